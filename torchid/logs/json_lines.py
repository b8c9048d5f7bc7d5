"""Tables of JSON lines, one object a line: what is within others has a name such as `imu.acc[2]`."""

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
from torchid.guards import MAX_COLUMNS

_LINE = 2**22  # bytes, at most
_ACCEPTED = 'a JSON object in each line, such as {"t": 0.01, "q": [0.1, 0.2]}'
_NUMBERS_OR_TEXT = "numbers throughout, or text throughout"

JsonColumns = dict[str, "NDArray[np.float64] | list[str | None]"]
"""Columns (N,) of numbers, NaN where a line has none or null, or of texts."""


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
