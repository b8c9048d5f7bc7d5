"""Standard errors say what repeated experiments would: their 95 % intervals hold the truth in 95 % of cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from intervals import FEET, REPETITIONS, STATES, covered, noisy_torques
from numpy.typing import NDArray
from scipy import signal, stats
from synthetic import SOLO12, UR5, Array, Oracle, load, make_log
from true_robots import true_parameters

from torchid.estimators import Estimate, LeastSquares
from torchid.logs import Log, read_log, write_log
from torchid.logs.low_pass import FILTER_ORDER
from torchid.logs.preprocess import preprocess
from torchid.parameters import FRICTION, PER_BODY
from torchid.problem import LinearProblem, RowBuilder, Samples, bind_log, compress, linear_problem
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


def test_intervals_from_noisy_joint_torques_of_a_robot_on_its_feet_hold_the_truth() -> None:
    robot, rng = load(SOLO12), np.random.default_rng(1)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    log = make_log(oracle, [(foot.frame, 3) for foot in FEET], STATES, 60, rng)
    builder = RowBuilder(robot, FEET, named_sensors("joints", robot.n, 4, SensorNoise(0.3, 1.0, 0.1)))
    estimates = []
    for _, samples in zip(range(REPETITIONS), noisy_torques(bind_log(log, robot, FEET), builder, rng), strict=False):
        estimates.append(LeastSquares().solve(linear_problem(compress([samples], builder, threads=1), builder, robot)))
    holds = covered(estimates, true_parameters(oracle, robot).ravel())
    assert holds.shape[1] > 60
    assert_honest(holds)
    spread = np.mean([estimate.residual_std for estimate in estimates])
    assert spread == pytest.approx(1.0, abs=0.01), "the stated noise is the one there is"


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


def test_intervals_that_count_filtered_samples_as_independent_are_far_too_narrow(
    filtered: tuple[list[Estimate], list[Estimate], Array],
) -> None:
    _, counted, true = filtered
    assert covered(counted, true).mean() < 0.7


def test_the_residual_of_a_filtered_log_is_the_share_of_the_noise_that_passes(
    filtered: tuple[list[Estimate], list[Estimate], Array],
) -> None:
    corrected, _, _ = filtered
    passed = np.mean([estimate.residual_std**2 for estimate in corrected])
    assert passed == pytest.approx(1.0 / corrected[0].oversampling, rel=0.01)
    assert corrected[0].oversampling == pytest.approx(RATE / 2.0 / (0.898 * CUTOFF), rel=0.03)


def test_a_filtered_log_that_is_too_short_says_so_by_its_standard_errors_and_not_by_a_breakdown() -> None:
    rng = np.random.default_rng(4)
    A, b = rng.normal(size=(60, 10)), rng.normal(size=60)
    problem = LinearProblem(A, b, 0.0, 60, np.zeros(10), np.ones(10), np.ones(10, bool))
    kappas = (1.0, 2.0, 4.0, 5.9, 6.1, 50.0)
    errors = [LeastSquares().solve(replace(problem, oversampling=kappa)).standard_error[0] for kappa in kappas]
    assert errors == sorted(errors)
    assert errors[1] == pytest.approx(errors[0] * np.sqrt(2.0 * 50.0 / 40.0))
    assert errors[-1] == pytest.approx(errors[0] * 50.0)


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


def arm_samples(log: Log) -> Samples:
    robot = load(UR5, fixed_base=True)
    per_joint = log.arrays() | ({} if log.joint_direction is None else {"joint_direction": log.joint_direction})
    spread = {name: np.repeat(array, robot.n, axis=1) for name, array in per_joint.items() if name != "time"}
    return bind_log(replace(log, joint_names=robot.joint_names, **spread), robot, ())


def test_samples_count_as_often_as_the_filtered_noise_can_change() -> None:
    log = white(200.0, 20.0)
    assert arm_samples(log).oversampling == 1.0
    assert arm_samples(preprocess(log, None, 400.0)).oversampling == 1.0, "nothing is filtered"
    alone, thinned = (arm_samples(preprocess(log, 10.0, rate)) for rate in (None, 50.0))
    assert alone.oversampling == pytest.approx(100.0 / (0.898 * 10.0), rel=0.01)
    assert thinned.oversampling == pytest.approx(alone.oversampling / 4.0, rel=1e-6)
    assert arm_samples(preprocess(log, 95.0)).oversampling < 1.1
    assert alone[5:9].oversampling == alone.to("cpu").oversampling == alone.oversampling


def test_the_noise_bandwidth_survives_a_selection_and_is_no_part_of_a_file(tmp_path: pytest.TempPathFactory) -> None:
    out = preprocess(white(100.0, 20.0), 10.0)
    assert out.select(slice(5)).noise_bandwidth_hz == out.noise_bandwidth_hz
    assert preprocess(out, None, 50.0).noise_bandwidth_hz == out.noise_bandwidth_hz
    assert preprocess(out, 20.0).noise_bandwidth_hz == out.noise_bandwidth_hz, "what is gone does not come back"
    write_log(out, f"{tmp_path}/out.npz")
    with np.load(f"{tmp_path}/out.npz") as file:
        assert "noise_bandwidth_hz" not in file
    assert read_log(f"{tmp_path}/out.npz").noise_bandwidth_hz is None


@pytest.mark.parametrize("bad", [0.5, np.nan, np.inf])
def test_rows_that_are_more_than_independent_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="oversampling"):
        LinearProblem(np.eye(2), np.ones(2), 0.0, 2, np.zeros(2), np.ones(2), np.ones(2, bool), bad)
