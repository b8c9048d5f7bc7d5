"""What the columns of a table are called: lines before the rows of CSV or OpenSim's text, and nested Parquet columns.

Nested are `state.q` of a structure, and `q[0]`, `q[1]`, ... of a column of lists. pyarrow is passed in by
`torchid.logs.tables`, the only module that imports it.
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from torchid.errors import LogError, excerpt
from torchid.guards import MAX_LIST
from torchid.logs.containers import OPENSIM
from torchid.logs.units import quantities_with

BLOCK = 2**22
"""Bytes of a table of text that are parsed at a time; no row may be longer."""

_LINES = 64  # at most before the first row
_SEPARATORS = (",", ";", "\t")
_COMMENT = re.compile(r"^(#|%|//)\s*")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)|true|false", re.IGNORECASE)
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d{1,9})?)?(Z|[+-]\d\d:?\d\d)?")
_TIME_OF_DAY = re.compile(r"\d\d:\d\d:\d\d(\.\d{1,9})?")
_END, _MOST_LINES = "endheader", 1000  # before OpenSim's names of columns
_DEGREES = re.compile(r"\s*inDegrees\s*=\s*(\S*)\s*", re.IGNORECASE)
_BRACKETS = re.compile(r"\[(.*)\]|\((.*)\)")
#: A cell such as -1,5 or 1,5e-3 between semicolons, tabs or spaces.
_DECIMAL_COMMA = re.compile(rb'(?:^|[;\t\n ])[ "]*[+-]?\d*,\d+(?:[eE][+-]?\d+)?[ "]*(?=[;\t\r\n ]|\Z)')


@dataclass(frozen=True)
class TextHeader:
    """The lines of a table of text before its rows.

    Attributes:
        texts: names of the columns, with their units in brackets where these have a line of their own.
        lines: how many there are before the first row, the names and remarks above them.
        separator: between cells.
        decimal_mark: . or ,
        is_all: whether the file has no rows.
        dates: columns whose first cell is a date with a time of day, and whether that states its zone.
        times_of_day: columns whose first cell is hours, minutes and seconds.
        is_open: whether rows end with a separator, so that the last column is empty.
        in_degrees: whether angles are in degrees.
        encoding: of its letters: that of most files, or that of western Europe's spreadsheets.
    """

    texts: list[str]
    lines: int
    separator: str
    decimal_mark: str
    is_all: bool
    dates: dict[str, bool]
    times_of_day: tuple[str, ...]
    is_open: bool
    in_degrees: bool
    encoding: str

    @property
    def named(self) -> list[str]:
        """The columns, but for an empty one behind the last separator."""
        return self.texts[: len(self.texts) - self.is_open]


def read_header(path: Path) -> TextHeader:
    """The names of the columns of a .csv, .mot or .sto file; the decimal mark is that of the rows.

    Names are in the first line with as many cells as the first row that is mostly numbers. Lines above are remarks, a
    line of units may follow, or more names where that line has some twice. A column without a name is called
    `unnamed_0` by its place; where there is no line of names, all are called `column_0`, ... In OpenSim's tables all
    that is below the line `endheader`.

    Raises:
        LogError: no names, or a line that is too long.
    """
    is_opensim = path.suffix.lower() in OPENSIM
    with path.open("rb") as stream:
        above, in_degrees = _opensim_lines(path, stream) if is_opensim else (0, False)
        lines = [line for _ in range(_LINES) if (line := stream.readline(BLOCK))]
        rest = stream.read(BLOCK)
    encoding = _encoding(lines)
    texts = [line.decode(encoding, "replace").removeprefix("\ufeff").rstrip("\r\n") for line in lines]
    row = next((number for number, text in enumerate(texts) if _is_row(text)), len(texts))
    named = _named(texts, row)
    _require_names(path, lines, texts, named, row, is_opensim)
    if named == row:
        return _without_names(texts, row, above, b"".join(lines[row:]) + rest, encoding)
    first = next((number for number in range(named + 1, row) if not _COMMENT.match(texts[number])), min(row, named + 1))
    title = _COMMENT.sub("", texts[named])
    separator = _separator(path, title, "".join(texts[row : row + 1]), is_opensim)
    cells = [cell.strip() for cell in _cells(title, separator)]
    if row == first + 1 and _is_units(texts[first], separator, len(cells)):
        units = _cells(_COMMENT.sub("", texts[first]), separator)
        cells = [_with_unit(*pair) for pair in zip(cells, units, strict=True)]
        first = row
    elif levels := _levels(cells, texts[first:row], separator):
        cells = [".".join(filter(None, names)) for names in zip(cells, *levels, strict=True)]
        first = row
    sample = [cell.strip() for cell in _cells(texts[first], separator)] if first < len(texts) else []
    cells += [""] * (len(sample) == len(cells) + 1 and not sample[-1])  # a separator at the end of each row
    cells = cells[: len(cells) - (len(sample) == len(cells) - 1 and not cells[-1])]  # or at that of the names alone
    names = [name or f"unnamed_{number}" for number, name in enumerate(cells)]
    rows = b"".join(lines[first:]) + rest
    comma = separator != "," and _DECIMAL_COMMA.search(rows) is not None
    dates = {name: match for name, cell in zip(names, sample, strict=False) if (match := _DATE.fullmatch(cell))}
    of_day = tuple(name for name, cell in zip(names, sample, strict=False) if _TIME_OF_DAY.fullmatch(cell))
    zones = {name: bool(match[3]) for name, match in dates.items()}
    is_open = len(sample) == len(cells) > 1 and not sample[-1] and not cells[-1]
    mark, is_all = "," if comma else ".", not rows.strip()
    return TextHeader(names, above + first, separator, mark, is_all, zones, of_day, is_open, in_degrees, encoding)


def _encoding(lines: Sequence[bytes]) -> str:
    """That of letters: UTF-8, or where these are none, Latin-1, as of degree signs and umlauts in old spreadsheets."""
    try:
        b"".join(lines).decode()
    except UnicodeDecodeError:
        return "utf-8" if any(b"\0" in line for line in lines) else "latin-1"
    return "utf-8"


def _opensim_lines(path: Path, stream: BinaryIO) -> tuple[int, bool]:
    """Read up to the line that ends OpenSim's own: how many they are, and whether angles are in degrees."""
    in_degrees = False
    for number in range(1, _MOST_LINES):
        line = stream.readline(BLOCK)
        text = line.decode("utf-8-sig").strip()
        if found := _DEGREES.fullmatch(text):
            if found[1].lower() not in ("yes", "no"):
                raise LogError(path, "inDegrees", f"'{excerpt(found[1])}'", "yes or no")
            in_degrees = found[1].lower() == "yes"
        if text.lower() == _END:
            return number, in_degrees
        if not line:
            break
    raise LogError(path, "header", f"no line {_END}", f"OpenSim's lines up to {_END}, then the names of the columns")


def _without_names(texts: Sequence[str], row: int, above: int, rows: bytes, encoding: str) -> TextHeader:
    """The header of a table of numbers alone, whose columns are `column_0`, ... by their place.

    A first line that counts the columns, as pandas writes it, is no row.
    """
    separator = _most_used(texts[row])
    cells = [cell.strip() for cell in _cells(texts[row], separator)]
    is_open = len(cells) > 1 and not cells[-1]
    names = [f"column_{k}" for k in range(len(cells))]
    counts = len(cells) > 1 and cells == [str(k) for k in range(len(cells))]
    mark = "," if separator != "," and _DECIMAL_COMMA.search(rows) else "."
    return TextHeader(names, above + row + counts, separator, mark, False, {}, (), is_open, False, encoding)


def _require_names(
    path: Path, lines: Sequence[bytes], texts: Sequence[str], named: int, row: int, is_opensim: bool
) -> None:
    """LogError where the line with names, by its number and that of the first row, has none that can be read."""
    if lines and any(b"\0" in line for line in lines[: row + 1]):
        lines[named].decode()  # raises of UTF-16
    if not lines or not texts[named].strip():
        raise LogError(path, "header", "an empty line", "the names of the columns")
    if len(lines[named]) == BLOCK:
        raise LogError(path, "header", f"a line of at least {BLOCK} bytes", "the names of the columns")
    if named == row and is_opensim:
        raise LogError(path, "header", f"numbers, '{excerpt(texts[row])}'", "the names of the columns")


def _named(texts: Sequence[str], row: int) -> int:
    """The line with names above the first row: the first with as many cells, remarks last; without one, the first."""
    if row == len(texts):
        return next((number for number, text in enumerate(texts) if text.strip() and not _COMMENT.match(text)), 0)
    mark = _most_used(texts[row])
    count = len(_cells(texts[row].rstrip(mark), mark))
    alike = [k for k in range(row) if len(_cells(_COMMENT.sub("", texts[k]).rstrip(mark), mark)) == count]
    plain = [k for k in range(row) if texts[k].strip() and not _COMMENT.match(texts[k])]
    return next((k for k in alike if k in plain), (alike or plain[-1:] or [row])[-1])


def _is_row(text: str) -> bool:
    """Whether most of the cells of a line are numbers or stamps, by the mark that separates most cells."""
    if _COMMENT.match(text):
        return False
    cells = [cell for cell in _cells(text, _most_used(text)) if cell.strip()]
    numbers = [cell for cell in cells if _NUMBER.fullmatch(cell.strip())]
    return 2 * len(numbers) > len(cells) or (bool(numbers) and _DATE.fullmatch(cells[0].strip()) is not None)


def _levels(names: Sequence[str], below: Sequence[str], mark: str) -> list[list[str]]:
    """Names below a line that has some twice, as pandas writes columns of several levels; none below others."""
    found = [[cell.strip() for cell in _cells(text, mark)] for text in below]
    return found if len(set(names)) < len(names) and all(len(cells) == len(names) for cells in found) else []


def _is_units(text: str, mark: str, count: int) -> bool:
    """Whether a line between names and the first row has units alone, one for each name."""
    cells = [cell.strip() for cell in _cells(_COMMENT.sub("", text), mark)]
    units = [cell for cell in cells if cell.strip("-")]
    return len(cells) == count and bool(units) and all(map(_is_unit, units))


def _is_unit(cell: str) -> bool:
    found = _BRACKETS.fullmatch(cell)
    return bool(quantities_with((found[1] or found[2] or "") if found else cell)) or cell in ("[]", "[-]", "1", "[1]")


def _with_unit(name: str, unit: str) -> str:
    """A name and its unit as one text; the name alone where there is no unit of it."""
    found = _BRACKETS.fullmatch(unit.strip())
    unit = ((found[1] or found[2] or "") if found else unit).strip()
    return f"{name} [{unit}]" if quantities_with(unit) else name


def _most_used(text: str) -> str:
    """The mark between which most cells are numbers, of several that with most cells; a space if none separates any.

    Of `0;1,5;2,5` it is the semicolon, though there are as many commas.
    """
    cells = {mark: _cells(text, mark) for mark in _SEPARATORS}
    counts = {mark: (sum(map(bool, map(_NUMBER.fullmatch, of))), len(of)) for mark, of in cells.items()}
    mark = max(counts, key=lambda mark: counts[mark])
    return mark if counts[mark][1] > 1 else " "


def _cells(text: str, mark: str) -> list[str]:
    try:
        return next(csv.reader([text], strict=True, delimiter=mark), [])
    except csv.Error:
        return [text]


def _separator(path: Path, names: str, row: str, is_opensim: bool) -> str:
    """What separates names: the mark that gives most, the first of equals; a space if no other does, not in OpenSim's.

    There columns between spaces have several of these.
    """
    found, failures = dict[str, int](), list[csv.Error]()
    for mark in _SEPARATORS:
        try:
            found[mark] = len(next(csv.reader([names], strict=True, delimiter=mark)))
        except csv.Error as error:  # behind a quoted name stands another mark
            failures.append(error)
    separator = max(found, key=lambda mark: found[mark], default="")
    if not separator or (failures and found[separator] == 1):
        accepted = "names separated by commas, semicolons, tabs or spaces"
        raise LogError(path, "header", f"no line of names ({failures[0]})", accepted) from failures[0]
    words = len(_cells(names, " "))
    if is_opensim and found[separator] == 1 and len(names.split()) > 1:
        raise LogError(path, "header", f"names between spaces: {excerpt(names)}", "names separated by tabs")
    if found[separator] > 1 or words == 1 or words != len(_cells(row, " ")):
        return separator
    return " "


_OF_NUMBERS = re.compile(r"\.(list|bag|array)\.(element|item|array_element|array)$")


class NestedColumns:
    """Single columns of numbers that a Parquet file has.

    Attributes:
        types: by name of the column, in the order of the file; that of the lists for lists of different lengths.
    """

    def __init__(self, pa: Any, file: Any) -> None:
        self._pa, self._lengths = pa, _list_lengths(file.metadata)
        self._lists = dict[str, int]()  # numbers in each row, by name of a column of lists
        self._list_of = dict[str, str]()  # by name of a column of numbers
        pairs = [pair for field in file.schema_arrow for pair in self._leaves(field)]
        self.names = [name for name, _ in pairs]
        self.types = dict(pairs)

    def _leaves(self, field: Any, outer: str = "") -> Iterator[tuple[str, Any]]:
        name = f"{outer}{field.name}"
        if self._pa.types.is_struct(field.type):
            for inner in field.type:
                yield from self._leaves(inner, f"{name}.")
        elif length := self._length(name, field.type):
            self._lists[name] = length
            for number in range(length):
                self._list_of[f"{name}[{number}]"] = name
                yield f"{name}[{number}]", field.type.value_type
        else:
            yield name, field.type

    def _length(self, name: str, type_: Any) -> int:
        """How many numbers each row of a column of lists has; 0 for other columns, and for lists of one."""
        types = self._pa.types
        is_fixed = types.is_fixed_size_list(type_)
        if not is_fixed and not types.is_list(type_) and not types.is_large_list(type_):
            return 0
        length = type_.list_size if is_fixed else self._lengths.get(name, 0)
        return length if 1 < length <= MAX_LIST and types.is_primitive(type_.value_type) else 0

    def in_file(self, names: Collection[str]) -> list[str]:
        """The columns of the file that some columns are in."""
        return list(dict.fromkeys(self._list_of.get(name, name) for name in names))

    def flat(self, batch: Any) -> Any:
        """A batch with the columns inside of others in the place of these; LogError for lists of several lengths."""
        types = self._pa.types
        if not any(types.is_nested(field.type) for field in batch.schema):
            return batch
        table = self._pa.Table.from_batches([batch])
        while any(types.is_struct(field.type) for field in table.schema):
            table = table.flatten()
        out = dict[str, Any]()
        for name, column in zip(table.column_names, table.columns, strict=True):
            if name in self._lists:
                numbers = self._numbers(name, column.combine_chunks())
                out |= {f"{name}[{k}]": self._pa.array(np.ascontiguousarray(x)) for k, x in enumerate(numbers.T)}
            else:
                out[name] = column
        return self._pa.table(out).combine_chunks().to_batches()[0]

    def _numbers(self, name: str, lists: Any) -> Any:
        """Numbers (N, k) of a column of lists, NaN where there is no list."""
        length = self._lists[name]
        is_fixed = self._pa.types.is_fixed_size_list(lists.type)
        of_lists = np.full(0, length) if is_fixed else np.asarray(lists.value_lengths().drop_null())
        if (others := of_lists[of_lists != length]).size:
            found = f"lists of {length} and of {others[0]} numbers"
            raise LogError.at_field(f"column '{name}'", found, "lists of one length")
        numbers = lists.flatten().to_numpy(zero_copy_only=False).reshape(-1, length)
        if not lists.null_count:
            return numbers
        out = np.full((len(lists), length), np.nan)
        out[np.asarray(lists.is_valid())] = numbers
        return out


def _list_lengths(metadata: Any) -> dict[str, int]:
    """Numbers in each row of columns of lists, by what a file declares: of those with as many in all rows."""
    counts = defaultdict[str, int](int)
    for group in map(metadata.row_group, range(metadata.num_row_groups)):
        for chunk in map(group.column, range(group.num_columns)):
            counts[chunk.path_in_schema] += chunk.num_values
    rows = metadata.num_rows
    return {_OF_NUMBERS.sub("", name): n // rows for name, n in counts.items() if rows and n % rows == 0}
