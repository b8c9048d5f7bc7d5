"""Logs larger than memory, read a block of samples at a time."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, about_file, excerpt
from torchid.logs.arrays import lazy_part, parse_names, require_plain
from torchid.logs.column_map import Columns
from torchid.logs.containers import Container, LogKind, existing_log_kind, open_container, reader_errors_explained
from torchid.logs.force_plates import about_world_origin
from torchid.logs.gaps import fill_short_gaps, warn_of_filled
from torchid.logs.lazy_arrays import Computed, LazyArray, MappedArray, Spill
from torchid.logs.log import (
    CONTACT_READINGS,
    FLAGS,
    NAME_FIELDS,
    POINTS,
    SHAPES,
    WRENCHES,
    FloatArray,
    Log,
    check_shape,
    check_time,
    field_shape,
    to_float64,
)
from torchid.logs.mapped_fields import map_arrays
from torchid.logs.read import build_log, check_fields_given
from torchid.logs.table_files import is_text_table
from torchid.logs.tables import read_table, table_blocks, table_size
from torchid.logs.time_range import split_range

GIGABYTE = 1e9
_WHOLE = "a larger preprocessing.memory_gb, or the file that torchid convert makes of it"
_ACCEPTED = "a plain array of numbers, truth values or text"
_SAMPLE = re.compile(r"\bsample (\d+)")
_BYTES_PER_LETTER = 4  # of a table: a cell has at least two characters, a number eight bytes


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


def count_samples_from(start: int, error: LogError) -> LogError:
    """An error in a part of a log, with samples counted from the start of the log."""
    found = _SAMPLE.sub(lambda match: f"sample {int(match[1]) + start}", error.found)
    return LogError(error.source, error.field, found.replace(" in all)", " near it)"), error.accepted)


@dataclass(frozen=True)
class _Rows:
    """Successive rows, from `start` to before `stop`, of an array that is read where it is sliced."""

    array: LazyArray
    start: int
    stop: int

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.stop - self.start, *self.array.shape[1:])

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.array.dtype

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        start, stop, _ = rows.indices(self.stop - self.start)
        return self.array[self.start + start : self.start + stop]


@dataclass
class LogBlocks:
    """An open log; only its stamps are in memory.

    Attributes:
        source: the log's file name.
        names: arrays of text, by field.
        time: (N,) [s].
        fields: all other fields with samples.
    """

    source: str
    names: Mapping[str, NDArray[Any]]
    time: FloatArray
    fields: Mapping[str, LazyArray]
    _last: tuple[int, FloatArray] | None = field(default=None, init=False)

    def __len__(self) -> int:
        return len(self.time)

    @property
    def row_bytes(self) -> int:
        """Bytes of a sample."""
        return 8 + sum(int(np.prod(x.shape[1:])) * x.dtype.itemsize for x in self.fields.values())

    def part(self, samples: slice) -> LogBlocks:
        """The log as if nothing but some successive samples had been recorded."""
        fields = {name: _Rows(array, samples.start, samples.stop) for name, array in self.fields.items()}
        return LogBlocks(self.source, self.names, self.time[samples], fields)

    def replaced(
        self, fields: Mapping[str, LazyArray | None], names: Mapping[str, NDArray[Any] | None] | None = None
    ) -> LogBlocks:
        """The log with other fields and arrays of text, None for none."""
        arrays = {name: array for name, array in {**self.fields, **fields}.items() if array is not None}
        texts = {name: array for name, array in {**self.names, **(names or {})}.items() if array is not None}
        return LogBlocks(self.source, texts, self.time, arrays)

    def read(self, samples: slice, only: tuple[str, ...] | None = None, allow_gaps: bool = False) -> Log:
        """Some samples as a log, or only the fields `only` of them with positions of 0; `allow_gaps` as of `read_log`.

        Signs of quaternions continue those of the samples before, if these were read last.

        Raises:
            LogError: an invalid value; the message counts samples from the start of the log.
        """
        with about_file(self.source):
            raw: dict[str, Any] = dict(self.names)
            if only is not None:
                raw["joint_position"] = np.zeros((len(self.time[samples]), len(self.names["joint_names"])))
            raw |= self.raw(samples, self._wanted(only))
            try:
                log = build_log(raw, allow_gaps)
            except LogError as error:
                raise count_samples_from(samples.start, error) from error
        if log.base_quat_xyzw is not None:
            self._continue_signs(log.base_quat_xyzw, samples)
        return log

    def _wanted(self, only: tuple[str, ...] | None) -> tuple[str, ...]:
        """Names of the fields that are there of those to be read."""
        with_points = only is not None and WRENCHES[1] in only
        return tuple(name for name in self.fields if only is None or name in only or (name == POINTS and with_points))

    def raw(self, samples: slice, names: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Stamps and fields of some samples as they are in the file."""
        raw: dict[str, NDArray[Any]] = {"time": self.time[samples]}
        for name in names:
            with reader_errors_explained(name, _ACCEPTED):
                raw[name] = np.asarray(self.fields[name][samples])
        return raw

    def about_world_origin(self) -> LogBlocks:
        """The log with moments about the world's origin, where it has the points of these, see `about_world_origin`."""
        if POINTS not in self.fields or WRENCHES[1] not in self.fields:
            return self
        names = [name for name in (WRENCHES[1], POINTS, FLAGS) if name in self.fields]
        wrench, points = self.fields[WRENCHES[1]], self.fields[POINTS]

        def moved(rows: slice) -> NDArray[Any]:
            try:
                return about_world_origin(self.raw(rows, names))[WRENCHES[1]]
            except LogError as error:
                raise count_samples_from(rows.start, error) from error

        origin = np.broadcast_to(np.zeros(()), points.shape)
        return self.replaced({WRENCHES[1]: Computed(wrench.shape, np.dtype(float), moved), POINTS: origin})

    def _continue_signs(self, quat: FloatArray, samples: slice) -> None:
        """Flip quaternions (M, 4) where their sign is not that of the samples before."""
        if self._last is not None:
            index, before = self._last
            place = max(index - samples.start, 0)  # of the sample that was read last, or of the one after it
            if samples.start <= index + 1 and place < len(quat) and quat[place] @ before < 0.0:
                quat *= -1.0
        self._last = samples.start + len(quat) - 1, quat[-1].copy()


class LogInMemory(LogBlocks):
    """A log that was read whole, as one that is read in blocks; its values are not checked again.

    Attributes:
        log: the log.
    """

    def __init__(self, log: Log) -> None:
        """Of the arrays of the log, which are not copied."""
        names = {name: np.array(getattr(log, name), dtype=np.str_) for name in NAME_FIELDS if getattr(log, name)}
        fields: dict[str, LazyArray] = {name: array for name, array in log.arrays().items() if name != "time"}
        super().__init__(log.source, names, log.time, fields)
        self.log = log

    def part(self, samples: slice) -> LogInMemory:
        """As `LogBlocks.part`."""
        return LogInMemory(self.log.select(samples))

    def replaced(
        self, fields: Mapping[str, LazyArray | None], names: Mapping[str, NDArray[Any] | None] | None = None
    ) -> LogInMemory:
        """As `LogBlocks.replaced`."""
        changed: dict[str, Any] = {name: x if x is None else np.asarray(x[:]) for name, x in fields.items()}
        changed |= {name: "" if x is None else tuple(x.tolist()) for name, x in (names or {}).items()}
        return LogInMemory(replace(self.log, **changed))

    def read(self, samples: slice, only: tuple[str, ...] | None = None, allow_gaps: bool = False) -> Log:
        """As `LogBlocks.read`, with all positions."""
        chosen = self.log if samples == slice(0, len(self)) else self.log.select(samples)
        if only is None:
            return chosen
        missing: dict[str, Any] = dict.fromkeys(self.fields.keys() - {*only, "joint_position"})
        return replace(chosen, **missing)


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
                blocks = blocks.part(part.range.select(blocks.time))
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
    mapped = None if columns is None else map_arrays(columns, given, load)
    check_fields_given(given if mapped is None else mapped.given, needs_flags)
    if mapped is not None and (others := list(mapped.other_times(given))):
        raise LogError.at_field("file", f"stamps beside those of time ('{excerpt(others[0])}'), read whole", _WHOLE)
    if mapped is None:
        text = [name for name in given if _is_text(name)]
        return {name: load(name) for name in text}, {name: lazy(name) for name in given if name not in text}
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


_AROUND = 64
"""Samples beyond the longest gap on either side that a spline is put through.

A cubic spline forgets what is further away: by a factor of 0.27 each sample.
"""


def bridge_in_blocks(blocks: LogBlocks, longest_s: float | None, pieces: Iterable[slice]) -> LogBlocks:
    """The log with its short gaps filled as by `bridge_gaps`, which takes a pass over it.

    Args:
        blocks: the log as recorded, with moments about the world's origin.
        longest_s: from the value before a gap to that after it [s]; None leaves all as it is.
        pieces: successive parts of it, all of it together.

    Raises:
        LogError: an invalid value.

    Warns:
        TorchidWarning: how many samples were filled.
    """
    if longest_s is None:
        return blocks
    names, count = dict[str, None](), 0
    for piece in pieces:
        filled = _filled(blocks, tuple(blocks.fields), piece, longest_s)[1]
        names |= dict.fromkeys(filled)
        if filled:
            count += int(np.any(list(filled.values()), axis=0).sum())
    if names:
        warn_of_filled(names, count, len(blocks), longest_s)

    def bridged(name: str) -> Computed:
        def rows_of(rows: slice) -> NDArray[Any]:
            wanted = (name, FLAGS) if name in CONTACT_READINGS and FLAGS in blocks.fields else (name,)
            return _filled(blocks, wanted, rows, longest_s)[0][name]

        return Computed(blocks.fields[name].shape, blocks.fields[name].dtype, rows_of)

    return blocks.replaced({name: bridged(name) for name in names})


def _filled(
    blocks: LogBlocks, names: tuple[str, ...], rows: slice, longest_s: float
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[np.bool_]]]:
    """Fields of some rows, as `fill_short_gaps` has them, and in which of the rows of which something was filled."""
    time = blocks.time
    first = int(np.searchsorted(time, time[rows.start] - 2.0 * longest_s)) - _AROUND
    last = int(np.searchsorted(time, time[rows.stop - 1] + 2.0 * longest_s)) + _AROUND
    window = slice(max(first, 0), min(last, len(time)))
    inside = slice(rows.start - window.start, rows.stop - window.start)
    out, filled = fill_short_gaps(blocks.raw(window, names), longest_s)
    in_rows = {name: where[inside] for name, where in filled.items()}
    return {name: out[name][inside] for name in names}, {name: x for name, x in in_rows.items() if x.any()}
