"""What each contact state of the logs lets through: rows per sample and rank(S_b V_x)."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from torchid.errors import BaseLostError, BaseLostWarning
from torchid.problem.chunks import by_state
from torchid.problem.plan import State, state_name
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.threads import one_thread
from torchid.sensing.projection import base_rank, base_singular_values

_CHECKED, _CHUNKS_CHECKED = 64, 8  # samples a chunk, chunks a state: rank is generic, a few postures settle it


@dataclass(frozen=True)
class StateReport:
    """A contact state in the logs.

    `name`: frames in contact, joined by "+". `rows`: equations per sample. `base_rank`: rank(S_b V_x), the best over
    the samples checked, None for a fixed base. `base_singular_value`: median of its smallest singular value; near 0,
    base accelerations are all but lost.
    """

    name: str
    samples: int
    rows: int
    base_rank: int | None
    base_singular_value: float | None


@one_thread()
@torch.no_grad()
def state_reports(logs: Sequence[Samples], builder: RowBuilder) -> list[StateReport]:
    """One report per contact state, most frequent first."""
    counts: dict[State, int] = {}
    values: dict[State, list[torch.Tensor]] = {}
    rows: dict[State, int] = {}
    checked: dict[State, int] = {}
    for samples in logs:
        every = torch.arange(len(samples))
        for state, index in by_state(samples):
            counts[state] = counts.get(state, 0) + len(every[index])
            checked[state] = checked.get(state, 0) + 1
            if checked[state] <= _CHUNKS_CHECKED:
                piece = samples[index]
                spread = piece[torch.linspace(0, len(piece) - 1, min(len(piece), _CHECKED)).long()].to(builder.device)
                for _, V in builder.bases(spread, state):
                    rows[state] = max(rows.get(state, 0), V.shape[2] + len(builder.plan(state).lone_joints))
                    if builder.tree.base_rows:
                        values.setdefault(state, []).append(base_singular_values(V).cpu())
    reports = []
    for state in sorted(counts, key=lambda s: -counts[s]):
        rank = smallest = None
        if builder.tree.base_rows:
            found = torch.cat(values[state])
            rank = int(base_rank(found).max())
            smallest = float(found[:, -1].median())
        reports.append(StateReport(state_name(builder.contacts, state), counts[state], rows[state], rank, smallest))
    return reports


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
    where = "; ".join(f"{r.name} ({r.samples} samples): rank {r.base_rank} of 6" for r in lost[:4])
    message = f"sensors: the base is lost, rank(S_b V_x) < 6, in contact with {where}"
    if on_base_lost == "error":
        raise BaseLostError(f"{message}; accepted: more sensors, other contacts, or sensors.on_base_lost: warn")
    warnings.warn(f"{message}; parameters of some bodies are out of reach there", BaseLostWarning, stacklevel=2)
