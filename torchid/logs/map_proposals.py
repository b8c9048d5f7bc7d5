"""A proposed map of foreign columns, from their names and some of their numbers."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.column_families import Family, find_families
from torchid.logs.column_map import PLACEHOLDER
from torchid.logs.column_proposals import OF_PLATES, is_desired, propose_field, threshold
from torchid.logs.column_samples import Columns, stated_names
from torchid.logs.columns import is_column
from torchid.logs.joint_orders import JOINT_ORDERS, MOTORS, suitable_orders, usual_order
from torchid.logs.log import SHAPES, VARIANTS
from torchid.logs.name_matching import SUFFIXES, KnownRobot, match_names
from torchid.logs.units import IN_DEGREES, UNITS, quantities_of, quantities_with, unit_factor

_GAINS = re.compile(r"\b(kp|kd)\b", re.IGNORECASE)
_FORCE = re.compile(r"force|(?<![a-z])f\{axis", re.IGNORECASE)
_MOMENT = re.compile(r"moment|torque|(?<![a-z])[mt]\{axis", re.IGNORECASE)
_SIDEWAYS = re.compile(r"(?<![a-z])(f[xy]|m[xyz])(?![a-z])", re.IGNORECASE)  # components that tell of no contact
_FOOT = re.compile(r"foot|feet", re.IGNORECASE)
_LAW = {"joint_position": "position", "joint_velocity": "velocity", "joint_torque": "feed_forward"}
_STEP = (2e-4, 0.2)  # [s]: of recordings
_TURNED = 7.0  # [rad]: no joint's position is as large throughout
_LEVER = 1.0  # [m]: rms of no torque is as large as that of the robot's weight with it
_FAR = 60.0  # [m]: no base is recorded as far away
_SORTED = 0.9  # of the steps of stamps, forwards
_TOUCH = 0.05  # of the robot's weight, what a contact bears at least


@dataclass
class MapProposal:
    """What `logs.columns`, or `logs.topics`, may say of a log.

    Attributes:
        columns: the map, as it stands in a file.
        notes: what was guessed, by key.
        left_out: columns that it ignores.
        key: columns or topics.
        fields: of the log, that a map of topics gives.
        lacking: joints of the robot without columns, if most have some.
        partial: by field that is left out for it, joints that have columns of other fields alone.
    """

    columns: dict[str, Any] = field(default_factory=dict)
    key: str = "columns"
    fields: set[str] = field(default_factory=set)
    notes: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    partial: dict[str, list[str]] = field(default_factory=dict)


def propose_map(
    sample: Columns, robot: KnownRobot, files: Sequence[Collection[str]] = (), in_degrees: Collection[str] = ()
) -> MapProposal:
    """Sort foreign columns into fields of a log by what they are called and what is in them.

    Args:
        sample: from `read_sample`.
        robot: whose log it is.
        files: columns of each of several files that are one log, whose stamps may differ in name.
        in_degrees: columns of files whose header says that angles are in degrees.
    """
    native = [name for name in sample if is_column(name) or name in (*SHAPES, *VARIANTS)]
    foreign = [name for name in sample if name not in native]
    return _Proposer(sample, native, robot, files, in_degrees).propose(foreign)


class _Proposer:
    def __init__(
        self,
        sample: Columns,
        native: Sequence[str],
        robot: KnownRobot,
        files: Sequence[Collection[str]],
        in_degrees: Collection[str],
    ) -> None:
        self.sample, self.native, self.robot, self.files = sample, native, robot, files
        self.in_degrees = in_degrees
        self.joints, self.feet = robot.joints, robot.feet
        self.given = {name.partition(".")[0] for name in native}
        self.out = MapProposal()
        stated = stated_names(sample, "joint_names")
        self.names_stated = bool(stated) and set(stated) <= set(self.joints)
        self.named_joints = set(stated) if self.names_stated else set[str]()
        self.joint_suffix = ""
        self.factors: dict[str, float] = {}  # of units that columns state, by key

    def propose(self, foreign: Sequence[str]) -> MapProposal:
        numeric = [name for name in foreign if self._is_numeric(name)]
        families, more = find_families(numeric, self.robot)
        self.out.columns |= {f"{kind}_name": pattern for kind, pattern in more.items()}
        self.joint_suffix = more.get("joint", "").removeprefix("{joint}")
        self.named_joints = self.named_joints or self._all_named(families)
        self.out.lacking = [name for name in self.joints if self.named_joints and name not in self.named_joints]
        used: list[Family] = [one for one in families if self._place(one)]
        if "joint_torque" not in {*self.given, *self.out.columns}:
            used += self._place_law([one for one in families if one not in used])
        if set(wrench := self.out.columns.get("contact_wrench_local", {})) == {"moment"}:  # of no use without forces
            used = [one for one in used if not one.entry.items() <= wrench["moment"].items()]
            del self.out.columns["contact_wrench_local"]
        if "contact_wrench_local" in self.out.columns and "contact_active" not in {*self.given, *self.out.columns}:
            self.out.columns["contact_active"] = {"above": float(f"{_TOUCH * self.robot.weight:.2g}")}
            self.out.notes["contact_active"] = f"above {_TOUCH:.0%} of the URDF's weight [N], by the wrenches"
        taken = {column for one in used for column in one.columns}
        self.out.left_out = [name for name in foreign if name not in taken]
        ignored = {_anything(one.pattern) for one in families if one not in used}
        ignored |= {name for name in foreign if not self._is_numeric(name)}
        ignored |= {_anything(one.pattern) for one in used if len(one.numbers) > len(self.joints)}
        if ignored:
            self.out.columns["ignore"] = sorted(ignored)
        with np.errstate(all="ignore"):  # of numbers that no unit explains
            self._add_units()
        return self.out

    def _is_numeric(self, name: str) -> bool:
        values = self.sample[name]
        return values is not None and values.dtype.kind in "fiub"

    # ----------------------------------------------------------------------------------------------------- fields

    def _place(self, family: Family) -> bool:
        """Whether a family has become an entry."""
        if is_desired(family.words) or _GAINS.search(family.words.replace("_", " ")):
            return False
        name = self._field(family)
        if name == "contact_wrench_local" and len(family.axes) == 3:
            return self._place_force(family)
        if name == "time" and name in self.out.columns:
            return self._place_other_time(family)
        if not name or name in self.given or name in self.out.columns or not self._fits(family, name):
            return False
        entry: dict[str, Any] = family.entry
        if (first := min(family.numbers, default=0)) > 0:
            entry["first_index"] = first
        if name == "base_quat_wxyz":
            name = self._quaternion(family)
            if "imu" in family.words.lower():
                self.out.notes[name] = "of the IMU, taken to be that of the base link; " + self.out.notes.get(name, "")
        if name == "contact_active":
            self._add_threshold(family, entry)
        self._add_order(family, name)
        self._add_stated_unit(family, entry, name, quantities_of(name))
        self.out.columns[name] = entry
        return True

    def _place_other_time(self, family: Family) -> bool:
        """Whether a family is the stamps of a file that has none yet."""
        others = self.out.columns.get("other_times", [])
        known = [entry["column"] for entry in (self.out.columns["time"], *others)]
        ours = [given for given in self.files if family.columns[0] in given]
        if not ours or any(column in given for given in ours for column in known) or not self._fits(family, "time"):
            return False
        entry: dict[str, Any] = family.entry
        self._add_stated_unit(family, entry, "other_times", ("time",))
        self.out.columns["other_times"] = [*others, entry]
        return True

    def _joints_of(self, family: Family) -> set[str]:
        """Joints of the robot that a family names."""
        if "{joint}" not in family.pattern:
            return set()
        return set(family.by_name) or {f"{name}{self.joint_suffix}" for name in family.names if name}

    def _all_named(self, families: Sequence[Family]) -> set[str]:
        """Joints that any column names, if more than half of them; none where columns name fewer."""
        named = {name for one in families for name in self._joints_of(one)}
        return named if 2 * len(named) > len(self.joints) else set()

    def _field(self, family: Family) -> str:
        """The field that a family probably is."""
        name, axes = propose_field(family.words), len(family.axes) == 3
        if not name and "time" in quantities_with(family.unit) and self._increases(family.columns[0]):
            return "time"
        of_foot = "{contact}" in family.pattern or _FOOT.search(family.words) is not None
        of_force = name == "contact_force_normal" or _FORCE.search(family.pattern) or _MOMENT.search(family.pattern)
        if axes and of_foot and of_force:
            return "contact_wrench_local"
        if of_foot and (_SIDEWAYS.search(family.words) or quantities_with(family.unit)[:1] == ("torque",)):
            return ""
        if name == "contact_force_normal" or (not name and of_foot):
            return "contact_active"  # as a threshold: what it is in newtons nobody knows
        return "base_position_world" if name == "joint_position" and axes and not any(family.names) else name

    def _increases(self, column: str) -> bool:
        values = self.sample[column]
        return (
            values is not None and values.ndim == 1 and len(values) > 2 and bool((np.diff(values) > 0).mean() > _SORTED)
        )

    def _fits(self, family: Family, name: str) -> bool:
        """Whether a family has as many columns as a field."""
        first = self.sample[family.columns[0]]
        if first is None or not first.ndim or name in OF_PLATES:
            return False
        inner = int(np.prod(first.shape[1:]))
        count = max(inner, len(family.columns)) if inner == 1 or len(family.columns) == 1 else 0
        if name == "time":
            return count == 1
        if ("{contact}" if name.startswith("joint_") else "{joint}") in family.pattern:
            return False
        if name.startswith("joint_"):
            return self._fits_joints(family, name, count)
        if name.startswith("contact_wrench"):
            return count == 6 * len(self.feet)
        if name.startswith("contact_"):
            return count == len(self.feet) > 0 and not any(family.axes)
        axes = "".join(sorted(family.axes)).lower()
        return count == (4 if "quat" in name else 3) and (not axes or axes == ("wxyz" if "quat" in name else "xyz"))

    def _fits_joints(self, family: Family, field: str, count: int) -> bool:
        """Whether a family has a column for each joint, or for each that positions are there of."""
        named = self._joints_of(family)
        slots = {MOTORS[JOINT_ORDERS[name].message] for name in suitable_orders(self.joints)}
        if named:
            whole = named == (self.named_joints or set(self.joints))
            if not whole and 2 * len(named) > len(self.joints):
                self.out.partial[field] = [x for x in self.joints if x in self.named_joints - named]
        else:
            whole = count in (len(self.joints), *slots, *([len(self.named_joints)] if self.names_stated else []))
        enough = count >= len(self.joints) if family.numbers else whole
        return enough and len(self.joints) > 0 and not any(family.axes)

    def _place_force(self, family: Family) -> bool:
        """Whether a family is the forces or the moments of contacts."""
        wrench = self.out.columns.setdefault("contact_wrench_local", {})
        part = "moment" if _MOMENT.search(family.pattern) else "force"
        complete = "".join(sorted(family.axes)).lower() == "xyz" and len(family.columns) == 3 * len(self.feet)
        if part in wrench or not complete or "contact_wrench_local" in self.given:
            if not wrench:
                del self.out.columns["contact_wrench_local"]
            return False
        wrench[part] = family.entry
        quantity = "torque" if part == "moment" else "force"
        self._add_stated_unit(family, wrench[part], f"contact_wrench_local.{part}", (quantity,))
        self.out.notes["contact_wrench_local"] = "taken to act on the robot, along the axes of the contact frames"
        self._add_order(family, "contact_wrench_local")
        return True

    def _place_law(self, families: Sequence[Family]) -> list[Family]:
        """Families of a PD law, if there are gains."""
        law: dict[str, Any] = {}
        used = []
        for family in families:
            words = family.words.replace("_", " ").lower()
            gain, what = _GAINS.search(words), propose_field(family.words, desired=True)
            key = gain[1].lower() if gain else _LAW.get(what, "")
            if key and key not in law and (gain or self._fits(family, what)):
                law[key] = family.entry
                if not gain:
                    self._add_stated_unit(family, law[key], f"joint_torque.pd.{key}", quantities_of(what))
                used.append(family)
        if "kp" not in law or "position" not in law:
            return []
        self.out.columns["joint_torque"] = {"pd": law}
        self.out.notes["joint_torque"] = "of the PD law that the columns belong to, as no torque was recorded"
        return used

    def _quaternion(self, family: Family) -> str:
        """The order of a quaternion whose components have numbers: w is the largest of a base that stands upright."""
        if any(family.axes):
            return "base_quat_xyzw" if family.axes[0] in "xX" else "base_quat_wxyz"
        values = [self.sample[column] for column in family.columns]
        flat = np.concatenate([np.atleast_2d(x).T if x.ndim == 1 else x for x in values if x is not None], axis=1)
        order = "xyzw" if np.nansum(np.abs(flat[:, 3])) > np.nansum(np.abs(flat[:, 0])) else "wxyz"
        self.out.notes[f"base_quat_{order}"] = "order of components, with w as the largest"
        return f"base_quat_{order}"

    def _add_threshold(self, family: Family, entry: dict[str, Any]) -> None:
        values = np.concatenate([np.ravel(x) for c in family.columns if (x := self.sample[c]) is not None])
        if not np.isin(values, (0, 1)).all():
            entry["above"] = threshold(values)
            self.out.notes["contact_active"] = "threshold, from the range of the readings"

    def _add_order(self, family: Family, name: str) -> None:
        """An order of names by number, where columns have none."""
        kind = next((kind for kind in SUFFIXES if name.startswith(f"{kind}_")), "")
        key = f"{kind}_order"
        if not kind or any(family.names) or key in self.out.columns or (kind == "joint" and self.names_stated):
            return
        first = self.sample[family.columns[0]]
        numbers = len(family.numbers) or (1 if first is None else int(np.prod(first.shape[1:2])))
        order, how = self._listed_order(kind, numbers) or usual_order(kind, self.robot, numbers)
        self.out.columns[key] = order
        self.out.notes[key] = f"{how}; compare it with the manual of the robot, and with what torchid check says"

    def _listed_order(self, kind: str, count: int) -> tuple[list[str], str] | None:
        """Names of joints or feet that some array of the file lists."""
        known = self.joints if kind == "joint" else self.feet
        for name in self.sample:
            listed = [] if self._is_numeric(name) or self.sample[name] is None else stated_names(self.sample, name)
            matched = match_names(listed, known, kind) if len(listed) == count == len(known) else {}
            if len(matched) == len(known) > 0:
                return [matched[text] for text in listed], f"as '{name}' of the file lists them"
        return None

    # ------------------------------------------------------------------------------------------------------ units

    def _add_stated_unit(self, family: Family, entry: dict[str, Any], key: str, quantities: tuple[str, ...]) -> None:
        """The unit in the names of columns, for the field that they are; a note where it is none of that field."""
        if not family.unit and quantities and quantities[0] in IN_DEGREES and family.columns[0] in self.in_degrees:
            self.factors[key] = unit_factor(key, IN_DEGREES[quantities[0]], quantities)
            self.out.notes[key] = f"{IN_DEGREES[quantities[0]]}, as the file's header says (inDegrees=yes)"
        if not family.unit or not quantities:
            return
        if not set(quantities) & set(quantities_with(family.unit)):
            known = " or ".join(quantities)
            self.out.notes[key] = f"unit '{excerpt(family.unit)}' of its columns is none of {known}; give it as unit"
            return
        self.factors[key] = unit_factor(key, family.unit, quantities)
        if self.factors[key] != 1.0:
            entry["unit"] = family.unit

    def _add_units(self) -> None:
        """Units other than SI that columns do not state, where the numbers say so."""
        time = self._values("time")
        if time is None or len(time) < 3:
            return
        step = float(np.median(np.diff(time[:, 0])))
        unit = next((u for u in ("s", "ms", "us", "ns") if _STEP[0] <= step * UNITS["time"][u] <= _STEP[1]), "s")
        self._set_unit("time", unit, f"from steps of {step:.3g}")
        seconds = time[:, 0] * self.factors.get("time", UNITS["time"][unit])
        position, velocity = self._values("joint_position"), self._values("joint_velocity")
        factor, is_stated = self.factors.get("joint_position", 1.0), "joint_position" in self.factors
        if position is not None and not is_stated and np.nanpercentile(np.abs(position), 98) > _TURNED:
            self._set_unit("joint_position", "deg", f"from values up to {np.nanmax(np.abs(position)):.3g}")
            factor = UNITS["angle"]["deg"]
        if position is not None and velocity is not None and not self.files:  # whose stamps may differ
            self._add_speed_unit(velocity, factor * position, seconds)
        for name, is_it, unit, why in (
            ("joint_torque", lambda x: _rms(x) > _LEVER * self.robot.weight, "N mm", "as they are too large for N m"),
            ("base_position_world", lambda x: np.nanmax(np.abs(x)) > _FAR, "mm", "as it is too far away for m"),
            ("imu_specific_force", lambda x: 0.7 < _length(x) < 1.4, "g", "as its length is about 1"),
            ("imu_angular_velocity", lambda x: _rms(x) > 20.0, "deg/s", "as it is too fast for rad/s"),
        ):
            values = self._values(name)
            if values is not None and is_it(values):
                self._set_unit(name, unit, why)

    def _add_speed_unit(
        self, velocity: NDArray[np.float64], position: NDArray[np.float64], seconds: NDArray[np.float64]
    ) -> None:
        if position.shape != velocity.shape:
            return
        slope = np.gradient(position, seconds, axis=0)
        ratio = float(np.sqrt(np.nanmean(velocity**2) / max(float(np.nanmean(slope**2)), 1e-12)))
        units = {unit: 1.0 / UNITS["angular velocity"][unit] for unit in ("rad/s", "deg/s", "rpm", "rev/s")}
        unit = min(units, key=lambda unit: abs(np.log(max(ratio, 1e-9) / units[unit])))
        self._set_unit("joint_velocity", unit, f"as they are {ratio:.3g} times the slope of the positions")

    def _set_unit(self, name: str, unit: str, why: str) -> None:
        entry = self.out.columns.get(name)
        if name in self.factors or unit == _si(name):
            return
        if isinstance(entry, dict) and {"column", "columns"} & set(entry):
            entry["unit"] = unit
            self.out.notes[name] = "; ".join(filter(None, (f"{unit}, {why}", self.out.notes.get(name))))

    def _values(self, name: str) -> NDArray[np.float64] | None:
        """Numbers (N, k) of an entry, in the order of its columns."""
        entry = self.out.columns.get(name)
        if not isinstance(entry, dict) or not {"column", "columns"} & set(entry):
            return None
        if "columns" in entry:
            return self._flat([x for column in entry["columns"].values() if (x := self.sample[column]) is not None])
        text = re.escape(entry["column"])
        text = re.sub(r"\\{(joint|contact)\\}", ".+", text)
        text = re.sub(r"\\{index(:\d+)?\\}", r"\\d+", re.sub(r"\\{(axis|AXIS)\\}", "[wxyzWXYZ]", text))
        found = [x for column, x in self.sample.items() if x is not None and x.size and re.fullmatch(text, column)]
        return self._flat(found)

    def _flat(self, found: Sequence[NDArray[Any]]) -> NDArray[np.float64] | None:
        """Numbers (N, k) of columns or arrays; None where they are none."""
        flat = [np.asarray(x, dtype=float).reshape(len(x), -1) for x in found]
        values = np.concatenate(flat, axis=1) if flat and len({len(x) for x in flat}) == 1 else np.zeros((0, 1))
        return values if np.isfinite(values).any() else None


def _si(name: str) -> str:
    return {"time": "s", "joint_velocity": "rad/s"}.get(name, "")


def _rms(x: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(x**2)))


def _length(x: NDArray[np.float64]) -> float:
    return float(np.nanmedian(np.linalg.norm(x, axis=1)))


def _anything(pattern: str) -> str:
    return PLACEHOLDER.sub("*", pattern)
