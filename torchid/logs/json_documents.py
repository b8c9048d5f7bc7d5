"""Whole documents of JSON: an object of arrays, or a list of records that all have the same keys."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError
from torchid.guards import MAX_DOCUMENT, MAX_LETTERS, MAX_NAMES, check_fields
from torchid.logs.lazy_arrays import ArraysInMemory


class JsonDocument(ArraysInMemory):
    """The arrays of a document, read whole; `group/name` of those in objects, and of records in lists."""

    def __init__(self, path: Path) -> None:
        """Read a file; LogError for one that is too large, ValueError where it is damaged or holds no object."""
        size = path.stat().st_size
        if size > MAX_DOCUMENT:
            accepted = f"at most {MAX_DOCUMENT} bytes, or .jsonl with a record in each line"
            raise LogError(path, "file", f"a JSON document of {size} bytes", accepted)
        document = _read(path.read_text(encoding="utf-8-sig"))
        if not isinstance(document, dict) and not _are_records(document):
            raise ValueError(f"a {type(document).__name__}, no object of arrays and no list of records")
        super().__init__(_flat("", document))


def _read(text: str) -> Any:
    """The document, or the list of the records in each line of a text that has several."""
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2 or not lines[0].lstrip().startswith("{") or not lines[0].rstrip().endswith("}"):
            raise
        return [json.loads(line) for line in lines]


def _are_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(one, dict) for one in value)


def _flat(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Arrays by name; objects, which readers of fields refuse, for what is none."""
    if isinstance(value, dict) and value and list(value) == [str(k) for k in range(len(value))]:
        value = list(value.values())  # a column by the numbers of its rows
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
        array = np.asarray(value)
        array = array.astype(np.float64) if array.dtype == object else array
    except (ValueError, TypeError, OverflowError):  # ragged rows, or nulls among texts
        return other
    longest = array.dtype.itemsize // 4 if array.dtype.kind == "U" else 0
    return other if longest > MAX_LETTERS or (longest and array.size > MAX_NAMES) else array
