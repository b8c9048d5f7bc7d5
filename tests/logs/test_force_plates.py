"""Force plates: moments about points of the world, which no foot's pose is part of, as moments at the feet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from dialects import parsed_map
from motions import value
from plates import (
    LABORATORIES,
    PLATES_MAP,
    centres_of_pressure,
    moments_about,
    plates_csv,
    walk,
    write_motion,
)
from raw_logs import log_refusal, write_arrays
from refusals import refused
from simulated import feet_of, forces
from synthetic import Array
from walking import MACHINES, recorded, robot_of, truth

from torchid.errors import InputError, TorchidWarning
from torchid.logs import Columns, Log, read_log, write_log
from torchid.logs.log import POINTS
from torchid.logs.preprocess import preprocess
from torchid.problem import RowBuilder, bind_log
from torchid.sensing import Contact, named_sensors

BIPED = MACHINES["biped"]
HERE, FAR = np.zeros(3), np.array([30.0, -20.0, 1.0])


def at_the_feet(log: Log) -> Array:
    """Wrenches (N, C, 6) at the soles along their axes, as the rows have them, while they touch."""
    robot, contacts = robot_of(BIPED), BIPED.contacts
    samples = bind_log(preprocess(log), robot, contacts)
    builder = RowBuilder(robot, contacts, named_sensors("full", robot.n, 2))
    with torch.no_grad():
        kinematics = builder.kinematics(samples)
        wrenches = [builder.recorded_wrench(kinematics, k).numpy() for k in range(2)]
    return np.where(samples.active.numpy()[..., None], np.stack(wrenches, axis=1), 0.0)


def along_world(log: Log) -> Log:
    """The log with wrenches along world axes."""
    local = value(log.contact_wrench_local).reshape(len(log), 2, 2, 3)
    turned = np.einsum("nfij,nfkj->nfki", feet_of(log)[1], local).reshape(len(log), 2, 6)
    return replace(log, contact_wrench_local=None, contact_wrench_world=turned)


def about_worlds_origin(log: Log, origin: Array = HERE) -> Log:
    """The log with moments about the origin of a world that is shifted, (3,) [m]."""
    moments = moments_about(log, -origin)
    wrench = np.concatenate([value(log.contact_wrench_world)[..., :3], moments], axis=2)
    return replace(log, contact_wrench_world=wrench, moments_about_world_origin=True)


def about_points(folder: Path, log: Log, points: Array, moments: Array, **more: Any) -> Path:
    """A file of arrays with moments about points of the world."""
    write_log(log, folder / "frames.npz")
    with np.load(folder / "frames.npz") as arrays:
        fields = dict(arrays)
    fields["contact_wrench_world"] = np.concatenate([fields["contact_wrench_world"][..., :3], moments], axis=2)
    return write_arrays(folder / "points.npz", fields | {POINTS: points} | more)


@pytest.mark.parametrize("laboratory", LABORATORIES)
def test_what_plates_read_is_what_acts_at_the_feet(laboratory: str, tmp_path: Path) -> None:
    write, text = LABORATORIES[laboratory]
    write_motion(tmp_path / "motion.npz", walk())
    write(tmp_path / "plates.csv", walk())
    found = read_log(tmp_path / "motion.npz + plates.csv", columns=parsed_map(text))
    assert found.moments_about_world_origin
    order = [found.contact_names.index(foot) for foot in BIPED.feet]
    assert np.array_equal(value(found.contact_active)[:, order], walk().contact_active)
    assert np.abs(at_the_feet(found) - at_the_feet(walk())).max() < 1e-9
    measured, expected = (forces(log)[0] for log in (preprocess(found), preprocess(walk())))
    assert np.abs(measured - expected).max() < 1e-9


def test_every_format_keeps_the_points_and_reads_the_same_log(tmp_path: Path) -> None:
    points, free = centres_of_pressure(walk())
    log = read_log(about_points(tmp_path, walk(), points, free[..., None] * [0.0, 0.0, 1.0]))
    assert np.abs(value(log.contact_wrench_world)[..., 3:] - moments_about(walk(), np.zeros(3))).max() < 1e-10
    for suffix in (".npz", ".h5", ".csv", ".parquet"):
        write_log(log, tmp_path / f"again{suffix}")
        again = read_log(tmp_path / f"again{suffix}")
        assert again.moments_about_world_origin
        assert np.array_equal(value(again.contact_wrench_world), value(log.contact_wrench_world))
    assert f'"{POINTS}.l_sole.x"' in (tmp_path / "again.csv").read_text().splitlines()[0].split(",")


def test_no_point_of_an_unloaded_plate_travels(tmp_path: Path) -> None:
    points, free = centres_of_pressure(walk())
    moments = free[..., None] * [0.0, 0.0, 1.0]
    idle = ~value(walk().contact_active)
    assert np.isnan(points[idle]).all()
    assert not np.isnan(points[~idle]).any()
    expected = value(read_log(about_points(tmp_path, walk(), points, moments)).contact_wrench_world)
    assert not expected[idle].any()
    for value_there in (np.nan, np.inf, 7.0):
        moved = np.where(idle[..., None], value_there, points)
        found = read_log(about_points(tmp_path, walk(), moved, moments))
        assert np.array_equal(value(found.contact_wrench_world), expected)
    lost = np.where(idle[..., None], np.nan, moments)
    assert np.array_equal(value(read_log(about_points(tmp_path, walk(), points, lost)).contact_wrench_world), expected)


def test_a_moment_about_an_unknown_point_is_not_known_while_the_foot_is_loaded(tmp_path: Path) -> None:
    points, free = centres_of_pressure(walk())
    sample = int(np.flatnonzero(value(walk().contact_active)[:, 0])[3])
    points[sample, 0] = np.nan
    log = read_log(about_points(tmp_path, walk(), points, free[..., None] * [0.0, 0.0, 1.0]))
    moment = value(log.contact_wrench_world)[..., 3:]
    assert np.isnan(moment[sample, 0]).all()
    assert np.isnan(moment).sum() == 3
    with pytest.warns(TorchidWarning, match="gaps of up to 0.02 s were bridged in 1 of 600 samples"):
        bridged = read_log(tmp_path / "points.npz", bridge_gaps_s=0.02)
    error = value(bridged.contact_wrench_world)[sample, 0, 3:] - moments_about(walk(), np.zeros(3))[sample, 0]
    assert np.abs(error).max() < 1.0  # of a spline through moments of 100 N m


def test_points_are_not_interpolated_but_the_moments_about_the_worlds_origin(tmp_path: Path) -> None:
    """A centre of pressure jumps where its force vanishes, the moment of that force does not."""
    log, half = walk(), slice(0, None, 2)
    points, free = centres_of_pressure(log)
    write_motion(tmp_path / "motion.npz", log.select(half))
    stamps = log.time + 0.3 * (log.time[1] - log.time[0])
    common = {"time": stamps, "contact_names": BIPED.feet, "contact_active": log.contact_active}
    force, zero = value(log.contact_wrench_world)[..., :3], np.zeros_like(points)
    with_points = np.concatenate([force, free[..., None] * [0.0, 0.0, 1.0]], axis=2)
    about_origin = np.concatenate([force, moments_about(log, np.zeros(3))], axis=2)
    found = []
    for wrench, about in ((with_points, points), (about_origin, zero)):
        np.savez(tmp_path / "plates.npz", contact_wrench_world=wrench, **common, **{POINTS: about})
        found.append(value(read_log(tmp_path / "motion.npz + plates.npz").contact_wrench_world))
    assert np.isfinite(found[0]).all()
    assert np.abs(found[0] - found[1]).max() < 1e-9


def filter_error(log: Log, cutoff_hz: float) -> float:
    """Rms [N m] of what is left of the base's moment equations of a robot that is its URDF."""
    measured, predicted = forces(preprocess(log, cutoff_hz))
    return float(np.sqrt(np.square(measured - predicted)[:, 3:6].mean()))


def test_a_filter_leaves_no_more_error_of_moments_about_a_point_at_rest_than_about_feet_that_swing() -> None:
    """Moments about a point of the world are linear in what is filtered; those about a foot that lands are not."""
    happened = truth(BIPED, 3, seconds=4.0, share=0.0)
    loaded = happened.share > 0.0
    exact = recorded(BIPED, happened, noise=0.0)
    local = replace(exact, joint_torque=happened.torque, contact_active=loaded, contact_wrench_local=happened.wrench)
    feet = along_world(local)
    plates = about_worlds_origin(feet)
    further = replace(plates, base_position_world=value(plates.base_position_world) + FAR)
    further = replace(about_worlds_origin(feet, FAR), base_position_world=further.base_position_world)
    for cutoff, share in ((3.0, 1.0), (6.0, 1.0), (12.0, 1.001)):  # of 0.24, 0.07 and 0.02 N m, of 19
        error = filter_error(plates, cutoff)
        assert error < share * min(filter_error(local, cutoff), filter_error(feet, cutoff))
        assert filter_error(further, cutoff) == pytest.approx(error, rel=1e-6), "where the world's origin is"


# -------------------------------------------------------------------------------------------------------- refusals


def test_what_no_frame_can_be_found_by_is_refused_in_one_line(tmp_path: Path) -> None:
    robot, contacts = robot_of(BIPED), BIPED.contacts
    log = about_worlds_origin(walk())
    lost = preprocess(replace(log, base_linear_acceleration_world=np.zeros((len(log), 3)), base_position_world=None))
    message = refused(
        lambda: bind_log(lost, robot, contacts), "biped: contact_wrench_point_world: moments about the world"
    )
    assert "base_position_world and the base's orientation, or moments" in message
    points = [Contact(foot, "point") for foot in BIPED.feet]
    assert bind_log(lost, robot, points).base.position is None  # no moment is read
    zeros = np.zeros((len(log), 2, 3))
    far, wide, infinite = zeros.copy(), zeros[:, :1], zeros + 1.0
    far[5, 1, 2], infinite[7, 0, 1] = 1e31, np.inf
    moments = value(log.contact_wrench_world)[..., 3:]
    for bad, found in ((far, "1e+31 at sample 5, component 1 z"), (infinite, "inf at sample 7"), (wide, "(600, 1, 3)")):
        assert f"{POINTS}: " in (line := log_refusal(about_points(tmp_path, walk(), bad, moments)))
        assert found in line
    with np.load(about_points(tmp_path, walk(), zeros, moments)) as arrays:
        alone = {name: x for name, x in arrays.items() if name != "contact_wrench_world"}
    assert "given without contact_wrench_world" in log_refusal(write_arrays(tmp_path / "alone.npz", alone))


BAD_MAPS = [
    ("plates: {l_sole: {}}", "no plate for r_sole; accepted: one for every contact; * stands for all others"),
    ("plates: {l_sole: {}, r_sole: {}, foot: {}}", "logs.columns.plates: unknown name 'foot'; accepted: r_sole, l_sol"),
    ('plates: {"*": {}}\ncontact_wrench_world: null', "logs.columns.plates: given without logs.columns.contact_wrench"),
    ('plates: {"*": {}}\ncontact_wrench_point_world: {column: "FP{index}_M{axis}", unit: N}', "a unit of force; acce"),
]


@pytest.mark.parametrize(("more", "expected"), BAD_MAPS)
def test_maps_of_plates_that_do_not_fit_are_refused(more: str, expected: str, tmp_path: Path) -> None:
    text = PLATES_MAP.partition("plates:")[0]
    settings = yaml.safe_load(text) | yaml.safe_load(more)
    path = plates_csv(tmp_path / "plates.csv", walk())
    assert expected in refused(lambda: read_log(path, columns=Columns(**settings)), "", InputError)
