"""HDF5 files (the only module with h5py): what one declares, its chunks measured before unpacking, its arrays."""

from __future__ import annotations

import itertools
import math
import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.guards import CHUNK_BYTES, MAX_CHUNKS, MAX_SMALL, check_fields, check_names
from torchid.logs.spill import LazyArray

_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_SUM = 4  # bytes that a checksum adds
_PIECE = 2**22  # bytes that are unpacked at a time
_ACCEPTED = "gzip or lzf, shuffle and fletcher32, each once (h5repack rewrites others)"
_OVERHEAD = 4096  # bytes that an array takes up beside its numbers


class Hdf5:
    """The datasets of an open file. Links are not followed: the numbers of a log stand in its file."""

    def __init__(self, file: Any, h5py: Any, file_size: int) -> None:
        self._file, self._h5py, self._file_size = file, h5py, file_size

    def declared_bytes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""
        check_fields(self._file if len(self._file) else (), len(self._file))
        return {name: self._size(name) for name in self._file}

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of UTF-8 bytes."""
        item = self._plain(name)
        if item.chunks:
            _MeasuredDataset(item).measure(slice(None))
        text = self._h5py.check_string_dtype(item.dtype)
        if text is not None:
            check_names(item.shape, text.length or 0)
            check_names(item.chunks or ())
            # bytes rather than h5py's own decoding, which takes fixed-width text for ASCII
            return np.asarray(item[()]) if text.length else self._texts(item)
        if item.dtype.hasobject:  # references or ragged rows, of any size, which the checks of fields refuse
            return np.broadcast_to(np.array(None, dtype=object), item.shape)
        return np.asarray(item[()])

    def lazy(self, name: str, folder: Path) -> LazyArray:
        """The array `name`, read where it is sliced."""
        item = self._plain(name)
        chunk = _chunk_bytes(item, self._file_size)
        if chunk > MAX_SMALL:
            raise ValueError(f"chunks of {chunk} bytes, more than the {MAX_SMALL} that are read at a time")
        if item.dtype.hasobject or not item.shape:
            return np.asarray(self.load(name))
        return _MeasuredDataset(item) if item.chunks else item

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
        return max(int(item.dtype.itemsize) * math.prod(item.shape), _chunk_bytes(item, self._file_size))

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


# ---------------------------------------------------------------------------- chunks, measured before they are unpacked


def _chunk_bytes(item: Any, file_size: int) -> int:
    """Bytes of one chunk of a dataset as it is in memory, 0 if it has none.

    Raises:
        ValueError: far more chunks than a file of this size can hold.
    """
    if not item.chunks:
        return 0
    count = math.prod(-(-size // step) for size, step in zip(item.shape, item.chunks, strict=True))
    most = MAX_CHUNKS + file_size // CHUNK_BYTES
    if count > most:
        raise ValueError(f"{count} chunks, more than the {most} that a file of {file_size} bytes may have")
    return math.prod(item.chunks) * int(item.dtype.itemsize)


class _MeasuredDataset:
    """A dataset of compressed chunks, each of which is measured before it is read for the first time."""

    def __init__(self, item: Any) -> None:
        """Take a dataset of chunks; ValueError where they are compressed in a way that is not read."""
        self._item, self._size = item, math.prod(item.chunks) * _stored_size(item)
        plist = item.id.get_create_plist()
        self._filters = [int(plist.get_filter(k)[0]) for k in range(plist.get_nfilters())]
        pressed = [x for x in self._filters if x in (_DEFLATE, _LZF)]
        known = set(self._filters) <= {_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF}
        if not known or len(pressed) > 1 or len(set(self._filters)) < len(self._filters):
            raise ValueError(f"chunks filtered by {self._filters}; these are read: {_ACCEPTED}")
        self._measured: set[int] = set()

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all of it."""
        return tuple(self._item.shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of its elements."""
        return np.dtype(self._item.dtype)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some rows; ValueError where a chunk of them does not hold what it should."""
        self.measure(rows)
        return np.asarray(self._item[rows])

    def measure(self, rows: slice) -> None:
        """Raise ValueError where a chunk that holds some of the rows holds more or less than it should."""
        if not self._filters:
            return
        start, stop, _ = rows.indices(self.shape[0])
        step, *others = self._item.chunks
        across = [range(0, size, of) for size, of in zip(self.shape[1:], others, strict=True)]
        for row in range(start // step, -(-stop // step)):
            if row not in self._measured:
                for rest in itertools.product(*across):
                    self._measure((row * step, *rest))
                self._measured.add(row)

    def _measure(self, offset: tuple[int, ...]) -> None:
        stored = self._item.id.get_chunk_info_by_coord(offset)
        if not stored.size or stored.byte_offset is None:
            return  # not there: the fill value stands for it
        if stored.size > 2 * self._size + _PIECE:
            raise ValueError(f"a chunk of {stored.size} bytes for {self._size}")
        mask, data = self._item.id.read_direct_chunk(offset)
        found, held = len(data), memoryview(data)
        for index in reversed(range(len(self._filters))):
            kind = self._filters[index]
            if mask >> index & 1:
                continue
            if kind == _FLETCHER32:
                found, held = found - _SUM, held[:-_SUM]
            elif kind in (_DEFLATE, _LZF):
                found = (_inflated if kind == _DEFLATE else _lzf)(held, self._size + _SUM)
        if found != self._size:
            raise ValueError(f"a chunk that holds {found} bytes, where {self._size} are declared")


def _stored_size(item: Any) -> int:
    """Bytes of one element in a chunk: of text of any length, its length and where it stands."""
    address: int = item.file.id.get_create_plist().get_sizes()[0]
    return address + 8 if item.dtype.hasobject else int(item.dtype.itemsize)


def _inflated(data: memoryview, most: int) -> int:
    """Bytes of what zlib compressed; ValueError where there is more than `most` or the end is missing."""
    press, found, left = zlib.decompressobj(), 0, bytes(data)
    while not press.eof and left:
        found += len(press.decompress(left, _PIECE))
        left = press.unconsumed_tail
        if found > most:
            raise ValueError(f"a chunk that holds more than {most} bytes, which are declared")
    if not press.eof:
        raise ValueError("a chunk that ends too soon")
    return found


def _lzf(data: memoryview, most: int) -> int:
    """Bytes that LZF data unpack to, summed over the lengths of literals and repetitions without unpacking."""
    found, at, size = 0, 0, len(data)
    while at < size:
        control = data[at]
        if control < 32:
            found, at = found + control + 1, at + control + 2
        elif control < 224:
            found, at = found + (control >> 5) + 2, at + 2
        else:
            found, at = found + (data[at + 1] if at + 1 < size else 0) + 9, at + 3
        if found > most:
            raise ValueError(f"a chunk that holds more than {most} bytes, which are declared")
    if at != size:
        raise ValueError("a chunk that ends too soon")
    return found
