"""Ridge 0: what the data do not determine stays nominal, as an independent conic solution has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conic_reference import least_misfit, least_prior
from physical import (
    PRIORS,
    active_case,
    as_good_as_none,
    prior_value,
    random_bodies,
    random_case,
)
from synthetic import Array

from torchid.errors import InputError
from torchid.estimators import Conditions, Consistent, LeastSquares, violations
from torchid.estimators.conic import Prior
from torchid.problem import LinearProblem
from torchid.problem.linear import parameter_scale

RANK = 1e-10  # what counts as determined
all_priors = pytest.mark.parametrize("prior", PRIORS)


def check(problem: LinearProblem, conditions: Conditions, prior: Prior, accuracy: float) -> None:
    """Least misfit, least prior among all that predict the same, conditions met, and nothing out of bounds."""
    estimate = Consistent(0.0, prior, conditions).solve(problem)
    phi, scale, nominal = (x.reshape(-1, 12) for x in (estimate.phi, problem.scale, problem.nominal))
    assert violations(phi, scale, conditions, 1e-7) == []
    floor = as_good_as_none(0.0, problem)
    misfit = problem.cost(estimate.phi) / problem.rows
    assert estimate.objective == pytest.approx(misfit, rel=1e-5, abs=1e-3 * floor)  # and the part of the least ridge
    least = least_misfit(problem, conditions)
    assert (misfit - least) / max(least, floor) < 1e-6
    bodies = problem.free.reshape(-1, 12)[:, 0]
    value = prior_value(prior, phi[bodies], nominal[bodies], scale[bodies])
    alike = least_prior(problem, conditions, prior, estimate.phi, RANK)
    assert value <= alike * (1.0 + accuracy) + accuracy
    assert np.abs((phi - nominal) / scale).max() < 1e3  # what data determine may be far away


# ---------------------------------------------------------------------------------------------- random and structural


@pytest.mark.parametrize("seed", [1, 3, 10])
@all_priors
def test_random_problems_have_the_least_misfit_and_of_all_with_it_the_least_prior(prior: Prior, seed: int) -> None:
    case = random_case(np.random.default_rng(seed))
    check(case.problem, case.conditions, prior, 1e-6)


# ------------------------------------------------------------------------------------------------------- known answers


def mass_alone(mass: float) -> tuple[LinearProblem, Array]:
    """Two bodies, and one row that says their total mass."""
    nominal = random_bodies(np.random.default_rng(1), 2)
    scale = parameter_scale(nominal)
    row = np.zeros((1, 24))
    row[0, [0, 12]] = 1.0
    free = np.ones(24, dtype=bool)
    return LinearProblem(row, np.array([mass]), 0.0, 1, nominal.ravel(), scale.ravel(), free), nominal


def test_without_active_conditions_it_is_least_squares_of_least_norm() -> None:
    problem, nominal = mass_alone(1.0)
    problem = replace(problem, b=np.array([1.01 * nominal[:, 0].sum()]))
    estimate = Consistent(0.0, conditions=Conditions(1e-6)).solve(problem)
    plain = LeastSquares().solve(problem)
    off = (estimate.phi - plain.phi) / problem.scale
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    assert estimate.increase == pytest.approx(0.0, abs=1e-12)


# ------------------------------------------------------------------------------------------------ flat bodies, rounding


@pytest.mark.parametrize("estimator", [LeastSquares(), Consistent(), Consistent(1e-3)])
def test_linear_algebra_that_fails_is_one_line(
    estimator: LeastSquares | Consistent, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem, _ = active_case(0)

    def fails(*arguments: object) -> None:
        raise np.linalg.LinAlgError("SVD did not converge")

    where = "least_squares._Inverse.of" if isinstance(estimator, LeastSquares) else "consistent._solve"
    monkeypatch.setattr(f"torchid.estimators.{where}", fails)
    with pytest.raises(InputError, match="^estimator: name: .*failed numerically .SVD did not converge.; accepted: "):
        estimator.solve(problem)
