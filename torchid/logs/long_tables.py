"""Tables with a row for each joint at each stamp, as tables with a column for each joint.

pyarrow is passed in by `torchid.logs.tables`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, format_count, join_names, warn_about_file
from torchid.guards import MAX_COLUMNS
from torchid.logs.column_entries import FRACTIONS, KEY
from torchid.logs.column_map import Columns
from torchid.logs.name_matching import propose_field
from torchid.logs.table_values import is_number, is_stamp, text_or_flags, to_numbers

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
