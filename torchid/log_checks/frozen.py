"""Sensors that repeat themselves: frozen, saturated, held at a lower rate, or constant."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import format_count, join_names
from torchid.log_checks.findings import (
    CONDEMNED,
    NOTE,
    SUSPICIOUS,
    ChannelGroup,
    Finding,
    Span,
    finite_median,
    neighbours_of,
)
from torchid.logs.log import WRENCHES, BoolArray, FloatArray

#: Samples at the very same extreme value from which on it is a limit and no coincidence.
AT_LIMIT = 5
#: Fields that are zero while a joint rests.
RATES = ("joint_velocity", "joint_acceleration")
#: Fields in which a driver may set small readings to zero.
DEAD_BANDS = (*RATES, "joint_torque", "ft_wrench", *WRENCHES)


@dataclass(frozen=True, eq=False)
class Runs:
    """Runs of repeats by the steps that they cover: `first`, `last` (R,), both included."""

    first: NDArray[np.intp]
    last: NDArray[np.intp]

    @classmethod
    def of_repeats(cls, repeated: BoolArray) -> Runs:
        """Of steps (M - 1,) that repeat the value before."""
        edges = np.diff(np.concatenate([[False], repeated, [False]]).astype(np.int8))
        return cls(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1)

    def __len__(self) -> int:
        return len(self.first)

    @property
    def lengths(self) -> NDArray[np.intp]:
        """Number of repeats in each."""
        return self.last - self.first + 1

    def select(self, chosen: BoolArray) -> Runs:
        """Some of the runs."""
        return Runs(self.first[chosen], self.last[chosen])

    def mask(self, steps: int) -> BoolArray:
        """Which of so many steps they cover."""
        edges = np.zeros(steps + 1, np.intp)
        np.add.at(edges, self.first, 1)
        np.add.at(edges, self.last + 1, -1)
        return np.asarray(np.cumsum(edges[:-1]) > 0)


_Stuck = list[tuple[str, Runs]]


def check_repeats(groups: Iterable[ChannelGroup]) -> Iterator[Finding]:
    """Findings about frozen, held, saturated and constant channels."""
    given = tuple(groups)
    positions = next((group for group in given if group.field == "joint_position"), None)
    for group in given:
        steps = np.diff(group.values, axis=0)
        constant = (steps == 0.0).all(axis=0)
        if constant.any():
            yield from _constant(group, constant)
        if constant.all():
            continue
        rests = _at_rest(group, steps, positions)
        together = ((steps == 0.0) & ~rests)[:, ~constant].all(axis=1) & group.joined
        if every := _mean_hold(group.values[:, ~constant], together):
            yield _held(group, [(name, every) for name in group.names])
            continue
        moving = group.values[:, ~constant]
        runs = _implausible_runs(moving, together)
        if group.field in DEAD_BANDS:
            runs = runs.select(~_in_dead_band(moving, runs))
        if len(runs):
            what = f"all {len(group.names)} channels" if len(group.names) > 1 else group.names[0]
            yield _frozen(group, what, [(name, runs) for name in group.names], len(runs))
        if len(group.names) > 1:
            repeated = (steps == 0.0) & ~rests & (group.joined & ~runs.mask(len(steps)))[:, None]
            yield from _by_channel(group, repeated, np.flatnonzero(~constant))


def _at_rest(group: ChannelGroup, steps: FloatArray, positions: ChannelGroup | None) -> BoolArray:
    """Which steps (M - 1, c) of joint velocities or accelerations are those of a joint that does not move."""
    if positions is None or group.field not in RATES or not np.isin(group.samples, positions.samples).all():
        return np.zeros(steps.shape, bool)
    columns = [positions.names.index(name) for name in group.names]
    position = positions.values[np.searchsorted(positions.samples, group.samples)][:, columns]
    return np.asarray((steps == 0.0) & (group.values[1:] == 0.0) & (np.diff(position, axis=0) == 0.0))


def _by_channel(group: ChannelGroup, all_repeated: BoolArray, columns: np.ndarray) -> Iterator[Finding]:
    """Channels that repeat by themselves, of steps (M - 1, c)."""
    stuck: _Stuck = []
    dead: list[tuple[str, float, float]] = []
    limits: list[tuple[str, Runs, float]] = []
    every = {column: _mean_hold(group.values[:, [column]], all_repeated[:, column]) for column in columns}
    for column in (column for column in columns if not every[column]):
        repeated = all_repeated[:, column]
        name, values = group.names[column], group.values[:, column]
        runs = _implausible_runs(values[:, None], repeated)
        zeros = values[runs.first] == 0.0
        quiet = _in_dead_band(values[:, None], runs)
        if group.field in DEAD_BANDS and quiet.any() and 2 * quiet.sum() >= zeros.sum():
            dead.append((name, float(np.abs(values[values != 0.0]).min()), 100.0 * float(np.mean(values == 0.0))))
            runs = runs.select(~zeros)
        for extreme in (values.min(), values.max()):
            at_limit = Runs.of_repeats(repeated & (values[1:] == extreme))
            if (values[runs.first] == extreme).any() and at_limit.lengths.sum() >= AT_LIMIT:
                limits.append((name, at_limit, float(extreme)))
                runs = runs.select(values[runs.first] != extreme)
        if len(runs):
            stuck.append((name, runs))
    if stuck:
        yield _frozen(group, join_names([name for name, _ in stuck]), stuck, sum(len(runs) for _, runs in stuck))
    if dead:
        each = [f"{name} below {least:.3g} {group.unit} ({share:.2g} % of it)" for name, least, share in dead]
        advice = "switch the dead band off; a velocity may be left out, and is derived then"
        names = tuple(name for name, _, _ in dead)
        yield Finding("dead band", SUSPICIOUS, group.field, f"reads 0: {join_names(each)}", advice, names)
    if limits:
        yield _saturated(group, limits)
    if any(every.values()):
        yield _held(group, [(group.names[column], each) for column, each in every.items() if each])


def _spans(group: ChannelGroup, channel: str, runs: Runs, skip: int = 1) -> Iterator[Span]:
    """Samples that repeat the one before; with it for a `skip` of 0."""
    for first, last in zip(runs.first, runs.last, strict=True):
        yield Span(int(group.samples[first + skip]), int(group.samples[last + 1]), channel)


def _frozen(group: ChannelGroup, what: str, stuck: _Stuck, count: int) -> Finding:
    spans = tuple(span for name, runs in stuck for span in _spans(group, name, runs))
    longest = max(spans, key=len)
    times = f"{format_count(len(longest), 'sample')} at {longest}"
    if count > 1:
        times = f"{count} times, the longest {times}"
    whose = f"{group.name}, " if group.name else ""
    text = f"{whose}{what}: repeated to the last bit amid motion, {times}"
    advice = "leave these samples out; look for lost messages or a stalled driver"
    return Finding("frozen", CONDEMNED, group.field, text, advice, tuple(name for name, _ in stuck), spans)


def _saturated(group: ChannelGroup, limits: list[tuple[str, Runs, float]]) -> Finding:
    spans = tuple(span for name, runs, _ in limits for span in _spans(group, name, runs, 0))
    names = tuple(dict.fromkeys(name for name, _, _ in limits))
    shares = [(name, extreme, 100.0 * np.mean(group.values == extreme, axis=0)) for name, _, extreme in limits]
    text = "stays at an extreme value: " + join_names(
        [f"{name} at {at:.4g} {group.unit} in {share[group.names.index(name)]:.2g} %" for name, at, share in shares]
    )
    if group.field == "joint_position":  # on a stop, or on the bound of an inverse kinematics: it may be right there
        advice = "none if these are the joints' stops; else widen the bounds of the encoder or inverse kinematics"
        return Finding("saturated", SUSPICIOUS, group.field, text, advice, names, spans)
    advice = "leave these samples out, or raise the sensor's range"
    return Finding("saturated", CONDEMNED, group.field, text, advice, names, spans)


def _held(group: ChannelGroup, held: list[tuple[str, float]]) -> Finding:
    every = max(each for _, each in held)
    names = tuple(name for name, _ in held)
    whose = f"{join_names(names)}: " if len(names) < len(group.names) else ""
    text = (
        f"{whose}new values only every {every:.3g} samples, repeated in between: "
        f"{0.5 * (every - 1):.2g} samples late on average"
    )
    advice = f"record at one rate, or set preprocessing.cutoff_hz below {0.25 / every:.2g} of the sample rate"
    return Finding("held", SUSPICIOUS, group.field, text, advice, names)


def _constant(group: ChannelGroup, constant: BoolArray) -> Iterator[Finding]:
    names = tuple(name for name, still in zip(group.names, constant, strict=True) if still)
    zero = not group.values[0][constant].any()
    if zero and group.field in WRENCHES:  # what a point contact cannot exert
        return
    text = f"{join_names(names)}: {'0' if zero else 'one value'} throughout"
    if zero and group.field == "joint_torque":
        advice = "write NaN if they were not measured: zeros are fitted as measured torques"
        yield Finding("constant", SUSPICIOUS, group.field, text, advice, names)
    else:
        yield Finding("constant", NOTE, group.field, text, "none if that is so: what does not move adds nothing", names)


# ------------------------------------------------------------------------------------------- repeats that are no chance

#: Logarithm (base 10) of the probability below which a run of repeats is no chance: none in a million samples.
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
#: Runs of repeats beyond which none is judged: coarse channels repeat all the time.
_MOST_RUNS = 20000


def _mean_hold(values: FloatArray, repeated: BoolArray) -> float:
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
    quanta = np.array([_estimate_resolution(column) for column in values.T])
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


def _estimate_resolution(values: FloatArray) -> float:
    """Quantum of the grid that the steps of a channel (M,) lie on; 0 if they lie on none, inf if they are too few."""
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


def _implausible_runs(values: FloatArray, repeated: BoolArray) -> Runs:
    """Runs of repeats (M - 1,) in values (M, c), all channels at once, that are neither chance nor rest."""
    runs = Runs.of_repeats(repeated)
    if not 0 < len(runs) <= _MOST_RUNS:
        return runs.select(np.zeros(len(runs), bool))
    sizes = np.abs(np.diff(values, axis=0))
    sides = [
        neighbours_of(sizes, runs.first, -1, NEIGHBOURS),
        neighbours_of(sizes, runs.last, 1, NEIGHBOURS),
    ]  # (R, k, c)
    typical = finite_median(np.concatenate(sides, axis=1))
    quanta = np.array([_estimate_resolution(column) for column in values.T])
    finest = np.maximum(_finest(sides, ROUNDING * np.abs(values).max(axis=0)), quanta)
    moving = np.ones(len(runs), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        one = np.where(typical > _GRAINS * finest, 0.5 * finest / typical, 1.0)
        chance = runs.lengths * np.log10(one).sum(axis=1)
        for side in sides:
            at_end = np.isnan(side[:, 0]).all(axis=1)
            moving &= at_end | (_pace(side) >= _MOVING)
    return runs.select((chance < CHANCE) & moving)


def _in_dead_band(values: FloatArray, runs: Runs) -> BoolArray:
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
    usual = finite_median(side)
    noisy = finite_median(np.abs(np.diff(side, axis=1))) > 0.5 * usual
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
