"""Arrays larger than memory: in files without a name, which vanish with the process however that ends."""

from __future__ import annotations

import tempfile
import weakref
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchid.errors import InputError


class LazyArray(Protocol):
    """An array that is in memory only where it is sliced."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all of it."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of its elements."""

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some rows."""


class SpillError(InputError):
    """No room on the disk for what does not fit into memory."""


class Spill:
    """An array that grows by rows on a disk.

    Its file has no name: no other process sees it, and it is gone when nothing holds the array any longer, be it by
    success, an error, an interrupt or a kill.
    """

    def __init__(self, source: object, folder: Path) -> None:
        """Start empty; `source` is named in errors."""
        self.source, self.folder = source, folder
        self._rows, self._like = 0, np.zeros(0)
        try:  # not closed before the object that it belongs to is gone
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._failure(error) from error
        weakref.finalize(self, self._file.close)

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows, all of one shape and type.

        Raises:
            SpillError: the disk is full.
        """
        self.write(np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data)
        self._rows, self._like = self._rows + len(rows), rows[:0]

    def write(self, data: Any) -> None:
        """Add bytes.

        Raises:
            SpillError: the disk is full.
        """
        left = memoryview(data)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise self._failure(error) from error

    def array(self) -> NDArray[Any]:
        """All rows, (N, ...), mapped to the file."""
        return self.mapped((self._rows, *self._like.shape[1:]), self._like.dtype)

    def mapped(self, shape: tuple[int, ...], dtype: np.dtype[Any], fortran_order: bool = False) -> NDArray[Any]:
        """The bytes as an array, mapped to the file: what is read stays in memory only while nobody else needs it."""
        if not np.prod(shape):
            return np.empty(shape, dtype)
        # shared and writable, though nobody writes: private pages count against the memory, and torch warns of others
        return np.memmap(self._file, dtype, "r+", shape=shape, order="F" if fortran_order else "C")

    def _failure(self, error: OSError) -> SpillError:
        accepted = "a folder with room for the log, or a preprocessing.memory_gb that takes it"
        return SpillError(self.source, f"temporary file in {self.folder}", f"cannot be written ({error})", accepted)
