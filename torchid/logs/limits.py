"""How much a log file may hold: far more than any log does, and far less than a hostile file may declare."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from torchid.errors import LogError

#: Bytes that the arrays of a file of any size may declare, and how many times its own size those of a larger one may:
#: measured motion shrinks to half, time stamps to a tenth, and only zeros to a thousandth.
MAX_SMALL, MAX_GROWTH = 64 * 2**20, 100

#: Most arrays in a file, names in an array, and characters in a name.
MAX_FIELDS, MAX_NAMES, MAX_LETTERS = 200, 10_000, 200


def check_growth(path: Path, total: int) -> None:
    """Raise LogError where a file declares arrays of `total` bytes that it is far too small for."""
    size = path.stat().st_size
    if total > max(MAX_SMALL, MAX_GROWTH * size):
        found = f"arrays of {total} bytes in a file of {size}"
        raise LogError(path, "file", found, f"at most {MAX_GROWTH} times the file's size")


def check_fields(names: Iterable[str | bytes], count: int) -> None:
    """Raise ValueError at more arrays than a log has, or at a name that none of them has and no message can show."""
    if count > MAX_FIELDS:
        raise ValueError(f"{count} arrays, more than the {MAX_FIELDS} that a log may have")
    for name in names:
        if isinstance(name, bytes) or len(name) > MAX_LETTERS or not name.isprintable():
            raise ValueError(f"a name of {len(name)} characters that is none of a log's: {ascii(name[:40])}")


def check_names(shape: Sequence[int], longest: int = 0) -> None:
    """Raise ValueError where an array of text of this shape holds more names, or longer ones, than a robot has."""
    if math.prod(shape) > MAX_NAMES:
        raise ValueError(f"{math.prod(shape)} names, more than the {MAX_NAMES} that an array may have")
    if longest > MAX_LETTERS:
        raise ValueError(f"a name of {longest} characters, more than {MAX_LETTERS}")
