"""Small files that stand for much: each below 10 MB, and none may take more than 10 s or 1 GB to be read or refused."""

from __future__ import annotations

import bz2
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard
from bags import ROS1, filled, joint_state
from hostile_bags import _cdr
from hostile_logs import N, fields
from hostile_robots import INERTIAL
from raw_logs import write_arrays

MEBIBYTE = 2**20
STATE = "sensor_msgs/msg/JointState"
_MAGIC = b"\x89MCAP0\r\n"


def costs(folder: Path, slow: bool) -> Iterator[tuple[str, Path]]:
    """All cases, or those that are made in no time."""
    for name, make in (CASES | SLOW if slow else CASES).items():
        path = folder / f"x.{name.split()[0]}"
        path.unlink(missing_ok=True)
        make(path)
        assert sum(x.stat().st_size for x in folder.iterdir() if x.is_file()) < 10_500_000
        yield name, path
        for made in folder.iterdir():
            made.unlink()


# ------------------------------------------------------------------------------------------------------------ HDF5


def pressed(mebibytes: int) -> bytes:
    """Zeros, as zlib presses them."""
    press = zlib.compressobj(9)
    first = press.compress(bytes(MEBIBYTE)) + press.flush(zlib.Z_FULL_FLUSH)
    again = press.compress(bytes(MEBIBYTE)) + press.flush(zlib.Z_FULL_FLUSH)
    return first + again * (mebibytes - 1) + press.flush()


def _chunk(content: bytes, **options: Any) -> Callable[[Path], None]:
    """A log whose torques are one chunk of a given content."""

    def make(path: Path) -> None:
        write_arrays(path, {name: x for name, x in fields().items() if name != "joint_torque"})
        with h5py.File(path, "a") as file:
            made = file.create_dataset("joint_torque", (N, 2), "f8", chunks=(N, 2), **{"compression": "gzip"} | options)
            made.id.write_direct_chunk((0, 0), content)

    return make


def _tiny_chunks(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["time"], file["joint_names"] = np.arange(3.0), np.array([b"a"])
        file.create_dataset("joint_position", (2**23 - 100, 1), "f8", chunks=(1, 1), maxshape=(None, 1))


def _chunks_of_text(path: Path) -> None:
    """Each name would unpack all of them again."""
    write_arrays(path, {name: x for name, x in fields().items() if name != "joint_names"})
    with h5py.File(path, "a") as file:
        options = {"chunks": (2**22,), "maxshape": (None,), "compression": "gzip"}
        file.create_dataset("joint_names", data=[f"j{k}" for k in range(9000)], dtype=h5py.string_dtype(), **options)


# ---------------------------------------------------------------------------------------------------------- robots


def _robot(mesh: str, visuals: int, links: int = 1) -> str:
    shape = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    bodies = "".join(f'<link name="l{k}">{INERTIAL}{shape * visuals}</link>' for k in range(links))
    joints = (
        f'<joint name="j{k}" type="revolute"><parent link="l0"/><child link="l{k}"/></joint>' for k in range(1, links)
    )
    return f'<robot name="m">{bodies}{"".join(joints)}</robot>'


def _solids(path: Path) -> None:
    face = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    (path.parent / "x.stl").write_text(f"SOLID x\n{face}ENDSOLID x\n" * 60_000)
    path.write_text(_robot("x.stl", 1))


def _named(visuals: int, links: int, on_sphere: bool = False) -> Callable[[Path], None]:
    """One mesh of 9 MB, named many times."""

    def make(path: Path) -> None:
        count = 180_000
        faces = np.zeros(count, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
        faces["corners"] = np.random.default_rng(0).standard_normal((count, 3, 3))
        if on_sphere:
            faces["corners"] /= np.linalg.norm(faces["corners"], axis=2, keepdims=True)
        (path.parent / "x.stl").write_bytes(bytes(80) + struct.pack("<I", count) + faces.tobytes())
        path.write_text(_robot("x.stl", visuals, links))

    return make


# ---------------------------------------------------------------------------------------------------------- tables


def _columns(count: int) -> list[str]:
    return ["time", *(f"joint_position.j{k}" for k in range(count - 1))]


def _wide_csv(path: Path) -> None:
    rows = (",".join([str(k), *["0"] * 19_999]) for k in range(4))
    path.write_text("\n".join([",".join(_columns(20_000)), *rows]) + "\n")


def _wide_parquet(path: Path) -> None:
    one = pa.array(np.arange(4.0))
    pq.write_table(
        pa.table({name: one for name in _columns(20_000)}), path, use_dictionary=False, write_statistics=False
    )


def _schema(count: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        schema = pa.schema([pa.field(f"{k:x}", pa.float64()) for k in range(count)])
        pq.ParquetWriter(path, schema, store_schema=False).close()

    return make


def _nested(depth: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        kind, value = pa.float64(), 1.0
        for _ in range(depth):
            kind, value = pa.struct([("a", kind)]), {"a": value}
        pq.write_table(pa.table({"time": [0.0], "joint_position.a": pa.array([value], kind)}), path)

    return make


def _zeros(path: Path) -> None:
    """32 million constants in a file of 20 kB."""
    zeros = pa.array(np.zeros(4_000_000))
    pq.write_table(pa.table({name: zeros for name in _columns(8)}), path)


# ------------------------------------------------------------------------------------------------------------ bags


def _mcap(content: bytes, name: str, times: int = 1) -> Callable[[Path], None]:
    """A file of so many chunks of a content."""

    def make(path: Path) -> None:
        data = {"bz2": bz2.compress, "zstd": zstandard.compress, "lz4": lz4.frame.compress}[name](content)
        head = struct.pack("<QQQI", 0, 0, len(content), 0) + struct.pack("<I", len(name)) + name.encode()
        chunk = head + struct.pack("<Q", len(data)) + data
        record = b"\x06" + struct.pack("<Q", len(chunk)) + chunk
        path.write_bytes(_MAGIC + record * times + b"\x02" + struct.pack("<Q", 20) + bytes(20) + _MAGIC)

    return make


def _messages(count: int) -> bytes:
    """Records of one message over and over, with the channel that they are on."""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def record(kind: int, content: bytes) -> bytes:
        return bytes([kind]) + struct.pack("<Q", len(content)) + content

    schema = record(3, struct.pack("<H", 1) + text(STATE) + text("ros2msg") + struct.pack("<I", 0))
    channel = record(4, struct.pack("<HH", 1, 1) + text("/joint_states") + text("cdr") + struct.pack("<I", 0))
    message = struct.pack("<HIQQ", 1, 0, 1, 1) + _cdr(joint_state(1, "a", position=[1]))
    return schema + channel + record(5, message) * count


def _interleaved(path: Path) -> None:
    """Messages that lie in two chunks by turns: each would unpack its chunk again."""
    from rosbags import rosbag1

    writer, names = rosbag1.Writer(path), [f"a{k}" for k in range(200)]
    writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
    with writer:
        there = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=ROS1)
        for part in range(2):
            for k in range(4000):
                stamp = 10**9 + 2 * k + part
                data = ROS1.serialize_ros1(filled(ROS1, STATE, joint_state(stamp, names, position=[0.0] * 200)), STATE)
                writer.write(there, stamp, bytes(data))


_SKIPPED = (b"\x80" + bytes(8)) * (6 * MEBIBYTE // 9)


def _mat(content: bytes) -> Callable[[Path], None]:
    """A file of Matlab 5 with one pressed element."""
    header = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(content))

    def make(path: Path) -> None:
        path.write_bytes(header + content)

    return make


def _cells(depth: int) -> bytes:
    """So many cells, one in the other."""
    inside = struct.pack("<IIIIIIiiII", 6, 8, 1, 0, 5, 8, 1, 1, 1, 0)
    return b"".join(struct.pack("<II", 14, 48 * k - 8) + inside for k in range(depth, 0, -1))


CASES: dict[str, Callable[[Path], None]] = {
    "h5 of chunks of one number": _tiny_chunks,
    "h5 of a chunk that holds 2 GB": _chunk(pressed(2000)),
    "h5 of names in one large chunk": _chunks_of_text,
    "mat of 2 GB": _mat(pressed(2000)),
    "mat of cells in 50000 cells": _mat(zlib.compress(_cells(50_000))),
    "urdf of a mesh of 60000 solids in capitals": _solids,
    "urdf of a mesh that 24 visuals name": _named(24, 1),
    "csv of 20000 columns": _wide_csv,
    "parquet of 60000 columns": _schema(60_000),
    "parquet of 50 structures in one another": _nested(50),
    "parquet of constants": _zeros,
    "mcap of records to skip, by zstd": _mcap(_SKIPPED, "zstd", 200),
}  # fmt: skip
SLOW: dict[str, Callable[[Path], None]] = {
    "mcap of one message too often, by lz4": _mcap(_messages(300_000), "lz4"),
    "urdf of a mesh that 300 links name": _named(1, 300),
    "urdf of a mesh that 300 visuals name": _named(300, 1),
    "urdf of a sphere that 24 visuals name": _named(24, 1, on_sphere=True),
    "urdf of a sphere that 300 links name": _named(1, 300, on_sphere=True),
    "parquet of 20000 columns": _wide_parquet,
    "bag of messages in two chunks by turns": _interleaved,
}
