"""Logs as tables, CSV and Parquet (the only module that imports pyarrow)."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, how_to_install
from torchid.guards import MAX_ARRAYS, MAX_SCHEMA, check_names, check_unpacked_size
from torchid.logs.columns import TEXT_COLUMN, TableLayout, column_names, parse_header
from torchid.logs.containers import atomic_output, reader_errors_explained
from torchid.logs.log import NAME_FIELDS

#: Bytes of a CSV file that are parsed at a time; no row may be longer.
_BLOCK = 2**22
#: Rows that are converted at a time.
_ROWS = 2**16
#: Limits on the metadata of a Parquet file (bytes of names and statistics, entries of lists); checksums are verified.
_PARQUET = {
    "thrift_string_size_limit": 2**26,
    "thrift_container_size_limit": MAX_SCHEMA,
    "page_checksum_verification": True,
}
_BAD_CELL = re.compile(r"In CSV column #(\d+): (?:Row #(\d+): )?.*?invalid value '(.{0,40})", re.DOTALL)
_QUOTES = "'\n"
_EMPTY = ["", " ", "  ", "nan", "NaN", "NAN"]
_FLAGS = {"true": "1", "false": "0"}
_NUMBERS = "numbers, or empty cells where nothing was measured"


def read_table(path: Path) -> dict[str, NDArray[Any]]:
    """The fields of a .csv or .parquet file, including names of joints, contacts and sensors.

    Raises:
        LogError: one line with the file and the column.
    """
    pa = _pyarrow(path)
    with _complete(path):
        (layout, _), *rest = _batches(pa, path)
        batches = [batch for _, batch in rest]
        del rest
        return _fields(pa, layout, batches)


def table_blocks(path: Path) -> Iterator[dict[str, NDArray[Any]]]:
    """As `read_table`, some rows at a time, after a block without rows."""
    pa = _pyarrow(path)
    with _complete(path):
        for layout, batch in _batches(pa, path, whole=False):
            yield _fields(pa, layout, [] if batch is None else [batch])


def _complete(path: Path) -> AbstractContextManager[None]:
    return reader_errors_explained("file", f"a complete {path.suffix.lower()} file")


def _fields(pa: Any, layout: TableLayout, batches: list[Any]) -> dict[str, NDArray[Any]]:
    """The fields of some rows; releases the batches."""
    table = pa.Table.from_batches(batches) if batches else None
    samples = 0 if table is None else table.num_rows
    columns = {} if table is None else dict(zip(table.column_names, table.columns, strict=True))
    del table
    batches.clear()

    def take(column: str) -> NDArray[Any]:
        # popped, to release its memory
        return _values(pa, column, columns.pop(column)) if columns else np.zeros(0)

    return layout.fields(samples, take)


def save_table(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays of a log as a .csv or .parquet file, atomically.

    Raises:
        LogError: a name is not valid in a column, or the file cannot be written.
    """
    pa = _pyarrow(path)
    columns = _columns(arrays)
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
        raise LogError(path, "file", found, f"a .npz or .h5 file, or {how_to_install('tables')}") from error
    return pyarrow


def _batches(pa: Any, path: Path, whole: bool = True) -> Iterator[tuple[TableLayout, Any]]:
    """The layout of a table, first with None, then with each batch of rows."""
    return (_read_csv if path.suffix.lower() == ".csv" else _read_parquet)(pa, path, whole)


def _read_csv(pa: Any, path: Path, whole: bool) -> Iterator[tuple[TableLayout, Any]]:
    import pyarrow.csv

    texts, empty = _header(path)
    layout = parse_header(texts)
    yield layout, None
    if empty:
        return
    words = pa.dictionary(pa.int32(), pa.string())
    types = {text: words if _is_text(text) else pa.float64() for text in texts}
    with path.open("rb") as stream:
        try:
            reader = pyarrow.csv.open_csv(
                stream,
                # one thread: else error messages have no row number
                pyarrow.csv.ReadOptions(use_threads=False, block_size=_BLOCK, skip_rows=1, column_names=texts),
                convert_options=pyarrow.csv.ConvertOptions(
                    column_types=types, null_values=_EMPTY, strings_can_be_null=True
                ),
            )
            for batch in _bounded(path, reader, len(texts), whole):
                yield layout, batch
        except pa.ArrowInvalid as error:
            bad = _BAD_CELL.match(str(error))
            if bad is None:
                raise
            column, row, found = bad.groups()
            where = "" if row is None else f" in row {row}"
            text = f"'{excerpt(found.strip(_QUOTES))}'{where}"
            raise LogError(path, f"column '{texts[int(column)]}'", text, _NUMBERS) from error


def _header(path: Path) -> tuple[list[str], bool]:
    """Names of a CSV file's columns, and whether it has no rows."""
    with path.open("rb") as stream:
        line = stream.readline(_BLOCK)
        empty = not stream.read(_BLOCK).strip()
    if not line.strip():
        raise LogError(path, "header", "an empty line", "the names of the columns")
    if len(line) == _BLOCK:
        raise LogError(path, "header", f"a line of at least {_BLOCK} bytes", "the names of the columns")
    text = line.decode("utf-8-sig").rstrip("\r\n")
    try:
        texts = [text.strip() for text in next(csv.reader([text], strict=True))]
    except csv.Error as error:
        raise LogError(path, "header", f"no line of names ({error})", "names separated by commas") from error
    if len(texts) == 1 and re.search("[;\t]", text):
        raise LogError(path, "header", f"'{excerpt(text)}'", "names separated by commas")
    return texts, empty


def _read_parquet(pa: Any, path: Path, whole: bool) -> Iterator[tuple[TableLayout, Any]]:
    import pyarrow.parquet

    with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
        texts = file.schema_arrow.names
        layout = parse_header(texts)
    # as a dictionary: one long text, repeated in every row, could fill the memory
    with pyarrow.parquet.ParquetFile(
        path, read_dictionary=[TEXT_COLUMN] if TEXT_COLUMN in texts else None, **_PARQUET
    ) as file:
        for field in file.schema_arrow:
            number = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
            fits = pa.types.is_dictionary(field.type) if field.name == TEXT_COLUMN else number
            if not fits and not (_is_text(field.name) and pa.types.is_boolean(field.type)):
                accepted = "text" if field.name == TEXT_COLUMN else "real numbers"
                raise LogError(path, f"column '{field.name}'", f"values of type {field.type}", accepted)
        _check_size(path, file.metadata.num_rows, len(texts), whole)
        yield layout, None
        for batch in _bounded(path, file.iter_batches(_ROWS), len(texts), whole):
            yield layout, batch


def _bounded(path: Path, batches: Iterable[Any], columns: int, whole: bool) -> Iterator[Any]:
    """The batches, with their total size checked: a file may contain more rows than it declares."""
    rows = 0
    for batch in batches:
        rows += batch.num_rows
        _check_size(path, rows, columns, whole)
        if batch.num_rows:
            yield batch


def table_size(path: Path) -> int:
    """Bytes of a table's numbers, without reading them.

    Raises:
        LogError: the file cannot be read.
    """
    _pyarrow(path)
    with _complete(path):
        if path.suffix.lower() == ".csv":
            texts, _ = _header(path)
            with path.open("rb") as stream:
                return 8 * len(texts) * sum(piece.count(b"\n") for piece in iter(lambda: stream.read(_BLOCK), b""))
        import pyarrow.parquet

        with pyarrow.parquet.ParquetFile(path, **_PARQUET) as file:
            return 8 * int(file.metadata.num_rows) * len(file.schema_arrow.names)


def _check_size(path: Path, rows: int, columns: int, whole: bool) -> None:
    if whole and 8 * rows * columns > MAX_ARRAYS:
        accepted = f"at most {MAX_ARRAYS} bytes in all"
        raise LogError(path, "file", f"{rows} rows of {columns} columns", accepted)
    check_unpacked_size(path, 8 * rows * columns)


def _is_text(column: str) -> bool:
    """Whether a column may contain text: the IMU's frame, and flags as `true` and `false`."""
    return column == TEXT_COLUMN or column.startswith("contact_active.")


def _values(pa: Any, column: str, values: Any) -> NDArray[Any]:
    """A column's values (N,), NaN for empty cells; for text, the common value of all rows."""
    if not pa.types.is_dictionary(values.type):
        if pa.types.is_boolean(values.type) and values.null_count:
            values = values.cast(pa.float64())
        return np.asarray(values.to_numpy())
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
        return float(_FLAGS.get(word.strip().lower(), word))
    except ValueError as error:
        raise LogError.at_field(f"column '{column}'", f"'{excerpt(word)}'", "true and false, or 1 and 0") from error


def _columns(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The columns of a log, by name."""
    names = {name: tuple(map(str, arrays[name])) for name in NAME_FIELDS if name in arrays}
    columns: dict[str, NDArray[Any]] = {}
    for field, array in arrays.items():
        if field in NAME_FIELDS:
            continue
        if field == TEXT_COLUMN:
            columns[field] = np.full(len(arrays["time"]), str(array))
            continue
        flat = array.reshape(len(array), -1)
        for j, text in enumerate(column_names(field, names)):
            if text != text.strip():
                raise LogError.at_field(f"column '{text}'", "a space at its end", "names without")
            columns[text] = flat[:, j]
    layout = parse_header(list(columns))
    for name, given in names.items():
        if given and layout.names.get(name) != given:
            raise LogError.at_field(name, "names without any values", "a .npz or .h5 file, or a field of them")
    return columns


def _save_csv(pa: Any, path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write numbers as the shortest exact text, NaN as an empty cell."""
    import pyarrow.csv

    def rows(first: int) -> Any:
        block = {text: x[first : first + _ROWS] for text, x in columns.items()}
        return pa.table({text: pa.array(np.ascontiguousarray(x), from_pandas=True) for text, x in block.items()})

    with path.open("xb") as stream, pyarrow.csv.CSVWriter(stream, rows(0).schema) as writer:
        for first in range(0, len(columns["time"]), _ROWS):
            writer.write_table(rows(first))
