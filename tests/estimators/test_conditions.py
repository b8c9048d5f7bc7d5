"""Conditions on bodies: what the checker finds, mirror images, enclosures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physical import (
    GOOD,
    SCALE,
    com,
    least_eigenvalues,
    of_points,
    random_bodies,
    random_case,
    random_points,
    random_reflection,
    turned,
)
from synthetic import Array

from torchid.estimators import Conditions, Enclosure, Mirror, Violation, nearest_consistent, violations
from torchid.estimators.conditions import mirror_matrix
from torchid.problem.linear import parameter_scale

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=50, deadline=None, derandomize=True)


def only(phi: Array, conditions: Conditions, scale: Array = SCALE) -> Violation:
    """The one violation."""
    (found,) = violations(phi, scale, conditions)
    return found


# -------------------------------------------------------------------------------------------------------- the checker


@few
@given(seed=seeds)
def test_bodies_that_exist_break_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nominal = random_bodies(rng, int(rng.integers(1, 5)))
    scale = parameter_scale(nominal)
    conditions = Conditions(0.99 * float(least_eigenvalues(nominal, scale).min()), float(nominal[:, 0].sum()))
    assert violations(nominal, scale, conditions) == []


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_a_centre_of_mass_outside_is_found_in_turned_axes(kind: str) -> None:
    half = np.array([0.1, 0.2, 0.3])
    for local, inside in (((0.95, 0.0, 0.0), True), ((0.0, 0.0, -0.95), True), ((0.9, 0.9, 0.9), kind == "box")):
        place = com(GOOD[0]) - turned @ (half * local)
        conditions = Conditions(enclosures=(Enclosure(0, kind, place, turned, half),))
        found = violations(GOOD, SCALE, conditions)
        assert (found == []) == inside
        for share in (1.0, 1.5):
            place = com(GOOD[0]) - turned @ (half * np.array(local) * share * 2.0)
            found = [only(GOOD, Conditions(enclosures=(Enclosure(0, kind, place, turned, half),)))]
            size = np.max(np.abs(local)) if kind == "box" else np.linalg.norm(local)
            assert found[0].amount == pytest.approx(2.0 * share * size - 1.0)
            assert (found[0].body, found[0].condition) == (0, f"centre of mass outside its {kind}")


def test_a_body_that_is_no_mirror_image_is_found() -> None:
    rng = np.random.default_rng(0)
    mass, place = random_points(rng)
    S = random_reflection(rng)
    phi = np.array([of_points(mass, place), of_points(mass, place @ S.T)])
    scale, conditions = parameter_scale(phi), Conditions(0.0, mirrors=(Mirror(0, 1, S),))
    assert violations(phi, scale, conditions) == []
    phi[1, 5] += 1e-3 * scale[1, 5]
    found = only(phi, conditions, scale)
    assert (found.body, found.condition, found.unit) == (1, "not the mirror image of body 0", "of its scale")
    assert found.amount == pytest.approx(1e-3)


def test_negative_friction_is_found_even_where_a_bound_allows_it() -> None:
    phi = GOOD.copy()
    phi[0, 11] = -0.25
    for lower in (None, np.full((1, 12), -1.0)):
        found = only(phi, Conditions(lower=lower, total_mass=2.0))
        assert (found.body, found.condition, found.unit) == (0, "fv negative", "N m s/rad")
        assert found.amount == pytest.approx(0.25)


@few
@given(seed=seeds, size=st.sampled_from([0.03, 0.3]))
def test_the_checker_agrees_with_brute_force(seed: int, size: float) -> None:
    """Physical is what some masses realize: all four eigenvalues, from the definition of the pseudo-inertia."""
    rng = np.random.default_rng(seed)
    case = random_case(rng)
    nominal, scale, conditions = case.problem.nominal.reshape(case.truth.shape), case.scale, case.conditions
    phi = nominal + size * scale * rng.normal(size=nominal.shape)
    found = violations(phi, scale, conditions)
    flawed = {x.body for x in found if x.condition.startswith(("mass", "inertia", "triangle", "pseudo"))}
    assert flawed == set(np.flatnonzero(least_eigenvalues(phi, scale) < conditions.margin))
    outside = set()
    for enclosure in conditions.enclosures:
        u = np.array([(com(phi[enclosure.body]) - enclosure.centre) @ axis for axis in enclosure.axes.T])
        norm = np.inf if enclosure.kind == "box" else 2
        if np.linalg.norm(u / enclosure.half, norm) > 1.0:
            outside.add(enclosure.body)
    assert {x.body for x in found if x.condition.startswith("centre of mass")} == outside
    lower, upper = (np.asarray(bound) if bound is not None else None for bound in (conditions.lower, conditions.upper))
    beyond = 0
    for (index, number), value in np.ndenumerate(phi):
        too_low = (number >= 10 and value < 0.0) or (lower is not None and value < lower[index, number])
        beyond += too_low or (upper is not None and value > upper[index, number])
    assert sum("beyond" in x.condition or "negative" in x.condition for x in found) == beyond
    assert any("total" in x.condition for x in found) == (conditions.total_mass is not None)


@pytest.mark.parametrize(
    "change",
    [
        {"lower": np.zeros(3)},
        {"upper": np.full((1, 12), np.nan)},
        {"upper": np.full((1, 12), -np.inf)},
        {"lower": np.full((1, 12), np.inf)},
        {"enclosures": (Enclosure(7, "box", np.zeros(3), np.eye(3), np.ones(3)),)},
        {"mirrors": (Mirror(0, 7, -np.eye(3)),)},
    ],
)
def test_conditions_that_fit_no_robot_are_refused_as_values(change: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="accepted"):
        nearest_consistent(GOOD, SCALE, Conditions(**change))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "ball"}, "kind: found 'ball'; accepted: 'box' or 'ellipsoid'"),
        ({"centre": np.zeros(2)}, "centre: found"),
        ({"centre": np.array([0.0, np.nan, 0.0])}, "centre: found"),
        ({"half": np.array([1.0, 0.0, 1.0])}, "half: found"),
        ({"half": np.ones(1)}, "half: found"),
        ({"axes": 2.0 * np.eye(3)}, "axes: found"),
        ({"axes": np.ones((3, 2))}, "axes: found"),
    ],
)
def test_an_enclosure_that_is_none_is_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        Enclosure(**({"body": 0, "kind": "box", "centre": np.zeros(3), "axes": np.eye(3), "half": np.ones(3)} | change))
    assert "accepted" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "reflection", [np.zeros((3, 3)), np.diag([1.0, -1.01, 1.0]), np.eye(2), np.full((3, 3), np.nan)]
)
def test_a_mirror_that_changes_lengths_is_refused(reflection: Array) -> None:
    with pytest.raises(ValueError, match="reflection: found .*; accepted: an orthogonal matrix"):
        Mirror(0, 1, reflection)


@pytest.mark.parametrize(
    ("phi", "scale", "message"),
    [
        (np.where(np.arange(12) == 3, np.nan, GOOD), SCALE, "phi: found a number that is not finite"),
        (GOOD[0], SCALE[0], "phi: found shape"),
        (GOOD[:, :10], SCALE[:, :10], "phi: found shape"),
        (GOOD, np.repeat(SCALE, 2, axis=0), "scale: found shape"),
        (GOOD, 0.0 * SCALE, "scale: found a number that is not positive"),
    ],
)
def test_what_cannot_be_checked_is_refused_and_not_passed(phi: Array, scale: Array, message: str) -> None:
    for check in (violations, nearest_consistent):
        with pytest.raises(ValueError, match=message):
            check(phi, scale, Conditions())


# ------------------------------------------------------------------------------------------------------ mirror images


@few
@given(seed=seeds)
def test_the_mirror_image_is_that_of_its_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass, place = random_points(rng)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    for S in (np.eye(3) - 2.0 * np.outer(normal, normal), random_reflection(rng), np.diag([1.0, -1.0, 1.0])):
        phi = of_points(mass, place) + np.repeat([0.0, 0.3], [10, 2])
        expected = of_points(mass, place @ S.T) + np.repeat([0.0, 0.3], [10, 2])
        np.testing.assert_allclose(mirror_matrix(S) @ phi, expected, rtol=0.0, atol=1e-13 * np.abs(phi).max())
        np.testing.assert_allclose(mirror_matrix(S.T) @ mirror_matrix(S), np.eye(12), rtol=0.0, atol=1e-14)
