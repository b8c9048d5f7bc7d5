"""Force plates under a robot: the wrenches at its feet as a laboratory records them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from dialects import save_csv
from motions import value
from scipy.spatial.transform import Rotation
from simulated import feet_of
from synthetic import Array
from walking import MACHINES, recorded, truth

from torchid.logs import Log, write_log

POSES = {"l_sole": ((0.31, -0.22, -0.04), (180.0, 0.0, 90.0)), "r_sole": ((-0.93, 0.41, 0.02), (177.0, 4.0, -63.0))}
"""Origin [m] and roll, pitch and yaw [deg] of the plate under each foot."""

PLATES_MAP = """
contact_order: [r_sole, l_sole]
contact_wrench_world:
  force: {column: "FP{index}_F{axis}", first_index: 1, scale: -1}
  moment: {column: "FP{index}_M{axis}", first_index: 1, scale: -1, unit: N mm}
contact_active: {above: 20}
plates:
  l_sole: {position: [0.31, -0.22, -0.04], rpy_deg: [180, 0, 90]}
  r_sole: {position: [-0.93, 0.41, 0.02], rpy_deg: [177, 4, -63]}
"""
"""Of `plates_csv`."""

OPENSIM_MAP = """
contact_wrench_world:
  force: {columns: {l_sole: "ground_force_v{axis}", r_sole: "1_ground_force_v{axis}"}}
  moment: {columns: {l_sole: "ground_torque_{axis}", r_sole: "1_ground_torque_{axis}"}}
contact_wrench_point_world: {columns: {l_sole: "ground_force_p{axis}", r_sole: "1_ground_force_p{axis}"}}
contact_active: {above: 20}
plates: {"*": {rpy_deg: [90, 0, 0]}}   # y points up
"""
"""Of `opensim_csv`."""

FREE_MOMENT_MAP = """
contact_wrench_world:
  force: "{contact}_F{axis}"
  moment: {column: "{contact}_Tz", axes: [z]}
contact_wrench_point_world: {column: "{contact}_COP{axis}", axes: [x, y], unit: mm}
contact_active: {above: 20}
plates: {"*": {}}
"""
"""Of `free_moment_csv`."""


@cache
def walk(seconds: float = 3.0) -> Log:
    """A biped that walks, with exact wrenches along world axes about its soles, which are 0 in the air."""
    machine = MACHINES["biped"]
    log = recorded(machine, truth(machine, 3, seconds=seconds), noise=0.0)
    wrench = np.where(value(log.contact_active)[..., None], value(log.contact_wrench_local), 0.0)
    loaded = np.linalg.norm(wrench[..., :3], axis=2) > 20.0
    wrench = np.where(loaded[..., None], wrench, 0.0)
    turned = np.einsum("nfij,nfkj->nfki", feet_of(log)[1], wrench.reshape(len(log), 2, 2, 3)).reshape(wrench.shape)
    return replace(log, contact_active=loaded, contact_wrench_local=None, contact_wrench_world=turned)


def moments_about(log: Log, point: Array) -> Array:
    """Moments (N, C, 3) [N m] of a log's wrenches about points of the world, (..., 3) [m], along its axes."""
    wrench = value(log.contact_wrench_world)
    return wrench[..., 3:] + np.cross(feet_of(log)[0] - point, wrench[..., :3])


def centres_of_pressure(log: Log) -> tuple[Array, Array]:
    """Where the ground's height of 0 is pressed, (N, C, 3) [m], NaN without a force, and the free moments (N, C)."""
    force, moment = value(log.contact_wrench_world)[..., :3], moments_about(log, np.zeros(3))
    with np.errstate(invalid="ignore"):
        x, y = -moment[..., 1] / force[..., 2], moment[..., 0] / force[..., 2]
    free = moment[..., 2] - np.nan_to_num(x) * force[..., 1] + np.nan_to_num(y) * force[..., 0]
    return np.stack([x, y, 0.0 * x], axis=2), free


def write_motion(path: Path, log: Log) -> Path:
    """All but what the plates read."""
    write_log(replace(log, contact_wrench_world=None, contact_names=(), contact_active=None), path)
    return path


def plates_csv(path: Path, log: Log) -> Path:
    """What the feet exert on rotated, shifted plates, in the plates' axes and about their origins, in N and N mm."""
    columns = {"time": log.time}
    for number, foot in enumerate(("r_sole", "l_sole"), 1):
        origin, rpy = POSES[foot]
        into, k = Rotation.from_euler("xyz", rpy, degrees=True).inv(), log.contact_names.index(foot)
        force = into.apply(-value(log.contact_wrench_world)[:, k, :3])
        moment = into.apply(-moments_about(log, np.array(origin))[:, k])
        columns |= {f"FP{number}_F{axis}": force[:, j] for j, axis in enumerate("xyz")}
        columns |= {f"FP{number}_M{axis}": 1e3 * moment[:, j] for j, axis in enumerate("xyz")}
    return save_csv(path, columns)


def opensim_csv(path: Path, log: Log) -> Path:
    """Forces, centres of pressure and free moments in a world whose y axis points up."""
    points, free = centres_of_pressure(log)
    vectors = {"force_v": value(log.contact_wrench_world)[..., :3], "force_p": points}
    vectors["torque_"] = free[..., None] * [0.0, 0.0, 1.0]
    columns = {"time": log.time}
    for name, of_feet in vectors.items():
        for before, vector in zip(("", "1_"), of_feet.transpose(1, 0, 2), strict=True):
            x, y, z = vector.T
            columns |= {f"{before}ground_{name}x": x, f"{before}ground_{name}y": z, f"{before}ground_{name}z": -y}
    return save_csv(path, columns)


def free_moment_csv(path: Path, log: Log) -> Path:
    """Forces, two coordinates of centres of pressure in mm, and the free moments alone."""
    points, free = centres_of_pressure(log)
    columns = {"time": log.time}
    for k, foot in enumerate(log.contact_names):
        columns |= {f"{foot}_F{axis}": value(log.contact_wrench_world)[:, k, j] for j, axis in enumerate("xyz")}
        columns |= {f"{foot}_COP{axis}": 1e3 * points[:, k, j] for j, axis in enumerate("xy")}
        columns[f"{foot}_Tz"] = free[:, k]
    return save_csv(path, columns)


LABORATORIES = {
    "plates": (plates_csv, PLATES_MAP),
    "OpenSim": (opensim_csv, OPENSIM_MAP),
    "free moments": (free_moment_csv, FREE_MOMENT_MAP),
}
"""What writes a table of readings, and its map."""
