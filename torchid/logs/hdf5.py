"""HDF5 files (the only module that imports h5py): declared sizes, arrays, and checks of chunks before unpacking."""

from __future__ import annotations

import itertools
import math
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, how_to_install
from torchid.guards import CHUNK_BYTES, MAX_CHUNKS, MAX_DATASETS, MAX_SMALL, check_fields, check_names
from torchid.logs.lazy_arrays import LazyArray

#: Filters by their HDF5 number.
_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF = 1, 2, 3, 32000
_ACCEPTED = "gzip or lzf, shuffle and fletcher32, each once (h5repack rewrites others)"
#: Bytes of a checksum, bytes that are unpacked at a time, and bytes of an array's header in a file.
_CHECKSUM_BYTES, _PIECE_BYTES, _HEADER_BYTES = 4, 2**22, 4096
_NUMBER = re.compile(r"\d+")
_DEPTH = 8  # of groups in groups
_OF_MATLAB = ("#refs#", "#subsystem#")  # what cells and objects of its files refer to


class Hdf5:
    """The datasets of an open file; links to other files are not followed."""

    def __init__(self, file: Any, h5py: Any, file_size: int) -> None:
        self._file, self._h5py, self._file_size = file, h5py, file_size

    def declared_bytes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""
        return {name: self._size(name) for name in self._names()}

    def _names(self) -> list[str]:
        """All names, `group/name` of what is in groups of the file itself; a group that holds nothing is a name too.

        ValueError where there are more than a log may have, as those of a group that contains itself; arrays of groups
        that differ in numbers, such as episodes, count once.
        """
        names, count, groups = list[str](), 0, [("", self._file)]
        for prefix, group in groups:
            count += len(group)
            if count > MAX_DATASETS:
                raise ValueError(f"{count} arrays and groups, more than the {MAX_DATASETS} that a log may have")
            for name in group if prefix else [name for name in group if name not in _OF_MATLAB]:
                inner = group[name] if isinstance(group.get(name, getlink=True), self._h5py.HardLink) else None
                if isinstance(inner, self._h5py.Group) and len(inner) and prefix.count("/") < _DEPTH:
                    groups.append((f"{prefix}{name}/", inner))
                else:
                    names.append(f"{prefix}{name}")
        check_fields(names, len({_NUMBER.sub("", os.path.dirname(name)) + os.path.basename(name) for name in names}))
        return names

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of UTF-8 bytes."""
        item = self._stored_dataset(name)
        if item.chunks:
            _ChunkedDataset(item).check(slice(None))
        text = self._h5py.check_string_dtype(item.dtype)
        if text is not None:
            check_names(item.shape, text.length or 0)
            check_names(item.chunks or ())
            # as bytes: h5py decodes fixed-width text as ASCII
            return np.asarray(item[()]) if text.length else self._texts(item)
        if item.dtype.hasobject:  # references or ragged rows, which the checks of fields refuse
            return np.broadcast_to(np.array(None, dtype=object), item.shape)
        return np.asarray(item[()])

    def lazy(self, name: str, folder: Path | None) -> LazyArray:
        """The array `name`, read where it is sliced; without a folder, arrays in chunks are read whole."""
        item = self._stored_dataset(name)
        if folder is None and item.chunks:
            return np.asarray(self.load(name))
        chunk = _chunk_bytes(item, self._file_size)
        if chunk > MAX_SMALL:
            raise ValueError(f"chunks of {chunk} bytes, more than the {MAX_SMALL} that are read at a time")
        if item.dtype.hasobject or not item.shape:
            return np.asarray(self.load(name))
        return _ChunkedDataset(item) if item.chunks else item

    def _stored_dataset(self, name: str) -> Any:
        """The dataset `name`; TypeError where it has no values in this file."""
        item = self._dataset(name)
        if item is None or item.shape is None or item.is_virtual or item.external is not None:
            raise TypeError("not a dataset with values in this file")
        return item

    def _texts(self, item: Any) -> NDArray[Any]:
        """Texts of variable length, read one by one: many elements may refer to the same large text."""
        texts = []
        for index in np.ndindex(item.shape):
            texts.append(item[index])
            check_names((), len(texts[-1]))
        return np.array(texts, dtype=np.bytes_).reshape(item.shape)

    def _size(self, name: str) -> int:
        """Declared bytes of a dataset, or of one chunk if that is more: chunks are read whole."""
        item = self._dataset(name)
        if item is None or item.shape is None:
            return 0
        return max(int(item.dtype.itemsize) * math.prod(item.shape), _chunk_bytes(item, self._file_size))

    def _dataset(self, name: str) -> Any:
        """The dataset `name` of the file itself, None where there is none."""
        item = self._file[name] if isinstance(self._file.get(name, getlink=True), self._h5py.HardLink) else None
        return item if isinstance(item, self._h5py.Dataset) else None


def import_h5py(path: Path) -> Any:
    """The module h5py; LogError where it is not installed."""
    try:
        import h5py
    except ImportError as error:
        accepted = f"a .npz file, or {how_to_install('hdf5')}"
        raise LogError(path, "file", "HDF5, but h5py is not installed", accepted) from error
    return h5py


def save_hdf5(h5py: Any, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a new file.

    Raises:
        OSError: the disk is full. The room is taken up first: the HDF5 library crashes where a disk fills up.
    """
    size = sum(array.nbytes for array in arrays.values()) + _HEADER_BYTES * len(arrays)
    with path.open("xb") as stream:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(stream.fileno(), 0, size)
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            if array.dtype.kind == "U":
                file.create_dataset(name, data=array.astype(object), dtype=h5py.string_dtype())
            else:
                file.create_dataset(name, data=array)


def _chunk_bytes(item: Any, file_size: int) -> int:
    """Unpacked bytes of one chunk of a dataset, 0 without chunks; ValueError for more chunks than a file can hold."""
    if not item.chunks:
        return 0
    count = math.prod(-(-size // step) for size, step in zip(item.shape, item.chunks, strict=True))
    most = MAX_CHUNKS + file_size // CHUNK_BYTES
    if count > most:
        raise ValueError(f"{count} chunks, more than the {most} that a file of {file_size} bytes may have")
    return math.prod(item.chunks) * int(item.dtype.itemsize)


class _ChunkedDataset:
    """A dataset of compressed chunks; the unpacked size of each is checked before it is first read."""

    def __init__(self, item: Any) -> None:
        """Check the filters of a dataset of chunks; ValueError for filters that are not supported."""
        address_bytes: int = item.file.id.get_create_plist().get_sizes()[0]
        element_bytes = address_bytes + 8 if item.dtype.hasobject else int(item.dtype.itemsize)  # of text: its location
        self._item, self._size = item, math.prod(item.chunks) * element_bytes
        plist = item.id.get_create_plist()
        self._filters = [int(plist.get_filter(k)[0]) for k in range(plist.get_nfilters())]
        known = set(self._filters) <= {_DEFLATE, _SHUFFLE, _FLETCHER32, _LZF}
        if not known or {_DEFLATE, _LZF} <= set(self._filters) or len(set(self._filters)) < len(self._filters):
            raise ValueError(f"chunks filtered by {self._filters}; these are read: {_ACCEPTED}")
        self._checked: set[int] = set()

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self._item.shape)

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(self._item.dtype)

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some rows; ValueError where one of their chunks has another size than declared."""
        self.check(rows)
        return np.asarray(self._item[rows])

    def check(self, rows: slice) -> None:
        """Raise ValueError where a chunk with some of the rows has another unpacked size than declared."""
        if not self._filters:
            return
        start, stop, _ = rows.indices(self.shape[0])
        step, *others = self._item.chunks
        across = [range(0, size, of) for size, of in zip(self.shape[1:], others, strict=True)]
        for row in range(start // step, -(-stop // step)):
            if row not in self._checked:
                for rest in itertools.product(*across):
                    self._check_chunk((row * step, *rest))
                self._checked.add(row)

    def _check_chunk(self, offset: tuple[int, ...]) -> None:
        stored = self._item.id.get_chunk_info_by_coord(offset)
        if not stored.size or stored.byte_offset is None:
            return  # not stored: all fill values
        if stored.size > 2 * self._size + _PIECE_BYTES:
            raise ValueError(f"a chunk of {stored.size} bytes for {self._size}")
        mask, data = self._item.id.read_direct_chunk(offset)
        size, packed = len(data), memoryview(data)
        for index in reversed(range(len(self._filters))):
            kind = self._filters[index]
            if mask >> index & 1:
                continue
            if kind == _FLETCHER32:
                size, packed = size - _CHECKSUM_BYTES, packed[:-_CHECKSUM_BYTES]
            elif kind in (_DEFLATE, _LZF):
                size = (_deflate_size if kind == _DEFLATE else _lzf_size)(packed, self._size + _CHECKSUM_BYTES)
        if size != self._size:
            raise ValueError(f"a chunk that holds {size} bytes, where {self._size} are declared")


def _deflate_size(data: memoryview, max_size: int) -> int:
    """Unpacked bytes of a zlib stream; ValueError where they exceed `max_size` or the end is missing."""
    decompressor, size, rest = zlib.decompressobj(), 0, bytes(data)
    while not decompressor.eof and rest:
        size += len(decompressor.decompress(rest, _PIECE_BYTES))
        rest = decompressor.unconsumed_tail
        if size > max_size:
            raise ValueError(f"a chunk that holds more than {max_size} bytes, which are declared")
    if not decompressor.eof:
        raise ValueError("a chunk that ends too soon")
    return size


def _lzf_size(data: memoryview, max_size: int) -> int:
    """Unpacked bytes of LZF data: the sum of the lengths of literals and repetitions; errors as `_deflate_size`."""
    size, at = 0, 0
    while at < len(data):
        control = data[at]
        if control < 32:
            size, at = size + control + 1, at + control + 2
        elif control < 224:
            size, at = size + (control >> 5) + 2, at + 2
        else:
            size, at = size + (data[at + 1] if at + 1 < len(data) else 0) + 9, at + 3
        if size > max_size:
            raise ValueError(f"a chunk that holds more than {max_size} bytes, which are declared")
    if at != len(data):
        raise ValueError("a chunk that ends too soon")
    return size
