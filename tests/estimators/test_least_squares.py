"""Least squares: the nearest of all best answers to the URDF, and figures that say how far to trust it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from descents import arm_log, true_arm
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import UR5, Array, load
from thinned import study_but

from torchid import parameters
from torchid.estimators import LeastSquares
from torchid.problem import LinearProblem, RowBuilder, compress, linear_problem
from torchid.problem.linear import PRIOR_DEVIATION
from torchid.sensing import SensorNoise, named_sensors

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=50, deadline=None, derandomize=True)


def problem_of(A: Array, b: Array, nominal: Array | None = None, scale: Array | None = None) -> LinearProblem:
    """All rows as they are, all parameters free."""
    P = A.shape[1]
    nominal, scale = np.zeros(P) if nominal is None else nominal, np.ones(P) if scale is None else scale
    return LinearProblem(A, b, 0.0, len(b), nominal, scale, np.ones(P, dtype=bool))


def compressed(A: Array, b: Array, nominal: Array, scale: Array) -> LinearProblem:
    """The same by its triangular factor, as logs give it."""
    R = np.linalg.qr(np.column_stack([A, b]), mode="r")
    free = np.ones(A.shape[1], dtype=bool)
    return LinearProblem(R[:-1, :-1], R[:-1, -1], float(R[-1, -1] ** 2), len(b), nominal, scale, free)


def random_problem(rng: np.random.Generator, rows: int, rank: int, columns: int, noise: float = 1.0) -> LinearProblem:
    """A problem of a given rank, nominal values and scales of different sizes."""
    scale = 10.0 ** rng.uniform(-2.0, 2.0, columns)
    A = rng.normal(size=(rows, rank)) @ rng.normal(size=(rank, columns)) / scale
    nominal = scale * rng.normal(size=columns)
    b = A @ (nominal + scale * rng.normal(size=columns)) + noise * rng.normal(size=rows)
    return problem_of(A, b, nominal, scale)


# --------------------------------------------------------------------------------------------------------- the answer


@few
@given(seed=seeds, rank=st.integers(1, 8))
def test_of_all_best_answers_it_is_the_nearest_to_the_nominal_one(seed: int, rank: int) -> None:
    problem = random_problem(np.random.default_rng(seed), 20, rank, 8)
    estimate = LeastSquares().solve(problem)
    scaled = problem.A * problem.scale
    step = np.linalg.pinv(scaled, rcond=1e-10) @ (problem.b - problem.A @ problem.nominal)
    np.testing.assert_allclose((estimate.phi - problem.nominal) / problem.scale, step, rtol=0.0, atol=1e-10)
    gradient = scaled.T @ (problem.A @ estimate.phi - problem.b)
    assert np.abs(gradient).max() < 1e-11 * np.linalg.norm(scaled) * np.linalg.norm(problem.b)
    assert estimate.rank == rank
    assert estimate.identifiable.all() == (rank == 8)


@few
@given(seed=seeds, ridge=st.floats(1e-6, 1e6))
def test_a_ridge_solves_its_normal_equations(seed: int, ridge: float) -> None:
    problem = random_problem(np.random.default_rng(seed), 20, 5, 8)
    estimate = LeastSquares(ridge).solve(problem)
    scaled, b = problem.A * problem.scale, problem.b - problem.A @ problem.nominal
    gram = scaled.T @ scaled / problem.rows + ridge * np.eye(8)
    step = np.linalg.solve(gram, scaled.T @ b / problem.rows)
    change = (estimate.phi - problem.nominal) / problem.scale
    rounding = 1e-14 * (np.linalg.cond(gram) * np.abs(step).max() + np.abs(problem.nominal / problem.scale).max())
    np.testing.assert_allclose(change, step, rtol=0.0, atol=rounding)


@few
@given(seed=seeds, rank=st.integers(1, 8))
def test_a_batch_of_ridges_has_the_solution_of_each(seed: int, rank: int) -> None:
    problem, ridges = random_problem(np.random.default_rng(seed), 20, rank, 8), [0.0, 1e-4, 1.0, 1e3]
    U, values, Vh = np.linalg.svd(problem.A * problem.scale, full_matrices=False)
    along = (U.T @ (problem.b - problem.A @ problem.nominal))[:rank]
    for ridge, phi in zip(ridges, LeastSquares().minimize_all(problem, ridges), strict=True):
        step = Vh[:rank].T @ (values[:rank] / (values[:rank] ** 2 + problem.rows * ridge) * along)
        np.testing.assert_allclose((phi - problem.nominal) / problem.scale, step, rtol=0.0, atol=1e-10)
        np.testing.assert_array_equal(phi, LeastSquares(ridge).minimize(problem).phi)


def test_what_is_not_free_is_taken_into_account() -> None:
    rng = np.random.default_rng(1)
    problem = random_problem(rng, 30, 8, 8)
    free = np.array([True, False, True, True, False, True, True, False])
    estimate = LeastSquares().solve(replace(problem, free=free))
    rest = problem.b - problem.A[:, ~free] @ problem.nominal[~free]
    expected = np.linalg.lstsq(problem.A[:, free], rest, rcond=None)[0]
    np.testing.assert_allclose(estimate.phi[free], expected, rtol=1e-10)


# --------------------------------------------------------------------------------------------------- how far to trust


@pytest.mark.parametrize("tolerance", [1e-10, 1e-3])
def test_rank_and_condition_number_are_those_of_the_scaled_problem(tolerance: float) -> None:
    rng = np.random.default_rng(3)
    U, V = (np.linalg.qr(rng.normal(size=(n, n)))[0] for n in (9, 4))
    scale = np.array([1e-3, 1.0, 50.0, 7.0])
    A = (U[:, :4] * [3.0, 2.0, 1e-2, 1e-5]) @ V.T / scale
    estimate = LeastSquares(rank_tolerance=tolerance).solve(problem_of(A, rng.normal(size=9), scale=scale))
    assert estimate.rank == (4 if tolerance < 1e-6 else 3)
    assert estimate.condition_number == pytest.approx(3.0 / (1e-5 if tolerance < 1e-6 else 1e-2), rel=1e-9)


@pytest.mark.parametrize("ridge", study_but([0.02], [0.0, 0.02]))
def test_standard_errors_are_the_spread_of_repeated_experiments(ridge: float) -> None:
    rng = np.random.default_rng(4)
    rows, columns, sigma, trials = 60, 5, 0.7, 3000
    nominal, scale = rng.normal(size=columns), 10.0 ** rng.uniform(-1.0, 1.0, columns)
    A = rng.normal(size=(rows, columns)) * [1.0, 0.3, 1.0, 0.2, 1.0] / scale
    A[:, 2] += A[:, 0] * scale[0] / scale[2]
    true = nominal + 0.05 * scale * rng.normal(size=columns)
    noise = sigma * rng.normal(size=(trials, rows))
    estimates = [LeastSquares(ridge).solve(compressed(A, A @ true + e, nominal, scale)) for e in noise]
    spread = np.std([estimate.phi for estimate in estimates], axis=0)
    stated = np.sqrt(np.mean([estimate.standard_error**2 for estimate in estimates], axis=0))
    np.testing.assert_allclose(stated, spread, rtol=0.05)  # 3000 trials give the spread to 1.3 %
    assert np.mean([e.residual_std for e in estimates]) == pytest.approx(sigma, rel=0.02)


def test_without_a_ridge_standard_errors_are_the_textbooks() -> None:
    problem = random_problem(np.random.default_rng(5), 40, 6, 6)
    estimate = LeastSquares().solve(problem)
    variance = problem.cost(estimate.phi) / (40 - 6)
    covariance = variance * np.linalg.inv(problem.A.T @ problem.A)
    np.testing.assert_allclose(estimate.standard_error, np.sqrt(np.diag(covariance)), rtol=1e-9)
    assert estimate.residual_std == pytest.approx(np.sqrt(variance))


# ------------------------------------------------------------------------------------------------------------ refusals


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    good = problem_of(np.ones((3, 2)), np.ones(3))
    for change in ({"b": np.ones(2)}, {"nominal": np.ones(3)}, {"scale": np.ones(1)}, {"free": np.ones(3, bool)}):
        with pytest.raises(ValueError, match=r"accepted: b of shape \(3,\), the others \(2,\)"):
            replace(good, **change)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["A", "b", "nominal", "scale"])
def test_numbers_that_are_not_finite_are_refused_and_never_become_parameters(name: str, bad: float) -> None:
    good = problem_of(np.eye(3), np.ones(3))
    spoilt = getattr(good, name).copy()
    spoilt.flat[1] = bad
    with pytest.raises(ValueError, match="finite"):
        LeastSquares().solve(replace(good, **{name: spoilt}))


# --------------------------------------------------------------------------------------------- rows that hold back data


@pytest.mark.parametrize("ridge", [0.0, 0.1])
def test_what_rows_lack_is_no_share_of_the_data_and_part_of_the_standard_error(ridge: float) -> None:
    rng = np.random.default_rng(0)
    problem = random_problem(rng, 40, 5, 6)
    held, more = 0.3 * (problem.A * problem.scale), rng.normal(size=(40, 2))
    held[:, 2] = problem.A[:, 2] * problem.scale[2]  # the third parameter is the prior's alone
    held[:, 3:] = 0.0
    lacking = replace(problem, shrinkage=np.hstack([PRIOR_DEVIATION * held, more]))
    before, estimate = (LeastSquares(ridge).solve(x) for x in (problem, lacking))
    assert np.array_equal(estimate.phi, before.phi)
    shares = before.data_share * np.array([0.7, 0.7, 0.0, 1.0, 1.0, 1.0])
    assert np.allclose(estimate.data_share, shares, atol=1e-9)
    unit = np.eye(8)
    moved = [LeastSquares(ridge).solve(replace(problem, b=problem.b - lacking.shrinkage @ z)).phi for z in unit]
    expected = np.sqrt(before.noise_error**2 + np.square(np.array(moved) - before.phi).sum(0))
    assert np.allclose(estimate.noise_error, expected, rtol=1e-9, equal_nan=True)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (
            {"free": np.ones(12, dtype=np.int64)},
            r"free: found ndarray \(dtype int64\); accepted: a NumPy array of bool",
        ),
        ({"A": torch.ones(20, 12)}, r"A: found Tensor \(dtype torch.float32\); accepted: a NumPy array of floats"),
        ({"nominal": [0.0] * 12}, r"nominal: found list \(dtype None\); accepted: a NumPy array of floats"),
    ],
)
def test_a_problem_of_other_types_is_refused_by_name(wrong: dict[str, Any], said: str) -> None:
    parts: dict[str, Any] = {"A": np.ones((20, 12)), "b": np.ones(20), "nominal": np.ones(12), "scale": np.ones(12)}
    parts |= {"free": np.ones(12, dtype=bool), "residual": 0.0, "rows": 20} | wrong
    with pytest.raises(TypeError, match=said):
        LinearProblem(**parts)


def test_only_what_the_data_determine_counts_as_identifiable() -> None:
    """The first is seen alone; the second and third only by their sum, however hard a ridge pulls; the fourth never."""
    A = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0]])
    for ridge in (0.0, 1.0):
        estimate = LeastSquares(ridge).solve(problem_of(A, np.array([1.0, 4.0, 5.1])))
        np.testing.assert_array_equal(estimate.identifiable, [True, False, False, False])
        np.testing.assert_array_equal(np.isnan(estimate.standard_error), [False, True, True, True])


@pytest.mark.parametrize("share", [1e-1, 1e-3, 1e-4])
def test_a_parameter_seen_with_a_thousandth_of_another_is_not_determined(share: float) -> None:
    """Found on the G1: two 'identifiable' parameters were off by 3e-4 of their scale, on exact data."""
    estimate = LeastSquares().solve(problem_of(np.array([[1.0, share]]), np.array([share])))  # the truth: 0 and 1
    assert estimate.phi[0] == pytest.approx(share, rel=0.02)
    assert not estimate.identifiable.any()


def test_friction_of_an_excavator_is_not_held_back_by_a_prior_of_light_robots() -> None:
    robot, tons = load(UR5, fixed_base=True), 1e3
    truth = true_arm(robot)
    nominal = replace(robot, nominal=tons * robot.nominal)
    builder = RowBuilder(nominal, [], named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=0.1 * tons)))
    log = arm_log(robot, tons * truth, seed=1, count=300, noise=0.1 * tons)
    estimate = LeastSquares(ridge=1e-5).solve(linear_problem(compress([log], builder), builder, nominal))
    found = estimate.phi.reshape(truth.shape)[1:, parameters.FRICTION] / tons
    np.testing.assert_allclose(found, truth[1:, parameters.FRICTION], atol=0.1)  # 0.7 off if all have 1 N m
