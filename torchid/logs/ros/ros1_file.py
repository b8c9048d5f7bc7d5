"""Bags of ROS 1: the only module that imports rosbags' reader."""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from rosbags import rosbag1

from torchid.guards import MAX_TOPICS, Budget
from torchid.logs.ros.expand import expanded
from torchid.logs.ros.storage import Channel, Record

_MAGIC = b"#ROSBAG V2.0\n"


class _Reader(rosbag1.Reader):
    """The reader of rosbags, which trusts its files, with bounds on what a chunk and the index grow to."""

    _index_bytes = 0

    def __init__(self, path: Path) -> None:
        """Start with nothing unpacked."""
        super().__init__(path)
        self.budget = Budget(path.stat().st_size)

    def read_chunk(self) -> Any:
        """As before, with a decompressor that stops."""
        stream: Any = self.bio
        start = stream.tell()
        chunk = super().read_chunk()
        end = stream.tell()
        stream.seek(start)
        compression = rosbag1.reader.Header.read(stream).get_string("compression")
        stream.seek(end)
        return chunk._replace(decompressor=functools.partial(expanded, compression=compression, budget=self.budget))

    def read_index_data(self, pos: int, indexes: Any) -> None:
        """As before, but every part of the index once."""
        stream: Any = self.bio
        start = stream.tell()
        super().read_index_data(pos, indexes)
        self._index_bytes += stream.tell() - start
        if self._index_bytes > self.path.stat().st_size:
            raise rosbag1.ReaderError("The index is larger than the file.")


class Ros1File:
    """A .bag file."""

    def __init__(self, path: Path) -> None:
        """Open the file and read its index."""
        with path.open("rb") as stream:  # of which the reader would read a whole line, however long
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise ValueError("no bag of ROS 1 in version 2.0")
        self._reader = _Reader(path)
        self._reader.open()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def channels(self) -> list[Channel]:
        """All topics."""
        if len(self._reader.connections) > MAX_TOPICS:
            raise ValueError(f"more than {MAX_TOPICS} topics")
        return [Channel(x.topic, x.msgtype, "ros1") for x in self._reader.connections]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics."""
        connections = [x for x in self._reader.connections if x.topic in topics]
        total = max(sum(x.msgcount for x in connections), 1)
        if connections:  # none would stand for all
            for i, (connection, received, data) in enumerate(self._reader.messages(connections)):
                self._reader.budget.message()
                yield Record(connection.topic, received, data, i / total)
