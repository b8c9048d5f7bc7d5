"""Documents of JSON: an object of arrays, or a list of records."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.guards import MAX_LETTERS, MAX_NAMES, check_fields
from torchid.logs.lazy_arrays import ArraysInMemory


class JsonDocument(ArraysInMemory):
    """The arrays of a document, read whole; `group/name` of those in objects, and of records in lists."""

    def __init__(self, path: Path) -> None:
        """Read a file; ValueError where it is damaged or holds no object."""
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(document, dict) and not _are_records(document):
            raise ValueError(f"a {type(document).__name__}, no object of arrays and no list of records")
        super().__init__(_flat("", document))


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, dict) for one in value)


def _flat(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays by name; objects, which readers of fields refuse, for what is none."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}/{key}".removeprefix("/"), inner)
    elif _are_records(value):
        keys = dict.fromkeys(key for record in value for key in record)
        check_fields((), len(keys))
        for key in keys:
            yield from _flat(f"{name}/{key}".removeprefix("/"), _filled([record.get(key) for record in value]))
    else:
        yield name, _array(value)


def _filled(column: list[Any]) -> list[Any]:
    """A column of records, what some of these lack or have as null in the form of what others have."""
    example = next((one for one in column if one is not None), None)
    if isinstance(example, list):
        return [[None] * len(example) if one is None else one for one in column]
    return [{} if one is None else one for one in column] if isinstance(example, dict) else column


def _array(value: Any) -> NDArray[Any]:
    """Numbers, with NaN for null, truth values, or texts that may be names; an object for anything else."""
    other = np.array(None, dtype=object)
    try:
        found = np.asarray(value)
        found = found.astype(np.float64) if found.dtype == object else found
    except (ValueError, TypeError, OverflowError):  # ragged rows, or nulls among texts
        return other
    longest = found.dtype.itemsize // 4 if found.dtype.kind == "U" else 0
    return other if longest > MAX_LETTERS or (longest and found.size > MAX_NAMES) else found
