"""What would be lost without each log, or without each contact state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchid.analysis.information import Knowledge, triangle
from torchid.parameters import Array
from torchid.problem import RowBuilder
from torchid.problem.elimination import without
from torchid.problem.streaming import Part


@dataclass(frozen=True)
class Contribution:
    """Bits and combinations, as in `Knowledge`, that are lost without a part of the data."""

    name: str
    bits: float
    determined: float


@dataclass(frozen=True)
class PartContribution(Contribution):
    """Of a log or a contact state: its samples, the rank of its rows alone, and how far that of all falls without."""

    samples: int
    rank: int
    rank_lost: int


@dataclass(frozen=True)
class Unknowns:
    """Places of the unknowns that are not asked for, among scaled columns: those that each log has anew.

    `of_all`: of those that all logs have in common, among the columns that are left then.
    """

    of_log: list[int]
    of_all: list[int]

    @classmethod
    def of(cls, builder: RowBuilder, directions: Array) -> Unknowns:
        """Of the columns `directions`, as `prior_directions` has them, the unknowns last."""
        first = directions.shape[1] - len(builder.extras)
        own = [first + number for number, extra in enumerate(builder.extras) if extra.per_log]
        return cls(own, list(range(first, directions.shape[1] - len(own))))


class ScaledParts:
    """Parts of logs, and X of each with `X^T X` its information in scaled columns, correlated noise counted."""

    def __init__(self, parts: Sequence[Part], directions: Array, unknowns: Unknowns) -> None:
        self.parts, self.unknowns = parts, unknowns
        self._factors = [
            part.factor.triangle().numpy()[:-1, :-1] @ directions / np.sqrt(part.factor.oversampling) for part in parts
        ]

    def together(self, chosen: Sequence[int]) -> Array:
        """X of some parts, with what is unknown in each log eliminated."""
        by_source: dict[str, list[Array]] = {}
        for i in chosen:
            by_source.setdefault(self.parts[i].source if self.unknowns.of_log else "", []).append(self._factors[i])
        nothing = np.empty((0, self._factors[0].shape[1] - len(self.unknowns.of_log)))
        found = (without(triangle(np.concatenate(same)), self.unknowns.of_log) for same in by_source.values())
        return triangle(np.concatenate([nothing, *found]))

    @cached_property
    def everything(self) -> Array:
        """Singular values of all parts together."""
        return self.singular_values(self.together(range(len(self.parts))))

    def singular_values(self, X: Array) -> Array:
        """Of what X of several logs say of the bodies' parameters, descending."""
        return np.asarray(np.linalg.svd(without(triangle(X), self.unknowns.of_all), compute_uv=False))


def left_out(data: ScaledParts, names: Sequence[str], rank_tolerance: float) -> list[PartContribution]:
    """What is lost without the parts of each name.

    Args:
        data: all parts.
        names: of each.
        rank_tolerance: as in `LeastSquares`.
    """
    groups = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    factors = [data.together(chosen) for chosen in groups.values()]
    everything, out = data.everything, []
    for (name, chosen), factor, others in zip(groups.items(), factors, _rests(data, groups, factors), strict=True):
        rest = data.singular_values(others)
        lost = Knowledge.of(everything**2) - Knowledge.of(rest**2)
        rank = _rank(data.singular_values(factor), rank_tolerance)
        rank_lost = _rank(everything, rank_tolerance) - _rank(rest, rank_tolerance)
        samples = sum(data.parts[i].samples for i in chosen)
        out.append(PartContribution(name, lost.bits, lost.determined, samples, rank, rank_lost))
    return out


def _rests(data: ScaledParts, groups: dict[str, list[int]], factors: Sequence[Array]) -> Iterator[Array]:
    """X of all parts but those of each group."""
    logs = [{data.parts[i].source for i in chosen} for chosen in groups.values()]
    if not data.unknowns.of_log or sum(map(len, logs)) == len(set().union(*logs)):
        yield from _without_each(factors)
        return
    for chosen in groups.values():  # groups share logs, and so their unknowns
        yield data.together([i for i in range(len(data.parts)) if i not in set(chosen)])


def _without_each(factors: Sequence[Array]) -> Iterator[Array]:
    """For every factor, one of all others, from those of the ones before and after it: no pair is merged twice."""
    nothing = factors[0][:0]
    after = [nothing]
    for factor in reversed(factors[1:]):
        after.append(triangle(np.concatenate([factor, after[-1]])))
    before = nothing
    for factor in factors:
        yield np.concatenate([before, after.pop()])
        before = triangle(np.concatenate([before, factor]))


def _rank(values: Array, tolerance: float) -> int:
    """As `LeastSquares` counts it."""
    least = max(tolerance, np.finfo(float).eps * len(values)) * values.max(initial=0.0)
    return int((values > least).sum())
