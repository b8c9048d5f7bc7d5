"""Limits on the time and memory that reading a file may take, each with its reason, and checks that readers share.

Files may come from anywhere. No file below 10 MB takes more than 10 s or 1 GB to be read or refused. The limits lie far
beyond what robots and their logs need.
"""

from __future__ import annotations

import errno
import math
import os
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path

from torchid.errors import LogError, excerpt, is_plain

MEBIBYTE = 2**20

# ------------------------------------------------------------------------------------------------------- all kinds

#: Characters of a name. The longest known name of a joint has 60.
MAX_LETTERS = 200

# ----------------------------------------------------------------------------------------------------------- logs

#: Bytes that the arrays of a file of any size may come to, and how many times its own size those of a larger one may:
#: measured motion shrinks to half, values of 12 bits to a fifth, and only constants to less than a tenth. `check` reads
#: 12 MB a second and needs five times their memory. Files of more than `LARGE` bytes may hold more constants.
MAX_SMALL, MAX_GROWTH = 64 * MEBIBYTE, 12
LARGE, MAX_GROWTH_LARGE = 10_000_000, 100
#: Bytes that the arrays of a file of any size may declare where they are read whole: 16 GiB are 2e7 samples of a
#: 30-joint robot with three channels a joint.
MAX_ARRAYS = 2**34
#: Most arrays in a file, and names in an array: a log has 22 fields, and no robot a thousand joints.
MAX_FIELDS, MAX_NAMES = 200, 10_000
#: Most columns of a table: a humanoid with every sensor has about 500. A schema is built before it can be refused, so
#: that its lists may have twice as many entries, for groups of rows too.
MAX_COLUMNS, MAX_SCHEMA = 20_000, 2**16
#: Chunks of an HDF5 dataset beside those that the file has room for: the library takes 400 bytes for every one that is
#: read, whether it is stored or not. A chunk that is stored takes 40 bytes of index at least.
MAX_CHUNKS, CHUNK_BYTES = 10_000, 40

# ----------------------------------------------------------------------------------------------------------- bags

#: Bytes of one record. A camera's image has a few million, the chunk of messages around it hardly more.
MAX_RECORD = 2**28
#: Records of a bag that its bytes need not make up for, at 5 us each, and bytes that make up for another one; the same
#: of messages of the topics in use, which take 20 us. A message of 20 joints has 700 bytes, a third when compressed.
FREE_RECORDS, RECORD_BYTES = 500_000, 20
FREE_MESSAGES, MESSAGE_BYTES = 200_000, 40
#: Topics of a bag: a humanoid's has 200.
MAX_TOPICS = 10_000

# --------------------------------------------------------------------------------------------------------- settings

#: Bytes of a settings file, nesting, entries with aliases unfolded, and characters of one entry.
MAX_YAML, MAX_DEPTH, MAX_NODES, MAX_TEXT = MEBIBYTE, 30, 5000, 5000
#: Bytes of a `parameters.json`: of the largest robot in ten contact states it has 10 MB; empty lists take 12 times
#: their text.
MAX_JSON = 32 * MEBIBYTE
#: Files in a checkpoint's archive, and values in its state: a few for each parameter group.
MAX_STATE = 10_000

# ----------------------------------------------------------------------------------------------------------- robots

#: Bytes of a URDF, its links, and the depth of its XML: the largest of the robots that were looked at has 0.2 MB and
#: 130 links. A chain of 300 joints takes pytorch-kinematics 2 s, of 800 it overflows its stack.
MAX_URDF, MAX_LINKS = 8 * MEBIBYTE, 300
#: kg, m or any other unit: products of several stay far from what float64 can hold.
MAX_NUMBER = 1e9
#: Bytes of a mesh file, the largest known one has 29 MB; and of the shapes in a COLLADA file, each counted as often
#: as it is used.
MAX_MESH, MAX_UNFOLDED = 32 * MEBIBYTE, 64 * MEBIBYTE
#: Parts of a text mesh, for each of which trimesh takes a millisecond, and bytes of a line, for it splits long ones
#: slowly.
MAX_PARTS, MAX_LINE = 1000, 2**16
#: Shapes of a link, each of which gives axes to try on all others; points of all shapes of a robot, a mesh counted as
#: often as it is named (one of 29 MB has 1.7 million corners, of which a hundredth are on its hull); and how many turns
#: of a point are tried, at 30 ns each.
MAX_SHAPES, MAX_POINTS, MAX_AXES = 300, 10_000_000, 50_000_000


def check_regular(path: Path) -> None:
    """Raise OSError unless `path` is a file with an end: a pipe waits, a device goes on forever."""
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, "a folder")
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "a pipe, a device or a socket")


def read_bytes(path: Path, most: int) -> bytes:
    """What a file holds.

    Raises:
        OSError: it is no file, or cannot be read.
        ValueError: it has more than `most` bytes, which are not read.
    """
    check_regular(path)
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(handle, "rb") as stream:
        if os.fstat(handle).st_size <= most:
            content = stream.read(most + 1)
            if len(content) <= most:
                return content
    raise ValueError(f"more than {format_bytes(most)}")


def format_bytes(size: int) -> str:
    """A limit in words."""
    return f"{size // MEBIBYTE} MiB" if size >= MEBIBYTE else f"{size} bytes"


def max_unpacked_bytes(size: int) -> int:
    """Bytes that a log file of `size` bytes may come to when it is unpacked."""
    return max(MAX_SMALL, MAX_GROWTH * size, MAX_GROWTH_LARGE * (size - LARGE))


def check_unpacked_size(path: Path, total: int) -> None:
    """Raise LogError where a file declares arrays of `total` bytes that it is far too small for."""
    size = path.stat().st_size
    if total > max_unpacked_bytes(size):
        found = f"arrays of {total} bytes in a file of {size}"
        accepted = f"at most {max_unpacked_bytes(size)} bytes in a file of this size"
        raise LogError(path, "file", found, accepted)


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


def require_plain_name(text: str) -> str:
    """The name itself; ValueError if it is longer than any name, or holds characters that no message can show."""
    if len(text) > MAX_LETTERS or not is_plain(text):
        raise ValueError(f"a name of {len(text)} characters: {excerpt(text)}")
    return text


class Budget:
    """How many bytes, records and messages may still come out of a log file that is unpacked chunk by chunk."""

    def __init__(self, size: int) -> None:
        """For a file of `size` bytes."""
        self._bytes = max_unpacked_bytes(size)
        self._records = FREE_RECORDS + size // RECORD_BYTES
        self._messages = FREE_MESSAGES + size // MESSAGE_BYTES

    def next_chunk_bytes(self) -> int:
        """Bytes that the next piece may have."""
        return min(self._bytes, MAX_RECORD)

    def spend_bytes(self, count: int) -> None:
        """Take a piece of `count` bytes; ValueError where the file comes to more than it may."""
        self._bytes -= count
        if self._bytes < 0:
            raise ValueError("chunks that expand to more bytes than a file of this size may hold")

    def spend_record(self) -> None:
        """Take a record; ValueError where there are more than a file of this size may have."""
        self._records -= 1
        if self._records < 0:
            raise ValueError("more records than a file of this size may have")

    def spend_message(self) -> None:
        """Take a message of a topic in use; ValueError where there are more than a file of this size may have."""
        self._messages -= 1
        if self._messages < 0:
            raise ValueError("more messages than a file of this size may have")
