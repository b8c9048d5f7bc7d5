"""Kernels in C++ for fits and modules: compiled when torchid is installed, called through `ctypes`.

Rows of fits: `limbs.cpp`, `rows.cpp` and `gram.cpp`, called by `torchid.problem.compiled_rows`.
"""

from __future__ import annotations

from ctypes import CDLL, c_double, c_int64, c_uint
from functools import cache
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from torch import Tensor

Word = Tensor | np.ndarray | int


def compiled() -> CDLL | None:
    """The library of the kernels; None where it is missing, see `why_not_compiled`. Calls release Python's lock."""
    return _load()[0]


def why_not_compiled() -> str:
    """Why `compiled` is None, and what to do, in one line."""
    return _load()[1]


def lanes() -> int:
    """Samples that a kernel handles at once: numbers of float64 in a register of the processor."""
    library = compiled()
    return 1 if library is None else library.torchid_lanes()


def call(name: str, *arguments: Word | tuple[Word, ...] | float) -> None:
    """Call a kernel with contiguous arrays, integers, floats, and tuples of arrays and integers for structures."""
    getattr(compiled(), name)(*map(_converted, arguments))


def _converted(argument: Word | tuple[Word, ...] | float) -> Any:
    if isinstance(argument, tuple):
        return (c_int64 * len(argument))(*map(_word, argument))
    return c_double(argument) if isinstance(argument, float) else c_int64(_word(argument))


def _word(value: Word) -> int:
    """An integer, or the address of an array."""
    if isinstance(value, int):
        return value
    if not (value.is_contiguous() if isinstance(value, Tensor) else value.flags.c_contiguous):
        raise ValueError("expected a contiguous array")
    return value.data_ptr() if isinstance(value, Tensor) else value.ctypes.data


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
