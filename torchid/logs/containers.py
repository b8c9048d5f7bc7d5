"""Kinds of log files; containers of named arrays (.npz and HDF5): opening within limits, atomic writing."""

from __future__ import annotations

import ast
import contextlib
import math
import os
import struct
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.lib.format import descr_to_dtype, dtype_to_descr
from numpy.typing import NDArray

from torchid.errors import LogError, TorchidError, during, excerpt
from torchid.guards import MAX_ARRAYS, check_fields, check_names, check_unpacked_size
from torchid.logs.hdf5 import Hdf5, import_h5py, save_hdf5
from torchid.logs.json_files import JsonDocument
from torchid.logs.lazy_arrays import Computed, LazyArray, Spill
from torchid.logs.matlab import MatFile, byte_order
from torchid.logs.time_range import split_range
from torchid.reader import RemoteObject, open_apart
from torchid.staging import atomic_file

# --------------------------------------------------------------------------------------------------- kinds of log files

#: Containers of named arrays; JSON is read whole; Matlab's are HDF5 (`save -v7.3`) or of its own format before.
_WRITTEN = (".npz", ".h5", ".hdf5")
ARRAYS = (*_WRITTEN, ".mat", ".json")
#: Tables of OpenSim, motions and storages: text with lines before the names of the columns.
OPENSIM = (".mot", ".sto")
#: Tables of text, by whatever their cells are separated.
_PLAIN_TEXT = (".tsv", ".txt", ".dat")
TEXT_TABLES = (".csv", *_PLAIN_TEXT, *OPENSIM)
#: Tables with an object of JSON in each line.
JSON_LINES = (".jsonl", ".ndjson")
TABLES = (*TEXT_TABLES, *JSON_LINES, ".parquet")
#: Logs that torchid compress has made factors of.
FACTORS = ".factor"
#: Files of ROS 1 (.bag) and ROS 2; those of ROS 2 may also lie in a folder.
BAGS = (".bag", ".mcap", ".db3")
WRITABLE = (*_WRITTEN, ".csv", ".parquet")
READABLE = (*WRITABLE, ".mat", ".json", *_PLAIN_TEXT, *OPENSIM, *JSON_LINES, *BAGS)


class LogKind(Enum):
    """Content of a log: named arrays, one column per scalar, messages, or several files of the first two kinds."""

    ARRAYS = "arrays"
    TABLE = "table"
    BAG = "bag"
    JOINED = "joined"


def existing_log_kind(path: Path, beside: Path | None = None) -> LogKind:
    """The kind of an existing log, or of the file that it is a part of.

    Args:
        path: the log.
        beside: folder of the first file of several, from which this one is looked for.

    Raises:
        LogError: the file does not exist, or its extension is unknown; or one of several files is a bag.
    """
    part = split_range(path)
    if part.joins:
        for number, file in enumerate(part.files):
            if existing_log_kind(file.path, part.files[0].path.parent if number else None) is LogKind.BAG:
                accepted = f"{', '.join(WRITABLE)}: the topics of a bag have common stamps already; or convert it"
                raise LogError(file.path, "file", "a bag, one of several files of a log", accepted)
        return LogKind.JOINED
    path = part.file
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        if list_bag_files(path):
            return LogKind.BAG
        raise LogError(path, "file", "a folder", f"a log ({', '.join(READABLE)}), or a folder recorded by ROS 2")
    kind = _kind(path, READABLE)
    if not os.path.isfile(path):
        found = "a pipe, a device or a socket" if os.path.exists(path) else "no such file"
        where = f"; later files of a log are looked for from the folder of the first, {beside}" if beside else ""
        raise LogError(path, "file", found, f"an existing log ({', '.join(READABLE)}){where}")
    return kind


def new_log_kind(path: Path) -> LogKind:
    """The kind of a new log. Raises LogError: its extension is unknown."""
    return _kind(path, WRITABLE)


def list_bag_files(path: Path) -> list[Path]:
    """The files of a bag: `path` itself, or those in a folder recorded by ROS 2."""
    if not os.path.isdir(path):
        return [path] if path.suffix.lower() in BAGS else []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in BAGS[1:] and file.is_file())


def log_files(path: Path) -> list[Path]:
    """The files of a log, or of the one that it is a part of: several of a bag in a folder, or of joined files."""
    files = (file.path for file in split_range(path).files)
    return [one for file in files for one in list_bag_files(file) or [file]]


def _kind(path: Path, accepted: tuple[str, ...]) -> LogKind:
    suffix = _suffix(path, accepted)
    return LogKind.ARRAYS if suffix in ARRAYS else LogKind.TABLE if suffix in TABLES else LogKind.BAG


def _suffix(path: Path, accepted: tuple[str, ...]) -> str:
    """A file's extension in small letters, LogError unless it is one of these."""
    suffix = path.suffix.lower()
    if suffix not in accepted:
        one_array = f"; of an array x numpy.savez('{path.stem}.npz', x=x)" if suffix == ".npy" else ""
        raise LogError(path, "file", f"extension '{path.suffix}'", ", ".join(accepted) + one_array)
    return suffix


# ------------------------------------------------------------------------------------------------- containers of arrays

#: Characters of another package's message that an error message quotes.
_MAX_QUOTED = 200


class Container(Protocol):
    """An open file with named arrays."""

    def declared_bytes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of str or of UTF-8 bytes."""

    def lazy(self, name: str, folder: Path | None) -> LazyArray:
        """The array `name`, read where it is sliced, while the file is open.

        Compressed arrays are unpacked to a file in `folder`, or to memory without one.
        """


@contextlib.contextmanager
def reader_errors_explained(field: str, accepted: str) -> Iterator[None]:
    """Turn all exceptions of readers on a damaged file into a LogError."""
    try:
        yield
    except (TorchidError, Warning):
        raise
    except Exception as error:
        text = excerpt(" ".join(str(error).split()), _MAX_QUOTED)  # some readers quote the file
        why = f"{type(error).__name__}: {text}" if text else type(error).__name__
        raise LogError.at_field(field, f"cannot be read ({why})", accepted) from error


@contextlib.contextmanager
def open_container(path: Path, whole: bool = True) -> Iterator[Container]:
    """Open a .npz, .h5, .hdf5, .mat or .json file; LogError where it is missing, of another kind, damaged or too large.

    Args:
        path: the file.
        whole: whether its arrays will be read whole, which limits their size to `MAX_ARRAYS`.
    """
    suffix = _suffix(path, ARRAYS)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise LogError(path, "file", found, f"an existing log ({', '.join(ARRAYS)})")
    kind = {
        ".npz": "a complete .npz (zip) archive",
        ".mat": "a complete file of Matlab 5 or later",
        ".json": "a complete JSON document: an object of arrays, or a list of records",
    }
    with contextlib.ExitStack() as stack:
        with reader_errors_explained("file", kind.get(suffix, "a complete HDF5 file")):
            container = _Remote(stack.enter_context(open_apart(_served, path)))
            total = sum(container.declared_bytes().values())
        if whole and total > MAX_ARRAYS:
            raise LogError(path, "file", f"arrays of {total} bytes", f"at most {MAX_ARRAYS} bytes in all")
        check_unpacked_size(path, total)
        yield container


class _Remote:
    """A container that another process reads."""

    def __init__(self, opened: RemoteObject) -> None:
        self._opened = opened

    def declared_bytes(self) -> dict[str, int]:
        sizes: dict[str, int] = self._opened.call("declared_bytes")
        return sizes

    def load(self, name: str) -> NDArray[Any]:
        array: NDArray[Any] = self._opened.call("load", name)
        return array

    def lazy(self, name: str, folder: Path | None) -> LazyArray:
        shape, dtype = self._opened.call("lazy", name, None if folder is None else os.fspath(folder.absolute()))
        if dtype is None:
            return self.load(name)

        def rows_of(rows: slice) -> NDArray[Any]:
            array: NDArray[Any] = self._opened.call("rows", name, rows.start, rows.stop)
            return array

        return Computed(tuple(shape), descr_to_dtype(ast.literal_eval(dtype)), rows_of)


class _Served:
    """The same container in the process that reads it."""

    def __init__(self, container: Container) -> None:
        self.declared_bytes, self.load = container.declared_bytes, container.load
        self._container, self._lazy = container, dict[str, LazyArray]()

    def lazy(self, name: str, folder: str | None) -> tuple[tuple[int, ...], str | None]:
        """Shape and type of an array, None where it is to be loaded."""
        array = self._lazy[name] = self._container.lazy(name, None if folder is None else Path(folder))
        return array.shape, None if array.dtype.hasobject or not array.shape else repr(dtype_to_descr(array.dtype))

    def rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Some rows of an array that is read where it is sliced."""
        return np.asarray(self._lazy[name][start:stop])


@contextlib.contextmanager
def _served(path: Path) -> Iterator[_Served]:
    """Open a container in the process that reads it."""
    suffix = path.suffix.lower()
    with contextlib.ExitStack() as stack:
        container: Container
        if suffix == ".mat" and byte_order(path):
            container = MatFile(path)
        elif suffix == ".json":
            container = JsonDocument(path)
        elif suffix in (".mat", *_WRITTEN[1:]):
            h5py = import_h5py(path)
            container = Hdf5(stack.enter_context(h5py.File(path, "r")), h5py)
        else:
            container = _Npz(stack.enter_context(zipfile.ZipFile(path)))
        yield _Served(container)


@contextlib.contextmanager
def atomic_output(path: Path) -> Iterator[Path]:
    """A temporary file that is renamed to `path` at the end of the block, unless an error occurs.

    Raises:
        LogError: the file cannot be written.
    """
    try:
        with atomic_file(path) as temporary, during("writing", path):
            yield temporary
    except OSError as error:
        raise LogError(path, "file", f"cannot be written ({error})", "a path in a writable folder") from error


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a .npz, .h5 or .hdf5 file, which appears complete or not at all."""
    suffix = _suffix(path, ARRAYS)
    with atomic_output(path) as temporary:
        if suffix == ".npz":
            with temporary.open("xb") as stream:
                named: dict[str, Any] = dict(arrays)
                np.savez(stream, **named)
        else:
            save_hdf5(import_h5py(path), temporary, arrays)


# --------------------------------------------------------------------------------------------------- the container .npz

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
#: Bytes that are unpacked at a time.
_PIECE_BYTES = 2**22
#: Of an entry, before its name; its last two numbers are the lengths of the name and of the extra fields.
_LOCAL_HEADER = struct.Struct("<26xHH")


@contextlib.contextmanager
def open_npz(path: Path) -> Iterator[Container]:
    """Open a .npz archive of any name; any exception where it is damaged or is none."""
    with open_apart(_served, path) as opened:
        yield _Remote(opened)


class _Npz:
    """The arrays of a zip archive."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def declared_bytes(self) -> dict[str, int]:
        entries = self._archive.infolist()
        check_fields((entry.filename for entry in entries), len(entries))
        sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in entries}
        if len(sizes) != len(entries):
            raise ValueError("a name occurs twice")
        return sizes

    def load(self, name: str) -> NDArray[Any]:
        entry = self._entry(name)
        with self._archive.open(entry) as stream:
            shape, _, dtype = _read_header(stream)
        if dtype.hasobject:  # pickled, which whoever reads a field refuses
            return np.broadcast_to(np.array(None, dtype=object), shape)
        with self._archive.open(entry) as stream, _python_2_headers_allowed():
            array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
        return array

    def lazy(self, name: str, folder: Path | None) -> LazyArray:
        """The array `name`, where it lies in the archive if it is not compressed, else unpacked."""
        entry = self._entry(name)
        with self._archive.open(entry) as stream:
            shape, fortran_order, dtype = _read_header(stream)
            if dtype.hasobject or not shape:
                return self.load(name)
            if entry.compress_type == zipfile.ZIP_STORED and not fortran_order:
                header = stream.tell()
                while stream.read(_PIECE_BYTES):  # compares the checksum at its end
                    pass
                return _StoredArray(self._archive.fp, self._start(entry) + header, shape, dtype)
            if folder is None:
                return self.load(name)
            unpacked = Spill(self._archive.filename, folder)
            while data := stream.read(_PIECE_BYTES):
                unpacked.write(data)
        return unpacked.mapped(shape, dtype, fortran_order)

    def _start(self, entry: zipfile.ZipInfo) -> int:
        """Where in the archive the bytes of an entry begin: after a header with its name and extra fields."""
        file: Any = self._archive.fp
        file.seek(entry.header_offset)
        *_, name, extra = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        return int(entry.header_offset) + _LOCAL_HEADER.size + int(name) + int(extra)

    def _entry(self, name: str) -> zipfile.ZipInfo:
        """The entry of the array `name`; ValueError if it does not match its header."""
        entry = self._archive.getinfo(f"{name}.npy")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("compressed in a way that NumPy does not use")
        with self._archive.open(entry) as stream:
            _check_header(stream, entry.file_size)
        return entry


class _StoredArray:
    """An array whose elements lie in an open file one after the other; one thread at a time may read it."""

    def __init__(self, file: Any, start: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self._file, self._start, self.shape, self.dtype = file, start, shape, dtype

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        """Some successive rows; EOFError if the file ends before."""
        start, stop, _ = rows.indices(self.shape[0])
        out: NDArray[Any] = np.empty((max(stop - start, 0), *self.shape[1:]), self.dtype)
        if out.size:
            self._file.seek(self._start + start * out[:1].nbytes)
            if self._file.readinto(out.reshape(-1).view(np.uint8).data) != out.nbytes:
                raise EOFError("the file has become shorter")
        return out


@contextlib.contextmanager
def _python_2_headers_allowed() -> Iterator[None]:
    """Suppress warnings about headers written by Python 2."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def _read_header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and type of an array."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of the format, which is not supported")
    with _python_2_headers_allowed():
        return _HEADERS[version](stream)


def _check_header(stream: Any, size: int) -> None:
    """Raise ValueError unless the size in the header, which NumPy allocates, is that of the entry."""
    shape, _, dtype = _read_header(stream)
    content = size - stream.tell()
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize != content:
        raise ValueError(f"{content} bytes for an array of shape {shape}, {dtype.itemsize} bytes each")
    if dtype.kind in "US":
        check_names(shape)
