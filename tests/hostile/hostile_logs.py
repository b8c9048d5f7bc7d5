"""Log files that nobody should trust, .npz and HDF5: made by hand, and valid ones with bytes cut off or changed."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from raw_logs import write_arrays

Cases = Iterator[tuple[str, Path]]
N = 40


def fields(samples: int = N) -> dict[str, Any]:
    """A valid log, in the names of the file format."""
    rng = np.random.default_rng(5)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (samples, 1))
    return {
        "time": 0.01 * np.arange(samples),
        "joint_names": np.array(["hip", "knee"]),
        "joint_position": rng.standard_normal((samples, 2)),
        "joint_velocity": rng.standard_normal((samples, 2)),
        "joint_acceleration": rng.standard_normal((samples, 2)),
        "joint_torque": rng.standard_normal((samples, 2)),
        "base_quat_wxyz": quat,
        "base_position_world": rng.standard_normal((samples, 3)),
        "contact_names": np.array(["l_sole", "r_sole"]),
        "contact_active": rng.random((samples, 2)) > 0.5,
        "contact_wrench_local": rng.standard_normal((samples, 2, 6)),
    }


def damaged(folder: Path, suffix: str, count: int, seed: int) -> Cases:
    """A valid file cut off at any place, with bits flipped, with runs of bytes replaced, moved or repeated."""
    path = folder / f"damaged{suffix}"
    whole, compressed = write_arrays(path, fields()).read_bytes(), _compressed(path).read_bytes()
    return mutations(path, [compressed, whole, whole], count, np.random.default_rng(seed))


def mutations(path: Path, whole: Sequence[bytes], count: int, rng: np.random.Generator) -> Cases:
    """A file of one content after the other, each with a random mutation."""
    for number in range(count):
        kind, content = mutated(whole[number % len(whole)], rng)
        path.write_bytes(content)
        yield f"{kind} {number}", path


def mutated(content: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """A random mutation, and its name."""
    data, size = bytearray(content), len(content)
    kind = ("cut", "flipped", "replaced", "repeated", "removed", "numbers")[rng.integers(6)]
    a, b = sorted(int(x) for x in rng.integers(0, size, 2))
    if kind == "cut":
        return kind, bytes(data[:b])
    if kind == "flipped":
        for place in rng.integers(0, size, rng.integers(1, 9)):
            data[place] ^= 1 << int(rng.integers(8))
    elif kind == "replaced":
        b = min(b, a + 64)
        data[a:b] = rng.integers(0, 256, b - a, dtype=np.uint8).tobytes()
    elif kind == "repeated":
        data[b:b] = data[a : min(b, a + 4096)]
    elif kind == "removed":
        del data[a : min(b, a + int(rng.integers(1, 512)))]
    else:  # where a length or an offset may stand
        value = (0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1, 2**40)[rng.integers(7)]
        width = int(rng.choice([2, 4, 8]))
        data[a : a + width] = (value & (256**width - 1)).to_bytes(width, "little")
    return kind, bytes(data)


def _compressed(path: Path) -> Path:
    if path.suffix == ".npz":
        np.savez_compressed(path, **fields())
        return path
    with h5py.File(path, "w") as file:
        for name, value in fields().items():
            array = np.asarray(value)
            array = np.char.encode(array) if array.dtype.kind == "U" else array
            file.create_dataset(name, data=array, chunks=True, compression="gzip", shuffle=True, fletcher32=True)
    return path


def values(folder: Path, suffix: str) -> Cases:
    """NaN, infinity, and numbers beyond all sense in every field; 0 and 1 sample; wrong shapes and types."""
    for samples in (0, 1):
        yield _named(folder, f"{samples} samples", suffix, fields(samples))
    for name, array in fields().items():
        for value in (np.nan, -np.inf, -1e160, 1e31):
            changed = array.astype(np.float64) if array.dtype.kind != "U" else np.full(array.shape, value)
            changed[(-1,) * changed.ndim] = value
            yield _named(folder, f"{value} in {name}", suffix, fields() | {name: changed})
            if array.dtype.kind == "f":
                yield _named(folder, f"{name} all {value}", suffix, fields() | {name: np.full(array.shape, value)})
        for kind in _TYPES:
            yield _named(folder, f"{name} of type {kind}", suffix, fields() | {name: np.zeros(array.shape, kind)})
        for shape in ((), (N, 0), (1,) * 9, (2, N)):
            yield _named(folder, f"{name} of shape {shape}", suffix, fields() | {name: np.zeros(shape)})


_TYPES = ("c16", ">f8", "S3", [("a", "f8"), ("b", "S3")])


def _named(folder: Path, name: str, suffix: str, content: dict[str, Any]) -> tuple[str, Path]:
    return name, write_arrays(folder / f"values{suffix}", content)


# ------------------------------------------------------------------------------------------------------------- archives


def header(shape: str, descr: str = "'<f8'", order: str = "False", version: int = 1) -> bytes:
    """The beginning of a .npy file that says what it is asked to."""
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}".encode() + b"\n"
    return b"\x93NUMPY" + bytes([version, 0]) + struct.pack("<H" if version == 1 else "<I", len(text)) + text


def archives(folder: Path) -> Cases:
    """Archives made by hand."""
    for name, content in _ENTRIES.items():
        path = folder / "archive.npz"
        yield name, _with_entry(path, "time.npy", content, zipfile.ZIP_DEFLATED)
    for name, entry in _ENTRY_NAMES.items():
        yield name, _with_entry(folder / "archive.npz", entry, header("(2,)") + bytes(16), zipfile.ZIP_STORED)
    for name, make in _ARCHIVES.items():
        path = folder / "archive.npz"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            make(path)
        yield name, path


def _with_entry(path: Path, entry: str, content: bytes, method: int) -> Path:
    """A log with one entry more, or one in place of another."""
    write_arrays(path, {name: x for name, x in fields().items() if f"{name}.npy" != entry})
    with zipfile.ZipFile(path, "a", method) as archive:
        archive.writestr(entry, content)
    return path


def _npy(array: np.ndarray, pickled: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=pickled)
    return stream.getvalue()


class Evil:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[object, ...]:
        return exec, ("open('pwned', 'w')",)


_DEEP = "(" * 10_000 + ")" * 10_000
_ENTRIES: dict[str, bytes] = {
    "a pickled object": _npy(np.array([Evil()], dtype=object), True),
    "10^15 numbers declared": header("(1000000000000000,)") + bytes(64),
    "a negative size": header("(-1,)") + bytes(64),
    "sizes that overflow": header("(4294967296, 4294967296, 4294967296)"),
    "an object type": header("(1,)", "'|O'") + bytes(8),
    "text of 2^31 characters": header("(1,)", "'<U2147483647'"),
    "a structured type": header("(2,)", "[('a', '<f8'), ('b', '|S3')]") + bytes(22),
    "a type that is code": header("(2,)", "__import__('os').system('touch pwned')") + bytes(16),
    "a header of brackets": header(_DEEP, version=2) + bytes(16),
    "a header of 4 GiB": b"\x93NUMPY\x02\x00\xff\xff\xff\xff{'descr'",
    "nothing": b"",
    "data missing": header("(40,)") + bytes(100),
    "data left over": header("(40,)") + bytes(320) + bytes(10**6),
}
_ENTRY_NAMES = {
    "an absolute entry": "/etc/time.npy",
    "an entry that climbs": "../../time.npy",
    "an entry with an escape": "\x1b[2Jtime.npy",
    "an entry of 60000 letters": "t" * 60_000 + ".npy",
}


def _twice(path: Path) -> None:
    write_arrays(path, fields())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("time.npy", archive.read("time.npy"))


def _bomb(mebibytes: int, declared: int | None = None) -> Callable[[Path], None]:
    """Zeros without end, of a declared size that may be a lie."""

    def make(path: Path) -> None:
        write_arrays(path, {name: x for name, x in fields().items() if name != "joint_torque"})
        press = zlib.compressobj(9, wbits=-15)
        start = header(f"({mebibytes * 2**16}, 2)")
        first = press.compress(start) + press.flush(zlib.Z_FULL_FLUSH)
        again = press.compress(bytes(2**20)) + press.flush(zlib.Z_FULL_FLUSH)
        with zipfile.ZipFile(path, "a") as archive:
            archive.writestr("joint_torque.npy", first + again * mebibytes + press.flush())
            entry = archive.getinfo("joint_torque.npy")
            entry.compress_type, entry.file_size = zipfile.ZIP_DEFLATED, declared or mebibytes * 2**20 + len(start)

    return make


def _many(count: int) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with zipfile.ZipFile(path, "w") as archive:
            for number in range(count):
                archive.writestr(f"{number}.npy", b"")

    return make


def _method(method: int) -> Callable[[Path], None]:
    return lambda path: void(_with_entry(path, "time.npy", _npy(fields()["time"]), method))


def void(_: object) -> None:
    """Nothing, of anything."""


def _flagged(offset: int, value: int) -> Callable[[Path], None]:
    """A field of every central directory entry set."""

    def make(path: Path) -> None:
        data = bytearray(write_arrays(path, fields()).read_bytes())
        place = data.find(b"PK\x01\x02")
        while place >= 0:
            data[place + offset] = value
            place = data.find(b"PK\x01\x02", place + 4)
        path.write_bytes(data)

    return make


def _overlapping(path: Path) -> None:
    """All entries point to the data of the first."""
    data = bytearray(write_arrays(path, fields()).read_bytes())
    place = data.find(b"PK\x01\x02")
    while place >= 0:
        data[place + 42 : place + 46] = bytes(4)
        place = data.find(b"PK\x01\x02", place + 4)
    path.write_bytes(data)


_ARCHIVES: dict[str, Callable[[Path], None]] = {
    "a name twice": _twice,
    "a bomb of 2 GiB": _bomb(2048),
    "a bomb that declares 1 byte": _bomb(1024, 1),
    "20000 entries": _many(20_000),
    "LZMA": _method(zipfile.ZIP_LZMA),
    "encrypted entries": _flagged(8, 1),
    "overlapping entries": _overlapping,
    "an empty file": lambda path: void(path.write_bytes(b"")),
    "zeros": lambda path: void(path.write_bytes(bytes(10**6))),
}


# ----------------------------------------------------------------------------------------------------------------- HDF5


def pressed(mebibytes: int) -> bytes:
    """Zeros, as zlib presses them."""
    press = zlib.compressobj(9)
    first = press.compress(bytes(2**20)) + press.flush(zlib.Z_FULL_FLUSH)
    again = press.compress(bytes(2**20)) + press.flush(zlib.Z_FULL_FLUSH)
    return first + again * (mebibytes - 1) + press.flush()


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


def _pressed(file: h5py.File, _: Path) -> None:
    """A chunk of 512 MiB in half a megabyte, of which few numbers are said to be used."""
    made = file.create_dataset(
        "joint_torque", (N, 2), "f8", chunks=(2**25, 2), maxshape=(None, 2), compression="gzip", compression_opts=9
    )
    made.id.write_direct_chunk((0, 0), pressed(512))


def _long_names(file: h5py.File, _: Path) -> None:
    del file["joint_names"]
    file["joint_names"] = ["a"] * 20_000 + ["b" * 10**6]


def _many_links(file: h5py.File, _: Path) -> None:
    for number in range(20_000):
        file[f"link{number}"] = h5py.SoftLink("/time")


_HDF5: dict[str, Callable[[h5py.File, Path], None]] = {
    "a link into another file": _external_link,
    "a dataset of another file": _virtual,
    "raw numbers in another file": _raw,
    "a link to itself": _item(h5py.SoftLink("/joint_torque")),
    "10^12 numbers of fill": _dataset((10**12,), chunks=(1024,), fillvalue=1.0),
    "a chunk of 512 MiB": _pressed,
    "no axes": _dataset(()),
    "references": _dataset((N, 2), h5py.ref_dtype),
    "ragged rows": _dataset((N, 2), h5py.vlen_dtype(np.float64)),
    "10^8 texts of fill": _dataset((10**8,), h5py.string_dtype(), chunks=(1024,)),
    "names of a million letters": _long_names,
    "an enumeration": _dataset((N, 2), h5py.enum_dtype({"a": 1}, "i4")),
    "half precision": _dataset((N, 2), "f2"),
    "extended precision": _dataset((N, 2), np.longdouble),
    "a name with an escape": lambda file, _: void(file.create_dataset("\x1b[2Jtime", data=[1.0])),
    "20000 links": _many_links,
}
