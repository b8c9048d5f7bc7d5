"""Read a log file, check it, convert it to canonical frames and orders; write a log file."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, about_file, current_file, during
from torchid.logs.alignment import align_by_stamps, read_joined
from torchid.logs.arrays import ARRAY_ACCEPTED, load_part, parse_frame, parse_names, require_plain
from torchid.logs.bags import read_bag
from torchid.logs.columns import Columns
from torchid.logs.containers import (
    LogKind,
    existing_log_kind,
    new_log_kind,
    open_container,
    reader_errors_explained,
    save_arrays,
)
from torchid.logs.episodes import EpisodeArrays
from torchid.logs.gaps import bridge_gaps, refuse_gaps
from torchid.logs.log import (
    CONTACT_READINGS,
    EXCLUSIVE,
    FLAGS,
    NAME_FIELDS,
    NAN_ALLOWED,
    NORMALS,
    POINTS,
    REQUIRED,
    REQUIRED_WITH,
    SHAPES,
    VARIANTS,
    WRENCHES,
    FloatArray,
    Log,
    check_finite,
    check_shape,
    column_labels,
    field_shape,
    is_quaternion,
    normalize_normals,
    normalize_quaternions,
    parse_flags,
    parse_time,
    to_float64,
)
from torchid.logs.quaternion import make_sign_continuous, rotate_to_base, rotate_to_world
from torchid.logs.ros_topics import Topics
from torchid.logs.schema import match_arrays, read_stamps
from torchid.logs.tables import read_table, save_table
from torchid.logs.time_range import Recording, TimeRange, recording_starts, split_range


def read_log(
    path: str | os.PathLike[str],
    topics: Topics | None = None,
    progress: Callable[[float], None] | None = None,
    allow_gaps: bool = False,
    columns: Columns | None = None,
    bridge_gaps_s: float | None = None,
    needs_flags: bool = True,
) -> Log:
    """Read a log: arrays (.npz, .h5, .mat), a table (.csv, .txt, .parquet, OpenSim's .mot) or a bag of ROS messages.

    Quaternions come back in the order xyzw, renormalised and without sign flips; linear velocity and acceleration of
    the base in the world frame, angular ones in the base frame. An acceleration's components are only rotated: it is
    the derivative of the world velocity whichever frame it is expressed in.

    Args:
        path: the file; of a ROS 2 bag also its folder. A range of time behind it takes a part of the log, as if nothing
            else had been recorded: `walk.npz[0:30]`, see `TimeRange`; `[#2]` the third of recordings whose stamps begin
            anew. Several files of one recording are one log with
            the stamps of the first: `motion.csv + plates.csv`, see `read_joined`.
        topics: topics of a bag (.bag, .mcap, .db3).
        progress: called with the share of a bag that has been read.
        allow_gaps: accept NaN in poses and their derivatives, which `torchid.check` reports.
        columns: what the columns of a table, or the arrays of a file, hold where these have other names.
        bridge_gaps_s: fill gaps of at most so long [s], see `bridge_gaps`; None leaves them.
        needs_flags: refuse readings of contacts without `contact_active`; false where flags are worked out of them.

    Raises:
        LogError: one line with the file, the field, its value and the accepted values.
        ConfigError: a map of columns that does not fit itself.
        TypeError: `columns` is no `Columns`.

    Warns:
        TorchidWarning: messages of a bag without time stamps, duplicate messages, channels that are NaN in some, or
            gaps that are filled.
    """
    if columns is not None and not isinstance(columns, Columns):
        raise TypeError(f"columns: found {type(columns).__name__}; accepted: torchid.Columns(joint_position=...)")
    with during("reading", os.fspath(path)):
        part = split_range(path)
        kept = _last_file.get()
        read = kept.read if kept is not None and isinstance(part.range, Recording) else _read_raw
        raw = read(path, topics, progress, columns, bridge_gaps_s, needs_flags)
        raw = raw if part.range is None else _cut(raw, part.range)
        return build_log(bridge_gaps(about_world_origin(raw), bridge_gaps_s), allow_gaps)


@contextmanager
def files_of_recordings_kept() -> Iterator[None]:
    """Keep the last file in memory, so that successive recordings of it (`walk.npz[#0:40]`) read it once."""
    token = _last_file.set(_LastFile())
    try:
        yield
    finally:
        _last_file.reset(token)


class _LastFile:
    """The fields of the file that was read last: of one file alone, whose recordings are parts of its memory."""

    def __init__(self) -> None:
        self._key: object = None
        self._raw = dict[str, NDArray[Any]]()

    def read(self, path: str | os.PathLike[str], *how: Any) -> dict[str, NDArray[Any]]:
        """As `_read_raw`, of the same file read in the same way what is there."""
        file = split_range(path).file
        state = os.stat(file) if os.path.exists(file) else None
        key = (file, state and (state.st_ino, state.st_size, state.st_mtime_ns), how)
        if key != self._key:
            self._key = None
            self._raw = {}  # before the next: there is never more than one
            self._raw = _read_raw(path, *how)
            self._key = key
        return dict(self._raw)


_last_file: ContextVar[_LastFile | None] = ContextVar("last file", default=None)


def read_recordings(
    path: str | os.PathLike[str], topics: Topics | None = None, columns: Columns | None = None
) -> list[Log]:
    """The recordings of a log, with their gaps: several if stamps start again, as for episodes in one file.

    Args:
        path: as of `read_log`.
        topics: likewise.
        columns: likewise.

    Raises:
        LogError: likewise.
    """
    if split_range(path).range is not None:
        return [read_log(path, topics, allow_gaps=True, columns=columns)]
    with during("reading", os.fspath(path)):
        raw = _read_raw(path, topics, None, columns, None, True)
        starts = recording_starts(_stamps(raw))
        if len(starts) == 1:
            return [build_log(raw, allow_gaps=True)]
    logs = []
    for number in range(len(starts)):
        recording = Recording(f"[#{number}]", number)
        with during("reading", f"{os.fspath(path)}{recording.text}"):
            logs.append(build_log(_cut(raw, recording), allow_gaps=True))
    return logs


def _read_raw(
    path: str | os.PathLike[str],
    topics: Topics | None,
    progress: Callable[[float], None] | None,
    columns: Columns | None,
    bridge_gaps_s: float | None,
    needs_flags: bool,
) -> dict[str, NDArray[Any]]:
    """The fields of all of a file, or of several, as they are there."""
    part = split_range(path)
    check = partial(check_fields_given, needs_flags=needs_flags)
    kind = existing_log_kind(part.file)
    if kind is LogKind.ARRAYS:
        return _read_arrays(part.file, columns, check)
    if kind is LogKind.JOINED:
        raw = read_joined(part.files, columns, partial(_read_one, bridge_gaps_s))
    elif kind is LogKind.TABLE:
        raw = read_table(part.file, columns)
    else:
        raw = read_bag(part.file, topics, progress, needs_flags)
    check(raw)
    return raw


def build_log(raw: dict[str, NDArray[Any]], allow_gaps: bool = False) -> Log:
    """The log of the fields of a file, in canonical frames and orders; LogError for invalid fields."""
    return _to_canonical(_check_values(about_world_origin(raw), allow_gaps))


_PLATE_WRENCH = WRENCHES[1]


def about_world_origin(raw: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The fields of a file with moments about the world's origin, m + p x f, where it has the points p of these.

    A centre of pressure is a point p; only the vertical component of m, the free moment, is then not 0. Moments about a
    point that does not move are linear in what a plate measures: they can be interpolated and filtered, which a centre
    of pressure cannot, and no motion is needed for them.

    Nothing acts without a force: where this is exactly 0, or the contact is not active, a point may be NaN and a moment
    of NaN is then 0. Elsewhere a moment about an unknown point is not known, NaN.

    Args:
        raw: arrays by field; afterwards the points are the world's origin.

    Raises:
        LogError: points or wrenches of another shape, or points that are infinite.
    """
    if POINTS not in raw or _PLATE_WRENCH not in raw:
        return raw
    check_shape("time", raw["time"], SHAPES["time"], {})
    samples = {"N": len(raw["time"])}
    check_shape(_PLATE_WRENCH, raw[_PLATE_WRENCH], SHAPES[_PLATE_WRENCH], samples)
    check_shape(POINTS, raw[POINTS], SHAPES[POINTS], samples | {"C": raw[_PLATE_WRENCH].shape[1]})
    wrench = to_float64(_PLATE_WRENCH, raw[_PLATE_WRENCH])
    points = to_float64(POINTS, raw[POINTS])
    if not points.any():
        return raw
    force = wrench[..., :3]
    moment = wrench[..., 3:]
    idle = (force == 0.0).all(axis=2)
    unknown = ~np.isfinite(points).all(axis=2)
    check_finite(POINTS, np.where(idle[..., None], 0.0, points), allow_nan=True)
    with np.errstate(invalid="ignore", over="ignore"):  # infinite forces are refused with the log
        arms = np.where((idle | ~points.any(axis=2))[..., None], 0.0, np.cross(points, force))
    moved = moment + arms
    if FLAGS in raw and raw[FLAGS].shape == idle.shape:
        idle = idle | (raw[FLAGS] == 0)
    moved[(idle & unknown)[..., None] & np.isnan(moved)] = 0.0
    return raw | {_PLATE_WRENCH: np.concatenate([force, moved], axis=2), POINTS: np.zeros_like(points)}


def _cut(raw: dict[str, NDArray[Any]], range_: TimeRange | Recording) -> dict[str, NDArray[Any]]:
    """The fields of a file with the samples of a part alone; LogError where their numbers differ."""
    time = _stamps(raw)
    samples = range_.select(time)
    out = dict(raw)
    for name, array in raw.items():
        if field_shape(name)[:1] == ("N",):
            if array.shape[:1] != time.shape:
                raise LogError.at_field(name, f"shape {array.shape}", f"{len(time)} samples, as in time")
            out[name] = array[samples]
    return out


def _stamps(raw: dict[str, NDArray[Any]]) -> FloatArray:
    """Stamps (N,) [s], which may begin anew."""
    check_shape("time", raw["time"], SHAPES["time"], {})
    return to_float64("time", raw["time"])


def check_fields_given(names: Collection[str], needs_flags: bool = True) -> None:
    """Raise LogError for missing fields, and for invalid combinations; `needs_flags` as in `read_log`."""
    for name in REQUIRED:
        if name not in names:
            raise LogError.at_field(name, "missing", f"a log with {', '.join(REQUIRED)}")
    _check_combination(names, needs_flags)


def _read_one(bridge_gaps_s: float | None, path: Path, columns: Columns | None) -> dict[str, NDArray[Any]]:
    """The fields of one of several files of a log, whose gaps no spline to the stamps of others can cross."""
    is_table = existing_log_kind(path) is LogKind.TABLE
    raw = read_table(path, columns) if is_table else _read_arrays(path, columns, None)
    return bridge_gaps(about_world_origin(raw), bridge_gaps_s) if "time" in raw else raw


def _read_arrays(
    path: Path, columns: Columns | None, check: Callable[[Collection[str]], None] | None
) -> dict[str, NDArray[Any]]:
    """The arrays of a .npz or HDF5 file; all names are checked first."""
    with open_container(path) as container:

        def load(name: str) -> NDArray[Any]:
            with reader_errors_explained(name, ARRAY_ACCEPTED):
                return require_plain(name, arrays.load(name))

        def take(name: str) -> NDArray[Any]:
            return load_part(name, names, load)

        arrays = EpisodeArrays(list(container.declared_bytes()), container.load, columns)
        names = arrays.names
        mapped = match_arrays(columns, names, load)
        if check is not None:
            check(mapped.given)
        raw = mapped.read(take)
        if columns is None:
            return raw
        if "time" in raw:
            rows = next(iter(raw["joint_position"].shape if "joint_position" in raw else ()), 0)
            raw["time"] = arrays.stamps(raw["time"], rows, mapped.step is not None)
        if others := {name: read_stamps(entry, load) for name, entry in mapped.other_times(names).items()}:
            return align_by_stamps(raw, {name: mapped.sources_of(name) for name in mapped.fields}, others)
        return raw


def _check_combination(names: Collection[str], needs_flags: bool) -> None:
    """Raise LogError on fields that exclude each other, or that need a field that is missing."""
    for first, second in EXCLUSIVE:
        if first in names and second in names:
            raise LogError.at_field(first, f"given together with {second}", "one of the two")
    for name, required in REQUIRED_WITH.items():
        missing = [field for field in required if field not in names and (needs_flags or field != FLAGS)]
        if name in names and missing:
            accepted = f"{missing[0]} in the log"
            if missing[0] == FLAGS and name in CONTACT_READINGS:
                accepted += ", or preprocessing.contact_threshold in an experiment file"
            raise LogError.at_field(name, f"given without {missing[0]}", accepted)
    for name, canonical in VARIANTS.items():
        if name in names and not is_quaternion(name) and not any(map(is_quaternion, names)):
            accepted = f"base_quat_wxyz or base_quat_xyzw in the log, or {canonical}"
            raise LogError.at_field(name, "given without the base's orientation", accepted)


def _check_values(raw: dict[str, NDArray[Any]], allow_gaps: bool) -> dict[str, Any]:
    """All fields of the file in their canonical types, with shapes and values checked."""
    names = {name: parse_names(name, raw[name]) if name in raw else () for name in NAME_FIELDS}
    time = parse_time(raw["time"])
    sizes = {"N": len(time)} | {NAME_FIELDS[name]: len(labels) for name, labels in names.items()}
    fields: dict[str, Any] = {**names, "time": time}
    if "imu_frame" in raw:
        fields["imu_frame"] = parse_frame("imu_frame", raw["imu_frame"])
    for name, array in raw.items():
        if name in fields:
            continue
        check_shape(name, array, field_shape(name), sizes)
        labels = column_labels(name, names)
        if name == FLAGS:
            fields[name] = parse_flags(name, array, labels)
            continue
        values = to_float64(name, array)
        may_be_nan = allow_gaps or name in (*NAN_ALLOWED, NORMALS)
        if not may_be_nan and np.isnan(values).any():
            refuse_gaps(name, values, time, labels)
        check_finite(name, values, allow_nan=may_be_nan, labels=labels)
        fields[name] = normalize_quaternions(name, values, allow_gaps) if is_quaternion(name) else values
    if NORMALS in fields and not allow_gaps:
        active = fields.get(FLAGS, np.zeros(fields[NORMALS].shape[:2], dtype=bool))
        fields[NORMALS] = normalize_normals(fields[NORMALS], active, names["contact_names"])
    return fields


def _to_canonical(fields: dict[str, Any]) -> Log:
    """The log with the variants of the file converted to canonical order and frames."""
    fields["moments_about_world_origin"] = fields.pop(POINTS, None) is not None
    if "base_quat_wxyz" in fields:
        fields["base_quat_xyzw"] = np.roll(fields.pop("base_quat_wxyz"), -1, axis=1)
    if "base_quat_xyzw" in fields:
        quat: FloatArray = make_sign_continuous(fields["base_quat_xyzw"])
        fields["base_quat_xyzw"] = quat
        for name, canonical in VARIANTS.items():
            if name in fields:
                rotate = rotate_to_world if name.endswith("_base") else rotate_to_base
                fields[canonical] = rotate(quat, fields.pop(name))
    return Log(source=current_file(), **fields)


def write_log(log: Log, path: str | os.PathLike[str]) -> None:
    """Write `log` to a .npz, .h5, .hdf5, .csv or .parquet file, from which `read_log` returns the same log.

    The file is written under a temporary name in its folder, then renamed.

    Raises:
        LogError: the extension is unknown or the file cannot be written.
    """
    save = save_table if new_log_kind(Path(path)) is LogKind.TABLE else save_arrays
    arrays: dict[str, NDArray[Any]] = {
        name: array
        for name, array in log.arrays().items()
        if 0 not in array.shape[1:] or name == "joint_position"  # empty fields are not written
    }
    for name, names in log.names.items():
        if names or name == "joint_names":
            arrays[name] = np.array(names, dtype=np.str_)
    if log.moments_about_world_origin:
        arrays[POINTS] = np.zeros((len(log), len(log.contact_names), 3))
    if log.imu_frame:
        arrays["imu_frame"] = np.array(log.imu_frame)
    with about_file(os.fspath(path)):
        save(Path(path), arrays)
