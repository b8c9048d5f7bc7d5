"""Kernels for the rows of a chunk, compiled by Numba (extra `[fast]`): what they work on stays in a processor's caches.

Importing a module of this package compiles its kernels, or loads what Numba has kept of them on disk. It compiles anew
when the kernel's own module has changed, but not for a change of others: whoever edits one of them deletes the
`*.nbi` and `*.nbc` in `__pycache__`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

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
