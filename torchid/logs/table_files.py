"""Files of tables, CSV, Parquet and JSON lines: names and rows of their columns (the only module with pyarrow)."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, how_to_install
from torchid.guards import MAX_ARRAYS, MAX_SCHEMA, check_unpacked_size
from torchid.logs.columns import TEXT_COLUMN, check_header, is_number, is_stamp
from torchid.logs.containers import JSON_LINES, TEXT_TABLES
from torchid.logs.json_files import JsonColumns, read_json_lines
from torchid.logs.table_headers import BLOCK, NestedColumns, TextHeader, read_header
from torchid.reader import RemoteObject, open_apart

#: Rows that are converted at a time; lines of JSON.
_ROWS, _LINES = 2**16, 2**12
#: Rows from which a map is proposed.
_SAMPLE = 2**12
#: Limits on the metadata of a Parquet file (bytes of names and statistics, entries of lists); checksums are verified.
_PARQUET = {
    "thrift_string_size_limit": 2**26,
    "thrift_container_size_limit": MAX_SCHEMA,
    "page_checksum_verification": True,
}
_BAD_CELL = re.compile(r"In CSV column #(\d+): (?:Row #(\d+): )?.*?invalid value '(.{0,40})", re.DOTALL)
_SHORT_ROW = re.compile(r".*?Row #(\d+): Expected (\d+) columns, got (\d+)", re.DOTALL)
_QUOTES = "'\n"
_EMPTY = ["", " ", "  ", "nan", "NaN", "NAN"]
_NUMBERS = "numbers, or empty cells where nothing was measured"


def import_pyarrow(path: Path) -> Any:
    """The module pyarrow; LogError where it is not installed."""
    try:
        import pyarrow
    except ImportError as error:
        found = f"a {path.suffix.lower()} file, but pyarrow is not installed"
        raise LogError(path, "file", found, f"a .npz file, or {how_to_install('tables')}") from error
    return pyarrow


class TableFile:
    """A table that another process reads."""

    def __init__(self, pa: Any, opened: RemoteObject) -> None:
        self._pa, self._opened = pa, opened

    def column_names(self) -> tuple[list[str], bool]:
        """The columns, and whether angles are in degrees by what the file says."""
        names, in_degrees = self._opened.call("column_names")
        return names, in_degrees

    def read_rows(self, sources: Collection[str], texts: Collection[str], only: bool, whole: bool) -> Iterator[Any]:
        """Batches of rows of some columns, see `_read_rows`."""
        for packed in self._opened.stream("read_rows", list(sources), list(texts), only, whole):
            yield from self._unpacked(packed).to_batches()

    def sample_rows(self) -> tuple[list[str], Any]:
        """The columns, and the first rows; LogError where there are none."""
        names, packed = self._opened.call("sample_rows")
        return names, self._unpacked(packed).combine_chunks().to_batches()[0]

    def whole_table(self) -> Any:
        """All columns and rows as they are, with columns that are in others apart."""
        return self._unpacked(self._opened.call("whole_table"))

    def count_bytes(self) -> int:
        """Bytes of the numbers, without reading them."""
        return int(self._opened.call("count_bytes"))

    def _unpacked(self, packed: bytes) -> Any:
        return self._pa.ipc.open_stream(packed).read_all()


@contextmanager
def open_table(pa: Any, path: Path) -> Iterator[TableFile]:
    """Open a table in another process."""
    with open_apart(_serve_table, path) as opened:
        yield TableFile(pa, opened)


@contextmanager
def _serve_table(path: Path) -> Iterator[_Served]:
    yield _Served(path)


class _Served:
    """A table in the process that reads it; rows are streams of Arrow's format."""

    def __init__(self, path: Path) -> None:
        self._pa, self._path = import_pyarrow(path), path

    def column_names(self) -> tuple[list[str], bool]:
        return _column_names(self._pa, self._path)

    def read_rows(self, *args: Any) -> Iterator[bytes]:
        return map(self._packed, _read_rows(self._pa, self._path, *args))

    def sample_rows(self) -> tuple[list[str], bytes]:
        names, batch = _sample_rows(self._pa, self._path)
        return names, self._packed(batch)

    def whole_table(self) -> bytes:
        return self._packed(_whole_table(self._pa, self._path))

    def count_bytes(self) -> int:
        return _count_bytes(self._pa, self._path)

    def _packed(self, rows: Any) -> bytes:
        sink = self._pa.BufferOutputStream()
        with self._pa.ipc.new_stream(sink, rows.schema) as writer:
            writer.write(rows)
        packed: bytes = sink.getvalue().to_pybytes()
        return packed


def is_text_table(path: Path) -> bool:
    """Whether a table is of text with a line of names."""
    return path.suffix.lower() in TEXT_TABLES


def _is_json(path: Path) -> bool:
    return path.suffix.lower() in JSON_LINES


def _column_names(pa: Any, path: Path) -> tuple[list[str], bool]:
    """The columns of a table, and whether its angles are in degrees by what it says."""
    if is_text_table(path):
        header = read_header(path)
        return header.named, header.in_degrees
    if _is_json(path):
        return list(_first_lines(path)), False
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
        return NestedColumns(pa, file).names, False


def _read_rows(
    pa: Any, path: Path, sources: Collection[str], texts: Collection[str], only: bool, whole: bool
) -> Iterator[Any]:
    """Batches of rows of some columns of a table.

    Args:
        pa: pyarrow.
        path: the file.
        sources: columns of numbers or stamps, and of texts and flags.
        texts: those of them that may be texts or flags.
        only: whether the file has other columns too.
        whole: whether all rows are kept, which limits their number.

    Raises:
        LogError: a cell that is no number, or a file that is too large.
    """
    read = _read_csv if is_text_table(path) else _read_json if _is_json(path) else _read_parquet
    return read(pa, path, sources, texts, only, whole)


def _sample_rows(pa: Any, path: Path) -> tuple[list[str], Any]:
    """The columns of a table, and its first rows; LogError where it has none."""
    read = _sample_csv if is_text_table(path) else _sample_json if _is_json(path) else _sample_parquet
    names, batch = read(pa, path)
    if batch is None or not batch.num_rows:
        raise LogError.at_field("time", "no samples", "at least one sample")
    return names, batch


def _whole_table(pa: Any, path: Path) -> Any:
    """All columns and rows of a table as they are, with columns that are in others apart."""
    if _is_json(path):
        blocks = list(read_json_lines(path, _LINES, partial(check_size, path, whole=True)))
        names = dict.fromkeys(name for block in blocks for name in block)
        return pa.Table.from_batches([_json_batch(pa, block, names) for block in blocks])
    if is_text_table(path):
        import pyarrow.csv

        header = read_header(path)
        check_header(header.texts)
        table = pyarrow.csv.read_csv(path, **_csv_options(header), convert_options=_csv_types(pa, header))
    else:
        with _open_parquet(pa, path) as file:
            check_size(path, file.metadata.num_rows, file.metadata.num_columns, whole=True)
            nested = NestedColumns(pa, file)
            plain = nested.in_file([name for name, type_ in nested.types.items() if _is_plain(pa, type_)])
            table = pa.Table.from_batches([nested.flat(batch) for batch in file.iter_batches(_ROWS, columns=plain)])
    check_size(path, table.num_rows, table.num_columns, whole=True)
    return table


def _count_bytes(pa: Any, path: Path) -> int:
    """Bytes of a table's numbers, without reading them."""
    if is_text_table(path) or _is_json(path):
        columns = len(read_header(path).texts if is_text_table(path) else _first_lines(path))
        with path.open("rb") as stream:
            return 8 * columns * sum(piece.count(b"\n") for piece in iter(lambda: stream.read(BLOCK), b""))
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
        return 8 * int(file.metadata.num_rows) * int(file.metadata.num_columns)


def write_table(pa: Any, path: Path, columns: Mapping[str, NDArray[Any]], as_parquet: bool) -> None:
    """Write columns as Parquet or CSV."""
    if as_parquet:
        import pyarrow.parquet

        table = pa.table({text: pa.array(np.ascontiguousarray(x)) for text, x in columns.items()})
        pyarrow.parquet.write_table(table, path, use_dictionary=[TEXT_COLUMN], write_page_checksum=True)
    else:
        _save_csv(pa, path, columns)


# ----------------------------------------------------------------------------------------------------------------- CSV


def _stamp_types(pa: Any, header: TextHeader) -> dict[str, Any]:
    """Types of the columns of a table of text that hold dates or times of day."""
    dates = {name: pa.timestamp("ns", "UTC" if zone else None) for name, zone in header.dates.items()}
    return dates | dict.fromkeys(header.times_of_day, pa.time64("ns"))


def _csv_options(header: TextHeader) -> dict[str, Any]:
    """Options of pyarrow's readers of CSV, but for types of columns."""
    import pyarrow.csv

    # one thread: else error messages have no row number
    rows = {"skip_rows": header.lines, "column_names": header.texts, "encoding": header.encoding}
    return {
        "read_options": pyarrow.csv.ReadOptions(use_threads=False, block_size=BLOCK, **rows),
        "parse_options": pyarrow.csv.ParseOptions(delimiter=header.separator),
    }


def _csv_types(pa: Any, header: TextHeader, **others: Any) -> Any:
    import pyarrow.csv

    types = others.pop("column_types", None) or _stamp_types(pa, header)
    marks = {"null_values": _EMPTY, "strings_can_be_null": True, "decimal_point": header.decimal_mark}
    return pyarrow.csv.ConvertOptions(column_types=types, **marks, **others)


def _sample_csv(pa: Any, path: Path) -> tuple[list[str], Any]:
    import pyarrow.csv

    header = read_header(path)
    check_header(header.texts)
    if header.is_all:
        return header.texts, None
    with path.open("rb") as stream:
        reader = pyarrow.csv.open_csv(stream, **_csv_options(header), convert_options=_csv_types(pa, header))
        return header.texts, reader.read_next_batch()


def _read_csv(
    pa: Any, path: Path, sources: Collection[str], texts: Collection[str], only: bool, whole: bool
) -> Iterator[Any]:
    import pyarrow.csv

    header = read_header(path)
    if header.is_all:
        return
    words = pa.dictionary(pa.int32(), pa.string())
    types = {text: words if text in texts else pa.float64() for text in sources}
    types |= {text: type_ for text, type_ in _stamp_types(pa, header).items() if text in types}
    included = list(sources) if only or header.is_open else None
    convert = _csv_types(pa, header, column_types=types, include_columns=included)
    with path.open("rb") as stream:
        try:
            reader = pyarrow.csv.open_csv(stream, **_csv_options(header), convert_options=convert)
            yield from _bounded(path, reader, len(types), whole)
        except pa.ArrowInvalid as error:
            if (bad := _bad_cell(path, header, error)) is None:
                raise
            raise bad from error


def _bad_cell(path: Path, header: TextHeader, error: Exception) -> LogError | None:
    """The error of a cell that is no number, or of a row with too many cells or too few; None for any other."""
    if row := _SHORT_ROW.match(str(error)):
        return LogError(path, f"row {row[1]}", f"{row[3]} cells", f"{row[2]} cells, as there are names")
    bad = _BAD_CELL.match(str(error))
    if bad is None:
        return None
    column, row_number, found = bad.groups()
    where = "" if row_number is None else f" in row {row_number}"
    found = found.strip(_QUOTES)
    other = "." if header.decimal_mark == "," else ","
    mixed = found.count(other) == 1 and found.replace(other, "").lstrip("-").isdigit()
    accepted = f"the decimal mark '{header.decimal_mark}' throughout, as in other rows" if mixed else _NUMBERS
    return LogError(path, f"column '{header.texts[int(column)]}'", f"'{excerpt(found)}'{where}", accepted)


# ------------------------------------------------------------------------------------------------------------- Parquet


def _sample_parquet(pa: Any, path: Path) -> tuple[list[str], Any]:
    with _open_parquet(pa, path) as file:
        nested = NestedColumns(pa, file)
        check_header(nested.names)
        check_size(path, file.metadata.num_rows, len(nested.names), whole=False)
        plain = [name for name, type_ in nested.types.items() if _is_plain(pa, type_)]
        batch = next(file.iter_batches(_SAMPLE, columns=nested.in_file(plain)), None) if plain else None
    return nested.names, None if batch is None else nested.flat(batch)


def _open_parquet(pa: Any, path: Path, texts: Collection[str] | None = None) -> Any:
    """An open file, whose texts are dictionaries: one long text, repeated in every row, could fill the memory."""
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
        types = NestedColumns(pa, file).types
    words = [name for name, type_ in types.items() if _is_text(pa, type_) and (texts is None or name in texts)]
    return pyarrow.parquet.ParquetFile(path, read_dictionary=words or None, **_PARQUET)


def _is_plain(pa: Any, type_: Any) -> bool:
    return is_number(pa, type_) or is_stamp(pa, type_) or _is_text(pa, type_)


def _read_parquet(
    pa: Any, path: Path, sources: Collection[str], texts: Collection[str], only: bool, whole: bool
) -> Iterator[Any]:
    with _open_parquet(pa, path, texts) as file:
        used, nested = set(sources), NestedColumns(pa, file)
        for name, type_ in nested.types.items():
            number = is_number(pa, type_) and (name in texts or not pa.types.is_boolean(type_))
            number = (number or is_stamp(pa, type_)) and name != TEXT_COLUMN
            if name in used and not number and not (name in texts and pa.types.is_dictionary(type_)):
                accepted = "text" if name == TEXT_COLUMN else "real numbers"
                raise LogError(path, f"column '{name}'", f"values of type {type_}", accepted)
        check_size(path, file.metadata.num_rows, len(used), whole)
        included = nested.in_file(sources) if only else None
        for batch in _bounded(path, file.iter_batches(_ROWS, columns=included), len(used), whole):
            yield nested.flat(batch)


def _is_text(pa: Any, type_: Any) -> bool:
    return bool(pa.types.is_string(type_) or pa.types.is_large_string(type_) or pa.types.is_dictionary(type_))


# ---------------------------------------------------------------------------------------------------------- JSON lines


def _first_lines(path: Path) -> JsonColumns:
    """The first lines of JSON, by column; LogError where there is none."""
    return next(read_json_lines(path, _LINES, partial(check_size, path, whole=False)), {})


def _read_json(
    pa: Any, path: Path, sources: Collection[str], texts: Collection[str], only: bool, whole: bool
) -> Iterator[Any]:
    known = set(_first_lines(path))
    for block in read_json_lines(path, _LINES, partial(check_size, path, whole=whole)):
        if later := [name for name in block if name not in known]:
            accepted = f"the same in each line, null where nothing was measured; the first {_LINES} lines tell which"
            raise LogError(path, f"column '{excerpt(later[0])}'", "in none of the first lines", accepted)
        for name, values in block.items():
            if name in sources and isinstance(values, list) != (name in texts) and isinstance(values, list):
                found = next((text for text in values if text is not None), "")
                raise LogError(path, f"column '{name}'", f"'{excerpt(found)}'", _NUMBERS)
        yield _json_batch(pa, block, sources)


def _json_batch(pa: Any, block: JsonColumns, names: Iterable[str]) -> Any:
    """Columns of some lines, NaN for those that no line has."""
    count = len(next(iter(block.values()), ()))
    words = pa.dictionary(pa.int32(), pa.string())
    columns = {name: block.get(name, np.full(count, np.nan)) for name in names}
    made = {name: pa.array(x, words if isinstance(x, list) else pa.float64()) for name, x in columns.items()}
    return pa.RecordBatch.from_pydict(made)


def _sample_json(pa: Any, path: Path) -> tuple[list[str], Any]:
    columns = _first_lines(path)
    check_header(list(columns))
    return list(columns), _json_batch(pa, columns, columns) if columns else None


# --------------------------------------------------------------------------------------------------------------- sizes


def _bounded(path: Path, batches: Iterable[Any], columns: int, whole: bool) -> Iterator[Any]:
    """The batches, with their total size checked: a file may contain more rows than it declares."""
    rows = 0
    for batch in batches:
        rows += batch.num_rows
        check_size(path, rows, columns, whole)
        if batch.num_rows:
            yield batch


def check_size(path: Path, rows: int, columns: int, whole: bool) -> None:
    """Raise LogError for more numbers than are read whole, or than a file of that size has."""
    if whole and 8 * rows * columns > MAX_ARRAYS:
        accepted = f"at most {MAX_ARRAYS} bytes in all"
        raise LogError(path, "file", f"{rows} rows of {columns} columns", accepted)
    check_unpacked_size(path, 8 * rows * columns)


def _save_csv(pa: Any, path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write numbers as the shortest exact text, NaN as an empty cell."""
    import pyarrow.csv

    def rows(first: int) -> Any:
        block = {text: x[first : first + _ROWS] for text, x in columns.items()}
        return pa.table({text: pa.array(np.ascontiguousarray(x), from_pandas=True) for text, x in block.items()})

    with path.open("xb") as stream, pyarrow.csv.CSVWriter(stream, rows(0).schema) as writer:
        for first in range(0, len(columns["time"]), _ROWS):
            writer.write_table(rows(first))
