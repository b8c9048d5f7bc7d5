"""Pages of files that tensors are mapped to, which count as memory of the process once they were read."""

from __future__ import annotations

import mmap
from collections.abc import Iterable
from typing import Any

from numpy.typing import NDArray

_DONTNEED = getattr(mmap, "MADV_DONTNEED", None)  # not on Windows


class MappedPages:
    """The pages of some arrays that are mapped to files."""

    def __init__(self, arrays: Iterable[NDArray[Any]]) -> None:
        """Those of the arrays that are mapped, of all given ones."""
        bases: list[object] = [array.base for array in arrays]
        self._maps = [one for one in bases if isinstance(one, mmap.mmap)]

    def let_go(self) -> None:
        """Take them out of memory; they come back where they are used."""
        if _DONTNEED is not None:
            for one in self._maps:
                one.madvise(_DONTNEED)

    def __reduce__(self) -> tuple[Any, ...]:
        """Tensors that another process gets are in its memory."""
        return MappedPages, ((),)
