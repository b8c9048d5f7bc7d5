"""A map of the columns of a table, or the arrays of a file, by exact names; what is not sure is listed for a person."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import excerpt, format_count
from torchid.logs.arrays import TRANSPOSED
from torchid.logs.columns import FILL_IN, OF_FILE, PLACEHOLDER, fits
from torchid.logs.log import SHAPES, VARIANTS, WRENCHES
from torchid.logs.schema import native_field
from torchid.logs.units import UNITS, quantities_of, quantities_with, split_unit, unit_factor
from torchid.proposals.names import (
    BASES,
    NEUTRAL,
    QUANTITIES,
    RobotNames,
    Spelling,
    exchange_affixes,
    find_spelling,
    is_measured,
    join_pairs,
    quantity_of,
    usual_order,
    within,
    words_of,
)
from torchid.proposals.samples import FileSample, increases, numbers_of, slope_fit, stated_names

_AXIS = re.compile(r"(?:(?<![A-Za-z])[A-Za-z]?([wxyz])|(?:(?<![A-Za-z])[A-Z]?|(?<=[a-z]))([WXYZ]))(?![A-Za-z0-9])")
_LAST_NUMBER = re.compile(r"\d+(?!.*\d)")
_OF_JOINTS = {
    "position": "joint_position", "velocity": "joint_velocity", "angular velocity": "joint_velocity",
    "acceleration": "joint_acceleration", "specific force": "joint_acceleration", "torque": "joint_torque",
    "moment": "joint_torque",
}  # fmt: skip
_LAW = {"joint_position": "position", "joint_velocity": "velocity", "joint_torque": "feed_forward"}
TOUCH_WEIGHT = 0.05
"""Share of the robot's weight that a contact bears at least."""

_TURN = 7.0  # [rad]: beyond this, angles are in degrees
_STEPS_S = (2e-4, 0.2)  # between samples of recordings
_MAX_LOG_UNIT_RATIO = 0.15  # of velocities with slopes of positions in the same unit
_MIN_CORRELATION = 0.9  # of velocities with slopes of positions


@dataclass(frozen=True)
class Family:
    """Columns that differ in the name of a joint or contact, in a number or in an axis; or one array.

    Attributes:
        pattern: with placeholders, as in a map.
        columns: in their order.
        kind: joint, contact or "", of the names in the columns.
        names: of the robot.
        numbers, axes: in the names of columns; empty without any.
        words: all else.
        units: of each column, "" where it says none.
        shape: of each sample in a column.
        by_name: columns of each name, where one pattern does not say them.
    """

    pattern: str
    columns: tuple[str, ...]
    kind: str
    names: tuple[str, ...]
    numbers: tuple[int, ...]
    axes: tuple[str, ...]
    words: tuple[str, ...]
    units: tuple[str, ...]
    shape: tuple[int, ...]
    by_name: Mapping[str, str] = field(default_factory=dict, compare=False)

    @property
    def count(self) -> int:
        """Numbers in each sample."""
        return len(self.columns) * int(np.prod(self.shape))

    @property
    def unit(self) -> str:
        """What the first column says of its unit."""
        return self.units[0]

    @property
    def quantity(self) -> str:
        """What the words and the unit say that it is."""
        return "position" if self.words == ("observation", "state") else quantity_of(self.words, self.unit)

    def unknown_words(self, known: Collection[str] = ()) -> list[str]:
        """Words that are neither quantities nor say nothing."""
        return [x for x in self.words if x not in QUANTITIES and x not in NEUTRAL and x not in known]

    @property
    def entry(self) -> dict[str, Any]:
        """Where the columns are, as a map says it."""
        if self.by_name:
            return {"columns": {name: self.by_name[name] for name in self.names}}
        first = min(self.numbers, default=0)
        return {"column": self.pattern} | ({"first_index": first} if first else {})


@dataclass
class MapProposal:
    """What `logs.columns`, or `logs.topics`, may say of a log.

    Attributes:
        columns: the map, as it stands in a file.
        assumed: what the log does not say, by key.
        perhaps: entries that are not sure, with what to do.
        listed: what has no entry, in words.
        hint: what helps to fill in the positions of joints.
        lacking: joints of the robot without columns, of a log that has some.
        key: columns or topics.
        fields: of the log that the map, or the file, gives, those that are to be filled in among them.
    """

    columns: dict[str, Any] = field(default_factory=dict)
    assumed: dict[str, str] = field(default_factory=dict)
    perhaps: list[tuple[str, dict[str, Any], str]] = field(default_factory=list)
    listed: list[str] = field(default_factory=list)
    hint: str = ""
    lacking: list[str] = field(default_factory=list)
    key: str = "columns"
    fields: set[str] = field(default_factory=set)


def propose_map(sample: FileSample, robot: RobotNames, files: Sequence[FileSample] = ()) -> MapProposal:
    """Sort foreign columns into fields of a log by what they are called.

    Args:
        sample: from `read_sample`.
        robot: whose log it is.
        files: samples of each of several files that are one log.
    """
    return _Proposer(sample, robot, files).propose()


def find_families(sample: FileSample, robot: RobotNames) -> tuple[list[Family], dict[str, Spelling]]:
    """Columns of numbers by pattern, and what they call the robot's joints and contacts."""
    spelled = {"joint": find_spelling(list(sample), robot.joints), "contact": find_spelling(list(sample), robot.feet)}
    groups = defaultdict[tuple[Any, ...], list[dict[str, Any]]](list)
    for text, values in sample.items():
        if values is not None and values.ndim and "{" not in text:
            parts = _parts(text, spelled)
            shape = values.shape[1:]
            what = parts["stem"], parts["kind"], parts["words"], quantity_of(parts["words"], parts["unit"]), shape
            groups[what].append(parts | {"text": text, "shape": shape})
    families = []
    for members in groups.values():
        whole = {(x["name"], x["number"], x["axis"]) for x in members}
        sizes = [len({x[key] for x in members}) for key in ("name", "number", "axis")]
        apart = [members] if len(members) == len(whole) == np.prod(sizes) else [[x] for x in members]
        families += [_family(group, spelled) for group in apart]
    return families, spelled


def _parts(text: str, spelled: Mapping[str, Spelling]) -> dict[str, Any]:
    """A column's name with placeholders, and what was in their places."""
    full = text.removesuffix(TRANSPOSED)
    name = ""
    kind = ""
    number = ""
    axis = ""
    inside = [(stem, kind) for kind in spelled for stem in spelled[kind].names if within(stem).search(full)]
    if inside:
        name, kind = max(inside, key=lambda pair: len(pair[0]))
        full = within(name).sub(f"{{{kind}}}", full, count=1)
    stem, unit = split_unit(full)
    tail = full[len(stem) :] + text[len(text.removesuffix(TRANSPOSED)) :]
    words = words_of(PLACEHOLDER.sub(" ", stem))
    if not inside and (match := _LAST_NUMBER.search(stem)):
        number = match[0]
        stem = f"{stem[: match.start()]}{{index}}{stem[match.end() :]}"
    if axes := list(_AXIS.finditer(PLACEHOLDER.sub(lambda x: "\0" * len(x[0]), stem))):
        axis = axes[-1][1] or axes[-1][2]
        place = axes[-1].end() - 1
        before, inner = split_unit(PLACEHOLDER.sub(" ", stem[:place]).rstrip("_./ "))
        stem = f"{stem[:place]}{{{'axis' if axis.islower() else 'AXIS'}}}{stem[place + 1 :]}"
        words = [re.sub(r"^([a-z])[wxyz]$", r"\1x", x) for x in words if not re.fullmatch("[wxyz]", x)]
        if inner and not unit and quantity_of(join_pairs(words_of(before))):  # of acc_g.x
            unit = inner
            words = words_of(before)
    parts = {"stem": stem if kind else stem + tail, "pattern": stem + tail, "words": tuple(join_pairs(words))}
    return parts | {"name": name, "kind": kind, "number": number, "axis": axis.lower(), "unit": unit}


def _family(members: Sequence[Mapping[str, Any]], spelled: Mapping[str, Spelling]) -> Family:
    first = members[0]
    members = sorted(members, key=lambda x: int(x["number"] or 0))
    columns = tuple(x["text"] for x in members)
    pattern = first["pattern"] if len({x["pattern"] for x in members}) == 1 else ""
    if len(members) == 1 and not first["kind"]:
        pattern = columns[0]
    if all(len(x["number"]) == 2 for x in members) and any(x["number"].startswith("0") for x in members):
        pattern = pattern.replace("{index}", "{index:02}")
    of_kind = spelled[first["kind"]].names if first["kind"] else {}
    by_name = {of_kind[x["name"]]: x["pattern"].replace(f"{{{x['kind']}}}", x["name"]) for x in members if x["name"]}
    by_pattern = pattern and "{" not in pattern.rpartition(OF_FILE)[0]
    names = tuple(dict.fromkeys(of_kind[x["name"]] for x in members if x["name"]))
    numbers = tuple(dict.fromkeys(int(x["number"]) for x in members if x["number"])) if len(members) > 1 else ()
    axes = tuple(dict.fromkeys(x["axis"] for x in members if x["axis"]))
    units = tuple(x["unit"] for x in members)
    named = {} if by_pattern else by_name
    return Family(pattern, columns, first["kind"], names, numbers, axes, first["words"], units, first["shape"], named)


class _Proposer:
    def __init__(self, sample: FileSample, robot: RobotNames, files: Sequence[FileSample]) -> None:
        self.sample = sample
        self.robot = robot
        self.files = files
        native = {name for name in sample if native_field(name) or name in (*SHAPES, *VARIANTS)}
        self.foreign = {name: x for name, x in sample.items() if name not in native}
        numeric = {name: x for name, x in self.foreign.items() if x is not None and x.dtype.kind in "fiub" and x.size}
        self.families, self.spelled = find_families(numeric, robot)
        self.given = {name.partition(".")[0] for name in native}
        self.out = MapProposal()
        self.used: list[Family] = []
        self.family_of = dict[str, Family]()  # by field
        stated = stated_names(sample, "joint_names")
        self.stated = stated if set(stated) <= set(robot.joints) else []

    def propose(self) -> MapProposal:
        if all(re.fullmatch(r"column_\d+", name) for name in self.sample):
            self._place_unnamed()
        else:
            self._place_joints()
            self._place_base()
            self._place_contacts()
            self._place_law()
        self._place_time()
        self._settle_units()
        self._ask()
        self.out.fields = {*self.given, *self.out.columns}
        self._list_others()
        order = ("imu_frame", "time", "joint_name", "contact_name", "joint_order", "contact_order")
        self.out.columns = {x: self.out.columns[x] for x in order if x in self.out.columns} | self.out.columns
        return self.out

    def _known(self, name: str) -> bool:
        return name in self.given or name in self.out.columns

    def _add(self, name: str, family: Family, entry: dict[str, Any]) -> None:
        self._add_unit(name, family, entry)
        self.out.columns[name] = entry
        self.family_of[name] = family
        self.used.append(family)

    def _best(self, what: str, candidates: Sequence[Family]) -> Family | None:
        """The one family that may be something: with names, then fewest other words; several are left to a person."""
        if not candidates:
            return None
        ranks = [(not family.kind, len(family.unknown_words())) for family in candidates]
        best = [family for family, rank in zip(candidates, ranks, strict=True) if rank == min(ranks)]
        if len(best) == 1:
            return best[0]
        for family in best:
            self.out.perhaps.append((what, family.entry, "one of several candidates"))
        return None

    # ---------------------------------------------------------------------------------------------------------- joints

    def _place_joints(self) -> None:
        candidates = defaultdict[str, list[Family]](list)
        for family in self.families:
            if is_measured(family.words) and (name := self._joint_field(family)) and not self._known(name):
                candidates[name].append(family)
        chosen = {name: best for name, families in candidates.items() if (best := self._best(name, families))}
        position = chosen.get("joint_position")
        named = set(position.names) if position is not None and position.kind else set(self.stated)
        for name in sorted(chosen, key=lambda x: x != "joint_position"):
            if (best := self._with_positions(name, chosen[name], named)) is not None:
                self._add(name, best, best.entry)
                self._add_order("joint", best)
        if named:
            self.out.lacking = [x for x in self.robot.joints if x not in named]
        self._add_spelling("joint")

    def _joint_field(self, family: Family) -> str:
        """The field of the joints that a family is, "" for none."""
        name = _OF_JOINTS.get(family.quantity, "")
        if family.kind == "joint":
            return "" if family.axes or family.shape not in ((), (1,)) else name
        is_other = family.kind or family.axes or family.unknown_words() or len(family.shape) > 1
        return "" if is_other or self._order_of("joint", family) is None else name

    def _with_positions(self, name: str, family: Family, named: Collection[str]) -> Family | None:
        """Columns of those joints that have positions; None where one of these has none, but for torques."""
        if not family.kind or not named:
            return family
        lacks = [x for x in self.robot.joints if x in named and x not in family.names]
        if lacks and name != "joint_torque":
            self.out.listed.append(f"{name}: no entry: {lacks[0]} has no column. torchid derives it from the positions")
            return None
        if not (more := [x for x in family.names if x not in named]):
            return family
        self.out.assumed[name] = f"without {', '.join(more)}: no position in the log"
        kept = [x in named for x in family.names]
        names, columns, units = (tuple(compress(x, kept)) for x in (family.names, family.columns, family.units))
        by_name = dict(zip(names, columns, strict=True))
        return (
            replace(family, pattern="", names=names, columns=columns, units=units, by_name=by_name) if names else None
        )

    def _order_of(self, kind: str, family: Family) -> tuple[list[str | None] | list[str] | str, str] | None:
        """The order of names that no column says, and why; None where there are not as many."""
        count = len(family.numbers) or int(np.prod(family.shape[:1]))
        names = self.robot.joints if kind == "joint" else self.robot.feet
        if kind == "joint" and self.stated:
            return ([], "") if count == len(self.stated) else None
        for name, values in self.sample.items():
            if values is not None and values.dtype.kind in "SU" and values.shape == (count,):
                matched = exchange_affixes(stated_names(self.sample, name), names)
                if len(matched) == len(names) > 0:
                    return [matched.get(x) for x in stated_names(self.sample, name)], f"the order in '{excerpt(name)}'"
        return usual_order(kind, self.robot, count)

    def _add_order(self, kind: str, family: Family) -> None:
        key = f"{kind}_order"
        order = None if family.kind or key in self.out.columns else self._order_of(kind, family)
        if order is not None and order[0]:
            self.out.columns[key], self.out.assumed[key] = order

    def _add_spelling(self, kind: str) -> None:
        spelling = self.spelled[kind]
        of_kind = [family for family in self.used if family.kind == kind and not family.by_name]
        if of_kind and (spelling.prefix or spelling.suffix):
            self.out.columns[f"{kind}_name"] = f"{spelling.prefix}{{{kind}}}{spelling.suffix}"

    def _place_law(self) -> None:
        """A PD law of gains and what a controller wants, where no torque was recorded."""
        if self._known("joint_torque"):
            return
        law = dict[str, Family]()
        for family in self.families:
            if is_measured(family.words):
                key = family.quantity if family.quantity in ("kp", "kd") else ""
            else:
                key = _LAW.get(_OF_JOINTS.get(family.quantity, ""), "")
            if key and key not in law and (family.kind == "joint" or self._is_of_law(family, key in ("kp", "kd"))):
                law[key] = family
        if not {"kp", "position"} <= set(law):
            return
        entries = {key: family.entry for key, family in law.items()}
        for key, family in law.items():
            if key not in ("kp", "kd"):
                self._add_unit(_OF_JOINTS[family.quantity], family, entries[key])
        self.used += law.values()
        self.out.columns["joint_torque"] = {"pd": entries}
        self.out.assumed["joint_torque"] = "computed from the PD law: the log has no torque"

    def _is_of_law(self, family: Family, is_gain: bool) -> bool:
        count = len(self.stated) or len(self.robot.joints)
        values = self.sample[family.columns[0]]
        return not family.axes and (
            family.count == count or (is_gain and values is not None and values.shape == (count,))
        )

    # ------------------------------------------------------------------------------------------------------------ base

    def _place_base(self) -> None:
        """The pose of the base and its IMU, of columns that say of nothing else that they are of it."""
        of_base = {*BASES, "imu", "ahrs", *words_of(self.robot.base_link)}
        candidates = defaultdict[str, list[Family]](list)
        for family in self.families:
            if not family.kind and is_measured(family.words) and not family.unknown_words(of_base):
                candidates[self._base_field(family, of_base)].append(family)
        imu = ("imu_specific_force", "imu_angular_velocity")
        if not all(self._known(x) or candidates[x] for x in imu):  # family alone is of no use
            candidates |= dict.fromkeys(imu, [])
        for name, families in candidates.items():
            is_free = name and not (self._is_turned if name.startswith("base_quat") else self._known(name))
            if is_free and (best := self._best(name, families)):
                self._add(name, best, best.entry)
                if name.startswith("base_quat") and "imu" in best.words:
                    self.out.assumed[name] = "the IMU's orientation is taken for the base link's"
        if all(map(self._known, imu)) and not self._known("imu_frame"):
            self.out.columns["imu_frame"], self.out.assumed["imu_frame"] = self.robot.imu_frame()

    @property
    def _is_turned(self) -> bool:
        """Whether the base's orientation is known."""
        return self._known("base_quat_wxyz") or self._known("base_quat_xyzw")

    def _base_field(self, family: Family, of_base: Collection[str]) -> str:
        """The field of the base that a family is, "" for none."""
        axes = "".join(sorted(family.axes))
        if family.quantity == "quaternion" and family.count == 4:
            if order := re.search("wxyz|xyzw", family.pattern.lower()):
                return f"base_quat_{order[0]}"
            if axes == "wxyz":
                return "base_quat_wxyz"
            for key in () if self._is_turned else ("base_quat_wxyz", "base_quat_xyzw"):
                self.out.perhaps.append((key, family.entry, f"if its components are in the order {key[-4:]}"))
        if family.count != 3 or not (axes == "xyz" or (not axes and family.shape in ((), (3,)))):
            return ""
        if family.quantity == "position" and set(of_base) & set(family.words):
            return "base_position_world"
        rates = {"angular velocity": "imu_angular_velocity"}
        return (rates | dict.fromkeys(("specific force", "acceleration"), "imu_specific_force")).get(
            family.quantity, ""
        )

    # -------------------------------------------------------------------------------------------------------- contacts

    def _place_contacts(self) -> None:
        feet = len(self.robot.feet)
        for family in self.families if feet and not self._known(WRENCHES[0]) and not self._known(WRENCHES[1]) else ():
            of_all = family.kind == "contact" and len(family.names) == feet
            axes = "".join(sorted(family.axes))
            shape = family.shape
            if not of_all and (family.kind or family.unknown_words({"foot", "feet"}) or shape[:1] != (feet,)):
                continue
            inner = shape if of_all else shape[1:]
            part = {"force": "force", "moment": "moment", "torque": "moment", "wrench": ""}.get(family.quantity)
            if part is None or not is_measured(family.words):
                continue
            if (inner == (3,) and not axes) or (inner == () and axes == "xyz"):
                self._add_wrench(part, family)
            elif inner == (6,) and part != "moment":
                self._add_wrench("", family)
        wrench = next((x for x in WRENCHES if x in self.out.columns), "")
        if set(self.out.columns.get(wrench, {})) == {"moment"}:
            del self.out.columns[wrench]
        self._place_flags(feet)
        if wrench in self.out.columns and not self._known("contact_active"):
            self.out.columns["contact_active"] = {"above": float(f"{TOUCH_WEIGHT * self.robot.weight:.2g}")}
            self.out.assumed["contact_active"] = f"{TOUCH_WEIGHT:.0%} of the robot's weight [N], from the wrenches"
        self._add_spelling("contact")

    def _add_wrench(self, part: str, family: Family) -> None:
        """Forces or moments of contacts, or both where `part` is ""."""
        name = WRENCHES[1] if {"world", "global"} & set(family.words) else WRENCHES[0]
        entry = family.entry
        known = self.out.columns.get(name, {})
        if part in known or (known and not part) or {"column", "columns"} & set(known):
            return
        if part:
            self._add_unit("", family, entry, ("force",) if part == "force" else ("torque",))
        self.out.columns[name] = known | {part: entry} if part else entry
        where = "along the axes of the world" if name == WRENCHES[1] else "along the axes of the contact frames"
        self.out.assumed[name] = f"wrenches act on the robot, {where}"
        self.used.append(family)
        self._add_order("contact", family)

    def _place_flags(self, feet: int) -> None:
        for family in self.families if feet and not self._known("contact_active") else ():
            of_all = family.kind == "contact" and len(family.names) == feet and family.shape in ((), (1,))
            if not of_all and (family.kind or family.unknown_words({"foot", "feet"}) or family.count != feet):
                continue
            if family.axes or family.quantity not in ("flag", "force") or family in self.used:
                continue
            values = numbers_of(self.sample, family.columns)
            if family.quantity == "flag" and np.isin(values, (0, 1)).all():
                if of_all or self._order_of("contact", family):
                    self._add("contact_active", family, family.entry)
                    self._add_order("contact", family)
                return
            self.out.perhaps.append(
                ("contact_active", family.entry | {"above": FILL_IN}, "above: the reading at which it touches")
            )

    # ----------------------------------------------------------------------------------------------------------- stamps

    def _place_time(self) -> None:
        if self._known("time") or self._split_stamps():
            return
        stamps = [x for x in self.families if x.quantity == "time" and is_measured(x.words) and x.count == 1]
        stamps = [x for x in stamps if increases(self.sample[x.columns[0]])]
        position = self.family_of.get("joint_position")
        beside = position.columns[0] if position else "joint_position"
        folder = beside[: beside.rfind("/") + 1]

        def distance(family: Family) -> tuple[bool, int, int]:
            first = family.columns[0]
            return not first.startswith(folder), len(family.unknown_words()), len(first)

        for family in sorted(stamps, key=distance):
            entry = family.entry
            if "time" not in self.out.columns:
                self._add_time_unit(family, entry, "time")
                self._add("time", family, entry)
            elif self._is_other_clock(family):
                self._add_time_unit(family, entry, "other_times")
                self.out.columns.setdefault("other_times", []).append(entry)
                self.used.append(family)
        if "time" not in self.out.columns:
            self._place_step()

    def _split_stamps(self) -> bool:
        """Whether stamps are whole seconds with the nanoseconds beside them, as in messages of ROS."""
        names = {re.sub(r"(?i)nano_?secs?(onds)?$|nsecs?$", "*", x): x for x in self.foreign}
        for text in self.foreign:
            before = re.fullmatch(r"(?i)(.*?)secs?(onds)?", text)
            more = names.get(f"{before[1]}*") if before else None
            if before and more and more != text and increases(self.sample[text], strictly=False):
                self.out.columns["time"] = {"column": text, "nanoseconds": more}
                self.used += [family for family in self.families if {text, more} & set(family.columns)]
                return True
        return False

    def _is_other_clock(self, family: Family) -> bool:
        """Whether stamps are those of a file, or of arrays, that lack the others."""
        first = family.columns[0]
        known = [self.out.columns["time"], *self.out.columns.get("other_times", [])]
        if self.files:
            return not any(entry["column"] in file for file in self.files if first in file for entry in known)
        lengths = [numbers_of(self.sample, [entry["column"]]).size for entry in known]
        return numbers_of(self.sample, [first]).size not in lengths

    def _add_time_unit(self, family: Family, entry: dict[str, Any], key: str) -> None:
        if "time" in quantities_with(family.unit):
            entry |= {"unit": family.unit} if unit_factor("time", family.unit, ("time",)) != 1.0 else {}
            return
        step = float(np.nanmedian(np.diff(numbers_of(self.sample, family.columns)[:, 0])))
        fitting = [x for x in ("s", "ms", "us", "ns") if _STEPS_S[0] <= step * UNITS["time"][x] <= _STEPS_S[1]]
        if fitting and fitting[0] != "s":
            entry["unit"] = fitting[0]
            self.out.assumed[key] = f"{fitting[0]}: steps are {step:.3g}"

    def _place_step(self) -> None:
        """Stamps by the step that the file states, or by which velocities are the slopes of positions."""
        for name, values in self.sample.items():
            is_step = re.fullmatch(r"(\w+_)?(dt|time_?step)(_s)?", name, re.IGNORECASE) is not None
            if is_step and values is not None and values.dtype.kind in "fiu" and values.size:
                step = float(np.ravel(values)[0])
                if _STEPS_S[0] <= step <= _STEPS_S[1] and (np.ravel(values) == step).all():
                    self.out.columns["time"] = {"step": step}
                    self.out.assumed["time"] = f"the log has no stamps; the step is '{name}' [s]"
                    return
        position, velocity = (self._values(x) for x in ("joint_position", "joint_velocity"))
        if position is None or velocity is None or position.shape != velocity.shape:
            return
        correlation, step = slope_fit(position, velocity)
        if correlation > _MIN_CORRELATION and _STEPS_S[0] <= step <= _STEPS_S[1]:
            self.out.columns["time"] = {"step": float(f"{1e3 * step:.2g}"), "unit": "ms"}
            self.out.assumed["time"] = "the log has no stamps; with this step velocities are the slopes of positions"

    # ------------------------------------------------------------------------------------------------ columns by number

    def _place_unnamed(self) -> None:
        """Columns without names: stamps that increase, then positions and velocities of all joints, by slopes."""
        count = len(self.robot.joints)
        names = list(self.foreign)
        values = numbers_of(self.sample, names)
        stamps = np.array([increases(column) for column in values.T])
        self.families = [
            Family(name, (name,), "", (), (), (), ("time",) * is_stamp, ("",), ())
            for name, is_stamp in zip(names, stamps.tolist(), strict=True)
        ]
        moves = (np.ptp(values, axis=0) > 0.0) & ~stamps
        starts = [k for k in range(len(names) - count + 1) if count and moves[k : k + count].all()]
        for first, second in permutations(starts, 2):
            pairs = zip(values.T[first : first + count], values.T[second : second + count], strict=True)
            if abs(second - first) < count or min(slope_fit(*pair)[0] for pair in pairs) < _MIN_CORRELATION:
                continue
            for name, start in (("joint_position", first), ("joint_velocity", second)):
                numbers = tuple(range(start, start + count))
                columns = tuple(names[start : start + count])
                block = Family("column_{index}", columns, "", (), numbers, (), (), ("",) * count, ())
                self._add(name, block, block.entry)
                self.out.assumed[name] = f"columns {start} to {numbers[-1]}: velocities are the slopes of positions"
            self._add_order("joint", block)
            return

    # ------------------------------------------------------------------------------------------------------------ units

    def _add_unit(self, name: str, family: Family, entry: dict[str, Any], quantities: tuple[str, ...] = ()) -> None:
        """The unit that the names of columns, or the file's header, say."""
        quantities = quantities or quantities_of(name)
        if name == "time" or not any(family.units):
            return
        other = [x for x in family.units if x and not set(quantities) & set(quantities_with(x))]
        if other and quantities:
            entry["unit"] = FILL_IN
            self.out.assumed[name] = f"unit '{excerpt(other[0])}' of its columns is no {' or '.join(quantities)} unit"
        elif len(set(family.units)) > 1 and family.kind:
            pairs = zip(family.names, family.units, strict=False)
            entry["unit"] = {joint: unit for joint, unit in pairs if unit}
        elif family.unit and quantities and unit_factor(name, family.unit, quantities) != 1.0:
            entry["unit"] = family.unit

    def _values(self, name: str) -> NDArray[np.float64] | None:
        """Numbers (N, k) of an entry or of a field with its own name, without their unit."""
        native = [x for x in self.sample if x == name or x.startswith(f"{name}.")]
        columns = self.family_of[name].columns if name in self.family_of else native
        values = numbers_of(self.sample, columns)
        return values if np.isfinite(values).any() else None

    def _settle_units(self) -> None:
        """Degrees, where positions are far beyond a turn, and velocities 57 times their slopes."""
        family = self.family_of.get("joint_position")
        position = self._values("joint_position")
        if family is None or position is None:
            return
        entry = self.out.columns["joint_position"]
        hinges = np.array([name not in self.robot.slides for name in family.names] or [True] * position.shape[1])
        largest = np.nanpercentile(np.abs(position[:, hinges]), 98) if hinges.any() else 0.0
        if largest > _TURN and not any(family.units):
            of_hinges = {name: "deg" for name, is_hinge in zip(family.names, hinges, strict=False) if is_hinge}
            entry["unit"] = "deg" if hinges.all() else of_hinges
            self.out.assumed["joint_position"] = f"deg: values reach {np.nanmax(np.abs(position)):.3g}"
        if not self.files and entry.get("unit") in (None, "deg"):
            self._settle_velocities(np.radians(position) if "unit" in entry else position)

    def _settle_velocities(self, position: NDArray[np.float64]) -> None:
        """Degrees per second, by the slopes of positions (N, n) [rad]."""
        family = self.family_of.get("joint_velocity")
        velocity = self._values("joint_velocity")
        stamps = self._values("time")
        if family is None or velocity is None or stamps is None or any(family.units):
            return
        if velocity.shape != position.shape or len(stamps) != len(position):
            return
        correlation, step = slope_fit(position, velocity)
        unit_s = UNITS["time"].get(self.out.columns.get("time", {}).get("unit", "s"), 1.0)
        ratio = unit_s * float(np.nanmedian(np.diff(stamps[:, 0]))) / max(step, np.finfo(float).tiny)
        if correlation > _MIN_CORRELATION and abs(math.log(ratio * UNITS["angle"]["deg"])) < _MAX_LOG_UNIT_RATIO:
            self.out.columns["joint_velocity"]["unit"] = "deg/s"
            self.out.assumed["joint_velocity"] = f"deg/s: values are {ratio:.3g} times the slopes of positions"

    # ---------------------------------------------------------------------------------------- what a person has to say

    def _ask(self) -> None:
        """Entries for what a fit needs and nothing says, to be filled in."""
        if not self._known("time"):
            self.out.columns["time"] = {"step": FILL_IN, "unit": "ms"}
            self.out.assumed["time"] = "the step between samples, if no column has stamps; else the column: time: NAME"
        if self.robot.joints and not self._known("joint_position"):
            self.out.columns["joint_position"] = {"column": FILL_IN}
            self.out.assumed["joint_position"] = 'a column or pattern below: an array, "q_{joint}", "q_{index}"'
            order = ", ".join(self.robot.joints)
            self.out.hint = f"joints of the robot: {order}; joint_order: [...] names numbered columns"
        forces = ("joint_torque", *WRENCHES, "contact_force_normal", "ft_wrench")
        if self.robot.joints and not any(map(self._known, forces)):
            self.out.columns["joint_torque"] = {"column": FILL_IN}
            self.out.assumed["joint_torque"] = "torques [N m]; or {current: ...}, {pd: ...}, contact_wrench_local"

    def _list_others(self) -> None:
        """Columns without an entry: ignored by the map, and listed with their shapes and ranges."""
        used = {x for family in self.used for x in family.columns}
        used |= {x for x in self.foreign if f"{x}{TRANSPOSED}" in used}
        rows = list[tuple[str, str]]()
        for family in self.families:
            others = [x for x in family.columns if x not in used]
            if not others:
                continue
            text = family.pattern if len(others) > 1 and family.pattern else excerpt(others[0])
            rows.append((text, self._range(others)))
        numeric = {x for family in self.families for x in family.columns}
        for name, values in self.foreign.items():
            if name not in numeric and f"{name}{TRANSPOSED}" not in numeric:
                is_single = values is not None and values.dtype.kind in "fiub" and values.size == 1
                rows.append((excerpt(name), str(values) if is_single else "no numbers"))
        if rows:
            self.out.columns["ignore"] = ["*", *sorted(self._confusable(used))]
        self.out.listed = [*(f"{text}: {what}" for text, what in rows), *self.out.listed]

    def _confusable(self, used: set[str]) -> set[str]:
        """What `ignore` needs beside `*`: unread columns that the pattern of an entry fits, too, with more letters."""
        patterns = [PLACEHOLDER.sub("*", family.pattern) for family in self.used if family.kind and not family.by_name]
        out = set[str]()
        for family in self.families:
            if not used & {*family.columns} and any(fits(x, pattern) for pattern in patterns for x in family.columns):
                star = PLACEHOLDER.sub("*", family.pattern)
                others = [x for x in self.sample if x not in family.columns]
                out |= {star} if star.strip("*") and not any(fits(x, star) for x in others) else {*family.columns}
        return out

    def _range(self, columns: Sequence[str]) -> str:
        values = numbers_of(self.sample, columns)
        first = self.sample[columns[0]]
        known = values[np.isfinite(values)]
        shape = f"{format_count(len(columns), 'column')}, " if len(columns) > 1 else ""
        if first is not None and first.ndim != 1:
            shape = f"shape {first.shape}, "
        return shape + (f"{known.min():.4g} to {known.max():.4g}" if known.size else "no finite number")


def joined(samples: Iterable[FileSample]) -> dict[str, NDArray[Any] | None]:
    """The columns of all files, of the first where several have them."""
    return {name: values for sample in reversed(list(samples)) for name, values in sample.items()}
