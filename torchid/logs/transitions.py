"""Samples near the moments at which contacts come and go, and those far from any: what sensors read in the air."""

from __future__ import annotations

import numpy as np

from torchid.errors import LogError
from torchid.logs.fields import BoolArray, FloatArray
from torchid.logs.log import Log
from torchid.logs.timeline import JITTER

#: How far from its contact [s] a sensor counts as unloaded. Flags come from thresholds of 20 to 50 N: a foot carries
#: that much for some 10 ms before and after, and a sensor rings about as long when it lands.
UNLOADED_MARGIN_S = 0.05


def near_contact_changes(log: Log, time: FloatArray, margin: float) -> BoolArray:
    """Which of some stamps lie within a margin of a change of contact.

    Args:
        log: as recorded; a change lies between two of its samples.
        time: (K,) [s].
        margin: [s] before the last sample of the old and after the first of the new contact state.
    """
    near = np.zeros(len(time), dtype=bool)
    if log.contact_active is None:
        return near
    changes = np.flatnonzero((log.contact_active[1:] != log.contact_active[:-1]).any(axis=1))
    if len(changes):
        margin += JITTER * float(np.median(np.diff(log.time)))  # a stamp at the margin is within, however it rounds
    first = np.searchsorted(time, log.time[changes] - margin)
    last = np.searchsorted(time, log.time[changes + 1] + margin, side="right")
    for start, stop in zip(first, last, strict=True):
        near[start:stop] = True
    return near


def away_from_changes(log: Log, time: FloatArray, margin: float) -> BoolArray | None:
    """Which of some stamps are not `near_contact_changes`, None for all.

    Raises:
        LogError: none is.
    """
    near = near_contact_changes(log, time, margin)
    if near.all():
        found = f"no sample further than {margin:g} s from a change of contact"
        raise LogError(log.source, "contact_active", found, "a smaller preprocessing.contact_margin_s")
    return ~near if near.any() else None


def unloaded(time: FloatArray, active: BoolArray, margin: float = UNLOADED_MARGIN_S) -> BoolArray:
    """Which contacts are further than a margin from every sample in which they touch, (N, C).

    Args:
        time: (N,) [s].
        active: (N, C).
        margin: [s].
    """
    out = np.ones(active.shape, dtype=bool)
    for contact in range(active.shape[1]):
        touching = time[active[:, contact]]
        if len(touching):
            after = np.searchsorted(touching, time)
            since = np.abs(time - touching[np.maximum(after - 1, 0)])
            until = np.abs(touching[np.minimum(after, len(touching) - 1)] - time)
            out[:, contact] = np.minimum(since, until) > margin
    return out


def unloaded_readings(log: Log, where: BoolArray | None = None) -> FloatArray | None:
    """What the sensors of contacts read while nothing touches, (N, C, 6), NaN elsewhere; None if there is none.

    Args:
        log: as recorded.
        where: (N, C), from `unloaded`, of a part of a log; the result is an array then, whatever it holds.
    """
    if log.contact_unloaded is not None:
        return log.contact_unloaded
    wrench = log.contact_wrench_local if log.contact_wrench_world is None else log.contact_wrench_world
    if wrench is None or log.contact_active is None:
        return None
    chosen = unloaded(log.time, log.contact_active) if where is None else where
    if where is None and not chosen.any():
        return None
    return np.where(chosen[..., None], wrench, np.nan)
