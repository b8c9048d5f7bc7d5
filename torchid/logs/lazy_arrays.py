"""Fields of a log that are worked out where they are sliced: of other fields, foreign arrays, neighbours of gaps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.logs.flags import runs
from torchid.logs.log import FloatArray
from torchid.logs.mapped_fields import MappedFields
from torchid.logs.spill import LazyArray


@dataclass(frozen=True)
class Computed:
    """An array of a shape (N, ...) and type, some rows of which are what `rows_of` gives."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows_of: Callable[[slice], NDArray[Any]]

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return self.rows_of(slice(*rows.indices(self.shape[0])))


class MappedArray:
    """A field whose arrays are read where it is sliced."""

    def __init__(self, fields: MappedFields, name: str, arrays: Mapping[str, LazyArray]) -> None:
        """The field of a name, of open arrays. Raises LogError: arrays that do not fit it."""
        self._fields, self._name, self._arrays = fields, name, arrays
        self._constant = fields.constant_sources(name)
        for source in fields.sources_of(name):
            if not arrays[source].shape:
                raise LogError.at_field(f"'{source}'", "a single value", "an array with a row for each sample")
        sampled = [source for source in fields.sources_of(name) if not self._is_constant(source)]
        lengths = {source: arrays[source].shape[0] for source in sampled}
        for source, length in lengths.items():
            if length != max(lengths.values()):
                raise LogError.at_field(f"'{source}'", f"{length} samples", f"{max(lengths.values())}, as others have")
        first = self[slice(0, 1)]
        self.dtype, self.shape = first.dtype, (max(lengths.values(), default=0), *first.shape[1:])

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        if self._name == "time" and self._fields.step is not None and hasattr(self, "shape"):
            start, stop, _ = rows.indices(self.shape[0])
            return self._fields.stamps(start, stop - start)
        return self._fields.value(self._name, lambda source: self._read(source, rows))

    def _read(self, source: str, rows: slice) -> NDArray[Any]:
        return np.asarray(self._arrays[source][slice(None) if self._is_constant(source) else rows])

    def _is_constant(self, source: str) -> bool:
        return source in self._constant and len(self._arrays[source].shape) == 1


class GapsFilled:
    """An array (N, k) without gaps (NaN): each is filled linearly, those at the ends with the nearest value.

    A channel of which more than a share is missing is NaN throughout.
    """

    def __init__(self, array: LazyArray, most_missing: float, parts: Iterable[FloatArray]) -> None:
        self.shape, self.dtype = array.shape, np.dtype(np.float64)
        self._array = array
        channels = [_Gaps() for _ in range(array.shape[1])]
        most, start = most_missing * array.shape[0], 0
        for values in parts:
            for gaps, channel in zip(channels, values.T, strict=True):
                gaps.add(start, channel, most)
            start += len(values)
        self.broken = np.array([gaps.missing > most for gaps in channels])
        """Channels (k,) that are NaN throughout."""

        self._tables = [
            np.zeros((0, 4)) if bad else gaps.table() for gaps, bad in zip(channels, self.broken, strict=True)
        ]

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, _, _ = rows.indices(self.shape[0])
        out = np.array(self._array[rows], dtype=np.float64)
        out[:, self.broken] = np.nan
        for channel, table in zip(out.T, self._tables, strict=True):
            missing = np.flatnonzero(np.isnan(channel)) if len(table) else np.zeros(0, dtype=np.intp)
            first, stop, before, after = table[np.searchsorted(table[:, 0], start + missing, side="right") - 1].T
            slope = (after - before) / (stop - (first - 1.0))
            channel[missing] = slope * (start + missing - (first - 1.0)) + before
        return out


class _Gaps:
    """Gaps of one channel: first samples, those after the last, values before and after."""

    def __init__(self) -> None:
        self.missing = 0
        self._found: list[FloatArray] = []
        self._last = np.nan  # value of the last sample that has one
        self._open: tuple[int, float] | None = None  # start of a gap that has not ended, and the value before it

    def add(self, offset: int, values: FloatArray, most: float) -> None:
        """Add successive samples; nothing is kept of a channel of which more than so many are missing."""
        nan = np.isnan(values)
        self.missing += int(nan.sum())
        if self.missing > most:
            self._found, self._open = [], None
            return
        table = []
        if self._open is not None and not nan.all():
            start, before = self._open
            stop = int(np.argmin(nan))
            table.append((start, offset + stop, before, values[stop]))
            self._open = None
        for start, stop in runs(nan):
            before = values[start - 1] if start else self._last
            if stop == len(values):
                self._open = self._open or (offset + start, before)
            elif start or not table:
                table.append((offset + start, offset + stop, before, values[stop]))
        if not nan.all():
            self._last = values[np.flatnonzero(~nan)[-1]]
        if table:
            self._found.append(np.array(table, dtype=np.float64))

    def table(self) -> FloatArray:
        """All gaps (G, 4)."""
        last = [] if self._open is None else [np.array([[self._open[0], np.inf, self._open[1], self._open[1]]])]
        out = np.concatenate([np.zeros((0, 4)), *self._found, *last])
        out[:, 2] = np.where(np.isnan(out[:, 2]), out[:, 3], out[:, 2])
        return out
