"""What columns say of a base: its position, its orientation, and the frame that its recorded velocities are in."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.column_map import PLACEHOLDER
from torchid.logs.log import FloatArray
from torchid.logs.name_matching import BASES, is_desired, words_of
from torchid.logs.quaternion import angular_velocity_base, make_sign_continuous, rotate_to_base, rotate_to_world
from torchid.logs.units import quantities_of, quantities_with, split_unit, unit_factor
from torchid.proposals.column_groups import Family, MapProposal
from torchid.proposals.file_samples import FileSample, side_by_side

_UNIT = 1e-3  # of the length of quaternions from 1
_STEPS = 0.1  # of the range of a path: as large no step of one is, in the median
_CLEAR = 0.05  # of a mean cosine, by which one order of a quaternion is better than the other
_PLACE = {"p", "pos", "position", "positions", "xyz", "r", "loc", "location", "translation", "trans", "lage"}
_TURN = {"q", "e", "o", "ori", "orient", "orientation", "quat", "quaternion", "rot", "rotation", "attitude"}
_LINEAR, _ANGULAR, _SPEED = {"linear", "lin"}, {"angular", "ang", "omega", "w"}, {"vel", "velocity", "v"}
_MESSAGE = {"pose", "twist"}
#: Fields of the base beside its orientation: their quantities, and words of which all, and some, are in their names.
_BESIDE: tuple[tuple[str, str, set[str], set[str]], ...] = (
    ("base_position_world", "length", _PLACE, set()),
    ("base_linear_velocity_world", "velocity", _LINEAR | _SPEED, set()),
    ("base_angular_velocity_base", "angular velocity", _ANGULAR | _SPEED, _ANGULAR),
)
_WHOSE = re.compile(
    rf"{BASES}|floating|state|states|data|pose|world|robot|est|"
    r"estimated?|meas|measured|link|vicon|optitrack|ground|truth|gt|global|"
    r"basis|rumpf"
)


def field_of_base(family: Family, sample: FileSample) -> str:
    """The field of the base that three or four numbers are whose names say little, by their values; "" for none.

    Names say that something is a position, or nothing beside its axes, and of nothing else than the base whose it is:
    `X`, `Y`, `Z`, or `pos_0` to `pos_2`. Positions are a path, quaternions of length 1 throughout.
    """
    if {"{joint}", "{contact}"} & set(re.findall(r"\{\w+\}", family.pattern)) or is_desired(family.words):
        return ""
    values = side_by_side(sample, family.columns)
    if values.dtype.kind not in "fiu" or values.ndim < 2 or len(values) < 3:
        return ""
    numbers = np.asarray(values, dtype=float).reshape(len(values), -1)
    words = words_of(family.stem)
    other = {word for word in words if not _WHOSE.fullmatch(word)}
    axes = "".join(sorted(family.axes)).lower()
    if numbers.shape[1] == 3 and axes in ("", "xyz") and family.unit_may_be("length"):
        named = other <= _PLACE and (bool(other) or axes == "xyz")
        return "base_position_world" if named and _is_path(numbers) else ""
    if numbers.shape[1] == 4 and axes in ("", "wxyz") and not family.unit:
        named = other <= _TURN and (bool(other) or axes == "wxyz")
        return "base_quat_wxyz" if named and _is_unit(numbers) else ""
    return ""


def field_beside(family: Family, quaternion: str, sample: FileSample) -> str:
    """The field of the base that three numbers are which belong to a quaternion by their names; "" for none.

    Positions are a path; in which frame velocities are, and whether they are its slope, is not looked at here.

    Args:
        family: of three columns, or of an array.
        quaternion: columns of a map: `state.quat[{index}]`, beside which `state.p[{index}]` is the position;
            `pose/orientation/{axis}`, beside which `twist/linear/{axis}` is a velocity.
        sample: of the file.
    """
    words, of_turn = (words_of(PLACEHOLDER.sub(" ", split_unit(x)[0])) for x in (family.pattern, quaternion))
    whose = [word for word in of_turn if word not in _TURN | _MESSAGE]
    values = side_by_side(sample, family.columns)
    numbers = values.reshape(len(values), -1) if values.ndim and values.dtype.kind in "fiu" else np.empty((0, 0))
    if numbers.shape[1:] != (3,) or "".join(sorted(family.axes)).lower() not in ("", "xyz"):
        return ""
    for field, quantity, own, needed in _BESIDE:
        rest = [word for word in words if word not in own | _MESSAGE]
        is_beside = rest == whose and (bool(rest) or any(family.axes))
        if is_beside and (not needed or needed & set(words)) and family.unit_may_be(quantity):
            return field if field != _BESIDE[0][0] or _is_path(numbers.astype(float)) else ""
    return ""


def _is_path(numbers: FloatArray) -> bool:
    """Whether numbers (N, 3) change in small steps."""
    with np.errstate(all="ignore"):
        spread = np.nanmax(np.ptp(numbers, axis=0))
        return bool(
            spread > 0.0 and np.nanmax(np.nanmedian(np.abs(np.diff(numbers, axis=0)), axis=0)) < _STEPS * spread
        )


def _is_unit(numbers: FloatArray) -> bool:
    length = np.linalg.norm(numbers, axis=1)
    known = length[np.isfinite(length)]
    return bool(len(known)) and float(np.abs(known - 1.0).max()) < _UNIT


def field_of_quaternion(family: Family, sample: FileSample, force: NDArray[Any] | None, notes: dict[str, str]) -> str:
    """The field of a quaternion in the order that it has, with a note where its numbers say so; `force` as below."""
    stated = re.search("xyzw|wxyz", family.words.lower())
    order = stated[0] if stated else "xyzw" if family.axes[0] in ("x", "X") else "wxyz"
    if not stated and not any(family.axes):
        arrays = [x for column in family.columns if (x := sample[column]) is not None]
        order, why = order_of_quaternion(arrays, force)
        notes[f"base_quat_{order}"] = f"order of components, {why}"
    return f"base_quat_{order}"


def order_of_quaternion(arrays: Sequence[NDArray[Any]], force: NDArray[Any] | None = None) -> tuple[str, str]:
    """Order of a quaternion's components, as columns or as an array, and why.

    That by which gravity is where an accelerometer reads it; else that by which the base is more upright; else, as of a
    heading near 0, that with the largest w.

    Args:
        arrays: (N,) each, or (N, 4).
        force: (N, 3), specific force in any unit, if there is one.
    """
    flat = np.concatenate([np.asarray(x, dtype=float).reshape(len(x), -1) for x in arrays], axis=1)
    up = {"wxyz": vertical_in_base(np.roll(flat, -1, axis=1)), "xyzw": vertical_in_base(flat)}
    vertical = np.tile([0.0, 0.0, 1.0], (len(flat), 1))
    for along, why in (
        (force, "by which gravity is where the accelerometer reads it"),
        (vertical, "by which it is upright"),
    ):
        if along is None or np.shape(along) != vertical.shape:
            continue
        with np.errstate(all="ignore"):
            direction = along / np.linalg.norm(along, axis=1, keepdims=True)
            alike = {order: float(np.nanmean((axis * direction).sum(axis=1))) for order, axis in up.items()}
        best = max(alike, key=lambda order: alike[order])
        if max(alike.values()) - min(alike.values()) > _CLEAR:
            return best, why
    is_last = np.nansum(np.abs(flat[:, 3])) > np.nansum(np.abs(flat[:, 0]))
    return ("xyzw" if is_last else "wxyz"), "with w as the largest"


def vertical_in_base(quat_xyzw: FloatArray) -> FloatArray:
    """The world's z axis (N, 3) in the base frame, of quaternions (N, 4)."""
    x, y, z, w = quat_xyzw.T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)


_NAMES = ("roll", "pitch", "yaw")
_OTHER_NAMES = {
    "roulis": "roll", "tangage": "pitch", "lacet": "yaw", "nickwinkel": "pitch", "gierwinkel": "yaw",
    "nick": "pitch", "gier": "yaw",
    "balanceo": "roll", "cabeceo": "pitch", "guinada": "yaw",
}  # fmt: skip
_ANGLE = re.compile(rf"(?<![a-z])({'|'.join([*_NAMES, *_OTHER_NAMES])})(?![a-z])", re.IGNORECASE)
_TRIPLE = re.compile(r"(?<![a-z])(rpy|euler\w*?)(?![a-z])", re.IGNORECASE)
#: Words beside these in names of what turns the base, rather than a joint or a rate.
_BESIDE_ANGLES = re.compile(
    rf"({BASES}|floating|imu|ahrs|euler|rpy|orientation|attitude|angles?|"
    r"state|states|data|pose|world|robot|est|estimated?|meas|measured|link|sensor|rotation|rot|value|x|y|z)"
)
_LARGEST = 6.5  # [rad]: of no angle within a turn
_UPRIGHT = 1.6  # [rad]: roll or pitch of a base that stands or hangs upright are less


@dataclass(frozen=True)
class Angles:
    """Columns of angles of the base.

    Attributes:
        entry: of a map.
        columns: that it has.
        note: what was guessed.
    """

    entry: dict[str, Any]
    columns: list[str]
    note: str


def find_angles(sample: FileSample, names: Sequence[str]) -> Angles | None:
    """Roll, pitch and yaw of the base, as three columns or as an array (N, 3); None where no names say so.

    Args:
        sample: from `read_sample`.
        names: of columns that may be.
    """
    known = {name: x for name in names if (x := sample[name]) is not None and not is_desired(name)}
    arrays = [[name] for name, x in known.items() if _TRIPLE.search(name) and x.shape[1:] == (len(_NAMES),)]
    for columns in (*_triples(list(known)), *arrays):
        stem, unit = split_unit(columns[0])
        of_angle = not unit or "angle" in quantities_with(unit)
        if of_angle and all(_BESIDE_ANGLES.fullmatch(word) for word in words_of(_ANGLE.sub("", _TRIPLE.sub("", stem)))):
            return _angles({name: known[name] for name in columns}, unit)
    return None


def _triples(names: Sequence[str]) -> list[list[str]]:
    """Three columns each that differ in the name of an angle, or in an axis or a number behind `rpy` or `euler`."""
    by_stem: dict[str, dict[str, str]] = {}
    for name in names:
        if (found := _ANGLE.search(name)) is not None:
            word = found[1].lower()
            by_stem.setdefault(_ANGLE.sub("*", name, count=1), {})[_OTHER_NAMES.get(word, word)] = name
    out = [[of[one] for one in _NAMES] for of in by_stem.values() if set(of) == set(_NAMES)]
    behind: dict[str, list[str]] = {}
    for name in names:
        if _TRIPLE.search(name) and (found := re.search(r"[xyz\d](?=\W*$)", split_unit(name)[0])) is not None:
            behind.setdefault(name[: found.start()], []).append(name)
    return out + [sorted(of) for of in behind.values() if len(of) == len(_NAMES) and _in_turn(sorted(of))]


def _in_turn(names: Sequence[str]) -> bool:
    """Whether names of one length differ in characters that follow one another."""
    if len({len(name) for name in names}) > 1:
        return False
    changed = [[(a, b) for a, b in zip(*pair, strict=True) if a != b] for pair in pairwise(names)]
    return all(len(of) == 1 and ord(of[0][1]) == ord(of[0][0]) + 1 for of in changed)


def _angles(values: Mapping[str, NDArray[Any]], unit: str) -> Angles:
    columns = list(values)
    one = len(columns) == 1
    entry: dict[str, Any] = {"column": columns[0]} if one else {"columns": dict(zip(_NAMES, columns, strict=True))}
    note = "angles of the base about the world's x, then y, then z, as in a URDF"
    if unit:
        entry["unit"] = unit
    elif (largest := float(np.nanmax([np.nanmax(np.abs(x), initial=0.0) for x in values.values()]))) > _LARGEST:
        entry["unit"] = "deg"
        note += f"; deg, from values up to {largest:.3g}"
    elif (tilt := float(np.nanmax(np.abs(side_by_side(values, columns)[:, :2]), initial=0.0))) > _UPRIGHT:
        entry["unit"] = "deg"
        note += f"; deg, as a base that is tilted by {tilt:.3g} rad would have fallen"
    else:
        note += f"; rad, as none exceeds {_LARGEST}"
    return Angles(entry, columns, note)


_AVERAGED = 0.1  # [s]: over which velocities are compared, for the noise of slopes
_LIKE, _BETTER = 0.5, 0.8  # error of a velocity that is the slope, and of one frame in the other's, at most


def settle_velocities(proposal: MapProposal, values: Callable[[str], FloatArray | None], seconds: FloatArray) -> None:
    """Give the velocities of a base in a proposed map the frame that they are in.

    Those that are the slope of its pose in no frame are left out: the pose alone gives velocities.

    Args:
        proposal: changed in place.
        values: numbers (N, k) of an entry, as the file has them.
        seconds: the stamps (N,).
    """
    columns, notes = proposal.columns, proposal.notes
    step = float(np.median(np.diff(seconds)))
    width = max(1, round(_AVERAGED / step)) if step > 0.0 else 1
    for kind, slopes in _slopes(columns, values, seconds).items():
        for name in [x for frame in slopes if (x := f"base_{kind}_velocity_{frame}") in columns]:
            recorded = _in_si(name, columns, values)
            if recorded is None or recorded.shape != slopes["world"].shape:
                continue
            known = np.isfinite(np.hstack([recorded, slopes["world"]])).all(axis=1)
            if known.sum() <= width:
                continue
            errors = {frame: _error(recorded[known], slope[known], width) for frame, slope in slopes.items()}
            best, other = sorted(errors, key=lambda frame: errors[frame])
            if errors[best] > _LIKE:
                notes[name] = "left out, as it is the slope of the base's pose along no axes"
                proposal.leave_out(name)
            elif errors[best] < _BETTER * errors[other]:
                _rename(columns, notes, name, f"base_{kind}_velocity_{best}", f"along the axes of the {best}")


def _rename(columns: dict[str, Any], notes: dict[str, str], old: str, new: str, why: str) -> None:
    """Another key of an entry, in its place."""
    if old != new:
        entries = [(new if key == old else key, entry) for key, entry in columns.items() if key != new]
        columns.clear()
        columns.update(entries)
        notes[new] = "; ".join(filter(None, (notes.pop(old, ""), f"{why}, by the slope of the base's pose")))


def _in_si(name: str, columns: dict[str, Any], values: Callable[[str], FloatArray | None]) -> FloatArray | None:
    found, entry = values(name), columns.get(name, {})
    if found is None or isinstance(entry.get("unit"), dict):
        return None
    return found * (unit_factor(name, entry["unit"], quantities_of(name)) if "unit" in entry else 1.0)


def _slopes(
    columns: dict[str, Any], values: Callable[[str], FloatArray | None], seconds: FloatArray
) -> dict[str, dict[str, FloatArray]]:
    """Linear and angular velocity (N, 3) [m/s, rad/s] along each axes, NaN in samples without the pose for them."""
    quat = values("base_quat_xyzw")
    if quat is None and (wxyz := values("base_quat_wxyz")) is not None and wxyz.shape[1] == 4:
        quat = np.roll(wxyz, -1, axis=1)
    if quat is None or quat.shape != (len(seconds), 4) or len(seconds) < 3 or not (np.diff(seconds) > 0.0).all():
        return {}
    quat = make_sign_continuous(quat)
    rate = angular_velocity_base(quat, _slope(quat, seconds))
    out = {"angular": {"world": rotate_to_world(quat, rate), "base": rate}}
    position = _in_si("base_position_world", columns, values)
    if position is not None and position.shape == (len(seconds), 3):
        slope = _slope(position, seconds)
        out["linear"] = {"world": slope, "base": rotate_to_base(quat, slope)}
    return out


def _slope(values: FloatArray, seconds: FloatArray) -> FloatArray:
    """Derivatives (N, k) across gaps, which stay NaN."""
    known, out = np.isfinite(values).all(axis=1), np.full_like(values, np.nan)
    if known.sum() > 1:
        out[known] = np.gradient(values[known], seconds[known], axis=0)
    return out


def _error(recorded: FloatArray, slope: FloatArray, width: int) -> float:
    """Relative rms error of recorded velocities, both averaged over some samples."""
    box = np.full(width, 1.0 / width)
    both = (recorded, slope)
    a, b = (np.stack([np.convolve(x, box, "valid") for x in of.T], axis=1) for of in both)
    return float(np.sqrt(np.nanmean((a - b) ** 2) / max(float(np.nanmean(b**2)), 1e-12)))
