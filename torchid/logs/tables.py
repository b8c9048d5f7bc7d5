"""Logs as tables, CSV, Parquet and JSON lines, with a row for each stamp, or for each joint at each stamp."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, format_count, join_names, warn_about_file
from torchid.guards import MAX_COLUMNS
from torchid.logs.column_entries import FRACTIONS, KEY
from torchid.logs.column_map import Columns
from torchid.logs.columns import (
    TEXT_COLUMN,
    TableLayout,
    check_header,
    column_values,
    is_number,
    is_stamp,
    parse_header,
    text_or_flags,
    to_columns,
    to_numbers,
)
from torchid.logs.containers import atomic_output, reader_errors_explained
from torchid.logs.log import field_shape
from torchid.logs.mapped_fields import MappedFields, map_table
from torchid.logs.name_matching import propose_field
from torchid.logs.table_files import (
    check_size,
    import_pyarrow,
    open_table,
    write_table,
)
from torchid.logs.units import IN_DEGREES, quantities_of

_Layout = TableLayout | MappedFields  # which columns a table's fields come from


def read_table(path: Path, columns: Columns | None = None) -> dict[str, NDArray[Any]]:
    """The fields of a .csv or .parquet file, including names of joints, contacts and sensors.

    Args:
        path: the file.
        columns: what those of its columns hold that have no names of the log format.

    Raises:
        LogError: one line with the file and the column.
    """
    pa = import_pyarrow(path)
    with _complete(path):
        (layout, _), *rest = _batches(pa, path, columns)
        batches = [batch for _, batch in rest]
        del rest
        (fields,) = _without_repeats([_fields(pa, layout, batches)])
        return fields


def sample_table(path: Path, rows: RowNames | None = None) -> dict[str, NDArray[Any] | None]:
    """The columns of a table with some of their first rows; flags of words, a text alone where it is in all, else None.

    Args:
        path: the file.
        rows: of a table with a row for each joint, of which all rows are taken.

    Raises:
        LogError: the file cannot be read, or has no rows.
    """
    pa = import_pyarrow(path)
    with _complete(path), open_table(pa, path) as table:
        if rows is not None:
            return {**_wide(pa, path, table.whole_table(), rows)}
        names, batch = table.sample_rows()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        read = {name: x for name, x in columns.items() if is_number(pa, x.type) or is_stamp(pa, x.type)}
        texts = {name: x for name, x in columns.items() if pa.types.is_string(x.type) or pa.types.is_dictionary(x.type)}
        found = {name: to_numbers(pa, x) for name, x in read.items()}
        found |= {name: x for name, of in texts.items() if (x := text_or_flags(of)) is not None}
        return {name: found.get(name) for name in names}


def sample_row_names(path: Path) -> RowNames | None:
    """What names the joint of each row, of a table with a row for each joint and stamp; None of other tables."""
    pa = import_pyarrow(path)
    with _complete(path), open_table(pa, path) as table:
        return find_row_names(pa, table.sample_rows()[1])


def table_size(path: Path) -> int:
    """Bytes of a table's numbers, without reading them. Raises LogError: the file cannot be read."""
    pa = import_pyarrow(path)
    with _complete(path), open_table(pa, path) as table:
        return table.count_bytes()


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
    pa = import_pyarrow(path)
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
        return column_values(pa, column, columns.pop(column)) if columns else np.zeros(0)

    out = layout.read(take)
    if not out["joint_names"].size:  # a robot without joints
        out["joint_position"] = np.zeros((samples, 0))
    return out


def save_table(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays of a log as a .csv or .parquet file, atomically.

    Raises:
        LogError: a name is not valid in a column, or the file cannot be written.
    """
    pa = import_pyarrow(path)
    columns = to_columns(arrays)
    with atomic_output(path) as temporary:
        write_table(pa, temporary, columns, path.suffix.lower() == ".parquet")


def _wide(pa: Any, path: Path, table: Any, rows: RowNames) -> dict[str, NDArray[Any]]:
    """A table with a row for each joint as columns of each; LogError for names that are none."""
    wide = with_a_row_for_each_stamp(pa, table, rows, partial(check_size, path, whole=True))
    check_header(list(wide))
    return wide


def _batches(pa: Any, path: Path, columns: Columns | None, whole: bool = True) -> Iterator[tuple[_Layout, Any]]:
    """The layout of a table, first with None, then with each batch of rows."""
    with open_table(pa, path) as table:
        if columns is not None and columns.rows_of is not None:
            rows = table.whole_table()
            wide = _wide(pa, path, rows, row_names_in_map(columns, rows.column_names))
            layout = _layout(list(wide), columns)
            yield layout, None
            yield layout, pa.RecordBatch.from_pydict({name: pa.array(wide[name]) for name in layout.sources})
            return
        names, in_degrees = table.column_names()
        layout = _layout(names, columns, in_degrees)
        yield layout, None
        texts = {TEXT_COLUMN, *layout.flags}
        for batch in table.read_rows(layout.sources, texts, columns is not None, whole):
            yield layout, batch


ROWS_OF = "rows_of"
"""The key of `logs.columns` that says which column names the joint of a row."""

_FEWEST = 2  # names that rows of one stamp have
_MOST = 100  # numbers of joints


@dataclass(frozen=True)
class RowNames:
    """The column that names the joint of each row, and those of stamps, which rows share."""

    column: str
    stamps: Sequence[str]


def row_names_in_map(columns: Columns, texts: Sequence[str]) -> RowNames:
    """What a map says of rows. Raises LogError: a table has no such column, or no stamps."""
    name = columns.rows_of or ""
    if name not in texts:
        raise LogError.at_field(f"{KEY}.{ROWS_OF}", f"no column '{excerpt(name)}'", f"one of {join_names(texts)}")
    entry = columns.time
    named = [] if entry is None else [entry.column, *(getattr(entry, name) for name in FRACTIONS)]
    found = [name for name in named or ["time"] if name in texts]
    if not found:
        accepted = f"a column of stamps in {KEY}.time, by which rows belong together"
        raise LogError.at_field(f"{KEY}.{ROWS_OF}", f"no column of stamps beside '{name}'", accepted)
    return RowNames(name, found)


def find_row_names(pa: Any, table: Any) -> RowNames | None:
    """The column with another name in each of successive rows of one stamp, the same ones at most; None without one.

    Args:
        pa: pyarrow.
        table: its batch of the first rows of a table.
    """
    columns = {name: pa.chunked_array([x]) for name, x in zip(table.schema.names, table.columns, strict=True)}
    stamps = [name for name in columns if propose_field(name) == "time" and _is_numeric(pa, columns[name].type)]
    for stamp in stamps:
        times = np.asarray(to_numbers(pa, columns[stamp].combine_chunks()), np.float64)
        samples = np.cumsum(np.diff(times, prepend=times[:1]) != 0)
        count = int(samples.max(initial=-1)) + 1
        if len(samples) < _FEWEST * count:
            continue
        for name, values in columns.items():
            if name == stamp or values.null_count or not _may_name(pa, values):
                continue
            words, codes = _names(pa, values)
            pairs = np.unique(samples * len(words) + codes)
            if len(words) >= _FEWEST and 2 * len(pairs) > count * len(words) and len(pairs) == len(samples):
                return RowNames(name, [stamp])
    return None


def _may_name(pa: Any, values: Any) -> bool:
    """Whether a column has texts, or numbers that count joints: no nanoseconds."""
    if not is_number(pa, values.type):
        return _is_text(pa, values.type)
    numbers = np.unique(np.asarray(to_numbers(pa, values.combine_chunks()), np.float64))
    return len(numbers) <= _MOST and bool((numbers == numbers[0] + np.arange(len(numbers))).all())


def with_a_row_for_each_stamp(
    pa: Any, table: Any, rows: RowNames, check: Callable[[int, int], None]
) -> dict[str, NDArray[Any]]:
    """Columns (N,) of a table with a row for each joint and stamp: `position.l_knee` of `position`.

    A column with one value at each stamp, such as of the base, keeps its name. Where a joint has no row, NaN.

    Args:
        pa: pyarrow.
        table: its table; columns of texts that are no flags are left out.
        rows: the column with the names, and those of stamps.
        check: called with the numbers of rows and columns, before these take memory.

    Raises:
        LogError: an empty name, too many columns, or two rows of one joint at one stamp.

    Warns:
        TorchidWarning: rows that are there twice.
    """
    columns = dict(zip(table.column_names, table.columns, strict=True))
    words, codes = _names(pa, columns.pop(rows.column))
    shared = [to_numbers(pa, columns.pop(name).combine_chunks()) for name in rows.stamps]
    keys, first, samples = np.unique(np.stack(shared, axis=1), axis=0, return_index=True, return_inverse=True)
    samples = samples.reshape(-1)
    every = {name: _values(pa, x) for name, x in columns.items()}
    numbers = {name: np.asarray(x, np.float64) for name, x in every.items() if x is not None and len(x) == len(samples)}
    if len(numbers) * len(words) > MAX_COLUMNS:
        found = f"{len(words)} names in {format_count(len(numbers), 'column')} of numbers"
        raise LogError.at_field(f"column '{rows.column}'", found, f"at most {MAX_COLUMNS} columns in all")
    check(len(keys), len(numbers) * len(words))
    out = dict(zip(rows.stamps, keys.T, strict=True))
    again = len(samples) - len(np.unique(samples * len(words) + codes))
    for name, values in numbers.items():
        of_stamps = values[first]
        if np.array_equal(of_stamps[samples], values, equal_nan=True):
            out[name] = of_stamps
            continue
        wide = np.full((len(keys), len(words)), np.nan)
        wide[samples, codes] = values
        other = ~((wide[samples, codes] == values) | np.isnan(values))
        if again and other.any():
            row = int(np.argmax(other))
            found = f"two rows of '{excerpt(words[codes[row]])}' at {keys[samples[row]][0]:.10g}, with two of '{name}'"
            raise LogError.at_field(f"column '{rows.column}'", found, "one row of each at each stamp")
        out |= {f"{name}.{word}": x for word, x in zip(words, np.ascontiguousarray(wide.T), strict=True)}
    if again:
        warn_about_file(f"{format_count(again, 'row')} of a joint and stamp that have one already: counted once")
    return out


def _is_numeric(pa: Any, type_: Any) -> bool:
    return is_number(pa, type_) or is_stamp(pa, type_)


def _values(pa: Any, values: Any) -> NDArray[Any] | None:
    """Numbers, or flags, of each row; None of other texts."""
    if _is_numeric(pa, values.type):
        return to_numbers(pa, values.combine_chunks())
    return text_or_flags(values) if _is_text(pa, values.type) else None


def _is_text(pa: Any, type_: Any) -> bool:
    return bool(pa.types.is_string(type_) or pa.types.is_dictionary(type_))


def _names(pa: Any, values: Any) -> tuple[list[str], NDArray[Any]]:
    """Names in the order in which they first appear, and which each row has (N,). Raises LogError: a row has none."""
    if values.null_count:
        raise LogError.at_field(f"{KEY}.{ROWS_OF}", "an empty cell", "a name in each row")
    if pa.types.is_floating(values.type):  # of JSON, whole numbers
        values = values.cast(pa.int64())
    coded = values.cast(pa.string()).combine_chunks().dictionary_encode()
    return [word.strip() for word in coded.dictionary.to_pylist()], np.asarray(coded.indices)
