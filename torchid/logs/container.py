"""The two file containers, .npz and HDF5, as a list of names and one array for each."""

from __future__ import annotations

import contextlib
import lzma
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError

SUFFIXES = (".npz", ".h5", ".hdf5")

#: Most bytes that the arrays of one file may declare: 16 GiB are 2e7 samples of a 30-joint robot with three channels
#: a joint. A compressed file of a few kilobytes can declare far more than any memory holds.
MAX_BYTES = 16 * 2**30

_UNREADABLE = (
    OSError, EOFError, ValueError, TypeError, KeyError, RuntimeError, MemoryError,
    struct.error, zlib.error, lzma.LZMAError, zipfile.BadZipFile,
)  # fmt: skip


class Container(Protocol):
    """An open file: what it declares, and its arrays one at a time."""

    def sizes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of str or of UTF-8 bytes."""


class _Npz:
    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive

    def sizes(self) -> dict[str, int]:
        entries = self._archive.infolist()
        sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in entries}
        if len(sizes) != len(entries):
            raise ValueError("a name occurs twice")
        return sizes

    def load(self, name: str) -> NDArray[Any]:
        with self._archive.open(f"{name}.npy") as stream:
            array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
        return array


class _Hdf5:
    def __init__(self, file: Any, h5py: Any) -> None:
        self._file, self._h5py = file, h5py

    def sizes(self) -> dict[str, int]:
        return {name: int(getattr(self._file.get(name), "nbytes", 0)) for name in self._file}

    def load(self, name: str) -> NDArray[Any]:
        item = self._file[name]
        if not isinstance(item, self._h5py.Dataset) or item.shape is None:
            raise TypeError("not a dataset with values")
        array = np.asarray(item[()])
        # bytes rather than h5py's own decoding, which takes fixed-width text for ASCII
        return array if self._h5py.check_string_dtype(item.dtype) is None else array.astype(np.bytes_)


@contextlib.contextmanager
def translated(source: str, field: str, accepted: str) -> Iterator[None]:
    """Turn whatever the readers raise on a damaged file into one LogError."""
    try:
        yield
    except LogError:
        raise
    except _UNREADABLE as error:
        raise LogError(source, field, f"cannot be read ({type(error).__name__}: {error})", accepted) from error


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise LogError(path, "file", f"extension '{path.suffix}'", ", ".join(SUFFIXES))
    return suffix


def _h5py(path: Path) -> Any:
    """The module h5py, or a LogError: only those who use HDF5 need it."""
    try:
        import h5py
    except ImportError as error:
        raise LogError(path, "file", "HDF5, but h5py is not installed", "a .npz file, or an installed h5py") from error
    return h5py


@contextlib.contextmanager
def open_container(path: Path) -> Iterator[Container]:
    """Open a .npz, .h5 or .hdf5 file; LogError where it is absent, of another kind, damaged or declares too much."""
    suffix = _suffix(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise LogError(path, "file", found, f"an existing log ({', '.join(SUFFIXES)})")
    kind = "a complete .npz (zip) archive" if suffix == ".npz" else "a complete HDF5 file"
    with contextlib.ExitStack() as stack:
        with translated(str(path), "file", kind):
            container: Container
            if suffix == ".npz":
                container = _Npz(stack.enter_context(zipfile.ZipFile(path)))
            else:
                h5py = _h5py(path)
                container = _Hdf5(stack.enter_context(h5py.File(path, "r")), h5py)
            total = sum(container.sizes().values())
        if total > MAX_BYTES:
            raise LogError(path, "file", f"arrays of {total} bytes", f"at most {MAX_BYTES} bytes in all")
        yield container


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a .npz, .h5 or .hdf5 file under a temporary name, then rename: no half-written file is left."""
    suffix = _suffix(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        if suffix == ".npz":
            with temporary.open("xb") as stream:
                named: dict[str, Any] = dict(arrays)
                np.savez(stream, **named)
        else:
            _save_hdf5(_h5py(path), temporary, arrays)
        temporary.replace(path)
    except OSError as error:
        raise LogError(path, "file", f"cannot be written ({error})", "a path in a writable folder") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _save_hdf5(h5py: Any, path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    with h5py.File(path, "x") as file:
        for name, array in arrays.items():
            if array.dtype.kind == "U":
                file.create_dataset(name, data=array.astype(object), dtype=h5py.string_dtype())
            else:
                file.create_dataset(name, data=array)
