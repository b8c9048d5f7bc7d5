"""Time stamps, missing values, and values that no sensor can have measured."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.errors import format_count, format_percent, join_names
from torchid.log_checks.findings import (
    MIN_GAP_STEPS,
    NON_SIGNAL_FIELDS,
    NOTE,
    REJECTED,
    SUSPICIOUS,
    Finding,
    Span,
    channel_names,
    find_spans,
)
from torchid.logs import Log
from torchid.logs.log import CONTACT_READINGS, NAN_ALLOWED, BoolArray, FloatArray
from torchid.logs.preprocess import lacks_derivatives
from torchid.logs.timeline import FEWEST_DIFFERENTIATED, LONGEST_STEP, SHORTEST_STEP

# --------------------------------------------------------------------------------------------------------------- values

#: Share of NaN up to which a channel has holes; above it, the channel was not recorded.
MAX_MISSING_SHARE = 0.2
#: Size of a value in any unit; larger ones are uninitialised memory or an overflow.
MAX_MAGNITUDE = 1e12


def check_magnitudes(log: Log) -> Iterator[Finding]:
    """Findings about values larger than any quantity of a robot."""
    for field in log.arrays():
        if field in NON_SIGNAL_FIELDS:
            continue
        values: FloatArray = getattr(log, field)
        flat = values.reshape(len(log), -1)
        with np.errstate(invalid="ignore"):
            bad = np.abs(flat) > MAX_MAGNITUDE
        if not bad.any():
            continue
        names = channel_names(log, field)
        columns = np.flatnonzero(bad.any(axis=0))
        channels = tuple(names[column] for column in columns)
        text = (
            f"{join_names(channels)}: beyond {MAX_MAGNITUDE:g}, in {format_count(int(bad.any(axis=1).sum()), 'sample')}"
        )
        rare = bad.any(axis=1).mean() <= MAX_MISSING_SHARE
        spans = tuple(span for column in columns for span in find_spans(bad[:, column], names[column])) if rare else ()
        yield Finding("absurd", REJECTED, field, text, "look for uninitialised memory or an overflow", channels, spans)


def check_missing_values(log: Log) -> Iterator[Finding]:
    """Findings about NaN, in readings of contacts while they touch. Motion must be known throughout, not forces."""
    for field in log.arrays():
        if field not in NON_SIGNAL_FIELDS:
            yield from _missing_findings(log, field)


def _missing_findings(log: Log, field: str) -> Iterator[Finding]:
    array: FloatArray = getattr(log, field)
    names = channel_names(log, field)
    nan = np.isnan(array)
    if field in CONTACT_READINGS and log.contact_active is not None:
        active = log.contact_active.reshape(log.contact_active.shape + (1,) * (array.ndim - 2))
        nan = nan & active
        relevant = np.broadcast_to(active.sum(axis=0), array.shape[1:]).ravel()
    else:
        relevant = np.full(len(names), len(log))
    nan = nan.reshape(len(log), -1)
    counts = nan.sum(axis=0)
    holes: dict[str, tuple[int, float]] = {}
    gone: dict[str, tuple[int, float]] = {}
    for column in np.flatnonzero(counts):
        share = counts[column] / relevant[column]
        (holes if share <= MAX_MISSING_SHARE else gone)[names[column]] = (int(column), share)
    if holes:
        spans: tuple[Span, ...] = tuple(
            span for name, (column, _) in holes.items() for span in find_spans(nan[:, column], name)
        )
        shares = ", ".join(f"{name} {format_percent(share)} %" for name, (_, share) in list(holes.items())[:4])
        text = f"NaN in {format_count(len(holes), 'channel')}, {format_count(len(spans), 'time')}: {shares}"
        if field in NAN_ALLOWED:
            advice = "leave these samples out (exclude_rejected); a filter would lose the channels throughout"
        else:
            advice = "leave these samples out (exclude_rejected): motion must be known throughout"
        yield Finding("not measured", REJECTED, field, text, advice, tuple(holes), spans)
    if gone:
        entire = all(share == 1.0 for _, share in gone.values())
        extent = "throughout" if entire else f"in {100 * max(share for _, share in gone.values()):.3g} % at most"
        needed = field not in NAN_ALLOWED
        if needed:
            advice = "record it throughout, or leave the field out if other fields give this motion"
        else:
            advice = "none, unless it is one of the sensors" if entire else "leave it out of the sensors"
        severity = REJECTED if needed else NOTE
        yield Finding("not measured", severity, field, f"{join_names(list(gone))}: NaN {extent}", advice, tuple(gone))


# ---------------------------------------------------------------------------------------------------------- time stamps

#: Median step above which accelerations cannot be derived: robots move at 0.5 to 5 Hz.
MAX_MEDIAN_STEP_S = 0.5
#: Wrong units of stamps, and their number per second.
_TICKS_PER_S = {"ms": 1e3, "us": 1e6, "ns": 1e9}
#: Rms jitter that is reported: 1e-3 of a step at 1 rad/s and 1 kHz is 1e-6 rad.
MIN_JITTER_STEPS = 1e-3
#: Change of a step, in rms deviations, at which motion and stamps are compared, and the samples that this needs.
_MIN_DEVIATION_RMS, _MIN_COMPARED_SAMPLES = 3.0, 10
#: Residual of positions with uniform stamps over that with the recorded stamps, below which the stamps jitter.
_MAX_STAMP_RESIDUAL_SHARE = 0.5


def check_time_stamps(log: Log) -> Iterator[Finding]:
    """Findings about `time`."""
    if len(log) < FEWEST_DIFFERENTIATED and lacks_derivatives(log):
        text = f"{format_count(len(log), 'sample')}: velocities and accelerations cannot be derived"
        advice = f"record {FEWEST_DIFFERENTIATED} samples or more, or give every velocity and acceleration"
        yield Finding("too short", REJECTED, "time", text, advice)
    if len(log) < 3:
        return
    steps = np.diff(log.time)
    median = float(np.median(steps))
    if median > MAX_MEDIAN_STEP_S:
        yield _unit_finding(median)
    long, short = steps > MIN_GAP_STEPS * median, steps < SHORTEST_STEP * median
    deviation = (steps - median)[~long] / median
    rms = float(np.sqrt(np.mean(np.square(deviation))))
    if rms > MIN_JITTER_STEPS:
        yield _jitter_finding(log, steps / median, rms, float(np.max(np.abs(deviation))), long)
    if long.any():
        yield _gap_finding(steps, median, long)
    if short.any():
        numbers = np.flatnonzero(short)
        first = int(numbers[0])
        below = f"{format_count(len(numbers), 'step')} below {SHORTEST_STEP:g} of the median"
        text = f"{below}, the first of {steps[first]:.3g} s after sample {first}: noise is amplified there"
        spans = tuple(Span(int(i) + 1, int(i) + 1) for i in numbers)
        yield Finding("coincident stamps", REJECTED, "time", text, "drop one sample of each pair", spans=spans)


def _unit_finding(median: float) -> Finding:
    likely = [unit for unit, ticks in _TICKS_PER_S.items() if median / ticks <= MAX_MEDIAN_STEP_S]
    guess = f"; are these {likely[0]}? Then {_TICKS_PER_S[likely[0]] / median:.4g} Hz" if likely else ""
    return Finding("unit", REJECTED, "time", f"median step {median:.4g} s{guess}", "convert the stamps to seconds")


def _jitter_finding(log: Log, steps: FloatArray, rms: float, largest: float, long: BoolArray) -> Finding:
    text = f"rms {format_percent(rms)} % of the median step, at most {format_percent(largest)} %"
    advice = "none: a filter (preprocessing.cutoff_hz) interpolates to a uniform grid"
    if _is_uniformly_sampled(log, steps, _MIN_DEVIATION_RMS * rms, long):
        text += "; the positions do not follow: the stamps jitter, not the sampling"
        advice = "replace the stamps by uniform ones, at the median rate"
    return Finding("jitter", NOTE, "time", text, advice)


def _is_uniformly_sampled(log: Log, steps: FloatArray, deviation: float, long: BoolArray) -> bool:
    """Whether joint positions are smoother by sample number than by time stamp, where steps change by `deviation`."""
    before, after = steps[:-1], steps[1:]
    numbers = 1 + np.flatnonzero((np.abs(before - after) > deviation) & ~long[:-1] & ~long[1:])
    if len(numbers) < _MIN_COMPARED_SAMPLES:
        return False
    ahead, behind = (log.joint_position[numbers + k] - log.joint_position[numbers] for k in (1, -1))
    left, right = steps[numbers - 1, None], steps[numbers, None]
    by_number = np.abs(ahead + behind)
    by_stamp = np.abs(2.0 * (ahead * left + behind * right) / (left + right))
    return bool(by_number.sum() < _MAX_STAMP_RESIDUAL_SHARE * by_stamp.sum())


def _gap_finding(steps: FloatArray, median: float, long: BoolArray) -> Finding:
    numbers, longest = np.flatnonzero(long), int(np.argmax(steps))
    lost = int(np.round(steps[numbers] / median - 1.0).sum())
    missing = f"{format_count(len(numbers), 'gap')}, {format_count(lost, 'sample')} missing"
    text = f"{missing}; longest {steps[longest]:.4g} s after sample {longest}"
    if steps[longest] > LONGEST_STEP * median:
        advice = f"split the log after sample {longest}: no spline crosses more than {LONGEST_STEP:g} steps"
        return Finding("gap", REJECTED, "time", text, advice)
    advice = f"keep preprocessing.cutoff_hz well below {0.5 / steps[longest]:.3g}: half a period fits in the gap then"
    return Finding("gap", SUSPICIOUS, "time", text, advice, spans=tuple(Span(int(i), int(i) + 1) for i in numbers))
