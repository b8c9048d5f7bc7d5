"""Single arrays of a log's file: names of joints, contacts, sensors and frames; parts that are a field each."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, is_plain
from torchid.guards import MAX_LETTERS
from torchid.logs.log import SHAPES, check_shape
from torchid.logs.spill import LazyArray


def parse_names(name: str, array: NDArray[Any]) -> tuple[str, ...]:
    """The names in a one-dimensional array of strings or UTF-8 bytes, LogError on anything else or a duplicate."""
    check_shape(name, array, SHAPES[name] or (1,), {})
    if array.size and array.dtype.kind not in "US":
        raise LogError.at_field(name, f"values of type {array.dtype}", "strings")
    try:
        names = tuple(item.decode() if isinstance(item, bytes) else str(item) for item in array.tolist())
    except UnicodeDecodeError as error:
        raise LogError.at_field(name, f"bytes that are no text ({error})", "UTF-8 strings") from error
    seen: set[str] = set()
    for i, item in enumerate(names):
        if len(item) > MAX_LETTERS or not is_plain(item):
            accepted = f"printable names of at most {MAX_LETTERS} characters"
            raise LogError.at_field(name, f"'{excerpt(item)}' at {i}", accepted)
        if not item or item in seen:
            found = f"'{item}' again at {i}" if item else f"an empty name at {i}"
            raise LogError.at_field(name, found, "names that are all different")
        seen.add(item)
    return names


def parse_frame(name: str, array: NDArray[Any]) -> str:
    """The one name in an array of strings or UTF-8 bytes of any shape, LogError on anything else."""
    if array.size != 1:
        raise LogError.at_field(name, f"{array.size} values", "one name")
    return parse_names(name, array.reshape(1))[0]


_PART = re.compile(r"(.+)\[(\d*):(\d*)\]")

Array = NDArray[Any]


def with_parts(given: Sequence[str], wanted: Iterable[str]) -> list[str]:
    """Names of arrays, those of which a map wants parts replaced by these."""
    parts, whole = dict[str, list[str]](), set[str]()
    for text in wanted:
        whole.add(text)
        match = _PART.fullmatch(text)
        if match is not None and text not in given and match[1] in given:
            parts.setdefault(match[1], []).append(text)
    for name in whole & set(parts):
        parts[name].append(name)
    return [text for name in given for text in dict.fromkeys(parts.get(name, [name]))]


def load_part(name: str, given: Sequence[str], load: Callable[[str], Array]) -> Array:
    """An array of a file, or the part of one that a name of `with_parts` means.

    Raises:
        LogError: an array that has not so many columns.
    """
    if name in given or (match := _PART.fullmatch(name)) is None:
        return load(name)
    array = load(match[1])
    return np.asarray(array[:, _columns(match, array.shape)])


class LazyPart:
    """Some columns of an array that is read where it is sliced."""

    def __init__(self, array: LazyArray, match: re.Match[str]) -> None:
        """The part of an array that a name means; LogError where it has not so many columns."""
        self._array, self._columns = array, _columns(match, array.shape)
        width = len(range(*self._columns.indices(array.shape[1])))
        self.dtype, self.shape = array.dtype, (array.shape[0], width, *array.shape[2:])

    def __getitem__(self, rows: slice) -> Array:
        """Some rows."""
        return np.asarray(self._array[rows][:, self._columns])


def lazy_part(name: str, given: Sequence[str], lazy: Callable[[str], LazyArray]) -> LazyArray:
    """As `load_part`, of arrays that are read where they are sliced."""
    if name in given or (match := _PART.fullmatch(name)) is None:
        return lazy(name)
    return LazyPart(lazy(match[1]), match)


def _columns(match: re.Match[str], shape: tuple[int, ...]) -> slice:
    """The columns that a name means, of an array of a shape."""
    start, stop = int(match[2] or 0), int(match[3]) if match[3] else None
    width = shape[1] if len(shape) > 1 else 0
    if start >= (width if stop is None else stop) or (stop or 0) > width:
        found = f"an array of shape ({', '.join(map(str, ('N', *shape[1:])))})"
        raise LogError.at_field(f"'{match[0]}'", found, "columns that it has, counted from 0")
    return slice(start, stop)
