"""Logs as tables, CSV, Parquet and JSON lines: the fields in columns that another process reads; writing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, format_count, join_names, warn_about_file
from torchid.guards import MAX_COLUMNS
from torchid.logs.columns import FRACTIONS, KEY, Columns, component_names, names_field
from torchid.logs.containers import atomic_output, reader_errors_explained
from torchid.logs.log import FLAG_WORDS, NAME_FIELDS, TEXT_FIELD, field_shape
from torchid.logs.schema import FileFields, match_table
from torchid.logs.table_files import check_column_names, import_pyarrow, serve_table, write_csv, write_parquet
from torchid.reader import RemoteObject, open_apart

Arrays = dict[str, NDArray[Any]]
"""Columns (N,) by name: numbers, NaN for empty cells, or texts."""


# ------------------------------------------------------------------------------------------------------------- reading


@contextmanager
def _opened(path: Path) -> Iterator[RemoteObject]:
    """Open a table in another process."""
    import_pyarrow(path)
    with (
        reader_errors_explained("file", f"a complete {path.suffix.lower()} file"),
        open_apart(serve_table, path) as table,
    ):
        yield table


def table_names(path: Path) -> tuple[list[str], bool]:
    """The columns of a table, and whether the file says that angles are in degrees."""
    with _opened(path) as table:
        names, in_degrees = table.call("header")
        return names, in_degrees


def sample_table(path: Path) -> dict[str, NDArray[Any] | None]:
    """The columns of a table with some of their first rows; None for what is neither numbers nor short texts.

    Raises:
        LogError: the file cannot be read, or has no rows.
    """
    with _opened(path) as table:
        columns: dict[str, NDArray[Any] | None] = table.call("sample")
        return columns


def table_size(path: Path) -> int:
    """Bytes of a table's numbers, without reading them. Raises LogError: the file cannot be read."""
    with _opened(path) as table:
        return int(table.call("count_bytes"))


def read_table(path: Path, columns: Columns | None = None) -> Arrays:
    """The fields of a table, including names of joints, contacts and sensors.

    Args:
        path: the file.
        columns: what those of its columns hold that have no names of the log format.

    Raises:
        LogError: one line with the file and the column.
    """
    blocks = list(_without_repeats(_every_block(path, columns, whole=True)))
    sampled = [name for name in blocks[0] if field_shape(name)[:1] == ("N",)]
    blocks = blocks[1:] or blocks
    return common_texts(blocks) | _joined(sampled, blocks)


def table_blocks(path: Path, columns: Columns | None = None) -> Iterator[Arrays]:
    """As `read_table`, some rows at a time, after a block without rows."""
    return _without_repeats(_every_block(path, columns, whole=False))


def common_texts(blocks: Iterable[Arrays]) -> Arrays:
    """Names and other texts of all rows; LogError where they differ."""
    out: Arrays = {}
    for block in blocks:
        for name, array in block.items():
            if field_shape(name)[:1] != ("N",) and array.tolist() != out.setdefault(name, array).tolist():
                reason = f"'{out[name]}' and '{array}'"
                raise LogError.at_field(f"column '{name}'", reason, "the same name in every row")
    return out


def _every_block(path: Path, columns: Columns | None, whole: bool) -> Iterator[Arrays]:
    with _opened(path) as table:
        if columns is not None and columns.rows_of is not None:
            every = [name for name, values in table.call("sample").items() if values is not None]
            of_rows = _joined(every, list(table.stream("read_rows", every, every, True)))
            wide = pivoted(of_rows, row_names_in_map(columns, table.call("header")[0]))
            check_column_names(list(wide))
            fields = match_table(columns, list(wide))
            blocks: Iterable[Arrays] = [{name: wide[name] for name in fields.sources}]
        else:
            fields = match_table(columns, *table.call("header"))
            blocks = table.stream("read_rows", fields.sources, _texts(fields), whole)
        yield _fields(fields, {name: np.zeros(0) for name in fields.sources})
        rows = 0
        for block in blocks:
            out = _fields(fields, block)
            if fields.step is not None:
                out["time"] = fields.stamps(rows, len(out["time"]))
                rows += len(out["time"])
            yield out


def _texts(fields: FileFields) -> list[str]:
    """Columns that may hold texts: flags in words, and the frame of the IMU."""
    has_threshold = fields.columns.contact_active is not None and fields.columns.contact_active.above is not None
    flags = fields.sources_of("contact_active") if "contact_active" in fields.fields and not has_threshold else ()
    return [*flags, *([fields.frame_column] if fields.frame_column else [])]


def _joined(names: Iterable[str], blocks: list[Arrays]) -> Arrays:
    """Columns of successive blocks as one; releases these."""
    out = {}
    for name in names:
        parts = [block.pop(name) for block in blocks]
        out[name] = np.concatenate(parts) if len(parts) > 1 else parts[0] if parts else np.zeros(0)
    return out


def _fields(fields: FileFields, columns: Arrays) -> Arrays:
    """The fields of some rows; releases the columns."""
    samples = len(next(iter(columns.values()), ()))
    if fields.frame_column:
        words = sorted(np.unique(columns[fields.frame_column]).tolist(), key=lambda word: not word)
        if len(words) > 1 or words == [""]:
            reason = " and ".join(f"'{excerpt(str(word))}'" if word else "an empty cell" for word in words[:2])
            raise LogError.at_field(f"column '{TEXT_FIELD}'", reason, "the same name in every row")
        columns[fields.frame_column] = np.array(str(words[0]).strip() if words else "")
    out = fields.read(columns.pop)
    if not out["joint_names"].size:  # a robot without joints
        out["joint_position"] = np.zeros((samples, 0))
    return out


def _without_repeats(blocks: Iterable[Arrays]) -> Iterator[Arrays]:
    """Fields of successive rows without those that repeat the one before, stamp and all, whose number is warned of."""
    count = 0
    last = dict[str, NDArray[Any]]()
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
        warn_about_file(f"{format_count(count, 'row')} equal to the previous one, including the stamp: ignored")


# ------------------------------------------------------------------------------------------------ a row for each joint

_ROWS_OF = f"{KEY}.rows_of"


@dataclass(frozen=True)
class RowNames:
    """The column that names the joint of each row, and those of stamps, which rows share."""

    column: str
    stamps: Sequence[str]


def row_names_in_map(columns: Columns, texts: Sequence[str]) -> RowNames:
    """What a map says of rows. Raises LogError: a table has no such column, or no stamps."""
    name = columns.rows_of or ""
    entry = columns.time
    if name not in texts:
        raise LogError.at_field(_ROWS_OF, f"no column '{excerpt(name)}'", f"one of {join_names(texts)}")
    named = ["time"] if entry is None else [entry.column, *(getattr(entry, fraction) for fraction in FRACTIONS)]
    stamps = [text for text in named if text in texts]
    if not stamps:
        accepted = f"a column of stamps in {KEY}.time, to group the rows"
        raise LogError.at_field(_ROWS_OF, "no column of stamps", accepted)
    return RowNames(name, stamps)


def pivoted(columns: Mapping[str, NDArray[Any]], rows: RowNames) -> Arrays:
    """Columns (N,) of a table with a row for each joint and stamp: `position.l_knee` of `position`.

    A column with one value at each stamp, such as of the base, keeps its name. Where a joint has no row, NaN.

    Args:
        columns: of numbers or texts.
        rows: the column with the names, and those of stamps.

    Raises:
        LogError: an empty name, too many columns, or two rows of one joint at one stamp.

    Warns:
        TorchidWarning: rows that are there twice.
    """
    texts = columns[rows.column]
    texts = texts if texts.dtype.kind == "U" else np.array([f"{value:g}" for value in texts])
    if (texts == "").any() or (texts == "nan").any():
        raise LogError.at_field(_ROWS_OF, "an empty cell", "a name in each row")
    _, first, codes = np.unique(texts, return_index=True, return_inverse=True)
    order = np.argsort(first)
    words = [texts[k].strip() for k in np.sort(first)]
    codes = np.argsort(order)[codes]
    shared = np.stack([columns[name] for name in rows.stamps], axis=1)
    keys, first, samples = np.unique(shared, axis=0, return_index=True, return_inverse=True)
    samples = samples.reshape(-1)
    others = {name: x for name, x in columns.items() if name not in (rows.column, *rows.stamps) and _has_flags(x)}
    if len(others) * len(words) > MAX_COLUMNS:
        reason = f"{len(words)} names and {format_count(len(others), 'column')} of numbers"
        raise LogError.at_field(f"column '{rows.column}'", reason, f"at most {MAX_COLUMNS} columns in all")
    out = dict(zip(rows.stamps, keys.T, strict=True))
    again = len(samples) - len(np.unique(samples * len(words) + codes))
    for name, values in others.items():
        at_stamps = values[first]
        is_text = values.dtype.kind == "U"
        if np.array_equal(at_stamps[samples], values, equal_nan=not is_text):
            out[name] = at_stamps
        if is_text or name in out:
            continue
        wide = np.full((len(keys), len(words)), np.nan)
        wide[samples, codes] = values
        other = ~((wide[samples, codes] == values) | np.isnan(values))
        if again and other.any():
            row = int(np.argmax(other))
            reason = f"two rows of '{excerpt(words[codes[row]])}' at {keys[samples[row]][0]:.10g} differ in '{name}'"
            raise LogError.at_field(f"column '{rows.column}'", reason, "one row per name and stamp")
        out |= {f"{name}.{word}": x for word, x in zip(words, np.ascontiguousarray(wide.T), strict=True)}
    if again:
        warn_about_file(f"{format_count(again, 'row')} with the same joint and stamp as another: ignored")
    return out


def _has_flags(values: NDArray[Any]) -> bool:
    """Whether a column has numbers, or words that say whether a contact touches."""
    return values.dtype.kind != "U" or {text.strip().lower() for text in np.unique(values).tolist()} <= {
        *FLAG_WORDS,
        "",
    }


# ------------------------------------------------------------------------------------------------------------- writing


def save_table(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write the arrays of a log as a .csv or .parquet file, atomically.

    Raises:
        LogError: a name is not valid in a column, or the file cannot be written.
    """
    import_pyarrow(path)
    columns = _columns_of(arrays)
    with atomic_output(path) as temporary:
        write = write_parquet if path.suffix.lower() == ".parquet" else write_csv
        write(temporary, columns)


def _columns_of(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    """The columns (N,) of a log's fields, by name; LogError for a name that no column can have, or without values."""
    columns: Arrays = {}
    for field, array in arrays.items():
        if field in NAME_FIELDS:
            continue
        if field == TEXT_FIELD:
            columns[field] = np.full(len(arrays["time"]), str(array))
            continue
        names = arrays[names_field(field)].tolist() if names_field(field) else [""]
        flat = array.reshape(len(array), -1)
        texts = [
            ".".join(filter(None, (field, name, axis))) for name in names for axis in component_names(field) or ("",)
        ]
        for j, text in enumerate(texts):
            if text != text.strip():
                raise LogError.at_field(f"column '{text}'", "a space at its end", "names without such spaces")
            columns[text] = flat[:, j]
    check_column_names(list(columns))
    stated = match_table(None, list(columns)).names
    for name in NAME_FIELDS:
        if name in arrays and len(arrays[name]) and stated.get(name) != tuple(arrays[name].tolist()):
            raise LogError.at_field(name, "names without values", "a .npz or .h5 file, or a field with these names")
    return columns
