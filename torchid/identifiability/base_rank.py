"""Rank of the base projection: whether sensors determine the base's motion in each contact state of the logs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate

import torch
from torch import Tensor

from torchid.errors import BaseLostError, BaseLostWarning, warn
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state, one_thread, subsample_states
from torchid.problem.contact_state import State, state_name
from torchid.sensing.projection import base_rank, base_singular_values

_CHECKED = 512  # samples a state, from all over the logs: shares are then known to about 2 %
_MOST = 0.5  # share of the samples that must have the whole base: else the median of the smallest singular value is 0


@dataclass(frozen=True)
class StateReport:
    """A contact state in the logs; what concerns the base is None if it is fixed.

    Attributes:
        name: frames in contact, joined by "+".
        samples: number of samples.
        rows: equations per sample, at most.
        base_rank: rank(S_b V_x) that at least half of the samples checked reach.
        base_singular_value: median of its smallest singular value; near 0, base accelerations are nearly lost.
        base_full_share: share of the samples at rank 6.
        base_rank_shares: share at each rank that occurs, descending.
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
    counts = Counter[State]()
    for samples in logs:
        every = torch.arange(len(samples))
        for state, index in chunks_by_state(samples):
            counts[state] += len(every[index])
    rows, values, weights = (
        Counter[State](),
        defaultdict[State, list[Tensor]](list),
        defaultdict[State, list[Tensor]](list),
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


def require_base(reports: Sequence[StateReport], on_base_lost: str = "error") -> None:
    """Refuse logs with a contact state in which part of the base is lost, or warn.

    Args:
        reports: from `state_reports`.
        on_base_lost: "error" or "warn".

    Raises:
        BaseLostError: a floating base of which only part survives the projection.

    Warns:
        BaseLostWarning: instead of the error, with "warn".
    """
    lost = [report for report in reports if report.base_rank is not None and report.base_rank < 6]
    if not lost:
        return
    where = "; ".join(f"{r.name} ({r.samples} samples): {_described(r)}" for r in lost[:4])
    message = f"sensors: the base is lost, rank(S_b V_x) < 6, in contact with {where}"
    if on_base_lost == "error":
        raise BaseLostError(f"{message}; accepted: more sensors, other contacts, or sensors.on_base_lost: warn")
    warn(f"{message}; parameters of some bodies are out of reach there", BaseLostWarning)


def _of_base(values: Tensor, weight: Tensor) -> tuple[int, float, float, dict[int, float]]:
    """The entries of a report on the base, from singular values (B, 6) of samples that represent `weight` each."""
    ranks = base_rank(values)
    share = {int(rank): float(weight[ranks == rank].sum() / weight.sum()) for rank in ranks.unique().flip(0)}
    reached = accumulate(share.values())
    most = next(rank for rank, so_far in zip(share, reached, strict=True) if so_far >= _MOST)
    return most, float(values[:, -1].median()), share.get(6, 0.0), share


def _described(report: StateReport) -> str:
    """The rank of most samples, and the share of those that are better."""
    share = f", 6 in {100 * report.base_full_share:.2g} % of them" if report.base_full_share else ""
    return f"rank {report.base_rank} of 6{share}"
