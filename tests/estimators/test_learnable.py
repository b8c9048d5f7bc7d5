"""Parameters that a descent moves: they start at the URDF, stay possible, and count in units of equal curvature."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from physical import data, least_eigenvalues, nothing_seen, of_points, pseudo, random_bodies
from synthetic import Array

from torchid.estimators import LogCholeskyParameters
from torchid.problem import LinearProblem
from torchid.problem.linear import parameter_scale

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=10, deadline=None, derandomize=True)
MARGIN = 1e-4


def well_inside(rng: np.random.Generator, count: int) -> Array:
    """Bodies (L, 12) whose scaled pseudo-inertias are above the margin by more than the start asks for."""
    drawn = random_bodies(rng, 4 * count)
    chosen = drawn[least_eigenvalues(drawn, parameter_scale(drawn)) > MARGIN + 2e-3][:count]
    scale = parameter_scale(chosen)
    assert len(chosen) == count
    assert least_eigenvalues(chosen, scale).min() > MARGIN + 1e-3
    return chosen


def some_free(rng: np.random.Generator) -> LinearProblem:
    """Bodies of which one has no free friction, one is frozen, one has only its viscous free, one all of both."""
    free = np.ones((4, 12), dtype=bool)
    free[0, 10:], free[1], free[2, 10] = False, False, False
    return nothing_seen(well_inside(rng, 4), free.ravel())


def random_raw(rng: np.random.Generator, learnable: LogCholeskyParameters, size: float) -> torch.Tensor:
    return torch.from_numpy(size * rng.normal(size=len(learnable.raw)))


def value(phi: torch.Tensor) -> Array:
    return np.array(phi.detach().numpy())


def assert_possible(phi: Array, problem: LinearProblem, margin: float) -> None:
    """Free bodies above the margin and friction above zero, but for what rounding takes of the largest eigenvalue."""
    scaled, free = (phi / problem.scale).reshape(-1, 12), problem.free.reshape(-1, 12)
    for body in np.flatnonzero(free[:, 0]):
        eigenvalues = np.linalg.eigvalsh(pseudo(scaled[body]))
        assert eigenvalues[0] >= margin - 1e-14 * eigenvalues[-1]
    assert (scaled[:, 10:][free[:, 10:]] > 0.0).all()


# -------------------------------------------------------------------------------------------------------------- start


@few
@given(seed=seeds)
def test_possible_bodies_start_at_the_urdfs_parameters(seed: int) -> None:
    problem = some_free(np.random.default_rng(seed))
    difference = (value(LogCholeskyParameters(problem, MARGIN)()) - problem.nominal) / problem.scale
    moved = problem.free & (problem.nominal == 0.0) & (np.arange(problem.nominal.size) % 12 >= 10)
    np.testing.assert_allclose(difference[~moved], 0.0, rtol=0.0, atol=1e-14)


def test_bodies_that_cannot_exist_start_inside_and_the_others_where_they_were() -> None:
    rng = np.random.default_rng(2)
    nominal = random_bodies(rng, 3)
    plate = rng.normal(size=(4, 3)) * [0.2, 0.2, 0.0]
    nominal[1, :10] = of_points(np.ones(4), plate)[:10]  # flat: eigenvalue 0
    nominal[2, 4] += 0.5 * nominal[2, [4, 7, 9]].sum()  # breaks the triangle inequality of principal inertias
    problem = nothing_seen(nominal)
    scale = problem.scale.reshape(3, 12)
    assert least_eigenvalues(nominal, scale)[1] == pytest.approx(0.0, abs=1e-12)
    assert least_eigenvalues(nominal, scale)[2] < -0.01
    phi = value(LogCholeskyParameters(problem, 0.02)()).reshape(3, 12)
    np.testing.assert_allclose(least_eigenvalues(phi, scale)[1:], 0.021, rtol=1e-10)
    np.testing.assert_allclose((phi / scale)[0, :10], (nominal / scale)[0, :10], rtol=0.0, atol=1e-14)
    for body in (1, 2):  # the eigenvalues that were inside have stayed
        before, after = (np.linalg.eigvalsh(pseudo((x / scale)[body])) for x in (nominal, phi))
        np.testing.assert_allclose(after, np.maximum(before, 0.021), rtol=1e-10)


# ------------------------------------------------------------------------------------------------------------- always


@few
@given(seed=seeds, size=st.sampled_from([0.1, 1.0, 5.0]), margin=st.sampled_from([0.0, 1e-4, 0.1]))
def test_whatever_the_raw_numbers_bodies_are_above_the_margin_and_friction_is_positive(
    seed: int, size: float, margin: float
) -> None:
    rng = np.random.default_rng(seed)
    problem = some_free(rng)
    learnable = LogCholeskyParameters(problem, margin)
    with torch.no_grad():
        learnable.raw.copy_(random_raw(rng, learnable, size))
    assert_possible(value(learnable()), problem, margin)


@few
@given(seed=seeds)
def test_every_body_above_the_margin_can_be_reached(seed: int) -> None:
    """The raw numbers of a body follow from its Cholesky factor: J = margin I + R_0 M (R_0 M)^T."""
    rng = np.random.default_rng(seed)
    problem = nothing_seen(well_inside(rng, 3))
    learnable = LogCholeskyParameters(problem, MARGIN)
    scale = problem.scale.reshape(3, 12)
    other = well_inside(rng, 3)
    assert least_eigenvalues(other, scale).min() > MARGIN
    other[:, 10:] = rng.uniform(0.01, 3.0, (3, 2)) * scale[:, 10:]
    coordinates = []
    for start, body in zip(problem.nominal.reshape(3, 12) / scale, other / scale, strict=True):
        R_0, R = (np.linalg.cholesky(pseudo(x) - MARGIN * np.eye(4)) for x in (start, body))
        M = np.linalg.solve(R_0, R)
        M[np.diag_indices(4)] = np.log(M[np.diag_indices(4)])
        coordinates += [M[np.tril_indices(4)]]
    friction = np.log(np.expm1((other / scale)[:, 10:])).ravel()
    start = np.log(np.expm1(np.maximum(problem.nominal.reshape(3, 12)[:, 10:], 0.01))).ravel()
    u = torch.from_numpy(np.concatenate([*coordinates, friction - start]))
    found = value(learnable.constrained(u)).reshape(3, 12)
    np.testing.assert_allclose(found / scale, other / scale, rtol=0.0, atol=1e-11 * np.abs(other / scale).max())


@few
@given(seed=seeds)
def test_what_is_not_free_stays_to_the_last_bit(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = some_free(rng)
    learnable = LogCholeskyParameters(problem)
    learnable.precondition(problem, 0.1, 1.0)
    with torch.no_grad():
        learnable.raw.copy_(random_raw(rng, learnable, 3.0))
    phi = value(learnable())
    np.testing.assert_array_equal(phi[~problem.free], problem.nominal[~problem.free])
    assert (phi[problem.free] != problem.nominal[problem.free]).all()


@pytest.mark.parametrize("part", [slice(0, 1), slice(4, 10), slice(9, 10)])
def test_a_body_of_which_part_is_free_is_refused(part: slice) -> None:
    free = np.ones((2, 12), dtype=bool)
    free[1, part] = False
    problem = nothing_seen(random_bodies(np.random.default_rng(4), 2), free.ravel())
    with pytest.raises(ValueError, match="free: found a body with both free and fixed inertial parameters; acc"):
        LogCholeskyParameters(problem)


# ------------------------------------------------------------------------------------------------------- derivatives


@pytest.mark.parametrize("size", [0.0, 0.3, 1.0])
def test_gradients_are_those_of_finite_differences(size: float) -> None:
    rng = np.random.default_rng(5)
    learnable = LogCholeskyParameters(some_free(rng))
    u = random_raw(rng, learnable, size).requires_grad_()
    assert torch.autograd.gradcheck(learnable.constrained, (u,), rtol=1e-6, atol=1e-8)
    assert torch.autograd.gradgradcheck(learnable.constrained, (u,), rtol=1e-5, atol=1e-7)


def seen(seed: int, spread: float) -> LinearProblem:
    """Two bodies without friction at the start, 40 rows whose singular values spread."""
    rng = np.random.default_rng(seed)
    nominal = random_bodies(rng, 2)
    nominal[:, 10:] = 0.2
    scale = parameter_scale(nominal)
    truth = nominal + 0.1 * scale * rng.normal(size=nominal.shape)
    problem = data(rng, nominal, truth, scale, 40, spread, 0.1)
    return replace(problem, free=np.arange(24) != 10)  # all but one body's dry friction


def objective(problem: LinearProblem, ridge: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Mean squared residual plus ridge, of phi."""
    A, b, nominal, scale = map(torch.from_numpy, (problem.A, problem.b, problem.nominal, problem.scale))

    def of(phi: torch.Tensor) -> torch.Tensor:
        return (A @ phi - b).square().sum() / problem.rows + ridge * ((phi - nominal) / scale).square().sum()

    return of


@pytest.mark.parametrize("damping", [1e-3, 1.0])
def test_curvature_of_possible_bodies_is_so_too_where_the_data_fit(damping: float) -> None:
    """There the Gauss-Newton Hessian is the whole one."""
    problem = seen(8, 1e3)
    learnable = LogCholeskyParameters(problem)
    problem = replace(problem, b=problem.A @ value(learnable()))
    of, start = objective(problem, 0.0), torch.zeros_like(learnable.raw)
    h = np.linalg.eigvalsh(torch.autograd.functional.hessian(lambda x: of(learnable.constrained(x)), start).numpy())
    learnable.precondition(problem, 0.0, damping)
    found = torch.autograd.functional.hessian(lambda x: of(learnable.constrained(learnable.preconditioner @ x)), start)
    np.testing.assert_allclose(np.linalg.eigvalsh(found.numpy()), h / (h + damping), rtol=0.0, atol=1e-10)
    assert h.max() > 0.1, "something must be seen"
