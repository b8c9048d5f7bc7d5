"""Arrays in temporary files, for what is larger than memory: they vanish with the process."""

from __future__ import annotations

import mmap
import tempfile
import weakref
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torchid.errors import InputError


class SpillError(InputError):
    """The disk has no room for arrays that exceed the memory."""


class Spill:
    """An array that grows by rows on a disk.

    Its file has no name: it vanishes with the last reference to the array, or with the process, however that ends.
    """

    def __init__(self, source: object, folder: Path) -> None:
        """Start empty; `source` is named in errors."""
        self.source = source
        self.folder = folder
        self._rows = 0
        self._like = np.zeros(0)
        try:  # closed when this object is deleted
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._failure(error) from error
        weakref.finalize(self, self._file.close)

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows, all of one shape and type. Raises SpillError: the disk is full."""
        self.write(np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data)
        self._rows += len(rows)
        self._like = rows[:0]

    def write(self, data: Any) -> None:
        """Add bytes. Raises SpillError: the disk is full."""
        unwritten = memoryview(data)
        try:
            while unwritten:
                unwritten = unwritten[self._file.write(unwritten) :]
        except OSError as error:
            raise self._failure(error) from error

    def array(self) -> NDArray[Any]:
        """All rows, (N, ...), mapped to the file."""
        return self.mapped((self._rows, *self._like.shape[1:]), self._like.dtype)

    def mapped(self, shape: tuple[int, ...], dtype: np.dtype[Any], order: Literal["C", "F"] = "C") -> NDArray[Any]:
        """The bytes as an array, mapped to the file: the system may drop its pages from memory."""
        if not np.prod(shape):
            return np.empty(shape, dtype)
        # shared, as private pages count as memory of the process; writable, as torch warns of read-only arrays
        return np.memmap(self._file, dtype, "r+", shape=shape, order=order)

    def _failure(self, error: OSError) -> SpillError:
        accepted = "a folder with space for the log, or a larger preprocessing.memory_gb"
        return SpillError(self.source, f"temporary file in {self.folder}", f"cannot be written ({error})", accepted)


_DONTNEED = getattr(mmap, "MADV_DONTNEED", None)  # not on Windows


class MappedPages:
    """The pages of some arrays that are mapped to files."""

    def __init__(self, arrays: Iterable[NDArray[Any]]) -> None:
        """Those of the arrays that are mapped, of all given ones."""
        bases: list[object] = [array.base for array in arrays]
        self._maps = [base for base in bases if isinstance(base, mmap.mmap)]

    def release(self) -> None:
        """Take them out of memory; they come back where they are used."""
        if _DONTNEED is not None:
            for mapping in self._maps:
                mapping.madvise(_DONTNEED)

    def __reduce__(self) -> tuple[Any, ...]:
        """Tensors that another process gets are in its memory."""
        return MappedPages, ((),)
