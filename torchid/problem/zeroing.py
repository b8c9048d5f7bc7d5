"""Contact sensors whose readings are zeroed in the air, as one does by hand before a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, warn
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, POINTS, WRENCHES, BoolArray, FloatArray
from torchid.logs.preprocess import UNLOADED_MARGIN_S, unloaded_readings
from torchid.problem.unloaded_offsets import LEAST_READINGS, are_masked
from torchid.sensing import Contact

KEY = "preprocessing.zero_in_air"
_FITTED = "sensors.offsets: {contact_force: log, contact_moment: log}, which are fitted"


def zero_in_air(log: Log, contacts: Sequence[Contact]) -> Log:
    """The log, of whose contact sensors the mean of what each channel reads in the air is subtracted.

    In the air is further than `UNLOADED_MARGIN_S` from every sample in which the contact touches by its flag. Wrenches
    along the world's axes are those of force plates, which do not move in it, and have moments about its origin.

    Args:
        log: as recorded, with flags.
        contacts: whose sensors are zeroed; one that nobody measured is left out.

    Raises:
        LogError: no readings of contacts, or along the world's axes of sensors that move; fewer than `LEAST_READINGS`
            in the air of a channel that has others.

    Warns:
        TorchidWarning: what was subtracted, by contact; channels that are masked in the air.
    """
    field, wrench, scalar = log.contact_wrench_field, log.contact_wrench, log.contact_force_normal
    offsets = offsets_in_the_air(log, contacts, [(log, unloaded_readings(log))])
    zeroed: dict[str, Any] = {} if wrench is None else {field: wrench - offsets[:, :6]}
    if scalar is not None:
        zeroed[FORCE_NORMAL] = scalar - offsets[:, 6]
    return dataclasses.replace(log, **zeroed)


def offsets_in_the_air(
    log: Log, contacts: Sequence[Contact], parts: Iterable[tuple[Log, FloatArray | None]]
) -> FloatArray:
    """What `zero_in_air` subtracts, (C, 7) [N, N m]: components of wrenches, and the force along the normal.

    Args:
        log: any samples of it, which name contacts and fields.
        contacts: as of `zero_in_air`.
        parts: all samples of the log, in order, each part with its `unloaded_readings`.

    Raises:
        LogError: as `zero_in_air`.

    Warns:
        TorchidWarning: likewise.
    """
    if log.contact_wrench_world is not None and not log.moments_about_world_origin:
        found = f"given with {KEY}, though no offset is constant along the world's axes of a sensor that moves"
        accepted = f"{WRENCHES[0]} or {FORCE_NORMAL}; of force plates {POINTS}, or logs.columns.plates"
        raise LogError(log.source, WRENCHES[1], found, accepted)
    if log.contact_wrench is None and log.contact_force_normal is None:
        raise LogError(log.source, WRENCHES[0], "missing", f"readings of contacts, which {KEY} is for")
    air = _Readings.of(len(log.contact_names), parts)
    offsets, masked = np.zeros((len(log.contact_names), 7)), list[str]()
    for contact in contacts:
        if contact.frame not in log.contact_names:
            continue
        column = log.contact_names.index(contact.frame)
        for component in np.flatnonzero(air.reads[column]):  # others are such as moments of points
            count, above, below = (int(x[column, component]) for x in (air.count, air.above, air.below))
            _require_readings(log, contact.frame, int(component), count)
            offsets[column, component] = air.total[column, component] / count
            if are_masked(count, above, below) and contact.frame not in masked:
                masked.append(contact.frame)
    _say(log, offsets, masked)
    return offsets


@dataclasses.dataclass(frozen=True)
class _Readings:
    """What channels of contact sensors, (C, 7) each, read in the air, and whether they ever read anything but 0.

    Attributes:
        reads: those that do, in the air or not.
        count: readings in the air; `above`, `below`: 0 of these.
        total: their sum [N, N m].
    """

    reads: BoolArray
    count: NDArray[np.intp]
    above: NDArray[np.intp]
    below: NDArray[np.intp]
    total: FloatArray

    @classmethod
    def of(cls, contacts: int, parts: Iterable[tuple[Log, FloatArray | None]]) -> _Readings:
        count, above, below = np.zeros((3, contacts, 7), dtype=np.intp)
        out = cls(np.zeros((contacts, 7), dtype=bool), count, above, below, np.zeros((contacts, 7)))
        for log, unloaded in parts:
            if log.contact_wrench is not None:
                out.reads[:, :6] |= np.nan_to_num(log.contact_wrench).any(axis=0)
            if log.contact_force_normal is not None:
                out.reads[:, 6] |= np.nan_to_num(log.contact_force_normal).any(axis=0)
            if unloaded is None:
                continue
            own = slice(unloaded.shape[2])
            finite = np.isfinite(unloaded)
            out.count[:, own] += finite.sum(axis=0)
            out.above[:, own] += (finite & (unloaded > 0.0)).sum(axis=0)
            out.below[:, own] += (finite & (unloaded < 0.0)).sum(axis=0)
            out.total[:, own] += np.where(finite, unloaded, 0.0).sum(axis=0)
        return out


def _require_readings(log: Log, frame: str, component: int, count: int) -> None:
    """Refuse a channel that was read less often in the air than a mean needs."""
    if count < LEAST_READINGS:
        found = f"{count} readings of {frame} in the air, more than {UNLOADED_MARGIN_S:g} s from contact"
        accepted = f"{LEAST_READINGS} or more for {KEY}, or {_FITTED}"
        raise LogError(log.source, FORCE_NORMAL if component == 6 else log.contact_wrench_field, found, accepted)


def _say(log: Log, offsets: FloatArray, masked: Sequence[str]) -> None:
    """Warn of offsets (C, 7) that were subtracted, and of contacts whose readings are masked."""
    units = ((slice(0, 3), "N"), (slice(3, 6), "N m"), (slice(6, 7), "N along the normal"))
    texts = [
        f"{name} {', '.join(f'{x:.3g}' for x in own[part])} {unit}"
        for name, own in zip(log.contact_names, offsets, strict=True)
        for part, unit in units
        if own[part].any()
    ]
    if texts:
        warn(f"{log.source}: {KEY} has subtracted {'; '.join(texts)}")
    if masked:
        text = f"readings of {', '.join(masked)} in the air are 0 or clamped and show no offset"
        warn(f"{log.source}: {KEY}: {text}; {_FITTED}, may find it")
