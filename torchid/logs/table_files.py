"""Files of tables, in the process that reads them: CSV, Parquet and JSON lines as named columns (with pyarrow)."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, how_to_install, is_plain
from torchid.guards import MAX_ARRAYS, MAX_COLUMNS, MAX_LETTERS, MAX_LIST, MAX_SCHEMA, check_names, check_unpacked_size
from torchid.logs.containers import JSON_LINES, OPENSIM, TEXT_TABLES
from torchid.logs.log import TEXT_FIELD

_BLOCK_BYTES = 2**22  # of text that is parsed at a time; no row may be longer
_BATCH_ROWS = 2**16
_SAMPLE_ROWS = 2**12
# before the first row
_HEADER_LINES = 64
_OPENSIM_LINES = 1000
_MAX_COLUMN_LETTERS = 2 * MAX_LETTERS  # the name of a column contains that of a joint
_PARQUET = {  # limits on metadata: bytes of names and statistics, entries of lists
    "thrift_string_size_limit": 2**26,
    "thrift_container_size_limit": MAX_SCHEMA,
    "page_checksum_verification": True,
}
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_EMPTY = ["", " ", "  ", "nan", "NaN", "NAN"]
_NUMBERS = "numbers, or empty cells for missing values"
_BAD_CELL = re.compile(r"In CSV column #(\d+): (?:Row #(\d+): )?.*?invalid value '(.{0,40})", re.DOTALL)
_SHORT_ROW = re.compile(r".*?Row #(\d+): Expected (\d+) columns, got (\d+)", re.DOTALL)
_SEPARATORS = (",", ";", "\t")
_COMMENT = re.compile(r"^(#|%|//)\s*")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|[+-]?(nan|inf)|true|false", re.IGNORECASE)
_DATE = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d.*")
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


def import_pyarrow(path: Path) -> Any:
    """The module pyarrow; LogError where it is not installed."""
    try:
        import pyarrow
    except ImportError as error:
        reason = f"a {path.suffix.lower()} file, but pyarrow is not installed"
        raise LogError(path, "file", reason, f"a .npz file, or {how_to_install('tables')}") from error
    return pyarrow


def is_text_table(path: Path) -> bool:
    """Whether a table is of text with a line of names."""
    return path.suffix.lower() in TEXT_TABLES


# --------------------------------------------------------------------------------------------------- lines before rows


@dataclass(frozen=True)
class TextHeader:
    """The lines of a table of text before its rows.

    Attributes:
        names: of the columns.
        lines: how many there are before the first row.
        separator: between cells.
        decimal_mark: . or ,
        encoding: of its letters, UTF-8 or else Latin-1.
        in_degrees: whether it says that angles are in degrees.
        is_open: whether rows end with a separator, so that there is one more, empty column.
        has_rows: whether there are any.
    """

    names: list[str]
    lines: int
    separator: str
    decimal_mark: str
    encoding: str
    in_degrees: bool
    is_open: bool
    has_rows: bool


def read_header(path: Path) -> TextHeader:
    """The names of the columns of a table of text.

    They are in the one line above the first row of numbers that has as many cells; all other lines there are remarks.
    A column without a name is called `unnamed_0` by its place; without a line of names all are called `column_0`, ...
    In OpenSim's tables all that is below the line `endheader`.

    Raises:
        LogError: no names, or lines between these and the rows, such as units.
    """
    with path.open("rb") as stream:
        above, in_degrees = _opensim_lines(path, stream) if path.suffix.lower() in OPENSIM else (0, False)
        lines = [line for _ in range(_HEADER_LINES) if (line := stream.readline(_BLOCK_BYTES))]
    if any(len(line) == _BLOCK_BYTES for line in lines[:1]):
        raise LogError(path, "header", f"a line of at least {_BLOCK_BYTES} bytes", "the names of the columns")
    encoding, texts = _decoded(path, lines)
    first = next((number for number, text in enumerate(texts) if _is_row(text)), len(texts))
    named = _line_of_names(path, texts, first)
    if named is not None:
        first = next((k for k in range(named + 1, first) if not _COMMENT.match(texts[k])), min(first, len(texts)))
    row = texts[first] if first < len(texts) else ""
    title = "" if named is None else _COMMENT.sub("", texts[named])
    separator = _separator(row or title)
    cells = _cells(row, separator)
    names = [cell.strip() for cell in _cells(title, separator)]
    if named is None:
        counts = len(cells) > 1 and [cell.strip() for cell in cells] == [str(k) for k in range(len(cells))]
        first += counts  # as pandas counts the columns
        names = [f"column_{k}" for k in range(len(cells) - (len(cells) > 1 and not cells[-1].strip()))]
    if len(cells) == len(names) - 1 and not names[-1]:
        names.pop()
    is_open = len(cells) == len(names) + 1 and not cells[-1].strip()
    if not is_open and len(names) > 1 and cells and len(cells) == len(names) and not names[-1] + cells[-1].strip():
        names.pop()
        is_open = True
    comma = separator != "," and any(
        _DECIMAL_COMMA.fullmatch(cell.strip()) for text in texts[first:] for cell in _cells(text, separator)
    )
    names = [name or f"unnamed_{number}" for number, name in enumerate(names)]
    check_column_names(names)
    has_rows = first < len(texts) and any(text.strip() for text in texts[first:])
    return TextHeader(names, above + first, separator, "," if comma else ".", encoding, in_degrees, is_open, has_rows)


def _decoded(path: Path, lines: Sequence[bytes]) -> tuple[str, list[str]]:
    """The encoding, UTF-8 or else Latin-1, as of degree signs in old spreadsheets; and the lines."""
    whole = b"".join(lines)
    if b"\0" in whole:
        raise LogError(path, "header", "bytes that are not text", "text in UTF-8 or Latin-1")
    if not whole.strip():
        raise LogError(path, "header", "an empty line", "the names of the columns")
    try:
        whole.decode()
        encoding = "utf-8"
    except UnicodeDecodeError:
        encoding = "latin-1"
    return encoding, [line.decode(encoding).removeprefix("\ufeff").rstrip("\r\n") for line in lines]


def _line_of_names(path: Path, texts: Sequence[str], first: int) -> int | None:
    """The number of the line with names above the first row, None where that is the first of all."""
    plain = [k for k in range(first) if texts[k].strip() and not _COMMENT.match(texts[k])]
    if first == len(texts):  # rows of words, or none
        return plain[0] if plain else 0
    separator = _separator(texts[first])
    count = len(_cells(texts[first].rstrip(separator), separator))
    alike = [k for k in range(first) if len(_cells(_COMMENT.sub("", texts[k]).rstrip(separator), separator)) == count]
    named = next((k for k in alike if k in plain), (alike or plain)[-1] if alike or plain else None)
    if between := [k for k in plain if named is not None and k > named and not _count_numbers(texts[k])]:
        reason = f"'{excerpt(texts[between[0]])}' between the names and the first row"
        accepted = "rows of numbers directly below one line of names; put units into logs.columns"
        raise LogError(path, f"line {between[0] + 1}", reason, accepted)
    return named


def _is_row(text: str) -> bool:
    """Whether most of the cells of a line are numbers, or the first one is a date."""
    cells = [cell.strip() for cell in _cells(text, _separator(text)) if cell.strip()]
    numbers = _count_numbers(text)
    is_dated = numbers > 0 and _DATE.fullmatch(cells[0]) is not None
    return not _COMMENT.match(text) and (2 * numbers > len(cells) or is_dated)


def _count_numbers(text: str) -> int:
    return sum(_NUMBER.fullmatch(cell.strip()) is not None for cell in _cells(text, _separator(text)))


def _separator(text: str) -> str:
    """The mark between which most cells are numbers, of several that with most cells; a space if none separates any.

    Of `0;1,5;2,5` it is the semicolon, though there are as many commas.
    """
    counts = {}
    for mark in _SEPARATORS:
        cells = _cells(text, mark)
        numbers = sum(map(bool, map(_NUMBER.fullmatch, cells)))
        counts[mark] = (numbers == len(cells), numbers, len(cells))
    mark = max(counts, key=lambda mark: counts[mark])
    return mark if counts[mark][-1] > 1 or " " not in text.strip() else " "


def _cells(text: str, mark: str) -> list[str]:
    try:
        return next(csv.reader([text], strict=True, delimiter=mark), [])
    except csv.Error:  # behind a quoted name stands another mark
        return [text]


def _opensim_lines(path: Path, stream: Any) -> tuple[int, bool]:
    """Read up to the line `endheader`: how many lines there are, and whether angles are in degrees."""
    in_degrees = False
    for number in range(1, _OPENSIM_LINES):
        line = stream.readline(_BLOCK_BYTES)
        key, _, value = line.decode("utf-8-sig").strip().partition("=")
        if key.strip().lower() == "indegrees":
            in_degrees = value.strip().lower() != "no"
        if key.strip().lower() == "endheader":
            return number, in_degrees
        if not line:
            break
    raise LogError(path, "header", "no line endheader", "a header of OpenSim: lines up to endheader, then column names")


def check_column_names(names: Sequence[str]) -> None:
    """Raise LogError for too many columns, and names that are too long, of control characters, or given twice."""
    if len(names) > MAX_COLUMNS:
        raise LogError.at_field("file", f"{len(names)} columns", f"at most {MAX_COLUMNS}")
    seen = set[str]()
    for name in names:
        if len(name) > _MAX_COLUMN_LETTERS or not is_plain(name):
            reason = f"a name of {len(name)} characters: {excerpt(name)}"
            raise LogError.at_field("header", reason, f"one line of at most {_MAX_COLUMN_LETTERS} characters")
        if name in seen:
            raise LogError.at_field(f"column '{name}'", "given twice", "every column once")
        seen.add(name)


# ---------------------------------------------------------------------------------------- in the process that reads it


class _Served:
    """A table in the process that reads it. Nested columns are columns: `state.q` of structures, `q[0]` of lists."""

    def __init__(self, path: Path) -> None:
        self._pa = import_pyarrow(path)
        self._path = path
        self._columns = 0
        self._header = read_header(path) if is_text_table(path) else None
        self._lengths = dict[str, int]()  # numbers in each row of columns of lists
        self._origin = dict[str, str]()  # of a column of numbers, the column of lists
        self._first = self._flat(next(self._tables()))
        check_column_names(self._names())

    def _names(self) -> list[str]:
        return list(self._first.column_names)

    def header(self) -> tuple[list[str], bool]:
        """The columns, and whether the file says that angles are in degrees."""
        return self._names(), self._header is not None and self._header.in_degrees

    def sample(self) -> dict[str, NDArray[Any] | None]:
        """The columns with some of their first rows, None for what is neither numbers nor texts."""
        if not self._first.num_rows:
            raise LogError.at_field("time", "no samples", "at least one sample")
        self._check_size(self._first.num_rows, whole=False)
        return {name: self._values(name, self._first[name]) for name in self._names()}

    def count_bytes(self) -> int:
        """Bytes of the numbers, without reading them."""
        if self._path.suffix.lower() == ".parquet":
            import pyarrow.parquet

            with pyarrow.parquet.ParquetFile(self._path, **_PARQUET) as file:
                return 8 * int(file.metadata.num_rows) * len(self._names())
        with self._path.open("rb") as stream:
            lines = sum(piece.count(b"\n") for piece in iter(lambda: stream.read(_BLOCK_BYTES), b""))
        return 8 * len(self._names()) * lines

    def read_rows(self, sources: Sequence[str], texts: Sequence[str], whole: bool) -> Iterator[dict[str, NDArray[Any]]]:
        """Some rows of some columns at a time.

        Args:
            sources: the columns.
            texts: those that may hold texts.
            whole: whether all rows are kept, which limits their number.

        Raises:
            LogError: a cell that is no number, or a file that is too large.
        """
        self._columns = len(sources)
        rows = 0
        for table in self._tables(sources, texts):
            if not table.num_rows:
                continue
            rows += table.num_rows
            self._check_size(rows, whole)
            flat = self._flat(table)
            block = {name: self._values(name, flat[name]) for name in sources}
            for name, values in block.items():
                if values is None or (values.dtype.kind == "U" and name not in texts):
                    accepted = "text" if name == TEXT_FIELD else "real numbers"
                    raise LogError(self._path, f"column '{name}'", f"values of type {flat[name].type}", accepted)
                if name == TEXT_FIELD and values.dtype.kind != "U":
                    raise LogError(self._path, f"column '{name}'", f"values of type {flat[name].type}", "text")
            yield {name: values for name, values in block.items() if values is not None}

    def _check_size(self, rows: int, whole: bool) -> None:
        """Raise LogError for more numbers than are read whole, or than a file of that size has."""
        size = 8 * rows * self._columns
        if whole and size > MAX_ARRAYS:
            raise LogError(self._path, "file", f"{rows} rows of {self._columns} columns", f"at most {MAX_ARRAYS} bytes")
        check_unpacked_size(self._path, size)

    # ------------------------------------------------------------------------------------------- rows as Arrow's tables

    def _tables(self, sources: Sequence[str] | None = None, texts: Sequence[str] = ()) -> Iterator[Any]:
        """Rows of some columns; without these all, with the types that Arrow infers, of which only the first count."""
        if self._header is not None:
            names = self._header.names if sources is None else sources
            types = {name: self._csv_type(name, name in texts) for name in sources or ()}
            if not self._header.has_rows:
                yield self._pa.table({name: self._pa.nulls(0) for name in names})
                return
            yield from map(self._table_of_batch, self._csv_batches(self._header, types, names))
        elif self._path.suffix.lower() in JSON_LINES:
            table = self._json_table()
            yield table.slice(0, _SAMPLE_ROWS) if sources is None else table
        else:
            with self._parquet() as file:
                if sources is None:
                    check_column_names([field.name for field in file.schema_arrow])
                    self._columns = file.metadata.num_columns
                    self._check_size(file.metadata.num_rows, whole=False)
                if not file.metadata.num_rows:
                    yield file.schema_arrow.empty_table()
                columns = None if sources is None else list(dict.fromkeys(self._origin.get(x, x) for x in sources))
                rows = _SAMPLE_ROWS if sources is None else _BATCH_ROWS
                yield from map(self._table_of_batch, file.iter_batches(rows, columns=columns))

    def _table_of_batch(self, batch: Any) -> Any:
        return self._pa.Table.from_batches([batch])

    def _csv_type(self, name: str, is_text: bool) -> Any:
        """That of a column: the inferred one of dates, truth values and allowed texts, else numbers."""
        types = self._pa.types
        inferred = self._first.schema.field(name).type
        is_kept = types.is_temporal(inferred) or types.is_boolean(inferred) or (is_text and types.is_string(inferred))
        if is_text and name == TEXT_FIELD:
            return self._pa.string()
        return inferred if is_kept else self._pa.float64()

    def _csv_batches(self, header: TextHeader, types: Mapping[str, Any], sources: Sequence[str]) -> Iterator[Any]:
        import pyarrow.csv

        names = [*header.names, *(["unnamed_last"] if header.is_open else [])]
        # one thread: else error messages have no row number
        rows = {"skip_rows": header.lines, "column_names": names, "encoding": header.encoding}
        marks = {"null_values": _EMPTY, "strings_can_be_null": True, "decimal_point": header.decimal_mark}
        with self._path.open("rb") as stream:
            try:
                yield from pyarrow.csv.open_csv(
                    stream,
                    read_options=pyarrow.csv.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES, **rows),
                    parse_options=pyarrow.csv.ParseOptions(delimiter=header.separator),
                    convert_options=pyarrow.csv.ConvertOptions(
                        column_types=types, include_columns=list(sources), **marks
                    ),
                )
            except self._pa.ArrowInvalid as error:
                raise self._bad_cell(header, names, error) or error from error

    def _bad_cell(self, header: TextHeader, names: Sequence[str], error: Exception) -> LogError | None:
        """The error of a cell that is no number, or of a row with too many cells or too few; None for any other."""
        if row := _SHORT_ROW.match(str(error)):
            return LogError(self._path, f"row {row[1]}", f"{row[3]} cells", f"{row[2]} cells, as in the line of names")
        bad = _BAD_CELL.match(str(error))
        if bad is None:
            return None
        where = "" if bad[2] is None else f" in row {bad[2]}"
        accepted = f"{_NUMBERS}, with the decimal mark '{header.decimal_mark}'"
        return LogError(
            self._path, f"column '{names[int(bad[1])]}'", f"'{excerpt(bad[3].rstrip(chr(39)))}'{where}", accepted
        )

    def _json_table(self) -> Any:
        import pyarrow.json

        options = pyarrow.json.ReadOptions(use_threads=False, block_size=_BLOCK_BYTES)
        return pyarrow.json.read_json(self._path, read_options=options)

    @contextmanager
    def _parquet(self) -> Iterator[Any]:
        import pyarrow.parquet

        with pyarrow.parquet.ParquetFile(self._path, **_PARQUET) as file:
            yield file

    def _flat(self, table: Any) -> Any:
        """A table with the columns inside of others in the place of these; LogError for lists of several lengths."""
        types = self._pa.types
        while any(types.is_struct(field.type) for field in table.schema):
            table = table.flatten()
        if not any(types.is_nested(field.type) for field in table.schema):
            return table
        out = list[tuple[str, Any]]()
        for name, column in zip(table.column_names, table.columns, strict=True):
            numbers = self._numbers_of_lists(name, column)
            if numbers is None:
                out.append((name, column))
                continue
            for k, values in enumerate(numbers.T):
                self._origin[f"{name}[{k}]"] = name
                out.append((f"{name}[{k}]", self._pa.chunked_array([np.ascontiguousarray(values)])))
        return self._pa.Table.from_arrays([column for _, column in out], [name for name, _ in out])

    def _numbers_of_lists(self, name: str, column: Any) -> NDArray[Any] | None:
        """Numbers (N, k) of a column of lists, NaN where there is no list; None of others than lists of numbers."""
        types = self._pa.types
        type_ = column.type
        is_list = types.is_list(type_) or types.is_large_list(type_) or types.is_fixed_size_list(type_)
        if not is_list or not types.is_primitive(type_.value_type):
            return None
        lists = column.combine_chunks()
        valid = np.asarray(lists.is_valid())
        lengths = np.unique(np.asarray(self._pa.compute.list_value_length(lists.drop_null())))
        expected = self._lengths.setdefault(name, int(lengths[0]) if len(lengths) else 0)
        if len(lengths) > 1 or (len(lengths) and lengths[0] != expected):
            if not self._origin.get(f"{name}[0]"):
                return None  # lists of several lengths, which nobody may need
            reason = f"lists of {expected} and of {lengths[lengths != expected][0]} numbers"
            raise LogError.at_field(f"column '{name}'", reason, "lists of equal length")
        if not 0 < expected <= MAX_LIST:
            return None
        flat = lists.drop_null().flatten().to_numpy(zero_copy_only=False)
        out = np.full((len(lists), expected), np.nan, dtype=flat.dtype if valid.all() else np.float64)
        out[valid] = flat.reshape(-1, expected)
        return out

    def _values(self, name: str, column: Any) -> NDArray[Any] | None:
        """Numbers (N,) of a column, of dates seconds since 1970, NaN for empty cells; or texts; None for others."""
        types = self._pa.types
        type_ = column.type
        if types.is_null(type_):
            return np.full(len(column), np.nan)
        if types.is_timestamp(type_) or types.is_time(type_) or types.is_duration(type_):
            whole = column.cast(self._pa.int32() if type_.bit_width == 32 else self._pa.int64())
            return np.asarray(whole.combine_chunks().to_numpy(zero_copy_only=False) / _PER_SECOND[type_.unit])
        if types.is_integer(type_) or types.is_floating(type_) or types.is_boolean(type_):
            column = column.cast(self._pa.float64()) if types.is_boolean(type_) and column.null_count else column
            return np.asarray(column.combine_chunks().to_numpy(zero_copy_only=False))
        if types.is_dictionary(type_):
            column = column.cast(type_.value_type)
        if not types.is_string(column.type) and not types.is_large_string(column.type):
            return None
        coded = column.combine_chunks().dictionary_encode()
        words = coded.dictionary.to_pylist()
        longest = max(map(len, words), default=0)
        if name == TEXT_FIELD:
            check_names([1], longest)
        if longest > MAX_LETTERS:
            return None
        codes = np.asarray(coded.indices.fill_null(len(words)))
        return np.array([*words, ""])[codes]


@contextmanager
def serve_table(path: Path) -> Iterator[_Served]:
    """Open a table in the process that reads it."""
    yield _Served(path)


# ------------------------------------------------------------------------------------------------------------- writing


def write_parquet(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write columns (N,) of numbers and texts."""
    import pyarrow.parquet

    table = pyarrow.table({name: pyarrow.array(np.ascontiguousarray(x)) for name, x in columns.items()})
    pyarrow.parquet.write_table(table, path, use_dictionary=[TEXT_FIELD], write_page_checksum=True)


def write_csv(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write numbers as the shortest exact text, NaN as an empty cell."""
    import pyarrow.csv

    def rows(first: int) -> Any:
        block = {text: x[first : first + _BATCH_ROWS] for text, x in columns.items()}
        return pyarrow.table(
            {name: pyarrow.array(np.ascontiguousarray(x), from_pandas=True) for name, x in block.items()}
        )

    with path.open("xb") as stream, pyarrow.csv.CSVWriter(stream, rows(0).schema) as writer:
        for first in range(0, len(columns["time"]), _BATCH_ROWS):
            writer.write_table(rows(first))
