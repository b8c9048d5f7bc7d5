"""The cheapest sensor set, with a proof that no cheaper one exists, and all minimal sets."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from itertools import chain, combinations, islice

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from torchid.errors import SensorError
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.sensor_planning.observability import (
    SPAN_TOLERANCE,
    Candidate,
    Demand,
    connected_groups,
    orthogonal_part,
    orthonormal_basis,
    span_basis,
    total_cost,
)

_DEVICES = 5
_COMBINATIONS = 100_000
_BATCH = 4096
_MEMORY = 2**22  # numbers in one batch of the enumeration
_MOST_FREE = 14  # candidates of which all sets are enumerated
_EXACT = 1e-7  # relative accuracy of the integer program


@dataclass(frozen=True)
class CheapestSet:
    """A sufficient set, in the order of the candidates; `proven` if its cost is `lower_bound`, the least possible."""

    chosen: tuple[Candidate, ...]
    cost: float
    lower_bound: float
    proven: bool


@one_thread()
def cheapest_set(
    demands: Sequence[Demand],
    candidates: Sequence[Candidate],
    keep: Iterable[Candidate] = (),
    exclude: Iterable[Candidate] = (),
    seconds: float = 60.0,
) -> CheapestSet:
    """The cheapest set of candidates that meets every demand.

    Args:
        demands: from `torchid.sensor_planning.observability.demands`.
        candidates: to choose from.
        keep: in the set, needed or not.
        exclude: not in the set.
        seconds: time limit, after which the best known set is returned, unproven.

    Raises:
        SensorError: as `_usable_candidates`.
    """
    kept, usable = _usable_candidates(demands, candidates, keep, exclude)
    deadline = time.monotonic() + seconds
    solved = [_cheapest_part(part, kept, deadline) for part in demand_groups(demands, usable)]
    chosen = kept.union(*(result.chosen for result in solved))
    beside = total_cost(kept.difference(*(result.chosen for result in solved)))
    cost = total_cost(chosen)
    return CheapestSet(
        tuple(c for c in candidates if c in chosen),
        cost,
        min(cost, beside + sum(result.lower_bound for result in solved)),  # as sums in another order round otherwise
        all(result.proven for result in solved),
    )


@one_thread()
def all_minimal_sets(
    demands: Sequence[Demand],
    candidates: Sequence[Candidate],
    keep: Iterable[Candidate] = (),
    exclude: Iterable[Candidate] = (),
) -> list[tuple[Candidate, ...]] | None:
    """Every minimal sufficient set: one that does not suffice without any one of its candidates, except kept ones.

    Use it for the demands and candidates of one `DemandGroup`. The minimal sets of a robot are all unions of one set of
    each group.

    Args:
        demands: to be met.
        candidates: to choose from.
        keep: in every set.
        exclude: in no set.

    Returns:
        The sets by size; None for more than `_MOST_FREE` candidates that are not kept.

    Raises:
        SensorError: as `_usable_candidates`.
    """
    kept, usable = _usable_candidates(demands, candidates, keep, exclude)
    free = [c for c in usable if c not in kept]
    if len(free) > _MOST_FREE:
        return None
    numbers = np.arange(2 ** len(free))
    member = (numbers[:, None] >> np.arange(len(free))) & 1 == 1  # (sets, candidates)
    size = member.sum(1)
    sufficient = np.zeros(len(numbers), dtype=bool)
    minimal = []
    for count in range(len(free) + 1):
        same = numbers[size == count]
        for bit in range(len(free)):  # a sufficient set with one more candidate is sufficient, and not minimal
            sufficient[same] |= sufficient[same & ~(1 << bit)]
        same = same[~sufficient[same]]
        sufficient[same] = _sufficient(demands, free, kept, member[same])
        minimal += [frozenset(free[k] for k in np.flatnonzero(member[s])) | kept for s in same[sufficient[same]]]
    return [tuple(c for c in candidates if c in chosen) for chosen in minimal]


def _usable_candidates(
    demands: Sequence[Demand], candidates: Sequence[Candidate], keep: Iterable[Candidate], exclude: Iterable[Candidate]
) -> tuple[frozenset[Candidate], tuple[Candidate, ...]]:
    """The kept candidates, and all that are not excluded, after a check that these suffice.

    Raises:
        SensorError: they do not suffice, or a candidate is both kept and excluded.
    """
    kept = frozenset(keep)
    excluded = frozenset(exclude)
    for contradiction in kept & excluded:
        raise SensorError("sensors", "keep", f"'{contradiction.name}' is also in exclude", "one of the two")
    usable = tuple(c for c in candidates if c not in excluded)
    lacking = [
        f"{missing} of {demand.target.shape[1]} dimensions of {' + '.join(demand.frames)}"
        for demand in demands
        if (missing := demand.missing(usable))
    ]
    if lacking:
        reason = f"all together do not determine {'; '.join(lacking)}"
        accepted = "more candidates: contact components, or joints between the base and the contact"
        raise SensorError("sensors", "candidates", reason, accepted)
    return kept, usable


@dataclass(frozen=True)
class DemandGroup:
    """Demands with common candidates: an independent part of the problem."""

    demands: tuple[Demand, ...]
    candidates: tuple[Candidate, ...]


def demand_groups(demands: Sequence[Demand], candidates: Sequence[Candidate]) -> list[DemandGroup]:
    """Independent parts of the problem. A candidate in none of them is never needed."""
    acting = [demand.vectors.keys() & set(candidates) for demand in demands]
    return [
        DemandGroup(
            tuple(demands[index] for index in indices),
            tuple(c for c in candidates if any(c in acting[index] for index in indices)),
        )
        for indices in connected_groups(acting)
    ]


@dataclass(frozen=True)
class CostBound:
    """Lower bound of the cost of any set that meets a demand; `chosen` is the best known set, which may cost more."""

    bound: float
    chosen: tuple[Candidate, ...]


def bound_cost(demand: Demand, candidates: Sequence[Candidate]) -> CostBound:
    """The cheapest candidates that meet one demand, which all together meet; no set if there are too many.

    All subsets of the sensors with several components are enumerated; the rest is a choice among single vectors.
    """
    acting = [c for c in candidates if c in demand.vectors]
    devices = [c for c in acting if demand.vectors[c].shape[1] > 1]
    single = sorted((c for c in acting if c not in devices), key=lambda c: c.cost)
    if len(devices) > _DEVICES:
        return CostBound(0.0, ())
    cost = np.array([c.cost for c in single])
    best = CostBound(math.inf, ())
    for taken in chain.from_iterable(combinations(devices, count) for count in range(len(devices) + 1)):
        basis = orthonormal_basis(demand.stacked(taken))
        target = orthogonal_part(demand.target, basis)
        vectors = orthogonal_part(demand.stacked(single), basis)
        bound, indices = _cheapest_vectors(span_basis(target), vectors, cost)
        bound += total_cost(taken)
        if bound < best.bound:
            best = CostBound(bound, (*taken, *(single[k] for k in indices)))
    return best


def inequalities(demand: Demand, candidates: Sequence[Candidate], chosen: AbstractSet[Candidate]) -> Iterator[Array]:
    """Valid inequalities on sets that meet the demand; `chosen`, which does not meet it, violates them.

    Each comes from a set F: `chosen`, enlarged as long as the number of missing dimensions does not change. This gives
    fewer and smaller weights for the same right-hand side. Candidates that do not act on one of the contacts come
    first, so the inequality concerns that contact.

    Yields:
        Rows (n + 1,): weights of the n candidates, then the right-hand side.
    """
    acting = [c for c in candidates if c in demand.vectors]
    start = orthonormal_basis(demand.stacked(c for c in acting if c in chosen))
    missing = int(demand.unreached(start))
    for contact in demand.contacts:
        rows = np.array(demand.rows) == contact
        there = {c for c in acting if demand.vectors[c][rows].any()}
        for order in (acting, acting[::-1]):
            basis = start
            for candidate in sorted(order, key=lambda c: c in there):
                wider = orthonormal_basis(np.hstack([basis, demand.vectors[candidate]]))
                if demand.unreached(wider) == missing:
                    basis = wider
            gains = demand.gains(basis)
            weights = [0 if c in chosen else min(gains.get(c, 0), missing) for c in candidates]
            yield np.array([*weights, missing], dtype=float)


def _cheapest_part(part: DemandGroup, kept: AbstractSet[Candidate], deadline: float) -> CheapestSet:
    cost = np.array([c.cost for c in part.candidates])
    must = np.array([float(c in kept) for c in part.candidates])
    alone = [bound_cost(demand, part.candidates) for demand in part.demands]
    cuts = [row for demand in part.demands for row in inequalities(demand, part.candidates, frozenset())]
    cuts += [
        np.append(cost * [c in d.vectors for c in part.candidates], least.bound)
        for d, least in zip(part.demands, alone, strict=True)
    ]
    guesses = [frozenset(chosen for least in alone for chosen in least.chosen), *(frozenset(a.chosen) for a in alone)]
    best = min((_pruned(part, guess, kept) for guess in guesses), key=total_cost)
    bound = max(a.bound for a in alone)
    while True:
        A = np.unique(np.array(cuts).reshape(-1, len(cost) + 1), axis=0)
        seconds_left = max(deadline - time.monotonic(), 0.0)
        solved = milp(
            cost,
            constraints=LinearConstraint(A[:, :-1], A[:, -1], np.inf),
            integrality=np.ones(len(cost)),
            bounds=Bounds(must, 1.0),
            options={"mip_rel_gap": 0.0, "time_limit": seconds_left},
        )
        bound = max(bound, solved.mip_dual_bound or 0.0)
        if solved.status != 0:  # out of time
            break
        relaxed = frozenset(c for c, x in zip(part.candidates, solved.x, strict=True) if x > 0.5)
        violated = [
            row for d in part.demands if d.missing(relaxed) for row in inequalities(d, part.candidates, relaxed)
        ]
        best = min(best, _pruned(part, relaxed, kept), key=total_cost)
        if not violated or total_cost(best) <= bound * (1.0 + _EXACT):
            break
        cuts += violated
    proven = math.isclose(total_cost(best), bound, rel_tol=_EXACT)
    chosen = tuple(c for c in part.candidates if c in best)
    return CheapestSet(chosen, total_cost(best), total_cost(best) if proven else bound, proven)


def _pruned(part: DemandGroup, preferred: AbstractSet[Candidate], kept: AbstractSet[Candidate]) -> frozenset[Candidate]:
    """A sufficient set: redundant candidates are removed, those not preferred first, then the most expensive."""
    chosen = frozenset(part.candidates)
    for candidate in sorted(chosen - kept, key=lambda c: (c in preferred, -c.cost, c.name)):
        fewer = chosen - {candidate}
        if not any(d.missing(fewer) for d in part.demands if candidate in d.vectors):
            chosen = fewer
    return chosen


def _sufficient(
    demands: Sequence[Demand], free: Sequence[Candidate], kept: AbstractSet[Candidate], member: Array
) -> Array:
    """Which sets meet every demand, (N,) bool, for membership (N, len(free)) of candidates beside the kept ones."""
    result = np.ones(len(member), dtype=bool)
    for demand in demands:
        acting = [k for k, c in enumerate(free) if c in demand.vectors]
        owner = np.repeat(acting, [demand.vectors[free[k]].shape[1] for k in acting]).astype(int)
        always = demand.stacked(kept)
        vectors = demand.stacked(free)
        for batch in np.array_split(np.flatnonzero(result), 1 + len(member) * vectors.size // _MEMORY):
            masked = vectors * member[batch][:, None, owner]
            fixed = np.broadcast_to(always, (len(batch), *always.shape))
            basis = orthonormal_basis(np.concatenate([fixed, masked], axis=2))
            result[batch] = demand.unreached(basis) == 0
    return result


def _cheapest_vectors(target: Array, vectors: Array, cost: Array) -> tuple[float, Sequence[int]]:
    """Bound and indices of the cheapest vectors, of (k, N) by ascending cost (N,), that span a target (k, d)."""
    d = target.shape[1]
    length = np.linalg.norm(vectors, axis=0)
    if d == 0:
        return 0.0, ()
    indices = np.flatnonzero(length > SPAN_TOLERANCE)
    vectors = vectors[:, indices] / length[indices]
    cost = cost[indices]
    outside = orthogonal_part(vectors, target)
    length = np.linalg.norm(outside, axis=0)
    inside = length <= SPAN_TOLERANCE
    outside = (span_basis(outside).T @ outside) / np.where(inside, 1.0, length)  # (dimensions modulo the target, N)
    best = math.inf
    chosen = np.zeros(0, dtype=int)
    budget = _COMBINATIONS
    for g in range(len(outside) + 1):
        floor = float(cost[: d + g].sum()) if d + g <= len(cost) else math.inf
        budget -= math.comb(int((~inside).sum()), g) if g < len(outside) else 1
        if floor >= best or budget < 0:
            return min(best, floor), indices[chosen].tolist()
        for flat in _flats(outside, inside, g, d + g):
            basis = _cheapest_basis(vectors, flat)
            if len(basis) == d + g and cost[basis].sum() < best:
                best = float(cost[basis].sum())
                chosen = np.array(basis)
    return best, indices[chosen].tolist()


def _flats(outside: Array, inside: np.ndarray, g: int, least: int) -> Iterator[np.ndarray]:
    """Members (N,) bool of flats of dimension g with at least `least` members."""
    if g == len(outside):
        yield np.ones(outside.shape[1], dtype=bool)
        return
    generators = combinations(np.flatnonzero(~inside).tolist(), g)
    while batch := list(islice(generators, _BATCH)):
        picked = np.array(batch, dtype=int).reshape(len(batch), g)
        basis = orthonormal_basis(outside[:, picked].transpose(1, 0, 2))  # (batch, dimensions, g)
        member = (np.linalg.norm(orthogonal_part(outside, basis), axis=1) <= SPAN_TOLERANCE) | inside
        yield from np.unique(member[member.sum(1) >= least], axis=0)


def _cheapest_basis(vectors: Array, flat: np.ndarray) -> list[int]:
    """Indices of independent vectors among the members (N,) bool of a flat, chosen greedily."""
    basis = np.zeros((len(vectors), 0))
    chosen = []
    for index in np.flatnonzero(flat).tolist():
        residual = orthogonal_part(vectors[:, [index]], basis)
        length = np.linalg.norm(residual)
        if length > SPAN_TOLERANCE:
            basis = np.hstack([basis, residual / length])
            chosen.append(index)
    return chosen
