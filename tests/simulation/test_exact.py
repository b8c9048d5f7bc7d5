"""Exact recordings obey the robot's dynamics with the true parameters, in and out of contact."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from motions import value
from scipy.spatial.transform import Rotation
from simulated import LIFTING, SOLES, SQUATS, UNSEEN, feet_of, forces, only, short
from synthetic import Array

from torchid.logs import Log, read_log
from torchid.simulation import Recording, set_up_simulation

COULOMB, VISCOUS = 1.0, 0.5  # N m, N m s/rad: what the shipped simulation has when friction is switched on


def exact(folder: Path, name: str) -> Log:
    return read_log(folder / "exact" / f"{name}.npz")


def recorded(name: str, seconds: float, *overrides: str) -> Recording:
    """One motion of the shipped simulation, in this process."""
    config = only(short(Path("nowhere"), *overrides), name)
    return set_up_simulation(config).run(dataclasses.replace(config.motions[0], duration_s=seconds))[0]


@pytest.fixture(scope="module")
def rubbing_squat() -> Log:
    """A squat of a robot with friction in every joint."""
    return recorded("squat_2.0hz", 1.0, "friction.enabled=true").log


@pytest.fixture(scope="module")
def rubbing_sway() -> Log:
    """A foot lifted by a robot with friction in every joint."""
    return recorded("sway_0.5hz", 2.5, "friction.enabled=true").log


def residual(log: Log) -> tuple[Array, Array]:
    """What S^T tau + J_C^T lambda has beyond K phi, (N, nv), and the size of the former, (N,)."""
    measured, predicted = forces(log)
    return measured - predicted, np.linalg.norm(measured, axis=1)


@pytest.mark.parametrize("name", ["squat_1.0hz", LIFTING, "sway_2.0hz", UNSEEN])
def test_inverse_dynamics_with_the_true_parameters_closes_at_every_instant(biped_folder: Path, name: str) -> None:
    log = exact(biped_folder, name)
    left, size = residual(log)
    assert size.min() > 100.0
    assert (np.linalg.norm(left, axis=1) / size).max() < 1e-6  # the solver's tolerance and the filed digits


def test_friction_leaves_the_base_rows_as_they_are(rubbing_squat: Log, rubbing_sway: Log) -> None:
    for log in (rubbing_squat, rubbing_sway):
        left, size = residual(log)
        assert (np.linalg.norm(left[:, :6], axis=1) / size).max() < 1e-6


def test_a_moving_joint_is_held_back_by_coulomb_and_viscous_friction(rubbing_squat: Log, rubbing_sway: Log) -> None:
    for log in (rubbing_squat, rubbing_sway):
        velocity = value(log.joint_velocity)
        taken = residual(log)[0][:, 6:]
        law = COULOMB * np.sign(velocity) + VISCOUS * velocity
        moving = np.abs(velocity) > 0.05  # rad/s: below, dry friction stops the joint within a step or two
        assert moving.mean() > 0.5
        assert (np.abs(taken - law)[moving] < 1e-5).mean() > 0.999


@pytest.mark.parametrize("name", ["squat_2.0hz", "sway_1.0hz"])
def test_positions_velocities_and_accelerations_are_steps_of_one_integration(biped_folder: Path, name: str) -> None:
    log = exact(biped_folder, name)
    step = 1e-3
    for rate, change in (
        ("joint_acceleration", "joint_velocity"),
        ("base_linear_acceleration_world", "base_linear_velocity_world"),
        ("base_angular_acceleration_base", "base_angular_velocity_base"),
    ):
        found = np.diff(value(getattr(log, change)), axis=0) / step
        np.testing.assert_allclose(found, value(getattr(log, rate))[:-1], rtol=0.0, atol=1e-9, err_msg=rate)
    for velocity, position in (
        ("joint_velocity", "joint_position"),
        ("base_linear_velocity_world", "base_position_world"),
    ):
        found = np.diff(value(getattr(log, position)), axis=0) / step  # the velocity at the step's end
        np.testing.assert_allclose(found, value(getattr(log, velocity))[1:], rtol=0.0, atol=1e-9, err_msg=velocity)
    base = Rotation.from_quat(value(log.base_quat_xyzw))
    turned = (base[:-1].inv() * base[1:]).as_rotvec() / step
    np.testing.assert_allclose(turned, value(log.base_angular_velocity_base)[1:], rtol=0.0, atol=1e-9)


def test_a_foot_off_the_floor_feels_nothing(biped_folder: Path) -> None:
    log = exact(biped_folder, LIFTING)
    active, wrench = value(log.contact_active), value(log.contact_wrench_local)
    assert (wrench[~active] == 0.0).all()
    height = feet_of(log)[0][..., 2]
    assert height[~active].min() > -1e-9
    assert (height[active] < 1e-3).mean() > 0.99
    assert (np.ptp(height, axis=0) > 0.045).all()  # of the 0.05 m it is told to lift them


def test_the_floor_only_pushes_and_within_its_friction(biped_folder: Path) -> None:
    for name in (SQUATS[0], LIFTING):
        log = exact(biped_folder, name)
        R = feet_of(log)[1]
        force = (R @ value(log.contact_wrench_local)[..., :3, None])[..., 0]
        assert force[..., 2].min() >= 0.0
        assert (np.hypot(force[..., 0], force[..., 1]) <= force[..., 2] + 1e-9).all()  # a coefficient of 1


def test_a_recording_knows_where_the_feet_are() -> None:
    recording = recorded("unseen_1.5hz", 0.2)
    place, R = feet_of(recording.log)
    np.testing.assert_allclose(recording.feet, place, rtol=0.0, atol=1e-12)
    assert recording.log.contact_names == SOLES
    tilt = np.arccos(np.clip(R[..., 2, 2], -1.0, 1.0))
    assert tilt.max() < 0.01  # the floor gives way under the heel or the toes
