"""Null space of the unmeasured forces, batched, with the rank each sample really has."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

RANK_TOLERANCE = 1e-9
"""A singular value of A_x below this share of the largest counts as zero (more in single precision)."""

_SUSPECT = 1e3  # below this many tolerances, the QR path hands the sample to an SVD


def null_space(A: Tensor) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Orthonormal bases of the null spaces of a batch of matrices, grouped by rank.

    A QR factorization of the transpose serves samples of full row rank; only those that might have lost rank (straight
    knees) pay for a singular value decomposition. Bases carry no gradient: they depend on the motion alone, and their
    choice within the null space is arbitrary.

    Args:
        A: (B, k, m).

    Yields:
        (index of the samples, V): V is (B', m, m - rank) with `A @ V = 0` and `V^T V = I`.
    """
    A = A.detach()
    samples, k, m = A.shape
    if samples == 0:
        return
    identity = torch.eye(m, dtype=A.dtype, device=A.device)
    tolerance = max(RANK_TOLERANCE, max(k, m) * torch.finfo(A.dtype).eps)
    if k == 0:
        yield slice(None), identity.expand(samples, m, m)
        return
    suspect = torch.ones(samples, dtype=torch.bool, device=A.device)
    if k <= m:
        reflectors, tau = torch.geqrf(A.mT)
        R = reflectors[:, :k].triu()
        inverse = torch.linalg.solve_triangular(R, identity[:k, :k].expand_as(R), upper=True)
        condition = torch.linalg.matrix_norm(R) * torch.linalg.matrix_norm(inverse)
        suspect = ~(condition < 1.0 / (_SUSPECT * tolerance))  # so written, infinite and undefined ones are suspect too
        V = torch.ormqr(reflectors, tau, identity[:, k:].expand(samples, m, m - k))
        if not suspect.any():
            yield slice(None), V
            return
        regular = torch.nonzero(~suspect)[:, 0]
        if len(regular):
            yield regular, V[regular]
    left = torch.nonzero(suspect)[:, 0]
    _, values, Vh = torch.linalg.svd(A[left], full_matrices=True)
    rank = (values > tolerance * values[:, :1].clamp_min(torch.finfo(A.dtype).tiny)).sum(1)
    for r in rank.unique().tolist():
        same = rank == r
        yield left[same], Vh[same, r:].mT


def whitened_null_space(
    A: Tensor, row_std: Tensor, J_m: Tensor, wrench_std: Tensor
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Bases W of the null spaces of A under which the projected sensor noise is white, grouped by rank.

    Args:
        A: (B, k, m).
        row_std: (m,), > 0, noise of the generalized force itself (torque sensors, floor of the base rows).
        J_m: (B, k_m, m), rows of the contact Jacobian whose wrench component is measured.
        wrench_std: (k_m,), noise of each measured wrench component.

    Yields:
        (index of the samples, W): W is (B', m, m - rank) with `A @ W = 0` and `W^T S W = I`, where S, the covariance of
        the generalized force, is `diag(row_std^2) + J_m^T diag(wrench_std^2) J_m`.
    """
    J_m = J_m.detach()
    for index, V in null_space(A / row_std):
        W = V / row_std[:, None]  # white already, as far as the rows' own noise goes
        if len(wrench_std):
            through_contacts = (J_m[index] @ W) * wrench_std[:, None]
            identity = torch.eye(W.shape[2], dtype=W.dtype, device=W.device)
            L = torch.linalg.cholesky(identity + through_contacts.mT @ through_contacts)
            W = torch.linalg.solve_triangular(L, W.mT, upper=False).mT
        yield index, W


def levelled_null_space(
    A: Tensor, row_std: Tensor, J_m: Tensor, wrench_std: Tensor, axes: Tensor | None
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """As `whitened_null_space`, with noise of the base rows along other axes than the base's.

    Args:
        A: (B, k, m), the six base rows of the generalized force first.
        row_std: (m,), base rows along `axes`.
        J_m: (B, k_m, m).
        wrench_std: (k_m,).
        axes: (B, 3, 3), columns are unit vectors in the base frame; None: the base's own.
    """
    if axes is None:
        yield from whitened_null_space(A, row_std, J_m, wrench_std)
        return
    axes = axes.detach()
    for index, W in whitened_null_space(_along(A, axes), row_std, _along(J_m, axes), wrench_std):
        yield index, _along(W.mT, axes[index].mT).mT


def _along(X: Tensor, axes: Tensor) -> Tensor:
    """Rows (B, k, m) whose force and moment on the base are given by their components along some axes."""
    return torch.cat([X[..., :3] @ axes, X[..., 3:6] @ axes, X[..., 6:]], dim=-1)
