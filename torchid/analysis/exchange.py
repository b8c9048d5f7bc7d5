"""A more informative set of the same cost, where there are too many sets to rank them all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet

from torchid.analysis.candidates import Candidate
from torchid.analysis.minimal_sets import Component
from torchid.analysis.ranking import SetRanking

_ROUNDS = 12
_SAME_COST = 1e-9


def exchanged(
    ranking: SetRanking,
    part: Component,
    first: Sequence[Candidate],
    keep: AbstractSet[Candidate],
    exclude: AbstractSet[Candidate],
) -> list[tuple[float, tuple[Candidate, ...]]]:
    """Sets found from a sufficient one by exchanging one sensor at a time, uphill in information, best first.

    Args:
        ranking: of the part's candidates.
        part: whose demands every set meets.
        first: where to start.
        keep: sensors that stay.
        exclude: sensors that cannot be taken.
    """
    best = (ranking.bits(first), tuple(first))
    climbed = [best]
    for _ in range(_ROUNDS):
        neighbours = [(ranking.bits(found), found) for found in _neighbours(part, best[1], keep, exclude)]
        higher = max(neighbours, key=lambda pair: pair[0], default=best)
        if higher[0] <= best[0]:
            break
        best = higher
        climbed.append(best)
    return climbed[::-1]


def _neighbours(
    part: Component, chosen: Sequence[Candidate], keep: AbstractSet[Candidate], exclude: AbstractSet[Candidate]
) -> Iterator[tuple[Candidate, ...]]:
    """Sufficient sets that differ by one sensor of the same cost."""
    for gone in chosen:
        for new in part.candidates:
            same_cost = abs(new.cost - gone.cost) <= _SAME_COST * gone.cost
            if gone not in keep and new not in exclude and new not in chosen and same_cost:
                found = tuple(c for c in part.candidates if (c in chosen and c is not gone) or c is new)
                if not any(demand.missing(found) for demand in part.demands):
                    yield found
