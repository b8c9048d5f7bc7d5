"""The cheapest sensor set, with a proof that no cheaper one exists.

The cheapest set that obeys some of the inequalities every sufficient set obeys costs no more than the cheapest
sufficient set. If it is not sufficient, the inequalities it violates are added, and so on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp

from torchid.analysis.candidates import Candidate, total_cost
from torchid.analysis.demands import Demand
from torchid.analysis.inequalities import inequalities
from torchid.analysis.least_cost import least_cost
from torchid.analysis.minimal_sets import Component, components, usable_candidates
from torchid.problem.threads import one_thread

_EXACT = 1e-7  # relative; what a solver of integer programs rounds


@dataclass(frozen=True)
class CheapestSet:
    """A sufficient set, by the order of the candidates; `proven` if its cost is `lower_bound`, the least possible."""

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
        demands: from `torchid.analysis.demands.demands`.
        candidates: to choose from.
        keep: in the set, needed or not.
        exclude: not in the set.
        seconds: after these, the best set found is returned with the bound reached, unproven.

    Raises:
        SensorError: as `usable_candidates`.
    """
    kept, usable = usable_candidates(demands, candidates, keep, exclude)
    deadline = time.monotonic() + seconds
    solved = [_cheapest_part(part, kept, deadline) for part in components(demands, usable)]
    chosen = kept.union(*(result.chosen for result in solved))
    beside = total_cost(kept.difference(*(result.chosen for result in solved)))
    return CheapestSet(
        tuple(c for c in candidates if c in chosen),
        total_cost(chosen),
        beside + sum(result.lower_bound for result in solved),
        all(result.proven for result in solved),
    )


def _cheapest_part(part: Component, kept: AbstractSet[Candidate], deadline: float) -> CheapestSet:
    cost = np.array([c.cost for c in part.candidates])
    must = np.array([float(c in kept) for c in part.candidates])
    alone = [least_cost(demand, part.candidates) for demand in part.demands]
    cuts = [row for demand in part.demands for row in inequalities(demand, part.candidates, frozenset())]
    cuts += [
        np.append(cost * [c in d.vectors for c in part.candidates], least.bound)
        for d, least in zip(part.demands, alone, strict=True)
    ]
    guesses = [frozenset(chosen for least in alone for chosen in least.chosen), *(frozenset(a.chosen) for a in alone)]
    best, bound = min((_pruned(part, guess, kept) for guess in guesses), key=total_cost), max(a.bound for a in alone)
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
            row for d in part.demands if d.missing(relaxed) for row in inequalities(d, part.candidates, relaxed)
        ]
        best = min(best, _pruned(part, relaxed, kept), key=total_cost)
        if not violated or total_cost(best) <= bound * (1.0 + _EXACT):
            break
        cuts += violated
    proven = math.isclose(total_cost(best), bound, rel_tol=_EXACT)
    chosen = tuple(c for c in part.candidates if c in best)
    return CheapestSet(chosen, total_cost(best), total_cost(best) if proven else bound, proven)


def _pruned(part: Component, wanted: AbstractSet[Candidate], kept: AbstractSet[Candidate]) -> frozenset[Candidate]:
    """A sufficient set: all candidates, less whatever can be spared, the unwanted and the dear first."""
    chosen = frozenset(part.candidates)
    for candidate in sorted(chosen - kept, key=lambda c: (c in wanted, -c.cost, c.name)):
        fewer = chosen - {candidate}
        if not any(d.missing(fewer) for d in part.demands if candidate in d.vectors):
            chosen = fewer
    return chosen
