"""Columns of a table, one per scalar: their names, which field each belongs to, and their values.

pyarrow is passed in by `torchid.logs.tables`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, is_plain
from torchid.guards import MAX_COLUMNS, check_names
from torchid.guards import MAX_LETTERS as MAX_NAME
from torchid.logs.log import (
    FLAG_ACCEPTED,
    FLAG_WORDS,
    NAME_FIELDS,
    SHAPES,
    VARIANTS,
    UnknownFieldError,
    field_shape,
    is_quaternion,
)
from torchid.logs.name_matching import is_foreign, unknown_columns
from torchid.parameters import WRENCH_COMPONENTS

#: The one column of text: the same in every row.
TEXT_COLUMN = "imu_frame"
COLUMN_FIELDS = tuple(name for name in (*SHAPES, *VARIANTS) if name not in NAME_FIELDS)
#: Characters in the name of a column, which contains that of a joint.
MAX_COLUMN_LETTERS = 2 * MAX_NAME

_UNIT = re.compile(r"\[.*\]$|\(.*\)$")
KINDS = {"joint_names": "joint", "contact_names": "contact", "ft_names": "sensor"}


@dataclass(frozen=True)
class _Column:
    """One scalar: its field and, where the field has them, the name and the component."""

    field: str
    name: str = ""
    component: str = ""

    def __str__(self) -> str:
        return ".".join(part for part in (self.field, self.name, self.component) if part)


@dataclass(frozen=True)
class TableLayout:
    """Columns of each field of a table.

    Attributes:
        names: names of joints, contacts and sensors, by field.
        columns: by field, its columns in the order of its elements.
    """

    names: dict[str, tuple[str, ...]]
    columns: dict[str, tuple[str, ...]]

    @property
    def sources(self) -> tuple[str, ...]:
        """All columns."""
        return tuple(column for columns in self.columns.values() for column in columns)

    @property
    def flags(self) -> tuple[str, ...]:
        """Columns that may hold true and false."""
        return self.columns.get("contact_active", ())

    def read(self, take: Callable[[str], NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """The arrays of a log file; `take` returns the values (N,) of a column and is called once for each."""
        out: dict[str, NDArray[Any]] = {name: np.array(names, dtype=np.str_) for name, names in self.names.items()}
        for field, columns in self.columns.items():
            taken = [take(column) for column in columns]
            out[field] = taken[0] if field == TEXT_COLUMN else self.field(field, taken)
        return out

    def field(self, name: str, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
        """A field (N, ...) of the values (N,) of its columns."""
        flat = np.stack(columns, axis=-1)
        sizes = {letter: len(self.names.get(field, ())) for field, letter in NAME_FIELDS.items()}
        shape = [sizes[x] if isinstance(x, str) else x for x in field_shape(name)[1:]]
        return flat.reshape(len(flat), *shape)


def parse_header(texts: Sequence[str], named: Mapping[str, tuple[str, ...]] | None = None) -> TableLayout:
    """Sort the columns of a table into fields.

    Joints, contacts and sensors are named by the columns of the first of their fields; the others have the same.

    Args:
        texts: the columns.
        named: names of joints, contacts and sensors by field, where they are known already.

    Raises:
        LogError: a column is missing, or some are unknown: all of these are named at once.
    """
    given: dict[str, dict[str, _Column]] = {}
    unknown: dict[str, LogError] = {}
    for text in texts:
        try:
            column = _parse_column(text)
        except LogError as error:
            unknown[text] = error
        else:
            given.setdefault(column.field, {})[text] = column
    if unknown:
        (name, failure), *others = unknown.items()
        raise unknown_columns(list(unknown)) if others or is_foreign(name) else failure
    names: dict[str, tuple[str, ...]] = dict(named or {})
    for field in COLUMN_FIELDS:
        of = names_field(field)
        if of and of not in names and field in given:
            names[of] = tuple(dict.fromkeys(column.name for column in given[field].values()))
    columns = {field: column_names(field, names) for field in given}
    for field, expected in columns.items():
        _check_complete(field, expected, given[field])
    return TableLayout({"joint_names": (), **names}, columns)


def check_header(texts: Sequence[str]) -> None:
    """Raise LogError for too many columns, and names that are too long, of control characters, or given twice."""
    if len(texts) > MAX_COLUMNS:
        raise LogError.at_field("file", f"{len(texts)} columns", f"at most {MAX_COLUMNS}")
    seen = set[str]()
    for text in texts:
        if len(text) > MAX_COLUMN_LETTERS or not is_plain(text):
            found = f"a name of {len(text)} characters: {excerpt(text)}"
            raise LogError.at_field("header", found, f"names of one line and at most {MAX_COLUMN_LETTERS} characters")
        if text in seen:
            raise LogError.at_field(f"column '{text}'", "given twice", "every column once")
        seen.add(text)


def is_column(text: str) -> bool:
    """Whether a column has a name of the log format."""
    try:
        _parse_column(text)
    except LogError:
        return False
    return True


def _check_complete(field: str, expected: Sequence[str], given: Mapping[str, _Column]) -> None:
    missing = [text for text in expected if text not in given]
    if missing:
        accepted = f"every column of {_column_pattern(field)}; a cell may be empty where nothing was measured"
        raise LogError.at_field(f"column '{missing[0]}'", f"missing, though there is '{next(iter(given))}'", accepted)
    extra = list(given.keys() - set(expected))
    if extra:
        found = f"a {KINDS[names_field(field)]} that the first field of its kind does not name"
        raise LogError.at_field(f"column '{extra[0]}'", found, "the same names in all fields")


def _parse_column(text: str) -> _Column:
    """The parts of a column's name: the field up to its first dot, a component after its last.

    Raises:
        LogError: no column has such a name.
    """
    field, _, rest = text.partition(".")
    if _UNIT.search(text):
        raise LogError.at_field(f"column '{text}'", "a unit in its name", "names without units, values in SI units")
    if field not in COLUMN_FIELDS:
        raise UnknownFieldError.at_field(f"column '{text}'", field, COLUMN_FIELDS)
    components, of = component_names(field), names_field(field)
    if of and components:
        name, _, component = rest.rpartition(".")
    else:
        name, component = (rest, "") if of else ("", rest)
    column = _Column(field, name, component)
    if str(column) != text or bool(name) != bool(of) or (component not in components if components else component):
        raise LogError.at_field(f"column '{text}'", "no such part of this field", _column_pattern(field))
    return column


def column_names(field: str, names: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    """The columns of a field in the order of its elements; `names` by field."""
    of = names_field(field)
    return tuple(
        str(_Column(field, name, component))
        for name in (names[of] if of else ("",))
        for component in component_names(field) or ("",)
    )


def component_names(field: str) -> tuple[str, ...]:
    """Possible last parts of a column's name; none for fields without components."""
    size = field_shape(field)[-1] if len(field_shape(field)) > 1 else None
    if size == 6:
        return WRENCH_COMPONENTS
    if is_quaternion(field):
        return tuple(field.rpartition("_")[2])
    return ("x", "y", "z") if size == 3 else ()


def _column_pattern(field: str) -> str:
    """Pattern of a field's column names, such as `ft_wrench.<sensor>.{fx, fy, fz, mx, my, mz}`."""
    of, components = names_field(field), component_names(field)
    return str(_Column(field, f"<{KINDS[of]}>" if of else "", f"{{{', '.join(components)}}}" if components else ""))


def names_field(field: str) -> str:
    """The field with the names of a field's columns (`joint_names`, ...), or ""."""
    letter = next((x for x in field_shape(field)[1:2] if isinstance(x, str)), None)
    return next((name for name, of in NAME_FIELDS.items() if of == letter), "")


def to_columns(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The columns (N,) of a log's fields, by name.

    Raises:
        LogError: a name that no column can have, or names without any values.
    """
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
    check_header(list(columns))
    layout = parse_header(list(columns))
    for name, given in names.items():
        if given and layout.names.get(name) != given:
            raise LogError.at_field(name, "names without any values", "a .npz or .h5 file, or a field of them")
    return columns


_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}


def is_number(pa: Any, type_: Any) -> bool:
    """Whether a type is that of numbers, or true and false."""
    return bool(pa.types.is_integer(type_) or pa.types.is_floating(type_) or pa.types.is_boolean(type_))


def is_stamp(pa: Any, type_: Any) -> bool:
    """Whether a type is that of dates or times of day."""
    return bool(pa.types.is_timestamp(type_) or pa.types.is_time(type_) or pa.types.is_duration(type_))


def to_numbers(pa: Any, values: Any) -> NDArray[Any]:
    """Numbers (N,) of a column: of dates seconds since 1970, of times of day since midnight, NaN for empty cells."""
    if not is_stamp(pa, values.type):
        return np.asarray(values.to_numpy(False))
    whole = np.asarray(values.cast(pa.int32() if values.type.bit_width == 32 else pa.int64()).to_numpy(False))
    return whole / _PER_SECOND[values.type.unit]


def column_values(pa: Any, column: str, values: Any) -> NDArray[Any]:
    """A column's values (N,), NaN for empty cells; for text, the common value of all rows."""
    if not pa.types.is_dictionary(values.type):
        if pa.types.is_boolean(values.type) and values.null_count:
            values = values.cast(pa.float64())
        return to_numbers(pa, values.combine_chunks())
    values = values.unify_dictionaries()
    words = values.unique().to_pylist()
    if column == TEXT_COLUMN:
        if len(words) != 1 or words[0] is None:
            found = " and ".join("an empty cell" if word is None else f"'{excerpt(word)}'" for word in words[:2])
            raise LogError.at_field(f"column '{column}'", found, "one name, the same in every row")
        check_names([1], len(words[0]))
        return np.array(words[0].strip())
    numbers = {word: np.nan if word is None else _flag(column, word) for word in words}
    coded = pa.array([numbers[word] for word in words])
    codes = pa.compute.index_in(values.cast(pa.string()), pa.array(words, pa.string()))
    return np.asarray(coded.take(codes.combine_chunks()).to_numpy(zero_copy_only=False))


def _flag(column: str, word: str) -> float:
    try:
        return float(FLAG_WORDS.get(word.strip().lower(), word.replace(",", ".")))
    except ValueError as error:
        raise LogError.at_field(f"column '{column}'", f"'{excerpt(word)}'", FLAG_ACCEPTED) from error


def text_or_flags(values: Any) -> NDArray[Any] | None:
    """The text (1,) that all rows of a column have, or flags (N,) of words that mean them; None of other texts."""
    texts = values.unique().to_pylist()
    flags = {text: np.nan if text is None else FLAG_WORDS.get(text.strip().lower()) for text in texts}
    if None not in flags.values():
        kind = np.float64 if None in texts else np.bool_
        return np.array([flags[text] for text in values.to_pylist()], dtype=kind)
    return np.array(texts) if len(texts) == 1 and texts[0] else None
