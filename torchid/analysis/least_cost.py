"""A lower bound on the cost of meeting one demand alone; exact unless the count of combinations forbids it.

Rank inequalities are weak where contacts share joints: for two hands on a rail, reached through a waist, they leave a
gap that branching closes in minutes only. Modulo the target of d dimensions, a sufficient set of independent vectors
has d fewer dimensions than vectors. The vectors within a g-dimensional space modulo the target, a *flat*, hold a
sufficient set if d + g of them are independent; then the cheapest is their cheapest basis. Flats are few: every one of
dimension g is spanned by g of the vectors.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, combinations, islice

import numpy as np

from torchid.analysis.candidates import Candidate, total_cost
from torchid.analysis.demands import TOLERANCE, Demand, orthonormal, outside, spanning
from torchid.parameters import Array

_DEVICES, _COMBINATIONS, _BATCH = 5, 100_000, 4096


@dataclass(frozen=True)
class LeastCost:
    """No set that meets the demand costs less than `bound`; `chosen`, the best set found, costs that if it is exact."""

    bound: float
    chosen: tuple[Candidate, ...]


def least_cost(demand: Demand, candidates: Sequence[Candidate]) -> LeastCost:
    """The cheapest of the candidates that meet one demand, which they can; without a set if there are too many.

    Sensors of several components are taken or left in all ways; the rest is a choice among single vectors.
    """
    ours = [c for c in candidates if c in demand.vectors]
    devices = [c for c in ours if demand.vectors[c].shape[1] > 1]
    single = sorted((c for c in ours if c not in devices), key=lambda c: c.cost)
    if len(devices) > _DEVICES:
        return LeastCost(0.0, ())
    cost, best = np.array([c.cost for c in single]), LeastCost(math.inf, ())
    for taken in chain.from_iterable(combinations(devices, count) for count in range(len(devices) + 1)):
        basis = orthonormal(demand.stacked(taken))
        target, vectors = outside(demand.target, basis), outside(demand.stacked(single), basis)
        bound, places = _least_of_vectors(spanning(target), vectors, cost)
        bound += total_cost(taken)
        if bound < best.bound:
            best = LeastCost(bound, (*taken, *(single[k] for k in places)))
    return best


def _least_of_vectors(target: Array, vectors: Array, cost: Array) -> tuple[float, Sequence[int]]:
    """Bound and places of the choice among vectors (k, N), by ascending cost (N,), that spans a target (k, d)."""
    d, length = target.shape[1], np.linalg.norm(vectors, axis=0)
    if d == 0:
        return 0.0, ()
    places = np.flatnonzero(length > TOLERANCE)
    vectors, cost = vectors[:, places] / length[places], cost[places]
    rest = outside(vectors, target)
    length = np.linalg.norm(rest, axis=0)
    inside = length <= TOLERANCE
    rest = (spanning(rest).T @ rest) / np.where(inside, 1.0, length)  # (dimensions modulo the target, N)
    best, chosen, budget = math.inf, np.zeros(0, dtype=int), _COMBINATIONS
    for g in range(len(rest) + 1):
        floor = float(cost[: d + g].sum()) if d + g <= len(cost) else math.inf
        budget -= math.comb(int((~inside).sum()), g) if g < len(rest) else 1
        if floor >= best or budget < 0:
            return min(best, floor), places[chosen].tolist()
        for flat in _flats(rest, inside, g, d + g):
            basis = _cheapest_basis(vectors, flat)
            if len(basis) == d + g and cost[basis].sum() < best:
                best, chosen = float(cost[basis].sum()), np.array(basis)
    return best, places[chosen].tolist()


def _flats(rest: Array, inside: np.ndarray, g: int, least: int) -> Iterator[np.ndarray]:
    """Members (N,) bool of flats of dimension g that have at least so many."""
    if g == len(rest):
        yield np.ones(rest.shape[1], dtype=bool)
        return
    generators = combinations(np.flatnonzero(~inside).tolist(), g)
    while some := list(islice(generators, _BATCH)):
        picked = np.array(some, dtype=int).reshape(len(some), g)
        basis = orthonormal(rest[:, picked].transpose(1, 0, 2))  # (some, dimensions, g)
        member = (np.linalg.norm(outside(rest, basis), axis=1) <= TOLERANCE) | inside
        yield from np.unique(member[member.sum(1) >= least], axis=0)


def _cheapest_basis(vectors: Array, flat: np.ndarray) -> list[int]:
    """Places of independent vectors among the members (N,) bool of a flat, the first ones first."""
    basis, chosen = np.zeros((len(vectors), 0)), []
    for place in np.flatnonzero(flat).tolist():
        left = outside(vectors[:, [place]], basis)
        length = np.linalg.norm(left)
        if length > TOLERANCE:
            basis = np.hstack([basis, left / length])
            chosen.append(place)
    return chosen
