"""MCAP files: the only module that imports mcap's readers."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel as McapChannel
from mcap.records import Chunk, Message, Schema

from torchid.guards import MAX_RECORD, MAX_TOPICS, Budget
from torchid.logs.ros.expand import expanded
from torchid.logs.ros.storage import Channel, Record

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # kind of record, bytes that follow
_KNOWN: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: McapChannel, Opcode.CHUNK: Chunk}


class McapFile:
    """An MCAP file, read from front to back: it needs no index, and its chunks are never expanded unchecked."""

    def __init__(self, path: Path) -> None:
        """Open the file."""
        self._stream = path.open("rb")
        self._size = max(path.stat().st_size, 1)

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def channels(self) -> list[Channel]:
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
        return [Channel(x.topic, types.get(x.schema_id, "unknown"), x.message_encoding) for x in found.values()]

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """The messages of some topics."""
        wanted: dict[int, str] = {}
        budget = Budget(self._size)
        for record in self._scan(True, budget):
            if isinstance(record, McapChannel) and record.topic in topics:
                wanted[record.id] = record.topic
            elif isinstance(record, Message) and record.channel_id in wanted:
                budget.message()
                share = self._stream.tell() / self._size
                yield Record(wanted[record.channel_id], record.log_time, record.data, share)

    def _scan(self, messages: bool, budget: Budget) -> Iterator[Schema | McapChannel | Message]:
        """The records of the file and of its chunks."""
        self._stream.seek(0)
        if self._stream.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("no MCAP file")
        for record in _records(self._stream, True, messages, budget):
            if isinstance(record, Chunk):
                data = expanded(record.data, record.compression, budget)
                if record.uncompressed_crc and zlib.crc32(data) != record.uncompressed_crc:
                    raise ValueError("a chunk that does not match its checksum")
                yield from _records(BytesIO(data), False, messages, budget)
            else:
                yield record


def _records(stream: BinaryIO, whole: bool, messages: bool, budget: Budget) -> Iterator[Any]:
    """Schemas, channels, chunks and, if asked for, messages, but not what else there is; of a file, up to the footer.

    mcap's own loop also reads attachments, and takes minutes for the zeros that a crash may leave in a file.
    """
    while head := stream.read(_HEAD.size):
        budget.record()
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
    """A message type as ROS 2 spells it; ROS 1 leaves the `msg` out."""
    package, _, message = name.partition("/")
    return f"{package}/msg/{message}" if message and "/" not in message else name
