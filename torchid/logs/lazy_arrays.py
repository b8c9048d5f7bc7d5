"""Arrays of a log that may not be in memory: on the disk, or worked out where they are sliced; or read whole.

On the disk they are in temporary files that vanish with the process, or mapped to files. Worked out are fields of
foreign arrays.
"""

from __future__ import annotations

import mmap
import tempfile
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchid.errors import InputError
from torchid.guards import check_fields


class LazyArray(Protocol):
    """An array that is in memory only where it is sliced."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its elements."""

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some rows."""


class SpillError(InputError):
    """The disk has no room for arrays that exceed the memory."""


class Spill:
    """An array that grows by rows on a disk.

    Its file has no name: it vanishes with the last reference to the array, or with the process, however that ends.
    """

    def __init__(self, source: object, folder: Path) -> None:
        """Start empty; `source` is named in errors."""
        self.source, self.folder = source, folder
        self._rows, self._like = 0, np.zeros(0)
        try:  # closed when this object is deleted
            self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115
        except OSError as error:
            raise self._failure(error) from error
        weakref.finalize(self, self._file.close)

    def append(self, rows: NDArray[Any]) -> None:
        """Add rows, all of one shape and type. Raises SpillError: the disk is full."""
        self.write(np.ascontiguousarray(rows).reshape(-1).view(np.uint8).data)
        self._rows, self._like = self._rows + len(rows), rows[:0]

    def write(self, data: Any) -> None:
        """Add bytes. Raises SpillError: the disk is full."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise self._failure(error) from error

    def array(self) -> NDArray[Any]:
        """All rows, (N, ...), mapped to the file."""
        return self.mapped((self._rows, *self._like.shape[1:]), self._like.dtype)

    def mapped(self, shape: tuple[int, ...], dtype: np.dtype[Any], fortran_order: bool = False) -> NDArray[Any]:
        """The bytes as an array, mapped to the file: the system may drop its pages from memory."""
        if not np.prod(shape):
            return np.empty(shape, dtype)
        # shared, as private pages count as memory of the process; writable, as torch warns of read-only arrays
        return np.memmap(self._file, dtype, "r+", shape=shape, order="F" if fortran_order else "C")

    def _failure(self, error: OSError) -> SpillError:
        accepted = "a folder with room for the log, or a preprocessing.memory_gb that takes it"
        return SpillError(self.source, f"temporary file in {self.folder}", f"cannot be written ({error})", accepted)


_DONTNEED = getattr(mmap, "MADV_DONTNEED", None)  # not on Windows


class MappedPages:
    """The pages of some arrays that are mapped to files."""

    def __init__(self, arrays: Iterable[NDArray[Any]]) -> None:
        """Those of the arrays that are mapped, of all given ones."""
        bases: list[object] = [array.base for array in arrays]
        self._maps = [one for one in bases if isinstance(one, mmap.mmap)]

    def release(self) -> None:
        """Take them out of memory; they come back where they are used."""
        if _DONTNEED is not None:
            for one in self._maps:
                one.madvise(_DONTNEED)

    def __reduce__(self) -> tuple[Any, ...]:
        """Tensors that another process gets are in its memory."""
        return MappedPages, ((),)


@dataclass(frozen=True)
class Computed:
    """An array of a shape (N, ...) and type, some rows of which are what `rows_of` gives."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows_of: Callable[[slice], NDArray[Any]]

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return self.rows_of(slice(*rows.indices(self.shape[0])))


class ArraysInMemory:
    """Named arrays of a file that was read whole."""

    def __init__(self, arrays: Iterable[tuple[str, NDArray[Any]]]) -> None:
        """Take them; LogError where they are too many."""
        self._arrays = dict(arrays)
        check_fields(self._arrays, len(self._arrays))

    def declared_bytes(self) -> dict[str, int]:
        """Bytes of each array, by name."""
        return {name: array.nbytes for name, array in self._arrays.items()}

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of str."""
        return self._arrays[name]

    def lazy(self, name: str, folder: Path | None) -> LazyArray:
        """The same, in memory."""
        return self._arrays[name]
