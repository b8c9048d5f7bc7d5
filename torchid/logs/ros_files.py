"""Bags of ROS 1 and 2, which rosbags reads in another process: their topics and serialized messages."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchid.guards import check_unpacked_size, require_plain_name
from torchid.reader import RemoteObject


@dataclass(frozen=True)
class BagChannel:
    """A topic with its message type, such as `sensor_msgs/msg/Imu`, and its serialization (cdr, ros1)."""

    topic: str
    type: str
    encoding: str

    def __post_init__(self) -> None:
        """Refuse unprintable and too long names."""
        for text in (self.topic, self.type, self.encoding):
            require_plain_name(text)


@dataclass(frozen=True)
class Record:
    """One serialized message: its time of receipt [ns], and the share of the file read so far."""

    topic: str
    received: int
    data: bytes
    share: float


class BagFile:
    """An open file of a bag."""

    def __init__(self, path: Path, opened: RemoteObject) -> None:
        self._path, self._opened = path, opened

    def channels(self) -> list[BagChannel]:
        """All topics, possibly with duplicates."""
        return [BagChannel(*channel) for channel in self._opened.call("channels")]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics, in any order."""
        size = 0
        for record in self._opened.stream("records", list(topics)):
            out = Record(*record)
            size += len(out.data)
            check_unpacked_size(self._path, size)
            yield out


@contextmanager
def serve_bag(path: Path) -> Iterator[_Mcap | _Bag]:
    """Open a bag in the process that reads it."""
    suffix = path.suffix.lower()
    if suffix == ".mcap":
        yield _Mcap(path)
        return
    from rosbags import rosbag1, rosbag2

    reader: Any = rosbag1.Reader(path) if suffix == ".bag" else rosbag2.Reader(path)
    with reader:
        yield _Bag(reader)


class _Bag:
    """A .bag or .db3 file in the process that reads it."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def channels(self) -> list[tuple[str, str, str]]:
        connections = self._reader.connections
        return [(x.topic, x.msgtype, getattr(x.ext, "serialization_format", "ros1")) for x in connections]

    def records(self, topics: list[str]) -> Iterator[tuple[str, int, bytes, float]]:
        connections = [x for x in self._reader.connections if x.topic in topics]
        total = max(sum(x.msgcount for x in connections), 1)
        if connections:  # for an empty list, rosbags reads all
            for number, (connection, received, data) in enumerate(self._reader.messages(connections)):
                yield connection.topic, received, bytes(data), number / total


class _Mcap:
    """An MCAP file in the process that reads it: of any profile, with or without an index, which rosbags refuses."""

    def __init__(self, path: Path) -> None:
        self._path, self._size = path, max(path.stat().st_size, 1)

    def channels(self) -> list[tuple[str, str, str]]:
        types, found = dict[int, str](), dict[int, Any]()
        for record, _ in self._scan():
            if type(record).__name__ == "Schema":
                types[record.id] = _full_name(record.name)
            elif type(record).__name__ == "Channel":
                found[record.id] = record
        return [(x.topic, types.get(x.schema_id, "unknown"), x.message_encoding) for x in found.values()]

    def records(self, topics: list[str]) -> Iterator[tuple[str, int, bytes, float]]:
        selected = dict[int, str]()
        for record, share in self._scan():
            if type(record).__name__ == "Channel" and record.topic in topics:
                selected[record.id] = record.topic
            elif type(record).__name__ == "Message" and record.channel_id in selected:
                yield selected[record.channel_id], record.log_time, record.data, share

    def _scan(self) -> Iterator[tuple[Any, float]]:
        from mcap.stream_reader import StreamReader

        with self._path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                yield record, stream.tell() / self._size


def _full_name(name: str) -> str:
    """A message type in the notation of ROS 2; ROS 1 omits `msg`."""
    package, _, message = name.partition("/")
    return f"{package}/msg/{message}" if message and "/" not in message else name
