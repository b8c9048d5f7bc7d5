"""What numbers of foreign columns say of themselves, where it is not stated: units, turns, axes of forces, contacts."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.column_entries import FRACTIONS
from torchid.logs.gaps import turn_jumps
from torchid.logs.log import FLAGS, FORCE_NORMAL
from torchid.logs.name_matching import words_of
from torchid.logs.unitree import names_by_number
from torchid.logs.units import OF_JOINTS, UNITS, split_unit, unit_factor
from torchid.proposals.base import vertical_in_base
from torchid.proposals.file_samples import FileSample, stated_names
from torchid.rounding import STD_PER_MAD

_STEP = (2e-4, 0.2)  # [s]: of recordings
_STEP_NAME = re.compile(r"(\w+_|sim|control)?(dt|time_?step|duration|period)(_s)?", re.IGNORECASE)
_TURN_S, _ALIKE = 0.3, 0.5  # over which gravity is seen to turn [s], and correlation with the angular velocity
_SLOPE = 0.15  # of the logarithm of the ratio of velocities to slopes of positions, that a unit explains
_TURNED = 7.0  # [rad]: no joint's position is as large throughout
_MOST_DEGREES = 720.0  # whole numbers up to which may be angles
_LEVER = 1.0  # [m]: rms of no torque is as large as that of the robot's weight with it
_OTHER_WEIGHT = 0.3  # by which a robot's weight may differ from its file's, of forces in N
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


def unit_of_step(step: float) -> str:
    """The unit of stamps, by the step between them."""
    return next((unit for unit in ("s", "ms", "us", "ns") if _STEP[0] <= step * UNITS["time"][unit] <= _STEP[1]), "s")


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

    def propose(self, weight: float, one_clock: bool, slides: Collection[str] = ()) -> Numbers | None:
        """Add units that are not SI units, and where turns begin; the stamps (N,) [s], None where these are not known.

        Args:
            weight: of the robot [N].
            one_clock: whether all columns have the same stamps.
            slides: joints that are prismatic.
        """
        seconds = self.seconds()
        if seconds is None:
            return None
        position, velocity = self.values(_POSITION), self.values("joint_velocity")
        if position is not None:
            names = self._joints(_POSITION, position.shape[1])
            slide = np.isin(names, list(slides))
            if _POSITION not in self._stated:
                self._add_position_unit(position, slide)
            self._add_turn(position)
            if velocity is not None and one_clock and not self._are_counts(position):
                self._add_speed(velocity, position * self._position_factors(names), seconds, slide)
        self._add_native_turn()
        if one_clock:
            self._add_rate(seconds)
        for name, is_it, unit, why in (
            ("joint_torque", lambda x: _rms(x) > _LEVER * weight, "N mm", "as they are too large for N m"),
            ("base_position_world", lambda x: np.nanmax(np.abs(x)) > _FAR, "mm", "as it is too far away for m"),
            ("imu_specific_force", lambda x: 0.7 < _length(x) < 1.4, "g", "as its length is about 1"),
            ("imu_angular_velocity", lambda x: _rms(x) > 20.0, "deg/s", "as it is too fast for rad/s"),
        ):
            values = self.values(name)
            if values is not None and is_it(values):
                self._set(name, unit, why)
        self._add_normal_forces(weight)
        return seconds

    def _add_normal_forces(self, weight: float) -> None:
        """Forces along the ground's normal, of readings with a threshold that say so and together carry the robot."""
        entry, readings = self._columns.get(FLAGS, {}), self.values(FLAGS)
        names = list(entry.get("columns", {}).values() or [entry.get("column", "")])
        is_turned = any(name.startswith("base_quat") for name in (*self._columns, *self._sample))
        if not ("above" in entry and readings is not None and is_turned and _all_say_normal(names)):
            return
        unit = split_unit(names[0])[1]
        factor = UNITS["force"].get(unit or "N", np.nan)
        if abs(factor * np.nanmedian(np.nansum(readings, axis=1)) / weight - 1.0) < _OTHER_WEIGHT:
            self._columns[FORCE_NORMAL] = entry | ({"unit": unit} if unit not in ("", "N") else {})
            self._columns[FLAGS] = {"above": float(f"{factor * self._columns[FORCE_NORMAL].pop('above'):.2g}")}
            how = "sensors: {joint_torques: ['*'], contact_wrenches: {FOOT: [fn]}}"
            self._note(FORCE_NORMAL, f"as its name says, and it carries the robot; to fit it, too, {how}")

    def _joints(self, name: str, count: int) -> list[str]:
        """Joints by column of an entry, as many as there are columns; "" for each where the map does not say."""
        entry, unknown = self._columns[name], [""] * count
        if "columns" in entry:
            return list(entry["columns"])
        if "{joint}" in entry["column"]:
            before, _, after = entry["column"].partition("{joint}")
            fits = [x for x in self._sample if x.startswith(before) and x.endswith(after)]
            spelled = self._columns.get("joint_name", "{joint}")
            names = [spelled.replace("{joint}", x[len(before) : len(x) - len(after)]) for x in fits]
        else:
            names = names_by_number(self._columns.get("joint_order", stated_names(self._sample, "joint_names")))
        return names if len(names) == count else unknown

    def _add_position_unit(self, position: Numbers, slide: NDArray[np.bool_]) -> None:
        """Units of positions by how large those of hinges and slides are."""
        if self._are_counts(position):
            self._note(_POSITION, "whole numbers, as of an encoder: give scale, 2π over the counts of a turn")
            return
        found = dict[str, str]()
        for unit, where in (("deg", ~slide), ("mm", slide)):
            some = np.abs(position[:, where])
            if np.isfinite(some).any() and np.nanpercentile(some, 98) > _TURNED:
                found[unit] = f"from values up to {np.nanmax(some):.3g}"
        if not found:
            return
        if not slide.any():
            self._set(_POSITION, "deg", found["deg"])
            return
        names = zip(self._joints(_POSITION, position.shape[1]), slide, strict=True)
        of_slides = {name: "mm" if "mm" in found else "m" for name, is_slide in names if is_slide}
        self._columns[_POSITION]["unit"] = ({"*": "deg"} if "deg" in found else {}) | of_slides
        self._note(_POSITION, ", ".join(f"{unit}, {why}" for unit, why in found.items()))

    @staticmethod
    def _are_counts(position: Numbers) -> bool:
        """Whether positions are whole numbers beyond those of angles in degrees."""
        return bool((np.mod(position, 1.0) == 0.0).all() and np.abs(position).max() > _MOST_DEGREES)

    def _units(self, name: str) -> dict[str, str]:
        """Units of an entry by pattern."""
        unit = self._columns[name].get("unit", {})
        return dict(unit) if isinstance(unit, dict) else {"*": unit}

    def _position_factors(self, names: Sequence[str]) -> Numbers:
        """What positions of joints are multiplied by, (n,) or ()."""
        units = self._units(_POSITION)
        if not units:
            return np.array(self._stated.get(_POSITION, 1.0))
        of_names = (units.get(name, units.get("*", "rad")) for name in names)
        return np.array([unit_factor(_POSITION, unit, OF_JOINTS[_POSITION]) for unit in of_names])

    def seconds(self) -> Numbers | None:
        """The stamps (N,) [s]; also those of a column called `time` that has another unit."""
        if step := self._columns.get("time", {}).get("step"):
            position = self.values(_POSITION)
            return None if position is None else step * np.arange(len(position))
        native = "time" not in self._columns and self._sample.get("time") is not None
        time = self._flat([self._sample["time"]]) if native else self.values("time")  # type: ignore[list-item]
        if time is None or len(time) < 3:
            return None
        for key, unit in FRACTIONS.items():
            if (column := self._columns.get("time", {}).get(key)) is not None:
                more = self._flat([self._sample[column]])  # type: ignore[list-item]
                time = time if more is None else time + UNITS["time"][unit] * more
        step = float(np.median(np.diff(time[:, 0])))
        if not step > 0.0:  # which nothing of what follows can be compared with
            return None
        if (unit := unit_of_step(step)) != "s" and native and self._columns:
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
        """Where the turn begins that angles are in, where encoders jump by one: one place for all, or by joint."""
        entry = self._columns[_POSITION]
        of_file = 2.0 * np.pi / self._stated.get(_POSITION, 1.0)  # in degrees, of a file that says so
        units = self._units(_POSITION)
        turn = _TURNS.get(units["*"].lower(), 0.0) if "*" in units else of_file
        names = self._joints(_POSITION, position.shape[1])
        turning = np.array([units.get(name, "") not in UNITS["length"] for name in names])
        jumping = turn_jumps(position, turn).any(axis=0) & turning if turn else np.zeros(len(names), dtype=bool)
        if not jumping.any():
            return
        start = _turn_start(position[:, turning], turn)
        by_joint = {name: _turn_start(x[:, None], turn) for name, x in zip(names, position.T, strict=True)}
        by_joint = {name: by_joint[name] for name, jumps in zip(names, jumping, strict=True) if jumps}
        if start is not None and turning.all():
            entry["turn_from"] = start
        elif all(by_joint) and None not in by_joint.values():
            entry["turn_from"] = by_joint
        else:
            found = "angles jump by a whole turn, and none of them stays within one: unwrap them"
            self._note(_POSITION, found)
            return
        starts = ", ".join(f"{x:g}" for x in dict.fromkeys(by_joint.values() if start is None else [start]))
        self._note(_POSITION, f"turns begin at {starts}, as angles jump by a whole turn")

    def _add_speed(self, velocity: Numbers, position: Numbers, seconds: Numbers, slide: NDArray[np.bool_]) -> None:
        """The unit of velocities, by the slope of positions [rad, m]."""
        if not position.shape == velocity.shape == (len(seconds), *position.shape[1:]):
            return
        slope = np.gradient(position, seconds, axis=0)
        slope = np.where(np.abs(slope) * np.median(np.diff(seconds)) > 1.0, np.nan, slope)  # a jump of a turn
        of_slides = self._speed_unit(velocity[:, slide], slope[:, slide], "velocity", ("m/s", "mm/s"))
        candidates = ("rad/s", "deg/s", "rpm", "rev/s")
        of_hinges = self._speed_unit(velocity[:, ~slide], slope[:, ~slide], "angular velocity", candidates)
        if "joint_velocity" not in self._stated and (of_hinges, of_slides) != ("rad/s", "m/s"):
            names = zip(self._joints(_POSITION, len(slide)), slide, strict=True)
            by_joint = {name: of_slides for name, is_slide in names if is_slide}
            self._columns["joint_velocity"]["unit"] = {"*": of_hinges} | by_joint if by_joint else of_hinges

    def _speed_unit(self, velocity: Numbers, slope: Numbers, quantity: str, candidates: Sequence[str]) -> str:
        """The unit of velocities of which the slope of positions is known [rad/s, m/s]; the first without any."""
        if not velocity.size or "joint_velocity" in self._stated:
            return candidates[0]
        ratio = float(np.sqrt(np.nanmean(velocity**2) / max(float(np.nanmean(slope**2)), 1e-12)))
        expected = {unit: 1.0 / UNITS[quantity][unit] for unit in candidates}
        unit = min(expected, key=lambda unit: abs(np.log(max(ratio, 1e-9) / expected[unit])))
        if abs(np.log(max(ratio, 1e-9) / expected[unit])) > _SLOPE:
            text = f"{ratio:.3g} times the slope of the positions, as no unit explains: are the stamps right?"
            self._note("joint_velocity", text)
            return candidates[0]
        if unit != candidates[0]:
            self._note("joint_velocity", f"{unit}, as they are {ratio:.3g} times the slope of the positions")
        return unit

    def _add_rate(self, seconds: Numbers) -> None:
        """The unit of an IMU's angular velocity, by how fast the vertical turns in its frame.

        By the base's quaternion; without one by the specific force, which is almost gravity.
        """
        rate, up = self.values("imu_angular_velocity"), self._vertical()
        if rate is None or up is None or not up.shape == rate.shape == (len(seconds), 3):
            return
        step = float(np.median(np.diff(seconds)))
        turned = np.cumsum(-np.cross(rate, up) * step, axis=0)
        lag = min(max(1, round(_TURN_S / step)), len(seconds) - 1)
        expected, found = turned[lag:] - turned[:-lag], up[lag:] - up[:-lag]
        ratio = np.nansum(expected * found) / max(float(np.nansum(expected**2)), 1e-12)
        alike = np.nansum(expected * found) / np.sqrt(np.nansum(expected**2) * np.nansum(found**2) + 1e-12)
        if alike > _ALIKE and ratio < np.sqrt(UNITS["angle"]["deg"]):
            why = f"as the vertical turns {ratio:.2g} times as fast as in rad/s"
            self._set("imu_angular_velocity", "deg/s", why)

    def _vertical(self) -> Numbers | None:
        """The world's z axis (N, 3) in the base or IMU frame, about; None where nothing says so."""
        for order in ("xyzw", "wxyz"):
            entry = self._columns.get(f"base_quat_{order}", {})
            if (
                "axis" not in entry.get("column", "axis").lower()
                and (quat := self.values(f"base_quat_{order}")) is not None
            ):
                return vertical_in_base(quat if order == "xyzw" else np.roll(quat, -1, axis=1))
        force = self.values("imu_specific_force")
        return None if force is None else force / np.linalg.norm(force, axis=1, keepdims=True)

    def _set(self, name: str, unit: str, why: str) -> None:
        entry = self._columns.get(name)
        if name in self._stated or unit == {"time": "s", "joint_velocity": "rad/s"}.get(name, ""):
            return
        if isinstance(entry, dict) and {"column", "columns"} & set(entry):
            entry["unit"] = unit
            self._note(name, f"{unit}, {why}")

    def _note(self, name: str, text: str) -> None:
        self._notes[name] = "; ".join(filter(None, (text, self._notes.get(name))))

    def values(self, name: str) -> Numbers | None:
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


def _all_say_normal(names: Sequence[str]) -> bool:
    """Whether all names of columns say that forces are those along the ground's normal."""
    return all({"fn", "normal", "vertical", "verticale"} & set(words_of(name)) for name in names)


def _turn_start(position: Numbers, turn: float) -> float | None:
    """Where a turn begins that all angles stay within; None where there is no such place."""
    phase = np.mod(position / turn, 1.0)
    for start in (*_STARTS, _middle_of_gap(phase)):
        away = np.abs(np.mod(phase - start + 0.5, 1.0) - 0.5)
        if np.nanmin(away) > _FREE:
            return float(f"{start * turn:.4g}")
    return None


def _middle_of_gap(phase: Numbers) -> float:
    """The middle of the widest part of a turn, from -0.5 to 0.5, that no angle is in, of phases in turns."""
    known = np.sort(phase[np.isfinite(phase)])
    gaps = np.diff(known, append=known[0] + 1.0)
    return float((known[gaps.argmax()] + 0.5 * gaps.max() + 0.5) % 1.0 - 0.5)


def _rms(x: Numbers) -> float:
    return float(np.sqrt(np.nanmean(x**2)))


def _length(x: Numbers) -> float:
    return float(np.nanmedian(np.linalg.norm(x, axis=1)))


# ------------------------------------------------------------------------------------------------------- forces at feet

_UPRIGHT = 0.96  # of the size of forces along z, of feet that walk
_AIR = 0.1  # of the way from the lowest to the highest reading: of a foot in the air
_SHARES = (0.05, 0.2)  # of that way, a threshold of contact: least and most
LEAST_GRAVITY = 0.25  # share of the power of an accelerometer's readings that their mean has
_STATES = 4  # at most, such as unknown, made and lost
_NOISE = 4.0  # standard deviations of readings in the air that it is above them


def point_along_z(forces: Any) -> bool:
    """Whether forces (N, ..., 3), or as many columns, point along z: in the world, as those of several small feet."""
    vectors = np.reshape(np.asarray(forces, dtype=float), (len(forces), -1, 3))
    with np.errstate(all="ignore"):
        upright = np.nansum(vectors[..., 2]) / np.nansum(np.linalg.norm(vectors, axis=2))
    return bool(abs(upright) > _UPRIGHT)


def gravity_share(readings: Any) -> float:
    """The share of the power of accelerations (N, 3) that their mean has: most of it where gravity is in them."""
    vectors = np.reshape(np.asarray(readings, dtype=float), (len(readings), -1))
    with np.errstate(all="ignore"):
        constant, size = np.nanmean(vectors, axis=0), np.nanmean(np.square(vectors), axis=0)
        return float(np.square(constant).sum() / size.sum())


def is_flags(values: Any) -> bool:
    """Whether numbers are zeros and ones, or truth values."""
    return bool(np.isin(values, (0, 1)).all())


def are_states(values: Any) -> bool:
    """Whether numbers are those of a few states, counted from 1: of which of them a foot touches nobody knows."""
    found = np.unique(np.asarray(values, dtype=float))
    return 2 <= len(found) <= _STATES and bool((found == np.arange(1, len(found) + 1)).all())


def threshold(readings: Any) -> float:
    """A reading above which a contact is probably active, in two digits.

    As low as the readings in the air allow: a foot that is taken to be in the air while it carries some weight
    falsifies the fit, one that is taken to stand in the air costs samples only.

    Args:
        readings: (N, C) of the sensors of C contacts, or all of them.
    """
    values = np.asarray(readings, dtype=float)
    if not np.isfinite(values).any():
        return 0.0
    low, high = np.percentile(values[np.isfinite(values)], (2, 98))
    least, most = (low + share * (high - low) for share in _SHARES)
    above = [least]
    for one in values.reshape(len(values), -1).T if values.ndim > 1 else [values]:
        air = one[one < low + _AIR * (high - low)]
        if len(air):  # its median, as a foot that lands or lifts off passes through
            middle = np.median(air)
            above.append(float(middle + _NOISE * STD_PER_MAD * np.median(np.abs(air - middle))))
    return float(f"{min(max(above), most):.2g}")
