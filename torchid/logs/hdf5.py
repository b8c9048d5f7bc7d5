"""HDF5 files (the only module with h5py): what one declares, its arrays one at a time, and writing one."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.guards import MAX_SMALL, check_fields, check_names
from torchid.logs.chunks import Measured, chunk_bytes
from torchid.logs.spill import Sliced

_OVERHEAD = 4096  # bytes that an array takes up beside its numbers


class Hdf5:
    """The datasets of an open file. Links are not followed: the numbers of a log stand in its file."""

    def __init__(self, file: Any, h5py: Any, file_size: int) -> None:
        self._file, self._h5py, self._file_size = file, h5py, file_size

    def sizes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""
        check_fields(self._file if len(self._file) else (), len(self._file))
        return {name: self._size(name) for name in self._file}

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of UTF-8 bytes."""
        item = self._plain(name)
        if item.chunks:
            Measured(item).measure(slice(None))
        text = self._h5py.check_string_dtype(item.dtype)
        if text is not None:
            check_names(item.shape, text.length or 0)
            check_names(item.chunks or ())
            # bytes rather than h5py's own decoding, which takes fixed-width text for ASCII
            return np.asarray(item[()]) if text.length else self._texts(item)
        if item.dtype.hasobject:  # references or ragged rows, of any size: what is wrong with them is said by others
            return np.broadcast_to(np.array(None, dtype=object), item.shape)
        return np.asarray(item[()])

    def sliced(self, name: str, folder: Path) -> Sliced:
        """The array `name`, read where it is sliced."""
        item = self._plain(name)
        chunk = chunk_bytes(item, self._file_size)
        if chunk > MAX_SMALL:
            raise ValueError(f"chunks of {chunk} bytes, more than the {MAX_SMALL} that are read at a time")
        if item.dtype.hasobject or not item.shape:
            return np.asarray(self.load(name))
        return Measured(item) if item.chunks else item

    def _plain(self, name: str) -> Any:
        """The dataset `name`; TypeError where it has no values in this file."""
        item = self._dataset(name)
        if item is None or item.shape is None or item.is_virtual or item.external is not None:
            raise TypeError("not a dataset with values in this file")
        return item

    def _texts(self, item: Any) -> NDArray[Any]:
        """Texts of any length, one at a time: a file of a megabyte may give each of them the same megabyte."""
        found = []
        for index in np.ndindex(item.shape):
            found.append(item[index])
            check_names((), len(found[-1]))
        return np.array(found, dtype=np.bytes_).reshape(item.shape)

    def _size(self, name: str) -> int:
        """Declared bytes of a dataset: of all it holds, or of one chunk, which is read as a whole, if that is more."""
        item = self._dataset(name)
        if item is None or item.shape is None:
            return 0
        return max(int(item.dtype.itemsize) * math.prod(item.shape), chunk_bytes(item, self._file_size))

    def _dataset(self, name: str) -> Any:
        """The dataset `name` of the file itself, None where there is none."""
        own = isinstance(self._file.get(name, getlink=True), self._h5py.HardLink)
        item = self._file[name] if own else None
        return item if isinstance(item, self._h5py.Dataset) else None


def import_h5py(path: Path) -> Any:
    """The module h5py, or a LogError that names the file: only those who use HDF5 need it."""
    try:
        import h5py
    except ImportError as error:
        raise LogError(path, "file", "HDF5, but h5py is not installed", "a .npz file, or an installed h5py") from error
    return h5py


def save_hdf5(h5py: Any, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a file that is not there yet.

    Raises:
        OSError: there is no room for them.
    """
    _check_room(path, sum(array.nbytes for array in arrays.values()) + _OVERHEAD * len(arrays))
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array.dtype.kind == "U":
                file.create_dataset(name, data=array.astype(object), dtype=h5py.string_dtype())
            else:
                file.create_dataset(name, data=array)


def _check_room(path: Path, size: int) -> None:
    """Take up the room of a file for a moment: when a disk fills up, the HDF5 library brings the interpreter down."""
    with path.open("xb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, size)
