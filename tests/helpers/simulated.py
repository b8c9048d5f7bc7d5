"""Simulated robots that several test files use, and the sums that their logs must add up to."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from motions import value
from repository import CONFIGS, DEMO
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from synthetic import Array, load

import torchid
from torchid.config import FootConfig, MotionConfig, SimulationConfig, StepsConfig, load_simulation
from torchid.config.simulation import SimulatedRobotConfig, WaveConfig
from torchid.logs import Log
from torchid.problem import Evaluation, bind_log
from torchid.problem.metrics import force_series
from torchid.robot import load_robot
from torchid.simulation import Stability

SHIPPED = CONFIGS / "biped_simulation.yaml"
BIPED = CONFIGS / "biped.urdf"
QUADRUPED = DEMO / "quadruped.urdf"
SOLES = ("l_sole", "r_sole")
SQUATS = ("squat_0.5hz", "squat_1.0hz", "squat_1.5hz", "squat_2.0hz", "squat_2.5hz", "squat_3.0hz", "squat_3.5hz")
SWAYS = ("sway_0.0hz", "sway_0.5hz", "sway_1.0hz", "sway_1.5hz", "sway_2.0hz")
UNSEEN = "unseen_1.5hz"
LIFTING = "sway_0.5hz"
"""The sway that is long enough in the short set for both feet to be lifted."""


def shipped(output: Path, *overrides: str) -> SimulationConfig:
    """The shipped simulation at its full length."""
    return load_simulation(SHIPPED, (f"output={output}", *overrides))


def short(output: Path, *overrides: str) -> SimulationConfig:
    """The shipped simulation with every motion cut to seconds; each sway lifts a foot."""
    config = shipped(output, *overrides)

    def cut(motion: MotionConfig) -> MotionConfig:
        seconds = 4.5 if motion.name == LIFTING else 2.5 if motion.steps else 1.2
        return dataclasses.replace(motion, duration_s=seconds)

    return dataclasses.replace(config, motions=[cut(motion) for motion in config.motions])


def only(config: SimulationConfig, *names: str) -> SimulationConfig:
    """The simulation with some of its motions."""
    return dataclasses.replace(config, motions=[motion for motion in config.motions if motion.name in names])


def robot_on(
    urdf: Path, feet: Sequence[FootConfig], posture: dict[str, float], *motions: MotionConfig, **settings: Any
) -> SimulationConfig:
    """A simulation of another robot, that nothing writes."""
    standing = motions or (MotionConfig("stand", 1.0),)
    robot = SimulatedRobotConfig(urdf)
    return SimulationConfig(
        robot=robot, feet=list(feet), motions=list(standing), output=Path("nowhere"), posture=posture, **settings
    )


def points_at(*frames: str) -> list[FootConfig]:
    """Feet that touch the floor at their origins alone."""
    return [FootConfig(frame, [[0.0, 0.0, 0.0]]) for frame in frames]


def quadruped(*motions: MotionConfig, **settings: Any) -> SimulationConfig:
    """The demo quadruped on its four point feet, knees bent."""
    legs = ("front_left", "front_right", "rear_left", "rear_right")
    posture = {f"{leg}_{joint}": angle for leg in legs for joint, angle in (("thigh", 0.6), ("knee", -1.2))}
    return robot_on(QUADRUPED, points_at(*(f"{leg}_foot" for leg in legs)), posture, *motions, **settings)


def squat(amplitude: float, hz: float = 1.0, seconds: float = 2.0) -> MotionConfig:
    """The centre of mass up and down [m]."""
    return MotionConfig("squat", seconds, [WaveConfig("com_z", hz, amplitude)])


def stepping(*order: str, hz: float = 1.0 / 6.0, seconds: float = 6.0, **settings: float) -> MotionConfig:
    """Feet lifted in turn while nothing else moves."""
    return MotionConfig("stepping", seconds, [], StepsConfig(hz, list(order), **settings))


STOOD = Stability((0.7, 0.8), 0.05, 0.001, 0.03, beyond_limits=0.0, effort=0.5, unloaded=(0.0, 0.2))
"""Of a robot that kept to all bounds."""


def forces(
    log: Log, urdf: Path = BIPED, feet: Sequence[str] = SOLES, held: Mapping[str, float] | None = None
) -> tuple[Array, Array]:
    """Measured S^T tau + J_C^T lambda, and K phi of the true inertias without friction, (N, nv) each."""
    robot = load(urdf) if held is None else load_robot(urdf, weld=held)
    contacts = [torchid.Contact(frame, "flat") for frame in feet]
    phi = robot.nominal.copy()
    phi[:, 10:] = 0.0
    builder = Evaluation(robot, contacts).builder
    measured, (predicted,) = force_series(builder, bind_log(log, robot, contacts), phi.flatten()[None])
    return measured, predicted


def feet_of(log: Log, urdf: Path = BIPED) -> tuple[Array, Array]:
    """Positions (N, F, 3) [m] and rotations (N, F, 3, 3) to world of a log's contact frames."""
    robot = load(urdf)
    columns = [log.joint_names.index(name) for name in robot.joint_names]
    poses = robot.link_poses(torch.from_numpy(log.joint_position[:, columns]))
    T_base_foot = np.stack([poses[frame].numpy() for frame in log.contact_names], axis=1)
    R = Rotation.from_quat(value(log.base_quat_xyzw)).as_matrix()[:, None]
    place = (R @ T_base_foot[..., :3, 3:])[..., 0] + value(log.base_position_world)[:, None]
    return place, R @ T_base_foot[..., :3, :3]


def zero_moment_margins(log: Log, points: Array) -> Array:
    """Distance (N,) [m] from the zero-moment point to the border of the loaded feet's hull, by the log alone.

    Args:
        log: exact log.
        points: of every foot that may touch the floor, (k, 3) [m] in its frame.
    """
    place, R = feet_of(log)
    wrench = value(log.contact_wrench_local)
    force = (R @ wrench[..., :3, None])[..., 0]
    moment = (R @ wrench[..., 3:, None])[..., 0] + np.cross(place, force)
    total, turning = force.sum(1), moment.sum(1)
    zmp = np.stack([-turning[:, 1], turning[:, 0]], axis=1) / total[:, 2:]
    corners = place[:, :, None, :2] + np.einsum("nfij,kj->nfki", R, points)[..., :2]
    margins = []
    for at, corner, on in zip(zmp, corners, force[..., 2] > 0.0, strict=True):
        hull = ConvexHull(corner[on].reshape(-1, 2)).equations
        margins.append(-(hull[:, :2] @ at + hull[:, 2]).max())
    return np.array(margins)
