"""Null space of the unmeasured forces, batched, with the rank each sample really has."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

RANK_TOLERANCE = 1e-9
"""A singular value of A_x below this share of the largest counts as zero."""

_SUSPECT = 1e-6  # below this share of the largest, the QR path hands the sample to an SVD


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
    if k == 0:
        yield slice(None), torch.eye(m, dtype=A.dtype, device=A.device).expand(samples, m, m)
        return
    suspect = torch.ones(samples, dtype=torch.bool, device=A.device)
    if k <= m:
        Q, R = torch.linalg.qr(A.mT, mode="complete")
        triangle = R[:, :k]
        diagonal = triangle.diagonal(dim1=1, dim2=2)
        scale = torch.linalg.matrix_norm(triangle)
        singular = diagonal.abs().amin(1) <= RANK_TOLERANCE * scale
        safe = triangle + torch.diag_embed(singular[:, None].to(A.dtype).expand(-1, k))
        identity = torch.eye(k, dtype=A.dtype, device=A.device).expand_as(safe)
        inverse = torch.linalg.solve_triangular(safe, identity, upper=True)
        suspect = singular | (torch.linalg.matrix_norm(inverse) * scale > 1.0 / _SUSPECT)
        if not suspect.any():
            yield slice(None), Q[:, :, k:]
            return
        regular = torch.nonzero(~suspect)[:, 0]
        if len(regular):
            yield regular, Q[regular, :, k:]
    left = torch.nonzero(suspect)[:, 0]
    _, values, Vh = torch.linalg.svd(A[left], full_matrices=True)
    rank = (values > RANK_TOLERANCE * values[:, :1].clamp_min(torch.finfo(A.dtype).tiny)).sum(1)
    for r in rank.unique().tolist():
        same = rank == r
        yield left[same], Vh[same, r:].mT
