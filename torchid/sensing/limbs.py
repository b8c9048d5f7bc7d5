"""Fast whitened null-space bases for limbs with as many joints as unmeasured contact components.

This covers most walking robots: point feet on three joints, flat feet on six. The motion of a limb follows from that of
the base by a small square system; no decomposition of all limbs together is needed.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

BASE = 6
"""Rows of the base in a generalized force."""

WELL_CONDITIONED = 1e4  # of a limb, in the Frobenius norm: a knee that is not straight
PIVOT = 1e-6  # remaining fraction of a column's square; below, the columns are nearly dependent
_OF_BASE = (slice(0, 3), slice(3, BASE))  # force and moment


def limb_null_space(
    limbs: Sequence[Tensor],
    joints: Sequence[Tensor],
    row_std: Tensor,
    J_m: Tensor,
    wrench_std: Tensor,
    axes: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Bases W of the null space of A, the limbs' rows, under which the projected noise is white, batch-last.

    With the base's motion given, `A V = 0` leaves each limb one motion: V is the identity on the base and `-L^-1 B` on
    a limb with rows `[B L]`. Columns of V, by their effect on each reading in units of its noise, are made orthonormal
    one after the other: `W = V R^-1` with R triangular, so that the first three columns of W are zero in the base's
    moment.

    Args:
        limbs: (k, 6 + k, B) each, rows of unmeasured wrench components in the base's rows and in the limb's k joints.
        joints: (k,) int64 each, where these joints are in the rows of the generalized force after the base's, all m - 6
            of them together.
        row_std: as of `whitened_null_space`.
        J_m: (k_m, m, B), rows of measured wrench components.
        wrench_std: as of `whitened_null_space`.
        axes: as of `whitened_null_space`.

    Returns:
        W, (m, 6, B), and whether each sample is suspect, (B,): a limb is singular or nearly so, and its W worthless.
    """
    m = len(row_std)
    samples = limbs[0].shape[-1]
    white = row_std.new_empty(m + len(J_m), BASE, samples)  # what the columns of V do to each reading, by its noise
    suspect = torch.zeros(samples, dtype=torch.bool, device=white.device)
    for k in dict.fromkeys(len(limb) for limb in limbs):
        alike = [number for number, limb in enumerate(limbs) if len(limb) == k]
        motion, condition = _solve([limbs[number] for number in alike])
        suspect |= ~(condition < WELL_CONDITIONED**2)  # so written, undefined ones are suspect too
        white[BASE:m].index_copy_(0, torch.cat([joints[number] for number in alike]), motion)
    base = white[:BASE]
    of_joints = white[BASE:m]
    for row, J, std in zip(white[m:], J_m, wrench_std, strict=True):
        row[:] = std * ((J[BASE:, None] * of_joints).sum(0) + J[:BASE])
    of_joints *= row_std[BASE:, None, None]
    base[:] = 0.0
    if axes is None:
        base.diagonal().copy_(row_std[:BASE])
    else:
        axes = axes.permute(1, 2, 0).contiguous()
        for rows in _OF_BASE:
            base[rows, rows] = axes.transpose(0, 1) * row_std[rows, None, None]
    _orthonormalize(white, suspect)
    of_joints /= row_std[BASE:, None, None]
    if axes is None:
        base /= row_std[:BASE, None, None]
    else:
        for rows in _OF_BASE:
            turn = axes / row_std[rows, None]
            base[rows] = _sum_of_products(turn[:, :, None].unbind(1), base[rows].unbind())
    return white[:m], suspect


def _orthonormalize(columns: Tensor, suspect: Tensor) -> None:
    """Make the columns of matrices (m, n, B) orthonormal in place; mark samples where this fails in `suspect`.

    Uses the modified Gram-Schmidt process; a Cholesky factor of their products would square their condition number.
    """
    least = PIVOT * columns.square().sum(0)
    for j in range(columns.shape[1]):
        column = columns[:, j]
        later = columns[:, j + 1 :]
        size = column.square().sum(0)
        suspect |= ~(size > least[j])
        column *= size.rsqrt_()
        later.addcmul_(column[:, None], (column[:, None] * later).sum(0), value=-1)


def _solve(limbs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """-L^-1 B of limbs [B L], (k, 6 + k, B) each: (limbs k, 6, B), and the square of their condition, (B,), the worst.

    By Householder reflections, one for each joint, the last first.
    """
    k = len(limbs[0])
    X = torch.stack(list(limbs))
    size = X[:, :, BASE:].square().sum((1, 2))
    for done, column in enumerate(reversed(range(BASE + 1, BASE + k))):
        v = X[:, done:, column].clone()
        earlier = X[:, done:, :column]
        length = torch.copysign((v * v).sum(1).sqrt_(), v[:, 0])
        v[:, 0] += length
        along = _sum_of_products(v[:, :, None].unbind(1), earlier.unbind(1))
        along /= (length * v[:, 0])[:, None]
        earlier.addcmul_(v[:, :, None], along[:, None], value=-1)
        X[:, done, column] = -length
    for row in reversed(range(k)):
        column = BASE + k - 1 - row
        X[:, row, :BASE] /= X[:, row, column, None]
        X[:, :row, :BASE].addcmul_(X[:, :row, column, None], X[:, row, None, :BASE], value=-1)
    motion = X[:, :, :BASE].flip(1).neg_()
    return motion.flatten(0, 1), (motion.square().sum((1, 2)) * size).amax(0)


def _sum_of_products(factors: Sequence[Tensor], others: Sequence[Tensor]) -> Tensor:
    """Sum of the products of each of some tensors with its other; no array holds all products."""
    out = factors[0] * others[0]
    for factor, other in zip(factors[1:], others[1:], strict=True):
        out.addcmul_(factor, other)
    return out
