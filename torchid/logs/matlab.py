"""Files of Matlab before 7.3 (the only module that imports scipy.io); later ones are HDF5."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.guards import MAX_ARRAYS, check_names, check_unpacked_size
from torchid.logs.lazy_arrays import ArraysInMemory

_HEADER = 128
_ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}  # of bytes, by version and mark at the end of the header
_FLAGS, _MATRIX, _COMPRESSED, _OBJECT = 6, 14, 15, 17
_NUMBERS, _WHOLE = {*range(1, 8), 9, 12, 13}, {5, 6}
#: Kinds of elements in an array, by its class: cells and structures hold arrays, characters texts, the rest numbers.
_INSIDE = (
    dict.fromkeys(range(6, 16), _NUMBERS)
    | dict.fromkeys((1, 2, 3, _OBJECT), {*_NUMBERS, _MATRIX})
    | {4: {*_NUMBERS, 16, 17, 18}}
)
_OF_NUMBERS = 4  # elements: flags, shape, name, numbers
_MOST_AXES, _COMPLEX = 8, 0x800
#: Elements in a file, arrays and their parts, those in structures too: some four for each array.
_MOST_ELEMENTS = 10_000
_PIECE = 2**22


class MatFile(ArraysInMemory):
    """The arrays of a file of Matlab 5 to 7.2, read whole; `structure/field` of those in structures."""

    def __init__(self, path: Path) -> None:
        """Read a file; LogError where it unpacks to too much, any exception where it is damaged."""
        from scipy.io import loadmat

        _check(path)
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


def _check(path: Path) -> None:
    """Refuse a file that unpacks to more than one of its size may, or has more elements than a log.

    SciPy trusts what such a file says: it follows arrays in arrays however deep, until the stack is full, and reserves
    whatever shapes promise.
    """
    total, left, order = 0, _MOST_ELEMENTS, byte_order(path)
    with path.open("rb") as stream:
        stream.seek(_HEADER)
        while len(tag := stream.read(8)) == 8:
            kind, size = struct.unpack(f"{order}II", tag)
            content, pieces = stream.read(min(size, MAX_ARRAYS)), list[bytes]()
            for piece in _unpacked(content) if kind == _COMPRESSED else [tag + content]:
                total += len(piece)
                check_unpacked_size(path, total)
                pieces.append(piece)
            left = _count_down(b"".join(pieces), order, left)


def _unpacked(content: bytes) -> Iterator[bytes]:
    unpack = zlib.decompressobj()
    while piece := unpack.decompress(content, _PIECE):
        yield piece
        content = unpack.unconsumed_tail


def _count_down(data: bytes, order: str, left: int) -> int:
    """How many elements there may be after those of `data`; ValueError where none is left, or one is no array's."""
    spans = [(0, len(data), False)]
    while spans:
        at, stop, is_inner = spans.pop()
        kinds, before = _check_array(data, order, at, stop) if is_inner else {_MATRIX}, left
        while at < stop:
            kind, size = struct.unpack_from(f"{order}II", data, at)
            small, kind = kind >> 16, kind & 0xFFFF  # up to 4 bytes lie in the tag itself
            if (left := left - 1) < 0:
                raise ValueError(f"more than {_MOST_ELEMENTS} elements")
            if kind not in kinds or small > 4 or at + 8 + size * (not small) > stop:
                raise ValueError(f"an element of kind {kind} and {small or size} bytes, where there can be none")
            if kind == _MATRIX and size:
                spans.append((at + 8, at + 8 + size, True))
            at += 8 if small else 8 + size + -size % 8
        if _MATRIX not in kinds and before - left != _OF_NUMBERS:  # where SciPy would go on behind it
            raise ValueError("an array without numbers")
    return left


def _check_array(data: bytes, order: str, at: int, stop: int) -> set[int]:
    """The kinds of elements in an array; ValueError for one with more elements than bytes, or no known class."""
    kind, size, flags, _, of_shape, bytes_of_shape, *shape = struct.unpack_from(f"{order}8I", data, at)
    of_class = flags & 0xFF
    if (kind, size) != (_FLAGS, 8) or of_class not in _INSIDE or flags & _COMPLEX:
        raise ValueError("an array without flags, or of complex numbers, or of another class")
    if of_class != _OBJECT:  # whose shape is elsewhere
        count = bytes_of_shape // 4
        shape = [*struct.unpack_from(f"{order}{min(count, _MOST_AXES)}I", data, at + 24)]
        if of_shape not in _WHOLE or not 2 <= count <= _MOST_AXES or math.prod(shape) > stop - at:
            raise ValueError(f"an array of shape {tuple(shape)} in {stop - at} bytes")
    return _INSIDE[of_class]
