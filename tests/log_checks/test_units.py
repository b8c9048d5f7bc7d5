"""Numbers in another unit than SI's are named with the unit that they seem to be in."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from faults import changed, demo_log, found, moving, of_demo, only, scaled, with_rates
from motions import uniform, value

from torchid.log_checks import NOTE, REJECTED
from torchid.log_checks.check import check
from torchid.logs import Log
from torchid.logs.units import UNITS, other_units, units_of_derivative_ratio, units_of_ratio


def with_velocity(log: Log) -> Log:
    """`log` with velocities and no accelerations."""
    return replace(with_rates(log), joint_acceleration=None)


@pytest.mark.parametrize("unit", [unit for unit, factor in UNITS["angular velocity"].items() if factor != 1.0])
@pytest.mark.parametrize("joints", [slice(None), slice(1, 2)], ids=["all", "one"])
def test_joint_velocities_in_any_unit_are_named_joint_by_joint(unit: str, joints: slice) -> None:
    factor = UNITS["angular velocity"][unit]
    log = changed(with_velocity(moving()), "joint_velocity", lambda v: v[:, joints].__itruediv__(factor))
    finding = only(check(log), "unit or sign", "joint_velocity")
    assert (finding.severity, finding.channels) == (REJECTED, log.joint_names[joints])
    assert f"joint_velocity is in {unit}" in finding.found
    assert f"logs.columns.joint_velocity.unit: {unit}" in finding.advice


def test_one_joint_in_degrees_is_named_by_its_velocity() -> None:
    log = changed(with_velocity(moving()), "joint_position", lambda q: q[:, 1].__imul__(180.0 / np.pi))
    finding = only(check(log), "unit or sign", "joint_velocity")
    assert finding.channels == ("b",)
    assert "logs.columns.joint_position.unit: deg" in finding.advice
    assert "time" not in finding.advice  # of one joint alone


def test_a_ratio_with_two_causes_names_both() -> None:
    both = units_of_derivative_ratio(np.pi / 180.0, "joint_velocity", "joint_position", 1)
    assert both == {"joint_position": ("deg",), "time": ("min",)}
    assert units_of_derivative_ratio(1e3, "joint_velocity", "joint_position", 1)["time"] == ("ms",)
    assert units_of_derivative_ratio(1e6, "joint_acceleration", "joint_position", 2)["time"] == ("ms",)
    assert not units_of_derivative_ratio(1.0, "joint_velocity", "joint_position", 1)
    assert not units_of_derivative_ratio(-57.3, "joint_velocity", "joint_position", 1)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("motion", ["noisy", "filtered", "still", "slow", "one joint"])
def test_velocities_in_si_units_give_no_alarm(seed: int, motion: str) -> None:
    log, rng = with_velocity(moving()), np.random.default_rng(seed)
    position, velocity = log.joint_position.copy(), value(log.joint_velocity).copy()
    if motion == "filtered":
        velocity = np.apply_along_axis(lambda v: np.convolve(v, np.full(21, 1 / 21), "same"), 0, velocity)
    elif motion != "noisy":
        kept = {"still": np.zeros(3), "slow": np.full(3, 1e-3), "one joint": np.array([0.0, 1.0, 0.0])}[motion]
        position, velocity = kept * (position - position[0]) + position[0], kept * velocity
    velocity += (0.3 if motion == "noisy" else 1e-3) * rng.normal(size=velocity.shape)
    position += 1e-4 * rng.normal(size=position.shape)
    checked = check(replace(log, joint_position=position, joint_velocity=velocity))
    assert not [one for one in checked.findings if one.name.startswith("unit")]


def shaken(unit: float, gravity: float = 9.80665) -> Log:
    """Ten seconds of an IMU on a base that sways and never rests, read in a unit of so many m/s^2."""
    time = uniform(10.0)
    sway = np.stack([np.sin(5.0 * time), np.sin(4.0 * time), 2.0 * np.sin(6.0 * time) + gravity], axis=1)
    path = np.stack([np.sin(5.0 * time + k) for k in range(3)], axis=1)
    return Log("sways.npz", time, ("a", "b", "c"), path, imu_frame="imu", imu_specific_force=sway / unit,
               imu_angular_velocity=0.1 * path)  # fmt: skip


@pytest.mark.parametrize("unit", ["g", "mg", "mm/s2", "cm/s2"])
def test_an_accelerometer_in_another_unit_is_named_without_rest(unit: str) -> None:
    finding = only(check(shaken(UNITS["acceleration"][unit])), "unit", "imu_specific_force")
    assert finding.severity == REJECTED
    assert re.search(f"logs.columns.imu_specific_force.unit: [^;]*{unit}", finding.advice)


@pytest.mark.parametrize("gravity", [9.80665, 0.0], ids=["with gravity", "without"])
def test_an_accelerometer_in_si_units_is_in_none_other(gravity: float) -> None:
    assert not found(check(shaken(1.0, gravity)), "unit")


def test_gravity_that_was_taken_out_is_missed_without_rest() -> None:
    assert not found(check(shaken(1.0)), "gravity")
    finding = only(check(shaken(1.0, 0.0)), "gravity", "imu_specific_force")
    assert (finding.severity, "gravity was removed" in finding.found) == (REJECTED, True)


@pytest.mark.parametrize("unit", ["mm", "cm"])
def test_a_base_position_in_another_unit_is_named_by_standing_feet(unit: str) -> None:
    log = demo_log().select(slice(0, 600))
    finding = only(of_demo(scaled(log, "base_position_world", 1.0 / UNITS["length"][unit])), "unit, sign or frame")
    assert (finding.severity, finding.field) == (REJECTED, "base_position_world")
    assert f"logs.columns.base_position_world.unit: {unit}" in finding.advice


def test_the_demo_has_no_finding() -> None:
    assert not [one for one in of_demo(demo_log()).findings if one.severity != NOTE]


@pytest.mark.parametrize("quantity", UNITS)
def test_numbers_in_every_unit_are_recognised_by_their_size(quantity: str) -> None:
    for unit, factor in UNITS[quantity].items():
        assert (unit in units_of_ratio(1.0 / factor, (quantity,))) == (factor != 1.0)
    assert {unit for units in other_units(quantity) for unit in units.split(" or ")} == {
        unit for unit, factor in UNITS[quantity].items() if factor != 1.0
    }
