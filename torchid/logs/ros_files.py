"""Readers of bag files (ROS 1, SQLite, MCAP): channels and records, with limits on time and memory."""

from __future__ import annotations

import bz2
import functools
import io
import sqlite3
import struct
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Message, Schema
from rosbags import rosbag1

from torchid.errors import excerpt
from torchid.guards import MAX_RECORD, MAX_TOPICS, Budget, require_plain_name


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


class BagFile(Protocol):
    """An open file of a bag."""

    def close(self) -> None:
        """Close the file."""

    def channels(self) -> list[BagChannel]:
        """All topics, possibly with duplicates."""

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics, in any order."""


_MCAP_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # kind of record, bytes that follow
_KNOWN: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: McapChannel, Opcode.CHUNK: Chunk}


class McapFile:
    """An MCAP file, read sequentially without its index; the size of each unpacked chunk is limited."""

    def __init__(self, path: Path) -> None:
        self._stream = path.open("rb")
        self._size = max(path.stat().st_size, 1)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def channels(self) -> list[BagChannel]:
        """All topics."""
        types: dict[int, str] = {}
        found: dict[int, McapChannel] = {}
        for record in self._scan(False, Budget(self._size)):
            if isinstance(record, Schema):
                types[record.id] = _full_name(record.name)
            elif isinstance(record, McapChannel):
                found[record.id] = record
            if len(types) + len(found) > 2 * MAX_TOPICS:
                raise ValueError(f"more than {MAX_TOPICS} topics")
        return [BagChannel(x.topic, types.get(x.schema_id, "unknown"), x.message_encoding) for x in found.values()]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics."""
        selected: dict[int, str] = {}
        budget = Budget(self._size)
        for record in self._scan(True, budget):
            if isinstance(record, McapChannel) and record.topic in topics:
                selected[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in selected:
                budget.spend_message()
                share = self._stream.tell() / self._size
                yield Record(selected[record.channel_id], record.log_time, record.data, share)

    def _scan(self, messages: bool, budget: Budget) -> Iterator[Schema | McapChannel | Message]:
        """The records of the file and of its chunks."""
        self._stream.seek(0)
        if self._stream.read(len(_MCAP_MAGIC)) != _MCAP_MAGIC:
            raise ValueError("no MCAP file")
        for record in _records(self._stream, True, messages, budget):
            if isinstance(record, Chunk):
                data = _decompress_chunk(record.data, record.compression, budget)
                if record.uncompressed_crc and zlib.crc32(data) != record.uncompressed_crc:
                    raise ValueError("a chunk that does not match its checksum")
                yield from _records(BytesIO(data), False, messages, budget)
            else:
                yield record


def _records(stream: BinaryIO, whole: bool, messages: bool, budget: Budget) -> Iterator[Any]:
    """Schemas, channels, chunks and, with `messages`, messages; `whole` files must end with a footer.

    The reader of mcap also reads attachments, and takes minutes for zeros that a crash may leave in a file.
    """
    while head := stream.read(_HEAD.size):
        budget.spend_record()
        kind, size = _HEAD.unpack(head)
        if not kind:
            raise ValueError("zeros in place of a record")
        if kind == Opcode.FOOTER:
            return
        if kind not in _KNOWN and not (messages and kind == Opcode.MESSAGE):
            stream.seek(size, 1)
            continue
        if size > MAX_RECORD:
            raise ValueError(f"a record of {size} bytes")
        body = stream.read(size)
        if len(body) < size:
            raise EndOfFile
        content = ReadDataStream(BytesIO(body))
        yield Message.read(content, size) if kind == Opcode.MESSAGE else _KNOWN[kind].read(content)
    if whole:
        raise EndOfFile("no footer: cut off before its end")


def _full_name(name: str) -> str:
    """A message type in the notation of ROS 2; ROS 1 omits `msg`."""
    package, _, message = name.partition("/")
    return f"{package}/msg/{message}" if message and "/" not in message else name


_ROS1_MAGIC = b"#ROSBAG V2.0\n"


class _Reader(rosbag1.Reader):
    """The reader of rosbags with limits on the size of unpacked chunks and of the index."""

    _index_bytes = 0

    def __init__(self, path: Path) -> None:
        """Prepare the reader; `open` reads the index."""
        super().__init__(path)
        self.budget = Budget(path.stat().st_size)

    def read_chunk(self) -> Any:
        stream: Any = self.bio
        start = stream.tell()
        chunk = super().read_chunk()
        end = stream.tell()
        stream.seek(start)
        compression = rosbag1.reader.Header.read(stream).get_string("compression")
        stream.seek(end)
        return chunk._replace(
            decompressor=functools.partial(_decompress_chunk, compression=compression, budget=self.budget)
        )

    def read_index_data(self, pos: int, indexes: Any) -> None:
        """As in rosbags, with a limit on the total size of the index."""
        stream: Any = self.bio
        start = stream.tell()
        super().read_index_data(pos, indexes)
        self._index_bytes += stream.tell() - start
        if self._index_bytes > self.path.stat().st_size:
            raise rosbag1.ReaderError("The index is larger than the file.")


class Ros1File:
    """A .bag file."""

    def __init__(self, path: Path) -> None:
        with path.open("rb") as stream:  # the reader would read a whole line of any length
            if stream.read(len(_ROS1_MAGIC)) != _ROS1_MAGIC:
                raise ValueError("no bag of ROS 1 in version 2.0")
        self._reader = _Reader(path)
        self._reader.open()

    def close(self) -> None:
        """Close the file."""
        self._reader.close()

    def channels(self) -> list[BagChannel]:
        """All topics."""
        if len(self._reader.connections) > MAX_TOPICS:
            raise ValueError(f"more than {MAX_TOPICS} topics")
        return [BagChannel(x.topic, x.msgtype, "ros1") for x in self._reader.connections]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics."""
        connections = [x for x in self._reader.connections if x.topic in topics]
        total = max(sum(x.msgcount for x in connections), 1)
        if connections:  # for an empty list, rosbags reads all
            for i, (connection, received, data) in enumerate(self._reader.messages(connections)):
                self._reader.budget.spend_message()
                yield Record(connection.topic, received, data, i / total)


class SqliteFile:
    """A .db3 file: tables of topics and messages; views and computed columns, which may never end, are refused."""

    def __init__(self, path: Path) -> None:
        """Open the file, which may be on a read-only disk."""
        self._connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
        self._connection.execute("PRAGMA trusted_schema = OFF")
        self._connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_RECORD)
        self._size = path.stat().st_size
        for table in ("topics", "messages"):
            self._check_plain(table)

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def _check_plain(self, table: str) -> None:
        """Refuse views and computed columns, which may never end."""
        query = "SELECT type, sql FROM sqlite_master WHERE name = ?"
        entry = self._connection.execute(query, (table,)).fetchone()
        if entry is None or entry[0] != "table" or not str(entry[1]).upper().startswith("CREATE TABLE"):
            raise ValueError(f"no table '{table}'")
        columns = self._connection.execute(f"PRAGMA table_xinfo({table})").fetchall()
        if any(hidden for *_, hidden in columns):
            raise ValueError(f"table '{table}' has computed columns")

    def channels(self) -> list[BagChannel]:
        """All topics."""
        rows = self._connection.execute("SELECT name, type, serialization_format FROM topics").fetchmany(MAX_TOPICS + 1)
        if len(rows) > MAX_TOPICS:
            raise ValueError(f"more than {MAX_TOPICS} topics")
        return [BagChannel(str(name), str(kind), str(encoding)) for name, kind, encoding in rows]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics."""
        names = dict(self._connection.execute("SELECT id, name FROM topics").fetchmany(MAX_TOPICS))
        budget = Budget(self._size)
        (total,) = self._connection.execute("SELECT count(*) FROM messages").fetchone()
        rows = self._connection.execute("SELECT topic_id, timestamp, data FROM messages")
        for i, (topic, received, data) in enumerate(rows):
            budget.spend_record()
            if names.get(topic) not in topics:
                continue
            budget.spend_message()
            if not (isinstance(received, int) and isinstance(data, bytes) and len(data) <= MAX_RECORD):
                raise ValueError(f"message {i} has no time or no data")
            yield Record(names[topic], received, data, i / total)


def _decompress_chunk(data: bytes, compression: str, budget: Budget) -> bytes:
    """The unpacked chunk; `compression` is bz2, lz4, zstd, or "" or none.

    Raises:
        ValueError: another compression, or more bytes than the remaining budget of the file.
    """
    limit = budget.next_chunk_bytes()
    if compression in ("", "none"):
        out = data
    elif compression == "bz2":
        out = bz2.BZ2Decompressor().decompress(data, limit + 1)
    elif compression == "lz4":
        out = lz4.frame.LZ4FrameDecompressor().decompress(data, limit + 1)
    elif compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(io.BytesIO(data), read_across_frames=True) as stream:
            out = stream.read(limit + 1)
    else:
        raise ValueError(f"chunks compressed by '{excerpt(compression)}'")
    if len(out) > limit:
        raise ValueError(f"a chunk of {len(data)} bytes that unpacks to more than {limit}")
    budget.spend_bytes(len(out))
    return out
