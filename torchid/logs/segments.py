"""Segments of a log without a break, and joint torques that act later than recorded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from torchid.errors import LogError
from torchid.logs.log import BoolArray, FloatArray, Log
from torchid.logs.low_pass import DROPPED_PERIODS
from torchid.logs.timeline import FEWEST_DIFFERENTIATED, LONGEST_STEP, Timeline, spline_derivatives


def long_segments(time: FloatArray, segments: Sequence[slice], whole: Timeline) -> list[slice]:
    """The segments that are long enough for the filter and for derivatives; LogError if none is.

    Args:
        time: stamps of the log as recorded (N,) [s].
        segments: of its samples.
        whole: what its timeline would be without gaps.
    """
    usable = [segment for segment in segments if _is_long_enough(time, segment, whole)]
    if not usable:
        longest = max((time[x.stop - 1] - time[x.start] for x in segments), default=0.0)
        cutoff_hz = whole.cutoff_hz
        needed = f"more than {2.0 * DROPPED_PERIODS / cutoff_hz:.3g} s" if cutoff_hz else "more samples"
        reason = f"segments of at most {longest:.3g} s without a gap"
        raise LogError.at_field("time", reason, f"{needed} (both ends are dropped), or a higher cutoff_hz")
    return usable


def count_samples(segments: Sequence[slice]) -> int:
    """How many samples segments have together."""
    return sum(segment.stop - segment.start for segment in segments)


def _is_long_enough(time: FloatArray, segment: slice, whole: Timeline) -> bool:
    """Whether two samples or more of a segment are left, and two of those that it is resampled to."""
    count = segment.stop - segment.start
    if count <= FEWEST_DIFFERENTIATED:
        return False
    if whole.low_pass is None or whole.cutoff_hz is None:
        return True
    step = float(np.median(np.diff(time)))
    kept_s = time[segment.stop - 1] - time[segment.start] - 2.0 * DROPPED_PERIODS / whole.cutoff_hz
    wanted = step * (whole.kept.step or 1) if whole.output is None else float(np.median(np.diff(whole.output)))
    return bool(kept_s > 2.0 * max(step, wanted) and count > 2 * whole.low_pass.padding)


def with_delayed_torques(log: Log, delay: float) -> Log:
    """A log whose joint torques are those that were recorded a `delay` [s] before; after, if it is negative.

    Samples at the ends, for which nothing was recorded then, are left out.

    Raises:
        LogError: none is left.
    """
    return log if not delay or log.joint_torque is None else with_delayed(log, delay, {"joint_torque": slice(None)})


def with_delayed(log: Log, delay: float | FloatArray, channels: Mapping[str, slice]) -> Log:
    """As `with_delayed_torques`, of some channels of fields, along their second axis; delays may be by sample (N,).

    Raises:
        LogError: no sample is left.
    """
    delays = np.broadcast_to(np.asarray(delay, float), len(log))
    kept = recorded_at_delays(log.time, (delays,))
    if not kept.any():
        longest = delays[np.argmax(np.abs(delays))]
        reason = f"{log.time[-1] - log.time[0]:.3g} s, not longer than actuators.delay ({longest:g} s)"
        raise LogError(log.source, "time", reason, "a longer log")
    moved: dict[str, Any] = {name: values.copy() for name, values in log.arrays().items() if name in channels}
    for segment in unbroken_segments(log.time):
        at = segment.start + np.flatnonzero(kept[segment])
        for name, chosen in channels.items() if len(at) else ():
            if name in moved:
                recorded = np.asarray(log.arrays()[name][segment, chosen], float)
                between = _between(log.time[segment], recorded.reshape(len(recorded), -1), log.time[at] - delays[at])
                moved[name][at, chosen] = between.reshape(len(at), *recorded.shape[1:])
    if (quat := moved.get("base_quat_xyzw")) is not None:
        moved["base_quat_xyzw"] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    index = np.flatnonzero(kept)
    whole = slice(int(index[0]), int(index[-1]) + 1)
    return replace(log, **moved).select(whole if kept[whole].all() else index)


def recorded_at_delays(time: FloatArray, delays: Sequence[float | FloatArray]) -> BoolArray:
    """Stamps (N,) [s] that are, by each of some delays [s] or (N,), within what was recorded without a break, (N,)."""
    kept = np.zeros(len(time), dtype=bool)
    for segment in unbroken_segments(time):
        stamps = time[segment]
        earlier = [stamps - (delay[segment] if isinstance(delay, np.ndarray) else delay) for delay in delays]
        kept[segment] = np.all([(at >= stamps[0]) & (at <= stamps[-1]) for at in earlier], axis=0)
    return kept


def unbroken_segments(time: FloatArray) -> Iterator[slice]:
    """Samples without a longer step than a spline is drawn across."""
    steps = np.diff(time)
    ends = np.flatnonzero(steps > LONGEST_STEP * np.median(steps)) + 1 if len(steps) else np.zeros(0, dtype=int)
    for start, stop in zip([0, *ends], [*ends, len(time)], strict=True):
        yield slice(int(start), int(stop))


def _between(time: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """Channels (N, n) between their samples, (K, n), by a quintic spline; NaN beside a value that is not known."""
    out = np.empty((len(at), values.shape[1]))
    known = np.isfinite(values).all(axis=0)
    out[:, known] = spline_derivatives(time, values[:, known], at, (0,))[0] if len(time) > 1 else values[:, known]
    for column in np.flatnonzero(~known):
        out[:, column] = np.interp(at, time, values[:, column])
    return out
