"""What numbers of foreign columns say of themselves, where nobody stated it: units, turns, rotations."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.column_proposals import BASES, is_desired, words_of
from torchid.logs.file_samples import FileSample, side_by_side
from torchid.logs.gaps import turn_jumps
from torchid.logs.units import UNITS, quantities_with, split_unit

_STEP = (2e-4, 0.2)  # [s]: of recordings
_STEP_NAME = re.compile(r"(sim_?|control_?)?(dt|time_?step)(_s)?", re.IGNORECASE)
_TURN_S, _ALIKE = 0.3, 0.5  # over which gravity is seen to turn [s], and correlation with the angular velocity
_TURNED = 7.0  # [rad]: no joint's position is as large throughout
_LEVER = 1.0  # [m]: rms of no torque is as large as that of the robot's weight with it
_FAR = 60.0  # [m]: no base is recorded as far away
_FREE = 0.02  # of a turn, to either side of where it begins
_STARTS = (-0.5, -0.25, -0.75, 0.25)  # of a turn, where it may begin
_POSITION = "joint_position"
_TURNS = {"rad": 2.0 * np.pi, "deg": 360.0, "rev": 1.0, "mrad": 2e3 * np.pi}

Numbers = NDArray[np.float64]


def step_of_stamps(sample: FileSample) -> tuple[str, float] | None:
    """The name and the value [s] of a number that is the step between samples, of a recording without stamps."""
    for name, values in sample.items():
        if values is None or not values.size or values.dtype.kind not in "fiu" or not _STEP_NAME.fullmatch(name):
            continue
        step = float(np.ravel(values)[0])
        if _STEP[0] <= step <= _STEP[1] and (np.ravel(values) == step).all():
            return name, step
    return None


class UnitProposer:
    """Adds units to the entries of a map, with a note for each."""

    def __init__(self, sample: FileSample, columns: dict[str, Any], notes: dict[str, str], stated: Mapping[str, float]):
        """Of a map that is being made.

        Args:
            sample: from `read_sample`.
            columns: the map.
            notes: what was guessed, by key.
            stated: factors of units that columns state, by key.
        """
        self._sample, self._columns, self._notes, self._stated = sample, columns, notes, stated

    def propose(self, weight: float, one_clock: bool) -> None:
        """Add units that are not SI units, and where turns begin.

        Args:
            weight: of the robot [N].
            one_clock: whether all columns have the same stamps.
        """
        seconds = self._seconds()
        if seconds is None:
            return
        position, velocity = self._values(_POSITION), self._values("joint_velocity")
        factor = self._stated.get(_POSITION, 1.0)
        if position is not None:
            turned = _POSITION not in self._stated and np.nanpercentile(np.abs(position), 98) > _TURNED
            if turned:
                self._set(_POSITION, "deg", f"from values up to {np.nanmax(np.abs(position)):.3g}")
                factor = UNITS["angle"]["deg"]
            self._add_turn(position)
        self._add_native_turn()
        if position is not None and velocity is not None and one_clock:
            self._add_speed(velocity, factor * position, seconds)
        if one_clock:
            self._add_rate(seconds)
        for name, is_it, unit, why in (
            ("joint_torque", lambda x: _rms(x) > _LEVER * weight, "N mm", "as they are too large for N m"),
            ("base_position_world", lambda x: np.nanmax(np.abs(x)) > _FAR, "mm", "as it is too far away for m"),
            ("imu_specific_force", lambda x: 0.7 < _length(x) < 1.4, "g", "as its length is about 1"),
            ("imu_angular_velocity", lambda x: _rms(x) > 20.0, "deg/s", "as it is too fast for rad/s"),
        ):
            values = self._values(name)
            if values is not None and is_it(values):
                self._set(name, unit, why)

    def _seconds(self) -> Numbers | None:
        """The stamps (N,) [s]; also those of a column called `time` that has another unit."""
        if step := self._columns.get("time", {}).get("step"):
            position = self._values(_POSITION)
            return None if position is None else step * np.arange(len(position))
        native = "time" not in self._columns and self._sample.get("time") is not None
        time = self._flat([self._sample["time"]]) if native else self._values("time")  # type: ignore[list-item]
        if time is None or len(time) < 3:
            return None
        if (column := self._columns.get("time", {}).get("nanoseconds")) is not None:
            more = self._flat([self._sample[column]])  # type: ignore[list-item]
            time = time if more is None else time + 1e-9 * more
        step = float(np.median(np.diff(time[:, 0])))
        unit = next((u for u in ("s", "ms", "us", "ns") if _STEP[0] <= step * UNITS["time"][u] <= _STEP[1]), "s")
        if native and unit != "s" and self._columns:
            self._columns["time"] = {"column": "time"}
        self._set("time", unit, f"from steps of {step:.3g}")
        return np.asarray(time[:, 0] * self._stated.get("time", UNITS["time"][unit]))

    def _add_native_turn(self) -> None:
        """An entry for positions [rad] with names of the format, if they jump by a turn."""
        named = [x for x in self._sample if x == _POSITION or x.startswith(f"{_POSITION}.")]
        values = self._flat([x for name in named if (x := self._sample[name]) is not None])
        if values is None or _POSITION in self._columns or not turn_jumps(values).any():
            return
        self._columns[_POSITION] = {"column": _POSITION if named == [_POSITION] else f"{_POSITION}.{{joint}}"}
        self._add_turn(values)
        if "turn_from" not in self._columns[_POSITION]:
            del self._columns[_POSITION]

    def _add_turn(self, position: Numbers) -> None:
        """Where the turn begins that angles are in, where encoders jump by one."""
        entry = self._columns[_POSITION]
        of_file = 2.0 * np.pi / self._stated.get(_POSITION, 1.0)  # in degrees, of a file that says so
        turn = _TURNS.get(str(entry["unit"]).lower(), 0.0) if "unit" in entry else of_file
        if not turn or not turn_jumps(position, turn).any():
            return
        phase = np.mod(position / turn, 1.0)
        for start in (*_STARTS, _middle_of_gap(phase)):
            away = np.abs(np.mod(phase - start + 0.5, 1.0) - 0.5)
            if np.nanmin(away) > _FREE:
                entry["turn_from"] = float(f"{start * turn:.4g}")
                self._note(_POSITION, f"turns begin at {entry['turn_from']:g}, as angles jump by a whole turn")
                return
        self._note(_POSITION, "angles jump by a whole turn, and none of them stays within one: unwrap them")

    def _add_speed(self, velocity: Numbers, position: Numbers, seconds: Numbers) -> None:
        if position.shape != velocity.shape:
            return
        slope = np.gradient(position, seconds, axis=0)
        slope = np.where(np.abs(slope) * np.median(np.diff(seconds)) > 1.0, np.nan, slope)  # a jump of a turn
        ratio = float(np.sqrt(np.nanmean(velocity**2) / max(float(np.nanmean(slope**2)), 1e-12)))
        units = {unit: 1.0 / UNITS["angular velocity"][unit] for unit in ("rad/s", "deg/s", "rpm", "rev/s")}
        unit = min(units, key=lambda unit: abs(np.log(max(ratio, 1e-9) / units[unit])))
        self._set("joint_velocity", unit, f"as they are {ratio:.3g} times the slope of the positions")

    def _add_rate(self, seconds: Numbers) -> None:
        """The unit of an IMU's angular velocity, by how fast its specific force, almost gravity, turns in its frame."""
        force, rate = self._values("imu_specific_force"), self._values("imu_angular_velocity")
        if force is None or rate is None or not force.shape == rate.shape == (len(seconds), 3):
            return
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        step = float(np.median(np.diff(seconds)))
        turned = np.cumsum(-np.cross(rate, up) * step, axis=0)
        lag = min(max(1, round(_TURN_S / step)), len(seconds) - 1)
        expected, found = turned[lag:] - turned[:-lag], up[lag:] - up[:-lag]
        ratio = np.nansum(expected * found) / max(float(np.nansum(expected**2)), 1e-12)
        alike = np.nansum(expected * found) / np.sqrt(np.nansum(expected**2) * np.nansum(found**2) + 1e-12)
        if alike > _ALIKE and ratio < np.sqrt(UNITS["angle"]["deg"]):
            why = f"as gravity turns {ratio:.2g} times as fast as in rad/s"
            self._set("imu_angular_velocity", "deg/s", why)

    def _set(self, name: str, unit: str, why: str) -> None:
        entry = self._columns.get(name)
        if name in self._stated or unit == {"time": "s", "joint_velocity": "rad/s"}.get(name, ""):
            return
        if isinstance(entry, dict) and {"column", "columns"} & set(entry):
            entry["unit"] = unit
            self._note(name, f"{unit}, {why}")

    def _note(self, name: str, text: str) -> None:
        self._notes[name] = "; ".join(filter(None, (text, self._notes.get(name))))

    def _values(self, name: str) -> Numbers | None:
        """Numbers (N, k) of an entry, in the order of its columns."""
        entry = self._columns.get(name)
        if not isinstance(entry, dict) or not {"column", "columns"} & set(entry):
            return None
        if "columns" in entry:
            return self._flat([x for column in entry["columns"].values() if (x := self._sample[column]) is not None])
        text = re.escape(entry["column"])
        text = re.sub(r"\\{(joint|contact)\\}", ".+", text)
        text = re.sub(r"\\{index(:\d+)?\\}", r"\\d+", re.sub(r"\\{(axis|AXIS)\\}", "[wxyzWXYZ]", text))
        found = [x for column, x in self._sample.items() if x is not None and x.size and re.fullmatch(text, column)]
        return self._flat(found)

    def _flat(self, found: Sequence[NDArray[Any]]) -> Numbers | None:
        """Numbers (N, k) of columns or arrays; None where they are none."""
        flat = [np.asarray(x, dtype=float).reshape(len(x), -1) for x in found]
        values = np.concatenate(flat, axis=1) if flat and len({len(x) for x in flat}) == 1 else np.zeros((0, 1))
        return values if np.isfinite(values).any() else None


def _middle_of_gap(phase: Numbers) -> float:
    """The middle of the widest part of a turn, from -0.5 to 0.5, that no angle is in, of phases in turns."""
    known = np.sort(phase[np.isfinite(phase)])
    gaps = np.diff(known, append=known[0] + 1.0)
    return float((known[gaps.argmax()] + 0.5 * gaps.max() + 0.5) % 1.0 - 0.5)


def _rms(x: Numbers) -> float:
    return float(np.sqrt(np.nanmean(x**2)))


def _length(x: Numbers) -> float:
    return float(np.nanmedian(np.linalg.norm(x, axis=1)))


_NAMES = ("roll", "pitch", "yaw")
_OTHER_NAMES = {"roulis": "roll", "tangage": "pitch", "lacet": "yaw", "nickwinkel": "pitch", "gierwinkel": "yaw"}
_ANGLE = re.compile(rf"(?<![a-z])({'|'.join([*_NAMES, *_OTHER_NAMES])})(?![a-z])", re.IGNORECASE)
_TRIPLE = re.compile(r"(?<![a-z])(rpy|euler\w*?)(?![a-z])", re.IGNORECASE)
#: Words beside these in names of what turns the base, rather than a joint or a rate.
_BESIDE_ANGLES = re.compile(
    rf"({BASES}|floating|imu|ahrs|euler|rpy|orientation|attitude|angles?|state|states|data|pose|world|robot|est|"
    r"estimated?|meas|measured|link|sensor|rotation|rot|value|x|y|z)"
)
_LARGEST = 6.5  # [rad]: of no angle within a turn
_UPRIGHT = 1.6  # [rad]: roll or pitch of a base that stands or hangs upright are less


def order_of_quaternion(arrays: Sequence[NDArray[Any]]) -> str:
    """Order of a quaternion's components, as columns or as an array: w is the largest of a base that stands upright."""
    flat = np.concatenate([np.atleast_2d(x).T if x.ndim == 1 else x for x in arrays], axis=1)
    return "xyzw" if np.nansum(np.abs(flat[:, 3])) > np.nansum(np.abs(flat[:, 0])) else "wxyz"


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
