"""Small files that stand for much, each below 10 MB, are read or refused, soon and in bounded memory."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hostile import judged
from hostile_logs import N, fields, pressed
from hostile_robots import INERTIAL
from raw_logs import write_arrays

from torchid.guards import MAX_GROWTH, MAX_SMALL, max_unpacked_bytes
from torchid.logs import read_log
from torchid.robot import body_extents, load_robot


def _tiny_chunks(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["time"] = np.arange(3.0)
        file["joint_names"] = np.array([b"a"])
        file.create_dataset("joint_position", (2**23 - 100, 1), "f8", chunks=(1, 1), maxshape=(None, 1))


def _large_chunk(path: Path) -> None:
    write_arrays(path, {name: x for name, x in fields().items() if name != "joint_torque"})
    with h5py.File(path, "a") as file:
        made = file.create_dataset("joint_torque", (N, 2), "f8", chunks=(N, 2), compression="gzip")
        made.id.write_direct_chunk((0, 0), pressed(2000))


def _chunks_of_text(path: Path) -> None:
    """Each name would unpack all of them again."""
    write_arrays(path, {name: x for name, x in fields().items() if name != "joint_names"})
    with h5py.File(path, "a") as file:
        options = {"chunks": (2**22,), "maxshape": (None,), "compression": "gzip"}
        file.create_dataset("joint_names", data=[f"j{k}" for k in range(9000)], dtype=h5py.string_dtype(), **options)


def _mat(content: Callable[[], bytes]) -> Callable[[Path], None]:
    """A file of Matlab 5 with one pressed element."""

    def make(path: Path) -> None:
        data = content()
        header = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(data))
        path.write_bytes(header + data)

    return make


def _cells() -> bytes:
    """50,000 cells, one in the other."""
    inside = struct.pack("<IIIIIIiiII", 6, 8, 1, 0, 5, 8, 1, 1, 1, 0)
    return zlib.compress(b"".join(struct.pack("<II", 14, 48 * k - 8) + inside for k in range(50_000, 0, -1)))


def _one_mesh_often(path: Path) -> None:
    """One mesh of 2 MB, which 24 visuals name."""
    count = 40_000
    faces = np.zeros(count, np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")]))
    faces["corners"] = np.random.default_rng(0).standard_normal((count, 3, 3))
    (path.parent / "x.stl").write_bytes(bytes(80) + struct.pack("<I", count) + faces.tobytes())
    shape = '<visual><geometry><mesh filename="x.stl"/></geometry></visual>'
    path.write_text(f'<robot name="m"><link name="l0">{INERTIAL}{shape * 24}</link></robot>')


def _many_columns(path: Path) -> None:
    schema = pa.schema([pa.field(f"{k:x}", pa.float64()) for k in range(60_000)])
    pq.ParquetWriter(path, schema, store_schema=False).close()


CASES: dict[str, Callable[[Path], None]] = {
    "h5 of chunks of one number": _tiny_chunks,
    "h5 of a chunk that holds 2 GB": _large_chunk,
    "h5 of names in one large chunk": _chunks_of_text,
    "mat of 2 GB": _mat(lambda: pressed(2000)),
    "mat of cells in 50000 cells": _mat(_cells),
    "urdf of a mesh that 24 visuals name": _one_mesh_often,
    "parquet of 60000 columns": _many_columns,
}


def read(path: Path) -> None:
    """Whatever it is."""
    if path.suffix == ".urdf":
        body_extents(load_robot(path))
    else:
        read_log(path)


@pytest.mark.slow("readers that come to their limits")
@pytest.mark.parametrize("case", CASES)
def test_a_small_file_that_stands_for_much_costs_little(tmp_path: Path, case: str) -> None:
    path = tmp_path / f"x.{case.split()[0]}"
    CASES[case](path)
    verdict = judged(case, lambda: read(path), tmp_path)
    assert verdict.faults == []
    assert verdict.outcome == ("accepted" if path.suffix == ".urdf" else "refused")


def test_a_file_may_come_to_more_the_larger_it_is() -> None:
    sizes = [0, 10**3, 10**6, 5 * 10**6, 10**7, 2 * 10**7, 10**9]
    most = [max_unpacked_bytes(size) for size in sizes]
    assert most == sorted(most)
    assert most[0] == MAX_SMALL
    assert most[4] == MAX_GROWTH * 10**7
