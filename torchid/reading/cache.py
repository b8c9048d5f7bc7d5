"""A cache of arrays in a folder, by the content that they come from: bounded, shared by runs, not trusted blindly.

An entry is a folder of .npy files with a description beside them. It appears whole, by one rename, and is not changed
from then on. What does not look as it did when it was written is compared with its checksums, and dropped if it
differs.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import time
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy
import torch
from numpy.typing import NDArray

import torchid
from torchid.checksums import checksum_of_parts, file_checksum, file_parts, file_states, part_checksum
from torchid.errors import excerpt, warn
from torchid.logs.blocks import GIGABYTE
from torchid.parallel import in_forks, thread_count
from torchid.staging import NEW, atomic_file, is_leftover, remove_leftover, staging_folder

FOLDER = ".torchid_cache"
"""Name of the folder of entries, beside the output of runs."""

TOKEN = "token-"
"""First letters of files by which processes tell whether they have a folder in common."""

_DESCRIPTION, _INDEX = "entry.json", "checksums.json"
_NAME = re.compile(r"[0-9a-f]{64}")
_LARGEST = 2**26  # bytes of a description: that of a log in 1000 contact states has 1e6
_BLOCK = 2**22  # bytes that are written at a time
_MOST_FILES = 10_000  # in the index of checksums
_FORGOTTEN = 3600.0  # [s]: age of a token whose process was killed
_THERE = (errno.ENOTEMPTY, errno.EEXIST)  # of a rename
_LONG = 2**27  # bytes that take longer to sum up than a copy of the process to make
_YOUNG = 2.0  # [s]: a file that is no older may change again within one tick of its time stamp


Files = Mapping[str, Mapping[str, Any]]
"""What an entry's description says of the file of each array."""


@dataclass(frozen=True)
class CacheEntry:
    """What was stored: a document of JSON, and arrays that are mapped to their files and cannot be written to."""

    document: Mapping[str, Any]
    arrays: Mapping[str, NDArray[Any]]


class _DamagedError(Exception):
    """An entry that is not as it was written."""


def content_key(content: object) -> str:
    """The name of what follows from some content, a document of JSON, with this code: SHA-256."""
    text = json.dumps([_code(), content], sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


@cache
def _code() -> str:
    """Checksum of all that turns logs into numbers: torchid's modules, libraries below, what the processor can do."""
    folder = Path(torchid.__file__).parent
    versions = [*(x.__version__ for x in (np, scipy, torch)), torch.backends.cpu.get_cpu_capability()]
    digest = hashlib.sha256("\n".join(versions).encode())
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


class Cache:
    """Entries in a folder, whose files together take no more than a limit; those that were not used for longest go.

    Entries that this object has read or written stay: a run whose logs are larger than the limit would otherwise drop
    each before the next run needs it.

    Attributes:
        folder: of the entries; it need not exist.
        limit: bytes of all entries.
    """

    def __init__(self, folder: Path, gigabytes: float) -> None:
        """Nothing is read or written yet; `gigabytes` above 0."""
        self.folder, self.limit = folder.absolute(), GIGABYTE * gigabytes
        self._writable, self._used = True, set[str]()
        self._noted: dict[str, Any] = {}  # for the index
        self._read_index: dict[str, Any] | None = None

    def keep(self, keys: Collection[str]) -> None:
        """Let entries that this run will need, and others write for it, not go for those that this object writes."""
        self._used.update(keys)

    def has(self, key: str) -> bool:
        """Whether there is an entry, damaged or not."""
        return (self.folder / key / _DESCRIPTION).is_file()

    def load(self, key: str) -> CacheEntry | None:
        """The entry of a key, None if there is none. Warns TorchidWarning: the entry is damaged; it is removed."""
        if not self.has(key):
            return None
        try:
            entry = _read(self.folder / key, key)
        except Exception as error:  # noqa: B902 - whatever may be in such a folder
            if self.has(key):  # no other run has just dropped it
                self.drop(key, str(error))
            return None
        self._used.add(key)
        with suppress(OSError):
            os.utime(self.folder / key / _DESCRIPTION)
        return entry

    def drop(self, key: str, reason: str) -> None:
        """Remove an entry that cannot be used. Warns TorchidWarning: names it."""
        why = excerpt(" ".join(reason.split()))
        warn(f"{self.folder / key}: a damaged entry of the cache ({why}); what was in it is worked out again")
        _remove(self.folder / key)

    def save(self, key: str, document: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bool:
        """Store an entry; whether it is there now.

        Warns:
            TorchidWarning: nothing can be written; the first time only.
        """
        size = sum(array.nbytes for array in arrays.values())
        return self.save_files(key, size, lambda folder: (document, _write(folder, arrays)))

    def save_files(self, key: str, size: int, write: Callable[[Path], tuple[Mapping[str, Any], Files] | None]) -> bool:
        """Store an entry of so many bytes, as far as they are known, whose files a function writes; as `save`.

        Args:
            key: its name.
            size: bytes of the arrays.
            write: puts files into a folder; gives the document and a `written_file` for each, or None to give up.
        """
        if not self._writable or size > self.limit:
            return False
        missing = missing_folders(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if not self._make_room(size):
                return False
            with staging_folder(self.folder / key) as folder:
                (folder / NEW).mkdir()
                written = write(folder / NEW)
                if written is None:
                    return False
                _describe(folder / NEW, key, *written)
                if not self.has(key):
                    _remove(self.folder / key)  # without a description it is nobody's
                _rename(folder / NEW, self.folder / key)
            if not self._make_room(0):  # another run has stored something meanwhile
                _remove(self.folder / key)
        except OSError as error:
            self._writable = False
            found = f"cannot be written ({error.strerror or error}); this run goes on without it"
            warn(f"{self.folder}: {found}, and with preprocessing.cache_gb: 0 without this line")
            remove_empty(missing)
        if self.has(key):
            self._used.add(key)
        return self.has(key)

    def tidy(self) -> None:
        """Remove what killed runs left, and entries beyond the limit."""
        with suppress(OSError):
            self._make_room(0)
            for path in self.folder.glob(f"{TOKEN}*"):
                if time.time() - path.stat().st_mtime > _FORGOTTEN:
                    path.unlink()

    def _make_room(self, size: int) -> bool:
        """Remove the entries that were not used for longest, and what killed runs left; whether `size` bytes fit in."""
        entries: list[tuple[float, int, Path]] = []
        for path in self.folder.iterdir():
            if is_leftover(path):
                remove_leftover(path)
            elif _NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                entries.append((_last_used(path), _bytes_in(path), path))
        excess = sum(taken for _, taken, _ in entries) + size - self.limit
        old = [entry for entry in sorted(entries) if entry[2].name not in self._used]
        if excess > sum(taken for _, taken, _ in old):
            return False
        for _, taken, path in old:
            if excess <= 0:
                break
            _remove(path)
            excess -= taken
        return True

    # ------------------------------------------------------------------------------------------- checksums of logs

    def checksum(self, path: Path, files: Sequence[Path], meanwhile: Callable[[], None] = lambda: None) -> str:
        """Checksum of the content of a log; that of the index, where no file has changed since.

        Args:
            path: of the log.
            files: that it consists of.
            meanwhile: called while forks of this process sum up long files.

        Raises:
            OSError: one cannot be read.
        """
        states = file_states(files)
        if found := self.known_checksum(path, states):
            return found
        if sum(state[0] for state in states) < _LONG:
            sums = [part_checksum(part) for part in file_parts(files)]
        else:
            with in_forks(file_parts(files), part_checksum, max(thread_count() - 1, 1)) as summing:
                meanwhile()
                sums = summing()
        self.note_checksum(path, files, states, found := checksum_of_parts(sums))
        return found

    def known_checksum(self, path: Path, states: Sequence[Sequence[int]]) -> str:
        """Checksum in the index of a log whose files have these states; none without it."""
        known = self._known(path)
        found = str(known.get("sha256")) if known.get("files") == states else ""
        return found if _NAME.fullmatch(found) else ""

    def note_checksum(self, path: Path, files: Sequence[Path], states: list[list[int]], found: str) -> None:
        """Note the checksum of a log for the index, unless its files have just changed."""
        youngest = max(max(state[1:3]) for state in states) / 1e9
        if states == file_states(files) and abs(time.time() - youngest) > _YOUNG:
            self._noted[_place(path)] = {"files": states, "sha256": found}

    def array_bytes(self, path: Path, checksum: str, limit: float) -> int | None:
        """What `note_array_bytes` has noted, None if nothing."""
        known = self._known(path)
        sizes = known.get("arrays") if known.get("sha256") == checksum else None
        found = sizes.get(repr(limit)) if isinstance(sizes, dict) else None
        return found if isinstance(found, int) else None

    def note_array_bytes(self, path: Path, checksum: str, limit: float, size: int) -> None:
        """Note what `log_bytes` said of a log, so that a later run need not open it."""
        known = self._known(path)
        if known.get("sha256") == checksum:
            self._noted[_place(path)] = {**known, "arrays": {repr(limit): size}}

    def write_index(self) -> None:
        """Write what was noted; what another run writes meanwhile may be lost, and is then worked out again."""
        if not (self._noted and self._writable):
            return
        index = {place: x for place, x in self._index().items() if place not in self._noted} | self._noted
        with suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            with atomic_file(self.folder / _INDEX, result=False) as new:
                new.write_text(json.dumps(dict([*index.items()][-_MOST_FILES:]), indent=1) + "\n")

    def _known(self, path: Path) -> dict[str, Any]:
        place = _place(path)
        if self._read_index is None:
            self._read_index = self._index()
        known = self._noted.get(place) or self._read_index.get(place)
        return known if isinstance(known, dict) else {}

    def _index(self) -> dict[str, Any]:
        try:
            document = json.loads((self.folder / _INDEX).read_bytes())
        except (OSError, ValueError, RecursionError):
            return {}
        return document if isinstance(document, dict) else {}


def missing_folders(folder: Path) -> list[Path]:
    """A folder and those above it that are not there, the innermost first."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def remove_empty(folders: Sequence[Path]) -> None:
    """Remove folders, the innermost first, up to one in which something is."""
    with suppress(OSError):
        for folder in folders:
            folder.rmdir()


def _place(path: Path) -> str:
    return os.path.realpath(path)


def _last_used(folder: Path) -> float:
    try:
        return (folder / _DESCRIPTION).stat().st_mtime
    except OSError:
        return 0.0


def _bytes_in(folder: Path) -> int:
    total = 0
    with suppress(OSError):
        for path in folder.iterdir():
            total += path.lstat().st_size
    return total


def _rename(folder: Path, entry: Path) -> None:
    """Let an entry appear, unless another run has just stored the same."""
    try:
        folder.rename(entry)
    except OSError as error:
        if error.errno not in _THERE:
            raise


def _remove(folder: Path) -> None:
    """Remove an entry at once for others, by a rename; what the system refuses to remove stays."""
    with suppress(OSError), staging_folder(folder) as staging:
        folder.rename(staging / NEW)


# ------------------------------------------------------------------------------------------------- files of an entry


class _Hashing:
    """A stream that works out the checksum of what is written."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._digest = stream, hashlib.sha256()

    def write(self, data: bytes | memoryview) -> int:
        self._digest.update(data)
        return self._stream.write(data)

    def hexdigest(self) -> str:
        return self._digest.hexdigest()


def written_file(path: Path, sha256: str) -> dict[str, Any]:
    """What the description of an entry says of a file with this checksum."""
    return {"state": file_states([path])[0], "sha256": sha256}


def _write(folder: Path, arrays: Mapping[str, NDArray[Any]]) -> Files:
    """A file for each array."""
    files = {}
    for name, array in arrays.items():
        path = folder / f"{name}.npy"
        with path.open("xb") as stream:
            hashing: Any = _Hashing(stream)
            rows = np.ascontiguousarray(array)
            np.lib.format.write_array_header_1_0(hashing, np.lib.format.header_data_from_array_1_0(rows))
            data = rows.reshape(-1).view(np.uint8)
            for start in range(0, len(data), _BLOCK):  # np.save copies what does not go to a plain file
                hashing.write(data[start : start + _BLOCK].data)
        files[name] = written_file(path, hashing.hexdigest())
    return files


def _describe(folder: Path, key: str, document: Mapping[str, Any], files: Files) -> None:
    text = json.dumps({"key": key, "files": files, "document": document}, allow_nan=False)
    checked = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "entry": text}
    (folder / _DESCRIPTION).write_text(json.dumps(checked))


def _read(folder: Path, key: str) -> CacheEntry:
    """Any exception where an entry is damaged, or none of this key."""
    path = folder / _DESCRIPTION
    if path.stat().st_size > _LARGEST:
        raise _DamagedError(f"{_DESCRIPTION} of {path.stat().st_size} bytes")
    checked = json.loads(path.read_bytes())
    if hashlib.sha256(checked["entry"].encode()).hexdigest() != checked["sha256"]:
        raise _DamagedError(f"{_DESCRIPTION} has changed")
    entry = json.loads(checked["entry"])
    if entry["key"] != key:
        raise _DamagedError("of another name")
    arrays = {name: _mapped(folder / f"{name}.npy", x) for name, x in entry["files"].items()}
    return CacheEntry(entry["document"], arrays)


def _mapped(path: Path, written: Mapping[str, Any]) -> NDArray[Any]:
    if file_states([path])[0] != written["state"] and file_checksum(path) != written["sha256"]:
        raise _DamagedError(f"{path.name} has changed")
    array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    return array


def tensor_of(array: NDArray[Any]) -> torch.Tensor:
    """A tensor on the memory of an array that must not be written to."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torch says that the array is not writable
        return torch.from_numpy(array)
