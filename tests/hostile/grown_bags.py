"""Bags grown by the rules of their file formats."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import zlib
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from bags import ROS1, ROS2, filled, header, joint_state
from grown import Chance
from grown_logs import IMU, STATE, WRENCH


def message(chance: Chance, stamp: int) -> tuple[str, str, bytes]:
    """Topic, type and content of a message, in the serialization of ROS 2."""
    kind = STATE if chance(0.95) else chance.of([IMU, WRENCH])
    if kind == STATE:
        names = ["a", "b"] if chance(0.998) else [chance.word() for _ in range(chance.below(4))]
        content = joint_state(stamp, names, position=chance.rng.random(len(names) if chance(0.998) else 3))
    else:
        content = {"header": header(stamp, chance.name(["imu"]))}
    data = bytes(ROS2.serialize_cdr(filled(ROS2, kind, content), kind))
    if chance(0.003):
        data = chance.of(
            [data[: chance.below(len(data))], data[:4] + chance.bytes(len(data) - 4), chance.bytes(chance.below(60))]
        )
    return (
        ("/joint_states" if kind == STATE else chance.name(["/imu"])),
        chance.name([kind]) if chance(0.05) else kind,
        data,
    )


def mcap(chance: Chance, folder: Path) -> Path:
    """Records in any order, in chunks or not, with lengths, numbers and sums that may lie."""
    path, stamp, out = folder / "grown.mcap", 10**9, [b"\x89MCAP0\r\n"]
    out.append(_record(chance, 1, _text(chance.name(["ros2"])) + _text("")))
    for _ in range(1 + chance.below(5)):
        body = []
        for _ in range(chance.below(60)):
            stamp += int(chance.rng.integers(0 if chance(0.02) else 1, 10**7))
            topic, kind, data = message(chance, stamp)
            number = 1 + sum(map(ord, topic + kind)) % 7
            if chance(0.3) or not body:
                body.append(
                    _record(chance, 3, struct.pack("<H", number) + _text(kind) + _text("ros2msg") + _bytes(b""))
                )
                body.append(
                    _record(
                        chance,
                        4,
                        struct.pack("<HH", number, number if chance(0.97) else 9)
                        + _text(topic)
                        + _text(chance.name(["cdr"]))
                        + struct.pack("<I", 0),
                    )
                )
            body.append(
                _record(chance, 5, struct.pack("<HIQQ", number if chance(0.998) else 77, 0, stamp, stamp) + data)
            )
        joined = b"".join(body)
        out.append(_chunk(chance, joined) if chance(0.6) else joined)
    out.append(
        _record(chance, chance.of([8, 9, 10, 11, 12, 13, 15, 0x80, 0]), chance.bytes(chance.below(60)))
        if chance(0.3)
        else b""
    )
    out += [_record(chance, 2, bytes(20)), out[0]] if chance(0.9) else []
    path.write_bytes(b"".join(out))
    return path


def _record(chance: Chance, kind: int, content: bytes) -> bytes:
    size = len(content) if chance(0.995) else chance.of([0, 2**63, len(content) + 1, 2**32])
    return bytes([kind]) + struct.pack("<Q", size) + content


def _chunk(chance: Chance, content: bytes) -> bytes:
    press = {"": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstandard.compress}
    name = chance.of(list(press))
    if chance(0.05):
        content = content + bytes(10**6) * chance.below(300)
    data = press[name](content)
    data = data if chance(0.95) else data[: chance.below(len(data) + 1)]
    total = zlib.crc32(content) if chance(0.3) else 0
    told = name if chance(0.97) else chance.word()
    head = struct.pack("<QQQI", 0, 0, len(content) if chance(0.9) else 2**60, total)
    return _record(chance, 6, head + _text(told) + struct.pack("<Q", len(data)) + data)


def _text(text: str) -> bytes:
    return _bytes(text.encode("utf-8", "replace"))


def _bytes(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def bag(chance: Chance, folder: Path) -> Path:
    """A bag of ROS 1: connections, chunks and their index, each with lies."""
    path, kind = folder / "grown.bag", "sensor_msgs/JointState"
    connection = _ros1(chance, {"op": b"\x07", "conn": struct.pack("<I", 0), "topic": b"/joint_states"}, _ros1_fields(
        {"topic": chance.name(["/joint_states"]).encode("utf-8", "replace"), "type": kind.encode(), "md5sum": b"*", "message_definition": b"x"}))  # fmt: skip
    chunks, infos, at = [], [], 13 + 4096
    for part in range(1 + chance.below(4)):
        body, index = connection if chance(0.9) else b"", []
        for k in range(chance.below(40)):
            stamp = 10**9 * (1 + part) + k * 10**7 + (0 if chance(0.95) else -(10**9))
            data = bytes(
                ROS1.serialize_ros1(filled(ROS1, STATE, joint_state(stamp, "ab", position=[1.0, float(k)])), STATE)
            )
            time = struct.pack("<II", stamp // 10**9, stamp % 10**9)
            index.append(time + struct.pack("<I", len(body) if chance(0.998) else chance.below(2**31)))
            body += _ros1(
                chance,
                {"op": b"\x02", "conn": struct.pack("<I", 0 if chance(0.998) else 5), "time": time},
                data if chance(0.998) else chance.bytes(9),
            )
        press = chance.of([("none", bytes), ("bz2", bz2.compress), ("lz4", lz4.frame.compress)])
        size = len(body) if chance(0.9) else chance.below(2**31)
        chunk = _ros1(
            chance, {"op": b"\x05", "compression": press[0].encode(), "size": struct.pack("<I", size)}, press[1](body)
        )
        count = struct.pack("<I", len(index) if chance(0.95) else chance.below(2**31))
        entry = _ros1(
            chance, {"op": b"\x04", "ver": struct.pack("<I", 1), "conn": bytes(4), "count": count}, b"".join(index)
        )
        infos.append(_ros1(chance, {"op": b"\x06", "ver": struct.pack("<I", 1), "chunk_pos": struct.pack("<Q", at if chance(0.95) else chance.below(2**20)),
                                    "start_time": bytes(8), "end_time": b"\xff" * 8, "count": struct.pack("<I", 1)}, bytes(4) + count))  # fmt: skip
        chunks.append(chunk + entry)
        at += len(chunks[-1])
    fields = {
        "op": b"\x03",
        "index_pos": struct.pack("<Q", at),
        "conn_count": struct.pack("<I", 1),
        "chunk_count": struct.pack("<I", len(infos) if chance(0.9) else chance.below(10**4)),
    }
    top = _ros1_fields(fields)
    head = struct.pack("<I", len(top)) + top + struct.pack("<I", 4096 - 8 - len(top)) + b" " * (4096 - 8 - len(top))
    path.write_bytes(b"#ROSBAG V2.0\n" + head + b"".join(chunks) + connection + b"".join(infos))
    return path


def _ros1_fields(fields: dict[str, bytes]) -> bytes:
    return b"".join(struct.pack("<I", len(k) + 1 + len(x)) + k.encode() + b"=" + x for k, x in fields.items())


def _ros1(chance: Chance, fields: dict[str, bytes], data: bytes) -> bytes:
    if chance(0.01):
        fields = {k: x for k, x in fields.items() if chance(0.7)}
    head = _ros1_fields(fields)
    return (
        struct.pack("<I", len(head))
        + head
        + struct.pack("<I", len(data) if chance(0.995) else chance.below(2**31))
        + data
    )


def database(chance: Chance, folder: Path) -> Path:
    """A database of any tables with the right names, or pages of two."""
    path = folder / "grown.db3"

    def written(at: Path) -> bytes:
        at.unlink(missing_ok=True)
        made = sqlite3.connect(at)
        made.execute(f"PRAGMA page_size = {chance.of([512, 4096, 65536])}")
        made.execute(f"PRAGMA encoding = '{chance.of(['UTF-8', 'UTF-8', 'UTF-16le'])}'")
        made.execute(
            "CREATE TABLE topics (id INTEGER, name TEXT, type TEXT, serialization_format TEXT"
            + chance.of([")", ")", ", offered_qos_profiles TEXT)"])
        )
        made.execute(
            "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
            + chance.of(["", "", " WITHOUT ROWID"])
        )
        for name in ("topics", "messages"):
            if chance(0.05):
                made.execute(f"CREATE TRIGGER t{name} AFTER INSERT ON {name} BEGIN SELECT 1; END")
            if chance(0.05):
                made.execute(f"ALTER TABLE {name} RENAME TO gone_{name}")
                made.execute(
                    chance.of(
                        [
                            f"CREATE VIEW {name} AS SELECT * FROM gone_{name}",
                            f"CREATE TABLE {name} (x)",
                            f"CREATE TABLE {name} AS SELECT * FROM gone_{name}",
                        ]
                    )
                )
        with_topics = made.execute("SELECT count(*) FROM pragma_table_info('topics')").fetchone()[0] >= 4
        if (
            with_topics
            and chance(0.95)
            and not made.execute("SELECT 1 FROM sqlite_master WHERE type = 'view'").fetchone()
        ):
            made.execute(
                "INSERT INTO topics (id, name, type, serialization_format) VALUES (1, '/joint_states', ?, ?)",
                (chance.name([STATE]), chance.name(["cdr"])),
            )
            for k in range(
                chance.below(60)
                if made.execute("SELECT count(*) FROM pragma_table_info('messages')").fetchone()[0] >= 4
                else 0
            ):
                stamp = 10**9 + k * 10**7
                data: Any = message(chance, stamp)[2] if chance(0.998) else chance.of([None, 1, "x", b"", 1.5])
                made.execute(
                    "INSERT INTO messages VALUES (?, ?, ?, ?)",
                    (
                        k,
                        1 if chance(0.998) else None,
                        stamp if chance(0.998) else chance.of([None, "x", 1.5, -5]),
                        data,
                    ),
                )
        made.commit()
        made.close()
        return at.read_bytes()

    content = written(path)
    if chance(0.3):
        other = written(folder / "other.db3")
        (folder / "other.db3").unlink()
        path.write_bytes(chance.spliced(content, other))
    return path
