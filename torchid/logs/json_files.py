"""Files of JSON: whole documents, an object of arrays or a list of records, and tables of an object in each line."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt
from torchid.guards import MAX_COLUMNS, MAX_LETTERS, MAX_NAMES, check_fields
from torchid.logs.lazy_arrays import ArraysInMemory

_LINE = 2**22  # bytes, at most
_ACCEPTED = 'a JSON object in each line, such as {"t": 0.01, "q": [0.1, 0.2]}'
_NUMBERS_OR_TEXT = "numbers throughout, or text throughout"

JsonColumns = dict[str, "NDArray[np.float64] | list[str | None]"]
"""Columns (N,) of numbers, NaN where a line has none or null, or of texts."""


# ------------------------------------------------------------------------------------------------------------ documents


class JsonDocument(ArraysInMemory):
    """The arrays of a document, read whole; `group/name` of those in objects, and of records in lists."""

    def __init__(self, path: Path) -> None:
        """Read a file; ValueError where it is damaged or holds no object."""
        document = _read(path.read_text(encoding="utf-8-sig"))
        if not isinstance(document, dict) and not _are_records(document):
            raise ValueError(f"a {type(document).__name__}, no object of arrays and no list of records")
        super().__init__(_flat("", document))


def _read(text: str) -> Any:
    """The document, or the list of the records in each line of a text that has several."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2 or not lines[0].lstrip().startswith("{") or not lines[0].rstrip().endswith("}"):
            raise
        return [json.loads(line) for line in lines]


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, dict) for one in value)


def _flat(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays by name; objects, which readers of fields refuse, for what is none."""
    if isinstance(value, dict) and value and list(value) == [str(k) for k in range(len(value))]:
        value = list(value.values())  # a column by the numbers of its rows
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}/{key}".removeprefix("/"), inner)
    elif _are_records(value):
        keys = dict.fromkeys(key for record in value for key in record)
        check_fields((), len(keys))
        for key in keys:
            yield from _flat(f"{name}/{key}".removeprefix("/"), _filled([record.get(key) for record in value]))
    else:
        yield name, _array(value)


def _filled(column: list[Any]) -> list[Any]:
    """A column of records, what some of these lack or have as null in the form of what others have."""
    example = next((one for one in column if one is not None), None)
    if isinstance(example, list):
        return [[None] * len(example) if one is None else one for one in column]
    return [{} if one is None else one for one in column] if isinstance(example, dict) else column


def _array(value: Any) -> NDArray[Any]:
    """Numbers, with NaN for null, truth values, or texts that may be names; an object for anything else."""
    other = np.array(None, dtype=object)
    try:
        found = np.asarray(value)
        found = found.astype(np.float64) if found.dtype == object else found
    except (ValueError, TypeError, OverflowError):  # ragged rows, or nulls among texts
        return other
    longest = found.dtype.itemsize // 4 if found.dtype.kind == "U" else 0
    return other if longest > MAX_LETTERS or (longest and found.size > MAX_NAMES) else found


# ---------------------------------------------------------------------------------------------------------------- lines


@dataclass
class _Rows:
    """Some lines, by column as far as these have it."""

    count: int = 0
    numbers: dict[str, array[float]] = field(default_factory=dict)
    texts: dict[str, list[str | None]] = field(default_factory=dict)

    def add(self, name: str, value: object) -> None:
        """The value of a column, or values of those within it, in the last line; ValueError for one of another kind."""
        if isinstance(value, dict):
            for inner, one in value.items():
                self.add(f"{name}.{inner}" if name else inner, one)
        elif isinstance(value, list):
            for number, one in enumerate(value):
                self.add(f"{name}[{number}]", one)
        elif isinstance(value, str):
            if name in self.numbers:
                raise ValueError(f"'{excerpt(name)}' is text, and a number before")
            self._append(self.texts.setdefault(name, []), name, value, None)
        elif isinstance(value, (bool, int, float)):
            if name in self.texts:
                raise ValueError(f"'{excerpt(name)}' is a number, and text before")
            self._append(self.numbers.setdefault(name, array("d")), name, float(value), np.nan)

    def _append(self, column: Any, name: str, value: Any, empty: Any) -> None:
        """Add the value of the last line, after empty ones of lines without the column."""
        if len(self.numbers) + len(self.texts) > MAX_COLUMNS:
            raise ValueError(f"more than {MAX_COLUMNS} columns")
        if len(column) >= self.count:
            raise ValueError(f"'{excerpt(name)}' twice")
        column.extend([empty] * (self.count - 1 - len(column)))
        column.append(value)

    def whole(self) -> JsonColumns:
        """All columns, as long as there are lines."""
        out: JsonColumns = {}
        for name, numbers in self.numbers.items():
            out[name] = whole = np.full(self.count, np.nan)
            whole[: len(numbers)] = numbers
        return out | {name: [*of, *[None] * (self.count - len(of))] for name, of in self.texts.items()}


def read_json_lines(path: Path, rows: int, check: Callable[[int, int], None]) -> Iterator[JsonColumns]:
    """The columns of so many lines at a time, in the order of the first line that has each.

    Args:
        path: the file.
        rows: lines at a time.
        check: called with the numbers of rows and columns so far, before these take memory.

    Raises:
        LogError: a line that is no object, or a column with numbers in one line and text in another.
    """
    found, before = _Rows(), 0
    with path.open("rb") as stream:
        number = 0
        while line := stream.readline(_LINE):
            number += 1
            if not line.strip():
                continue
            found.count += 1
            _add_line(path, number, line, found)
            if found.count == rows:
                before += rows
                check(before, len(found.numbers) + len(found.texts))
                yield found.whole()
                found = _Rows()
    if found.count:
        check(before + found.count, len(found.numbers) + len(found.texts))
        yield found.whole()


def _add_line(path: Path, number: int, line: bytes, rows: _Rows) -> None:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError) as error:
        text = excerpt(line.decode("utf-8", "replace").strip())
        raise LogError(path, f"line {number}", f"'{text}' ({excerpt(str(error))})", _ACCEPTED) from error
    if not isinstance(value, dict):
        raise LogError(path, f"line {number}", f"a {type(value).__name__}", _ACCEPTED)
    try:
        rows.add("", value)
    except (ValueError, OverflowError, RecursionError) as error:
        raise LogError(path, f"line {number}", excerpt(str(error)), _NUMBERS_OR_TEXT) from error
