"""Logs larger than memory, read a block of samples at a time."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, about_file, excerpt
from torchid.logs.arrays import ARRAY_ACCEPTED, load_part, parse_names, require_plain, sample_axis
from torchid.logs.columns import Columns
from torchid.logs.containers import Container, LogKind, existing_log_kind, open_container, reader_errors_explained
from torchid.logs.gaps import bridge_gaps
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
from torchid.logs.read import about_world_origin, build_log, check_fields_given
from torchid.logs.schema import match_arrays
from torchid.logs.spill import Spill
from torchid.logs.table_files import is_text_table
from torchid.logs.tables import common_texts, table_blocks, table_size
from torchid.logs.time_range import split_range

GIGABYTE = 1e9
_WHOLE = "a larger preprocessing.memory_gb, or first torchid convert"
_BYTES_PER_LETTER = 4  # of a table: a cell has at least two characters, a number eight bytes


def log_bytes(path: Path, limit: float) -> int:
    """Bytes of a log's arrays: an upper bound for text tables below a limit, 0 for bags (they are read whole).

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
    """Whether a log can be read in blocks: no bag, no episodes, and no interpolation to other stamps."""
    is_joined = existing_log_kind(path) in (LogKind.BAG, LogKind.JOINED)
    return not is_joined and not (columns is not None and (columns.other_times or columns.episodes))


@dataclass(frozen=True)
class LogBlocks:
    """An open log; only its stamps are in memory.

    Attributes:
        source: the log's file name.
        names: arrays of text, by field.
        time: (N,) [s].
        row_shapes: shape of a sample of every other field, by field.
        read_rows: arrays of some samples (...) by field, texts too.
        first: number of its first sample in the fields, of a part of a log.
    """

    source: str
    names: Mapping[str, NDArray[Any]]
    time: FloatArray
    row_shapes: Mapping[str, tuple[int, ...]]
    read_rows: Callable[[slice], dict[str, NDArray[Any]]]
    first: int = 0

    def __len__(self) -> int:
        return len(self.time)

    @property
    def row_bytes(self) -> int:
        """Bytes of a sample of float64."""
        return 8 + sum(8 * math.prod(shape) for shape in self.row_shapes.values())

    def read(self, samples: slice, allow_gaps: bool = False, bridge_gaps_s: float | None = None) -> Log:
        """Some samples as a log; `allow_gaps` and `bridge_gaps_s` as in `read_log`. Raises LogError: invalid values."""
        raw = self.read_rows(slice(self.first + samples.start, self.first + samples.stop))
        raw["time"] = self.time[samples]
        return build_log(bridge_gaps(about_world_origin(raw), bridge_gaps_s), allow_gaps)


@contextmanager
def open_log_blocks(
    path: Path, folder: Path, columns: Columns | None = None, needs_flags: bool = True
) -> Iterator[LogBlocks]:
    """Open a log in one file (.h5, .npz or a table) to read it in blocks.

    Arrays of .h5 and .npz files are read in place unless these are compressed; others, and tables, are unpacked to
    temporary files in `folder`. Of a part of a log no other samples are there.

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
                lengths, time, read_rows = _open_table(part.file, folder, columns, needs_flags)
            else:
                container = stack.enter_context(open_container(part.file, whole=False))
                lengths, time, read_rows = _open_arrays(container, folder, columns, needs_flags)
            blocks = _check_blocks(str(path), lengths, time, read_rows)
            if part.range is not None:
                samples = part.range.select(blocks.time)
                blocks = replace(blocks, time=blocks.time[samples], first=samples.start)
            check_time(blocks.time)
        yield blocks


_Opened = tuple[dict[str, int], NDArray[Any], Callable[[slice], dict[str, NDArray[Any]]]]
"""Samples of each field of a file, its stamps, and what reads rows of all."""


def _open_arrays(container: Container, folder: Path, columns: Columns | None, needs_flags: bool) -> _Opened:
    """Fields of a container, whose arrays are read where they are sliced."""
    given = list(container.declared_bytes())
    if columns is not None and columns.episodes is not None:
        raise LogError.at_field("file", "a file with several episodes must fit into memory", _WHOLE)

    def load(name: str) -> NDArray[Any]:
        with reader_errors_explained(name, ARRAY_ACCEPTED):
            return require_plain(name, container.load(name))

    mapped = match_arrays(columns, given, load)
    check_fields_given(mapped.given, needs_flags)
    if others := list(mapped.other_times(given)):
        raise LogError.at_field("file", f"a file with stamps '{excerpt(others[0])}' must fit into memory", _WHOLE)
    sources = {source: sample_axis(source, given) for source in mapped.sources if source != mapped.frame_column}
    shapes = dict[str, tuple[int, ...]]()
    counts = dict[str, int]()
    for source, (name, axis) in sources.items():
        with reader_errors_explained(source, ARRAY_ACCEPTED):
            shapes[source] = container.shape(name, folder)
            if not shapes[source]:
                require_plain(source, container.load(name))
                raise LogError.at_field(f"'{source}'", "a single value", "an array with a row for each sample")
            if axis >= len(shapes[source]):
                load_part(source, given, load)  # which refuses it
            counts[source] = shapes[source][axis]
    constant = {source for field in mapped.fields for source in mapped.constant_sources(field)}
    constant = {source for source in constant if len(shapes[source]) == 1}

    def take(source: str, rows: slice) -> NDArray[Any]:
        if source in constant or source not in sources:
            return load_part(source, given, load)
        axis = sources[source][1]
        with reader_errors_explained(source, ARRAY_ACCEPTED):
            return load_part(source, given, lambda name: require_plain(name, container.rows(name, rows, axis)))

    lengths = {field: _common_length(mapped.sources_of(field), counts, constant) for field in mapped.fields}
    every = slice(0, lengths["time"])
    counted = mapped.stamps(0, lengths["time"]) if mapped.step is not None else None
    time = mapped.value("time", partial(take, rows=every)) if counted is None else counted
    return lengths, time, lambda rows: mapped.read(partial(take, rows=rows))


def _common_length(sources: Sequence[str], counts: Mapping[str, int], constant: Collection[str]) -> int:
    """Samples of the arrays of a field; LogError where they differ."""
    sampled = [source for source in sources if source not in constant]
    most = max((counts[source] for source in sampled), default=0)
    for source in sampled:
        if counts[source] != most:
            raise LogError.at_field(f"'{source}'", f"{counts[source]} samples", f"{most}, as in the other arrays")
    return most


def _open_table(path: Path, folder: Path, columns: Columns | None, needs_flags: bool) -> _Opened:
    """Fields of a table, which is read once, to files."""
    spills: defaultdict[str, Spill] = defaultdict(partial(Spill, path, folder))
    texts = list[dict[str, NDArray[Any]]]()
    for number, block in enumerate(table_blocks(path, columns)):
        if not number:
            check_fields_given(block, needs_flags)
            continue
        texts.append({name: array for name, array in block.items() if field_shape(name)[:1] != ("N",)})
        for name in block.keys() - texts[-1].keys():
            spills[name].append(block[name])
    if not spills:
        raise LogError.at_field("time", "no samples", "at least one sample")
    names = common_texts(texts)
    arrays = {name: spill.array() for name, spill in spills.items()}
    lengths = {name: len(array) for name, array in arrays.items()}
    return lengths, arrays["time"], lambda rows: names | {name: array[rows] for name, array in arrays.items()}


def _check_blocks(
    source: str, lengths: dict[str, int], time: NDArray[Any], read_rows: Callable[[slice], dict[str, NDArray[Any]]]
) -> LogBlocks:
    """The log, after all checks of names and shapes."""
    check_shape("time", np.broadcast_to(False, time.shape), SHAPES["time"], {})
    stamps = to_float64("time", np.array(time))
    first = read_rows(slice(0, 1))
    names = {name: array for name, array in first.items() if name not in lengths}
    sizes = {"N": len(stamps)}
    for name, letter in NAME_FIELDS.items():
        sizes[letter] = len(parse_names(name, names[name])) if name in names else 0
    shapes = {name: array.shape[1:] for name, array in first.items() if name in lengths and name != "time"}
    for name, shape in shapes.items():
        check_shape(name, np.broadcast_to(False, (lengths[name], *shape)), field_shape(name), sizes)
    return LogBlocks(source, names, stamps, shapes, read_rows)
