"""Samples near the moments at which contacts come and go: impacts and slip are no rigid-body dynamics."""

from __future__ import annotations

import numpy as np

from torchid.errors import LogError
from torchid.logs.fields import BoolArray, FloatArray
from torchid.logs.log import Log
from torchid.logs.timeline import JITTER


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
