"""Files of named arrays, in the process that reads them: .npz, HDF5, Matlab's and JSON (h5py and scipy.io)."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import struct
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, how_to_install
from torchid.guards import MAX_DATASETS, MAX_LETTERS, MAX_NAMES, check_fields, check_names
from torchid.logs.spill import Spill

AnyArray = NDArray[Any]
_NO_NUMBERS = np.array(None, dtype=object)
"""In place of what is no plain array: readers of fields refuse it."""


@contextlib.contextmanager
def serve_arrays(path: Path) -> Iterator[ServedArrays]:
    """Open a file in the process that reads it; a damaged file raises any exception."""
    suffix = path.suffix.lower()
    with contextlib.ExitStack() as stack:
        if suffix == ".mat" and _is_older_matlab(path):
            yield ServedArrays(_read_matlab(path))
        elif suffix == ".json":
            yield ServedArrays(_read_json(path))
        elif suffix in (".mat", ".h5", ".hdf5"):
            h5py = import_h5py(path)
            yield _Hdf5(stack.enter_context(h5py.File(path, "r")), h5py)
        else:
            yield _Npz(stack.enter_context(zipfile.ZipFile(path)))


class ServedArrays:
    """Named arrays of a file that was read whole; base class for other files."""

    def __init__(self, arrays: Iterable[tuple[str, AnyArray]] = ()) -> None:
        """Take the arrays; ValueError where they are too many."""
        self._arrays = dict(arrays)
        self._sliced = dict[str, Any]()  # arrays by name, as `rows` slices them
        check_fields(self._arrays, len(self._arrays))

    def declared_bytes(self) -> dict[str, int]:
        """Bytes of each array, by name."""
        return {name: array.nbytes for name, array in self._arrays.items()}

    def load(self, name: str) -> AnyArray:
        """The array `name`; text is an array of str or of UTF-8 bytes."""
        return self._arrays[name]

    def shape(self, name: str, folder: str) -> tuple[int, ...]:
        """Shape of an array of which `rows` are read; what is packed is unpacked to a file in the folder."""
        array = self._sliced[name] = self._sliceable(name, Path(folder))
        return tuple(array.shape)

    def rows(self, name: str, start: int, stop: int, axis: int) -> AnyArray:
        """Rows of an array after `shape`, or columns for axis 1."""
        array = self._sliced[name]
        return np.asarray(array[:, start:stop] if axis else array[start:stop])

    def _sliceable(self, name: str, folder: Path) -> Any:
        """An array that is read where it is sliced."""
        return self.load(name)


# ---------------------------------------------------------------------------------------------------------------- .npz

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_PIECE_BYTES = 2**22  # that are unpacked at a time
#: Of an entry, before its name; its last two numbers are the lengths of the name and of the extra fields.
_LOCAL_HEADER = struct.Struct("<26xHH")


class _Npz(ServedArrays):
    """The arrays of a zip archive."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        super().__init__()
        self._archive = archive

    def declared_bytes(self) -> dict[str, int]:
        entries = self._archive.infolist()
        check_fields((entry.filename for entry in entries), len(entries))
        sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in entries}
        if len(sizes) != len(entries):
            raise ValueError("a name occurs twice")
        return sizes

    def load(self, name: str) -> AnyArray:
        entry, shape, _, dtype, _ = self._entry(name)
        if dtype.hasobject:  # pickled
            return np.broadcast_to(_NO_NUMBERS, shape)
        with self._archive.open(entry) as stream, _python_2_headers_allowed():
            array: AnyArray = np.lib.format.read_array(stream, allow_pickle=False)
        return array

    def _sliceable(self, name: str, folder: Path) -> AnyArray:
        """An array mapped to the archive if it is not compressed, else to a temporary file."""
        entry, shape, fortran_order, dtype, header = self._entry(name)
        if dtype.hasobject or not math.prod(shape):
            return self.load(name)
        order: Literal["C", "F"] = "F" if fortran_order else "C"
        with self._archive.open(entry) as stream:
            if entry.compress_type == zipfile.ZIP_STORED:
                while stream.read(_PIECE_BYTES):  # compares the checksum at its end
                    pass
                start = self._start(entry) + header
                return np.memmap(str(self._archive.filename), dtype, "r", offset=start, shape=shape, order=order)
            stream.seek(header)
            unpacked = Spill(self._archive.filename, folder)
            while data := stream.read(_PIECE_BYTES):
                unpacked.write(data)
        return unpacked.mapped(shape, dtype, order)

    def _start(self, entry: zipfile.ZipInfo) -> int:
        """Where in the archive the bytes of an entry begin: after a header with its name and extra fields."""
        file: Any = self._archive.fp
        file.seek(entry.header_offset)
        *_, name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        return int(entry.header_offset) + _LOCAL_HEADER.size + int(name) + int(extra)

    def _entry(self, name: str) -> tuple[zipfile.ZipInfo, tuple[int, ...], bool, np.dtype[Any], int]:
        """The entry of an array; its shape, Fortran order and type; bytes of its header.

        ValueError where the size in the header, which NumPy allocates, is not that of the entry.
        """
        entry = self._archive.getinfo(f"{name}.npy")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("unsupported compression")
        with self._archive.open(entry) as stream:
            version = np.lib.format.read_magic(stream)
            if version not in _HEADERS:
                raise ValueError(f"unsupported version {version} of the format")
            with _python_2_headers_allowed():
                shape, fortran_order, dtype = _HEADERS[version](stream)
            header = stream.tell()
        content = entry.file_size - header
        if not dtype.hasobject and math.prod(shape) * dtype.itemsize != content:
            raise ValueError(f"{content} bytes do not fit an array of shape {shape} with {dtype.itemsize} bytes each")
        if dtype.kind in "US":
            check_names(shape)
        return entry, shape, fortran_order, dtype, header


@contextlib.contextmanager
def _python_2_headers_allowed() -> Iterator[None]:
    """Suppress warnings about headers written by Python 2."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


# ---------------------------------------------------------------------------------------------------------------- HDF5

_HEADER_BYTES = 4096  # of an array, in a file
_NUMBER = re.compile(r"\d+")
_DEPTH = 8  # of groups in groups
_OF_MATLAB = ("#refs#", "#subsystem#")  # what cells and objects of its files refer to


def import_h5py(path: Path) -> Any:
    """The module h5py; LogError if it is not installed."""
    try:
        import h5py
    except ImportError as error:
        accepted = f"a .npz file, or {how_to_install('hdf5')}"
        raise LogError(path, "file", "HDF5, but h5py is not installed", accepted) from error
    return h5py


class _Hdf5(ServedArrays):
    """The datasets of an open file; links to other files are not followed."""

    def __init__(self, file: Any, h5py: Any) -> None:
        super().__init__()
        self._file = file
        self._h5py = h5py

    def declared_bytes(self) -> dict[str, int]:
        """Bytes by name, `group/name` of what is in groups of the file itself; an empty group is a name too.

        ValueError where there are more than a log may have, as those of a group that contains itself; arrays of groups
        that differ in numbers, such as episodes, count once.
        """
        sizes = dict[str, int]()
        count = 0
        groups = [("", self._file)]
        for prefix, group in groups:
            count += len(group)
            if count > MAX_DATASETS:
                raise ValueError(f"{count} arrays and groups; a log may have {MAX_DATASETS}")
            for name in group if prefix else [name for name in group if name not in _OF_MATLAB]:
                inner = self._item(group, name)
                if isinstance(inner, self._h5py.Group) and len(inner) and prefix.count("/") < _DEPTH:
                    groups.append((f"{prefix}{name}/", inner))
                    continue
                has_values = isinstance(inner, self._h5py.Dataset) and inner.shape is not None
                sizes[f"{prefix}{name}"] = int(inner.dtype.itemsize) * math.prod(inner.shape) if has_values else 0
        kinds = {_NUMBER.sub("", os.path.dirname(name)) + os.path.basename(name) for name in sizes}
        check_fields(sizes, len(kinds))
        return sizes

    def load(self, name: str) -> AnyArray:
        item = self._dataset(name)
        text = self._h5py.check_string_dtype(item.dtype)
        if text is not None:
            check_names(item.shape, text.length or 0)
            # as bytes: h5py decodes fixed-width text as ASCII
            return np.asarray(item[()]) if text.length else self._texts(item)
        if item.dtype.hasobject:  # references or ragged rows
            return np.broadcast_to(_NO_NUMBERS, item.shape)
        return np.asarray(item[()])

    def _sliceable(self, name: str, folder: Path) -> Any:
        item = self._dataset(name)
        return self.load(name) if item.dtype.hasobject or not item.shape else item

    def _dataset(self, name: str) -> Any:
        """A dataset of the file itself; TypeError where it has no values in this file."""
        item = self._item(self._file, name)
        is_dataset = isinstance(item, self._h5py.Dataset) and item.shape is not None
        if not is_dataset or item.is_virtual or item.external is not None:
            raise TypeError("a dataset without values in this file")
        return item

    def _item(self, group: Any, name: str) -> Any:
        """What a group itself holds, None for a link to another place."""
        return group[name] if isinstance(group.get(name, getlink=True), self._h5py.HardLink) else None

    def _texts(self, item: Any) -> AnyArray:
        """Texts of variable length, read one by one: many elements may refer to the same large text."""
        texts = []
        for index in np.ndindex(item.shape):
            texts.append(item[index])
            check_names((), len(texts[-1]))
        return np.array(texts, dtype=np.bytes_).reshape(item.shape)


def save_hdf5(path: Path, named: Path, arrays: Mapping[str, AnyArray]) -> None:
    """Write arrays to a new file; `named`: its name in messages.

    Raises:
        OSError: the disk is full. The room is taken up first: the HDF5 library crashes where a disk fills up.
    """
    h5py = import_h5py(named)
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


# ---------------------------------------------------------------------------------- Matlab's files before 7.3, and JSON

_MATLAB_HEADER_BYTES = 128
_MATLAB_MARKS = (b"\x00\x01IM", b"\x01\x00MI")  # version and order of bytes, at the end of the header


def _is_older_matlab(path: Path) -> bool:
    """Whether a file is of Matlab 5 to 7.2; later ones are HDF5."""
    with path.open("rb") as stream:
        return stream.read(_MATLAB_HEADER_BYTES)[-4:] in _MATLAB_MARKS


def _read_matlab(path: Path) -> Iterator[tuple[str, AnyArray]]:
    """Arrays by name, `structure/field` of those in structures; lists of texts as arrays of str."""
    from scipy.io import loadmat

    content = loadmat(path, simplify_cells=True)
    for name, value in _flat("", {name: x for name, x in content.items() if not name.startswith("__")}):
        array = np.asarray(value) if isinstance(value, (np.ndarray, str, int, float)) else _NO_NUMBERS
        texts = array.ravel().tolist() if array.dtype == object else []
        if texts and all(isinstance(text, str) for text in texts):
            check_names(array.shape, max(map(len, texts)))
            array = array.astype(np.str_)
        yield name, array


def _read_json(path: Path) -> Iterator[tuple[str, AnyArray]]:
    """Arrays by name of an object of arrays or a list of records; `group/name` of those in objects."""
    document = json.loads(path.read_text(encoding="utf-8-sig"))
    if not isinstance(document, dict) and not _are_records(document):
        raise ValueError(f"found a {type(document).__name__}, not an object of arrays or a list of records")
    yield from ((name, _json_array(value)) for name, value in _flat("", document))


def _flat(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What objects and structures hold, by name; columns of records in lists."""
    if isinstance(value, list) and _are_records(value):
        keys = dict.fromkeys(key for record in value for key in record)
        check_fields((), len(keys))
        value = {key: _filled([record.get(key) for record in value]) for key in keys}
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}/{key}".removeprefix("/"), inner)
    else:
        yield name, value


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, dict) for item in value)


def _filled(column: list[Any]) -> list[Any]:
    """A column of records, what some of these lack or have as null in the form of what others have."""
    example = next((item for item in column if item is not None), None)
    if isinstance(example, list):
        return [[None] * len(example) if item is None else item for item in column]
    return [{} if item is None else item for item in column] if isinstance(example, dict) else column


def _json_array(value: Any) -> AnyArray:
    """Numbers, with NaN for null, truth values, or texts that may be names; an object for anything else."""
    try:
        array = np.asarray(value)
        array = array.astype(np.float64) if array.dtype == object else array
    except (ValueError, TypeError, OverflowError):  # ragged rows, or nulls among texts
        return _NO_NUMBERS
    longest = array.dtype.itemsize // 4 if array.dtype.kind == "U" else 0
    return _NO_NUMBERS if longest > MAX_LETTERS or (longest and array.size > MAX_NAMES) else array
