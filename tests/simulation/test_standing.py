"""Simulated robots stay on their feet, do what they are told, and lift their feet cleanly."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motions import value
from simulated import (
    BIPED,
    LIFTING,
    SOLES,
    SQUATS,
    STOOD,
    SWAYS,
    UNSEEN,
    feet_of,
    points_at,
    quadruped,
    robot_on,
    squat,
    zero_moment_margins,
)
from synthetic import ANYMAL, G1, SOLO12

from torchid.config import BoundsConfig, FootConfig, SensorImperfectionsConfig, SimulationConfig
from torchid.errors import InputError, UrdfError
from torchid.logs import read_log
from torchid.simulation import set_up_simulation
from torchid.simulation.plant import find_feet

THRESHOLD = 30.0  # N, from which on the shipped simulation counts a foot as standing


def stability(folder: Path) -> Mapping[str, Mapping[str, Any]]:
    found: Mapping[str, Mapping[str, Any]] = json.loads((folder / "stability.json").read_text())
    return found


def assert_nobody_falls(folder: Path) -> None:
    """Bounds of the whole set, much tighter than those that stop a simulation."""
    found = stability(folder)
    assert list(found) == [*SQUATS, *SWAYS, UNSEEN]
    for name, run in found.items():
        assert run["height_change"] < 0.12, name
        assert run["slip"] < 0.010, name
        assert run["zmp_margin"] > 0.010, name
        if name not in SWAYS:
            assert run["unloaded"] == [0.0, 0.0], name


# --------------------------------------------------------------------------------------------------------------- biped


def test_nobody_falls_in_the_first_seconds_of_any_motion(biped_folder: Path) -> None:
    assert_nobody_falls(biped_folder)
    for name in SWAYS:
        left, right = stability(biped_folder)[name]["unloaded"]
        assert right > 0.25, name  # the first foot to be lifted
        assert left > 0.05 or name != LIFTING, name


@pytest.mark.parametrize("name", [SQUATS[1], LIFTING])
def test_what_is_said_of_how_the_robot_stood_is_what_its_log_shows(biped_folder: Path, name: str) -> None:
    log, said = read_log(biped_folder / "exact" / f"{name}.npz"), stability(biped_folder)[name]
    height = value(log.base_position_world)[:, 2]
    assert said["base_height"] == pytest.approx([height.min(), height.max()], rel=1e-12)
    assert said["height_change"] >= 0.5 * np.ptp(height)
    load = value(log.contact_wrench_local)[..., 2]
    np.testing.assert_allclose(said["unloaded"], (load <= THRESHOLD).mean(axis=0), atol=2e-3)  # soles tilt a little
    slip, place = 0.0, feet_of(log)[0][..., :2]
    for foot in range(len(SOLES)):
        began = None
        for at, force in zip(place[:, foot], load[:, foot], strict=True):
            began = None if force <= THRESHOLD else at if began is None else began
            slip = max(slip, 0.0 if began is None else float(np.linalg.norm(at - began)))
    assert said["effort"] == pytest.approx(np.abs(value(log.joint_torque)).max() / 500.0)  # N m, all joints of the URDF
    assert said["beyond_limits"] == 0.0
    assert said["slip"] == pytest.approx(slip, abs=1e-5)
    margin = zero_moment_margins(log, np.array(find_feet([FootConfig(SOLES[0])], BIPED)[0].points)).min()
    assert said["zmp_margin"] == pytest.approx(margin, abs=2e-3)  # which takes the soles to be where they began


# -------------------------------------------------------------------------------------------------------- other robots

KNEES = {f"{side}_{joint}": angle for side in ("left", "right")
         for joint, angle in (("hip_pitch_joint", -0.4), ("knee_joint", 0.8), ("ankle_pitch_joint", -0.4))}  # fmt: skip
SOLO_LEGS = ("FL", "FR", "HL", "HR")
SOLO_POSTURE = {f"{leg}_{joint}": angle for leg in SOLO_LEGS for joint, angle in (("HFE", 0.8), ("KFE", -1.6))}


def g1() -> SimulationConfig:
    return robot_on(G1, [FootConfig(f"{side}_ankle_roll_link") for side in ("left", "right")], KNEES)


def solo12() -> SimulationConfig:
    sensors = SensorImperfectionsConfig(contact_threshold=1.0)  # it weighs 2.5 kg
    return robot_on(SOLO12, points_at(*(f"{leg}_FOOT" for leg in SOLO_LEGS)), SOLO_POSTURE, sensors=sensors)


@pytest.mark.parametrize(
    "config", [g1(), quadruped(), pytest.param(solo12(), marks=pytest.mark.study)], ids=["G1", "quadruped", "Solo12"]
)
def test_other_robots_stand_where_they_are_put_and_squat_as_far_as_they_are_told(config: SimulationConfig) -> None:
    simulation = set_up_simulation(config)
    recording, stood = simulation.run(config.motions[0])
    assert stood.height_change < 0.001
    assert stood.slip < 0.001
    assert stood.zmp_margin > 0.05
    assert set(stood.unloaded) == {0.0}
    assert np.ptp(value(recording.log.joint_position), axis=0).max() < 1e-3
    recording, stood = simulation.run(squat(0.03))
    assert stood.slip < 0.01
    assert stood.zmp_margin > 0.02
    assert set(stood.unloaded) == {0.0}
    assert 0.7 < np.ptp(value(recording.log.base_position_world)[:, 2]) / 0.06 < 1.4


def test_a_robot_that_no_matter_could_be_made_of_is_refused(tmp_path: Path) -> None:
    """ANYmal's cameras and hatch break the triangle inequality of inertias, the bodies they are part of do not."""
    feet = points_at(*(f"{leg}_FOOT" for leg in ("LF", "RF", "LH", "RH")))
    assert set_up_simulation(robot_on(ANYMAL, feet, {})).plant.mass > 40.0
    urdf = tmp_path / "anymal.urdf"
    urdf.write_text(re.sub(r'izz="[^"]*"', 'izz="90"', ANYMAL.read_text()))
    with pytest.raises(
        UrdfError, match=r"anymal.urdf: link '\w+': .*its inertia is not physically consistent"
    ) as raised:
        set_up_simulation(robot_on(urdf, feet, {}))
    assert "\n" not in str(raised.value)


def test_a_threshold_that_no_foot_ever_reaches_is_refused() -> None:
    config = dataclasses.replace(solo12(), sensors=SensorImperfectionsConfig(contact_threshold=30.0))
    with pytest.raises(InputError, match=r"sensors.contact_threshold: 30 N, but the force at .* is at most"):
        set_up_simulation(config).run(config.motions[0])


@pytest.mark.parametrize(
    ("found", "bounds", "message"),
    [
        ({"height_change": 0.3}, {}, "the base height changes by 0.3 m"),
        ({"slip": 0.02}, {}, "a foot slips by 20 mm"),
        ({"zmp_margin": 0.001}, {}, "the ZMP is 1 mm inside the support polygon"),
        ({"height_change": np.nan}, {}, "the base height changes by nan"),
        ({"slip": 0.0005}, {"slip_m": 0.0001}, "a foot slips by 0.5 mm"),
        ({"beyond_limits": 0.01}, {}, "a joint is 0.01 rad or m outside its limits"),
        ({"effort": 1.2}, {}, "a joint needs 120 % of its effort limit"),
    ],
)
def test_a_bound_that_is_broken_is_named_with_its_motion(
    found: dict[str, Any], bounds: dict[str, float], message: str
) -> None:
    STOOD.require_within(BoundsConfig(), "m")
    with pytest.raises(InputError, match=f"^motions.m: {message}"):
        dataclasses.replace(STOOD, **found).require_within(BoundsConfig(**bounds), "m")
