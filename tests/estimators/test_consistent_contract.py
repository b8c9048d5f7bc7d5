"""Contradictions end soon in a message; gaps are true; what is not free stays, as least squares has it."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from conic_reference import least_objective
from hypothesis import given, settings
from hypothesis import strategies as st
from physical import (
    PRIORS,
    active_case,
    nothing_seen,
    random_bodies,
    random_case,
)
from scipy.optimize import nnls

from torchid.errors import InputError, NumericalWarning
from torchid.estimators import Conditions, Consistent, Enclosure, Mirror, violations
from torchid.estimators.conic import Prior, build_conic_problem, solve_barrier

all_priors = pytest.mark.parametrize("prior", PRIORS)

# ------------------------------------------------------------------------------------------------------- contradictions


def contradictions() -> dict[str, tuple[Conditions, np.ndarray, str]]:
    """Conditions on two bodies that exclude each other, which parameters are free, what the message names."""
    nominal, free = random_bodies(np.random.default_rng(8), 2), np.ones(24, dtype=bool)
    held, none = free.copy(), np.zeros(24, dtype=bool)
    held[12:] = False
    lower, upper, negative = np.full((2, 12), -np.inf), np.full((2, 12), np.inf), np.full((2, 12), np.inf)
    lower[:, 0], upper[:, 10], negative[1, 0] = nominal[:, 0], -0.1, -1.0
    crossed = np.full((2, 12), np.inf)
    capped = crossed.copy()
    crossed[0, 0], capped[0, 10] = 0.5 * nominal[0, 0], 0.5 * nominal[1, 10]
    away = tuple(
        Enclosure(0, kind, np.full(3, x), np.eye(3), np.ones(3)) for kind, x in (("box", 0.0), ("ellipsoid", 9.0))
    )
    ghost = Mirror(0, 1, np.diag([1.0, -1.0, 1.0]))
    total = float(nominal[:, 0].sum())
    mass = "(upper|lower) bound of m of body|pseudo-inertia of body"
    return {
        "total mass below the bounds": (Conditions(lower=lower, total_mass=0.9 * total), free, mass),
        "mass at most negative": (Conditions(upper=negative), free, "(upper bound of m of|pseudo-inertia of) body 1"),
        "friction at most negative": (Conditions(upper=upper), free, "bounds of fc of body 0"),
        "bounds crossed": (Conditions(lower=lower, upper=crossed), free, "bounds of m of body 0"),
        "centre of mass in two places": (Conditions(enclosures=away), free, "body 0"),
        "total mass below a held body": (Conditions(total_mass=0.5 * float(nominal[1, 0])), held, "body 0"),
        "total mass of held bodies": (Conditions(total_mass=2.0 * total), none, "total_mass"),
        "total mass of images": (Conditions(total_mass=total, mirrors=(ghost,)), held, "total_mass, body 1 as mirror"),
        "mirror image of an impossible body": (Conditions(mirrors=(ghost,)), held, "pseudo-inertia of body 0"),
        "held friction beyond its image's": (Conditions(mirrors=(ghost,), upper=capped), held, "upper bound of fc"),
    }


@pytest.mark.parametrize("name", contradictions())
def test_conditions_that_exclude_each_other_are_refused_soon(name: str) -> None:
    conditions, free, named = contradictions()[name]
    nominal = random_bodies(np.random.default_rng(8), 2)
    problem = nothing_seen(nominal, free)
    if name.startswith("mirror"):
        nominal[1, 4] = 9.0 * nominal[1, [4, 7, 9]].sum()  # breaks the triangle inequality
        problem = replace(problem, nominal=nominal.ravel())
    started = time.process_time()
    with pytest.raises(InputError, match=named):
        Consistent(1e-3, conditions=conditions).solve(problem)
    assert time.process_time() - started < 5.0


def test_a_start_far_from_what_the_conditions_allow_finds_it() -> None:
    """No bound keeps masses from growing on the way."""
    rng = np.random.default_rng(12)
    nominal = random_bodies(rng, 2)
    for distance in (1.0, 10.0):  # of centres of mass [m]
        enclosures = tuple(
            Enclosure(body, kind, np.full(3, distance), np.eye(3), np.full(3, 0.01))
            for body, kind in ((0, "box"), (1, "ellipsoid"))
        )
        conditions = Conditions(enclosures=enclosures)
        problem = nothing_seen(nominal)
        estimate = Consistent(1e-3, conditions=conditions).solve(problem)
        assert violations(estimate.phi.reshape(2, 12), problem.scale.reshape(2, 12), conditions) == []
        assert estimate.objective == pytest.approx(least_objective(problem, conditions, "euclidean", 1e-3), rel=1e-6)


# ------------------------------------------------------------------------------------------------------------- the gap


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), prior=st.sampled_from(PRIORS))
def test_no_multipliers_claim_a_gap_that_is_too_small(seed: int, prior: Prior) -> None:
    """Weak duality: at the best point and far from it, with multipliers of that point, of another, and at random."""
    rng = np.random.default_rng(seed)
    case = random_case(rng)
    ridge = 0.0 if prior == "euclidean" else 10.0 ** rng.uniform(-6.0, -1.0)
    conic = build_conic_problem(case.problem, case.conditions, ridge, prior)
    best = solve_barrier(conic)
    inside = solve_barrier(conic, tolerance=1.0).x
    for here, there in ((0.0, 1e-3), (0.0, 1.0), (1e-3, 1e-3), (0.1, 0.0), (1.0, 0.1), (1.0, 1.0)):
        x, elsewhere = ((1.0 - share) * best.x + share * inside for share in (here, there))
        kappa = 10.0 ** rng.uniform(-12.0, 0.0)
        Z = (kappa + conic.weights)[:, None, None] * np.linalg.inv(conic.blocks(elsewhere))
        y = kappa / (conic.G @ elsewhere - conic.h)
        root = rng.normal(size=Z.shape)
        for noise in (0.0, kappa):
            gap = conic.gap(x, Z + noise * root @ root.mT, y)
            assert gap >= conic.objective(x) - best.objective - 1e-12


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-6])
@all_priors
def test_a_gap_is_as_small_as_was_asked_for_and_true(prior: Prior, tolerance: float) -> None:
    problem, _ = active_case(4)
    conic = build_conic_problem(problem, Conditions(), 1e-3, prior)
    rough, best = solve_barrier(conic, tolerance), solve_barrier(conic)
    assert rough.objective - best.objective <= rough.gap <= tolerance * rough.objective
    assert rough.steps < best.steps


def test_a_solver_that_stops_short_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = active_case(4)
    monkeypatch.setattr("torchid.estimators.conic._STEPS", 2)
    with pytest.warns(NumericalWarning, match=r"not converged \(duality gap .* Set a larger estimator.ridge"):
        estimate = Consistent(1e-3).solve(problem)
    assert estimate.gap > 1e-6 * estimate.objective


# ------------------------------------------------------------------------------------------------------ what is free


@all_priors
def test_what_is_not_free_is_taken_into_account(prior: Prior) -> None:
    problem, scale = active_case(9, bodies=3, rows=30)
    nominal, free = problem.nominal.reshape(3, 12).copy(), np.ones((3, 12), dtype=bool)
    nominal[2, :10], free[2, :10], free[1], free[0, 10] = 0.0, False, False, False  # no mass; held; no friction
    problem = replace(problem, nominal=nominal.ravel(), free=free.ravel())
    estimate = Consistent(1e-2, prior).solve(problem)
    assert np.isnan(estimate.eigenvalues).tolist() == [False, False, True]
    only = replace(
        problem, A=problem.A[:, :12], b=problem.b - problem.A[:, 12:] @ problem.nominal[12:], free=problem.free[:12],
        nominal=problem.nominal[:12], scale=problem.scale[:12],
    )  # fmt: skip
    without = replace(problem, free=np.where(np.arange(36) < 12, problem.free, False))
    alone, held = (Consistent(1e-2, prior).solve(p) for p in (only, without))
    np.testing.assert_allclose(
        alone.phi / only.scale, held.phi[:12] / only.scale, rtol=0.0, atol=1e-5
    )  # sqrt(gap / ridge)


def test_bounds_that_meet_hold_a_number() -> None:
    """The known mass of one body."""
    problem, scale = active_case(2)
    lower, upper = np.full(scale.shape, -np.inf), np.full(scale.shape, np.inf)
    lower[0, 0] = upper[0, 0] = 1.25 * problem.nominal[0]
    estimate = Consistent(1e-3, conditions=Conditions(lower=lower, upper=upper)).solve(problem)
    assert estimate.phi[0] == pytest.approx(lower[0, 0], rel=1e-7)


@all_priors
def test_friction_alone_can_be_free(prior: Prior) -> None:
    problem, _ = active_case(0)
    free = np.arange(24) % 12 >= 10
    estimate = Consistent(1e-6, prior).solve(replace(problem, free=free))
    A, b = problem.A[:, free], problem.b - problem.A[:, ~free] @ problem.nominal[~free]
    weight = np.sqrt(1e-6 * problem.rows)
    stacked, right = np.vstack([A, weight * np.eye(4)]), np.append(b, weight * problem.nominal[free])
    np.testing.assert_allclose(estimate.phi[free], nnls(stacked, right)[0], rtol=0.0, atol=1e-6)
