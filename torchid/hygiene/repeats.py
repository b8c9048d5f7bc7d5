"""Runs of samples that repeat the one before to the last bit, and whether that can be chance or rest.

A robot at rest repeats itself as well. Whether a run can be chance follows from its neighbourhood: where a channel
moves by a median |d| from sample to sample on a grid of quantum q, one repeat has a probability of about q / (2 |d|);
for k of them in c channels it is the product. And a robot that comes to rest slows down before. The quantum is that of
the whole channel where its steps lie on a grid, be it one that single precision or a change of units has blurred: the
differences between the smallest steps would be rounding then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.hygiene.neighbours import beside, median_known
from torchid.logs.fields import BoolArray, FloatArray

#: Decades below which a run of repeats is no chance: of a million samples none would repeat like that.
CHANCE = -8.0
#: Steps on either side that a run is compared with.
NEIGHBOURS = 10
#: Quanta per step that a channel must make to count: one that stops on a coarse grid repeats itself before it rests.
_GRAINS = 4.0
#: Share of the speed on one side that the robot must have next to a run: one that stops smoothly is below it. Of a
#: noisy channel, the mean over so many steps counts.
_MOVING, _NEAREST = 0.5, 4
#: Share of repeats above which a channel is taken for one that was recorded at a lower rate and held...
HELD = 0.2
#: ... if this share of the runs has the typical length, give or take one sample.
_REGULAR = 0.8
#: Share of the time in values held longer than so many times the mean from which on a robot rests and starts again.
_RESTING, _LONG = 0.2, 5.0
#: Share of a channel's largest value below which differences are rounding, and the same after single precision.
ROUNDING = 16.0 * float(np.finfo(np.float64).eps)
_SINGLE = 2.0 * float(np.finfo(np.float32).eps)
#: A grid: this share of at least `_STEPS` steps of up to `_QUANTA` quanta is whole to within `_OFF` quanta, where of
#: steps of any size a fifth would be.
_ON_GRID, _STEPS, _QUANTA, _OFF = 0.95, 10, 10.5, 0.1
#: Shares of the steps below which the smallest are looked for.
_SMALLEST = (0.001, 0.005, 0.02)
#: Runs after which nobody can tell chance from design.
_MOST_RUNS = 20000


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of repeats by the steps that they cover: `first`, `last` (R,), both included."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]

    @classmethod
    def of(cls, repeated: BoolArray) -> Runs:
        """Of steps (M - 1,) that repeat the value before."""
        edges = np.diff(np.concatenate([[False], repeated, [False]]).astype(np.int8))
        return cls(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1)

    def __len__(self) -> int:
        return len(self.first)

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Number of repeats in each."""
        return self.last - self.first + 1

    def where(self, chosen: BoolArray) -> Runs:
        """Some of the runs."""
        return Runs(self.first[chosen], self.last[chosen])

    def mask(self, steps: int) -> BoolArray:
        """Which of so many steps they cover."""
        edges = np.zeros(steps + 1, np.intp)
        np.add.at(edges, self.first, 1)
        np.add.at(edges, self.last + 1, -1)
        return np.asarray(np.cumsum(edges[:-1]) > 0)


def held_for(values: FloatArray, repeated: BoolArray) -> float:
    """For how many samples values (M, c) are held on average whose steps (M - 1,) `repeated` all; 0 if they are not.

    Held values repeat at more or less regular times while the robot moves on: the change after a repeat is no single
    quantum, as it is of an encoder that creeps, and most repeats do not lie in long rests.
    """
    if float(np.mean(repeated)) <= HELD:
        return 0.0
    changes = np.flatnonzero(~repeated)
    if len(changes) < NEIGHBOURS:
        return 0.0
    lengths = np.diff(changes)
    quanta = np.array([resolution(column) for column in values.T])
    after = changes[1:][lengths > 1]
    sizes = np.abs(values[after + 1] - values[after])
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.nan_to_num(sizes / quanta, nan=0.0, posinf=np.inf).max(axis=1)
    if np.median(steps) <= _GRAINS:
        return 0.0
    typical = int(np.median(lengths))
    if typical > 1 and float(np.mean(np.abs(lengths - typical) <= 1)) >= _REGULAR:
        return typical
    mean = float(lengths.mean())
    return mean if lengths[lengths > _LONG * mean].sum() <= _RESTING * lengths.sum() else 0.0


def resolution(values: FloatArray) -> float:
    """Quantum of the grid that the steps of a channel (M,) lie on; 0 if they lie on none, inf if too few tell."""
    sizes = np.abs(np.diff(values))
    sizes = sizes[sizes > _SINGLE * np.abs(values).max()]
    if len(sizes) < _STEPS:
        return np.inf
    for least in np.quantile(sizes, _SMALLEST):  # single quanta are rare in a channel that is fast
        quantum = float(np.median(sizes[sizes < 1.5 * least]))
        steps = sizes[sizes < _QUANTA * quantum] / quantum
        if len(steps) >= _STEPS and float(np.mean(np.abs(steps - np.rint(steps)) < _OFF)) >= _ON_GRID:
            return quantum
    return 0.0


def implausible(values: FloatArray, repeated: BoolArray) -> Runs:
    """Runs of repeats (M - 1,) in values (M, c), all channels at once, that are neither chance nor rest."""
    runs = Runs.of(repeated)
    if not 0 < len(runs) <= _MOST_RUNS:
        return runs.where(np.zeros(len(runs), bool))
    sizes = np.abs(np.diff(values, axis=0))
    sides = [beside(sizes, runs.first, -1, NEIGHBOURS), beside(sizes, runs.last, 1, NEIGHBOURS)]  # (R, k, c)
    typical = median_known(np.concatenate(sides, axis=1))
    quanta = np.array([resolution(column) for column in values.T])
    finest = np.maximum(_finest(sides, ROUNDING * np.abs(values).max(axis=0)), quanta)
    moving = np.ones(len(runs), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        one = np.where(typical > _GRAINS * finest, 0.5 * finest / typical, 1.0)
        chance = runs.lengths * np.log10(one).sum(axis=1)
        for side in sides:
            at_end = np.isnan(side[:, 0]).all(axis=1)
            moving &= at_end | (_pace(side) >= _MOVING)
    return runs.where((chance < CHANCE) & moving)


def in_dead_band(values: FloatArray, runs: Runs) -> BoolArray:
    """Which runs (R,) of values (M, c) are of zeros amid the smallest readings that there are.

    A driver that reads 0 below some size goes to 0 and leaves it there; a sensor that is lost does so from any reading.
    """
    size = np.abs(values)
    least = np.where(size > 0.0, size, np.inf).min(axis=0)
    inside = (size[runs.first] == 0.0).all(axis=1)
    for neighbour in (runs.first - 1, runs.last + 2):
        beyond = (neighbour < 0) | (neighbour >= len(size))
        inside &= beyond | (size[np.clip(neighbour, 0, len(size) - 1)] <= 2.0 * least).all(axis=1)
    return np.asarray(inside)


def _pace(side: FloatArray) -> FloatArray:
    """Speed next to runs over that on the same side of them, (R,), of sizes of steps (R, k, c)."""
    usual = median_known(side)
    noisy = median_known(np.abs(np.diff(side, axis=1))) > 0.5 * usual
    nearest = np.where(noisy, side[:, :_NEAREST].mean(axis=1), side[:, 0])
    return _mean_known(np.where(usual > 0.0, nearest / usual, np.nan))


def _finest(sides: list[FloatArray], rounding: FloatArray) -> FloatArray:
    """The smallest difference of values or of steps that is not rounding in the neighbourhood, (R, c)."""
    sizes = np.concatenate([*sides, *(np.abs(np.diff(side, axis=1)) for side in sides)], axis=1)
    least = np.where(sizes > rounding, sizes, np.inf).min(axis=1)  # so written, NaN is none either
    return np.where(np.isfinite(least), least, 0.0)


def _mean_known(values: FloatArray) -> FloatArray:
    """Mean along the last axis over what is a number; 0 where nothing is."""
    known = np.isfinite(values)
    return np.where(known, values, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
