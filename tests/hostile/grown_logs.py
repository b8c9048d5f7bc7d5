"""Logs grown by the rules of their file formats, with lies in any place that the rules have: no valid log is damaged."""

from __future__ import annotations

import csv
import io
import struct
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
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
