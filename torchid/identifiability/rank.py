"""Numerical ranks and how clear they are: of problems, and of S_b V_x in each contact state."""

from __future__ import annotations

import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import NamedTuple

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.errors import BaseLostError, BaseLostWarning, NumericalWarning
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state, one_thread, subsample_states
from torchid.problem.contact_state import ContactState, state_name
from torchid.rounding import RANK_TOLERANCE, is_significant, numerical_rank
from torchid.sensing.projection import base_rank, base_singular_values

_CLEAR_GAP = 1e3  # a rank is told by a step of many decades (14 on exact motions), not by a slope


class RankGap(NamedTuple):
    """Number of singular values that count, and how clear that is: the smallest of them over the next one."""

    rank: int
    gap: float


def rank_and_gap(values: Array, tolerance: float = RANK_TOLERANCE) -> RankGap:
    """Rank of a matrix with columns of one size.

    What lies below rounding is not known: the gap takes it for `eps` times the largest value, and is 4.5e15 at most.

    Args:
        values: singular values, descending.
        tolerance: a value below this share of the largest counts as zero.

    Warns:
        NumericalWarning: a gap below 1e3, so that another tolerance finds another rank.
    """
    rank = numerical_rank(values, tolerance)
    if rank == 0:
        return RankGap(0, np.inf)
    dropped = max(float(values[rank]) if rank < len(values) else 0.0, np.finfo(float).eps * float(values[0]))
    gap = float(values[rank - 1]) / dropped
    if gap < _CLEAR_GAP:
        message = f"rank {rank}: the next singular value is only {gap:.3g} times smaller than the last that counts"
        warnings.warn(f"{message}; the rank is a matter of the tolerance, {tolerance:g}", NumericalWarning, 2)
    return RankGap(rank, gap)


@one_thread()
def structural_rank(problem: LinearProblem, tolerance: float = RANK_TOLERANCE) -> RankGap:
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
    seen = is_significant(norms, tolerance)
    norms[~seen] = 1.0
    return np.where(seen, columns, 0.0) / norms, scale / norms


_CHECKED = 512  # samples a state, from all over the logs: shares are then known to about 2 %
_MOST = (
    0.5  # share of the samples that must see the whole base: then the median of the smallest singular value is not 0
)


@dataclass(frozen=True)
class StateReport:
    """A contact state in the logs.

    `name`: frames in contact, joined by "+". `rows`: equations per sample, at most. `base_rank`: rank(S_b V_x) that at
    least half of the samples checked reach, None for a fixed base, as all that follows. `base_singular_value`: median
    of its smallest singular value; near 0, base accelerations are all but lost. `base_full_share`: share of the samples
    at rank 6; `base_rank_shares`: share at each rank that occurs, descending.
    """

    name: str
    samples: int
    rows: int
    base_rank: int | None
    base_singular_value: float | None
    base_full_share: float | None = None
    base_rank_shares: dict[int, float] = field(default_factory=dict)


@one_thread()
@torch.no_grad()
def state_reports(logs: Sequence[Samples], builder: RowBuilder) -> list[StateReport]:
    """One report per contact state, most frequent first."""
    counts = Counter[ContactState]()
    for samples in logs:
        every = torch.arange(len(samples))
        for state, index in chunks_by_state(samples):
            counts[state] += len(every[index])
    rows, values, weights = (
        Counter[ContactState](),
        defaultdict[ContactState, list[Tensor]](list),
        defaultdict[ContactState, list[Tensor]](list),
    )
    for samples, state, weight in subsample_states(logs, _CHECKED):
        for _, V in builder.null_space_bases(samples.to(builder.device), state):
            rows[state] = max(rows[state], V.shape[2] + len(builder.layout(state).uncoupled_joints))
            if builder.tree.base_rows:
                values[state].append(base_singular_values(V).cpu())
                weights[state].append(torch.full((len(V),), weight))
    return [
        StateReport(
            state_name(builder.contacts, state),
            count,
            rows[state],
            *(_of_base(torch.cat(values[state]), torch.cat(weights[state])) if values[state] else (None, None)),
        )
        for state, count in counts.most_common()
    ]


def _of_base(values: Tensor, weight: Tensor) -> tuple[int, float, float, dict[int, float]]:
    """What a report says of the base, from singular values (B, 6) of samples that stand for so many each."""
    ranks = base_rank(values)
    share = {int(rank): float(weight[ranks == rank].sum() / weight.sum()) for rank in ranks.unique().flip(0)}
    reached = accumulate(share.values())
    most = next(rank for rank, so_far in zip(share, reached, strict=True) if so_far >= _MOST)
    return most, float(values[:, -1].median()), share.get(6, 0.0), share


def check_base(reports: Sequence[StateReport], on_base_lost: str = "error") -> None:
    """Refuse, or warn, if the base is lost in some contact state.

    Args:
        reports: from `state_reports`.
        on_base_lost: "error" or "warn".

    Raises:
        BaseLostError: a floating base of which only part survives the projection.

    Warns:
        BaseLostWarning: instead of the error, if asked to.
    """
    lost = [report for report in reports if report.base_rank is not None and report.base_rank < 6]
    if not lost:
        return
    where = "; ".join(f"{r.name} ({r.samples} samples): {_described(r)}" for r in lost[:4])
    message = f"sensors: the base is lost, rank(S_b V_x) < 6, in contact with {where}"
    if on_base_lost == "error":
        raise BaseLostError(f"{message}; accepted: more sensors, other contacts, or sensors.on_base_lost: warn")
    warnings.warn(f"{message}; parameters of some bodies are out of reach there", BaseLostWarning, stacklevel=2)


def _described(report: StateReport) -> str:
    """The rank of most samples, and the share of those that are better."""
    share = f", 6 in {100 * report.base_full_share:.2g} % of them" if report.base_full_share else ""
    return f"rank {report.base_rank} of 6{share}"
