"""Samples of a posterior: inside every condition, as wide as the data and the prior say, as long chains find them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from physical import GOOD, SCALE, active_case, nothing_seen, random_case
from synthetic import Array
from thinned import study_but

from torchid.estimators import Conditions, LeastSquares, violations
from torchid.estimators.posterior import Posterior, whitened_rows
from torchid.estimators.truncated_gaussian import TruncatedGaussian, barrier_gaussian
from torchid.problem import LinearProblem

NONE = np.zeros(0)


def posterior_of(problem: LinearProblem, conditions: Conditions, noise: float = 1.0) -> Posterior:
    A, b = whitened_rows(problem, noise, None)
    same = (problem.nominal, problem.scale, problem.free, conditions)
    return Posterior(A, np.zeros((len(A), 0)), b, *same, NONE, NONE)


def drawn(posterior: Posterior, count: int, prior_error: float = 0.2, seed: int = 0) -> tuple[Array, TruncatedGaussian]:
    """Samples of the parameters in units of their scale, (count, free), less the nominal ones."""
    conic = posterior.conic_problem(prior_error)
    sampler = TruncatedGaussian(conic, posterior.owners())
    x = sampler.draw(count, torch.Generator().manual_seed(seed)).numpy()
    return x @ conic.deviations.T, sampler


def parameters_of(posterior: Posterior, deviations: Array) -> Array:
    """(count, L, 12)."""
    phi = np.tile(posterior.nominal, (len(deviations), 1))
    phi[:, posterior.free] += posterior.scale[posterior.free] * deviations[:, : posterior.free.sum()]
    return phi.reshape(len(phi), -1, 12)


@pytest.mark.parametrize("seed", study_but(range(4), range(25)))
def test_every_sample_meets_every_condition(seed: int) -> None:
    case = random_case(np.random.default_rng(seed))
    posterior = posterior_of(case.problem, case.conditions, noise=0.05)
    deviations, _ = drawn(posterior, 200, prior_error=0.5)
    for phi in parameters_of(posterior, deviations):
        assert not violations(phi, case.scale, case.conditions, tolerance=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_exact_data_of_bodies_that_do_not_exist_have_a_gaussian_inside_the_conditions(seed: int) -> None:
    """Noise of 1e-6: at the edge eigenvalues are positive by rounding where a Cholesky factor fails.

    Data that are sharper by a factor leave samples narrower by it, which lie along the edge.
    """
    conic = posterior_of(active_case(seed)[0], Conditions(), noise=1e-6).conic_problem(0.2)
    at_edge = conic.F0 + np.einsum("kv,kvij->kij", barrier_gaussian(conic).mean[conic.variables], conic.F)
    assert np.isfinite(np.linalg.cholesky(at_edge)).all()
    blunt, sharp = (
        drawn(posterior_of(active_case(seed)[0], Conditions(), noise), 1000)[0].std(axis=0) for noise in (1e-4, 1e-6)
    )
    np.testing.assert_allclose(np.median(blunt / sharp), 100.0, rtol=0.15)


def test_without_conditions_nearby_samples_are_those_of_the_gaussian() -> None:
    problem = replace(nothing_seen(GOOD), A=3.0 * np.eye(12) / SCALE, b=3.0 * GOOD[0] / SCALE[0])
    posterior = posterior_of(problem, Conditions(lower=np.full((1, 12), -100.0), upper=np.full((1, 12), 100.0)), 0.02)
    deviations, sampler = drawn(posterior, 20_000)
    assert not sampler.near
    conic = posterior.conic_problem()
    covariance = np.linalg.inv(conic.root.T @ conic.root)
    expected = conic.deviations @ covariance @ conic.deviations.T
    deviation = np.sqrt(np.diag(expected))
    unit = np.outer(deviation, deviation)
    np.testing.assert_allclose(np.cov(deviations.T) / unit, expected / unit, atol=0.04)


@pytest.mark.parametrize("distance", [-1.0, 0.0, 3.0, 9.0, 29.0, 31.0, 1000.0])
def test_friction_that_data_want_negative_is_a_truncated_normal(distance: float) -> None:
    """Of a mean so many standard deviations below 0."""
    problem = replace(nothing_seen(GOOD), A=np.eye(12)[10:11] * 100.0, b=np.array([-distance]))
    posterior = posterior_of(problem, Conditions())
    deviations, _ = drawn(posterior, 20_000)
    friction = parameters_of(posterior, deviations)[:, 0, 10]
    t = np.linspace(0.0, 0.12 / max(distance, 1.0), 100_001)
    density = np.exp(-0.5 * (100.0 * t + distance) ** 2 + 0.5 * distance**2 - 0.5 * ((t - GOOD[0, 10]) / 0.2) ** 2)
    mean = float(t @ density / density.sum())
    deviation = np.sqrt(float((t - mean) ** 2 @ density / density.sum()))
    assert friction.min() > 0.0
    np.testing.assert_allclose(friction.mean(), mean, rtol=0.03)
    np.testing.assert_allclose(friction.std(), deviation, rtol=0.03)


def test_the_barrier_has_the_mean_of_an_exponential_tail() -> None:
    problem = replace(nothing_seen(GOOD), A=np.eye(12)[10:11] * 1e4, b=np.array([-1e4]))
    conic = posterior_of(problem, Conditions()).conic_problem(100.0)
    found = barrier_gaussian(conic)
    friction = int(np.flatnonzero(conic.deviations[10])[0])
    rate = 1e4 * 1e4  # of exp(-|A fc - b|^2 / 2) at fc = 0
    np.testing.assert_allclose(found.mean[friction] + GOOD[0, 10], 1.0 / rate, rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(found.covariance[friction, friction]), 2.0 / rate, rtol=1e-3)


def test_the_seed_decides_every_bit_whatever_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = active_case(3)
    posterior = posterior_of(problem, Conditions())
    _, sampler = drawn(posterior, 1)
    one, other = (sampler.draw(1200, torch.Generator().manual_seed(5)) for _ in range(2))
    monkeypatch.setattr("torchid.estimators.truncated_gaussian.worker_count", lambda device: 1)
    assert torch.equal(one, other)
    assert torch.equal(one, sampler.draw(1200, torch.Generator().manual_seed(5)))
    assert not torch.equal(one, sampler.draw(1200, torch.Generator().manual_seed(6)))


def test_likelihood_of_a_full_problem_has_the_covariance_of_the_standard_errors() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(40, 12)) / SCALE
    problem = replace(nothing_seen(GOOD), A=A, b=A @ GOOD[0] + 0.3 * rng.normal(size=40), rows=40, oversampling=4.0)
    estimate = LeastSquares().solve(problem)
    noise = 2.0 * estimate.residual_std
    rows, right = whitened_rows(problem, noise, None)
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))), estimate.noise_error, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.lstsq(rows, right)[0], estimate.phi, rtol=1e-8)


def test_no_reported_combination_is_sharper_than_its_standard_error_between_blocks() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(40, 12)) / SCALE
    problem = replace(nothing_seen(GOOD), A=A, b=A @ GOOD[0] + rng.normal(size=40), rows=40)
    deviations = 0.3 * SCALE * rng.normal(size=(1, 12)) + 0.03 * SCALE * rng.normal(size=(8, 12))
    reported = np.vstack([np.eye(12), rng.normal(size=(3, 12)) / SCALE])
    by_blocks = np.linalg.norm(deviations @ reported.T, axis=0)

    def spread(*combinations: Array) -> Array:
        rows, _ = whitened_rows(problem, 1.0, deviations, *combinations)
        return np.sqrt(np.einsum("ki,ij,kj->k", reported, np.linalg.inv(rows.T @ rows), reported))

    alone, together = spread(), spread(reported)
    assert (alone < 0.8 * by_blocks).any(), "scatter along one direction is spread over many singular vectors"
    assert (together > by_blocks * (1.0 - 1e-9)).all()
    assert (together > alone * (1.0 - 1e-9)).all()
    rows, right = whitened_rows(problem, 1.0, deviations, reported)
    np.testing.assert_allclose(np.linalg.lstsq(rows, right)[0], np.linalg.lstsq(A, problem.b)[0], rtol=1e-8)


def test_an_extra_parameter_confounded_with_a_body_shares_its_spread() -> None:
    """Armature + fv known to 0.001: what one has more the other has less, and neither is negative."""
    row = np.zeros((1, 12))
    row[0, 11] = 1000.0
    same = nothing_seen(GOOD)
    posterior = Posterior(
        row, np.array([[1000.0]]), np.array([200.0]), same.nominal, same.scale, same.free, Conditions(),
        np.array([0.1]), np.array([0.0]),
    )  # fmt: skip
    conic = posterior.conic_problem()
    sampler = TruncatedGaussian(conic, posterior.owners())
    x = sampler.draw(10_000, torch.Generator().manual_seed(0)).numpy()
    armature, viscous = 0.1 * x[:, -1], parameters_of(posterior, x @ conic.deviations.T)[:, 0, 11]
    assert armature.min() > 0.0
    assert viscous.min() > 0.0
    np.testing.assert_allclose((armature + viscous).std(), 0.001, rtol=0.05)
    assert np.corrcoef(armature, viscous)[0, 1] < -0.99


def test_what_no_condition_is_near_follows_what_a_bound_cuts_off() -> None:
    """A mass and a friction of which the sum is known to 0.002, the friction truncated at 0: no chain has the mass."""
    rows = np.zeros((2, 12))
    rows[0, 10], rows[1, 10], rows[1, 0] = 20.0, 500.0, 500.0
    problem = replace(nothing_seen(GOOD), A=rows, b=np.array([-1.0, 500.0 * (GOOD[0, 0] + 0.05)]))
    posterior = posterior_of(problem, Conditions())
    deviations, sampler = drawn(posterior, 40_000)
    phi = parameters_of(posterior, deviations)[:, 0]
    assert sampler.near == len(sampler.near_variables) == 2, "Coulomb and viscous friction"
    mass, friction = phi[:, 0], phi[:, 10]
    t = np.linspace(0.0, 0.4, 100_001)
    of_sum = (t - 0.05) ** 2 / (0.002**2 + (0.2 * GOOD[0, 0]) ** 2)  # the mass integrated out
    density = np.exp(-0.5 * (20.0 * t + 1.0) ** 2 - 0.5 * ((t - GOOD[0, 10]) / 0.2) ** 2 - 0.5 * of_sum)
    mean = float(t @ density / density.sum())
    np.testing.assert_allclose(friction.mean(), mean, rtol=0.03)
    np.testing.assert_allclose((mass + friction).mean(), GOOD[0, 0] + 0.05, atol=1e-4)
    np.testing.assert_allclose((mass + friction).std(), 0.002, rtol=0.03)


def test_what_the_data_do_not_see_is_as_wide_as_the_prior() -> None:
    posterior = posterior_of(nothing_seen(GOOD), Conditions())
    deviations, _ = drawn(posterior, 20_000, prior_error=0.1)
    phi = parameters_of(posterior, deviations)[:, 0]
    np.testing.assert_allclose(phi[:, 0].std(), 0.1 * GOOD[0, 0], rtol=0.03)
    np.testing.assert_allclose(phi[:, :10].mean(axis=0), GOOD[0, :10], atol=0.02 * SCALE[0, 0])


def test_blocks_that_disagree_widen_the_posterior_along_what_they_disagree_on() -> None:
    problem = replace(nothing_seen(GOOD), A=np.eye(12) * np.arange(1, 13) / SCALE, b=np.zeros(12), rows=12)
    deviations = np.zeros((3, 12))
    deviations[:, 0] = 5.0 * SCALE[0, 0] / np.sqrt(3.0)  # five times what noise of 1 leaves
    rows, _ = whitened_rows(problem, 1.0, deviations)
    covariance = np.linalg.inv(rows.T @ rows)
    expected = SCALE[0] / np.arange(1, 13)
    expected[0] *= 5.0
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), expected, rtol=1e-9)
