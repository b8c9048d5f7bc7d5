"""Contradictions end soon in a message; what is not free stays; the contract that least squares meets as well."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from physical import active_case, nothing_seen, random_bodies

from torchid.errors import InputError
from torchid.estimators.conditions import Conditions, Enclosure, Mirror
from torchid.estimators.consistent import Consistent, Method, Prior

PRIORS: tuple[Prior, ...] = ("euclidean", "pullback", "entropic")
METHODS: tuple[Method, ...] = ("barrier", "certified")
both = pytest.mark.parametrize("method", METHODS)
all_priors = pytest.mark.parametrize("prior", PRIORS)

# ------------------------------------------------------------------------------------------------------- contradictions


def contradictions() -> dict[str, tuple[Conditions, np.ndarray]]:
    """Conditions on two bodies that exclude each other, and which parameters are free."""
    nominal, free = random_bodies(np.random.default_rng(8), 2), np.ones(24, dtype=bool)
    held, none = free.copy(), np.zeros(24, dtype=bool)
    held[12:] = False
    lower, upper, negative = np.full((2, 12), -np.inf), np.full((2, 12), np.inf), np.full((2, 12), np.inf)
    lower[:, 0], upper[:, 10], negative[1, 0] = nominal[:, 0], -0.1, -1.0
    crossed = np.full((2, 12), np.inf)
    crossed[0, 0] = 0.5 * nominal[0, 0]
    away = tuple(
        Enclosure(0, kind, np.full(3, x), np.eye(3), np.ones(3)) for kind, x in (("box", 0.0), ("ellipsoid", 9.0))
    )
    ghost = Mirror(0, 1, np.diag([1.0, -1.0, 1.0]))
    return {
        "total mass below the bounds": (Conditions(lower=lower, total_mass=0.9 * float(nominal[:, 0].sum())), free),
        "mass at most negative": (Conditions(upper=negative), free),
        "friction at most negative": (Conditions(upper=upper), free),
        "bounds crossed": (Conditions(lower=lower, upper=crossed), free),
        "centre of mass in two places": (Conditions(enclosures=away), free),
        "total mass below a held body": (Conditions(total_mass=0.5 * float(nominal[1, 0])), held),
        "total mass of held bodies": (Conditions(total_mass=2.0 * float(nominal[:, 0].sum())), none),
        "mirror image of an impossible body": (Conditions(mirrors=(ghost,)), held),
    }


@pytest.mark.parametrize("name", contradictions())
@both
def test_conditions_that_exclude_each_other_are_refused_soon(method: Method, name: str) -> None:
    conditions, free = contradictions()[name]
    nominal = random_bodies(np.random.default_rng(8), 2)
    problem = nothing_seen(nominal, free)
    if name.startswith("mirror"):
        nominal[1, 4] = 9.0 * nominal[1, [4, 7, 9]].sum()  # breaks the triangle inequality
        problem = replace(problem, nominal=nominal.ravel())
    started = time.perf_counter()
    with pytest.raises(InputError, match="mass|friction|fc|bound|body|mirror|conditions"):
        Consistent(1e-3, conditions=conditions, method=method).solve(problem)
    assert time.perf_counter() - started < 5.0


@both
def test_bounds_that_meet_hold_a_number(method: Method) -> None:
    """The known mass of one body."""
    problem, scale = active_case(2)
    lower, upper = np.full(scale.shape, -np.inf), np.full(scale.shape, np.inf)
    lower[0, 0] = upper[0, 0] = 1.25 * problem.nominal[0]
    estimate = Consistent(1e-3, conditions=Conditions(lower=lower, upper=upper), method=method).solve(problem)
    assert estimate.phi[0] == pytest.approx(lower[0, 0], rel=1e-7)


# --------------------------------------------------------------------------------------------------------- the contract


@all_priors
@both
def test_what_is_not_free_stays_nominal_to_the_last_bit_and_is_taken_into_account(method: Method, prior: Prior) -> None:
    problem, scale = active_case(9, bodies=3, rows=30)
    nominal, free = problem.nominal.reshape(3, 12).copy(), np.ones((3, 12), dtype=bool)
    nominal[2, :10], free[2, :10], free[1], free[0, 10] = 0.0, False, False, False  # no mass; held; no friction
    problem = replace(problem, nominal=nominal.ravel(), free=free.ravel())
    estimate = Consistent(1e-2, prior, method=method).solve(problem)
    np.testing.assert_array_equal(estimate.phi[~problem.free], problem.nominal[~problem.free])
    assert (estimate.phi[problem.free] != problem.nominal[problem.free]).all()
    assert np.isnan(estimate.eigenvalues).tolist() == [False, False, True]
    only = replace(
        problem, A=problem.A[:, :12], b=problem.b - problem.A[:, 12:] @ problem.nominal[12:], free=problem.free[:12],
        nominal=problem.nominal[:12], scale=problem.scale[:12],
    )  # fmt: skip
    without = replace(problem, free=np.where(np.arange(36) < 12, problem.free, False))
    alone, held = (Consistent(1e-2, prior, method=method).solve(p) for p in (only, without))
    np.testing.assert_allclose(
        alone.phi / only.scale, held.phi[:12] / only.scale, rtol=0.0, atol=1e-5
    )  # sqrt(gap / ridge)


@pytest.mark.parametrize("case", ["nothing free", "no rows"])
@both
def test_without_anything_to_learn_the_parameters_stay_nominal(method: Method, case: str) -> None:
    nominal = random_bodies(np.random.default_rng(10), 1)
    nominal[:, 10:] = 0.2
    problem = nothing_seen(nominal)
    if case == "nothing free":
        problem = replace(problem, free=np.zeros(12, dtype=bool))
    else:
        problem = replace(problem, A=np.zeros((0, 12)), b=np.zeros(0), rows=0)
    estimate = Consistent(1e-3, method=method).solve(problem)
    np.testing.assert_allclose(estimate.phi / problem.scale, problem.nominal / problem.scale, rtol=0.0, atol=1e-6)
    assert estimate.rank == 0


@pytest.mark.parametrize("ridge", [-1.0, np.nan, np.inf])
def test_a_ridge_that_is_no_weight_is_refused(ridge: float) -> None:
    with pytest.raises(ValueError, match="ridge"):
        Consistent(ridge).solve(active_case(0)[0])


@both
def test_a_body_of_which_only_part_is_free_is_refused(method: Method) -> None:
    problem, _ = active_case(0)
    with pytest.raises(ValueError, match="body by body"):
        Consistent(method=method).solve(replace(problem, free=np.arange(24) != 3))


@pytest.mark.parametrize("change", [{"method": "sdp"}, {"prior": "riemannian"}])
def test_an_unknown_method_or_prior_is_refused(change: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="accepted"):
        Consistent(**change).solve(active_case(0)[0])
