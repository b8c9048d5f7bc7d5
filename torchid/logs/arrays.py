"""Single arrays of a log's file: names of joints, contacts, sensors and frames; parts that are a field each."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, is_plain
from torchid.guards import MAX_LETTERS
from torchid.logs.lazy_arrays import LazyArray
from torchid.logs.log import SHAPES, check_shape


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


_COLUMNS = re.compile(r"(.+)\[(\d*):(\d*)\]")
_FIELD = re.compile(r"(.+)\['([^'\[\]]+)'\]")
TRANSPOSED = ".T"
"""Behind the name of an array whose columns are the samples."""

_TRANSPOSED = re.compile(rf"(.+){re.escape(TRANSPOSED)}")

AnyArray = NDArray[Any]


@dataclass(frozen=True)
class _Part:
    """What a name means of another array: some columns, a field of records, or the transposed array.

    Attributes:
        text: the name.
        of: name of the other array, or part.
        columns: first and last of `[3:7]`.
        field: of `['q']`.
    """

    text: str
    of: str
    columns: tuple[str, str] | None = None
    field: str | None = None

    @classmethod
    def of_name(cls, text: str) -> _Part | None:
        """What a name means; None for one of an array as it is."""
        if (match := _COLUMNS.fullmatch(text)) is not None:
            return cls(text, match[1], columns=(match[2], match[3]))
        if (match := _FIELD.fullmatch(text)) is not None:
            return cls(text, match[1], field=match[2])
        match = _TRANSPOSED.fullmatch(text)
        return None if match is None else cls(text, match[1])

    @property
    def is_transposed(self) -> bool:
        """Whether samples are the columns of the other array."""
        return self.columns is None and self.field is None

    def __call__(self, array: AnyArray) -> AnyArray:
        """The part of an array, or of some of its rows."""
        self.require(array.dtype, array.shape)
        if self.columns is not None:
            return np.asarray(array[:, self.slice(array.shape)])
        return np.asarray(array.T if self.field is None else array[self.field])

    def require(self, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        """Make sure that an array has the part; LogError where it has not."""
        by_samples = f"an array of shape ({', '.join(map(str, ('N', *shape[1:])))})"
        if self.columns is not None:
            self.slice(shape)
        elif self.field is not None and self.field not in (dtype.names or ()):
            accepted = f"fields of '{self.of}': {', '.join(dtype.names)}" if dtype.names else "an array of records"
            raise LogError.at_field(f"'{self.text}'", "no such field" if dtype.names else by_samples, accepted)
        elif self.is_transposed and len(shape) != 2:
            raise LogError.at_field(f"'{self.text}'", f"an array of shape {shape}", "one of rows and columns")

    def slice(self, shape: tuple[int, ...]) -> slice:
        """The columns, of an array of a shape; LogError where it has not so many."""
        first, last = self.columns or ("", "")
        start, stop = int(first or 0), int(last) if last else None
        width = shape[1] if len(shape) > 1 else 0
        if start >= (width if stop is None else stop) or (stop or 0) > width:
            found = f"an array of shape ({', '.join(map(str, ('N', *shape[1:])))})"
            raise LogError.at_field(f"'{self.text}'", found, "columns that it has, counted from 0")
        return slice(start, stop)


def _root(text: str, given: Collection[str]) -> str | None:
    """The array of a file that a name means a part of, or the name itself; None where there is none."""
    while text not in given:
        if (part := _Part.of_name(text)) is None:
            return None
        text = part.of
    return text


_A = TypeVar("_A", bound=LazyArray)


def require_plain(name: str, array: _A) -> _A:
    """The array itself; LogError for one of Python objects, which no reader of a log loads."""
    if array.dtype.hasobject:
        accepted = "plain arrays, one for each field: numpy.savez(path, time=..., q=...)"
        raise LogError.at_field(name, "Python objects (pickled), references or ragged rows", accepted)
    return array


def fields_of_records(name: str, array: AnyArray) -> Iterator[tuple[str, AnyArray]]:
    """The fields of an array of records, by the names that mean them, of records in records too; else the array."""
    if not array.dtype.names:
        yield name, array
    for field in array.dtype.names or ():
        yield from fields_of_records(f"{name}['{field}']", array[field])


def with_parts(given: Sequence[str], wanted: Iterable[str]) -> list[str]:
    """Names of arrays, those of which a map wants parts replaced by these."""
    parts = dict[str, list[str]]()
    for text in wanted:
        if (root := _root(text, given)) is not None:
            parts.setdefault(root, []).append(text)
    return [text for name in given for text in dict.fromkeys(parts.get(name, [name]))]


def load_part(name: str, given: Collection[str], load: Callable[[str], AnyArray]) -> AnyArray:
    """An array of a file, or the part of one that a name of `with_parts` means.

    Raises:
        LogError: an array that has no such part.
    """
    if name in given or (part := _Part.of_name(name)) is None:
        return load(name)
    return part(load_part(part.of, given, load))


class LazyPart:
    """A part of an array that is read where it is sliced."""

    def __init__(self, array: LazyArray, part: _Part) -> None:
        """The part of an array that a name means; LogError where it has not so many columns."""
        part.require(array.dtype, array.shape)
        self._array, self._part = array, part
        if part.is_transposed:
            self.dtype, self.shape = array.dtype, array.shape[::-1]
            return
        example = part(np.empty((0, *array.shape[1:]), array.dtype))
        self.dtype, self.shape = example.dtype, (array.shape[0], *example.shape[1:])

    def __getitem__(self, rows: slice) -> AnyArray:
        """Some rows; of a transposed array one of its own rows is read at a time."""
        if not self._part.is_transposed:
            return self._part(np.asarray(self._array[rows]))
        of_rows = (np.asarray(self._array[k : k + 1])[0, rows] for k in range(self.shape[1]))
        return np.stack(list(of_rows), axis=1)


def lazy_part(name: str, given: Collection[str], lazy: Callable[[str], LazyArray]) -> LazyArray:
    """As `load_part`, of arrays that are read where they are sliced."""
    if name in given or (part := _Part.of_name(name)) is None:
        return lazy(name)
    return LazyPart(lazy_part(part.of, given, lazy), part)
