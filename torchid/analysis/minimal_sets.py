"""The cheapest sensor set, with a proof that no cheaper one exists, and all sets without a sensor to spare.

The cheapest set that obeys some of the inequalities every sufficient set obeys costs no more than the cheapest
sufficient set. If it is not sufficient, the inequalities it violates are added, and so on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from torchid.analysis.candidates import Candidate
from torchid.analysis.demands import Demand, connected, missing, orthonormal
from torchid.analysis.inequalities import inequalities
from torchid.analysis.least_cost import least_cost
from torchid.errors import SensorError
from torchid.parameters import Array
from torchid.problem.threads import one_thread

Progress = Callable[[int, float, float], None]
"""Called with the inequalities so far, the lower bound and the cost of the best set known, of the part at work."""

_MEMORY = 2**22  # numbers in one batch of the enumeration
_EXACT = 1e-7  # relative; what a solver of integer programs rounds


@dataclass(frozen=True)
class MinimalSet:
    """A sufficient set, by the order of the candidates; `proven` if its cost is `lower_bound`, the least possible."""

    chosen: tuple[Candidate, ...]
    cost: float
    lower_bound: float
    proven: bool


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
def cheapest_set(
    demands: Sequence[Demand],
    candidates: Sequence[Candidate],
    keep: Iterable[Candidate] = (),
    exclude: Iterable[Candidate] = (),
    progress: Progress | None = None,
    seconds: float = 60.0,
) -> MinimalSet:
    """The cheapest set of candidates that meets every demand.

    Args:
        demands: from `torchid.analysis.demands.demands`.
        candidates: to choose from.
        keep: in the set, needed or not.
        exclude: not in the set.
        progress: told after every round of inequalities.
        seconds: after these, the best set found is returned with the bound reached, unproven.

    Raises:
        SensorError: no set of these candidates suffices, or one is both kept and excluded.
    """
    kept, usable = _usable(demands, candidates, keep, exclude)
    deadline = time.monotonic() + seconds
    solved = [_cheapest_part(part, kept, progress, deadline) for part in components(demands, usable)]
    chosen = kept.union(*(result.chosen for result in solved))
    beside = sum(c.cost for c in kept.difference(*(result.chosen for result in solved)))
    return MinimalSet(
        tuple(c for c in candidates if c in chosen),
        sum(c.cost for c in chosen),
        beside + sum(result.lower_bound for result in solved),
        all(result.proven for result in solved),
    )


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
        SensorError: as `cheapest_set`.
    """
    kept, usable = _usable(demands, candidates, keep, exclude)
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


def _usable(
    demands: Sequence[Demand], candidates: Sequence[Candidate], keep: Iterable[Candidate], exclude: Iterable[Candidate]
) -> tuple[frozenset[Candidate], tuple[Candidate, ...]]:
    """The kept candidates and all that are not excluded, once these are known to suffice."""
    kept, excluded = frozenset(keep), frozenset(exclude)
    for both in kept & excluded:
        raise SensorError("sensors", "keep", f"'{both.name}', which is also excluded", "one or the other")
    usable = tuple(c for c in candidates if c not in excluded)
    lacking = [
        f"{short} of {demand.target.shape[1]} dimensions of {' + '.join(demand.frames)}"
        for demand in demands
        if (short := missing(demand, usable))
    ]
    if lacking:
        found, accepted = (
            f"all of them leave {'; '.join(lacking)} unseen",
            "joints on the way there, contact components",
        )
        raise SensorError("sensors", "candidates", found, f"more candidates: {accepted}")
    return kept, usable


def _cheapest_part(
    part: Component, kept: AbstractSet[Candidate], progress: Progress | None, deadline: float
) -> MinimalSet:
    cost = np.array([c.cost for c in part.candidates])
    must = np.array([float(c in kept) for c in part.candidates])
    alone = [least_cost(demand, part.candidates) for demand in part.demands]
    cuts = [row for demand in part.demands for row in inequalities(demand, part.candidates, frozenset())]
    cuts += [
        np.append(cost * [c in d.vectors for c in part.candidates], least.bound)
        for d, least in zip(part.demands, alone, strict=True)
    ]
    guesses = [frozenset(chosen for least in alone for chosen in least.chosen), *(frozenset(a.chosen) for a in alone)]
    best, bound = min((_pruned(part, guess, kept) for guess in guesses), key=_cost), max(a.bound for a in alone)
    while True:
        A = np.unique(np.array(cuts).reshape(-1, len(cost) + 1), axis=0)
        left = max(deadline - time.monotonic(), 0.0)
        solved = milp(
            cost,
            constraints=LinearConstraint(A[:, :-1], A[:, -1], np.inf),
            integrality=np.ones(len(cost)),
            bounds=Bounds(must, 1.0),
            options={"mip_rel_gap": 0.0, "time_limit": left},
        )
        bound = max(bound, solved.mip_dual_bound or 0.0)
        if solved.status != 0:  # out of time
            break
        relaxed = frozenset(c for c, x in zip(part.candidates, solved.x, strict=True) if x > 0.5)
        violated = [
            row for d in part.demands if missing(d, relaxed) for row in inequalities(d, part.candidates, relaxed)
        ]
        best = min(best, _pruned(part, relaxed, kept), key=_cost)
        if progress is not None:
            progress(len(A), bound, _cost(best))
        if not violated or _cost(best) <= bound * (1.0 + _EXACT):
            break
        cuts += violated
    proven = math.isclose(_cost(best), bound, rel_tol=_EXACT)
    chosen = tuple(c for c in part.candidates if c in best)
    return MinimalSet(chosen, _cost(best), _cost(best) if proven else bound, proven)


def _cost(chosen: Iterable[Candidate]) -> float:
    return sum(c.cost for c in chosen)


def _pruned(part: Component, wanted: AbstractSet[Candidate], kept: AbstractSet[Candidate]) -> frozenset[Candidate]:
    """A sufficient set: all candidates, less whatever can be spared, the unwanted and the dear first."""
    chosen = frozenset(part.candidates)
    for candidate in sorted(chosen - kept, key=lambda c: (c in wanted, -c.cost, c.name)):
        fewer = chosen - {candidate}
        if not any(missing(d, fewer) for d in part.demands if candidate in d.vectors):
            chosen = fewer
    return chosen


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
            result[some] = demand.missing(basis) == 0
    return result
