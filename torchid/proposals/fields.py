"""Which field of a log columns that belong together may be: by names, units and numbers, and of feet by their sides."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.log import WRENCHES, FloatArray
from torchid.logs.name_matching import (
    OF_BASE,
    OF_PLATES,
    SUFFIXES,
    KnownRobot,
    is_desired,
    is_no_torque,
    limb_and_words,
    limb_of,
    propose_field,
    within,
    words_of,
)
from torchid.logs.unitree import JOINT_ORDERS, MOTORS, numbered_joints, suitable_orders
from torchid.logs.units import quantities_with, split_unit
from torchid.proposals.column_groups import Family, has_pose
from torchid.proposals.file_samples import (
    FileSample,
    increases,
    listed_joints,
    listed_order,
    side_by_side,
    stated_names,
)
from torchid.proposals.numbers import point_along_z

FORCE = re.compile(r"force|kraft|f(ue|o)r[cçz]a|(?<![a-z])f\{axis", re.IGNORECASE)
MOMENT = re.compile(r"moment|torque|(?<![a-z])[mt]\{axis", re.IGNORECASE)
"""In patterns of columns."""

_SIDEWAYS = re.compile(r"(?<![a-z])(f[xy]|m[xyz])(?![a-z])", re.IGNORECASE)  # components that tell of no contact
_MOMENTS = {"moment", "moments", "momente"}  # of each joint; of feet and plates others
_DRIVE = re.compile(r"joint|motor|current|temp|limit|volt", re.IGNORECASE)  # of a limb, but of no foot
_FOOT = re.compile(r"foot|feet", re.IGNORECASE)


class FieldMatcher:
    """What families of columns of a file may be.

    Attributes:
        sample: of the file, from `read_sample`.
        robot: whose log it is.
        stated: names of joints that the file lists.
        names_stated: whether they are those of the robot.
        named_joints: those that its columns name, or it lists.
        partial: by field that is left out for it, joints that have columns of other fields alone.
    """

    def __init__(self, sample: dict[str, NDArray[Any] | None], robot: KnownRobot) -> None:
        self.sample, self.robot = sample, robot
        self.stated = stated_names(sample, "joint_names")
        self.names_stated = bool(self.stated) and set(self.stated) <= {*robot.joints, *robot.moving}
        self.named_joints = set(self.stated) if self.names_stated else set[str]()
        self.partial, self._suffix = dict[str, list[str]](), ""
        self._with_base = set[int]()  # numbers of columns that have a base's position or velocity in front of joints

    def look_at(self, families: Sequence[Family], more: Mapping[str, str]) -> None:
        """Learn which joints the columns of a file name; `more` as from `find_families`."""
        self._suffix = more.get("joint", "").removeprefix("{joint}")
        self.named_joints = self.named_joints or self._all_named(families)
        states = [one.columns for one in families if len(one.numbers) == len(one.columns) == len(self.robot.joints) + 7]
        has_base = any(has_pose(side_by_side(self.sample, columns)) for columns in states)
        self._with_base = {len(self.robot.joints) + more for more in (6, 7) if has_base}

    def of_limbs(self, names: Sequence[str]) -> list[tuple[Family, set[str]]]:
        """Arrays, or numbered columns, of the joints of one limb each, together all, and which of `names` these are.

        Joints are those that a list in the file names, else a limb's in the order of the robot's file.

        Args:
            names: that may be; of arrays the columns become a part of the sample.
        """
        by_field, out = defaultdict[str, dict[str, list[str]]](dict), list[tuple[Family, set[str]]]()
        for name, columns in self._side_by_side(names).items():
            if (field := propose_field(name)).startswith("joint_") and len(columns) < len(self.robot.joints):
                by_field[field][name] = columns
        for lists in by_field.values():
            limbs = self._limbs_of({name: len(columns) for name, columns in lists.items()})
            entry = {joint: column for name, of in limbs.items() for joint, column in zip(of, lists[name], strict=True)}
            if len(limbs) > 1 and len(entry) == sum(map(len, limbs.values())) == len(self.robot.joints):
                arrays = {name: np.asarray(self.sample[name]) for name in limbs if name in self.sample}
                self.sample |= {column: x[:, k] for name, x in arrays.items() for k, column in enumerate(lists[name])}
                family = Family(next(iter(limbs)), list(entry.values()), tuple(entry), (), ("",), entry)
                out.append((family, {*arrays, *entry.values()} & set(names)))
        return out

    def _side_by_side(self, names: Sequence[str]) -> dict[str, list[str]]:
        """The columns of each array, and columns that differ in a number at their end, by what they have in common."""
        out, numbered = dict[str, list[str]](), defaultdict[str, list[tuple[int, str]]](list)
        for name in names:
            if np.ndim(array := np.asarray(self.sample[name])) == 2:
                out[name] = [f"{name}[{k}:{k + 1}]" for k in range(array.shape[1])]
            elif found := re.fullmatch(r"(.*\D)(\d+)\]?", name):
                numbered[found[1]].append((int(found[2]), name))
        return out | {name: [column for _, column in sorted(of)] for name, of in numbered.items()}

    def _limbs_of(self, counts: Mapping[str, int]) -> dict[str, Sequence[str]]:
        """The joints of lists of so many, by their names; the one limb that is left is that of the one list without."""
        names = self.robot.joints
        out = {x: listed_joints(self.sample, x, n, names) or limb_of(x, n, self.robot) for x, n in counts.items()}
        nameless, taken = [x for x, of in out.items() if not of], {joint for of in out.values() for joint in of}
        left = [of for of in self.robot.limbs if not taken & set(of)]
        if len(nameless) == len(left) == 1 and counts[nameless[0]] == len(left[0]):
            out[nameless[0]] = left[0]
        return {x: of for x, of in out.items() if of}

    def is_like_torques(self, family: Family) -> bool:
        """Whether a family that nothing says what it is has changing numbers of each joint."""
        known = is_no_torque(family.words.replace("_", " "), family.unit)
        if known or self.field(family) not in ("", "joint_torque") or not self.fits(family, "joint_torque"):
            return False
        values = side_by_side(self.sample, family.columns)
        return values.dtype.kind in "fiu" and bool((np.ptp(values, axis=0) > 0).any())

    def joints_of(self, family: Family) -> set[str]:
        """Joints of the robot that a family names."""
        if "{joint}" not in family.pattern:
            return set()
        return set(family.by_name) or {f"{name}{self._suffix}" for name in family.names if name}

    def _all_named(self, families: Sequence[Family]) -> set[str]:
        """Joints that any column names, if more than half of them; none where columns name fewer."""
        named = {name for one in families for name in self.joints_of(one)}
        return named if 2 * len(named) > len(self.robot.joints) else set()

    def field(self, family: Family) -> str:
        """The field that a family probably is."""
        name, axes = family.proposed, len(family.axes) == 3
        if not name and "time" in quantities_with(family.unit) and increases(self.sample[family.columns[0]]):
            return "time"
        if not name and "{joint}" in family.pattern and _MOMENTS & set(words_of(family.pattern)):
            return "joint_torque"
        if not name and axes and re.fullmatch(OF_BASE, family.stem) and family.unit_may_be("length"):
            return "base_position_world"
        of_foot = "{contact}" in family.pattern or _FOOT.search(family.words) is not None
        of_force = name == "contact_force_normal" or FORCE.search(family.pattern) or MOMENT.search(family.pattern)
        shape = self.shape(family)
        if of_force and ((axes and of_foot) or (len(family.columns) == 1 and shape == (len(self.robot.feet), 3))):
            return "contact_wrench_local"
        if of_foot and (_SIDEWAYS.search(family.words) or quantities_with(family.unit)[:1] == ("torque",)):
            return ""
        is_load = of_foot and name == "joint_torque" and "load" in family.words.lower()
        if name == "contact_force_normal" or is_load or (not name and of_foot and not _DRIVE.search(family.words)):
            return "contact_active"  # as a threshold: what it is in newtons nobody knows
        is_vector = name == "joint_position" and axes and not any(family.names)
        return "" if is_vector else name  # of the base, or of anything else: see `field_of_base`

    def shape(self, family: Family) -> tuple[int, ...]:
        """What a column or array of a family has of each sample."""
        inner = () if (first := self.sample[family.columns[0]]) is None else first.shape[1:]
        return inner[1:] if len(inner) > 1 and inner[0] == 1 else inner

    def fits(self, family: Family, name: str) -> bool:
        """Whether a family has as many columns as a field."""
        first = self.sample[family.columns[0]]
        if first is None or not first.ndim or name in OF_PLATES:
            return False
        inner = int(np.prod(self.shape(family)))
        count = max(inner, len(family.columns)) if inner == 1 or len(family.columns) == 1 else 0
        if name == "time":
            return count == 1 and (len(first) < 2 or bool(np.ptp(first)))  # all the same: steps
        if ("{contact}" if name.startswith("joint_") else "{joint}") in family.pattern:
            return False
        if name.startswith("joint_"):
            return self._fits_joints(family, name, count)
        if name.startswith("contact_wrench"):
            return count == 6 * len(self.robot.feet) > 0
        if name.startswith("contact_"):
            return count == len(self.robot.feet) > 0 and not any(family.axes)
        axes = "".join(sorted(family.axes)).lower()
        return count == (4 if "quat" in name else 3) and (not axes or axes == ("wxyz" if "quat" in name else "xyz"))

    def _fits_joints(self, family: Family, field: str, count: int) -> bool:
        """Whether a family has a column for each joint, or for each that positions are there of."""
        named = self.joints_of(family)
        slots = {MOTORS[JOINT_ORDERS[name].message] for name in suitable_orders(self.robot.joints)}
        if named:
            most = 2 * len(named) > len(self.robot.joints)
            whole = named == (self.named_joints or set(self.robot.joints))
            whole |= most and field == "joint_torque" and named <= self.named_joints  # of others it is not measured
            if not whole and most:
                self.partial[field] = [x for x in self.robot.joints if x in self.named_joints - named]
        else:
            known = {len(self.robot.joints), len(self.robot.moving), *slots}
            whole = count in known or (self.names_stated and count == len(self.named_joints))
            numbered = not self.names_stated and len(numbered_joints(self.robot.joints, count)) == count > 2
            whole |= numbered and not self._has_rival(family)
            whole |= listed_order(self.sample, "joint", self.robot, count) is not None
        is_motors = bool(family.numbers) and count not in self._with_base
        enough = whole or (count >= len(self.robot.joints) and is_motors)
        return enough and len(self.robot.joints) > 0 and not any(family.axes)

    def _has_rival(self, family: Family) -> bool:
        """Whether another array has as many columns and the same last word, such as the `q` of another limb."""
        named = {name: x for name, x in self.sample.items() if words_of(name)[-1:] == words_of(family.pattern)[-1:]}
        alike = [x for x in named.values() if x is not None and x.shape[1:] == self.shape(family)]
        return len(family.columns) == 1 and len(alike) > 1


_OF_FOOT = re.compile(
    r"foot|feet|sole|ankle|pied|patte|fu(ss|ß)|(?<![a-z])pie(?![a-z])|contact|touch|stance|wrench|grf|(?<![a-z])fts?(?![a-z])",
    re.IGNORECASE,
)
_FORCE = re.compile(r"force|wrench|grf|kraft|f(ue|o)r[cçz]a|(?<![a-z])fts?(?![a-z])", re.IGNORECASE)
_MOMENT = re.compile(r"torque|moment|couple", re.IGNORECASE)
_TOUCH = re.compile(r"contact|touch|stance|pressure", re.IGNORECASE)
_NO_FOOT = re.compile(
    r"hand|wrist|gripper|palm|finger|tool|tcp|motor|temp|current|limit|cop|pos|vel|acc|(?<![a-z])arm(?![a-z])",
    re.IGNORECASE,
)
_IN_WORLD = re.compile(r"world|global|inertial|forces?_w(?![a-z])", re.IGNORECASE)
_LOCAL = re.compile(r"(?<![a-z])local(?![a-z])", re.IGNORECASE)
_COMPONENT = "(?:(?<![A-Za-z])|(?<=[a-z])(?=[FMTCXYZ]))([fmtcFMTC]?)([xyzXYZ])(?![A-Za-z])"
_AXIS = re.compile(f"{_COMPONENT}(?!.*{_COMPONENT})")  # the last
_NUMBER = re.compile(r"(?<=[\[_./' -])(\d)(?=\W*$)")
_PARTS = {"f": "force", "m": "moment", "t": "moment", "c": "moment"}  # c: of a couple
_WHOLE = {("",), ("x", "y", "z"), ("0", "1", "2"), ("0", "1", "2", "3", "4", "5")}
_BARE = re.compile(r"f[nxyz]?|forces?|normal|[xyz]")
_OTHER_WEIGHT = 0.5  # by which a robot's weight may differ from its file's
_CARRIED = 0.3  # of the robot's weight, at least, where forces on the robot add up to it


@dataclass(frozen=True)
class FootReadings:
    """Columns or arrays that are readings of all feet.

    Attributes:
        part: force, moment, wrench (both), or normal, one number or flag of each foot.
        columns: of each foot, by its name in the robot's file, in the order of components.
        patterns: that are these columns, in a map.
    """

    part: str
    columns: Mapping[str, Sequence[str]]
    patterns: Mapping[str, str]
    all_columns: list[str] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "all_columns", [column for of in self.columns.values() for column in of])

    @property
    def family(self) -> Family:
        """The same as columns that belong together, whatever component they are."""
        return Family(self.all_columns[0], self.all_columns, tuple(self.columns), (), ("",), dict(self.patterns))

    def forces(self, sample: FileSample) -> FloatArray:
        """Forces (N, C, 3) of the feet, as the file has them."""
        found = [x for column in self.all_columns if (x := sample[column]) is not None]
        arrays = [np.asarray(x, dtype=float).reshape(len(x), -1) for x in found]
        return np.concatenate(arrays, axis=1).reshape(len(arrays[0]), len(self.columns), -1)[..., :3]


def frame_of_forces(forces: FloatArray, robot: KnownRobot, words: str = "") -> tuple[str, str, int]:
    """The field that forces (N, ..., 3) of all feet are, a note on it, and the sign of those that act on the robot.

    That which `words` in names of columns say; else, as in the world forces of several small feet point along z, the
    world's if these do, and the contacts' for all others.
    """
    known = forces.ndim > 1
    named = _IN_WORLD.search(words) is not None
    is_upright = known and len(robot.feet) > 2 and not _LOCAL.search(words) and point_along_z(forces)
    if not named and not is_upright:
        return WRENCHES[0], "taken to act on the robot, along the axes of the contact frames", 1
    upwards = np.nansum(forces.reshape(len(forces), -1, 3)[..., 2], axis=1) if known else np.zeros(1)
    downwards = float(np.nanmean(upwards)) < -_CARRIED * robot.weight
    acting = "reversed, as they pull the robot down" if downwards else "taken to act on the robot"
    why = "as its name says" if named else "as almost all of them points along z"
    return WRENCHES[1], f"{acting}, along the axes of the world, {why}", -1 if downwards else 1


def find_foot_readings(sample: FileSample, columns: Sequence[str], robot: KnownRobot) -> list[FootReadings]:
    """What columns or arrays say of all feet, where they name these by their sides, other than the robot's file does.

    Args:
        sample: from `read_sample`.
        columns: of numbers, that may be.
        robot: whose feet they are, each on another side.
    """
    by_side = {_side(name, robot): name for name in robot.feet}
    if len(by_side) < len(robot.feet) or frozenset() in by_side or len(robot.feet) < 2:
        return []
    found = defaultdict[tuple[tuple[str, ...], str], dict[str, dict[str, str]]](lambda: defaultdict(dict))
    for column in columns:
        if _is_of_feet(column, robot):
            inner = () if (values := sample[column]) is None else values.shape[1:]
            rest, part, component = _component(column, inner)
            is_flag = (values is not None) and values.dtype.kind == "b" and not inner
            part = part or ("normal" if is_flag else "")  # words or truth values tell, whatever their name is
            foot = by_side.get(_side(rest, robot), "")
            found[limb_and_words(rest)[1], part if foot else ""][foot][component] = column
    out = []
    for (_, part), feet in found.items():
        components = {tuple(sorted(of)) for of in feet.values()}
        if part and set(feet) == set(robot.feet) and len(components) == 1 and components <= _WHOLE:
            out.append(_readings(part, feet, robot.feet))
    apart = [one for one in out if not _is_spelled_alike(one, robot) or _are_vectors(one, sample)]
    return [one for one in apart if _is_surely_of_feet(one, sample, robot)]


def _are_vectors(readings: FootReadings, sample: FileSample) -> bool:
    """Whether readings are an array of each foot, which no pattern of columns describes."""
    return (first := sample[readings.all_columns[0]]) is not None and first.shape[1:] in ((3,), (6,))


def _is_of_feet(column: str, robot: KnownRobot) -> bool:
    stem = split_unit(column)[0]
    of_joint = any(within(name).search(column) for name in robot.joints)
    named = _OF_FOOT.search(stem) or _is_bare(stem)
    return bool(named) and not _NO_FOOT.search(stem) and not is_desired(column) and not of_joint


def _is_bare(stem: str) -> bool:
    """Whether a name says that something is a force, and of which side, but not of what."""
    return all(_BARE.fullmatch(word) for word in limb_and_words(stem)[1])


def _is_surely_of_feet(readings: FootReadings, sample: FileSample, robot: KnownRobot) -> bool:
    """Whether readings say that they are those of feet, or together carry the robot as these do."""
    if not all(_is_bare(split_unit(column)[0]) for column in readings.all_columns):
        return True
    with np.errstate(all="ignore"):
        carried = np.nanmean(np.linalg.norm(np.nansum(readings.forces(sample), axis=1), axis=1)) / robot.weight
    return readings.part != "moment" and bool(1.0 - _OTHER_WEIGHT < carried < 1.0 + _OTHER_WEIGHT)


def _side(text: str, robot: KnownRobot) -> frozenset[str]:
    """The limb that a text means; of a robot with two feet left or right, as of `lf` the left foot."""
    found = limb_and_words(text)[0]
    return found - {"f"} if len(robot.feet) == 2 and "b" not in found else found


def _component(column: str, inner: tuple[int, ...]) -> tuple[str, str, str]:
    """A name without the component in it, what the component is of, "" for nothing known, and the component."""
    stem, unit = split_unit(column)
    if inner in ((3,), (6,)):
        return stem, "wrench" if inner == (6,) and _FORCE.search(stem) else _part_of(stem), ""
    if inner not in ((), (1,)):
        return stem, "", ""
    if found := _AXIS.search(stem):
        rest = f"{stem[: found.start()]} {stem[found.end() :]}"
        return rest, _PARTS.get(found[1].lower()) or _part_of(rest), found[2].lower()
    if found := _NUMBER.search(stem):
        rest = f"{stem[: found.start()]} {stem[found.end() :]}"
        return rest, _part_of(rest), found[1]
    tells = _part_of(stem) == "force" or _TOUCH.search(stem) or quantities_with(unit)[:1] == ("force",)
    return stem, "normal" if tells else "", ""


def _part_of(text: str) -> str:
    is_force = _FORCE.search(text) or "f" in limb_and_words(text)[1]
    return "moment" if _MOMENT.search(text) else "force" if is_force else ""


def _readings(part: str, feet: Mapping[str, Mapping[str, str]], order: Sequence[str]) -> FootReadings:
    sorted_feet = {foot: dict(sorted(feet[foot].items())) for foot in order}
    columns = {foot: list(of.values()) for foot, of in sorted_feet.items()}
    patterns = {foot: _pattern(*next(iter(of.items()))) for foot, of in sorted_feet.items()}
    return FootReadings("wrench" if len(columns[order[0]]) == 6 else part, columns, patterns)


def _pattern(component: str, column: str) -> str:
    """The pattern of the columns of a foot, of which one has the component x or 0."""
    regex = _NUMBER if component.isdigit() else _AXIS
    if not component or (found := regex.search(split_unit(column)[0])) is None:
        return column
    start, end = found.span(1 if component.isdigit() else 2)
    name = "component" if component.isdigit() else "axis" if column[start].islower() else "AXIS"
    return f"{column[:start]}{{{name}}}{column[end:]}"


def _is_spelled_alike(readings: FootReadings, robot: KnownRobot) -> bool:
    """Whether the file names each foot as the robot's file does, but for what that has behind."""
    for suffix in SUFFIXES["contact"]:
        stems = {foot: within(foot.removesuffix(suffix) or foot) for foot in robot.feet}
        if all(stems[foot].search(column) for foot, of in readings.columns.items() for column in of):
            return True
    return False
