"""Linear inequalities that every sufficient sensor set obeys.

Let F be a set of candidates that leaves d(F) > 0 dimensions of a demand's target unreached, and w_j(F) the dimensions
that candidate j adds to F's span. Whatever else is chosen must reach the rest, so with x_j = 1 for chosen candidates

    sum over j outside F of min(w_j(F), d(F)) x_j  >=  d(F).

A set that is not sufficient violates the inequality of its own F; together they describe the sufficient sets.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from collections.abc import Set as AbstractSet

import numpy as np

from torchid.analysis.candidates import Candidate
from torchid.analysis.demands import Demand, orthonormal
from torchid.parameters import Array


def inequalities(demand: Demand, candidates: Sequence[Candidate], chosen: AbstractSet[Candidate]) -> Iterator[Array]:
    """Some that a set violates which does not meet the demand.

    Each F is `chosen`, enlarged while it leaves as much of the target unreached: fewer and smaller weights for the same
    right-hand side. Enlarging first by what does not act on one of the contacts finds what that contact needs.

    Yields:
        Rows (n + 1,): weights of the n candidates, then the right-hand side.
    """
    ours = [c for c in candidates if c in demand.vectors]
    start = orthonormal(demand.stacked(c for c in ours if c in chosen))
    short = int(demand.unreached(start))
    for contact in demand.contacts:
        rows = np.array(demand.rows) == contact
        there = {c for c in ours if demand.vectors[c][rows].any()}
        for order in (ours, ours[::-1]):
            basis = start
            for candidate in sorted(order, key=lambda c: c in there):
                wider = orthonormal(np.hstack([basis, demand.vectors[candidate]]))
                if demand.unreached(wider) == short:
                    basis = wider
            gains = demand.gains(basis)
            weights = [0 if c in chosen else min(gains.get(c, 0), short) for c in candidates]
            yield np.array([*weights, short], dtype=float)
