"""Logs larger than memory, read a block of samples at a time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, about_file, excerpt
from torchid.logs.arrays import lazy_part, parse_names, require_plain
from torchid.logs.columns import Columns
from torchid.logs.containers import Container, LogKind, existing_log_kind, open_container, reader_errors_explained
from torchid.logs.force_plates import about_world_origin
from torchid.logs.gaps import bridge_gaps
from torchid.logs.lazy_arrays import LazyArray, Spill
from torchid.logs.log import (
    NAME_FIELDS,
    SHAPES,
    FloatArray,
    Log,
    check_shape,
    check_time,
    field_shape,
    to_float64,
)
from torchid.logs.read import build_log, check_fields_given
from torchid.logs.schema import FileFields, match_arrays
from torchid.logs.table_files import is_text_table
from torchid.logs.tables import read_table, table_blocks, table_size
from torchid.logs.time_range import split_range

GIGABYTE = 1e9
_WHOLE = "a larger preprocessing.memory_gb, or the file that torchid convert makes of it"
_ACCEPTED = "a plain array of numbers, truth values or text"
_BYTES_PER_LETTER = 4  # of a table: a cell has at least two characters, a number eight bytes


class MappedArray:
    """A field whose arrays are read where it is sliced."""

    def __init__(self, fields: FileFields, name: str, arrays: Mapping[str, LazyArray]) -> None:
        """The field of a name, of open arrays. Raises LogError: arrays that do not fit it."""
        self._fields, self._name, self._arrays = fields, name, arrays
        self._constant = fields.constant_sources(name)
        for source in fields.sources_of(name):
            if not arrays[source].shape:
                raise LogError.at_field(f"'{source}'", "a single value", "an array with a row for each sample")
        sampled = [source for source in fields.sources_of(name) if not self._is_constant(source)]
        lengths = {source: arrays[source].shape[0] for source in sampled}
        for source, length in lengths.items():
            if length != max(lengths.values()):
                raise LogError.at_field(f"'{source}'", f"{length} samples", f"{max(lengths.values())}, as others have")
        first = self[slice(0, 1)]
        self.dtype, self.shape = first.dtype, (max(lengths.values(), default=0), *first.shape[1:])

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        if self._name == "time" and self._fields.step is not None and hasattr(self, "shape"):
            start, stop, _ = rows.indices(self.shape[0])
            return self._fields.stamps(start, stop - start)
        return self._fields.value(self._name, lambda source: self._read(source, rows))

    def _read(self, source: str, rows: slice) -> NDArray[Any]:
        return np.asarray(self._arrays[source][slice(None) if self._is_constant(source) else rows])

    def _is_constant(self, source: str) -> bool:
        return source in self._constant and len(self._arrays[source].shape) == 1


def log_bytes(path: Path, limit: float) -> int:
    """Bytes of a log's arrays: an upper bound for tables of text below a limit, 0 for bags, which are read whole.

    A part of a log counts as all of it, several files count together.

    Raises:
        LogError: the file cannot be read.
    """
    kind = existing_log_kind(path)
    if kind is LogKind.BAG:
        return 0
    if kind is LogKind.JOINED:
        return sum(log_bytes(file.path, limit) for file in split_range(path).files)
    with about_file(path):
        path = split_range(path).file
        if kind is LogKind.TABLE:
            most = _BYTES_PER_LETTER * path.stat().st_size
            return most if is_text_table(path) and most <= limit else table_size(path)
        with open_container(path, whole=False) as container:
            return sum(container.declared_bytes().values())


def has_blocks(path: Path, columns: Columns | None) -> bool:
    """Whether a log can be read a block at a time: no bag, nothing interpolated to stamps of others, no episodes."""
    is_joined = existing_log_kind(path) in (LogKind.BAG, LogKind.JOINED)
    return not is_joined and not (columns is not None and (columns.other_times or columns.episodes))


@dataclass(frozen=True)
class LogBlocks:
    """An open log; only its stamps are in memory.

    Attributes:
        source: the log's file name.
        names: arrays of text, by field.
        time: (N,) [s].
        fields: all other fields with samples.
        first: number of its first sample in the fields, of a part of a log.
    """

    source: str
    names: Mapping[str, NDArray[Any]]
    time: FloatArray
    fields: Mapping[str, LazyArray]
    first: int = 0

    def __len__(self) -> int:
        return len(self.time)

    @property
    def row_bytes(self) -> int:
        """Bytes of a sample."""
        return 8 + sum(int(np.prod(x.shape[1:])) * x.dtype.itemsize for x in self.fields.values())

    def read(self, samples: slice, allow_gaps: bool = False, bridge_gaps_s: float | None = None) -> Log:
        """Some samples as a log; `allow_gaps` and `bridge_gaps_s` as of `read_log`. Raises LogError: invalid values."""
        rows = slice(self.first + samples.start, self.first + samples.stop)
        raw = {**self.names, "time": self.time[samples]}
        for name, array in self.fields.items():
            with reader_errors_explained(name, _ACCEPTED):
                raw[name] = np.asarray(array[rows])
        return build_log(bridge_gaps(about_world_origin(raw), bridge_gaps_s), allow_gaps)


@contextmanager
def open_log_blocks(
    path: Path, folder: Path | None, columns: Columns | None = None, needs_flags: bool = True
) -> Iterator[LogBlocks]:
    """Open a log in one file (.h5, .npz or a table).

    Arrays of .h5 and .npz files are read in place unless these are compressed; others are unpacked to temporary files
    in `folder`, or to memory without one. Of a part of a log no other samples are there.

    Args:
        path: of the log.
        folder: on whose disk there is room.
        columns: as of `read_log`.
        needs_flags: likewise.

    Raises:
        LogError: the file is invalid.
        SpillError: there is no room in the folder.
    """
    with ExitStack() as stack:
        with about_file(path):
            part = split_range(path)
            if existing_log_kind(part.file) is LogKind.TABLE:
                names, fields = _open_table(part.file, folder, columns, needs_flags)
            else:
                container = stack.enter_context(open_container(part.file, whole=False))
                names, fields = _open_arrays(container, folder, columns, needs_flags)
            blocks = _check_blocks(str(path), names, fields)
            if part.range is not None:
                samples = part.range.select(blocks.time)
                blocks = replace(blocks, time=blocks.time[samples], first=samples.start)
            check_time(blocks.time)
        yield blocks


def _open_arrays(
    container: Container, folder: Path | None, columns: Columns | None, needs_flags: bool
) -> tuple[dict[str, NDArray[Any]], dict[str, LazyArray]]:
    """Text and arrays of a container."""

    def load(name: str) -> NDArray[Any]:
        with reader_errors_explained(name, _ACCEPTED):
            return require_plain(name, container.load(name))

    def lazy(name: str) -> LazyArray:
        with reader_errors_explained(name, _ACCEPTED):
            return require_plain(name, container.lazy(name, folder))

    given = list(container.declared_bytes())
    if columns is not None and columns.episodes is not None:
        raise LogError.at_field("file", "episodes side by side, read whole", _WHOLE)
    mapped = match_arrays(columns, given, load)
    check_fields_given(mapped.given, needs_flags)
    if others := list(mapped.other_times(given)):
        raise LogError.at_field("file", f"stamps beside those of time ('{excerpt(others[0])}'), read whole", _WHOLE)
    sources = dict.fromkeys(source for name in mapped.fields for source in mapped.sources_of(name))
    arrays = {source: lazy_part(source, given, lazy) for source in sources}
    fields: dict[str, LazyArray] = {}
    for name in mapped.fields:
        with reader_errors_explained(name, _ACCEPTED):
            fields[name] = MappedArray(mapped, name, arrays)
    return mapped.text(load), fields


def _open_table(
    path: Path, folder: Path | None, columns: Columns | None, needs_flags: bool
) -> tuple[dict[str, NDArray[Any]], dict[str, LazyArray]]:
    """Text and arrays of a table, which is read once."""
    names: dict[str, NDArray[Any]] = {}
    if folder is None:
        raw = read_table(path, columns)
        check_fields_given(raw, needs_flags)
        return {n: x for n, x in raw.items() if _is_text(n)}, {n: x for n, x in raw.items() if not _is_text(n)}
    spills: defaultdict[str, Spill] = defaultdict(partial(Spill, path, folder))
    for number, block in enumerate(table_blocks(path, columns)):
        if not number:
            check_fields_given(block, needs_flags)
            continue
        for name, array in block.items():
            if not _is_text(name):
                spills[name].append(array)
            elif names.setdefault(name, array).tolist() != array.tolist():
                found = f"'{names[name]}' and '{array}'"
                raise LogError.at_field(f"column '{name}'", found, "one name, the same in every row")
    if not spills:
        raise LogError.at_field("time", "no samples", "at least one sample")
    return names, {name: spill.array() for name, spill in spills.items()}


def _is_text(name: str) -> bool:
    return name in NAME_FIELDS or SHAPES.get(name) == ()


def _check_blocks(source: str, names: dict[str, NDArray[Any]], fields: dict[str, LazyArray]) -> LogBlocks:
    """The log, after all checks of names and shapes."""
    time = fields.pop("time")
    check_shape("time", _empty(time), SHAPES["time"], {})
    with reader_errors_explained("time", _ACCEPTED):
        stamps = to_float64("time", np.asarray(time[:]))
    sizes = {"N": len(stamps)}
    for name, letter in NAME_FIELDS.items():
        sizes[letter] = len(parse_names(name, names[name])) if name in names else 0
    for name, array in fields.items():
        check_shape(name, _empty(array), field_shape(name), sizes)
    return LogBlocks(source, names, stamps, fields)


def _empty(array: LazyArray) -> NDArray[Any]:
    """An array of the same shape that takes no memory."""
    return np.broadcast_to(np.zeros((), dtype=array.dtype if array.dtype.kind in "biuf" else bool), array.shape)
