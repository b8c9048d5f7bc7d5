"""Bags and tables that nobody should trust: hand-made ones, and valid ones with bytes cut off or changed."""

from __future__ import annotations

import io
import sqlite3
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard
from bags import (
    FLAG,
    JOINT_STATE,
    ROS1,
    ROS2,
    Entry,
    entries_of,
    filled,
    header,
    joint_state,
    recorded,
    topics_of,
    write_bag,
)
from hostile_logs import mutations
from mcap.writer import CompressionType, Writer
from rosbags import rosbag1

from torchid.logs import Log, write_log

Cases = Iterator[tuple[str, Path]]
SUFFIXES = (".csv", ".parquet", ".bag", ".mcap", ".db3")
MEBIBYTE = 2**20


TOPICS = topics_of(recorded(3))


def write(path: Path, log: Log) -> Path:
    """A log as a file of any type."""
    if path.suffix in SUFFIXES[2:]:
        return write_bag(path, entries_of(log))
    write_log(log, path)
    return path


def damaged(folder: Path, suffix: str, count: int, seed: int) -> Cases:
    """A valid file cut off at any place, with bits flipped, with runs of bytes replaced, moved or repeated."""
    path = folder / f"damaged{suffix}"
    return mutations(path, [write(path, recorded(12)).read_bytes()], count, np.random.default_rng(seed))


# -------------------------------------------------------------------------------------------------------------- bags


def bag_cases(folder: Path) -> Cases:
    """Everything that a bag can say and no robot would."""
    for name, content in MESSAGES.items():
        for suffix in (".bag", ".mcap", ".db3"):
            yield name, write_bag(folder / f"message{suffix}", [("/joint_states", 1, JOINT_STATE, content)])
            (folder / f"message{suffix}").unlink()
    for name, make in {**MCAP, **ROS1_BAGS, **DATABASES}.items():
        path = folder / f"x.{name.split()[0]}"
        make(path)
        yield name, path
        path.unlink()
    (folder / "recording").mkdir()
    (folder / "recording" / "loop.mcap").symlink_to("loop.mcap")
    yield "a folder with a link to itself", folder / "recording"


MESSAGES: dict[str, dict[str, Any]] = {
    "a name with an escape": joint_state(1, ["a\x1b[2J\n"], position=[1]),
    "a name with separators": joint_state(1, ["../../etc/passwd"], position=[1]),
    "100000 joints": joint_state(1, [f"j{i}" for i in range(100_000)], position=np.zeros(100_000)),
    "the same joint often": joint_state(1, ["a"] * 5000, position=np.zeros(5000)),
    "a frame of 10 MB": joint_state(1, "a", position=[1]) | {"header": header(1, "a" * 10_000_000)},
}


def mcap(path: Path, data: bytes, channels: int = 1, kind: str = JOINT_STATE, topic: str = "/joint_states") -> Path:
    """An MCAP file with one message, and as many channels of its topic."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=1)
    writer.start("ros2", "")
    for i in range(channels):
        schema = writer.register_schema(kind if not i else FLAG, "ros2msg", b"import os; os.system('touch hacked')")
        channel = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channel, 1, data, 1)
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path


def _packed(content: bytes, times: int) -> bytes:
    """An MCAP file with a chunk that holds the content so many times."""
    data = zstandard.compress(content * times)
    chunk = struct.pack("<QQQI", 0, 0, len(content) * times, 0) + b"\x04\x00\x00\x00zstd"
    chunk += len(data).to_bytes(8, "little") + data
    return _MAGIC + b"\x06" + len(chunk).to_bytes(8, "little") + chunk + b"\x02" + bytes(28) + _MAGIC


def _edited(where: bytes, put: bytes, offset: int = 0) -> Callable[[Path], object]:
    """A valid file with other bytes at an offset from the first place of some bytes."""

    def make(path: Path) -> None:
        path.unlink(missing_ok=True)
        data = bytearray(write_bag(path, entries_of(recorded(5))).read_bytes())
        at = data.index(where) + offset
        data[at : at + len(put)] = put
        path.write_bytes(data)

    return make


def _cdr(content: dict[str, Any]) -> bytes:
    return bytes(ROS2.serialize_cdr(filled(ROS2, JOINT_STATE, content), JOINT_STATE))


_STATE = joint_state(1, "a", position=[1])
_MAGIC = b"\x89MCAP0\r\n"
_HUGE = 64 * MEBIBYTE

MCAP: dict[str, Callable[[Path], object]] = {
    "mcap a record of 200 MiB that is not there": lambda path: path.write_bytes(
        _MAGIC + b"\x06" + (200 * MEBIBYTE).to_bytes(8, "little")
    ),
    "mcap a bomb": lambda path: mcap(path, _cdr(_STATE | {"header": header(1, "a" * _HUGE)})),
    "mcap a bomb of records": lambda path: path.write_bytes(_packed(b"\x80" + bytes(8), 5_000_000)),
    "mcap two types on one topic": lambda path: mcap(path, _cdr(_STATE), 2),
    "mcap a topic that cannot be shown": lambda path: mcap(path, _cdr(_STATE), 1, JOINT_STATE, "/a\x07\n"),
    "mcap a message that claims 4e9 names": lambda path: mcap(path, _cdr({})[:16] + b"\xff" * 12),
    "mcap compressed messages": lambda path: mcap(path, b"\x28\xb5\x2f\xfd" + bytes(20)),
}


def _ros1_bomb(path: Path) -> None:
    writer = rosbag1.Writer(path)
    writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
    content = _STATE | {"header": header(1, "a" * _HUGE)}
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=ROS1)
        writer.write(connection, 1, ROS1.serialize_ros1(filled(ROS1, JOINT_STATE, content), JOINT_STATE))


def _ros1_same_chunk(path: Path) -> None:
    """An index that leads to one chunk 20,000 times."""
    entries: list[Entry] = [("/joint_states", i, JOINT_STATE, joint_state(i, "a", position=[1])) for i in range(2000)]
    data = write_bag(path, entries).read_bytes()
    info = int.from_bytes(data[data.index(b"index_pos=") + 10 :][:8], "little")
    for _ in range(2):  # past the header and the data of the one connection
        info += 4 + int.from_bytes(data[info : info + 4], "little")
    at = data.index(b"chunk_count=") + 12
    path.write_bytes(data[:at] + (20_000).to_bytes(4, "little") + data[at + 4 :] + data[info:] * 19_999)


ROS1_BAGS: dict[str, Callable[[Path], object]] = {
    "bag a bomb": _ros1_bomb,
    "bag one chunk often": _ros1_same_chunk,
    "bag without an index": _edited(b"index_pos=", bytes(8), 10),
    "bag an index beyond its end": _edited(b"index_pos=", b"\xff" * 7 + b"\x7f", 10),
    "bag a definition that is a programme": _edited(b"message_definition=", b"import os; os.abort()\n", 19),
}


def _database(*statements: str, rows: Any = ()) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        connection = sqlite3.connect(path)
        for statement in statements:
            connection.execute(statement)
        if rows:
            connection.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
        connection.commit()
        connection.close()

    return make


_TOPICS = "CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT)"
_TOPIC = f"INSERT INTO topics VALUES (1, '/joint_states', '{JOINT_STATE}', 'cdr')"
_MESSAGES = "CREATE TABLE messages (id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)"
_FOREVER = "WITH RECURSIVE n(x) AS (VALUES (1) UNION ALL SELECT x + 1 FROM n) SELECT x, 1, x, x FROM n"

DATABASES: dict[str, Callable[[Path], object]] = {
    "db3 a view without end": _database(_TOPICS, _TOPIC, f"CREATE VIEW messages AS {_FOREVER}"),
    "db3 text for data": _database(_TOPICS, _TOPIC, _MESSAGES, rows=[(1, 1, 1, "text")]),
    "db3 time beyond time": _database(_TOPICS, _TOPIC, _MESSAGES, rows=[(1, 1, 2**63 - 1, _cdr(_STATE))] * 2),
    "db3 a topic of bytes": _database(_TOPICS, "INSERT INTO topics VALUES (1, x'ff', NULL, 3)", _MESSAGES),
}

# ------------------------------------------------------------------------------------------------------------ tables


def table_cases(folder: Path) -> Cases:
    """Everything that a table can say and no robot would."""
    for name, content in TEXTS.items():
        (folder / "x.csv").write_bytes(content)
        yield f"csv {name}", folder / "x.csv"
    for name, table in PARQUET.items():
        pq.write_table(table(), folder / "x.parquet")
        yield f"parquet {name}", folder / "x.parquet"


_HEAD = b"time,joint_position.a\n"
TEXTS: dict[str, bytes] = {
    "empty": b"",
    "zeros": bytes(100_000),
    "a header alone": _HEAD,
    "100000 joints": ",".join(["time", *(f"joint_position.j{i}" for i in range(100_000))]).encode(),
    "a cell without end": _HEAD + b"0,1" + b"1" * 20_000_000,
    "a quote without end": _HEAD + b'0,"1\n' + b"1,2\n" * 100_000,
    "names with escapes": b"time,joint_position.\x1b[2J\x00\n0,1\n",
    "a name with separators": b"time,joint_position.../../etc/passwd\n0,1\n",
}


def _zeros(rows: int, columns: int) -> pa.Table:
    one = pa.array(np.zeros(rows))
    return pa.table({"time": one, **{f"joint_position.j{i}": one for i in range(columns)}})


PARQUET: dict[str, Callable[[], pa.Table]] = {
    "no columns": lambda: pa.table({}),
    "a bomb": lambda: _zeros(4_000_000, 20),
    "30000 joints": lambda: _zeros(1, 30_000),
    "nested": lambda: pa.table({"time": [0.0], "joint_position.a": [[[{"a": 1}]]]}),
    "times": lambda: pa.table({"time": np.array([0], "M8[ns]"), "joint_position.a": [1.0]}),
    "names with escapes": lambda: pa.table({"time": [0.0], "joint_position.\x1b[2J\n": [0.0]}),
}
