"""Fields of foreign arrays that are read where they are sliced."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.logs.mapped_fields import MappedFields
from torchid.logs.spill import LazyArray


class MappedArray:
    """A field whose arrays are read where it is sliced."""

    def __init__(self, fields: MappedFields, name: str, arrays: Mapping[str, LazyArray]) -> None:
        """The field of a name, of open arrays.

        Raises:
            LogError: arrays that do not fit it.
        """
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
        """Some rows."""
        if self._name == "time" and self._fields.step is not None and hasattr(self, "shape"):
            start, stop, _ = rows.indices(self.shape[0])
            return self._fields.stamps(start, stop - start)
        return self._fields.value(self._name, lambda source: self._read(source, rows))

    def _read(self, source: str, rows: slice) -> NDArray[Any]:
        return np.asarray(self._arrays[source][slice(None) if self._is_constant(source) else rows])

    def _is_constant(self, source: str) -> bool:
        return source in self._constant and len(self._arrays[source].shape) == 1
