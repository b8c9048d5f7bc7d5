"""Spikes and lasting steps of one channel.

A step from one sample to the next is a jump where it leaves what its neighbours span by more than `THRESHOLD` times the
local spread. The neighbours are lines through the `SIDE` steps on either side, continued to the step and at their
middle, in time or in samples, whichever is further. The spread is the largest of the median absolute deviation from
these lines and that of second differences over `BLOCK` samples, both scaled to standard deviations of a normal
distribution, and the quantum. So motion that begins, ends or turns is no jump, nor is noise of up to 17 standard
deviations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.hygiene.neighbours import NORMAL, beside, block_spread, median_known
from torchid.logs.fields import FloatArray

#: Spreads that a step must exceed. Laplacian noise, whose tails are heavy, does so once in 10^7 samples.
THRESHOLD = 12.0
SIDE = 10
BLOCK = 128
#: Longest run of samples off the track that counts as a spike.
LONGEST_SPIKE = 5
#: Share of a jump that may be left when what jumped has come back, at once or after having moved on.
_LEFT, _LEFT_LATER = 0.3, 0.5
#: Share of the threshold that is enough for the way back.
_PARTNER = 0.5
#: Share of the channel's range below which differences count as rounding.
_ROUNDING = 1e-9
#: Jumps of one channel after which nobody wants to hear of more.
_MOST = 5000


@dataclass(frozen=True)
class Jump:
    """An excursion of samples `first` to `last` by about `size`, or a lasting step between these two.

    `spreads`: how many local spreads the size is.
    """

    first: int
    last: int
    size: float
    spreads: float
    lasting: bool


def jumps(values: FloatArray, elapsed: FloatArray, piece: NDArray[np.intp], longest: int = LONGEST_SPIKE) -> list[Jump]:
    """Excursions of at most `longest` samples, and lasting steps.

    Args:
        values: (M,).
        elapsed: (M,) time in median steps.
        piece: (M,) of successive samples that each belongs to; between pieces nothing is compared.
        longest: samples after which nothing is taken to have come back.
    """
    kept = np.flatnonzero(np.append(True, np.diff(values) != 0.0))  # what rests or is held counts as one sample
    if len(kept) < SIDE:
        return []
    values, steps, joined = values[kept], np.diff(elapsed[kept]), np.diff(piece[kept]) == 0
    d = np.where(joined, np.diff(values), 0.0)
    second = np.diff(d)
    spread = block_spread(second, BLOCK)
    touched, large = np.zeros(len(d), bool), np.abs(second) > THRESHOLD / 2.0 * spread
    touched[:-1] |= large
    touched[1:] |= large
    suspects = np.flatnonzero(touched & joined)
    around = np.maximum(spread[np.maximum(suspects - 1, 0)], spread[np.minimum(suspects, len(spread) - 1)])
    excess, least = _excess(d, steps, suspects)
    least = np.maximum.reduce([least, around / np.sqrt(3.0), np.full(len(suspects), _quantum(d, values))])
    bad = np.flatnonzero(np.abs(excess) > _PARTNER * THRESHOLD * least)[:_MOST]
    single = [
        Jump(int(kept[i + 1]) - 1, int(kept[i + 1]), float(e), float(abs(e) / s), lasting=True)
        for i, e, s in zip(suspects[bad], excess[bad], least[bad], strict=True)
    ]
    near = [jump for jump in _paired(single, LONGEST_SPIKE, _LEFT) if jump.spreads > THRESHOLD]
    return list(_paired(near, longest, _LEFT_LATER))


def _quantum(d: FloatArray, values: FloatArray) -> float:
    """The smallest step that is no rounding."""
    sizes = np.abs(d)
    sizes = sizes[sizes > _ROUNDING * np.ptp(values)]
    return float(sizes.min()) if len(sizes) else 0.0


def _excess(d: FloatArray, steps: FloatArray, at: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """How far steps leave what their neighbours span, and the spread of the neighbours, (S,) each."""
    spanned, spreads = [], []
    away = np.arange(1.0, SIDE + 1.0)
    pairs = np.triu_indices(SIDE, 1)
    for direction in (-1, 1):
        neighbours = beside(d, at, direction, SIDE)
        slope = median_known((neighbours[:, pairs[1]] - neighbours[:, pairs[0]]) / (away[pairs[1]] - away[pairs[0]]))
        level = median_known(neighbours - slope[:, None] * away)
        spreads.append(NORMAL * median_known(np.abs(neighbours - level[:, None] - slope[:, None] * away)))
        spanned += [level, level + slope * away.mean()]
    hull = np.stack([*spanned, *(one * steps[at] for one in spanned)])
    return d[at] - np.clip(d[at], hull.min(axis=0), hull.max(axis=0)), np.max(spreads, axis=0)


def _paired(found: list[Jump], longest: int, left: float) -> Iterator[Jump]:
    """Lasting steps that cancel within `longest` samples, but for a share `left`, as one excursion."""
    start = 0
    while start < len(found):
        jump, end, least = found[start], start, left
        net, largest = jump.size, abs(jump.size)
        for following in range(start + 1, len(found)) if jump.lasting else ():
            other = found[following]
            if other.last - jump.last > longest:
                break
            if other.lasting:
                net, largest = net + other.size, max(largest, abs(other.size))
                if abs(net) < least * largest:
                    end, least = following, abs(net) / largest if longest <= LONGEST_SPIKE else 0.0
        if end == start:
            yield jump
        else:
            inside = [each for each in found[start : end + 1] if each.lasting]
            size, spreads = (max(abs(getattr(each, name)) for each in inside) for name in ("size", "spreads"))
            yield Jump(jump.last, found[end].first, size, spreads, lasting=False)
            yield from (each for each in found[start : end + 1] if not each.lasting)
        start = end + 1
