"""Joint torques that act later than the log says: a command or reading of some time before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from torchid.errors import LogError
from torchid.logs.log import BoolArray, FloatArray, Log
from torchid.logs.timeline import LONGEST_STEP, spline_derivatives


def with_delayed_torques(log: Log, delay: float) -> Log:
    """A log whose joint torques are those that were recorded a `delay` [s] before; after, if it is negative.

    Samples at the ends, for which nothing was recorded then, are left out.

    Raises:
        LogError: none is left.
    """
    if not delay or log.joint_torque is None:
        return log
    torque, kept = np.empty_like(log.joint_torque), recorded_at_delays(log.time, (delay,))
    if not kept.any():
        found = f"{log.time[-1] - log.time[0]:.3g} s, no longer than actuators.delay of {delay:g} s"
        raise LogError(log.source, "time", found, "a longer log")
    for stretch in stretches(log.time):
        at = stretch.start + np.flatnonzero(kept[stretch])
        if len(at):
            torque[at] = _between(log.time[stretch], log.joint_torque[stretch], log.time[at] - delay)
    chosen = np.flatnonzero(kept)
    whole = slice(int(chosen[0]), int(chosen[-1]) + 1)
    return replace(log, joint_torque=torque).select(whole if kept[whole].all() else chosen)


def recorded_at_delays(time: FloatArray, delays: tuple[float, ...]) -> BoolArray:
    """Stamps (N,) [s] that are, by each of some delays [s], within what was recorded without a break, (N,)."""
    kept = np.zeros(len(time), dtype=bool)
    for stretch in stretches(time):
        own = time[stretch]
        kept[stretch] = np.all([(own - delay >= own[0]) & (own - delay <= own[-1]) for delay in delays], axis=0)
    return kept


def stretches(time: FloatArray) -> Iterator[slice]:
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
