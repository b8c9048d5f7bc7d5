"""A proposed map of foreign columns, from their names and some of their numbers."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt
from torchid.logs.column_map import fits
from torchid.logs.columns import is_column
from torchid.logs.log import SHAPES, VARIANTS, WRENCHES
from torchid.logs.name_matching import SUFFIXES, KnownRobot, is_desired, propose_field
from torchid.logs.unitree import JOINT_ORDERS, numbered_joints, usual_order
from torchid.logs.units import IN_DEGREES, quantities_of, quantities_with, unit_factor
from torchid.proposals.base import field_beside, field_of_base, field_of_quaternion, find_angles
from torchid.proposals.column_groups import Family, MapProposal, find_families, split_arrays
from torchid.proposals.fields import MOMENT, FieldMatcher, find_foot_readings, frame_of_forces
from torchid.proposals.file_samples import FileSample, listed_order, side_by_side, with_samples_first
from torchid.proposals.numbers import (
    LEAST_GRAVITY,
    UnitProposer,
    are_states,
    gravity_share,
    is_flags,
    step_of_stamps,
    threshold,
    unit_of_step,
)
from torchid.proposals.settling import settle_in_files
from torchid.proposals.stamps import first_of_stamps, has_stamps_of, split_stamps, stamps_first

_GAINS = re.compile(r"\b(kp|kd)\b", re.IGNORECASE)
_LAW = {"joint_position": "position", "joint_velocity": "velocity", "joint_torque": "feed_forward"}
_TOUCH = 0.05  # of the robot's weight, what a contact bears at least


def propose_map(
    sample: FileSample,
    robot: KnownRobot,
    files: Sequence[FileSample] = (),
    in_degrees: Collection[str] = (),
    clocks: Sequence[Collection[str]] = (),
) -> MapProposal:
    """Sort foreign columns into fields of a log by what they are called and what is in them.

    Args:
        sample: from `read_sample`.
        robot: whose log it is.
        files: samples of each of several files that are one log, whose stamps may differ in name.
        in_degrees: columns of files whose header says that angles are in degrees.
        clocks: arrays with each of several stamps in one file.
    """
    turned, notes = with_samples_first(sample, len(robot.joints))
    out = _Proposer(turned, robot, files, in_degrees, clocks).propose()
    out.notes = notes | out.notes
    if notes and "ignore" in out.columns:  # by their names in the file
        apart = [name for name in turned if name not in sample]
        ignored = (x.removesuffix(".T") if any(fits(one, x) for one in apart) else x for x in out.columns["ignore"])
        out.columns["ignore"] = sorted(set(ignored))
    return out


class _Proposer:
    def __init__(
        self,
        sample: FileSample,
        robot: KnownRobot,
        files: Sequence[FileSample],
        in_degrees: Collection[str],
        clocks: Sequence[Collection[str]],
    ) -> None:
        self.sample, self.robot, self.in_degrees = dict(sample), robot, in_degrees
        self.files, self.clocks = files, clocks
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
        of_feet = self._place_feet(numeric)
        families, more = find_families([name for name in numeric if name not in of_feet], self.robot)
        self.out.columns |= {f"{kind}_name": pattern for kind, pattern in more.items()}
        self.match.look_at(families, more)
        if named := self.match.named_joints:
            self.out.lacking = [name for name in self.joints if name not in named]
        families = sorted(families, key=lambda one: (self._lacks_gravity(one), not self._has_flags(one)))
        of_force = (one for one in families if self._lacks_gravity(one) < 0.0)
        self.force = next((side_by_side(self.sample, one.columns) for one in of_force), None)
        split, of_limbs = self._place_parts(numeric), self._place_limbs(numeric)
        split |= of_limbs
        self.fractions = split_stamps(numeric)
        of_fractions = {column for _, column in self.fractions.values()}
        families = [one for one in families if one.columns[0] not in split | of_fractions]
        stamps = [one for one in families if one.columns[0] in self.fractions or self.match.field(one) == "time"]
        used = [one for one in families if one not in stamps and self._place(one)]
        stamps = first_of_stamps(stamps, self.sample, self.out.notes) if of_limbs else stamps
        known = {column for one in used for column in one.columns} | split | self.native
        stamps = [one for one in stamps if has_stamps_of(one, known, self.clocks)]
        positions = self.out.columns.get("joint_position", {})
        stamps = stamps_first(stamps, self.sample, positions, self.fractions, bool(self.clocks))
        used += [one for one in stamps if self._place(one, "time")]
        used += self._place_of_base([one for one in families if one not in used])
        if "time" in self.out.columns:
            self.out.columns = {"time": self.out.columns["time"], **self.out.columns}
        elif "time" not in self.given and (found := step_of_stamps(self.sample)):
            self.out.columns = {"time": {"step": found[1]}, **self.out.columns}
            self.out.notes["time"] = f"steps of '{found[0]}' [s], as nothing has stamps"
        if "joint_torque" not in {*self.given, *self.out.columns}:
            used += self._place_law([one for one in families if one not in used])
        used = self._settle_contacts(used)
        taken = {column for one in used for column in one.columns} | split | of_feet
        taken |= of_fractions & set(self.out.columns.get("time", {}).values())
        taken |= self._place_angles([name for name in numeric if name not in taken])
        self.out.partial = self.match.partial
        self.out.left_out = [name for name in foreign if name not in taken]
        self.out.not_numbers = [name for name in foreign if name not in numeric]
        families = [one for one in families if one in used or not set(one.columns) <= taken]
        unused = [one for one in families if one not in used or len(one.numbers) > len(self.joints)]
        read = {x for one in used for x in one.as_ignored}  # `q_*` has no more letters than `q_{joint}`, `q_x` has
        ignored = {x for one in unused for x in (one.columns if read & {*one.as_ignored} else one.as_ignored)}
        ignored |= {x for x in foreign if x not in numeric or x in of_fractions} - taken
        self.out.columns |= {"ignore": sorted(ignored)} if ignored else {}
        if "joint_torque" not in {*self.given, *self.out.columns}:
            alike = [one for one in families if one not in used and self.match.is_like_torques(one)]
            self.out.like_torques = [one for one in alike if one.is_current] or alike
        self._settle_numbers()
        return self.out

    def _settle_numbers(self) -> None:
        """Units and frames, as the numbers say; a gyroscope alone is the angular velocity of a base that turns."""
        entries, turns = self.out.columns, {"base_quat_wxyz", "base_quat_xyzw"}
        rates = {"base_angular_velocity_base", "base_angular_velocity_world", "imu_specific_force"}
        known = {*self.given, *entries}
        if "imu_angular_velocity" in entries and turns & known and not rates & known:
            entries["base_angular_velocity_base"] = entries.pop("imu_angular_velocity")
        with np.errstate(all="ignore"):  # of numbers that no unit explains
            units = UnitProposer(self.sample, self.out.columns, self.out.notes, self.factors)
            units.propose(self.robot.weight, not self.files, self.robot.slides)
            settle_in_files(self.out, self.files or [self.sample], self.factors)

    def _lacks_gravity(self, family: Family) -> float:
        """Minus the share of gravity in what may be an accelerometer, 0 for all else."""
        if family.proposed != "imu_specific_force" or len(family.columns) not in (1, 3):
            return 0.0
        values = side_by_side(self.sample, family.columns)
        return -gravity_share(values) if values.shape[1:] == (3,) and values.dtype.kind in "fiu" else 0.0

    def _has_flags(self, family: Family) -> bool:
        """Whether a family is recorded flags of contacts, which count before a threshold of forces."""
        return family.proposed == "contact_active" and is_flags(side_by_side(self.sample, family.columns))

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

    def _place_limbs(self, numeric: Sequence[str]) -> set[str]:
        """Arrays of the joints of a limb each, which have become entries."""
        placed = [(family, of) for family, of in self.match.of_limbs(numeric) if self._place(family)]
        for family, _ in placed:
            self._note(family.proposed, "joints of each limb as the file lists them, else as the robot's file does")
        return {name for _, arrays in placed for name in arrays}

    def _place_part(self, name: str, columns: str, field: str) -> None:
        """Make some columns of an array an entry."""
        (start, _, stop), text = columns.strip("[]").partition(":"), f"{name}{columns}"
        part = np.asarray(self.sample[name])[:, int(start) : int(stop) if stop else None]
        self.sample[text] = part
        family = Family(text, [text], ("",), (), ("",))
        if field == "base_quat_wxyz":
            field = field_of_quaternion(family, self.sample, self.force, self.out.notes)
        if field.startswith("joint_") and "joint_order" not in self.out.columns and len(part.T) == len(self.joints):
            why = "as in the robot's file, as of libraries for dynamics"
            self.out.guess_order("joint_order", list(self.joints), why)
        self._add_order(family, field)
        self.out.columns[field] = {"column": text}
        self._note(field, f"columns {start} to {stop or 'the last'} of '{name}'")

    def _place_of_base(self, families: Sequence[Family]) -> list[Family]:
        """Families that have become the pose of a base, of a robot with feet or of a single body, by their numbers."""
        if not self.feet and self.joints:  # of an arm, that of its hand
            return []
        named = [(one, field) for one in families if (field := field_of_base(one, self.sample))]
        placed = [one for one, field in sorted(named, key=lambda pair: not pair[0].stem) if self._place(one, field)]
        turns = [self.out.columns.get(f"base_quat_{order}", {}).get("column", "") for order in ("xyzw", "wxyz")]
        others = [(one, turn) for turn in turns if turn for one in families if one not in placed]
        beside = [(one, field) for one, turn in others if (field := field_beside(one, turn, self.sample))]
        return placed + [one for one, field in beside if self._place(one, field)]

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
        known |= {"base_quat_wxyz"} if "base_quat_xyzw" in known else set()
        if not name or name in known or not self.match.fits(family, name):
            return False
        entry: dict[str, Any] = family.counted_entry
        if name == "base_quat_wxyz":
            name = field_of_quaternion(family, self.sample, self.force, self.out.notes)
            if "imu" in family.words.lower():
                self._note(name, "of the IMU, taken to be that of the base link")
        if name == "time" and (more := self.fractions.get(family.columns[0])):
            entry |= [more]
        if not self._has_readings_of(family, name, entry):
            return False
        self._add_order(family, name)
        self._add_stated_unit(family, entry, name, quantities_of(name))
        if family.by_place:
            self._note(name, "joints by their limb and number, counted from the base outwards")
        self.out.columns[name] = entry
        return True

    def _has_readings_of(self, family: Family, name: str, entry: dict[str, Any]) -> bool:
        """Whether the numbers of a family may be those of a field; flags get a threshold."""
        if name == "contact_active":
            return self._add_threshold(family, entry)
        if is_free := name == "imu_specific_force" and not family.unit and -self._lacks_gravity(family) < LEAST_GRAVITY:
            self._note(name, f"not '{excerpt(family.columns[0])}', which is without gravity")
        return not is_free

    def _place_other_time(self, family: Family) -> bool:
        """Whether a family is the stamps of a file that has none yet."""
        others = self.out.columns.get("other_times", [])
        known = [entry["column"] for entry in (self.out.columns["time"], *others)]
        ours = [given for given in self.files or self.clocks if family.columns[0] in given]
        if (
            not ours
            or any(column in given for given in ours for column in known)
            or not self.match.fits(family, "time")
        ):
            return False
        entry: dict[str, Any] = family.entry
        self._add_stated_unit(family, entry, "other_times", ("time",))
        step = float(np.median(np.diff(np.asarray(self.sample[family.columns[0]]))))
        entry |= {"unit": unit_of_step(step)} if not family.unit and unit_of_step(step) != "s" else {}
        self.out.columns["other_times"] = [*others, entry]
        if self.clocks:
            self.out.notes["other_times"] = "stamps of the arrays beside them, which are interpolated to those of time"
        return True

    def _place_feet(self, columns: Sequence[str]) -> set[str]:
        """Columns of forces and flags of feet that the file names by their sides, which have become entries."""
        taken = set[str]()
        found = find_foot_readings(self.sample, columns, self.robot)
        for one in sorted(found, key=lambda one: not is_flags(side_by_side(self.sample, one.family.columns))):
            known, entry = {*self.given, *self.out.columns}, one.family.entry
            if one.part == "normal":
                placed = "contact_active" not in known and self._add_threshold(one.family, entry)
                self.out.columns |= {"contact_active": entry} if placed else {}
            else:
                placed = self._place_forces(one.part, one.family, one.forces(self.sample), "; feet by their sides")
            taken |= set(one.all_columns) if placed else set()
        return taken

    def _place_force(self, family: Family) -> bool:
        """Whether a family is the forces or the moments of contacts."""
        has_axes = "".join(sorted(family.axes)).lower() == "xyz" and len(family.columns) == 3 * len(self.feet)
        if not has_axes and self.match.shape(family) != (len(self.feet), 3):
            return False
        in_order = not family.axes or family.axes[0] in "xX"
        forces = side_by_side(self.sample, family.columns) if in_order else np.empty(0)
        placed = self._place_forces("moment" if MOMENT.search(family.pattern) else "force", family, forces)
        if placed:
            self._add_order(family, WRENCHES[0])
        return placed

    def _place_forces(self, part: str, family: Family, forces: NDArray[Any], whose: str = "") -> bool:
        """Whether forces (N, ..., 3) of all feet, moments beside these, or wrenches have become an entry."""
        field = next((one for one in WRENCHES if one in self.out.columns), "")
        wrench = self.out.columns.get(field, {})
        if set(WRENCHES) & self.given or {part, "column", "columns"} & set(wrench) or (wrench and part == "wrench"):
            return False
        entry: dict[str, Any] = family.entry
        if not field:
            field, note, scale = frame_of_forces(forces if part != "moment" else np.empty(0), self.robot, family.words)
            entry |= {"scale": scale} if scale < 0 else {}
            self.out.notes[field] = f"{note}{whose}"
        elif any("scale" in of for of in wrench.values()):
            entry["scale"] = -1
        self._add_stated_unit(family, entry, f"{field}.{part}", ("torque" if part == "moment" else "force",))
        self.out.columns[field] = entry if part == "wrench" else wrench | {part: entry}
        return True

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

    def _place_angles(self, columns: Sequence[str]) -> set[str]:
        """Columns that are angles of the base, where nothing else says how it is turned."""
        if any(name.startswith("base_quat") for name in (*self.given, *self.out.columns)):
            return set()
        if (found := find_angles(self.sample, columns)) is None:
            return set()
        self.out.columns["base_quat_wxyz"] = {"rpy": found.entry}
        self._note("base_quat_wxyz", found.note)
        return set(found.columns)

    def _add_threshold(self, family: Family, entry: dict[str, Any]) -> bool:
        """Whether flags can be made of a family, with a threshold unless it has flags; not of numbers of states."""
        values = side_by_side(self.sample, family.columns)
        if are_states(values):
            text = f"'{excerpt(family.columns[0])}' has numbers of states, which nothing in the file explains: not used"
            self._note("contact_active", text)
            return False
        if not is_flags(values):
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
        as_in_file = kind == "contact" and self.out.columns.get("joint_order") == list(self.joints)
        usual = (list(self.feet), "as in the robot's file, as joints are") if as_in_file else None
        listed = listed_order(self.sample, kind, self.robot, numbers)
        order, how = listed or usual or usual_order(kind, self.robot, numbers)
        self.out.columns[key] = order
        self.out.guessed_orders |= set() if listed else {key}
        if kind == "joint" and not self.out.lacking:
            self.out.lacking = [name for name in self.joints if name not in self._order()]
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
