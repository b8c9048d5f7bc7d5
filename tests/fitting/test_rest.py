"""Joints that pause, where friction is whatever holds them: with their torques unmeasured then, fits are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from delays import arm, motion
from scipy.integrate import cumulative_trapezoid
from synthetic import Array

from torchid.estimators import LeastSquares
from torchid.fitting.fit import Fit, LogFitter
from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.parameters import COULOMB, PER_BODY, VISCOUS
from torchid.problem import RowBuilder, bind_log
from torchid.problem.compression import compress_in_blocks
from torchid.sensing import SensorNoise, named_sensors

STEP, SECONDS = 0.005, 20.0  # [s]
FRICTION = np.array([0.8, 0.5])  # [N m]
VISCOSITY = 0.3  # [N m s/rad], as in `arm`
NOISE = 0.05  # [N m]
SLOWER = 0.1  # sines up to 3 Hz, in a phase that is three times as fast as time at most: less than 1 Hz


def phase(time: Array) -> tuple[Array, Array, Array]:
    """A phase of each joint that stands still for a third of the time, (N, 2), and its derivatives."""
    frequency = 2.0 * np.pi / np.array([2.6, 3.4])
    turn, share = frequency * time[:, None], np.maximum(np.sin(frequency * time[:, None]) + 0.5, 0.0)
    speed, rate = share**3, 3.0 * share**2 * np.cos(turn) * frequency
    return cumulative_trapezoid(speed, time, axis=0, initial=0.0), speed, rate


def recorded(seed: int, noise: float = 0.0, moving: tuple[float, float] = (1.0, 1.0)) -> tuple[Log, Array]:
    """A log of the arm, with noise of the encoders, too, if torques have noise; and the velocities."""
    robot, oracle = arm()
    rng, time = np.random.default_rng(seed), STEP * np.arange(round(SECONDS / STEP))
    s, speed, rate = phase(time)
    each = [motion(SLOWER * s[:, joint]) for joint in range(2)]
    q, dq, ddq = (np.stack([each[joint][k][:, joint] for joint in range(2)], axis=1) for k in range(3))
    v, a = SLOWER * dq * speed, SLOWER**2 * ddq * speed**2 + SLOWER * dq * rate
    moved = q * moving, v * moving, a * moving
    held = FRICTION * np.sin(time[:, None] * rng.uniform(0.5, 3.0, 2) + rng.uniform(0.0, 6.0, 2))
    torque = oracle.forces(*moved) + np.where(moved[1] == 0.0, held, FRICTION * np.sign(moved[1]))
    fields = dict(zip(("joint_position", "joint_velocity", "joint_acceleration"), moved, strict=True))
    if noise:
        fields = {"joint_position": moved[0] + 2e-5 * rng.normal(size=q.shape)}
        torque += noise * rng.normal(size=q.shape)
    return Log("arm.npz", time, robot.joint_names, joint_torque=torque, **fields), moved[1]


def fitted(log: Log, finds_rest: bool, cutoff_hz: float | None = None) -> Fit:
    robot, _ = arm()
    sensors = named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=NOISE))
    fitter = LogFitter(robot=robot, builder=RowBuilder(robot, (), sensors), estimator=LeastSquares())
    samples = bind_log(preprocess(log, cutoff_hz, cutoff_hz and 5.0 * cutoff_hz, finds_rest=finds_rest), robot, ())
    return fitter.fit(compress_in_blocks([samples], fitter.builder))


def friction(values: Array) -> Array:
    """Coulomb and viscous friction of both joints, (2, 2)."""
    return values.reshape(-1, PER_BODY)[1:, [COULOMB, VISCOUS]]


TRUE = np.stack([FRICTION, np.full(2, VISCOSITY)], axis=1)


def test_friction_of_joints_that_pause_is_found_exactly_with_their_torques_unmeasured() -> None:
    log, velocity = recorded(0)
    rests = preprocess(log, finds_rest=True).joint_rests
    assert rests is not None
    slow = 0.1 * np.sqrt(np.square(velocity).mean(0))
    assert (rests == (np.abs(velocity) <= slow)).mean() > 0.999
    assert ((velocity == 0.0).mean(0) > 0.3).all()
    found, without = fitted(log, True).estimate, fitted(log, False).estimate
    np.testing.assert_allclose(friction(found.phi), TRUE, rtol=1e-9)
    assert found.residual_std < 1e-9 < 1.0 < without.residual_std, "of the noise"


def test_intervals_hold_the_friction_of_joints_that_pause_only_with_their_torques_unmeasured() -> None:
    held = {True: 0, False: 0}
    for seed in range(6):
        log, _ = recorded(seed, NOISE)
        for finds_rest in held:
            estimate = fitted(log, finds_rest, 15.0).estimate
            inside = np.abs(friction(estimate.phi) - TRUE) <= 1.96 * friction(estimate.standard_error)
            held[finds_rest] += int(inside.sum())
    assert held[True] >= 22, "of 24"
    assert held[False] <= 2


def test_what_holds_a_joint_at_rest_is_not_in_the_filtered_torques_that_count_as_measured() -> None:
    cutoff, (log, velocity) = 8.0, recorded(0)
    slow = np.abs(velocity) <= 0.1 * np.sqrt(np.square(velocity).mean(0))
    largest, rests = np.zeros(2), None
    for seed in range(20):  # of friction that pushes either way, in steps
        pushes = np.repeat(np.sign(np.random.default_rng(seed).normal(size=(len(slow), 2))), 1 + seed, axis=0)
        held = replace(log, joint_torque=np.where(slow, pushes[: len(slow)], 0.0))
        filtered = preprocess(held, cutoff, finds_rest=True)
        rests = filtered.joint_rests
        assert rests is not None
        assert filtered.joint_torque is not None
        largest = np.maximum(largest, np.abs(np.where(rests, 0.0, filtered.joint_torque)).max(0))
    assert (largest < 0.0357).all(), "of it: what the filter leaves 1/cutoff after a pause, whichever way it pushed"
    assert rests is not None
    away = np.convolve(slow[:, 0], np.ones(2 * round(1.0 / (cutoff * STEP)) + 1), "same") == 0.0
    kept, within_reach = (~rests[:, 0]).mean(), away.mean()
    assert kept > 1.15 * within_reach > 0.0, "turns between two moves weigh less than pauses"
