"""Values of the columns of a table: numbers, stamps, flags and texts. pyarrow is passed in by `torchid.logs.tables`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, excerpt
from torchid.guards import check_names
from torchid.logs.columns import TEXT_COLUMN
from torchid.logs.log import FLAG_ACCEPTED, FLAG_WORDS

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
