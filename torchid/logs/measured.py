"""Channels of which parts may not have been measured: joint torques and contact wrenches."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import TorchidWarning
from torchid.logs.checks import check_finite, place
from torchid.logs.fields import WRENCHES, BoolArray, FloatArray, labels_of
from torchid.logs.log import Log
from torchid.logs.timeline import Timeline

#: Channels that are filtered together: as many as make the copies of a long log small against it.
GROUP = 4


@dataclass
class Coverage:
    """Which channels of a field were measured throughout, gathered block by block.

    Of every channel: `measurable`, samples in which there is something to measure (all, or those in contact);
    `missing`, those of them that are NaN, from the `first` to the `last`; `values`, samples with a value.
    """

    samples: int
    measurable: NDArray[np.intp]
    missing: NDArray[np.intp]
    values: NDArray[np.intp]
    first: NDArray[np.intp]
    last: NDArray[np.intp]

    @classmethod
    def of(cls, channels: tuple[int, ...]) -> Coverage:
        """Of no samples yet."""
        return cls(0, *(np.zeros(channels, dtype=np.intp) for _ in range(5)))

    def add(self, values: FloatArray, active: BoolArray | None) -> None:
        """Add samples (N, ...) of the field; `active`: (N, C) of a wrench's contacts."""
        nan = np.isnan(values)
        self.values += len(values) - nan.sum(axis=0)
        self.measurable += len(values) if active is None else active.sum(axis=0)[:, None]
        if active is not None:
            nan &= active[..., None]
        count = nan.sum(axis=0)
        new = (count > 0) & (self.missing == 0)
        self.first[new] = self.samples + np.argmax(nan, axis=0)[new]
        self.last[count > 0] = self.samples + (len(nan) - 1 - np.argmax(nan[::-1], axis=0))[count > 0]
        self.missing += count
        self.samples += len(values)

    @property
    def complete(self) -> BoolArray:
        """Channels with a value wherever there is something to measure, unless there are none at all."""
        return np.asarray((self.missing == 0) & (self.values > 0))

    @property
    def broken(self) -> BoolArray:
        """Channels with a value in some samples and NaN in others."""
        return np.asarray((self.missing > 0) & (self.missing < self.measurable) & (self.values > 0))


def check_coverage(log: Log, name: str, coverage: Coverage) -> None:
    """Warn of channels that become NaN throughout because they are NaN in some samples.

    Warns:
        TorchidWarning: names them.
    """
    labels = labels_of(name, log.names)
    broken = [
        f"{place((0, *channel), labels).partition(', ')[2]}"
        f" (samples {coverage.first[channel]} to {coverage.last[channel]})"
        for channel in map(tuple, np.argwhere(coverage.broken).tolist())
    ]
    if broken:
        message = f"{log.source}: {name}: NaN in part of {', '.join(broken)}: NaN throughout after preprocessing"
        warnings.warn(message, TorchidWarning, stacklevel=3)


def coverage_of(log: Log, name: str) -> Coverage:
    """Coverage of the field `name` of a log."""
    values: FloatArray = getattr(log, name)
    found = Coverage.of(values.shape[1:])
    found.add(values, log.contact_active if name in WRENCHES else None)
    return found


def carry_measured(log: Log, name: str, timeline: Timeline, coverage: Coverage | None) -> FloatArray:
    """The field `name` (N, ...) at the output's stamps (K, ...), filtered like all others.

    A channel that is NaN throughout stays so. A wrench of an inactive contact is 0, whatever the log says. A channel
    with NaN among other values can be neither filtered nor resampled: it becomes NaN throughout.

    Args:
        log: the log, or a part of one.
        name: of the field.
        timeline: stamps of the log and of the result.
        coverage: of the field in the whole log; None where nothing is filtered or resampled.
    """
    values: FloatArray = getattr(log, name)
    check_finite(log.source, name, values, allow_nan=True, labels=labels_of(name, log.names))
    if coverage is None:
        return values[timeline.kept]
    flags = log.contact_active if name in WRENCHES else None
    complete = np.argwhere(coverage.complete)
    out = np.full((len(timeline.at), *values.shape[1:]), np.nan)
    for start in range(0, len(complete), GROUP):
        columns = (slice(None), *complete[start : start + GROUP].T)
        clean = values[columns]
        if flags is not None:
            clean[~flags[:, columns[1]]] = 0.0
        out[columns] = timeline.evaluate(timeline.smooth(clean), (0,))[0]
    return out
