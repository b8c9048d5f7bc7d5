"""Ranks of problems, and how clear they are."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import scipy.linalg

from torchid.errors import NumericalWarning
from torchid.parameters import Array
from torchid.problem.linear import LinearProblem
from torchid.problem.threads import one_thread

_CLEAR_GAP = 1e3  # a rank is told by a step of many decades (14 on exact motions), not by a slope


class RankGap(NamedTuple):
    """Number of singular values that count, and how clear that is: the smallest of them over the next one."""

    rank: int
    gap: float


def rank_and_gap(values: Array, tolerance: float = 1e-10) -> RankGap:
    """Rank of a matrix with columns of one size.

    What lies below rounding is not known: the gap takes it for `eps` times the largest value, and is 4.5e15 at most.

    Args:
        values: singular values, descending.
        tolerance: a value below this share of the largest counts as zero.

    Warns:
        NumericalWarning: a gap below 1e3, so that another tolerance finds another rank.
    """
    rank = int((values > tolerance * values[:1]).sum())
    if rank == 0:
        return RankGap(0, np.inf)
    dropped = max(float(values[rank]) if rank < len(values) else 0.0, np.finfo(float).eps * float(values[0]))
    gap = float(values[rank - 1]) / dropped
    if gap < _CLEAR_GAP:
        message = f"rank {rank}: the next singular value is only {gap:.3g} times smaller than the last that counts"
        warnings.warn(f"{message}; the rank is a matter of the tolerance, {tolerance:g}", NumericalWarning, 2)
    return RankGap(rank, gap)


@one_thread()
def structural_rank(problem: LinearProblem, tolerance: float = 1e-10) -> RankGap:
    """Rank of a problem's free columns, scaled to norm 1.

    Args:
        problem: its rows decide what is seen.
        tolerance: as in `unit_columns` and `rank_and_gap`.

    Warns:
        NumericalWarning: the rank is a matter of the tolerance.
    """
    columns, _ = unit_columns(problem, tolerance)
    return rank_and_gap(scipy.linalg.svd(columns, compute_uv=False, lapack_driver="gesvd"), tolerance)


def unit_columns(problem: LinearProblem, tolerance: float) -> tuple[Array, Array]:
    """Free columns scaled to norm 1, (R, P_free), and their parameters' units, (P_free,).

    A column below the share `tolerance` of the largest, in units of `problem.scale`, is not seen at all, and set to 0.
    """
    scale = problem.scale[problem.free]
    columns = problem.A[:, problem.free] * scale
    norms = np.linalg.norm(columns, axis=0)
    seen = norms > tolerance * norms.max(initial=0.0)
    norms[~seen] = 1.0
    return np.where(seen, columns, 0.0) / norms, scale / norms
