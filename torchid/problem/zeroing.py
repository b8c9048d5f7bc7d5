"""Contact sensors whose readings are zeroed in the air, as one does by hand before a recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from torchid.errors import LogError, warn
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, POINTS, WRENCHES, FloatArray
from torchid.logs.preprocess import UNLOADED_MARGIN_S, unloaded_readings
from torchid.problem.unloaded_offsets import LEAST_READINGS, is_masked
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
    if log.contact_wrench_world is not None and not log.moments_about_world_origin:
        found = f"given with {KEY}, though no offset is constant along the world's axes of a sensor that moves"
        accepted = f"{WRENCHES[0]} or {FORCE_NORMAL}; of force plates {POINTS}, or logs.columns.plates"
        raise LogError(log.source, WRENCHES[1], found, accepted)
    if wrench is None and scalar is None:
        raise LogError(log.source, WRENCHES[0], "missing", f"readings of contacts, which {KEY} is for")
    in_the_air = unloaded_readings(log)
    offsets, masked = np.zeros((len(log.contact_names), 7)), list[str]()
    for contact in contacts:
        if contact.frame not in log.contact_names:
            continue
        column = log.contact_names.index(contact.frame)
        for component in range(7):
            read = _channel(log, column, component)
            if read is None or not np.nan_to_num(read).any():  # such as moments of points
                continue
            air = np.zeros(0) if in_the_air is None else in_the_air[:, column, component]
            air = air[np.isfinite(air)]
            _require_readings(log, contact.frame, component, len(air))
            offsets[column, component] = air.mean()
            if is_masked(torch.from_numpy(air)) and contact.frame not in masked:
                masked.append(contact.frame)
    _say(log, offsets, masked)
    zeroed: dict[str, Any] = {} if wrench is None else {field: wrench - offsets[:, :6]}
    if scalar is not None:
        zeroed[FORCE_NORMAL] = scalar - offsets[:, 6]
    return dataclasses.replace(log, **zeroed)


def _channel(log: Log, column: int, component: int) -> FloatArray | None:
    """Readings (N,) of one of six components of a wrench, or of the force along the normal, the seventh."""
    if component == 6:
        return None if log.contact_force_normal is None else log.contact_force_normal[:, column]
    return None if log.contact_wrench is None else log.contact_wrench[:, column, component]


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
