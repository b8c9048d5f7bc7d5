"""Several files of one recording, each with stamps of its own, as one log."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, about_file
from torchid.logs.alignment import Series, stamp_slack
from torchid.logs.arrays import parse_names
from torchid.logs.column_map import Columns
from torchid.logs.column_matching import columns_by_file
from torchid.logs.columns import KINDS, names_field
from torchid.logs.containers import LogKind, existing_log_kind, open_container
from torchid.logs.gaps import refuse_gaps
from torchid.logs.log import (
    NAME_FIELDS,
    NAN_ALLOWED,
    NORMALS,
    SHAPES,
    FloatArray,
    check_finite,
    check_shape,
    check_time,
    field_shape,
    to_float64,
)
from torchid.logs.tables import sample_table
from torchid.logs.time_range import LogFile

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
    for file, own in zip(files, maps, strict=True):
        with about_file(os.fspath(file.path)):
            parts.append(_stamped(read(file.path, own), file.shift_s))
    paths = [file.path for file in files]
    _require_once(paths, parts)
    time = _common_stamps(paths, [part["time"] for part in parts])
    names = _common_names(parts)
    out: Fields = {}
    for path, part in zip(paths, parts, strict=True):
        with about_file(os.fspath(path)):
            out |= _aligned(_in_order(part, names), time, parts[0]["time"][0])
    return out | {name: np.array(of, dtype=np.str_) for name, of in names.items()} | {"time": time}


def _maps(paths: Sequence[Path], columns: Columns | None) -> list[Columns | None]:
    """The entries of a map that each file has columns of."""
    if columns is None:
        return [None for _ in paths]
    given = []
    for path in paths:
        with about_file(os.fspath(path)):
            given.append(_names_in(path))
    return columns_by_file(columns, given, [path.name for path in paths])


def _names_in(path: Path) -> list[str]:
    """Columns of a table, or names of the arrays of a file."""
    if existing_log_kind(path) is LogKind.TABLE:
        return list(sample_table(path))
    with open_container(path) as container:
        return list(container.declared_bytes())


def _stamped(raw: Fields, shift_s: float) -> Fields:
    """The fields of a file, those that have anything in them, with its stamps (K,) [s] in the clock of the log."""
    if "time" not in raw:
        raise LogError.at_field("time", "missing", "stamps in each of several files of a log")
    check_shape("time", raw["time"], SHAPES["time"], {})
    time = to_float64("time", raw["time"])
    check_time(time)
    out = {name: x for name, x in raw.items() if name not in NAME_FIELDS}
    out |= {name: np.array(of, np.str_) for name in NAME_FIELDS if name in raw and (of := parse_names(name, raw[name]))}
    if "joint_names" not in out and 0 in out.get("joint_position", time).shape[1:]:
        del out["joint_position"]  # what a table without joints has
    for name, array in out.items():
        if field_shape(name)[:1] == ("N",):
            check_shape(name, array, field_shape(name), {"N": len(time)})
    return out | {"time": time + shift_s if shift_s else time}


def _require_once(paths: Sequence[Path], parts: Sequence[Fields]) -> None:
    """Refuse a field of two files."""
    owners: dict[str, Path] = {}
    for path, part in zip(paths, parts, strict=True):
        for name in part:
            if name in owners and name not in ("time", *NAME_FIELDS):
                found = f"both in {owners[name].name} and in {path.name}"
                raise LogError.at_field(name, found, "every field but time in one of several files alone")
            owners.setdefault(name, path)


def _common_stamps(paths: Sequence[Path], stamps: Sequence[FloatArray]) -> FloatArray:
    """The stamps of the first file within the time that all cover."""
    time = stamps[0]
    slack = stamp_slack(time)
    late = max(range(len(paths)), key=lambda number: stamps[number][0])
    early = min(range(len(paths)), key=lambda number: stamps[number][-1])
    common = time[(time >= stamps[late][0] - slack) & (time <= stamps[early][-1] + slack)]
    if not len(common):
        found = f"no stamp of {paths[0].name} that all files cover: "
        found += f"{paths[late].name} starts at {stamps[late][0]:.6f} s, "
        found += f"{paths[early].name} ends at {stamps[early][-1]:.6f} s"
        raise LogError.at_field("time", found, "stamps of one clock, or shift_s, what is added to those of a file")
    return common


def _common_names(parts: Sequence[Fields]) -> dict[str, list[str]]:
    """Names of joints, contacts and sensors in the order of the first file that has them."""
    names: dict[str, list[str]] = {}
    for part in parts:
        for field in NAME_FIELDS:
            if field in part:
                names.setdefault(field, part[field].tolist())
    return names


def _in_order(part: Fields, names: Mapping[str, list[str]]) -> Fields:
    """The fields of a file with samples, their columns in the order of the log's names."""
    out = {name: x for name, x in part.items() if name not in NAME_FIELDS}
    for field, common in names.items():
        own = part[field].tolist() if field in part else common
        if own == common:
            continue
        if differing := sorted(set(own) ^ set(common)):
            found = f"'{differing[0]}' {'missing' if differing[0] in common else 'here alone'}"
            raise LogError.at_field(field, found, f"the same {KINDS[field]}s in all files of a log, in any order")
        order = [own.index(name) for name in common]
        out |= {name: x[:, order] for name, x in out.items() if names_field(name) == field and x.ndim > 1}
    return out


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
