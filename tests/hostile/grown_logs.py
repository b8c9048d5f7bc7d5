"""Logs grown by the rules of their file formats, with lies in any place that the rules have: no valid log is damaged."""

from __future__ import annotations

import bz2
import csv
import io
import sqlite3
import struct
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard
from bags import ROS1, ROS2, filled, header, joint_state
from grown import Chance

FIELDS = {
    "time": 0, "joint_position": 2, "joint_velocity": 2, "joint_acceleration": 2, "joint_torque": 2, "base_quat_wxyz": 4,
    "base_quat_xyzw": 4, "base_position_world": 3, "base_linear_velocity_base": 3, "base_angular_velocity_world": 3,
    "imu_specific_force": 3, "imu_angular_velocity": 3, "contact_active": 1, "ft_wrench": 6,
}  # fmt: skip
KINDS = (*("f8",) * 12, "f4", "i4", "u1", "?", "f2", ">f8", "c16", "i8")
STATE, IMU, WRENCH = "sensor_msgs/msg/JointState", "sensor_msgs/msg/Imu", "geometry_msgs/msg/WrenchStamped"


def arrays(chance: Chance) -> dict[str, np.ndarray]:
    """Fields of a log, most of which fit together."""
    n = chance.of([0, 1, 2, 7, 50, 50, 50, 50, 300])
    found: dict[str, np.ndarray] = {"time": np.cumsum(chance.rng.random(n)), "joint_names": np.array(["hip", "knee"])}
    for name in ["joint_position", *(chance.of(list(FIELDS)) for _ in range(chance.below(8)))]:
        width = FIELDS[name] if chance(0.98) else chance.below(9)
        shape: tuple[int, ...] = (n, width) if chance(0.99) else tuple(chance.below(5) for _ in range(chance.below(5)))
        found[name] = chance.array(shape, chance.of(KINDS))
    if chance(0.9):
        _completed(chance, found, n)
    if chance(0.1):
        found[chance.of(["joint_names", "contact_names", "ft_names", "imu_frame"])] = np.array(
            [chance.name(["hip", "knee", "sole"]) for _ in range(chance.below(4))], dtype=chance.of(["U", "S20"])
        ) if chance(0.5) else np.array([chance.name(["hip", "knee"]) for _ in range(2)])  # fmt: skip
    if chance(0.05):
        found[chance.word(20).replace("\0", "0").replace("/", "|") or "x"] = chance.array((n,), "f8")
    return found


def _completed(chance: Chance, found: dict[str, np.ndarray], n: int) -> None:
    """Add what fields need, and leave out what would say the same twice."""
    if "base_quat_xyzw" in found:
        found.pop("base_quat_wxyz", None)
    if any(name.startswith("base_") for name in found) and "base_quat_xyzw" not in found:
        found["base_quat_wxyz"] = np.tile([0.6, 0.8, 0.0, 0.0], (n, 1))
    if "contact_active" in found:
        found |= {"contact_names": np.array(["sole"]), "contact_active": chance.rng.random((n, 1)) > 0.5}
    if "ft_wrench" in found:
        found |= {"ft_names": np.array(["ankle"]), "ft_wrench": chance.array((n, 1, 6), "f8")}
    if any(name.startswith("imu") for name in found):
        found |= {name: chance.array((n, 3), "f8") for name in ("imu_specific_force", "imu_angular_velocity")}
        found["imu_frame"] = np.array("imu")


def npz(chance: Chance, folder: Path) -> Path:
    """Archives with headers and entries of chance."""
    path = folder / "grown.npz"
    method = chance.of([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", method) as archive:
        warnings.simplefilter("ignore")
        for name, array in arrays(chance).items():
            content = _npy(chance, array)
            archive.writestr(f"{name}{chance.name(['.npy']) if chance(0.1) else '.npy'}", content)
            if chance(0.003):
                archive.writestr(f"{name}.npy", content)
    if chance(0.15):
        path.write_bytes(_directory_lies(chance, path.read_bytes()))
    return path


def _npy(chance: Chance, array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    if array.dtype.kind == "U" and chance(0.3):
        array = np.char.encode(array)
    np.lib.format.write_array(stream, array, version=chance.of([None, (2, 0)]))
    content = stream.getvalue()
    if chance(0.04):
        size = struct.unpack("<H", content[8:10])[0]
        text = content[10 : 10 + size].decode("latin1").strip()
        old, new = chance.of([("False", chance.of(["True", "None", "[]"])), ("'<f8'", chance.of(["'|O'", "'<U9'", "'>f4'", "('<f8', (2,))"])),
                              ("(", "(" * (1 + chance.below(2000))), (",", chance.word()), ("}", ", 'x': 1}"), ("shape", "shabe")])  # fmt: skip
        text = text.replace(old, new, 1)
        content = (
            b"\x93NUMPY\x01\x00"
            + struct.pack("<H", len(text) + 1)
            + text.encode("latin1", "replace")
            + b"\n"
            + content[10 + size :]
        )
    return content


def _directory_lies(chance: Chance, data: bytes) -> bytes:
    """Sizes, places and methods of entries that are not theirs."""
    content, place = bytearray(data), data.find(b"PK\x01\x02")
    while place >= 0:
        if chance(0.2):
            offset, width = chance.of([(8, 2), (10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (42, 4)])
            value = chance.of([0, 1, 8, 2**16 - 1, 2**31, 2**32 - 1, chance.below(2**20)]) & (256**width - 1)
            content[place + offset : place + offset + width] = value.to_bytes(width, "little")
        place = data.find(b"PK\x01\x02", place + 4)
    return bytes(content)


def hdf5(chance: Chance, folder: Path) -> Path:
    """Files of datasets in any layout, and with chunks that are written past the filters."""
    path = folder / "grown.h5"
    with h5py.File(path, "w", libver=chance.of(["earliest", "latest"]), track_order=chance(0.3)) as file:
        for name, array in arrays(chance).items():
            values: Any = np.char.encode(array) if array.dtype.kind == "U" else array
            options: dict[str, Any] = {}
            if values.ndim and values.size and chance(0.6):
                options = {
                    "chunks": tuple(1 + chance.below(2 * x) for x in values.shape),
                    "compression": chance.of([None, "gzip", "gzip", "lzf"]),
                }
                options |= {key: True for key in ("shuffle", "fletcher32") if chance(0.3)}
                options["maxshape"] = tuple(None if chance(0.3) else x for x in values.shape)
                options["chunks"] = tuple(
                    c if m is None else min(c, x)
                    for c, m, x in zip(options["chunks"], options["maxshape"], values.shape, strict=True)
                )
            made = file.create_dataset(name, data=values, **options)
            if options and chance(0.3):
                _lying_chunk(chance, made)
            if chance(0.05):
                made.attrs["x" + chance.word().replace("\0", "")] = chance.word().replace("\0", "")
        if chance(0.1):
            file[chance.of(["base_angular_acceleration_base", "g/h", "x"])] = chance.of(
                [h5py.SoftLink("/time"), h5py.ExternalLink("a\x1b.h5", "/time"), h5py.SoftLink("/" + "a/" * 50)]
            )
        if chance(0.1):
            file.create_group("a/" * (1 + chance.below(60)) + "b")
    return path


def _lying_chunk(chance: Chance, made: Any) -> None:
    """A chunk of another content than its filters make of what is declared."""
    size = int(np.prod(made.chunks)) * made.dtype.itemsize
    content = chance.of([bytes(size), bytes(chance.below(size + 1)), chance.bytes(size), bytes(50 * size + 10**5), b""])
    if made.compression == "gzip" and chance(0.8):
        content = zlib.compress(content)[: None if chance(0.8) else chance.below(20) + 1]
    if chance(0.3):
        content += chance.bytes(chance.below(9))
    place = tuple(0 for _ in made.chunks)
    made.id.write_direct_chunk(place, content or b"\0", filter_mask=chance.of([0, 0, 0, 1, 2, 7]))


def columns(chance: Chance) -> list[str]:
    """Names of columns, most of which fit together."""
    names = ["time", "joint_position.hip", "joint_position.knee"]
    for _ in range(chance.below(6)):
        field = chance.of(
            ["joint_torque", "joint_velocity", "contact_active", "base_quat_wxyz", "ft_wrench", "imu_frame"]
        )
        names += {"joint_torque": ["joint_torque.hip", "joint_torque.knee"], "joint_velocity": [f"joint_velocity.{chance.name(['hip'])}", "joint_velocity.knee"],
                  "contact_active": ["contact_active.sole"], "base_quat_wxyz": [f"base_quat_wxyz.{x}" for x in "wxyz"],
                  "ft_wrench": [f"ft_wrench.a.{x}" for x in ("fx", "fy", "fz", "mx", "my", "mz")], "imu_frame": ["imu_frame"]}[field]  # fmt: skip
    return [chance.name([name]) if chance(0.1) else name for name in (names if chance(0.2) else dict.fromkeys(names))]


def table_csv(chance: Chance, folder: Path) -> Path:
    """Text with any habit of writing tables."""
    path, stream = folder / "grown.csv", io.StringIO(newline="")
    names, rows = columns(chance), chance.of([0, 1, 5, 40])
    style: dict[str, Any] = {
        "delimiter": chance.of(",,,,;\t|"),
        "lineterminator": chance.of(["\n", "\n", "\r\n", "\r", "\n\n"]),
    }
    writer = csv.writer(stream, quoting=chance.of([csv.QUOTE_MINIMAL, csv.QUOTE_ALL]), **style)
    with_nul = chance(0.05)
    writer.writerow([name.replace("\0", "0") for name in names])
    for row in range(rows):
        cells = [
            f"{0.01 * row:g}" if name == "time" else "sole" if name == "imu_frame" else f"{chance.rng.random():.3f}"
            for name in names
        ]
        if chance(0.15):
            cells[chance.below(len(cells))] = chance.number() if chance(0.6) else chance.word().replace("\0", "0")
        writer.writerow(cells[: None if chance(0.97) else chance.below(len(cells))])
    text = stream.getvalue() + ("\0" if with_nul else "")
    path.write_bytes(
        chance.of([b"", b"", b"", b"\xef\xbb\xbf"])
        + text.encode(chance.of([*["utf-8"] * 12, "utf-16", "latin1"]), "replace")
    )
    return path


def parquet(chance: Chance, folder: Path) -> Path:
    """Columns of any type, in any encoding, and two files spliced."""
    path, rows = folder / "grown.parquet", chance.of([0, 1, 5, 40])

    def column(name: str) -> Any:
        if name == "imu_frame" and chance(0.8):
            return pa.array(["sole"] * rows)
        if chance(0.95):
            return pa.array(
                np.arange(rows) * 0.01 if name == "time" else chance.rng.random(rows),
                type=chance.of([pa.float64(), pa.float64(), pa.float32()]),
            )
        return chance.of([
            lambda: pa.array(chance.array((rows,), "i4")), lambda: pa.nulls(rows), lambda: pa.array([chance.word() for _ in range(rows)]),
            lambda: pa.array([b"\xff"] * rows), lambda: pa.array([[1.0]] * rows, pa.list_(pa.float64())), lambda: pa.array([{"a": 1}] * rows, pa.struct([("a", pa.int8())])),
            lambda: pa.array([True] * rows), lambda: pa.array([0] * rows, pa.timestamp("ns")), lambda: pa.array([0] * rows, pa.duration("s")),
            lambda: pa.array([0.5] * rows).dictionary_encode(), lambda: pa.array([None] * rows, pa.decimal128(30, 2)), lambda: pa.array(np.zeros(rows, "f2")),
            lambda: pa.array([2**63] * rows, pa.uint64()),
        ])()  # fmt: skip

    def written() -> bytes:
        sink = pa.BufferOutputStream()
        names = columns(chance)
        table = pa.Table.from_arrays(
            [column(name) for name in names], names=[name.replace("\ud800", "") for name in names]
        )
        pq.write_table(table, sink, compression=chance.of(["snappy", "gzip", "zstd", "brotli", "none", "lz4"]), row_group_size=1 + chance.below(50),
                       use_dictionary=chance(0.5), data_page_version=chance.of(["1.0", "2.0"]), write_page_checksum=chance(0.5), store_schema=chance(0.7))  # fmt: skip
        return sink.getvalue().to_pybytes()

    content = written()
    path.write_bytes(chance.spliced(content, written()) if chance(0.3) else content)
    return path


# ---------------------------------------------------------------------------------------------------------------- bags


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
