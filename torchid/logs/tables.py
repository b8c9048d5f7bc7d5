"""Logs as tables, CSV and Parquet (the only module that imports pyarrow)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, format_count, how_to_install, warn_about_file
from torchid.guards import MAX_ARRAYS, MAX_SCHEMA, check_names, check_unpacked_size
from torchid.logs.column_map import Columns
from torchid.logs.columns import TEXT_COLUMN, TableLayout, check_header, parse_header, to_columns
from torchid.logs.containers import TEXT_TABLES, atomic_output, reader_errors_explained
from torchid.logs.log import field_shape
from torchid.logs.mapped_fields import MappedFields, map_table
from torchid.logs.table_headers import BLOCK, NestedColumns, TextHeader, read_header
from torchid.logs.units import IN_DEGREES, quantities_of

#: Rows that are converted at a time.
_ROWS = 2**16
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
_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_QUOTES = "'\n"
_EMPTY = ["", " ", "  ", "nan", "NaN", "NAN"]
_FLAGS = {"true": "1", "false": "0"}
_NUMBERS = "numbers, or empty cells where nothing was measured"


_Layout = TableLayout | MappedFields  # which columns a table's fields come from


def read_table(path: Path, columns: Columns | None = None) -> dict[str, NDArray[Any]]:
    """The fields of a .csv or .parquet file, including names of joints, contacts and sensors.

    Args:
        path: the file.
        columns: what those of its columns hold that have no names of the log format.

    Raises:
        LogError: one line with the file and the column.
    """
    pa = _pyarrow(path)
    with _complete(path):
        (layout, _), *rest = _batches(pa, path, columns)
        batches = [batch for _, batch in rest]
        del rest
        (fields,) = _without_repeats([_fields(pa, layout, batches)])
        return fields


def sample_table(path: Path) -> dict[str, NDArray[Any] | None]:
    """The columns of a table with some of their first rows; a text alone where it is in all, None for other texts.

    Raises:
        LogError: the file cannot be read, or has no rows.
    """
    pa = _pyarrow(path)
    with _complete(path):
        names, batch = (_sample_csv if is_text_table(path) else _sample_parquet)(pa, path)
        if batch is None or not batch.num_rows:
            raise LogError.at_field("time", "no samples", "at least one sample")
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        read = {name: x for name, x in columns.items() if _is_number(pa, x.type) or _is_stamp(pa, x.type)}
        texts = {name: x for name, x in columns.items() if pa.types.is_string(x.type) or pa.types.is_dictionary(x.type)}
        found = {name: _numbers(pa, x) for name, x in read.items()} | {name: _one(x) for name, x in texts.items()}
        return {name: found.get(name) for name in names}


def _one(values: Any) -> NDArray[Any] | None:
    """The text (1,) that all rows of a column have; None where they differ."""
    texts = values.unique().to_pylist()
    return np.array(texts) if len(texts) == 1 and texts[0] else None


def _is_number(pa: Any, type_: Any) -> bool:
    return bool(pa.types.is_integer(type_) or pa.types.is_floating(type_) or pa.types.is_boolean(type_))


def _is_stamp(pa: Any, type_: Any) -> bool:
    return bool(pa.types.is_timestamp(type_) or pa.types.is_time(type_) or pa.types.is_duration(type_))


def _numbers(pa: Any, values: Any) -> NDArray[Any]:
    """Numbers (N,) of a column: of dates seconds since 1970, of times of day since midnight, NaN for empty cells."""
    if not _is_stamp(pa, values.type):
        return np.asarray(values.to_numpy(False))
    whole = np.asarray(values.cast(pa.int32() if values.type.bit_width == 32 else pa.int64()).to_numpy(False))
    return whole / _PER_SECOND[values.type.unit]


def _stamp_types(pa: Any, header: TextHeader) -> dict[str, Any]:
    """Types of the columns of a table of text that hold dates or times of day."""
    dates = {name: pa.timestamp("ns", "UTC" if zone else None) for name, zone in header.dates.items()}
    return dates | dict.fromkeys(header.times_of_day, pa.time64("ns"))


def _csv_options(header: TextHeader) -> Any:
    import pyarrow.csv

    # one thread: else error messages have no row number
    rows = {"skip_rows": header.lines, "column_names": header.texts}
    return pyarrow.csv.ReadOptions(use_threads=False, block_size=BLOCK, **rows)


def _sample_csv(pa: Any, path: Path) -> tuple[list[str], Any]:
    import pyarrow.csv

    header = read_header(path)
    check_header(header.texts)
    if header.is_all:
        return header.texts, None
    options = _csv_options(header)
    marks = {"decimal_point": header.decimal_mark, "null_values": _EMPTY, "strings_can_be_null": True}
    convert = pyarrow.csv.ConvertOptions(column_types=_stamp_types(pa, header), **marks)
    with path.open("rb") as stream:
        parse = pyarrow.csv.ParseOptions(delimiter=header.separator)
        return header.texts, pyarrow.csv.open_csv(stream, options, parse, convert).read_next_batch()


def _sample_parquet(pa: Any, path: Path) -> tuple[list[str], Any]:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
        nested = NestedColumns(pa, file)
        check_header(nested.names)
        _check_size(path, file.metadata.num_rows, len(nested.names), whole=False)
        plain = [name for name, type_ in nested.types.items() if _is_number(pa, type_) or _is_stamp(pa, type_)]
        batch = next(file.iter_batches(_SAMPLE, columns=nested.in_file(plain)), None) if plain else None
    return nested.names, None if batch is None else nested.flat(batch)


def table_blocks(path: Path, columns: Columns | None = None) -> Iterator[dict[str, NDArray[Any]]]:
    """As `read_table`, some rows at a time, after a block without rows."""
    return _without_repeats(_every_block(path, columns))


def _without_repeats(blocks: Iterable[dict[str, NDArray[Any]]]) -> Iterator[dict[str, NDArray[Any]]]:
    """Fields of successive rows without those that repeat the one before, stamp and all, whose number is warned of."""
    count, last = 0, dict[str, NDArray[Any]]()
    for block in blocks:
        fields = {name: x for name, x in block.items() if field_shape(name)[:1] == ("N",)}
        stamps = fields.get("time", np.zeros(0))
        again = np.flatnonzero(np.diff(stamps, prepend=last.get("time", [np.nan])) == 0.0)
        for name, x in fields.items() if len(again) else ():
            before = np.concatenate([last.get(name, x[:1]), x[:-1]])[again]
            equal = (x[again] == before) | ((x[again] != x[again]) & (before != before))  # NaN, too
            again = again[equal.all(axis=tuple(range(1, x.ndim)))]
        last = {name: x[-1:].copy() for name, x in fields.items()} if len(stamps) else last
        count += len(again)
        yield block | {name: np.delete(x, again, axis=0) for name, x in fields.items()} if len(again) else block
    if count:
        warn_about_file(f"{format_count(count, 'row')} like the one before, stamp and all: counted once")


def _every_block(path: Path, columns: Columns | None) -> Iterator[dict[str, NDArray[Any]]]:
    pa = _pyarrow(path)
    with _complete(path):
        rows = 0
        for layout, batch in _batches(pa, path, columns, whole=False):
            block = _fields(pa, layout, [] if batch is None else [batch])
            if isinstance(layout, MappedFields) and layout.step is not None:
                block["time"] = layout.stamps(rows, len(block["time"]))
                rows += len(block["time"])
            yield block


def _complete(path: Path) -> AbstractContextManager[None]:
    return reader_errors_explained("file", f"a complete {path.suffix.lower()} file")


def is_text_table(path: Path) -> bool:
    """Whether a table is of text."""
    return path.suffix.lower() in TEXT_TABLES


def _layout(texts: list[str], columns: Columns | None, in_degrees: bool = False) -> _Layout:
    """Which columns a table's fields come from; LogError for angles in degrees without a map."""
    check_header(texts)
    mapped = None if columns is None else map_table(columns, texts, in_degrees)
    layout = parse_header(texts) if mapped is None else mapped
    native = layout.columns if isinstance(layout, TableLayout) else layout.native
    turning = [name for name in native if set(quantities_of(name)) & IN_DEGREES.keys()]
    if in_degrees and turning:
        found = f"yes, though {turning[0]} is a name of the log format, in rad"
        raise LogError.at_field("inDegrees", found, "no, or names that logs.columns has entries for")
    return layout


def _fields(pa: Any, layout: _Layout, batches: list[Any]) -> dict[str, NDArray[Any]]:
    """The fields of some rows; releases the batches."""
    table = pa.Table.from_batches(batches) if batches else None
    samples = 0 if table is None else table.num_rows
    columns = {} if table is None else dict(zip(table.column_names, table.columns, strict=True))
    del table
    batches.clear()

    def take(column: str) -> NDArray[Any]:
        # popped, to release its memory
        return _values(pa, column, columns.pop(column)) if columns else np.zeros(0)

    out = layout.read(take)
    if not out["joint_names"].size:  # a robot without joints
        out["joint_position"] = np.zeros((samples, 0))
    return out


def save_table(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays of a log as a .csv or .parquet file, atomically.

    Raises:
        LogError: a name is not valid in a column, or the file cannot be written.
    """
    pa = _pyarrow(path)
    columns = to_columns(arrays)
    with atomic_output(path) as temporary:
        if path.suffix.lower() == ".parquet":
            import pyarrow.parquet

            table = pa.table({text: pa.array(np.ascontiguousarray(x)) for text, x in columns.items()})
            pyarrow.parquet.write_table(table, temporary, use_dictionary=[TEXT_COLUMN], write_page_checksum=True)
        else:
            _save_csv(pa, temporary, columns)


def _pyarrow(path: Path) -> Any:
    """The module pyarrow; LogError where it is not installed."""
    try:
        import pyarrow
    except ImportError as error:
        found = f"a {path.suffix.lower()} file, but pyarrow is not installed"
        raise LogError(path, "file", found, f"a .npz file, or {how_to_install('tables')}") from error
    return pyarrow


def _batches(pa: Any, path: Path, columns: Columns | None, whole: bool = True) -> Iterator[tuple[_Layout, Any]]:
    """The layout of a table, first with None, then with each batch of rows."""
    return (_read_csv if is_text_table(path) else _read_parquet)(pa, path, columns, whole)


def _read_csv(pa: Any, path: Path, columns: Columns | None, whole: bool) -> Iterator[tuple[_Layout, Any]]:
    import pyarrow.csv

    header = read_header(path)
    layout = _layout(header.named, columns, header.in_degrees)
    yield layout, None
    if header.is_all:
        return
    words = pa.dictionary(pa.int32(), pa.string())
    may_be_text = {TEXT_COLUMN, *layout.flags}
    types = {text: words if text in may_be_text else pa.float64() for text in layout.sources}
    types |= {text: type_ for text, type_ in _stamp_types(pa, header).items() if text in types}
    with path.open("rb") as stream:
        try:
            reader = pyarrow.csv.open_csv(
                stream,
                _csv_options(header),
                pyarrow.csv.ParseOptions(delimiter=header.separator),
                pyarrow.csv.ConvertOptions(
                    column_types=types,
                    null_values=_EMPTY,
                    strings_can_be_null=True,
                    decimal_point=header.decimal_mark,
                    include_columns=layout.sources if columns is not None or header.is_open else None,
                ),
            )
            for batch in _bounded(path, reader, len(types), whole):
                yield layout, batch
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


def _read_parquet(pa: Any, path: Path, columns: Columns | None, whole: bool) -> Iterator[tuple[_Layout, Any]]:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
        texts = NestedColumns(pa, file).names
        layout = _layout(texts, columns)
    # as a dictionary: one long text, repeated in every row, could fill the memory
    with pyarrow.parquet.ParquetFile(
        path, read_dictionary=[TEXT_COLUMN] if TEXT_COLUMN in texts else None, **_PARQUET
    ) as file:
        used, nested = set(layout.sources), NestedColumns(pa, file)
        for name, type_ in nested.types.items():
            number = _is_number(pa, type_) and (name in layout.flags or not pa.types.is_boolean(type_))
            number |= _is_stamp(pa, type_)
            if name in used and not (pa.types.is_dictionary(type_) if name == TEXT_COLUMN else number):
                accepted = "text" if name == TEXT_COLUMN else "real numbers"
                raise LogError(path, f"column '{name}'", f"values of type {type_}", accepted)
        _check_size(path, file.metadata.num_rows, len(used), whole)
        yield layout, None
        only = None if columns is None else nested.in_file(layout.sources)
        for batch in _bounded(path, file.iter_batches(_ROWS, columns=only), len(used), whole):
            yield layout, nested.flat(batch)


def _bounded(path: Path, batches: Iterable[Any], columns: int, whole: bool) -> Iterator[Any]:
    """The batches, with their total size checked: a file may contain more rows than it declares."""
    rows = 0
    for batch in batches:
        rows += batch.num_rows
        _check_size(path, rows, columns, whole)
        if batch.num_rows:
            yield batch


def table_size(path: Path) -> int:
    """Bytes of a table's numbers, without reading them. Raises LogError: the file cannot be read."""
    _pyarrow(path)
    with _complete(path):
        if is_text_table(path):
            columns = len(read_header(path).texts)
            with path.open("rb") as stream:
                return 8 * columns * sum(piece.count(b"\n") for piece in iter(lambda: stream.read(BLOCK), b""))
        import pyarrow.parquet

        with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
            return 8 * int(file.metadata.num_rows) * int(file.metadata.num_columns)


def _check_size(path: Path, rows: int, columns: int, whole: bool) -> None:
    if whole and 8 * rows * columns > MAX_ARRAYS:
        accepted = f"at most {MAX_ARRAYS} bytes in all"
        raise LogError(path, "file", f"{rows} rows of {columns} columns", accepted)
    check_unpacked_size(path, 8 * rows * columns)


def _values(pa: Any, column: str, values: Any) -> NDArray[Any]:
    """A column's values (N,), NaN for empty cells; for text, the common value of all rows."""
    if not pa.types.is_dictionary(values.type):
        if pa.types.is_boolean(values.type) and values.null_count:
            values = values.cast(pa.float64())
        return _numbers(pa, values.combine_chunks())
    values = values.unify_dictionaries()
    words = values.unique().to_pylist()
    if column == TEXT_COLUMN:
        if len(words) != 1 or words[0] is None:
            found = " and ".join("an empty cell" if word is None else f"'{excerpt(word)}'" for word in words[:2])
            raise LogError.at_field(f"column '{column}'", found, "one name, the same in every row")
        check_names([1], len(words[0]))
        return np.array(words[0].strip())
    numbers = {word: np.nan if word is None else _number(column, word) for word in words}
    coded = pa.array([numbers[word] for word in words])
    codes = pa.compute.index_in(values.cast(pa.string()), pa.array(words, pa.string()))
    return np.asarray(coded.take(codes.combine_chunks()).to_numpy(zero_copy_only=False))


def _number(column: str, word: str) -> float:
    try:
        return float(_FLAGS.get(word.strip().lower(), word.replace(",", ".")))
    except ValueError as error:
        raise LogError.at_field(f"column '{column}'", f"'{excerpt(word)}'", "true and false, or 1 and 0") from error


def _save_csv(pa: Any, path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write numbers as the shortest exact text, NaN as an empty cell."""
    import pyarrow.csv

    def rows(first: int) -> Any:
        block = {text: x[first : first + _ROWS] for text, x in columns.items()}
        return pa.table({text: pa.array(np.ascontiguousarray(x), from_pandas=True) for text, x in block.items()})

    with path.open("xb") as stream, pyarrow.csv.CSVWriter(stream, rows(0).schema) as writer:
        for first in range(0, len(columns["time"]), _ROWS):
            writer.write_table(rows(first))
