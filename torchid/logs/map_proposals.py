"""A proposed map of foreign columns, from their names and some of their numbers."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.base_proposals import field_of_base, find_angles, order_of_quaternion
from torchid.logs.column_groups import Family, find_families, split_arrays, split_stamps
from torchid.logs.column_proposals import is_desired, propose_field
from torchid.logs.columns import is_column
from torchid.logs.field_matching import MOMENT, FieldMatcher
from torchid.logs.file_samples import FileSample, increases, listed_order, side_by_side, with_samples_first
from torchid.logs.joint_orders import JOINT_ORDERS, numbered_joints, usual_order
from torchid.logs.log import SHAPES, VARIANTS, WRENCHES
from torchid.logs.name_matching import SUFFIXES, KnownRobot
from torchid.logs.number_proposals import UnitProposer, are_states, point_along_z, step_of_stamps, threshold
from torchid.logs.units import IN_DEGREES, quantities_of, quantities_with, unit_factor

_GAINS = re.compile(r"\b(kp|kd)\b", re.IGNORECASE)
_LAW = {"joint_position": "position", "joint_velocity": "velocity", "joint_torque": "feed_forward"}
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
        like_torques: columns that no field takes, one for each joint, of a log without torques.
    """

    columns: dict[str, Any] = field(default_factory=dict)
    key: str = "columns"
    fields: set[str] = field(default_factory=set)
    notes: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    partial: dict[str, list[str]] = field(default_factory=dict)
    like_torques: list[Family] = field(default_factory=list)


def propose_map(
    sample: FileSample, robot: KnownRobot, files: Sequence[Collection[str]] = (), in_degrees: Collection[str] = ()
) -> MapProposal:
    """Sort foreign columns into fields of a log by what they are called and what is in them.

    Args:
        sample: from `read_sample`.
        robot: whose log it is.
        files: columns of each of several files that are one log, whose stamps may differ in name.
        in_degrees: columns of files whose header says that angles are in degrees.
    """
    sample, notes = with_samples_first(sample, len(robot.joints))
    out = _Proposer(sample, robot, files, in_degrees).propose()
    out.notes = notes | out.notes
    return out


class _Proposer:
    def __init__(
        self, sample: FileSample, robot: KnownRobot, files: Sequence[Collection[str]], in_degrees: Collection[str]
    ) -> None:
        self.sample, self.robot, self.files, self.in_degrees = dict(sample), robot, files, in_degrees
        self.match = FieldMatcher(self.sample, robot)
        self.joints, self.feet = robot.joints, robot.feet
        self.native = {name for name in sample if is_column(name) or name in (*SHAPES, *VARIANTS)}
        self.given = {name.partition(".")[0] for name in self.native}
        self.out = MapProposal()
        self.factors = dict[str, float]()  # of units that columns state, by key
        self.force: NDArray[Any] | None = None  # that an accelerometer reads

    def propose(self) -> MapProposal:
        foreign = [name for name in self.sample if name not in self.native]
        numeric = [name for name in foreign if (x := self.sample[name]) is not None and x.dtype.kind in "fiub"]
        families, more = find_families(numeric, self.robot)
        self.out.columns |= {f"{kind}_name": pattern for kind, pattern in more.items()}
        self.match.look_at(families, more)
        if named := self.match.named_joints:
            self.out.lacking = [name for name in self.joints if name not in named]
        of_force = (one for one in families if one.proposed == "imu_specific_force" and len(one.columns) in (1, 3))
        self.force = next((side_by_side(self.sample, one.columns) for one in of_force), None)
        split = self._place_parts(numeric)
        families = [one for one in families if one.columns[0] not in split]
        self.nanoseconds = split_stamps(numeric)
        families = [one for one in families if one.columns[0] not in self.nanoseconds.values()]
        stamps = [one for one in families if self.match.field(one) == "time"]
        used = [one for one in families if one not in stamps and self._place(one)]
        used += [one for one in self._stamps_first(stamps) if self._place(one)]
        used += self._place_of_base([one for one in families if one not in used])
        if "time" in self.out.columns:
            self.out.columns = {"time": self.out.columns["time"], **self.out.columns}
        elif "time" not in self.given and (found := step_of_stamps(self.sample)):
            self.out.columns = {"time": {"step": found[1]}, **self.out.columns}
            self.out.notes["time"] = f"steps of '{found[0]}' [s], as nothing has stamps"
        if "joint_torque" not in {*self.given, *self.out.columns}:
            used += self._place_law([one for one in families if one not in used])
        used = self._settle_contacts(used)
        taken = {column for one in used for column in one.columns} | split
        taken |= {self.out.columns.get("time", {}).get("nanoseconds")} - {None}
        taken |= self._place_angles([name for name in numeric if name not in taken])
        self.out.partial = self.match.partial
        self.out.left_out = [name for name in foreign if name not in taken]
        families = [one for one in families if one in used or not set(one.columns) <= taken]
        ignored = {one.as_ignored for one in families if one not in used or len(one.numbers) > len(self.joints)}
        ignored |= {name for name in foreign if name not in numeric or name in self.nanoseconds.values()} - taken
        self.out.columns |= {"ignore": sorted(ignored)} if ignored else {}
        if "joint_torque" not in {*self.given, *self.out.columns}:
            alike = [one for one in families if one not in used and self.match.is_like_torques(one)]
            self.out.like_torques = [one for one in alike if one.is_current] or alike
        with np.errstate(all="ignore"):  # of numbers that no unit explains
            units = UnitProposer(self.sample, self.out.columns, self.out.notes, self.factors)
            units.propose(self.robot.weight, not self.files, self.robot.slides)
        return self.out

    def _settle_contacts(self, used: list[Family]) -> list[Family]:
        """The families in use without moments of contacts that have no force; flags by forces where none are."""
        for name in [name for name in WRENCHES if set(self.out.columns.get(name, {})) == {"moment"}]:
            moment = self.out.columns.pop(name)["moment"]
            used = [one for one in used if not one.entry.items() <= moment.items()]
        if set(WRENCHES) & set(self.out.columns) and "contact_active" not in {*self.given, *self.out.columns}:
            self.out.columns["contact_active"] = {"above": float(f"{_TOUCH * self.robot.weight:.2g}")}
            self.out.notes["contact_active"] = f"above {_TOUCH:.0%} of the robot's weight [N], by the wrenches"
        return used

    def _note(self, key: str, text: str) -> None:
        self.out.notes[key] = "; ".join(filter(None, (text, self.out.notes.get(key))))

    def _place_parts(self, numeric: Sequence[str]) -> set[str]:
        """Arrays of which parts have become entries."""
        if {"base_position_world", "base_quat_wxyz", "base_quat_xyzw"} & self.given:
            return set()
        counts = {len(numbered_joints(self.joints, count)) for count in range(len(self.joints))} - {0}
        measured = [name for name in numeric if not is_desired(name)]
        every = split_arrays(self.sample, measured, {*counts, len(self.joints)})
        parts = [part for part in every if part[2] not in self.given]
        for part in parts:
            self._place_part(*part)
        return {name for name, *_ in parts}

    def _place_part(self, name: str, columns: str, field: str) -> None:
        """Make some columns of an array an entry."""
        (start, _, stop), text = columns.strip("[]").partition(":"), f"{name}{columns}"
        part = np.asarray(self.sample[name])[:, int(start) : int(stop) if stop else None]
        self.sample[text] = part
        family = Family(text, [text], ("",), (), ("",))
        if field == "base_quat_wxyz":
            field = self._quaternion(family)
        if field.startswith("joint_") and "joint_order" not in self.out.columns and len(part.T) == len(self.joints):
            self.out.columns["joint_order"] = list(self.joints)
            self.out.notes["joint_order"] = "as in the robot's file, as of libraries for dynamics"
        self._add_order(family, field)
        self.out.columns[field] = {"column": text}
        self._note(field, f"columns {start} to {stop or 'the last'} of '{name}'")

    def _stamps_first(self, families: Sequence[Family]) -> list[Family]:
        """Families of stamps, those that increase first, of these those beside the positions of joints."""
        entry = self.out.columns.get("joint_position", {})
        beside = next(iter(entry.get("columns", {}).values()), "") or entry.get("column", "joint_position")

        def rank(family: Family) -> tuple[bool, int]:
            first = family.columns[0]
            forwards = first in self.nanoseconds or increases(self.sample[first])
            return not forwards, -len(os.path.commonprefix([first, beside]))

        return sorted(families, key=rank)

    # ----------------------------------------------------------------------------------------------------- fields

    def _place_of_base(self, families: Sequence[Family]) -> list[Family]:
        """Families that have become the pose of a base that stands on feet, by what their numbers are."""
        if not self.feet:  # of an arm, that of its hand
            return []
        named = [(one, field) for one in families if (field := field_of_base(one, self.sample))]
        return [one for one, field in sorted(named, key=lambda pair: not pair[0].stem) if self._place(one, field)]

    def _place(self, family: Family, name: str = "") -> bool:
        """Whether a family has become an entry; `name`: of which field, by default the one that it probably is."""
        if is_desired(family.words) or _GAINS.search(family.words.replace("_", " ")):
            return False
        name = name or self.match.field(family)
        if name == "contact_wrench_local" and (len(family.axes) == 3 or self.match.shape(family)[1:] == (3,)):
            return self._place_force(family)
        if name == "time" and name in self.out.columns:
            return self._place_other_time(family)
        known = {*self.given, *self.out.columns}
        again = name == "base_quat_wxyz" and "base_quat_xyzw" in known
        if not name or name in known or again or not self.match.fits(family, name):
            return False
        entry: dict[str, Any] = family.counted_entry
        if name == "base_quat_wxyz":
            name = self._quaternion(family)
            if "imu" in family.words.lower():
                self._note(name, "of the IMU, taken to be that of the base link")
        if name == "time" and (more := self.nanoseconds.get(family.columns[0])):
            entry["nanoseconds"] = more
        if name == "contact_active" and not self._add_threshold(family, entry):
            return False
        self._add_order(family, name)
        self._add_stated_unit(family, entry, name, quantities_of(name))
        if family.by_place:
            self._note(name, "joints by their limb and number, counted from the base outwards")
        self.out.columns[name] = entry
        return True

    def _place_other_time(self, family: Family) -> bool:
        """Whether a family is the stamps of a file that has none yet."""
        others = self.out.columns.get("other_times", [])
        known = [entry["column"] for entry in (self.out.columns["time"], *others)]
        ours = [given for given in self.files if family.columns[0] in given]
        if (
            not ours
            or any(column in given for given in ours for column in known)
            or not self.match.fits(family, "time")
        ):
            return False
        entry: dict[str, Any] = family.entry
        self._add_stated_unit(family, entry, "other_times", ("time",))
        self.out.columns["other_times"] = [*others, entry]
        return True

    def _place_force(self, family: Family) -> bool:
        """Whether a family is the forces or the moments of contacts."""
        has_axes = "".join(sorted(family.axes)).lower() == "xyz" and len(family.columns) == 3 * len(self.feet)
        if not has_axes and self.match.shape(family) != (len(self.feet), 3):
            return False
        is_moment = bool(MOMENT.search(family.pattern))
        (field, why), part = self._frame_of_forces(family, is_moment), "moment" if is_moment else "force"
        if part in (wrench := self.out.columns.get(field, {})) or set(WRENCHES) & self.given:
            return False
        self.out.columns[field] = wrench | {part: family.entry}
        wrench = self.out.columns[field]
        self._add_stated_unit(family, wrench[part], f"{field}.{part}", ("torque" if is_moment else "force",))
        if why:
            self.out.notes[field] = f"taken to act on the robot, along the axes of {why}"
        self._add_order(family, field)
        return True

    def _frame_of_forces(self, family: Family, is_moment: bool) -> tuple[str, str]:
        """The field of a family of forces, and why: in the world, forces of several small feet point up."""
        known = [field for field in WRENCHES if field in self.out.columns]
        if is_moment or known:
            return (known or WRENCHES)[0], "" if known else "the contact frames"
        in_order = not family.axes or family.axes[0] in "xX"
        values = side_by_side(self.sample, family.columns)
        if len(self.feet) > 2 and in_order and values.ndim > 1 and point_along_z(values):
            return WRENCHES[1], "the world, as almost all of them points along z"
        return WRENCHES[0], "the contact frames"

    def _place_law(self, families: Sequence[Family]) -> list[Family]:
        """Families of a PD law, if there are gains."""
        law, used = dict[str, Any](), list[Family]()
        for family in families:
            words = family.words.replace("_", " ").lower()
            gain, what = _GAINS.search(words), propose_field(family.words, desired=True)
            key = gain[1].lower() if gain else _LAW.get(what, "")
            if key and key not in law and (gain or self.match.fits(family, what)):
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
        """The field of a quaternion in the order that it has."""
        stated = re.search("xyzw|wxyz", family.words.lower())
        order = stated[0] if stated else "xyzw" if family.axes[0] in ("x", "X") else "wxyz"
        if not stated and not any(family.axes):
            arrays = [x for column in family.columns if (x := self.sample[column]) is not None]
            order, why = order_of_quaternion(arrays, self.force)
            self.out.notes[f"base_quat_{order}"] = f"order of components, {why}"
        return f"base_quat_{order}"

    def _place_angles(self, columns: Sequence[str]) -> set[str]:
        """Columns that are angles of the base, where nothing else says how it is turned."""
        if any(name.startswith("base_quat") for name in (*self.given, *self.out.columns)):
            return set()
        if found := find_angles(self.sample, columns):
            self.out.columns["base_quat_wxyz"] = {"rpy": found.entry}
            self._note("base_quat_wxyz", found.note)
        return set(found.columns if found else ())

    def _add_threshold(self, family: Family, entry: dict[str, Any]) -> bool:
        """Whether flags can be made of a family, with a threshold unless it has flags; not of numbers of states."""
        values = side_by_side(self.sample, family.columns)
        if are_states(values):
            text = f"'{excerpt(family.columns[0])}' has numbers of states, which nothing in the file explains: not used"
            self._note("contact_active", text)
            return False
        if not np.isin(values, (0, 1)).all():
            entry["above"] = threshold(values)
            self.out.notes["contact_active"] = "threshold, from the readings in the air and their range"
        return True

    def _add_order(self, family: Family, name: str) -> None:
        """An order of names by number, where columns have none."""
        kind = next((kind for kind in SUFFIXES if name.startswith(f"{kind}_")), "")
        key = f"{kind}_order"
        if not kind or any(family.names) or key in self.out.columns or (kind == "joint" and self.match.names_stated):
            return
        numbers = len(family.numbers) or int(np.prod(self.match.shape(family)[:1]))
        order, how = listed_order(self.sample, kind, self.robot, numbers) or usual_order(kind, self.robot, numbers)
        self.out.columns[key] = order
        listed = [name for name in self._order() if name] if kind == "joint" else order
        if kind == "joint" and not self.out.lacking:
            self.out.lacking = [name for name in self.joints if name not in listed]
        self.out.notes[key] = f"{how}; compare it with the manual of the robot, and with what torchid check says"

    def _add_units(self, family: Family, entry: dict[str, Any]) -> None:
        """Columns and units by joint, of a family whose columns have different ones."""
        if "columns" not in entry:
            by_number = dict(zip(self._order(), family.columns, strict=False))
            entry.clear()
            entry["columns"] = {name: column for name, column in by_number.items() if name}
        units = {name: family.units[column] for name, column in entry["columns"].items()}
        entry["unit"] = {"*": family.unit} | {name: unit for name, unit in units.items() if unit != family.unit}
        entry["unit"] = {name: unit for name, unit in entry["unit"].items() if unit}

    def _order(self) -> list[str | None]:
        """Joints by number."""
        order = self.out.columns.get("joint_order", list(self.match.stated))
        return list(JOINT_ORDERS[order].joints) if isinstance(order, str) else list(order)

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
        if family.units:
            self._add_units(family, entry)
        elif self.factors[key] != 1.0:
            entry["unit"] = family.unit
