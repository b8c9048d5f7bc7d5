"""HDF5 files that no log is."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from hostile_logs import Cases, N, fields, void
from raw_logs import write_arrays


def hdf5(folder: Path) -> Cases:
    """HDF5 files made by hand."""
    other = write_arrays(folder / "other.h5", fields())
    for name, make in _HDF5.items():
        path = write_arrays(folder / "log.h5", {key: x for key, x in fields().items() if key != "joint_torque"})
        with h5py.File(path, "a") as file:
            make(file, other)
        yield name, path
    for name, content in {"an empty file": b"", "a text": b"time\n0\n", "a signature": b"\x89HDF\r\n\x1a\n"}.items():
        (folder / "log.h5").write_bytes(content)
        yield name, folder / "log.h5"


def _dataset(shape: tuple[int, ...], dtype: Any = "f8", **options: Any) -> Callable[[h5py.File, Path], None]:
    return lambda file, _: void(file.create_dataset("joint_torque", shape, dtype, **options))


def _item(item: Any) -> Callable[[h5py.File, Path], None]:
    return lambda file, _: file.__setitem__("joint_torque", item)


def _external_link(file: h5py.File, other: Path) -> None:
    file["joint_torque"] = h5py.ExternalLink(str(other), "/joint_torque")


def _virtual(file: h5py.File, other: Path) -> None:
    layout = h5py.VirtualLayout((N, 2), "f8")
    layout[...] = h5py.VirtualSource(str(other), "joint_torque", (N, 2))
    file.create_virtual_dataset("joint_torque", layout)


def _raw(file: h5py.File, other: Path) -> None:
    file.create_dataset("joint_torque", (N, 2), "f8", external=[(str(other), 0, 16 * N)])


def _cycle(file: h5py.File, _: Path) -> None:
    group = file.create_group("joint_torque")
    group["again"] = group
    group["up"] = file["/"]


def _pressed(file: h5py.File, _: Path) -> None:
    """A chunk of 512 MiB in half a megabyte, of which few numbers are said to be used."""
    press = zlib.compressobj(9)
    first = press.compress(bytes(2**20)) + press.flush(zlib.Z_FULL_FLUSH)
    again = press.compress(bytes(2**20)) + press.flush(zlib.Z_FULL_FLUSH)
    made = file.create_dataset(
        "joint_torque", (N, 2), "f8", chunks=(2**25, 2), maxshape=(None, 2), compression="gzip", compression_opts=9
    )
    made.id.write_direct_chunk((0, 0), first + again * 511 + press.flush())


def _long_names(file: h5py.File, _: Path) -> None:
    del file["joint_names"]
    file["joint_names"] = ["a"] * 20_000 + ["b" * 10**6]


def _many_links(file: h5py.File, _: Path) -> None:
    for number in range(20_000):
        file[f"link{number}"] = h5py.SoftLink("/time")


_COMPOUND = np.dtype([("a", "f8"), ("b", "S3")])
_HDF5: dict[str, Callable[[h5py.File, Path], None]] = {
    "a link into another file": _external_link,
    "a dataset of another file": _virtual,
    "raw numbers in another file": _raw,
    "a link to itself": _item(h5py.SoftLink("/joint_torque")),
    "a cycle of groups": _cycle,
    "10^12 numbers of fill": _dataset((10**12,), chunks=(1024,), fillvalue=1.0),
    "sizes that overflow": _dataset((2**40, 2**40), chunks=(1, 1024)),
    "a chunk of 512 MiB": _pressed,
    "no axes": _dataset(()),
    "an empty space": _item(h5py.Empty("f8")),
    "references": _dataset((N, 2), h5py.ref_dtype),
    "ragged rows": _dataset((N, 2), h5py.vlen_dtype(np.float64)),
    "10^8 texts of fill": _dataset((10**8,), h5py.string_dtype(), chunks=(1024,)),
    "names of a million letters": _long_names,
    "an enumeration": _dataset((N, 2), h5py.enum_dtype({"a": 1}, "i4")),
    "pairs": _dataset((N, 2), _COMPOUND),
    "half precision": _dataset((N, 2), "f2"),
    "big-endian": _dataset((N, 2), ">f8"),
    "extended precision": _dataset((N, 2), np.longdouble),
    "a name with an escape": lambda file, _: void(file.create_dataset("\x1b[2Jtime", data=[1.0])),
    "20000 links": _many_links,
}
