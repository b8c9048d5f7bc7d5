"""Offsets of contact sensors from their readings in the air, as equations of a fit or subtracted before it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchid.errors import LogError, warn
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, POINTS, WRENCHES, FloatArray
from torchid.logs.preprocess import UNLOADED_MARGIN_S, find_unloaded
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.rounding import MAD_PER_STD
from torchid.sensing import Contact

LEAST_READINGS = 16
"""Least number of readings in the air for an equation."""

_BATCHES = 8  # batches of successive readings, whose means show drift
_MASKED_SHARE = 0.01  # readings are masked or clamped if more than this fraction is exactly 0 ...
_ONE_SIDED = 0.05  # ... and less than this fraction has one of the signs (otherwise 0 is a step of a coarse sensor)
_OUTLYING = 4.0  # standard deviations; of Gaussian readings 6e-5 are dropped


@dataclass(frozen=True)
class UnloadedOffsetEquation:
    """Equation for the unknown offset of a contact sensor, from its readings in the air.

    In the air the sensor measures its offset and the weight of the parts beyond it.

    Attributes:
        offset: its number among the extras.
        scale: number of the channel's unknown scale; None if the scale is known.
        masked: whether the readings are masked, clamped or missing (exactly 0); there is no equation then.
        mean: of the readings, without outliers [N, N m].
        deviation: standard deviation of the mean [N, N m]: that of independent readings with the stated noise, or more
            if the readings, or their means over longer times, vary more.
    """

    offset: int
    scale: int | None
    masked: bool = False
    mean: float = 0.0
    deviation: float = 1.0

    def row(self, builder: RowBuilder) -> tuple[tuple[int, ...], Tensor]:
        """The whitened equation `o - (s - 1) mean = mean` as a block of one row: its columns, and (1, columns + 1).

        The scale's column has the mean, because the noise of single readings would bias the scale towards 0. The row is
        on the CPU, like the readings in the air.
        """
        first = builder.columns.count
        row = [1.0, self.mean]
        columns: tuple[int, ...] = (first + self.offset,)
        if self.scale is not None:
            columns = (*columns, first + self.scale)
            row = [1.0, -self.mean, self.mean]
        return columns, torch.tensor([row], dtype=builder.tree.ancestors.dtype) / self.deviation


def unloaded_offset_equations(builder: RowBuilder, samples: Samples) -> Iterator[UnloadedOffsetEquation]:
    """Equations of the unknown offsets, from the readings in the air among some samples of a log."""
    if samples.unloaded is None:
        return
    scales = {at: number for number, x in enumerate(builder.extras) if x.what == "scale" for at in x.contacts}
    noise = builder.sensors.noise.wrench_std.tolist()
    for number, extra in enumerate(builder.extras):
        if extra.what != "offset" or extra.contact is None:
            continue
        contact, axis = extra.contact
        y = samples.unloaded[:, contact, axis]
        y = y[torch.isfinite(y)]
        if len(y) < LEAST_READINGS:
            continue
        if _are_masked(len(y), int((y > 0.0).sum()), int((y < 0.0).sum())):
            yield UnloadedOffsetEquation(number, None, masked=True)
        else:
            mean, deviation = _robust_mean(y, noise[axis], samples.oversampling)
            yield UnloadedOffsetEquation(number, scales.get(extra.contact), False, mean, deviation)


def _are_masked(count: ArrayLike, above: ArrayLike, below: ArrayLike) -> NDArray[np.bool_]:
    """Whether readings in the air are masked or clamped: many are exactly 0, and few have one of the signs."""
    zero = np.subtract(np.subtract(count, above), below)
    return (zero > np.multiply(_MASKED_SHARE, count)) & (np.minimum(above, below) < np.multiply(_ONE_SIDED, count))


def _robust_mean(y: Tensor, noise: float, oversampling: float) -> tuple[float, float]:
    """Mean of successive readings (M,) without outliers, and its standard deviation without oversampling."""
    deviation = (y - y.median()).abs()
    y = y[deviation <= _OUTLYING * max(float(deviation.median()) / MAD_PER_STD, noise)]
    batches = y[: len(y) // _BATCHES * _BATCHES].view(_BATCHES, -1).mean(1)
    scatter = max(float(y.var()) / len(y), float(batches.var()) / _BATCHES) / oversampling
    return float(y.mean()), max(noise**2 / len(y), scatter) ** 0.5


_KEY = "preprocessing.zero_in_air"
_FITTED = "sensors.offsets: {contact_force: log, contact_moment: log}"


def zero_in_air(log: Log, contacts: Sequence[Contact]) -> Log:
    """Subtract from each contact sensor channel the mean of its readings in the air.

    In the air means more than `UNLOADED_MARGIN_S` from every sample in which the contact flag is set. Wrenches along
    world axes must be those of force plates, which do not move and have moments about the world's origin.

    Args:
        log: as recorded, with flags.
        contacts: sensors to zero; unmeasured ones are ignored.

    Raises:
        LogError: the log has no contact readings, readings along world axes of moving sensors, or a channel with fewer
            than `LEAST_READINGS` readings in the air.

    Warns:
        TorchidWarning: the subtracted offsets; channels that are masked in the air.
    """
    wrench = log.contact_wrench
    scalar = log.contact_force_normal
    if log.contact_wrench_world is not None and not log.moments_about_world_origin:
        reason = f"{_KEY} needs wrenches in the sensor's frame: along world axes a moving sensor has no constant offset"
        accepted = f"{WRENCHES[0]} or {FORCE_NORMAL}; for force plates {POINTS} or logs.columns.plates"
        raise LogError(log.source, WRENCHES[1], reason, accepted)
    if wrench is None and scalar is None:
        raise LogError(log.source, WRENCHES[0], "missing", f"contact readings for {_KEY}")
    count = len(log.contact_names)
    six = np.zeros((len(log), count, 6)) if wrench is None else wrench
    along = np.zeros((len(log), count)) if scalar is None else scalar
    readings = np.concatenate([six, along[..., None]], axis=2)
    reads = np.nan_to_num(readings).any(axis=0)  # others are, for example, moments of point contacts
    if log.contact_active is None:
        in_the_air = np.zeros(readings.shape[:2], dtype=bool)
    else:
        in_the_air = find_unloaded(log.time, log.contact_active)
    known = in_the_air[..., None] & np.isfinite(readings)
    counts = known.sum(axis=0)
    is_zeroed = reads & np.isin(log.contact_names, [contact.frame for contact in contacts])[:, None]
    for column, component in np.argwhere(is_zeroed):
        _require_readings(log, log.contact_names[column], int(component), int(counts[column, component]))
    values = np.where(known & is_zeroed, readings, 0.0)
    offsets = values.sum(axis=0) / np.maximum(counts, 1)
    is_masked = is_zeroed & _are_masked(counts, (values > 0.0).sum(axis=0), (values < 0.0).sum(axis=0))
    masked = [name for name, channels in zip(log.contact_names, is_masked, strict=True) if channels.any()]
    _warn_of_offsets(log, offsets, masked)
    zeroed: dict[str, Any] = {} if wrench is None else {log.contact_wrench_field: wrench - offsets[:, :6]}
    if scalar is not None:
        zeroed[FORCE_NORMAL] = scalar - offsets[:, 6]
    return dataclasses.replace(log, **zeroed)


def _require_readings(log: Log, frame: str, component: int, count: int) -> None:
    """Raise LogError if a channel has too few readings in the air for a mean."""
    if count < LEAST_READINGS:
        reason = f"{count} readings of {frame} in the air (more than {UNLOADED_MARGIN_S:g} s from contact)"
        accepted = f"at least {LEAST_READINGS} for {_KEY}, or fit the offset: {_FITTED}"
        raise LogError(log.source, FORCE_NORMAL if component == 6 else log.contact_wrench_field, reason, accepted)


def _warn_of_offsets(log: Log, offsets: FloatArray, masked: Sequence[str]) -> None:
    """Warn about subtracted offsets (C, 7), and about contacts with masked readings."""
    units = ((slice(0, 3), "N"), (slice(3, 6), "N m"), (slice(6, 7), "N along the normal"))
    texts = [
        f"{name} {', '.join(f'{x:.3g}' for x in offset[part])} {unit}"
        for name, offset in zip(log.contact_names, offsets, strict=True)
        for part, unit in units
        if offset[part].any()
    ]
    if texts:
        warn(f"{log.source}: {_KEY} subtracted these offsets: {'; '.join(texts)}")
    if masked:
        text = f"readings of {', '.join(masked)} in the air are 0 or clamped, so {_KEY} finds no offset"
        warn(f"{log.source}: {text}. To fit it, set {_FITTED}")
