"""Intervals of robots that shake faster than the filter's cutoff hold the truth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from synthetic import UR5, Array, load

from torchid import Regressor
from torchid.estimators import LeastSquares
from torchid.estimators.least_squares import IDENTIFIED
from torchid.fitting.fit import LogFitter
from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.parameters import FRICTION, PER_BODY, perturb_parameters
from torchid.problem import RowBuilder, bind_log
from torchid.problem.compression import compress_in_blocks, split_into_folds
from torchid.robot import Robot
from torchid.sensing import SensorNoise, named_sensors

RATE, SECONDS, TORQUE_NOISE = 500.0, 12.0, 0.2  # Hz, s, N m
CUTOFF, RESAMPLED = 20.0, 100.0  # Hz
MOTIONS = {"slow": ((0.5, 0.1, 0.6, 4),), "shaking": ((0.4, 0.2, 0.9, 4), (0.004, 12.0, 35.0, 6))}


def motion(kind: str, rng: np.random.Generator, time: Array, n: int) -> tuple[Array, Array, Array]:
    """Positions, velocities and accelerations of sums of sines [rad]: size, slowest and fastest [Hz], how many."""
    q, v, a = np.zeros((3, len(time), n))
    for size, slowest, fastest, count in MOTIONS[kind]:
        w = 2.0 * np.pi * rng.uniform(slowest, fastest, (count, n))
        phase = w * time[:, None, None] + rng.uniform(0.0, 2.0 * np.pi, (count, n))
        size /= np.sqrt(count)
        q, v = q + size * np.sin(phase).sum(axis=1), v + size * (w * np.cos(phase)).sum(axis=1)
        a = a - size * (w**2 * np.sin(phase)).sum(axis=1)
    return q, v, a


def held(robot: Robot, kind: str, seed: int, velocity_noise: float) -> tuple[Array, Array]:
    """Whether two standard errors hold the truth, of friction and of the bodies' parameters that are identified."""
    rng = np.random.default_rng([seed, 41])
    true = perturb_parameters(robot.nominal, 0.2, rng)
    true[1:, FRICTION] = rng.uniform((0.1, 0.05), (0.4, 0.2), (len(true) - 1, 2))
    time = np.arange(round(SECONDS * RATE)) / RATE
    q, v, a = motion(kind, rng, time, robot.n)
    with torch.no_grad():
        K = Regressor(robot)(*(torch.from_numpy(x) for x in (q, v, a)))
        torque = (K @ torch.from_numpy(true.flatten())).numpy()
    log = Log(
        f"{kind} {seed}",
        time=time,
        joint_names=robot.joint_names,
        joint_position=q,
        joint_velocity=v + velocity_noise * rng.normal(size=v.shape),
        joint_torque=torque + TORQUE_NOISE * rng.normal(size=torque.shape),
    )
    samples = bind_log(preprocess(log, CUTOFF, RESAMPLED), robot, [])
    builder = RowBuilder(robot, [], named_sensors("full", robot.n, 0, SensorNoise(joint_torque=TORQUE_NOISE)))
    fitter = LogFitter(robot=robot, builder=builder, estimator=LeastSquares())
    estimate = fitter.fit(compress_in_blocks(split_into_folds([samples], builder), builder)).estimate
    inside = (np.abs(estimate.phi - true.flatten()) <= 2.0 * estimate.standard_error).reshape(-1, PER_BODY)
    known = (estimate.verdict == IDENTIFIED).reshape(-1, PER_BODY)
    friction = np.zeros_like(known)
    friction[:, FRICTION] = True
    return inside[known & friction], inside[known & ~friction]


def coverage(kind: str, seeds: range, velocity_noise: float) -> tuple[float, float]:
    """Shares of friction and of bodies' parameters."""
    robot = load(UR5, fixed_base=True)
    found = [held(robot, kind, seed, velocity_noise) for seed in seeds]
    friction, bodies = (np.concatenate(parts) for parts in zip(*found, strict=True))
    assert len(friction) == 2 * robot.n * len(seeds)
    return float(friction.mean()), float(bodies.mean())


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_intervals_of_friction_hold_the_truth_on_a_shaking_log() -> None:
    friction, _ = coverage("shaking", range(2), velocity_noise=0.0)
    assert friction >= 0.9  # 0.2 where the sign is that of velocities behind the filter


@pytest.mark.study
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("kind", list(MOTIONS))
@pytest.mark.parametrize("velocity_noise", [0.0, 0.01])
def test_coverage_over_many_robots(kind: str, velocity_noise: float) -> None:
    friction, bodies = coverage(kind, range(100, 120), velocity_noise)
    assert friction >= 0.92
    assert bodies >= (0.92 if kind == "slow" else 0.8)  # what else the filter takes off a shaking motion
