"""Channels of which parts may not have been measured: joint torques and contact wrenches."""

from __future__ import annotations

import warnings

import numpy as np

from torchid.errors import TorchidWarning
from torchid.logs.checks import check_finite, place
from torchid.logs.fields import WRENCHES, BoolArray, FloatArray, labels_of
from torchid.logs.log import Log
from torchid.logs.timeline import Timeline

#: Channels that are filtered together: as many as make the copies of a long log small against it.
GROUP = 4


def carry_measured(log: Log, name: str, timeline: Timeline) -> FloatArray:
    """The field `name` (N, ...) at the output's stamps (K, ...), filtered like all others.

    A channel that is NaN throughout stays so. A wrench of an inactive contact is 0, whatever the log says. A channel
    with NaN among other values can be neither filtered nor resampled: it becomes NaN throughout, and a TorchidWarning
    names it.
    """
    values: FloatArray = getattr(log, name)
    labels = labels_of(name, log.names)
    check_finite(log.source, name, values, allow_nan=True, labels=labels)
    if timeline.low_pass is None and timeline.output is None:
        return values[timeline.kept]
    flags = log.contact_active if name in WRENCHES else None
    complete, broken = [], []
    for channel in np.ndindex(values.shape[1:]):
        gaps = _gaps(values[(slice(None), *channel)], None if flags is None else flags[:, channel[0]])
        if gaps is None:
            complete.append(channel)
        elif gaps:
            broken.append(f"{place((gaps[0], *channel), labels).partition(', ')[2]} (samples {gaps[0]} to {gaps[1]})")
    if broken:
        message = f"{log.source}: {name}: NaN in part of {', '.join(broken)}: NaN throughout after preprocessing"
        warnings.warn(message, TorchidWarning, stacklevel=3)
    out = np.full((len(timeline.at), *values.shape[1:]), np.nan)
    for start in range(0, len(complete), GROUP):
        columns = (slice(None), *np.transpose(complete[start : start + GROUP]))
        clean = values[columns]
        if flags is not None:
            clean[~flags[:, columns[1]]] = 0.0
        out[columns] = timeline.evaluate(timeline.smooth(clean), (0,))[0]
    return out


def _gaps(column: FloatArray, active: BoolArray | None) -> tuple[int, ...] | None:
    """First and last sample that is NaN though active, () where nothing was measured, None without a gap."""
    nan = np.isnan(column)
    if nan.all():
        return ()
    if active is not None:
        nan &= active
    where = np.flatnonzero(nan)
    if not len(where):
        return None
    measured = len(column) if active is None else np.count_nonzero(active)
    return () if len(where) == measured else (int(where[0]), int(where[-1]))
