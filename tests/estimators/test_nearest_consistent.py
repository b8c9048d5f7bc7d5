"""The nearest parameters that meet conditions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conic_reference import least_objective
from hypothesis import given, settings
from hypothesis import strategies as st
from physical import (
    GOOD,
    PRIORS,
    SCALE,
    Case,
    body,
    prior_value,
    random_bodies,
    random_case,
    random_parameters_within,
)
from synthetic import Array

from torchid.errors import InputError
from torchid.estimators import Conditions, Mirror, nearest_consistent, violations
from torchid.estimators.conic import Prior
from torchid.estimators.consistent import _changeable
from torchid.problem import LinearProblem

seeds = st.integers(0, 2**32 - 1)


def drawn(rng: np.random.Generator, prior: Prior) -> tuple[Case, Array | None]:
    """Parameters to project, with the conditions, and the bodies whose pseudo-inertias measure deviations."""
    case = random_case(rng)
    nominal = case.problem.nominal.reshape(case.truth.shape)
    if prior == "entropic":  # from bodies that exist
        return replace(case, truth=random_bodies(rng, len(nominal))), None
    return case, nominal if prior == "pullback" else None


def least_distance(phi: Array, scale: Array, conditions: Conditions, prior: Prior, reference: Array | None) -> float:
    """By the reference, of parameters that may change."""
    free = _changeable(phi, conditions).ravel()
    problem = LinearProblem(np.zeros((0, phi.size)), np.zeros(0), 0.0, 1, phi.ravel(), scale.ravel(), free)
    return least_objective(problem, conditions, prior, 1.0, reference)


@pytest.mark.parametrize("prior", PRIORS)
@settings(max_examples=10, deadline=None, derandomize=True)
@given(seed=seeds)
def test_a_projection_is_the_nearest_parameters_that_meet_the_conditions(prior: Prior, seed: int) -> None:
    rng = np.random.default_rng(seed)
    case, reference = drawn(rng, prior)
    phi, scale, conditions = case.truth, case.scale, case.conditions

    def distance(other: Array) -> float:
        return prior_value(prior, other, phi, scale, reference)

    near = nearest_consistent(phi, scale, conditions, prior=prior, nominal=reference)
    assert violations(near, scale, conditions) == []
    nearest = distance(near)
    assert nearest == pytest.approx(least_distance(phi, scale, conditions, prior, reference), rel=1e-6, abs=1e-9)
    nominal = case.problem.nominal.reshape(phi.shape)
    if not violations(nominal, scale, conditions):
        for share in (1e-4, 1e-2, 1.0):
            assert distance((1.0 - share) * near + share * nominal) >= nearest * (1.0 - 1e-8)
    if not (conditions.enclosures or conditions.mirrors or conditions.total_mass or conditions.lower is not None):
        for size in np.repeat([1e-4, 1e-2, 1e-1], 20):
            other = random_parameters_within(rng, near, scale, conditions, size)
            assert other is None or distance(other) >= nearest * (1.0 - 1e-8)


@pytest.mark.parametrize("prior", PRIORS)
def test_parameters_that_meet_the_conditions_are_their_own_projection(prior: Prior) -> None:
    before = GOOD.copy()
    found = nearest_consistent(GOOD, SCALE, Conditions(1e-4), prior=prior)
    np.testing.assert_allclose(found / SCALE, GOOD / SCALE, rtol=0.0, atol=1e-6)  # sqrt(gap)
    np.testing.assert_array_equal(GOOD, before)


def test_friction_of_zero_moves_only_to_a_mirror_image_or_a_bound() -> None:
    phi = np.repeat(GOOD, 3, axis=0)
    phi[:, :10] = body(2.0, np.zeros(3), [0.3, 0.4, 0.5])[:, :10]
    phi[:, 10], phi[:, 11] = (0.0, 0.3, 0.0), (0.0, 0.0, 0.0)
    lower = np.full(phi.shape, -np.inf)
    lower[2, 11] = 0.2
    mirror = Mirror(0, 1, np.eye(3))
    found = nearest_consistent(phi, np.repeat(SCALE, 3, axis=0), Conditions(mirrors=(mirror,), lower=lower))
    np.testing.assert_allclose(found[:, 10], [0.15, 0.15, 0.0], rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(found[:, 11], [0.0, 0.0, 0.2], rtol=0.0, atol=1e-7)
    assert found[2, 10] == 0.0


def test_distances_that_are_not_defined_are_refused() -> None:
    broken = body(2.0, np.zeros(3), [0.1, 0.2, 0.4])
    for arguments in ({"prior": "entropic"}, {"prior": "pullback"}, {"prior": "pullback", "nominal": broken}):
        with pytest.raises(InputError, match=f"{arguments['prior']}, but the nominal pseudo-inertia of body 0 "):
            nearest_consistent(broken, SCALE, Conditions(), **arguments)
    assert (
        violations(nearest_consistent(broken, SCALE, Conditions(), prior="pullback", nominal=GOOD), SCALE, Conditions())
        == []
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"prior": "riemannian"}, "prior: found 'riemannian'; accepted: 'euclidean', 'pullback' or 'entropic'"),
        ({"nominal": GOOD}, "nominal: set, but the prior is 'euclidean'"),
        ({"prior": "pullback", "nominal": GOOD[:, :10]}, "nominal: found shape"),
    ],
)
def test_arguments_of_a_projection_that_make_no_sense_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        nearest_consistent(GOOD, SCALE, Conditions(), **arguments)
