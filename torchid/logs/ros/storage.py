"""What the files of a bag have in common: channels, and records on them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from torchid.errors import LogError, install
from torchid.guards import plain
from torchid.logs.container import translated

#: What bags of any kind are read with.
_PACKAGES = ("rosbags", "mcap", "zstandard")


@dataclass(frozen=True)
class Channel:
    """What a topic carries: a message type such as `sensor_msgs/msg/Imu`, and how it is serialized (cdr, ros1)."""

    topic: str
    type: str
    encoding: str

    def __post_init__(self) -> None:
        """Refuse what no message can show."""
        for text in (self.topic, self.type, self.encoding):
            plain(text)


@dataclass(frozen=True)
class Record:
    """One message as it lies in the file: when it was received [ns], and the share of the file read up to it."""

    topic: str
    received: int
    data: bytes
    share: float


class BagFile(Protocol):
    """An open file of a bag."""

    def close(self) -> None:
        """Close the file."""

    def channels(self) -> list[Channel]:
        """All topics, some of them perhaps several times."""

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics, in any order."""


@contextlib.contextmanager
def open_bag_file(path: Path) -> Iterator[BagFile]:
    """Open a .bag, .mcap or .db3 file.

    Raises:
        LogError: it is damaged, and so does what is read later; or its reader is not installed.
    """
    suffix = path.suffix.lower()
    try:
        import mcap  # noqa: F401
        import rosbags.rosbag1  # noqa: F401
        import zstandard  # noqa: F401
    except ImportError as error:
        absent = [name for name in _PACKAGES if name == error.name or find_spec(name) is None]
        found = f"a bag, but {' and '.join(absent) or error.name} {'are' if len(absent) > 1 else 'is'} not installed"
        raise LogError(path, "file", found, install("ros")) from error
    from torchid.logs.ros.mcap_file import McapFile
    from torchid.logs.ros.ros1_file import Ros1File
    from torchid.logs.ros.sqlite_file import SqliteFile

    readers: dict[str, Callable[[Path], BagFile]] = {".bag": Ros1File, ".mcap": McapFile, ".db3": SqliteFile}
    accepted = f"a complete {suffix} file of ROS messages"
    with translated(str(path), "file", accepted), contextlib.closing(readers[suffix](path)) as file:
        yield file
