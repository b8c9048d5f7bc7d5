"""Files of Matlab before 7.3 (the only module that imports scipy.io); later ones are HDF5."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.guards import check_names
from torchid.logs.lazy_arrays import ArraysInMemory

_HEADER = 128
_ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}  # of bytes, by version and mark at the end of the header


class MatFile(ArraysInMemory):
    """The arrays of a file of Matlab 5 to 7.2, read whole; `structure/field` of those in structures."""

    def __init__(self, path: Path) -> None:
        """Read a file; any exception where it is damaged."""
        from scipy.io import loadmat

        read = loadmat(path, simplify_cells=True)
        super().__init__(_flat("", {name: x for name, x in read.items() if not name.startswith("__")}))


def _flat(name: str, value: object) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays by name; lists of texts as arrays of str, others as objects, which readers of fields refuse."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}/{key}".removeprefix("/"), inner)
        return
    array = np.asarray(value) if isinstance(value, (np.ndarray, str, int, float)) else np.array(None, dtype=object)
    texts = array.ravel().tolist() if array.dtype == object else []
    if texts and all(isinstance(text, str) for text in texts):
        check_names(array.shape, max(map(len, texts)))
        array = array.astype(np.str_)
    yield name, array


def byte_order(path: Path) -> str:
    """That of a file of Matlab 5 to 7.2, < or >; "" of any other file."""
    with path.open("rb") as stream:
        return _ORDERS.get(stream.read(_HEADER)[-4:], "")
