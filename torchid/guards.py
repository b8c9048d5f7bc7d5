"""Limits on the size of input files, each with its reason, and checks that all readers share.

Files are not trusted. No file below 10 MB takes more than 10 s or 1 GB to be read or refused. The limits are far above
the needs of robots and their logs.
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

#: Unpacked bytes that are allowed for any file, and their ratio to the file's size: measured motion is compressed to
#: half, values of 12 bits to a fifth, and only constants to less than a tenth. `check` reads 12 MB/s and needs five
#: times their memory. Above `LARGE` bytes, files may contain more constants.
MAX_SMALL = 64 * MEBIBYTE
MAX_GROWTH = 12
LARGE = 10_000_000
MAX_GROWTH_LARGE = 100
#: Bytes of all arrays of a log that is read whole: 16 GiB are 2e7 samples of a 30-joint robot with three channels per
#: joint.
MAX_ARRAYS = 2**34
#: Arrays in a file, and names in an array: a log has 22 fields, robots have less than a thousand joints.
MAX_FIELDS = 200
MAX_NAMES = 10_000
#: Datasets and groups of an HDF5 file, where each episode has a group of the same ones: listing one takes 0.1 ms.
MAX_DATASETS = 20_000
#: Columns of a table: a humanoid with every sensor has about 500. Entries of the lists of a schema: the schema is read
#: before its columns are counted, and also lists groups of rows.
MAX_COLUMNS = 20_000
MAX_SCHEMA = 2**16
#: Numbers in each list of a column of lists, which are columns then.
MAX_LIST = 1000

# -------------------------------------------------------------------------------------------------------- factors

#: Bytes of the description of a compressed log.
MAX_DESCRIPTION = 8 * MEBIBYTE

# --------------------------------------------------------------------------------------------------------- settings

#: Bytes of a settings file, nesting, entries with aliases unfolded, and characters of one entry.
MAX_YAML = MEBIBYTE
MAX_DEPTH = 30
MAX_NODES = 5000
MAX_TEXT = 5000
#: Bytes of a `parameters.json`: the largest robot in ten contact states has 10 MB. Empty lists take 12 times their text
#: in memory.
MAX_JSON = 32 * MEBIBYTE

# ----------------------------------------------------------------------------------------------------------- robots

#: Bytes and links of a URDF: the largest of the tested robots has 0.2 MB and 130 links. pytorch-kinematics takes 2 s
#: for a chain of 300 joints and overflows its stack at 800.
MAX_URDF = 8 * MEBIBYTE
MAX_LINKS = 300
#: Size of a number in a URDF, in any unit: products stay within the range of float64. Slides that must not move have a
#: damping of 1e11 in published models.
MAX_NUMBER = 1e12
#: Shapes of a link, each with axes that are tried on all others; points of all shapes of a robot, counted per use of a
#: mesh (one of 29 MB has 1.7 million vertices, a hundredth of them on its hull); and rotations of points, 30 ns each.
MAX_SHAPES = 300
MAX_POINTS = 10_000_000
MAX_AXES = 50_000_000


def check_regular(path: Path) -> None:
    """Raise OSError unless `path` is a regular file: pipes block, devices are endless."""
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise OSError(errno.EISDIR, "a folder")
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "a pipe, a device or a socket")


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """The content of a file.

    Raises:
        OSError: it is not a regular file, or cannot be read.
        ValueError: it has more than `max_bytes` bytes; they are not read.
    """
    check_regular(path)
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(handle, "rb") as stream:
        if os.fstat(handle).st_size <= max_bytes:
            content = stream.read(max_bytes + 1)
            if len(content) <= max_bytes:
                return content
    raise ValueError(f"more than {format_bytes(max_bytes)}")


def format_bytes(size: int) -> str:
    """A limit as text."""
    return f"{size // MEBIBYTE} MiB" if size >= MEBIBYTE else f"{size} bytes"


def max_unpacked_bytes(size: int) -> int:
    """Largest unpacked size of a log file of `size` bytes."""
    return max(MAX_SMALL, MAX_GROWTH * size, MAX_GROWTH_LARGE * (size - LARGE))


def check_unpacked_size(path: Path, total: int, copy: Path | None = None) -> None:
    """Raise LogError where a file, or its copy, declares arrays of `total` bytes, far more than its size allows."""
    size = (copy or path).stat().st_size
    if total > max_unpacked_bytes(size):
        reason = f"arrays of {total} bytes in a file of {size} bytes"
        accepted = f"at most {max_unpacked_bytes(size)} bytes in a file of this size"
        raise LogError(path, "file", reason, accepted)


def check_fields(names: Iterable[str | bytes], count: int) -> None:
    """Raise ValueError at more arrays than a log may have, or at an unprintable or too long name."""
    if count > MAX_FIELDS:
        raise ValueError(f"{count} arrays; a log may have {MAX_FIELDS}")
    for name in names:
        if isinstance(name, bytes) or len(name) > MAX_LETTERS or not name.isprintable():
            raise ValueError(f"a name that no log has ({len(name)} characters): {ascii(name[:40])}")


def check_names(shape: Sequence[int], longest: int = 0) -> None:
    """Raise ValueError where an array of text of this shape has too many or too long names."""
    if math.prod(shape) > MAX_NAMES:
        raise ValueError(f"{math.prod(shape)} texts; at most {MAX_NAMES} names may be text")
    if longest > MAX_LETTERS:
        raise ValueError(f"a name of {longest} characters; at most {MAX_LETTERS} are allowed")


def require_plain_name(text: str) -> str:
    """The name itself; ValueError if it is too long or not printable."""
    if len(text) > MAX_LETTERS or not is_plain(text):
        raise ValueError(f"a name of {len(text)} characters: {excerpt(text)}")
    return text
