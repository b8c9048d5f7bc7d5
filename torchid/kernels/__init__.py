"""Kernels for the rows of a chunk, compiled by Numba (extra `[fast]`): what they work on stays in a processor's caches.

Importing a module of this package compiles its kernels, or loads what Numba has kept of them on disk. It compiles anew
when the kernel's own module has changed, but not for a change of others: whoever edits one of them deletes the
`*.nbi` and `*.nbc` in `__pycache__`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from ctypes import CDLL, c_uint
from functools import cache
from pathlib import Path
from zlib import crc32

_announcers: list[Callable[[], AbstractContextManager[object]]] = []


@contextmanager
def compiling_announced(announce: Callable[[], AbstractContextManager[object]]) -> Iterator[None]:
    """Enter what `announce` returns while kernels are compiled, not where Numba has kept them on disk."""
    _announcers.append(announce)
    try:
        yield
    finally:
        _announcers.remove(announce)


def announced() -> AbstractContextManager[object]:
    """What is to be entered while a kernel is compiled."""
    return _announcers[-1]() if _announcers else nullcontext()


def compiled() -> CDLL | None:
    """The library of the C++ kernels; None where it is missing, see `why_not_compiled`. Calls release Python's lock."""
    return _load()[0]


def why_not_compiled() -> str:
    """Why `compiled` is None, and what to do, in one line."""
    return _load()[1]


@cache
def _load() -> tuple[CDLL | None, str]:
    folder = Path(__file__).parent
    reinstall = "then reinstall torchid with pip"
    libraries = sorted(folder.glob("_compiled*.so"), key=lambda path: path.stat().st_mtime)
    if not libraries:
        return None, f"torchid was installed without a C++ compiler: install g++ or clang, {reinstall}"
    try:
        library = CDLL(str(libraries[-1]))
    except OSError as error:
        return None, f"{libraries[-1]} does not load ({error}): install g++ or clang, {reinstall}"
    library.torchid_checksum.restype = c_uint
    sources = sorted(path for pattern in ("*.cpp", "*.h") for path in folder.glob(pattern))
    if library.torchid_checksum() != crc32(b"".join(path.read_bytes() for path in sources)):
        return None, "the C++ sources of torchid changed after they were compiled: reinstall torchid with pip"
    if not library.torchid_supported():
        return None, "torchid was compiled for another processor: reinstall torchid with pip on this machine"
    return library, ""
