"""All sensor sets without a sensor to spare, part by part of the robot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np

from torchid.analysis.candidates import Candidate
from torchid.analysis.demands import Demand, connected, orthonormal
from torchid.errors import SensorError
from torchid.parameters import Array
from torchid.problem.threads import one_thread

_MEMORY = 2**22  # numbers in one batch of the enumeration


@dataclass(frozen=True)
class Component:
    """Demands that compete for the same candidates: a part of the problem that can be solved on its own."""

    demands: tuple[Demand, ...]
    candidates: tuple[Candidate, ...]


def components(demands: Sequence[Demand], candidates: Sequence[Candidate]) -> list[Component]:
    """Independent parts. A candidate in none of them is never needed."""
    acting = [demand.vectors.keys() & set(candidates) for demand in demands]
    return [
        Component(
            tuple(demands[place] for place in places),
            tuple(c for c in candidates if any(c in acting[place] for place in places)),
        )
        for places in connected(acting)
    ]


@one_thread()
def all_minimal_sets(
    demands: Sequence[Demand],
    candidates: Sequence[Candidate],
    keep: Iterable[Candidate] = (),
    exclude: Iterable[Candidate] = (),
    limit: int = 14,
) -> list[tuple[Candidate, ...]] | None:
    """Every sufficient set that would not suffice without any one of its candidates (but the kept ones).

    Meant for the demands and candidates of one `Component`: the sets of a robot are all unions of one set of each.

    Args:
        demands: to be met.
        candidates: to choose from.
        keep: in every set.
        exclude: in none.
        limit: the most candidates to enumerate the sets of.

    Returns:
        The sets by size; None if more than `limit` candidates are open.

    Raises:
        SensorError: as `usable_candidates`.
    """
    kept, usable = usable_candidates(demands, candidates, keep, exclude)
    free = [c for c in usable if c not in kept]
    if len(free) > limit:
        return None
    numbers = np.arange(2 ** len(free))
    member = (numbers[:, None] >> np.arange(len(free))) & 1 == 1  # (sets, candidates)
    size = member.sum(1)
    sufficient, found = np.zeros(len(numbers), dtype=bool), []
    for count in range(len(free) + 1):
        same = numbers[size == count]
        for bit in range(len(free)):  # a sufficient set with one more candidate is sufficient, and not minimal
            sufficient[same] |= sufficient[same & ~(1 << bit)]
        same = same[~sufficient[same]]
        sufficient[same] = _sufficient(demands, free, kept, member[same])
        found += [frozenset(free[k] for k in np.flatnonzero(member[s])) | kept for s in same[sufficient[same]]]
    return [tuple(c for c in candidates if c in chosen) for chosen in found]


def usable_candidates(
    demands: Sequence[Demand], candidates: Sequence[Candidate], keep: Iterable[Candidate], exclude: Iterable[Candidate]
) -> tuple[frozenset[Candidate], tuple[Candidate, ...]]:
    """The kept candidates and all that are not excluded, once these are known to suffice.

    Raises:
        SensorError: they do not suffice, or one is both kept and excluded.
    """
    kept, excluded = frozenset(keep), frozenset(exclude)
    for both in kept & excluded:
        raise SensorError("sensors", "keep", f"'{both.name}', which is also excluded", "one or the other")
    usable = tuple(c for c in candidates if c not in excluded)
    lacking = [
        f"{short} of {demand.target.shape[1]} dimensions of {' + '.join(demand.frames)}"
        for demand in demands
        if (short := demand.missing(usable))
    ]
    if lacking:
        found = f"all of them leave {'; '.join(lacking)} unseen"
        raise SensorError(
            "sensors", "candidates", found, "more candidates: joints on the way there, contact components"
        )
    return kept, usable


def _sufficient(
    demands: Sequence[Demand], free: Sequence[Candidate], kept: AbstractSet[Candidate], member: Array
) -> Array:
    """Which sets meet every demand, (N,) bool, for membership (N, len(free)) of candidates beside the kept ones."""
    result = np.ones(len(member), dtype=bool)
    for demand in demands:
        ours = [k for k, c in enumerate(free) if c in demand.vectors]
        owner = np.repeat(ours, [demand.vectors[free[k]].shape[1] for k in ours]).astype(int)
        always, vectors = demand.stacked(kept), demand.stacked(free)
        for some in np.array_split(np.flatnonzero(result), 1 + len(member) * vectors.size // _MEMORY):
            masked = vectors * member[some][:, None, owner]
            fixed = np.broadcast_to(always, (len(some), *always.shape))
            basis = orthonormal(np.concatenate([fixed, masked], axis=2))
            result[some] = demand.unreached(basis) == 0
    return result
