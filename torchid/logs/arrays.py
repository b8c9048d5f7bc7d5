"""Single arrays of a log's file: names of joints, contacts, sensors and frames; parts that are a field each."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, is_plain
from torchid.guards import MAX_LETTERS
from torchid.logs.log import SHAPES, check_shape


def parse_names(name: str, array: NDArray[Any]) -> tuple[str, ...]:
    """The names in a one-dimensional array of strings or UTF-8 bytes; LogError for other values or duplicates."""
    check_shape(name, array, SHAPES[name] or (1,), {})
    if array.size and array.dtype.kind not in "US":
        raise LogError.at_field(name, f"values of type {array.dtype}", "strings")
    try:
        names = tuple(item.decode() if isinstance(item, bytes) else str(item) for item in array.tolist())
    except UnicodeDecodeError as error:
        raise LogError.at_field(name, f"not text ({error})", "UTF-8 strings") from error
    seen: set[str] = set()
    for i, item in enumerate(names):
        if len(item) > MAX_LETTERS or not is_plain(item):
            accepted = f"printable names of at most {MAX_LETTERS} characters"
            raise LogError.at_field(name, f"'{excerpt(item)}' at {i}", accepted)
        if not item or item in seen:
            reason = f"'{item}' again at {i}" if item else f"an empty name at {i}"
            raise LogError.at_field(name, reason, "different names")
        seen.add(item)
    return names


def parse_frame(name: str, array: NDArray[Any]) -> str:
    """The single name in an array of strings or UTF-8 bytes of any shape; LogError for anything else."""
    if array.size != 1:
        raise LogError.at_field(name, f"{array.size} values", "one name")
    return parse_names(name, array.reshape(1))[0]


ARRAY_ACCEPTED = "a plain array of numbers, booleans or text"
"""Accepted value, for an array that cannot be read."""

TRANSPOSED = ".T"
"""Suffix of the name of an array with samples as columns."""

_PART = re.compile(r"(?P<array>.+)(?:\[(?P<first>\d*):(?P<last>\d*)\]|\['(?P<field>[^'\[\]]+)'\]|\.T)")
"""Parts of an array that a name may mean: some columns, a field of records, or the transposed array."""

AnyArray = NDArray[Any]


def _split_parts(name: str, given: Collection[str]) -> tuple[str, list[re.Match[str]]]:
    """The array behind a name with parts, and these parts, the outermost first."""
    parts = list[re.Match[str]]()
    while name not in given and (part := _PART.fullmatch(name)) is not None:
        parts.insert(0, part)
        name = part["array"]
    return name, parts


def _part_of(array: AnyArray, part: re.Match[str]) -> AnyArray:
    """A part of an array; LogError if the array has no such part."""
    by_samples = f"an array of shape ({', '.join(map(str, ('N', *array.shape[1:])))})"
    if (field := part["field"]) is not None:
        fields = array.dtype.names
        if field in (fields or ()):
            return np.asarray(array[field])
        accepted = f"fields of '{part['array']}': {', '.join(fields)}" if fields else "an array of records"
        raise LogError.at_field(f"'{part[0]}'", "no such field" if fields else by_samples, accepted)
    if part["first"] is None:
        if array.ndim != 2:
            raise LogError.at_field(f"'{part[0]}'", f"a {array.ndim}-dimensional array", "a 2-dimensional array")
        return array.T
    width = array.shape[1] if array.ndim > 1 else 0
    start = int(part["first"] or 0)
    stop = int(part["last"] or width)
    if start >= stop or stop > width:
        raise LogError.at_field(f"'{part[0]}'", by_samples, "existing columns, counted from 0")
    return np.asarray(array[:, start:stop])


def load_part(name: str, given: Collection[str], load: Callable[[str], AnyArray]) -> AnyArray:
    """An array of a file, or a part of one, by a name of `with_parts`.

    Raises:
        LogError: the array has no such part.
    """
    array_name, parts = _split_parts(name, given)
    array = load(array_name)
    for part in parts:
        array = _part_of(array, part)
    return array


def sample_axis(name: str, given: Collection[str]) -> tuple[str, int]:
    """The array behind a name, and its axis of samples, 0 or 1."""
    array_name, parts = _split_parts(name, given)
    return array_name, sum(part[0].endswith(TRANSPOSED) for part in parts) % 2


def with_parts(given: Sequence[str], wanted: Iterable[str]) -> list[str]:
    """Names of arrays; if a map wants parts of an array, the names of these parts instead."""
    parts = defaultdict[str, dict[str, None]](dict)
    for text in wanted:
        parts[_split_parts(text, given)[0]][text] = None
    return [text for name in given for text in parts.get(name, [name])]


def require_plain(name: str, array: AnyArray) -> AnyArray:
    """The array itself; LogError for an array of Python objects."""
    if array.dtype.hasobject:
        accepted = "one plain array per field: numpy.savez(path, time=..., q=...)"
        raise LogError.at_field(name, "Python objects (pickled), references or ragged rows", accepted)
    return array


def fields_of_records(name: str, array: AnyArray) -> Iterator[tuple[str, AnyArray]]:
    """The fields of an array of records by name, also of nested records; any other array itself."""
    if not array.dtype.names:
        yield name, array
    for field in array.dtype.names or ():
        yield from fields_of_records(f"{name}['{field}']", array[field])
