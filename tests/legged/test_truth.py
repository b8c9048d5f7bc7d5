"""Simulated legged robots are exact: forces obey the dynamics of the true parameters wherever the ground acts."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from legged.errors import parameter_errors, structural_base
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import FRICTION_WIDTH, G1, GO2, QUADRUPED, Legged, TrueRobot
from legged.simulate import Exact, prescribed, simulated
from motions import value
from scipy.spatial.transform import Rotation
from synthetic import PINOCCHIO_ORDER, Array, Oracle
from walkers import INSTALLED, WALKERS

from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.problem import Evaluation, ExtraTerms, bind_log
from torchid.problem.metrics import force_series
from torchid.sensing import Contact

SECONDS = 1.6


@cache
def true_robot(legged: Legged) -> TrueRobot:
    return TrueRobot.unlike_its_urdf(legged)


@cache
def walked(legged: Legged) -> Exact:
    """In MuJoCo."""
    true = true_robot(legged)
    return simulated(true, Reference(true, SECONDS, seed=0), SECONDS)


@cache
def planned(legged: Legged) -> Exact:
    """By inverse dynamics."""
    true = true_robot(legged)
    return prescribed(true, Reference(true, SECONDS, seed=0, static=True), SECONDS)


def missed(true: TrueRobot, log: Log, sign_width: float | None) -> float:
    """Largest error of K phi against the forces of a log, as a share of the largest force.

    Contacts count as flat ones: so all of the wrench at the frame's origin enters, wherever the ground acts.
    """
    contacts = [Contact(foot, "flat") for foot in true.legged.feet]
    evaluation = Evaluation(true.robot, contacts, terms=ExtraTerms(armature=True, sign_width=sign_width))
    phi = np.append(true.phi.flatten(), true.armature)
    measured, (predicted,) = force_series(evaluation.builder, bind_log(log, true.robot, contacts), phi[None])
    return float(np.abs(predicted - measured).max() / np.abs(measured).max())


# ----------------------------------------------------------------------------------------------------------- exactness


@pytest.mark.parametrize("legged", WALKERS)
def test_forces_of_a_simulated_log_are_those_of_the_true_parameters(legged: Legged) -> None:
    true, log = true_robot(legged), walked(legged).log
    assert missed(true, log, FRICTION_WIDTH) < 1e-10
    still = TrueRobot.unlike_its_urdf(legged, seed=1)
    assert missed(still, log, FRICTION_WIDTH) > 1e-2, "another robot's are not"


@pytest.mark.parametrize("legged", WALKERS)
def test_forces_along_a_prescribed_motion_are_those_of_the_true_parameters(legged: Legged) -> None:
    assert missed(true_robot(legged), planned(legged).log, None) < 1e-10


def of_truth(true: TrueRobot) -> Oracle:
    """Pinocchio's model of a true robot."""
    oracle = Oracle.of(true.robot)
    for body, place in oracle._places(true.robot):
        oracle.model.inertias[place] = pin.Inertia.FromDynamicParameters(true.phi[body, PINOCCHIO_ORDER])
    for name, friction in zip(true.robot.joint_names, true.friction, strict=True):
        oracle.friction[oracle.moving.index(name)] = friction
    return oracle


@pytest.mark.parametrize("legged", WALKERS)
def test_forces_along_a_prescribed_motion_are_pinocchios(legged: Legged) -> None:
    true, log = true_robot(legged), planned(legged).log.select(slice(None, None, 40))
    turn = Rotation.from_quat(value(log.base_quat_xyzw))
    v, a = value(log.base_linear_velocity_world), value(log.base_linear_acceleration_world)
    omega = value(log.base_angular_velocity_base)
    local = turn.inv().apply(v)
    q = np.hstack([value(log.base_position_world), turn.as_quat(), log.joint_position])
    velocity = np.hstack([local, omega, value(log.joint_velocity)])
    linear = turn.inv().apply(a) - np.cross(omega, local)
    acceleration = np.hstack([linear, value(log.base_angular_acceleration_base), value(log.joint_acceleration)])
    oracle = of_truth(true)
    needed = oracle.forces(q, velocity, acceleration)
    needed[:, 6:] += true.armature * value(log.joint_acceleration)
    given = np.hstack([np.zeros((len(q), 6)), value(log.joint_torque)])
    for number, foot in enumerate(legged.feet):
        R, _ = oracle.pose(q, foot)
        wrench = value(log.contact_wrench_world)[:, number].reshape(-1, 2, 3) @ R
        given += np.einsum("nkj,nk->nj", oracle.jacobian(q, foot), wrench.reshape(-1, 6))
    assert np.abs(needed - given).max() < 1e-9 * np.abs(given).max()


# ---------------------------------------------------------------------------------------------------------- the ground


@INSTALLED
def test_the_ground_acts_a_radius_below_the_middle_of_a_ball_foot() -> None:
    exact = walked(GO2)
    on = value(exact.log.contact_active)
    arm = exact.arm[on]
    assert np.abs(arm[:, :2]).max() < 1e-12
    depth = arm[:, 2] + GO2.radius  # half of the depth by which the foot sinks into the floor
    assert depth.min() >= 0.0
    assert np.median(depth) < 2e-5
    assert depth.max() < 5e-4, "at impacts"
    force, moment = np.split(value(exact.log.contact_wrench_world)[on], 2, axis=1)
    np.testing.assert_allclose(moment, np.cross(arm, force), atol=1e-9)
    smooth = planned(GO2)
    lowest = smooth.arm[value(smooth.log.contact_active)]
    np.testing.assert_allclose(lowest, np.broadcast_to([0.0, 0.0, -0.022], lowest.shape), atol=1e-12)


@pytest.mark.parametrize("legged", WALKERS)
def test_feet_are_lifted_push_and_do_not_slip(legged: Legged) -> None:
    exact = walked(legged)
    on, force = value(exact.log.contact_active), value(exact.log.contact_wrench_world)[..., :3]
    assert (force[on][:, 2] > 0.0).all()
    assert (~on).any()
    assert on.any(axis=1).all()
    weight = 9.81 * true_robot(legged).phi[:, 0].sum()
    assert force[..., 2].sum(axis=1).mean() == pytest.approx(weight, rel=0.02)
    tangent = np.linalg.norm(force[..., :2], axis=2)[on] / force[on][:, 2]
    assert np.mean(tangent < 1.4) > 0.95, "inside the friction cone: no slip"


# ---------------------------------------------------------------------------------------------- the truth, and sensors


@pytest.mark.parametrize("legged", WALKERS)
def test_errors_are_one_for_the_urdf_and_zero_for_the_truth(legged: Legged) -> None:
    true = true_robot(legged)
    urdf, truth = (parameter_errors(true, phi) for phi in (true.robot.nominal, true.phi))
    assert (urdf.median, urdf.inertial, urdf.friction) == (1.0, 1.0, 1.0)
    assert (truth.median, truth.worse) == (0.0, 0.0)
    assert truth.mass == pytest.approx(true.phi[:, 0].sum())
    assert structural_base(legged).rank == 10 + 9 * true.robot.n, "ten of the base; seven and friction of every joint"
    halfway = parameter_errors(true, 0.5 * (true.phi + true.robot.nominal))
    assert halfway.median == pytest.approx(0.5)


def test_a_recording_has_the_noise_that_is_stated_and_no_rates() -> None:
    exact, noise = planned(QUADRUPED), Noise()
    log = record(exact, "trunk", noise, np.random.default_rng(0))
    for name in ("joint_velocity", "joint_acceleration", "base_angular_velocity_base", "base_position_world"):
        assert getattr(log, name) is None
    for name, deviation in (("joint_position", 1e-3), ("joint_torque", 0.3)):
        error: Array = value(getattr(log, name)) - value(getattr(exact.log, name))
        assert error.std() == pytest.approx(deviation, rel=0.03)
    assert (value(log.imu_angular_velocity) - exact.rate[:, 3:6]).std() == pytest.approx(0.01, rel=0.03)
    silent = record(exact, "trunk", noise.times(0.0, 0.0), np.random.default_rng(0))
    np.testing.assert_array_equal(silent.joint_position, exact.log.joint_position)
    true = true_robot(QUADRUPED)
    bound = bind_log(preprocess(silent), true.robot, true.legged.contacts())
    rates = bind_log(exact.log, true.robot, true.legged.contacts())
    np.testing.assert_allclose(bound.base.specific_force, rates.base.specific_force[2:-2], atol=1e-9)


@pytest.mark.study
def test_no_robot_falls() -> None:
    for legged in (GO2, G1, QUADRUPED):
        for seed in range(3):
            true = TrueRobot.unlike_its_urdf(legged, seed)
            assert len(simulated(true, Reference(true, 20.0, seed=seed), 20.0).log) == 10_000
