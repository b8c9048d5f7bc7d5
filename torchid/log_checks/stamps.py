"""Time stamps, and samples that were not measured or cannot have been."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.errors import format_count, join_names
from torchid.log_checks.findings import (
    CONDEMNED,
    LONG_STEP,
    NO_SIGNALS,
    NOTE,
    SUSPICIOUS,
    Finding,
    Span,
    channel_names,
    find_spans,
)
from torchid.logs import Log
from torchid.logs.log import NAN_ALLOWED, WRENCHES, BoolArray, FloatArray
from torchid.logs.preprocess import lacks_derivatives
from torchid.logs.timeline import FEWEST_DIFFERENTIATED, LONGEST_STEP, SHORTEST_STEP

# --------------------------------------------------------------------------------------------------------------- values

#: Share of NaN above which a channel counts as one that was not recorded, and not as one with holes.
MOSTLY_THERE = 0.2
#: Size in any unit that no quantity of a robot has: uninitialised memory, or an overflow.
ABSURD = 1e12


def check_magnitudes(log: Log) -> Iterator[Finding]:
    """Findings about values larger than any quantity of a robot."""
    for field in log.arrays():
        if field in NO_SIGNALS:
            continue
        values: FloatArray = getattr(log, field)
        flat = values.reshape(len(log), -1)
        with np.errstate(invalid="ignore"):
            bad = np.abs(flat) > ABSURD
        if not bad.any():
            continue
        names = channel_names(log, field)
        columns = np.flatnonzero(bad.any(axis=0))
        channels = tuple(names[column] for column in columns)
        text = f"{join_names(channels)}: beyond {ABSURD:g}, in {format_count(int(bad.any(axis=1).sum()), 'sample')}"
        rare = bad.any(axis=1).mean() <= MOSTLY_THERE
        spans = tuple(span for column in columns for span in find_spans(bad[:, column], names[column])) if rare else ()
        yield Finding("absurd", CONDEMNED, field, text, "look for uninitialised memory or an overflow", channels, spans)


def check_missing_values(log: Log) -> Iterator[Finding]:
    """Findings about NaN; of a contact, while it is active. Motion has to be known throughout, a force has not."""
    for field in log.arrays():
        if field not in NO_SIGNALS:
            yield from _missing(log, field)


def _missing(log: Log, field: str) -> Iterator[Finding]:
    array: FloatArray = getattr(log, field)
    names = channel_names(log, field)
    nan = np.isnan(array)
    if field in WRENCHES and log.contact_active is not None:
        nan = nan & log.contact_active[..., None]
        relevant = np.repeat(log.contact_active.sum(axis=0), array.shape[2])
    else:
        relevant = np.full(len(names), len(log))
    nan = nan.reshape(len(log), -1)
    counts = nan.sum(axis=0)
    holes: dict[str, tuple[int, float]] = {}
    gone: dict[str, tuple[int, float]] = {}
    for column in np.flatnonzero(counts):
        share = counts[column] / relevant[column]
        (holes if share <= MOSTLY_THERE else gone)[names[column]] = (int(column), share)
    if holes:
        spans: tuple[Span, ...] = tuple(
            span for name, (column, _) in holes.items() for span in find_spans(nan[:, column], name)
        )
        shares = ", ".join(f"{name} {100 * share:.2g} %" for name, (_, share) in list(holes.items())[:4])
        text = f"NaN in {format_count(len(holes), 'channel')}, {format_count(len(spans), 'time')}: {shares}"
        if field in NAN_ALLOWED:
            advice = "leave these samples out; a filter would lose the channels throughout"
        else:
            advice = "leave these samples out (exclude_condemned): motion must be known throughout"
        yield Finding("not measured", CONDEMNED, field, text, advice, tuple(holes), spans)
    if gone:
        entire = all(share == 1.0 for _, share in gone.values())
        how = "throughout" if entire else f"in {100 * max(share for _, share in gone.values()):.3g} % at most"
        needed = field not in NAN_ALLOWED
        if needed:
            advice = "record it throughout, or leave the field out if something else gives this motion"
        else:
            advice = "none, as long as it is not among the sensors" if entire else "leave it out of the sensors"
        severity = CONDEMNED if needed else NOTE
        yield Finding("not measured", severity, field, f"{join_names(list(gone))}: NaN {how}", advice, tuple(gone))


# ---------------------------------------------------------------------------------------------------------- time stamps

#: A median step [s] above which accelerations cannot be derived: robots move at 0.5 to 5 Hz.
SLOWEST_STEP = 0.5
#: Units that stamps are mistaken in, by how many there are in a second.
_TICKS = {"ms": 1e3, "us": 1e6, "ns": 1e9}
#: Jitter, in median steps, that is not reported: 1e-3 of a step at 1 rad/s and 1 kHz is 1e-6 rad.
WORTH_A_NOTE = 1e-3
#: Deviations of a step, in rms deviations, by which samples are chosen to ask whether the motion follows the stamps.
_STRONG = 3.0
#: Share of the misfit against the stamps below which positions that were taken as uniform in time fit better.
_BETTER = 0.5


def check_time_stamps(log: Log) -> Iterator[Finding]:
    """Findings about `time`."""
    if len(log) < FEWEST_DIFFERENTIATED and lacks_derivatives(log):
        text = f"{format_count(len(log), 'sample')}: velocities and accelerations cannot be derived"
        advice = f"record {FEWEST_DIFFERENTIATED} samples or more, or give every velocity and acceleration"
        yield Finding("too short", CONDEMNED, "time", text, advice)
    if len(log) < 3:
        return
    steps = np.diff(log.time)
    median = float(np.median(steps))
    if median > SLOWEST_STEP:
        yield _slow(median)
    long, short = steps > LONG_STEP * median, steps < SHORTEST_STEP * median
    deviation = (steps - median)[~long] / median
    rms = float(np.sqrt(np.mean(np.square(deviation))))
    if rms > WORTH_A_NOTE:
        yield _jitter(log, steps / median, rms, float(np.max(np.abs(deviation))), long)
    if long.any():
        yield _gaps(steps, median, long)
    if short.any():
        where = np.flatnonzero(short)
        first = int(where[0])
        below = f"{format_count(len(where), 'step')} below {SHORTEST_STEP:g} of the median"
        text = f"{below}, the first of {steps[first]:.3g} s after sample {first}: noise is multiplied there"
        spans = tuple(Span(int(i) + 1, int(i) + 1) for i in where)
        yield Finding("coincident stamps", CONDEMNED, "time", text, "drop one sample of each pair", spans=spans)


def _slow(median: float) -> Finding:
    likely = [unit for unit, ticks in _TICKS.items() if median / ticks <= SLOWEST_STEP]
    guess = f"; are these {likely[0]}? Then {_TICKS[likely[0]] / median:.4g} Hz" if likely else ""
    return Finding("unit", CONDEMNED, "time", f"median step {median:.4g} s{guess}", "convert the stamps to seconds")


def _jitter(log: Log, steps: FloatArray, rms: float, largest: float, long: BoolArray) -> Finding:
    found = f"rms {100 * rms:.2g} % of the median step, at most {100 * largest:.2g} %"
    advice = "none: a filter (preprocessing.cutoff_hz) interpolates to a uniform grid"
    if _motion_ignores(log, steps, _STRONG * rms, long):
        found += "; the positions do not follow: the stamps jitter, not the sampling"
        advice = "replace the stamps by uniform ones, at the median rate"
    return Finding("jitter", NOTE, "time", found, advice)


def _motion_ignores(log: Log, steps: FloatArray, strong: float, long: BoolArray) -> bool:
    """Whether joint positions are smoother in the sample number than in the time stamps, where stamps are off most."""
    before, after = steps[:-1], steps[1:]
    where = 1 + np.flatnonzero((np.abs(before - after) > strong) & ~long[:-1] & ~long[1:])
    if len(where) < 10:  # too few to judge
        return False
    ahead, behind = (log.joint_position[where + k] - log.joint_position[where] for k in (1, -1))
    left, right = steps[where - 1, None], steps[where, None]
    by_number = np.abs(ahead + behind)
    by_stamp = np.abs(2.0 * (ahead * left + behind * right) / (left + right))
    return bool(by_number.sum() < _BETTER * by_stamp.sum())


def _gaps(steps: FloatArray, median: float, long: BoolArray) -> Finding:
    where, longest = np.flatnonzero(long), int(np.argmax(steps))
    lost = int(np.round(steps[where] / median - 1.0).sum())
    missing = f"{format_count(len(where), 'gap')}, {format_count(lost, 'sample')} missing"
    found = f"{missing}; longest {steps[longest]:.4g} s after sample {longest}"
    if steps[longest] > LONGEST_STEP * median:
        advice = f"split the log after sample {longest}: no spline is drawn across more than {LONGEST_STEP:g} steps"
        return Finding("gap", CONDEMNED, "time", found, advice)
    advice = f"keep preprocessing.cutoff_hz well below {0.5 / steps[longest]:.3g}: half a period fits in the gap then"
    return Finding("gap", SUSPICIOUS, "time", found, advice, spans=tuple(Span(int(i), int(i) + 1) for i in where))
