"""Files of bags, in the process that reads them: topics and serialized messages (with rosbags and mcap)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


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
        """Topics, types and serializations."""
        connections = self._reader.connections
        return [(x.topic, x.msgtype, getattr(x.ext, "serialization_format", "ros1")) for x in connections]

    def records(self, topics: list[str]) -> Iterator[tuple[str, int, bytes, float]]:
        """Topic, time of receipt [ns] and bytes of each message, and the share of the file that was read."""
        connections = [x for x in self._reader.connections if x.topic in topics]
        total = max(sum(x.msgcount for x in connections), 1)
        if connections:  # for an empty list, rosbags reads all
            for number, (connection, received, data) in enumerate(self._reader.messages(connections)):
                yield connection.topic, received, bytes(data), number / total


class _Mcap:
    """An MCAP file in the process that reads it: of any profile, with or without an index, which rosbags refuses."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = max(path.stat().st_size, 1)

    def channels(self) -> list[tuple[str, str, str]]:
        """As of `_Bag`."""
        types = dict[int, str]()
        channels = dict[int, Any]()
        for record, _ in self._scan():
            if type(record).__name__ == "Schema":
                package, _, message = record.name.partition("/")  # ROS 1 omits `msg`
                is_short = message and "/" not in message
                types[record.id] = f"{package}/msg/{message}" if is_short else record.name
            elif type(record).__name__ == "Channel":
                channels[record.id] = record
        return [(x.topic, types.get(x.schema_id, "unknown"), x.message_encoding) for x in channels.values()]

    def records(self, topics: list[str]) -> Iterator[tuple[str, int, bytes, float]]:
        """As of `_Bag`."""
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
