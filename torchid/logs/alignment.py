"""Align series with different stamps: topics of a bag, or files of one recording."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, about_file, excerpt, join_names, warn_about_file
from torchid.logs.arrays import parse_names
from torchid.logs.columns import (
    KEY,
    KINDS,
    MOST_LISTED,
    Columns,
    as_in_file,
    fits,
    letters_of,
    list_parts,
    names_field,
)
from torchid.logs.containers import LogKind, existing_log_kind, open_container
from torchid.logs.gaps import refuse_gaps
from torchid.logs.log import (
    CONTACT_READINGS,
    IMU_FIELDS,
    NAME_FIELDS,
    NAN_ALLOWED,
    NORMALS,
    WRENCHES,
    FloatArray,
    check_finite,
    check_shape,
    field_shape,
    is_quaternion,
    normalize_quaternions,
    parse_time,
    to_float64,
)
from torchid.logs.quaternion import make_sign_continuous
from torchid.logs.schema import column_pattern, columns_of_file
from torchid.logs.segments import unbroken_segments
from torchid.logs.tables import table_names
from torchid.logs.time_range import LogFile
from torchid.logs.timeline import JITTER, LONGEST_STEP, spline_derivatives


@dataclass(frozen=True, eq=False)
class Series:
    """Fields of a log (K, ...) with stamps (K,) [s], strictly increasing, in the log's clock.

    `name`: of the topic, "" if messages name it already. `whole`: "bag" or "file", for messages.
    """

    name: str
    stamps: FloatArray
    fields: Mapping[str, FloatArray]
    whole: str

    def _field(self, field: str) -> str:
        return f"{self.name}: {field}" if self.name else field

    def at(self, time: FloatArray) -> dict[str, FloatArray]:
        """The fields at stamps (N,) [s] within the series: unchanged at equal stamps, else from a quintic spline.

        Quaternions are interpolated as in `preprocess`: by component without sign flips, then normalised.
        A channel with any NaN becomes NaN in all samples.

        Raises:
            LogError: the series must be interpolated, and has a gap that is too long.

        Warns:
            TorchidWarning: a field is NaN in some samples.
        """
        same = self.same_stamps(time)
        if same is not None:
            return {name: values[same] for name, values in self.fields.items()}
        run = self._unbroken(time)
        return {name: self._interpolated(time, run, name) for name in self.fields}

    def hold(self, values: NDArray[np.float64], time: FloatArray) -> FloatArray:
        """The last values (K, ...) of the series before each stamp, (N, ...)."""
        return np.asarray(values[np.searchsorted(self.stamps, time + stamp_slack(time), side="right") - 1])

    def same_stamps(self, time: FloatArray) -> slice | None:
        """The samples at the stamps (N,) [s]; None if some stamps have no sample."""
        slack = stamp_slack(time)
        first = int(np.searchsorted(self.stamps, time[0] - slack))
        last = int(np.searchsorted(self.stamps, time[-1] + slack, side="right"))
        stamps = self.stamps[first:last]
        same = len(stamps) == len(time) and bool(np.all(np.abs(stamps - time) <= slack))
        return slice(first, last) if same else None

    def _unbroken(self, time: FloatArray) -> slice:
        """The samples around the log's time; LogError if a gap is too long for interpolation."""
        segments = list(unbroken_segments(self.stamps))
        starts = self.stamps[[segment.start for segment in segments]]
        number = max(int(np.searchsorted(starts, time[0], side="right")) - 1, 0)
        run = segments[number]
        if number + 1 < len(segments) and self.stamps[run.stop - 1] < time[-1]:
            before, after = self.stamps[[run.stop - 1, run.stop]]
            reason = f"a gap of {after - before:.4g} s after {before:.4g} s (median step"
            reason += f" {np.median(np.diff(self.stamps)):.4g} s)"
            accepted = f"gaps of at most {LONGEST_STEP:g} median steps; cut the {self.whole} there"
            raise LogError.at_field(self.name or "time", reason, accepted)
        return run

    def _interpolated(self, time: FloatArray, run: slice, name: str) -> FloatArray:
        values = self.fields[name][run]
        stamps = self.stamps[run]
        if is_quaternion(name):
            quat = make_sign_continuous(normalize_quaternions(self._field(name), values))
            quat = spline_derivatives(stamps, quat, time, (0,))[0]
            return np.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True))
        gaps = np.isnan(values).any(axis=0)
        if gaps.any() and not np.isnan(values[:, gaps]).all():
            warn_about_file(f"{self._field(name)}: NaN in some samples; after interpolation all samples are NaN")
        out = np.full((len(time), *values.shape[1:]), np.nan)
        out[:, ~gaps] = spline_derivatives(stamps, values[:, ~gaps], time, (0,))[0]
        return out


def stamp_slack(time: FloatArray) -> float:
    """The largest difference [s] of two stamps that count as equal."""
    return JITTER * float(np.median(np.diff(time))) if len(time) > 1 else 0.0


Fields = dict[str, NDArray[Any]]
#: Fields whose values hold until the next sample.
_HELD = ("contact_active", NORMALS)


def read_joined(
    files: Sequence[LogFile], columns: Columns | None, read: Callable[[Path, Columns | None], Fields]
) -> Fields:
    """Read a log from several files: at the stamps of the first, within the time that all of them cover.

    Args:
        files: each with other fields. Names of joints, contacts and sensors may have another order in each.
        columns: the map of columns; each entry applies to the files that have its columns.
        read: reads the fields of one file with its part of the map.

    Raises:
        LogError: a field is in two files, names differ, the files have no common time, or a gap is too long.
    """
    maps = _maps([file.path for file in files], columns)
    parts = []
    for file, file_columns in zip(files, maps, strict=True):
        with about_file(os.fspath(file.path)):
            parts.append(_stamped(read(file.path, file_columns), file.shift_s))
    return _joined([file.path.name for file in files], parts, [os.fspath(file.path) for file in files])


def align_by_stamps(raw: Fields, sources: Mapping[str, Sequence[str]], others: Mapping[str, FloatArray]) -> Fields:
    """Align the fields of a file with several arrays of stamps to those of `time`, within the time that all cover.

    A field belongs to the array of stamps with as many samples; `own_stamps` decides between several.

    Args:
        raw: fields of the file, `time` among them.
        sources: arrays of each field.
        others: other stamps (K,) [s] than `time`, by the name of their array.

    Raises:
        LogError: as `read_joined`.
    """
    stamps = {next(iter(sources["time"]), "time"): raw["time"], **others}
    parts: dict[str, Fields] = {name: {"time": time} for name, time in stamps.items()}
    for field, values in raw.items():
        if field != "time":
            beside = next(iter(sources.get(field, ())), "")
            parts[own_stamps(values if field_shape(field)[:1] == ("N",) else None, beside, stamps)][field] = values
    used = {name: _stamped(part, 0.0) for name, part in parts.items() if len(part) > 1}
    return _joined([f"the data with stamps '{excerpt(name)}'" for name in used], list(used.values()))


def own_stamps(values: NDArray[Any] | None, name: str, stamps: Mapping[str, NDArray[Any]]) -> str:
    """The name of the stamps of an array (N, ...): equally many; among several, the ones with the most similar name.

    The first stamps if none are equally many, or if the array has no samples.

    Args:
        values: of the array, None for an array without samples.
        name: of the array.
        stamps: (K,) each.
    """
    as_many = [] if values is None else [key for key, time in stamps.items() if len(time) == len(values)]
    words = re.findall("[a-z]+", name.lower())

    def alike(key: str) -> int:
        return len(os.path.commonprefix([re.findall("[a-z]+", key.lower()), words]))

    return max(as_many or [next(iter(stamps))], key=alike)


def _joined(labels: Sequence[str], parts: Sequence[Fields], files: Sequence[str] = ()) -> Fields:
    """The fields of all parts of a log at the stamps of the first; `files`: of the parts, if there are several.

    A field may be in several parts, each with other joints, contacts or sensors; they keep the order of the parts.
    """
    time = _common_stamps(labels, [part["time"] for part in parts])
    names: dict[str, list[str]] = {}
    for kind_field in NAME_FIELDS:
        every = [name for part in parts if kind_field in part for name in part[kind_field].tolist()]
        names |= {kind_field: list(dict.fromkeys(every))} if every else {}
    pieces = dict[str, list[tuple[str, list[str], NDArray[Any]]]]()
    for number, part in enumerate(parts):
        with about_file(files[number]) if files else nullcontext():
            fields = {name: x for name, x in part.items() if name not in NAME_FIELDS}
            for name, values in _aligned(fields, time, parts[0]["time"][0]).items():
                own_names = part[names_field(name)].tolist() if names_field(name) in part else []
                pieces.setdefault(name, []).append((labels[number], own_names, values))
    out = {name: _side_by_side(name, x, names.get(names_field(name), []), files) for name, x in pieces.items()}
    return out | {name: np.array(x, dtype=np.str_) for name, x in names.items()} | {"time": time}


def _side_by_side(
    field: str, pieces: Sequence[tuple[str, list[str], NDArray[Any]]], names: list[str], files: Sequence[str]
) -> NDArray[Any]:
    """A field of several files with its columns in the order of the log's names.

    Raises:
        LogError: two files have the field for the same joints, contacts or sensors; or no file has it for one of them.
    """
    own_names = [name for _, of_file, _ in pieces for name in of_file]
    if len(pieces) > 1 and (len(set(own_names)) < len(own_names) or not all(of_file for _, of_file, _ in pieces)):
        reason = f"in {pieces[0][0]} and in {pieces[1][0]}"
        accepted = "each field in one file only, or with different joints or contacts in each file"
        raise LogError.at_field(field, reason, accepted)
    values = np.concatenate([x for *_, x in pieces], axis=1) if len(pieces) > 1 else pieces[0][2]
    own_names = own_names or names
    if own_names == names or values.ndim < 2:
        return values
    if missing := sorted(set(names) - set(own_names)):
        kind_field = names_field(field)
        file = next((file for file in files if file.endswith(pieces[-1][0])), "")
        with about_file(file) if file else nullcontext():
            accepted = f"all {KINDS[kind_field]}s of the log in the files with {field}, in any order"
            raise LogError.at_field(kind_field, f"'{missing[0]}' missing", accepted)
    return np.asarray(values[:, [own_names.index(name) for name in names]])


def columns_by_file(columns: Columns, given: Sequence[Sequence[str]], files: Sequence[str]) -> list[Columns]:
    """Split a map of columns: for each of several files, the entries that apply to it.

    Entries without columns go to the file with their field. If several files have the same column, `::` separates the
    file from the column: `torques.csv::{joint}`. An entry may have joints, contacts or sensors in several files.

    Args:
        columns: the map.
        given: columns or arrays of each file.
        files: their names.

    Raises:
        LogError: no file has a column of an entry.
    """
    maps = [columns_of_file(as_in_file(columns, file, files), texts) for file, texts in zip(files, given, strict=True)]
    entries = [_entries_in(of_file, texts) for of_file, texts in zip(maps, given, strict=True)]
    for name in columns.fields:
        if not any(name in of_file for of_file in entries):
            none = f"{join_names(files, MOST_LISTED)} have no such column"
            raise LogError.at_field(f"{KEY}.{name}", none, "a column of one of the files")
    out = []
    for of_file, has in zip(maps, entries, strict=True):
        without: dict[str, Any] = dict.fromkeys({*columns.fields, "imu_frame"} - has)
        without |= {} if WRENCHES[1] in has else {"plates": {}}
        out.append(replace(of_file, **without))
    return out


def _entries_in(columns: Columns, given: Sequence[str]) -> set[str]:
    """Entries of a map with a column in a file, and entries without columns that belong to one of its fields.

    A constant step of time applies to every file without a column of stamps.
    """
    parts = list_parts(columns).values()
    patterns = [
        (part.key.partition(".")[0], letters_of(text), column_pattern(part, text))
        for part in parts
        for text in part.patterns
    ]
    out = set[str]()
    for text in given:
        of_fields = [(field, letters) for field, letters, regex in patterns if regex.fullmatch(text)]
        ignored = [letters_of(pattern) for pattern in columns.ignore if fits(text, pattern)]
        most = max((*ignored, *(letters for _, letters in of_fields)), default=0)
        out |= {field for field, letters in of_fields if letters == most}
    has = {*out, *(text.partition(".")[0] for text in given)}
    if columns.time is not None and columns.time.step is not None and "time" not in has:
        out.add("time")
    by_force = columns.contact_active is not None and columns.contact_active.above is not None
    beside: dict[str, Sequence[str]] = {
        "contact_active": CONTACT_READINGS if by_force else ("joint_position",),  # of any file, contacts that touch
        "joint_torque": ("joint_velocity",),
        "imu_frame": IMU_FIELDS,
    }
    with_columns = {field for field, *_ in patterns}
    return out | {name for name, fields in beside.items() if name not in with_columns and has & set(fields)}


def _maps(paths: Sequence[Path], columns: Columns | None) -> list[Columns | None]:
    """The entries of a map that each file has columns of."""
    if columns is None:
        return [None for _ in paths]
    if columns.rows_of is not None:
        accepted = "one file; or first convert it with torchid convert"
        raise LogError.at_field(f"{KEY}.rows_of", "not supported for several files", accepted)
    given = []
    for path in paths:
        with about_file(os.fspath(path)):
            given.append(_names_in(path))
    return [*columns_by_file(columns, given, [path.name for path in paths])]


def _names_in(path: Path) -> list[str]:
    """Columns of a table, or names of the arrays of a file."""
    if existing_log_kind(path) is LogKind.TABLE:
        return table_names(path)[0]
    with open_container(path) as container:
        return list(container.declared_bytes())


def _stamped(raw: Fields, shift_s: float) -> Fields:
    """The fields of a file that are not empty, with its stamps (K,) [s] in the clock of the log."""
    if "time" not in raw:
        raise LogError.at_field("time", "missing", "stamps in each file of the log")
    time = parse_time(raw["time"])
    out = {name: x for name, x in raw.items() if name not in NAME_FIELDS}
    out |= {name: np.array(x, np.str_) for name in NAME_FIELDS if name in raw and (x := parse_names(name, raw[name]))}
    if "joint_names" not in out and 0 in out.get("joint_position", time).shape[1:]:
        del out["joint_position"]  # what a table without joints has
    for name, array in out.items():
        if field_shape(name)[:1] == ("N",):
            check_shape(name, array, field_shape(name), {"N": len(time)})
    return out | {"time": time + shift_s if shift_s else time}


def _common_stamps(labels: Sequence[str], stamps: Sequence[FloatArray]) -> FloatArray:
    """The stamps of the first file within the time that all cover."""
    time = stamps[0]
    slack = stamp_slack(time)
    late = max(range(len(labels)), key=lambda number: stamps[number][0])
    early = min(range(len(labels)), key=lambda number: stamps[number][-1])
    common = time[(time >= stamps[late][0] - slack) & (time <= stamps[early][-1] + slack)]
    if not len(common):
        reason = f"no time that all files share with {labels[0]}: {labels[late]} starts at {stamps[late][0]:.6f} s,"
        reason += f" {labels[early]} ends at {stamps[early][-1]:.6f} s"
        raise LogError.at_field("time", reason, "stamps of one clock; shift_s adds a time to those of a file")
    return common


def _aligned(part: Fields, time: FloatArray, origin: float) -> Fields:
    """The fields of a file at the stamps (N,) [s] of the log."""
    sampled = {name: x for name, x in part.items() if field_shape(name)[:1] == ("N",) and name != "time"}
    moving = {name: to_float64(name, x) for name, x in sampled.items() if name not in _HELD}
    series = Series("", part["time"] - origin, moving, "file")
    if series.same_stamps(time - origin) is None:
        for name, x in moving.items():
            _check_unbroken(name, x, part["time"])
    held = {name: series.hold(sampled[name], time - origin) for name in _HELD if name in sampled}
    text = {name: x for name, x in part.items() if name not in sampled and name != "time"}
    return {**text, **held, **series.at(time - origin)}


def _check_unbroken(name: str, values: FloatArray, time: FloatArray) -> None:
    """Refuse a field (K, ...) with values that a spline cannot interpolate."""
    if name not in NAN_ALLOWED and np.isnan(values).any():
        refuse_gaps(name, values, time)
    check_finite(name, values, allow_nan=True)
