"""Standard errors say what repeated experiments would: their 95 % intervals hold the truth in 95 % of cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from intervals import REPETITIONS, covered
from numpy.typing import NDArray
from scipy import signal, stats
from synthetic import UR5, Array, Oracle, load
from true_robots import true_parameters

from torchid.estimators import Estimate, LeastSquares
from torchid.logs import Log
from torchid.logs.low_pass import FILTER_ORDER
from torchid.logs.preprocess import preprocess
from torchid.parameters import FRICTION, PER_BODY
from torchid.problem import LinearProblem, RowBuilder, bind_log, compress, linear_problem
from torchid.robot import Robot
from torchid.sensing import SensorNoise, named_sensors


def assert_honest(holds: NDArray[np.bool_]) -> None:
    """92 to 98 % of all intervals; of each parameter's, as many as chance allows in all but one of 10^5 cases."""
    assert 0.92 < holds.mean() < 0.98
    least, most = stats.binom.ppf([1e-5, 1.0 - 1e-5], len(holds), 0.95)
    counts = holds.sum(axis=0)
    assert least <= counts.min()
    assert counts.max() <= most


# --------------------------------------------------------------------------------------------------------- white noise


def test_intervals_from_white_rows_hold_the_truth() -> None:
    rng = np.random.default_rng(0)
    scale = 10.0 ** rng.uniform(-1.0, 1.0, 6)
    A = rng.normal(size=(80, 5)) @ rng.normal(size=(5, 6)) / scale
    A[:, 5] = 0.0  # never seen
    true = scale * rng.normal(size=6)
    free = np.array([True, True, True, True, False, True])
    nominal = np.where(free, 0.0, true)
    problem = LinearProblem(A, A @ true, 0.0, 80, nominal, scale, free)
    estimates = [
        LeastSquares().solve(replace(problem, b=problem.b + 0.3 * rng.normal(size=80))) for _ in range(REPETITIONS)
    ]
    holds = covered(estimates, true)
    assert holds.shape[1] == 4
    assert_honest(holds)


@pytest.mark.parametrize("ridge", [1e-2, 1e-1, 1.0])
def test_intervals_of_a_ridge_hold_the_truth_whatever_it_keeps_of_the_nominal_parameters(ridge: float) -> None:
    rng, bodies, rows, others = np.random.default_rng(5), 5, 200, 3800  # rows that tell of noise alone
    is_friction = np.arange(PER_BODY * bodies) % PER_BODY >= FRICTION.start
    scale, off = 10.0 ** rng.uniform(-1.0, 1.0, is_friction.size), np.where(is_friction, 2.0, 0.15)
    A = rng.normal(size=(rows, is_friction.size)) * 10.0 ** rng.uniform(-1.0, 1.5, is_friction.size)
    holds, of_noise = [], []
    for _ in range(100):
        nominal = scale * rng.normal(size=scale.size)
        true = nominal + scale * off * rng.normal(size=scale.size)
        b = A / scale @ true + rng.normal(size=rows)
        problem = LinearProblem(A / scale, b, rng.chisquare(others), rows + others, nominal, scale, scale > 0.0)
        estimate = LeastSquares(ridge).solve(problem)
        error = np.abs(estimate.phi - true)
        holds.append(error <= 1.959964 * estimate.standard_error)
        of_noise.append(error <= 1.959964 * estimate.noise_error)
    assert 0.92 < np.mean(holds) < 0.98
    assert np.mean(of_noise) < 0.75, "noise alone is not what such an estimate is off by"


# ------------------------------------------------------------------------------------------------------ filtered noise


CUTOFF, RATE, SECONDS, TORQUE_NOISE = 20.0, 200.0, 3.0, 2.0


def smooth_log(robot: Robot, oracle: Oracle, rng: np.random.Generator) -> Log:
    """A bolted arm whose joints swing at 0.2 to 1.5 Hz: forces stay far below the cutoff; no dry friction, no noise."""
    time = np.arange(round(SECONDS * RATE)) / RATE
    rates = 2.0 * np.pi * rng.uniform(0.2, 1.5, (4, robot.n))
    phases, sizes = rng.uniform(0.0, 2.0 * np.pi, (4, robot.n)), rng.uniform(0.1, 0.5, (4, robot.n))
    angles = time[:, None, None] * rates + phases
    q = (sizes * np.sin(angles)).sum(1)
    v = (sizes * rates * np.cos(angles)).sum(1)
    a = -(sizes * rates**2 * np.sin(angles)).sum(1)
    return Log("arm.npz", time, robot.joint_names, q, v, a, oracle.forces(q, v, a))


@pytest.fixture(scope="module")
def filtered() -> tuple[list[Estimate], list[Estimate], Array]:
    """Fits of the same motion with new torque noise each time: with the correction, without, and the truth."""
    robot, rng = load(UR5, fixed_base=True), np.random.default_rng(2)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    oracle.friction[:, 0] = 0.0
    log = smooth_log(robot, oracle, rng)
    builder = RowBuilder(robot, (), named_sensors("joints", robot.n, 0, SensorNoise(TORQUE_NOISE)))
    corrected, counted = [], []
    for _ in range(REPETITIONS):
        noise = TORQUE_NOISE * rng.normal(size=log.joint_position.shape)
        samples = bind_log(preprocess(replace(log, joint_torque=log.joint_torque + noise), CUTOFF), robot, ())
        factor = compress([samples], builder, threads=1)
        for kappa, estimates in ((samples.oversampling, corrected), (1.0, counted)):
            estimates.append(LeastSquares().solve(replace(linear_problem(factor, builder, robot), oversampling=kappa)))
    return corrected, counted, true_parameters(oracle, robot).ravel()


def test_intervals_from_a_filtered_log_hold_the_truth(filtered: tuple[list[Estimate], list[Estimate], Array]) -> None:
    corrected, _, true = filtered
    holds = covered(corrected, true)
    assert holds.shape[1] > 20
    assert_honest(holds)


# ------------------------------------------------------------------------------------------------------ noise bandwidth


def white(rate: float, seconds: float = 400.0) -> Log:
    """A joint at rest whose torque sensor reads white noise of one newton metre."""
    count = round(rate * seconds)
    noise = np.random.default_rng(3).normal(size=(count, 1))
    still = np.zeros((count, 1))
    return Log("white.npz", np.arange(count) / rate, ("a",), still, still, still, noise)


@pytest.mark.parametrize(("cutoff", "rate"), [(5.0, 100.0), (20.0, 100.0), (45.0, 100.0), (2.0, 500.0)])
def test_the_noise_bandwidth_is_what_the_filter_leaves_of_white_noise(cutoff: float, rate: float) -> None:
    out = preprocess(white(rate), cutoff)
    assert out.noise_bandwidth_hz is not None
    assert out.joint_torque is not None
    assert np.var(out.joint_torque) == pytest.approx(out.noise_bandwidth_hz / (rate / 2.0), rel=0.08)
    impulse = np.zeros(2**15)
    impulse[2**14] = 1.0
    response = signal.sosfiltfilt(signal.butter(FILTER_ORDER, cutoff, fs=rate, output="sos"), impulse)
    assert out.noise_bandwidth_hz == pytest.approx(rate / 2.0 * float(np.sum(response**2)), rel=1e-9)
