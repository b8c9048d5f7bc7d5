"""The kinds of files that logs come in, told apart by name."""

from __future__ import annotations

import os
from enum import Enum
from pathlib import Path

from torchid.errors import LogError
from torchid.logs.container import SUFFIXES as ARRAYS

TABLES = (".csv", ".parquet")
#: Files of ROS 1 (.bag) and ROS 2; those of ROS 2 may also lie in a folder.
BAGS = (".bag", ".mcap", ".db3")
WRITABLE = (*ARRAYS, *TABLES)
READABLE = (*WRITABLE, *BAGS)


class Kind(Enum):
    """What a file holds: named arrays, one column per scalar, or messages."""

    ARRAYS = "arrays"
    TABLE = "table"
    BAG = "bag"


def kind_to_read(path: Path) -> Kind:
    """The kind of an existing log.

    Raises:
        LogError: there is none, or its extension is unknown.
    """
    if os.path.isdir(path):  # Path.is_dir raises where a name is too long
        if bag_files(path):
            return Kind.BAG
        raise LogError(path, "file", "a folder", f"a log ({', '.join(READABLE)}), or a folder that ROS 2 recorded")
    kind = _kind(path, READABLE)
    if not os.path.isfile(path):
        found = "a pipe, a device or a socket" if os.path.exists(path) else "no such file"
        raise LogError(path, "file", found, f"an existing log ({', '.join(READABLE)})")
    return kind


def kind_to_write(path: Path) -> Kind:
    """The kind of a log to be written.

    Raises:
        LogError: no log with this extension is written.
    """
    return _kind(path, WRITABLE)


def bag_files(path: Path) -> list[Path]:
    """The files of a bag: `path` itself, or those in the folder that ROS 2 recorded to."""
    if not os.path.isdir(path):
        return [path] if path.suffix.lower() in BAGS else []
    return sorted(file for file in path.iterdir() if file.suffix.lower() in BAGS[1:] and file.is_file())


def _kind(path: Path, accepted: tuple[str, ...]) -> Kind:
    suffix = path.suffix.lower()
    if suffix not in accepted:
        raise LogError(path, "file", f"extension '{path.suffix}'", ", ".join(accepted))
    return Kind.ARRAYS if suffix in ARRAYS else Kind.TABLE if suffix in TABLES else Kind.BAG
