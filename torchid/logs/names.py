"""Names in arrays of files: of joints, contacts, sensors and frames."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from torchid.errors import LogError, excerpt, is_plain
from torchid.guards import MAX_LETTERS
from torchid.logs.log import SHAPES, check_shape


def parse_names(name: str, array: NDArray[Any]) -> tuple[str, ...]:
    """The names in a one-dimensional array of strings or UTF-8 bytes, LogError on anything else or a duplicate."""
    check_shape(name, array, SHAPES[name] or (1,), {})
    if array.size and array.dtype.kind not in "US":
        raise LogError.at_field(name, f"values of type {array.dtype}", "strings")
    try:
        names = tuple(item.decode() if isinstance(item, bytes) else str(item) for item in array.tolist())
    except UnicodeDecodeError as error:
        raise LogError.at_field(name, f"bytes that are no text ({error})", "UTF-8 strings") from error
    seen: set[str] = set()
    for i, item in enumerate(names):
        if len(item) > MAX_LETTERS or not is_plain(item):
            accepted = f"printable names of at most {MAX_LETTERS} characters"
            raise LogError.at_field(name, f"'{excerpt(item)}' at {i}", accepted)
        if not item or item in seen:
            found = f"'{item}' again at {i}" if item else f"an empty name at {i}"
            raise LogError.at_field(name, found, "names that are all different")
        seen.add(item)
    return names


def parse_frame(name: str, array: NDArray[Any]) -> str:
    """The one name in an array of strings or UTF-8 bytes of any shape, LogError on anything else."""
    if array.size != 1:
        raise LogError.at_field(name, f"{array.size} values", "one name")
    return parse_names(name, array.reshape(1))[0]
