"""Whitened null-space bases of robots that stand on limbs with as many joints as their contact leaves unmeasured.

Point feet on three joints, flat feet on six: nearly all that walks. Each limb's joints follow from the base's motion,
by a small square system, so that no batch of decompositions of all limbs together is needed.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

BASE = 6
"""Rows of the base in a generalized force."""

_WELL_CONDITIONED = 1e3  # of a limb, in the Frobenius norm: a knee that is not straight
_PIVOT = 1e-4  # of the covariance, relative to its diagonal: below it, its square root loses digits


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
    a limb with rows `[B L]`. `W = V C^-T`, with `C C^T` the covariance of `V^T` noise, is zero in the base's moment in
    its first three columns, as C is triangular.

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
    m, samples = len(row_std), limbs[0].shape[-1]
    # columns that are combined until the covariance, in the first rows, is triangular; the others are V
    both = row_std.new_empty(BASE + m, BASE, samples)
    covariance, V = both[:BASE], both[BASE:]
    both[: 2 * BASE] = 0.0
    V[:BASE].diagonal().fill_(1.0)
    suspect = torch.zeros(samples, dtype=torch.bool, device=V.device)
    for k in dict.fromkeys(len(limb) for limb in limbs):
        alike = [number for number, limb in enumerate(limbs) if len(limb) == k]
        motion, condition = _solve([limbs[number] for number in alike])
        suspect |= ~(condition < _WELL_CONDITIONED**2)  # so written, undefined ones are suspect too
        V[BASE:].index_copy_(0, torch.cat([joints[number] for number in alike]), motion)
    variance = row_std**2
    if axes is None:
        covariance.diagonal().copy_(variance[:BASE])
    else:
        covariance[:3, :3] = ((axes * variance[:3]) @ axes.mT).permute(1, 2, 0)
        covariance[3:, 3:] = ((axes * variance[3:BASE]) @ axes.mT).permute(1, 2, 0)
    for row, std in zip(V[BASE:], row_std[BASE:], strict=True):
        scaled = std * row
        covariance.addcmul_(scaled[:, None], scaled)
    for row, std in zip(J_m, wrench_std, strict=True):
        through_contact = std * (row[:, None] * V).sum(0)
        covariance.addcmul_(through_contact[:, None], through_contact)
    least = _PIVOT * covariance.diagonal().mT
    for j in range(BASE):
        suspect |= ~(covariance[j, j] > least[j])
        column = both[j:, j].mul_(covariance[j, j].rsqrt())
        both[j:, j + 1 :].addcmul_(column[:, None], column[1 : BASE - j], value=-1)
    return V, suspect


def _solve(limbs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """-L^-1 B of limbs [B L], (k, 6 + k, B) each: (limbs k, 6, B), and the square of their condition, (B,), the worst.

    By Householder reflections, one for each joint, the last first.
    """
    k = len(limbs[0])
    X = torch.stack(list(limbs))
    size = X[:, :, BASE:].square().sum((1, 2))
    for done, column in enumerate(reversed(range(BASE + 1, BASE + k))):
        v, rest = X[:, done:, column].clone(), X[:, done:, :column]
        length = torch.copysign((v * v).sum(1).sqrt_(), v[:, 0])
        v[:, 0] += length
        along = (v[:, :, None] * rest).sum(1)
        along /= (length * v[:, 0])[:, None]
        rest.addcmul_(v[:, :, None], along[:, None], value=-1)
        X[:, done, column] = -length
    for row in reversed(range(k)):
        column = BASE + k - 1 - row
        X[:, row, :BASE] /= X[:, row, column, None]
        X[:, :row, :BASE].addcmul_(X[:, :row, column, None], X[:, row, None, :BASE], value=-1)
    motion = X[:, :, :BASE].flip(1).neg_()
    return motion.flatten(0, 1), (motion.square().sum((1, 2)) * size).amax(0)
