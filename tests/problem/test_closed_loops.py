"""Closed loops against MuJoCo: its constraint forces drop out, and parameters are found to the last digits."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from closed_loops import MODELS, RANKS, LoopWorld, loop_world
from synthetic import Array

from torchid.errors import LogError
from torchid.estimators import Estimate, LeastSquares
from torchid.problem import Evaluation, RowBuilder, Samples, bind_log, compress, linear_problem
from torchid.problem.metrics import at_motors, force_series, null_space_part
from torchid.regressor import FrameJacobian, LoopJacobian, Regressor
from torchid.sensing import Projection, SensorSet, named_sensors

EXACT = 1e-8  # of the largest force or of a parameter's size; 1e-12 measured for most

robots = pytest.mark.parametrize("name", MODELS)


def sensors_of(w: LoopWorld, name: str = "joints") -> SensorSet:
    """A named set; torques of joints without a motor are known with all of them."""
    sensors = named_sensors(name, w.robot.n, len(w.contacts))
    return replace(sensors, torque=sensors.torque | w.robot.is_passive)


def samples_of(w: LoopWorld, sensors: SensorSet | None = None) -> Samples:
    """The samples of the log, NaN for wrenches that the sensors do not measure."""
    samples = bind_log(w.log, w.robot, w.contacts)
    if sensors is None or samples.wrench is None:
        return samples
    return replace(samples, wrench=torch.where(torch.from_numpy(sensors.wrench), samples.wrench, torch.nan))


@cache
def found(name: str, sensors: str) -> Estimate:
    w = loop_world(name)
    chosen = sensors_of(w, sensors)
    builder = RowBuilder(w.robot, w.contacts, chosen)
    factor = compress([samples_of(w, chosen)], builder)
    return LeastSquares().solve(linear_problem(factor, builder, w.robot))


@robots
def test_the_null_space_annihilates_mujocos_own_jacobian(name: str) -> None:
    w = loop_world(name)
    sensors = sensors_of(w)
    builder, samples = RowBuilder(w.robot, w.contacts, sensors), samples_of(w)
    assert np.abs(w.base).max() < 1e-12, "forces inside the robot do not move its base"
    J = np.concatenate([np.zeros((*w.loops.shape[:2], 6)), w.loops], axis=2)
    size = np.linalg.norm(J, axis=(1, 2)).min()
    inside = null_space_part(builder, samples, J.transpose(1, 0, 2).copy())
    assert np.abs(inside).max() < 1e-10 * size


@robots
def test_the_loops_rows_span_those_of_mujoco_and_no_more(name: str) -> None:
    w = loop_world(name)
    q = torch.tensor(np.hstack([np.zeros((len(w.log), 3)), w.log.base_quat_xyzw, w.log.joint_position]))
    own = LoopJacobian(w.robot)(q)[..., 6:].numpy()
    for one, other in zip(own, w.loops, strict=True):
        ranks = [np.linalg.matrix_rank(x, tol=1e-9) for x in (one, other, np.concatenate([one, other]))]
        assert ranks == [RANKS[name]] * 3


@robots
def test_true_parameters_explain_what_is_left_without_constraint_forces(name: str) -> None:
    w = loop_world(name)
    sensors = sensors_of(w, "full")
    builder, samples = RowBuilder(w.robot, w.contacts, sensors), samples_of(w)
    measured, (true, nominal) = force_series(builder, samples, np.stack([w.true.flatten(), w.robot.nominal.flatten()]))
    size = np.abs(measured).max()
    assert np.abs(true - measured).max() > 1e-2 * size, "constraint forces are in the rows of joints"
    errors = null_space_part(builder, samples, np.stack([true - measured, nominal - measured]))
    assert np.abs(errors[0]).max() < 1e-12 * size
    assert np.abs(errors[1]).max() > 1e-2 * size


@robots
def test_what_was_found_predicts_the_motors_of_motions_that_no_fit_has_seen(name: str) -> None:
    w = loop_world(name, 60, 7)
    samples, evaluation = samples_of(w), Evaluation(w.robot, w.contacts)
    phi = np.stack([w.robot.nominal.flatten(), found(name, "joints").phi])
    before, after = evaluation.metrics([samples], phi)
    motors = [joint for joint in w.robot.joint_names if joint not in w.robot.passive]
    for joint in w.robot.joint_names:
        error = after.by_joint_relative[joint]
        if joint in motors:
            assert error is not None
            assert error < EXACT
        else:
            assert error is None, "what goes through the loop is not known"
    for group in ("base_force", "base_moment", "nullspace"):
        assert (after.relative[group] or 1.0) < EXACT
        assert (before.relative[group] or 0.0) > 1e-2


@robots
def test_torques_at_the_motors_are_those_of_virtual_work(name: str) -> None:
    w = loop_world(name)
    builder, samples = RowBuilder(w.robot, w.contacts, sensors_of(w)), samples_of(w)
    measured, predicted = force_series(builder, samples, w.true.flatten()[None])
    errors: Array = at_motors(builder, samples, predicted - measured)[0][:, 6:]
    motors = ~w.robot.is_passive
    assert np.abs(errors[:, motors]).max() < 1e-11 * np.abs(measured).max()
    in_loops = list(builder.motors.passive)
    assert np.isnan(errors[:, in_loops]).all()


@robots
def test_the_public_modules_make_the_same_equations(name: str) -> None:
    w = loop_world(name)
    sensors, samples = sensors_of(w, "full"), samples_of(w)
    builder, (q, v, a) = RowBuilder(w.robot, w.contacts, sensors), samples.coordinates()
    torque, J_L = samples.torque, LoopJacobian(w.robot)(q)
    assert torque is not None
    assert samples.wrench is not None
    J_C = torch.cat([FrameJacobian(w.robot, x.frame)(q)[:, list(x.components)] for x in w.contacts], dim=1)
    masks, read = [], []
    for index, contact in enumerate(w.contacts):
        masks.append(samples.active[:, index, None].expand(-1, len(contact.components)))
        read.append(samples.wrench[:, index, list(contact.components)])
    always, nothing = J_L.new_ones(J_L.shape[:2], dtype=torch.bool), J_L.new_zeros(J_L.shape[:2])
    measured = [True] * J_C.shape[1] + [False] * J_L.shape[1]
    groups = Projection(sensors.torque, measured)(
        torch.cat([J_C, J_L], dim=1),
        torch.cat([*masks, always], dim=1),
        Regressor(w.robot)(q, v, a),
        torque - builder.known_torques.of(samples),
        torch.cat([*read, nothing], dim=1),
    )
    for group in groups:
        left = (group.K @ torch.from_numpy(w.true.flatten()) - group.f).abs().max()
        assert left < 1e-11 * group.f.abs().max()
        assert group.K.shape[1] == 6 + w.robot.n - RANKS[name]


def test_a_wrong_frame_is_refused_with_how_far_the_loop_is_open() -> None:
    w = loop_world("four-bar leg")
    loop = replace(w.robot.loops[0], frames=(w.robot.loops[0].frames[0], "toe"))
    with pytest.raises(
        LogError, match=r"robot.loops\[0\]: pin of coupler and toe are apart by 3\d\d mm rms, 3\d\d mm at most; "
    ):
        bind_log(w.log, replace(w.robot, loops=(loop,)), w.contacts)
    assert len(bind_log(w.log, replace(w.robot, loops=(replace(loop, max_gap=0.5),)), w.contacts)) == len(w.log.time)


def test_a_torque_of_a_joint_without_a_motor_is_refused() -> None:
    w = loop_world("four-bar leg")
    torque = np.nan_to_num(w.log.joint_torque)
    joint = w.robot.joint_names.index("knee")
    torque[3, joint] = 2.0
    with pytest.raises(
        LogError,
        match=r"joint_torque: up to 2 N m at joints without a motor: knee; accepted: 0 or NaN .* robot.passive: \[",
    ):
        bind_log(replace(w.log, joint_torque=torque), w.robot, w.contacts)
    torque[3, joint] = 0.0
    samples = bind_log(replace(w.log, joint_torque=torque), w.robot, w.contacts)
    assert samples.torque is not None
    assert torch.equal(samples.torque, samples_of(w).torque)
