"""Null spaces of batches in which every sample may have a rank of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import Array
from torch import Tensor

from torchid.sensing.projection import complement, null_space


def orthogonal(rng: np.random.Generator, size: int) -> Array:
    return np.linalg.qr(rng.normal(size=(size, size)))[0]


def of_rank(rng: np.random.Generator, k: int, m: int, rank: int) -> Array:
    """A matrix with singular values between 0.1 and 10, all multiplied by up to 10^6 or 10^-6."""
    values = 10.0 ** rng.uniform(-1.0, 1.0, rank) * 10.0 ** rng.uniform(-6.0, 6.0)
    return orthogonal(rng, k)[:, :rank] * values @ orthogonal(rng, m)[:, :rank].T


def bases(A: Array) -> list[Array]:
    """The basis of each sample, after making sure that every sample has one."""
    found: dict[int, Array] = {}
    for index, V in null_space(torch.from_numpy(A)):
        samples = torch.arange(len(A))[index].tolist()
        assert len(samples) == len(V)
        assert not found.keys() & samples
        found |= dict(zip(samples, V.numpy(), strict=True))
    assert found.keys() == set(range(len(A)))
    return [found[i] for i in range(len(A))]


@settings(max_examples=100, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), k=st.integers(0, 14), m=st.integers(1, 20), samples=st.integers(0, 6))
def test_a_null_space_is_all_that_a_matrix_maps_to_nothing(seed: int, k: int, m: int, samples: int) -> None:
    rng = np.random.default_rng(seed)
    ranks = [rng.choice([min(k, m), rng.integers(0, min(k, m) + 1)]) for _ in range(samples)]
    A = np.array([of_rank(rng, k, m, rank) for rank in ranks]).reshape(samples, k, m)
    for matrix, V, rank in zip(A, bases(A), ranks, strict=True):
        assert V.shape == (m, m - rank)
        np.testing.assert_allclose(V.T @ V, np.eye(m - rank), rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(matrix @ V, 0.0, rtol=0.0, atol=1e-13 * np.abs(matrix).max(initial=0.0))


@pytest.mark.parametrize("k", [1, 3, 5, 8])
def test_without_any_constraint_everything_is_free_and_so_it_is_under_zero_constraints(k: int) -> None:
    (free,) = bases(np.zeros((1, 0, 5)))
    np.testing.assert_array_equal(free, np.eye(5))
    mixed = np.zeros((3, k, 5))
    mixed[1, 0, 2] = 1.0
    zero, one, other_zero = bases(mixed)
    for V in (zero, other_zero):
        np.testing.assert_allclose(V @ V.T, np.eye(5), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(one @ one.T, np.diag([1.0, 1.0, 0.0, 1.0, 1.0]), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("rank", [1, 2, 3], ids=["one", "two", "full"])
def test_the_projector_on_a_null_space_has_its_derivatives_along_motions_that_keep_the_rank(rank: int) -> None:
    rng = np.random.default_rng(rank)
    left, right = (torch.from_numpy(rng.normal(size=shape)) for shape in ((2, 3, rank), (2, rank, 5)))

    def projector(left: Tensor, right: Tensor) -> Tensor:
        ((_, V),) = null_space(left @ right)
        assert V.shape == (2, 5, 5 - rank)
        return V @ V.mT

    arguments = [left.requires_grad_(), right.requires_grad_()]
    assert torch.autograd.gradcheck(projector, arguments)
    assert torch.autograd.gradgradcheck(projector, arguments)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("with_gradient", [False, True])
def test_a_jacobian_of_rounding_errors_alone_has_rank_0(dtype: torch.dtype, with_gradient: bool) -> None:
    eps = torch.finfo(dtype).eps
    A = eps * torch.randn(4, 2, 5, dtype=dtype, generator=torch.Generator().manual_seed(0))
    A[0, 1] = torch.tensor([0.0, 1.0, 0.0, 0.0, 0.0])
    bases = dict.fromkeys(range(4), torch.empty(0, 0))
    for index, V in null_space(A.requires_grad_(with_gradient)):
        bases |= dict(zip(torch.arange(4)[index].tolist(), V, strict=True))
    assert [V.shape[1] for V in bases.values()] == [4, 5, 5, 5]
    assert (bases[0][1].abs() < 100.0 * eps).all()


@pytest.mark.parametrize(("m", "k"), [(18, 12), (35, 12), (6, 6), (7, 1), (1, 1)])
def test_what_a_gpu_makes_of_reflections_is_what_lapack_makes_of_them(m: int, k: int) -> None:
    A = torch.randn(40, m, k, generator=torch.Generator().manual_seed(m), dtype=torch.float64)
    A[0], A[1, 1:], A[2, :, -1] = 0.0, 0.0, A[2, :, 0]  # reflections that are none
    reflectors, tau = torch.geqrf(A)
    last = torch.eye(m, dtype=torch.float64)[:, k:].expand(40, m, m - k)
    expected = torch.ormqr(reflectors, tau, last)
    torch.testing.assert_close(complement(reflectors, tau), expected, rtol=0.0, atol=1e-14)
