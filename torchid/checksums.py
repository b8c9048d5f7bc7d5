"""Checksums of files, whole or of their parts, and what changes with a file."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_BLOCK = 2**20
_PART = 2**27  # bytes of a part of a file, which take 0.1 s to sum up


def file_checksum(*paths: Path) -> str:
    """SHA-256 of a file, or of several one after the other."""
    digest = hashlib.sha256()
    for path in paths:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


class FilePart(NamedTuple):
    """So many bytes of a file, from one on, which are summed up by themselves."""

    path: Path
    start: int
    size: int


def file_parts(files: Sequence[Path]) -> list[FilePart]:
    """Parts of some files, which several processes can sum up. Raises OSError: one is not there."""
    sizes = [(file, file.stat().st_size) for file in files]
    return [
        FilePart(file, start, min(_PART, size - start))
        for file, size in sizes
        for start in range(0, max(size, 1), _PART)
    ]


def part_checksum(part: FilePart) -> str:
    """SHA-256 of a part of a file. Raises OSError: it cannot be read."""
    digest = hashlib.sha256()
    with part.path.open("rb") as file:
        file.seek(part.start)
        for start in range(0, part.size, _BLOCK):
            digest.update(file.read(min(_BLOCK, part.size - start)))
    return digest.hexdigest()


def checksum_of_parts(sums: Sequence[str]) -> str:
    """Checksum of files from those of their parts: SHA-256 of these, that of the part itself where there is but one."""
    return sums[0] if len(sums) == 1 else hashlib.sha256("".join(sums).encode()).hexdigest()


def file_states(files: Sequence[Path]) -> list[list[int]]:
    """What of files changes when their content does, as documents of JSON have it; ctime even where mtime is set back.

    Raises OSError: one is not there.
    """
    return [[x.st_size, x.st_mtime_ns, x.st_ctime_ns, x.st_ino] for x in (file.stat() for file in files)]
