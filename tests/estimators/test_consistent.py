"""Consistent estimates: a conic solver agrees, nothing allowed is better, priors are what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conic_reference import least_objective
from hypothesis import example, given, settings
from hypothesis import strategies as st
from physical import (
    PRIORS,
    active_case,
    as_good_as_none,
    data,
    least_eigenvalues,
    objective,
    pseudo,
    random_bodies,
    random_case,
)
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from synthetic import Array, transform

from torchid import parameters
from torchid.errors import InputError
from torchid.estimators import Conditions, Consistent, violations
from torchid.estimators.conic import Prior
from torchid.problem.linear import parameter_scale

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=10, deadline=None, derandomize=True)
all_priors = pytest.mark.parametrize("prior", PRIORS)


# ----------------------------------------------------------------------------------------------------- the reference


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=seeds, prior=st.sampled_from(PRIORS))
@example(seed=3628799, prior="euclidean")  # one row that the nominal parameters happen to explain: an optimum of 1e-15
@example(seed=3628799, prior="entropic")
def test_it_is_the_optimum_of_the_reference_and_meets_every_condition(seed: int, prior: Prior) -> None:
    rng = np.random.default_rng(seed)
    case = random_case(rng)
    ridge = 10.0 ** rng.uniform(-6.0, -1.0)
    estimate = Consistent(ridge, prior, case.conditions).solve(case.problem)
    floor = as_good_as_none(ridge, case.problem)
    optimum = least_objective(case.problem, case.conditions, prior, ridge)
    assert estimate.objective <= optimum + 1e-6 * max(optimum, floor)
    assert estimate.objective >= optimum - 1e-4 * max(optimum, floor)  # of which the reference's inaccuracy is a part
    phi = estimate.phi.reshape(case.truth.shape)
    assert violations(phi, case.scale, case.conditions, 1e-9) == []
    off = [violation.condition for violation in violations(phi, case.scale, case.conditions)]
    assert not [condition for condition in off if "mirror" in condition or "total" in condition]
    least = least_eigenvalues(phi, case.scale)
    assert (least >= case.conditions.margin - 1e-12).all()
    np.testing.assert_allclose(estimate.eigenvalues, least, rtol=0.0, atol=1e-12)
    value = objective(prior, ridge, case.problem, phi)
    assert estimate.objective == pytest.approx(value, rel=1e-7, abs=1e-7 * floor)
    assert (estimate.unconstrained is None) == (prior == "entropic")
    assert estimate.unconstrained is None or estimate.objective >= estimate.unconstrained * (1.0 - 1e-7)
    assert 0.0 <= estimate.gap <= 1e-9 * max(estimate.objective, floor)


# --------------------------------------------------------------------------------------------------------- optimality


@all_priors
@pytest.mark.parametrize("seed", [0, 3])
def test_a_general_optimizer_finds_nothing_better(seed: int, prior: Prior) -> None:
    """SLSQP over Cholesky factors of the scaled pseudo-inertias less the margin, from the nominal and from the best."""
    problem, scale = active_case(seed, bodies=1, rows=9)
    margin, ridge = 0.05, 1e-3
    estimate = Consistent(ridge, prior, Conditions(margin)).solve(problem)
    assert estimate.eigenvalues.min() < 1.01 * margin  # the condition is active
    rows, columns = np.tril_indices(4)

    def phi_of(z: Array) -> Array:
        L = np.zeros((4, 4))
        L[rows, columns] = z[:10]
        J = L @ L.T + margin * np.eye(4)
        second = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
        ten = [J[3, 3], *J[:3, 3], *(second[i, j] for i, j in parameters.INERTIA_AXES)]
        return np.append(ten, z[10:] ** 2)[None] * scale

    def z_of(phi: Array) -> Array:
        J = pseudo((phi / scale)[0]) - margin * np.eye(4)
        values, vectors = np.linalg.eigh(J)
        R = np.linalg.qr((vectors * np.sqrt(np.maximum(values, 1e-10))).T, mode="r")
        return np.append(R.T[rows, columns], np.sqrt(np.maximum(phi[0, 10:], 0.0)))

    assert phi_of(z_of(estimate.phi[None])) == pytest.approx(estimate.phi[None], abs=1e-6)
    for start in (
        parameters.perturb_parameters(problem.nominal[None], 0.1, np.random.default_rng(0)),
        estimate.phi[None],
    ):
        found = minimize(
            lambda z: objective(prior, ridge, problem, phi_of(z)) / estimate.objective,
            z_of(start) + 1e-3,
            method="SLSQP",
            options={"maxiter": 300, "ftol": 1e-13},
        )
        assert found.fun >= 1.0 - 1e-9 - estimate.gap / estimate.objective
        assert found.fun < 1.02  # it does arrive: the comparison means something


@pytest.mark.parametrize("ridge", [0.0, 1e-10])
@pytest.mark.parametrize("rows", [10, 40])
def test_noise_free_data_of_a_real_robot_are_explained(rows: int, ridge: float) -> None:
    rng = np.random.default_rng(6)
    nominal = random_bodies(rng, 2)
    truth = parameters.perturb_parameters(nominal, 0.2, rng)
    truth[:, 10:] += 0.1
    problem = data(rng, nominal, truth, parameter_scale(nominal), rows, 10.0, 0.0)
    estimate = Consistent(ridge, conditions=Conditions(1e-4)).solve(problem)
    np.testing.assert_allclose(problem.A @ estimate.phi, problem.b, rtol=0.0, atol=1e-6 * np.abs(problem.b).max())
    assert np.isfinite(estimate.phi).all()
    if rows > truth.size:
        off = (estimate.phi - truth.ravel()) / problem.scale
        assert np.abs(off).max() < 1e-5  # condition 10


# ------------------------------------------------------------------------------------------------------------- priors


@pytest.mark.parametrize("prior", ["pullback", "entropic"])
@few
@given(seed=seeds)
def test_frames_and_units_do_not_matter_to_the_priors_of_matter(prior: Prior, seed: int) -> None:
    """Without a margin, which knows the link's origin. Solutions are good to sqrt(gap)."""
    rng = np.random.default_rng(seed)
    problem, _ = active_case(seed, bodies=1)
    T = transform(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))
    T[:3] *= 10.0 ** rng.uniform(-1.0, 1.0)  # another unit of length
    X = np.eye(12)
    X[:10, :10] = parameters.change_of_frame(T)
    nominal = (X @ problem.nominal)[None]
    scale = parameter_scale(nominal).ravel()
    moved = replace(problem, A=problem.A @ np.linalg.inv(X), nominal=nominal[0], scale=scale)
    one, other = (Consistent(1e-2, prior, Conditions(0.0)).solve(p) for p in (problem, moved))
    assert other.objective == pytest.approx(one.objective, rel=1e-7)
    back = np.linalg.solve(X, other.phi)
    np.testing.assert_allclose(back / problem.scale, one.phi / problem.scale, rtol=0.0, atol=2e-3)


@pytest.mark.parametrize("prior", ["pullback", "entropic"])
def test_a_prior_of_matter_refuses_nominal_bodies_that_do_not_exist(prior: Prior) -> None:
    problem, _ = active_case(0, bodies=1)
    for worst in (-0.1, 0.0):  # broken triangle inequality; a plate
        inertia = np.diag([1.0, 1.0, 2.0 - worst])
        nominal = np.append(parameters.inertial_vector(1.0, np.zeros(3), inertia), [0.0, 0.0])
        with pytest.raises(InputError, match="body 0"):
            Consistent(1e-2, prior).solve(replace(problem, nominal=nominal))


@all_priors
def test_what_the_conditions_cost_is_stated(prior: Prior) -> None:
    """Against the least objective without conditions, found by a general optimizer."""
    problem, scale = active_case(1, bodies=1, rows=9)
    nominal = problem.nominal.reshape(scale.shape)
    estimate = Consistent(1e-2, prior).solve(problem)
    if prior == "entropic":  # whose domain is a condition
        assert estimate.unconstrained is None
        assert estimate.increase is None
        return
    found = minimize(
        lambda x: objective(prior, 1e-2, problem, nominal + scale * x), np.zeros(12), options={"gtol": 1e-9}
    )
    assert estimate.unconstrained == pytest.approx(found.fun, rel=1e-7)
    assert estimate.increase == pytest.approx(estimate.objective - found.fun, rel=1e-5)
    assert estimate.increase > 0.01 * estimate.objective  # something is active
