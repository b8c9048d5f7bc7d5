"""Kinds of log files; containers of named arrays (.npz and HDF5): opening within limits, atomic writing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, TorchidError, during, excerpt
from torchid.guards import MAX_ARRAYS, check_unpacked_size
from torchid.logs.array_files import save_hdf5, serve_arrays
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
    """The kind of an existing log, or of the file of a part.

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
                accepted = f"a bag alone, or {', '.join(WRITABLE)}; torchid convert writes these"
                raise LogError(file.path, "file", "a bag in a log of several files", accepted)
        return LogKind.JOINED
    path = part.file
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        if list_bag_files(path):
            return LogKind.BAG
        raise LogError(path, "file", "a folder", f"a log ({', '.join(READABLE)}), or a folder recorded by ROS 2")
    kind = _kind(path, READABLE)
    if not os.path.isfile(path):
        reason = "a pipe, a device or a socket" if os.path.exists(path) else "no such file"
        where = f"; paths of further files are relative to {beside}" if beside else ""
        raise LogError(path, "file", reason, f"an existing log ({', '.join(READABLE)}){where}")
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
    """The files of a log or of a part of one: several for a bag in a folder, or for joined files."""
    files = (file.path for file in split_range(path).files)
    return [part for file in files for part in list_bag_files(file) or [file]]


def _kind(path: Path, accepted: tuple[str, ...]) -> LogKind:
    suffix = _suffix(path, accepted)
    return LogKind.ARRAYS if suffix in ARRAYS else LogKind.TABLE if suffix in TABLES else LogKind.BAG


def _suffix(path: Path, accepted: tuple[str, ...]) -> str:
    """A file's extension in small letters, LogError unless it is one of these."""
    suffix = path.suffix.lower()
    if suffix not in accepted:
        one_array = f"; convert an array x with numpy.savez('{path.stem}.npz', x=x)" if suffix == ".npy" else ""
        raise LogError(path, "file", f"extension '{path.suffix}'", ", ".join(accepted) + one_array)
    return suffix


# ------------------------------------------------------------------------------------------------- containers of arrays

#: Characters of another package's message that an error message quotes.
_MAX_QUOTED = 200


@contextlib.contextmanager
def reader_errors_explained(field: str, accepted: str) -> Iterator[None]:
    """Turn every exception of a reader into a LogError."""
    try:
        yield
    except (TorchidError, Warning):
        raise
    except Exception as error:
        text = excerpt(" ".join(str(error).split()), _MAX_QUOTED)  # some readers quote the file
        why = f"{type(error).__name__}: {text}" if text else type(error).__name__
        raise LogError.at_field(field, f"cannot be read ({why})", accepted) from error


class Container:
    """An open file with named arrays, which another process reads."""

    def __init__(self, opened: RemoteObject) -> None:
        """Arrays of a file that `serve_arrays` has opened."""
        self._opened = opened

    def declared_bytes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""
        sizes: dict[str, int] = self._opened.call("declared_bytes")
        return sizes

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of str or of UTF-8 bytes."""
        array: NDArray[Any] = self._opened.call("load", name)
        return array

    def shape(self, name: str, folder: Path) -> tuple[int, ...]:
        """Shape of an array, before `rows`; a compressed array is first unpacked to a file in the folder."""
        return tuple(self._opened.call("shape", name, os.fspath(folder.absolute())))

    def rows(self, name: str, rows: slice, axis: int = 0) -> NDArray[Any]:
        """Rows of an array after `shape`, or columns for axis 1."""
        array: NDArray[Any] = self._opened.call("rows", name, rows.start, rows.stop, axis)
        return array


@contextlib.contextmanager
def open_container(path: Path, whole: bool = True) -> Iterator[Container]:
    """Open a .npz, .h5, .hdf5, .mat or .json file; LogError if it is missing, unknown, damaged or too large.

    Args:
        path: the file.
        whole: whether its arrays will be read whole, which limits their size to `MAX_ARRAYS`.
    """
    suffix = _suffix(path, ARRAYS)
    if not path.is_file():
        reason = "a folder" if path.is_dir() else "no such file"
        raise LogError(path, "file", reason, f"an existing log ({', '.join(ARRAYS)})")
    kind = {
        ".npz": "a complete .npz (zip) archive",
        ".mat": "a complete file of Matlab 5 or later",
        ".json": "a complete JSON document: an object of arrays, or a list of records",
    }
    with contextlib.ExitStack() as stack:
        with reader_errors_explained("file", kind.get(suffix, "a complete HDF5 file")):
            container = stack.enter_context(open_npz(path))
            total = sum(container.declared_bytes().values())
        if whole and total > MAX_ARRAYS:
            raise LogError(path, "file", f"arrays of {total} bytes", f"at most {MAX_ARRAYS} bytes in all")
        check_unpacked_size(path, total)
        yield container


@contextlib.contextmanager
def open_npz(path: Path) -> Iterator[Container]:
    """Open a file by its extension, by default as a .npz archive; a damaged file raises any exception."""
    with open_apart(serve_arrays, path) as opened:
        yield Container(opened)


@contextlib.contextmanager
def atomic_output(path: Path) -> Iterator[Path]:
    """A temporary file; it is renamed to `path` at the end of the block, unless an error occurs.

    Raises:
        LogError: the file cannot be written.
    """
    try:
        with atomic_file(path) as temporary, during("writing", path):
            yield temporary
    except OSError as error:
        raise LogError(path, "file", f"cannot be written ({error})", "a path in a writable folder") from error


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a .npz, .h5 or .hdf5 file: completely or not at all."""
    suffix = _suffix(path, ARRAYS)
    with atomic_output(path) as temporary:
        if suffix == ".npz":
            with temporary.open("xb") as stream:
                named: dict[str, Any] = dict(arrays)
                np.savez(stream, **named)
        else:
            save_hdf5(temporary, path, arrays)
