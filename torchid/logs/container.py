"""The two file containers, .npz and HDF5, as a list of names and one array for each."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, TorchidError, during
from torchid.guards import MAX_ARRAYS, check_growth
from torchid.logs.hdf5 import Hdf5, import_h5py, save_hdf5
from torchid.logs.npz import Npz, open_archive
from torchid.logs.spill import Sliced
from torchid.staging import whole_file
from torchid.text import shown

SUFFIXES = (".npz", ".h5", ".hdf5")

#: Characters of another package's message that a message of ours repeats.
_LONGEST_TEXT = 200


class Container(Protocol):
    """An open file: what it declares, and its arrays one at a time."""

    def sizes(self) -> dict[str, int]:
        """Declared bytes of each array, by name."""

    def load(self, name: str) -> NDArray[Any]:
        """The array `name`; text is an array of str or of UTF-8 bytes."""

    def sliced(self, name: str, folder: Path) -> Sliced:
        """The array `name`, not read before it is sliced; what has to be unpacked goes to a file in `folder`."""


@contextlib.contextmanager
def translated(source: str, field: str, accepted: str) -> Iterator[None]:
    """Turn whatever the readers raise on a damaged file, of which no list is ever complete, into one LogError."""
    try:
        yield
    except (TorchidError, Warning):
        raise
    except Exception as error:
        text = shown(" ".join(str(error).split()), _LONGEST_TEXT)  # some readers quote the file
        raise LogError(source, field, f"cannot be read ({type(error).__name__}: {text})", accepted) from error


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise LogError(path, "file", f"extension '{path.suffix}'", ", ".join(SUFFIXES))
    return suffix


@contextlib.contextmanager
def open_container(path: Path, whole: bool = True) -> Iterator[Container]:
    """Open a .npz, .h5 or .hdf5 file; LogError where it is absent, of another kind, damaged or declares too much.

    Args:
        path: the file.
        whole: whether its arrays are to be read whole, and are refused if no memory holds them.
    """
    suffix = _suffix(path)
    if not path.is_file():
        found = "a folder" if path.is_dir() else "no such file"
        raise LogError(path, "file", found, f"an existing log ({', '.join(SUFFIXES)})")
    kind = "a complete .npz (zip) archive" if suffix == ".npz" else "a complete HDF5 file"
    with contextlib.ExitStack() as stack:
        with translated(str(path), "file", kind):
            container: Container
            if suffix == ".npz":
                container = Npz(stack.enter_context(open_archive(path)))
            else:
                h5py = import_h5py(path)
                container = Hdf5(stack.enter_context(h5py.File(path, "r")), h5py, path.stat().st_size)
            total = sum(container.sizes().values())
        if whole and total > MAX_ARRAYS:
            raise LogError(path, "file", f"arrays of {total} bytes", f"at most {MAX_ARRAYS} bytes in all")
        check_growth(path, total)
        yield container


@contextlib.contextmanager
def appearing_whole(path: Path) -> Iterator[Path]:
    """A temporary name that becomes `path` when the block ends without an error: no half-written file is left.

    Raises:
        LogError: the file cannot be written.
    """
    try:
        with whole_file(path) as temporary, during("writing", path):
            yield temporary
    except OSError as error:
        raise LogError(path, "file", f"cannot be written ({error})", "a path in a writable folder") from error


def save_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays to a .npz, .h5 or .hdf5 file, which appears complete or not at all."""
    suffix = _suffix(path)
    with appearing_whole(path) as temporary:
        if suffix == ".npz":
            with temporary.open("xb") as stream:
                named: dict[str, Any] = dict(arrays)
                np.savez(stream, **named)
        else:
            save_hdf5(import_h5py(path), temporary, arrays)
