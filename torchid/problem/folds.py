"""Folds for cross-validation: contiguous blocks of the logs, and what is kept of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torchid.problem.chunks import by_state
from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.streaming import Part
from torchid.problem.threads import one_thread, worker_count
from torchid.problem.triangular import TriangularFactor

FOLDS = 5
"""Blocks that all training samples are cut into: each fit sees four fifths, and five fits are cheap."""

_LEAST = 20  # independent samples a block: what neighbours share through a filter is a small part of that
_MEMORY = 2**30  # bytes of factors


def in_folds(logs: Sequence[Samples], builder: RowBuilder) -> list[Samples]:
    """The logs in order, cut into blocks contiguous in time that know their fold.

    Errors of successive samples are alike, so that samples drawn at random would judge a fit by what it has seen. A log
    is cut as often as its share of all samples asks for; where there are many, whole logs are left out. Fewer folds, or
    a single one, if the samples or the memory for their factors are too few.

    Args:
        logs: bound logs.
        builder: of their rows.
    """
    total, count = sum(map(len, logs)), _count(logs, builder)
    out, before = [], 0
    for log in logs:
        blocks = max(1, round(count * len(log) / max(total, 1)))
        ends = [len(log) * k // blocks for k in range(blocks + 1)]
        for start, end in zip(ends, ends[1:], strict=False):
            middle = before + (start + end) / 2
            fold = min(int(count * middle / max(total, 1)), count - 1)
            out.append(replace(log if blocks == 1 else log[start:end], fold=fold))
        before += len(log)
    found = sorted({block.fold for block in out})  # rounding may have left one empty
    return [replace(block, fold=found.index(block.fold)) for block in out]


def _count(logs: Sequence[Samples], builder: RowBuilder) -> int:
    independent = sum(len(log) / log.oversampling for log in logs)
    states: set[tuple[str, State]] = {(log.source, state) for log in logs for state, _ in by_state(log)}
    size = 8 * (builder.width + 1) ** 2 * max(len(states), 1) * worker_count(builder.device)
    return max(1, min(FOLDS, int(independent / _LEAST), _MEMORY // size))


@one_thread()
def states_together(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """One part for each log and fold, its contact states together; equations in the air stay apart."""
    return _together(parts, [(part.source, part.fold, part.unloaded) for part in parts], builder)


@one_thread()
def folds_together(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """One part for each log and contact state, its folds together; equations in the air stay apart."""
    return _together(parts, [(part.source, part.state, part.unloaded) for part in parts], builder)


def _together(parts: Sequence[Part], keys: Sequence[tuple[object, ...]], builder: RowBuilder) -> list[Part]:
    """One part for each key, with the contact state and fold of the first."""
    out: dict[tuple[object, ...], Part] = {}
    for part, key in zip(parts, keys, strict=True):
        if key not in out:
            out[key] = replace(part, factor=TriangularFactor(builder.width), samples=0, gated=set())
        out[key].factor.merge(part.factor)
        out[key].gated |= part.gated
        out[key].samples += part.samples
    return list(out.values())
