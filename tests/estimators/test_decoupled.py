"""Parameters that no row and no condition couples to others stay at the nominal values to the last bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from physical import PRIORS, data, random_bodies, random_reflection
from synthetic import Array

from torchid.estimators import Conditions, Consistent, Mirror
from torchid.estimators.conic import Prior
from torchid.parameters import MASS, PER_BODY
from torchid.problem import LinearProblem
from torchid.problem.linear import EliminatedTerms, SignCondition, parameter_scale

BASE, FAR = 0, 2  # bodies
COULOMB = 10  # number of a friction parameter


def bolted(seed: int = 0) -> tuple[LinearProblem, np.ndarray]:
    """Three bodies of which one, and the dry friction of another, are in no row; which parameters these are."""
    rng = np.random.default_rng(seed)
    nominal, truth = random_bodies(rng, 3), random_bodies(rng, 3)
    nominal[FAR, COULOMB] = 0.0
    problem = data(rng, nominal, truth, parameter_scale(nominal), 60, 100.0, 0.1)
    unseen = np.zeros(nominal.shape, dtype=bool)
    unseen[BASE], unseen[FAR, COULOMB] = True, True
    return replace(problem, A=np.where(unseen.ravel(), 0.0, problem.A)), unseen.ravel()


def deviation(problem: LinearProblem, phi: Array) -> Array:
    """From nominal, in units of the scale, (L, 12)."""
    return np.asarray((phi - problem.nominal) / problem.scale).reshape(-1, PER_BODY)


@pytest.mark.parametrize("ridge", [0.0, 1e-7, 1e-2])
@pytest.mark.parametrize("prior", PRIORS)
def test_a_body_that_no_row_sees_stays_nominal_and_changes_nothing(prior: Prior, ridge: float) -> None:
    problem, unseen = bolted()
    estimator = Consistent(ridge, prior)
    found, without = estimator.solve(problem), estimator.solve(replace(problem, free=~unseen))
    assert np.array_equal(found.phi[unseen], problem.nominal[unseen])
    assert np.array_equal(found.phi, without.phi)
    assert found.objective == without.objective
    assert np.abs(deviation(problem, found.phi)[1]).max() > 0.01, "others move"
    assert not found.observable[unseen].any()
    assert (found.verdict[unseen] == "unobservable").all()


def test_a_total_mass_or_mirror_image_couples_what_no_row_sees() -> None:
    problem, _ = bolted()
    heavier = 1.3 * problem.nominal.reshape(-1, PER_BODY)[:, MASS].sum()
    mass = Consistent(1e-3, conditions=Conditions(total_mass=heavier)).solve(problem)
    assert mass.phi.reshape(-1, PER_BODY)[:, MASS].sum() == pytest.approx(heavier, rel=1e-6)
    assert abs(deviation(problem, mass.phi)[BASE, MASS]) > 0.01
    assert deviation(problem, mass.phi)[FAR, COULOMB] == 0.0
    mirror = Conditions(mirrors=(Mirror(BASE, 1, random_reflection(np.random.default_rng(4))),))
    image = Consistent(1e-3, conditions=mirror).solve(problem)
    assert image.phi.reshape(-1, PER_BODY)[BASE, MASS] == pytest.approx(image.phi[PER_BODY + MASS], rel=1e-6)
    assert abs(deviation(problem, image.phi)[BASE, MASS]) > 0.01


def test_a_bounded_term_couples_the_friction_it_is_added_to() -> None:
    """As friction of both directions: their mean must not be below half of their difference."""
    problem, unseen = bolted()
    one = np.zeros(len(problem.nominal))
    one[FAR * PER_BODY + COULOMB] = 1.0
    terms = EliminatedTerms(
        C=np.zeros((1, len(one))),
        D=np.array([[100.0]]),
        z=np.array([30.0]),
        size=np.array([0.3]),
        labels=("difference",),
        conditions=(SignCondition("backward", np.array([-1.0]), one, 0.3, "N m"),),
    )
    found = Consistent(1e-3).solve(replace(problem, terms=terms))
    assert found.phi[one > 0.0][0] > 0.1
    assert np.array_equal(found.phi[unseen & (one == 0.0)], problem.nominal[unseen & (one == 0.0)])
