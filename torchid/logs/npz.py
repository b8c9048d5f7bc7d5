"""An open .npz file: what it declares, and its arrays one at a time; never pickled ones."""

from __future__ import annotations

import contextlib
import math
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.guards import check_fields, check_names
from torchid.logs.spill import Sliced, Spill

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}

_PIECE = 2**22  # bytes that are unpacked at a time
_ENTRY, _DIRECTORY = b"PK\x01\x02", 2**20  # how entries begin; bytes at the end of a file, that hold those of a log


def open_archive(path: Path) -> zipfile.ZipFile:
    """Open a zip archive; ValueError if it has far too many entries, which `zipfile` takes seconds to list."""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - _DIRECTORY))
        check_fields((), stream.read().count(_ENTRY))
    return zipfile.ZipFile(path)


class Npz:
    """The arrays of a zip archive."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def sizes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""
        entries = self._archive.infolist()
        check_fields((entry.filename for entry in entries), len(entries))
        sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in entries}
        if len(sizes) != len(entries):
            raise ValueError("a name occurs twice")
        return sizes

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`."""
        entry = self._entry(name)
        with self._archive.open(entry) as stream:
            array: NDArray[Any]
            with _of_python_2():
                array = np.lib.format.read_array(stream, allow_pickle=False)
        return array

    def sliced(self, name: str, folder: Path) -> Sliced:
        """The array `name`, unpacked to a file in `folder`."""
        entry = self._entry(name)
        with self._archive.open(entry) as stream:
            shape, fortran_order, dtype = _read_header(stream)
            if dtype.hasobject or not shape:
                return self.load(name)
            unpacked = Spill(self._archive.filename, folder)
            while data := stream.read(_PIECE):
                unpacked.write(data)
        return unpacked.mapped(shape, dtype, fortran_order)

    def _entry(self, name: str) -> zipfile.ZipInfo:
        """Where the array `name` is; ValueError where it is not what it says."""
        entry = self._archive.getinfo(f"{name}.npy")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError("compressed in a way that NumPy does not use")
        with self._archive.open(entry) as stream:
            _check_header(stream, entry.file_size)
        return entry


@contextlib.contextmanager
def _of_python_2() -> Iterator[None]:
    """Without a warning of headers that Python 2 wrote."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def _read_header(stream: Any) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether in Fortran's order, and type of an array."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"version {version} of the format, which numbers and names do not need")
    with _of_python_2():
        return _HEADERS[version](stream)


def _check_header(stream: Any, size: int) -> None:
    """Refuse an array that is not as large as its entry: NumPy makes room for whatever the header says."""
    shape, _, dtype = _read_header(stream)
    left = size - stream.tell()
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"{left} bytes for an array of shape {shape}, {dtype.itemsize} bytes each")
    if dtype.kind in "US":
        check_names(shape)
