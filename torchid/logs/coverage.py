"""Which channels of a log's fields were measured throughout."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import warn
from torchid.logs.log import CONTACT_READINGS, BoolArray, FloatArray, Log, column_labels, describe_element


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
    def empty(cls, channels: tuple[int, ...]) -> Coverage:
        """Coverage of no samples."""
        return cls(0, *(np.zeros(channels, dtype=np.intp) for _ in range(5)))

    def add(self, values: FloatArray, active: BoolArray | None) -> None:
        """Add samples (N, ...) of the field; `active`: (N, C) of the contacts of a reading."""
        nan = np.isnan(values)
        if active is not None:
            active = active.reshape(active.shape + (1,) * (values.ndim - 2))
        self.values += len(values) - nan.sum(axis=0)
        self.measurable += len(values) if active is None else active.sum(axis=0)
        if active is not None:
            nan &= active
        count = nan.sum(axis=0)
        new = (count > 0) & (self.missing == 0)
        self.first[new] = self.samples + np.argmax(nan, axis=0)[new]
        self.last[count > 0] = self.samples + (len(nan) - 1 - np.argmax(nan[::-1], axis=0))[count > 0]
        self.missing += count
        self.samples += len(values)

    @property
    def complete(self) -> BoolArray:
        """Channels with a value in all measurable samples, and in at least one sample."""
        return np.asarray((self.missing == 0) & (self.values > 0))

    @property
    def broken(self) -> BoolArray:
        """Channels with a value in some samples and NaN in others."""
        return np.asarray((self.missing > 0) & (self.missing < self.measurable) & (self.values > 0))


def warn_of_gaps(log: Log, name: str, coverage: Coverage) -> None:
    """Warn of channels that become NaN throughout because they are NaN in some samples.

    Warns:
        TorchidWarning: names them.
    """
    labels = column_labels(name, log.names)
    broken = [
        f"{describe_element((0, *channel), labels).partition(', ')[2]}"
        f" (samples {coverage.first[channel]} to {coverage.last[channel]})"
        for channel in map(tuple, np.argwhere(coverage.broken).tolist())
    ]
    if broken:
        message = f"{log.source}: {name}: NaN in part of {', '.join(broken)}: NaN throughout after preprocessing"
        message += ", unless preprocessing.bridge_gaps_s bridges these gaps"
        warn(message)


def measure_coverage(log: Log, name: str) -> Coverage:
    """Coverage of the field `name` of a log."""
    values: FloatArray = getattr(log, name)
    found = Coverage.empty(values.shape[1:])
    found.add(values, log.contact_active if name in CONTACT_READINGS else None)
    return found
