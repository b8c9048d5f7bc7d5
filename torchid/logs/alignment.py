"""Series with stamps of their own at the common stamps of a log: topics of a bag, files of one recording."""

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
    """Fields of a log (K, ...) with stamps (K,) [s], strictly increasing, counted as those of the log.

    `name`: of the topic, "" for what messages name already. `whole`: what it is a part of, "bag" or "file".
    """

    name: str
    stamps: FloatArray
    fields: Mapping[str, FloatArray]
    whole: str

    def _field(self, field: str) -> str:
        return f"{self.name}: {field}" if self.name else field

    def at(self, time: FloatArray) -> dict[str, FloatArray]:
        """The fields at stamps (N,) [s] that the series covers: unchanged for equal stamps, else by a quintic spline.

        Quaternions are interpolated as in `preprocess`, component by component without sign flips, then normalised.
        A channel with any NaN becomes NaN throughout.

        Raises:
            LogError: too long a gap in a series that must be interpolated.

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
        """The samples that have the stamps (N,) [s]; None where others are needed."""
        slack = stamp_slack(time)
        first = int(np.searchsorted(self.stamps, time[0] - slack))
        last = int(np.searchsorted(self.stamps, time[-1] + slack, side="right"))
        stamps = self.stamps[first:last]
        same = len(stamps) == len(time) and bool(np.all(np.abs(stamps - time) <= slack))
        return slice(first, last) if same else None

    def _unbroken(self, time: FloatArray) -> slice:
        """The samples around the log's time, checked for gaps that are too long to be interpolated."""
        segments = list(unbroken_segments(self.stamps))
        starts = self.stamps[[segment.start for segment in segments]]
        number = max(int(np.searchsorted(starts, time[0], side="right")) - 1, 0)
        run = segments[number]
        if number + 1 < len(segments) and self.stamps[run.stop - 1] < time[-1]:
            before, after = self.stamps[[run.stop - 1, run.stop]]
            reason = f"a gap of {after - before:.4g} s from {before:.4g} s on, "
            reason += f"where the median step is {np.median(np.diff(self.stamps)):.4g} s"
            accepted = f"steps of at most {LONGEST_STEP:g} median steps: cut the {self.whole} there"
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
            where = f"{self.name}: NaN in part of {name}" if self.name else f"{name}: NaN in part of it"
            warn_about_file(f"{where}: NaN throughout after interpolation")
        out = np.full((len(time), *values.shape[1:]), np.nan)
        out[:, ~gaps] = spline_derivatives(stamps, values[:, ~gaps], time, (0,))[0]
        return out


def stamp_slack(time: FloatArray) -> float:
    """By how much two stamps may differ [s] that are one, but for rounding."""
    return JITTER * float(np.median(np.diff(time))) if len(time) > 1 else 0.0


Fields = dict[str, NDArray[Any]]
#: Fields whose values hold until the next sample.
_HELD = ("contact_active", NORMALS)


def read_joined(
    files: Sequence[LogFile], columns: Columns | None, read: Callable[[Path, Columns | None], Fields]
) -> Fields:
    """The fields of a log in several files: at the stamps of the first, within the time that all of them cover.

    Args:
        files: each with other fields. Names of joints, contacts and sensors may have another order in each.
        columns: what their columns hold; an entry is for those files that have a column of it.
        read: the fields of one file, with a map of its own.

    Raises:
        LogError: a field in two files, names that differ, files without a common time, or too long a gap in one.
    """
    maps = _maps([file.path for file in files], columns)
    parts = []
    for file, file_columns in zip(files, maps, strict=True):
        with about_file(os.fspath(file.path)):
            parts.append(_stamped(read(file.path, file_columns), file.shift_s))
    return _joined([file.path.name for file in files], parts, [os.fspath(file.path) for file in files])


def align_by_stamps(raw: Fields, sources: Mapping[str, Sequence[str]], others: Mapping[str, FloatArray]) -> Fields:
    """The fields of a file of which some have stamps of their own: all at those of `time`, within what all cover.

    A field has the stamps that are as many as its samples, of several those that `own_stamps` says.

    Args:
        raw: fields of the file, `time` among them.
        sources: arrays that each field comes from.
        others: stamps (K,) [s] beside those of `time`, by the name of their array.

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
    return _joined([f"what has the stamps '{excerpt(name)}'" for name in used], list(used.values()))


def own_stamps(values: NDArray[Any] | None, name: str, stamps: Mapping[str, NDArray[Any]]) -> str:
    """The stamps, by name, of an array (N, ...): as many; of several those with most of the first words of its name.

    The first ones where none are as many, or of what has no samples.

    Args:
        values: of the array, None for what has no samples.
        name: of the array.
        stamps: (K,) each.
    """
    as_many = [] if values is None else [key for key, time in stamps.items() if len(time) == len(values)]
    words = re.findall("[a-z]+", name.lower())

    def alike(key: str) -> int:
        return len(os.path.commonprefix([re.findall("[a-z]+", key.lower()), words]))

    return max(as_many or [next(iter(stamps))], key=alike)


def _joined(labels: Sequence[str], parts: Sequence[Fields], files: Sequence[str] = ()) -> Fields:
    """The fields of all parts of a log at the stamps of the first; `files`: that they are in, if in several.

    A field may be in several parts, each with joints, contacts or sensors of its own; their order is that of the parts
    that have them.
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
    """A field with its columns in the order of the log's names, those of several files side by side.

    Raises:
        LogError: a field in two files that have the same joints, contacts or sensors of it, or none; or one of these
            that is in no file.
    """
    own_names = [name for _, of_file, _ in pieces for name in of_file]
    if len(pieces) > 1 and (len(set(own_names)) < len(own_names) or not all(of_file for _, of_file, _ in pieces)):
        reason = f"both in {pieces[0][0]} and in {pieces[1][0]}"
        accepted = "every field but time in one of several files, or other joints or contacts in each"
        raise LogError.at_field(field, reason, accepted)
    values = np.concatenate([x for *_, x in pieces], axis=1) if len(pieces) > 1 else pieces[0][2]
    own_names = own_names or names
    if own_names == names or values.ndim < 2:
        return values
    if missing := sorted(set(names) - set(own_names)):
        kind_field = names_field(field)
        file = next((file for file in files if file.endswith(pieces[-1][0])), "")
        with about_file(file) if file else nullcontext():
            where = f"in all files of a log, or in those that have {field} together, in any order"
            accepted = f"the same {KINDS[kind_field]}s {where}"
            raise LogError.at_field(kind_field, f"'{missing[0]}' missing", accepted)
    return np.asarray(values[:, [own_names.index(name) for name in names]])


def columns_by_file(columns: Columns, given: Sequence[Sequence[str]], files: Sequence[str]) -> list[Columns]:
    """The map without the entries that are for others of several files, for each.

    Entries without columns are for the file with the field that they belong to. Of columns that several files have, a
    name says before `::` of which file they are: `torques.csv::{joint}`. An entry may have joints, contacts or sensors
    in each of several files.

    Args:
        columns: the map.
        given: columns or arrays of each file.
        files: their names.

    Raises:
        LogError: an entry of which no file has a column.
    """
    maps = [columns_of_file(as_in_file(columns, file, files), texts) for file, texts in zip(files, given, strict=True)]
    entries = [_entries_in(of_file, texts) for of_file, texts in zip(maps, given, strict=True)]
    for name in columns.fields:
        if not any(name in of_file for of_file in entries):
            none = f"no column of it in {join_names(files, MOST_LISTED)}"
            raise LogError.at_field(f"{KEY}.{name}", none, "columns that one of the files has")
    out = []
    for of_file, has in zip(maps, entries, strict=True):
        without: dict[str, Any] = dict.fromkeys({*columns.fields, "imu_frame"} - has)
        without |= {} if WRENCHES[1] in has else {"plates": {}}
        out.append(replace(of_file, **without))
    return out


def _entries_in(columns: Columns, given: Sequence[str]) -> set[str]:
    """Entries of a map of which a file has a column, and those without columns that belong to one of its fields.

    Stamps by their step belong to every file without a column of stamps.
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
        raise LogError.at_field(
            f"{KEY}.rows_of", "given for several files", "one file; or convert it to one of columns"
        )
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
    """The fields of a file, those that have anything in them, with its stamps (K,) [s] in the clock of the log."""
    if "time" not in raw:
        raise LogError.at_field("time", "missing", "stamps in each of several files of a log")
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
        reason = f"no stamp of {labels[0]} that all files cover: "
        reason += f"{labels[late]} starts at {stamps[late][0]:.6f} s, "
        reason += f"{labels[early]} ends at {stamps[early][-1]:.6f} s"
        raise LogError.at_field("time", reason, "stamps of one clock, or shift_s, what is added to those of a file")
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
    """Refuse a field (K, ...) that no spline can be drawn through."""
    if name not in NAN_ALLOWED and np.isnan(values).any():
        refuse_gaps(name, values, time)
    check_finite(name, values, allow_nan=True)
