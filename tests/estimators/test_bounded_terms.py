"""Armatures, springs and dry friction of each direction: never negative, and otherwise as they fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conic_reference import least_objective
from hypothesis import given, settings
from hypothesis import strategies as st
from physical import PRIORS, as_good_as_none, data, objective, random_bodies, random_case
from scipy.optimize import nnls
from synthetic import Array

from torchid import parameters
from torchid.estimators import Consistent
from torchid.estimators.conditions import term_violations
from torchid.estimators.conic import Prior
from torchid.problem import LinearProblem
from torchid.problem.linear import EliminatedTerms, SignCondition, parameter_scale

SIZE = 0.3


def terms_of(
    rng: np.random.Generator,
    problem: LinearProblem,
    truth: Array,
    psi: Array,
    conditions: tuple[SignCondition, ...] = (),
) -> EliminatedTerms:
    """Rows that `psi` (M,) and true parameters (L, 12) explain but for some noise; by default none is negative."""
    count, columns = len(psi), len(problem.nominal)
    root = np.sqrt(problem.rows)
    C, D = root * rng.normal(size=(count, columns)) / problem.scale, root * rng.normal(size=(count, count)) / SIZE
    z = C @ truth.ravel() + D @ psi + 0.01 * root * rng.normal(size=count)
    zero = np.zeros(columns)
    every = tuple(SignCondition(f"term {k}", row, zero, SIZE, "N m") for k, row in enumerate(np.eye(count)))
    return EliminatedTerms(C, D, z, np.full(count, SIZE), tuple(f"term {k}" for k in range(count)), conditions or every)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), prior=st.sampled_from(PRIORS))
def test_terms_are_those_of_the_reference_and_none_is_negative(seed: int, prior: Prior) -> None:
    rng = np.random.default_rng(seed)
    case = random_case(rng)
    psi = SIZE * rng.normal(size=int(rng.integers(1, 6)))
    problem = replace(case.problem, terms=terms_of(rng, case.problem, case.truth, psi))
    ridge = 10.0 ** rng.uniform(-6.0, -1.0)
    estimate = Consistent(ridge, prior, case.conditions).solve(problem)
    floor = as_good_as_none(ridge, problem)
    least = least_objective(problem, case.conditions, prior, ridge)
    assert estimate.objective <= least + 1e-6 * max(least, floor)
    assert estimate.objective >= least - 1e-4 * max(least, floor)  # of which the reference's inaccuracy is a part
    assert estimate.psi.min() >= 0.0
    assert term_violations(problem, estimate.phi, estimate.psi, 1e-9) == []
    phi = estimate.phi.reshape(case.truth.shape)
    value = objective(prior, ridge, problem, phi) + problem.terms.misfit(estimate.phi, estimate.psi) / problem.rows
    assert estimate.objective == pytest.approx(value, rel=1e-7, abs=1e-7 * floor)
    assert estimate.cost == pytest.approx(problem.cost(estimate.phi, estimate.psi))


def test_terms_of_known_bodies_are_nonnegative_least_squares() -> None:
    rng = np.random.default_rng(3)
    truth = random_bodies(rng, 2)
    known = data(rng, truth, truth, parameter_scale(truth), 30, 3.0, 0.0)
    known = replace(known, free=np.zeros(truth.size, dtype=bool))
    terms = terms_of(rng, known, truth, SIZE * rng.normal(size=8))
    expected, _ = nnls(terms.D, terms.z - terms.C @ truth.ravel())
    assert (expected == 0.0).any()
    estimate = Consistent(1e-3).solve(replace(known, terms=terms))
    np.testing.assert_allclose(estimate.psi, expected, rtol=0.0, atol=1e-5 * SIZE)
    standing = {f"term {k}" for k in np.flatnonzero(expected == 0.0)}
    assert {*estimate.active} == standing == {*terms.at_bounds(estimate.phi, estimate.psi)}


def test_dry_friction_is_negative_in_neither_direction_and_a_joint_without_any_is_left_alone() -> None:
    """Coulomb friction 0.1 N m with half a difference of 0.3 N m would push the joint backwards."""
    rng = np.random.default_rng(7)
    truth = random_bodies(rng, 2)
    truth[:, parameters.FRICTION] = 0.0
    truth[1, parameters.COULOMB] = 0.1
    problem = data(rng, truth, truth, parameter_scale(truth), 60, 3.0, 1e-3)
    conditions = tuple(
        SignCondition(f"joint {body} {way}", sign * np.eye(2)[body], np.eye(24)[12 * body + 10], SIZE, "N m")
        for body in range(2)
        for way, sign in (("forwards", 1.0), ("backwards", -1.0))
    )
    psi = np.array([0.2, 0.3])
    problem = replace(problem, terms=terms_of(rng, problem, truth, psi, conditions))
    free = problem.free.copy()
    free[parameters.COULOMB] = False  # of the first joint: no friction at all is known of it
    estimate = Consistent(1e-6).solve(replace(problem, free=free))
    fc = estimate.phi.reshape(2, 12)[1, parameters.COULOMB]
    assert abs(estimate.psi[1]) <= fc + 1e-9
    assert estimate.active.count("joint 1 backwards") == 1
    assert estimate.psi[0] > 0.1, "its condition would leave it none"
    (broken,) = term_violations(problem, truth.ravel(), np.array([0.0, 0.3]))
    assert (broken.term, broken.condition, broken.amount) == ("joint 1 backwards", "negative", pytest.approx(0.2))


def test_terms_that_no_row_depends_on_are_none_with_and_without_a_ridge() -> None:
    rng = np.random.default_rng(9)
    nominal = random_bodies(rng, 1)
    problem = data(rng, nominal, nominal, parameter_scale(nominal), 40, 3.0, 1e-3)
    terms = terms_of(rng, problem, nominal, np.array([SIZE, SIZE, SIZE]))
    D = terms.D.copy()
    D[:, 1] = 0.0
    U, _, _ = np.linalg.svd(D, full_matrices=False)
    seen = replace(terms, C=U[:, :2].T @ terms.C, D=U[:, :2].T @ D, z=U[:, :2].T @ terms.z)
    for ridge in (0.0, 1e-3):
        estimate = Consistent(ridge).solve(replace(problem, terms=seen))
        assert 0.0 <= estimate.psi[1] < 1e-2 * SIZE
