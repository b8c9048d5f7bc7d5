"""Forces and flags of feet that a file names by their sides: `left_foot_fx`, `RF_wrench`, `force_pied_avg`."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchid.logs.column_groups import Family
from torchid.logs.column_proposals import is_desired
from torchid.logs.file_samples import FileSample
from torchid.logs.log import WRENCHES, FloatArray
from torchid.logs.name_matching import SUFFIXES, KnownRobot, limb_and_words, within
from torchid.logs.number_proposals import point_along_z
from torchid.logs.units import quantities_with, split_unit

_FOOT = re.compile(
    r"foot|feet|sole|ankle|pied|patte|fu(ss|ß)|(?<![a-z])pie(?![a-z])|contact|touch|stance|wrench|grf|(?<![a-z])fts?(?![a-z])",
    re.IGNORECASE,
)
_FORCE = re.compile(r"force|wrench|grf|kraft|fuerza|(?<![a-z])fts?(?![a-z])", re.IGNORECASE)
_MOMENT = re.compile(r"torque|moment|couple", re.IGNORECASE)
_TOUCH = re.compile(r"contact|touch|stance|pressure", re.IGNORECASE)
_OTHER = re.compile(
    r"hand|wrist|gripper|palm|finger|tool|tcp|motor|temp|current|limit|cop|pos|vel|acc|(?<![a-z])arm(?![a-z])",
    re.IGNORECASE,
)
_IN_WORLD = re.compile(r"world|global|inertial|forces?_w(?![a-z])", re.IGNORECASE)
_LOCAL = re.compile(r"(?<![a-z])local(?![a-z])", re.IGNORECASE)
_COMPONENT = "(?<![A-Za-z])([fmtcFMTC]?)([xyzXYZ])(?![A-Za-z])"
_AXIS = re.compile(f"{_COMPONENT}(?!.*{_COMPONENT})")  # the last
_NUMBER = re.compile(r"(?<=[\[_./' -])(\d)(?=\W*$)")
_PARTS = {"f": "force", "m": "moment", "t": "moment", "c": "moment"}  # c: of a couple
_WHOLE = {("",), ("x", "y", "z"), ("0", "1", "2"), ("0", "1", "2", "3", "4", "5")}
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
            foot = by_side.get(_side(rest, robot), "")
            found[limb_and_words(rest)[1], part if foot else ""][foot][component] = column
    out = []
    for (_, part), feet in found.items():
        components = {tuple(sorted(of)) for of in feet.values()}
        if part and set(feet) == set(robot.feet) and len(components) == 1 and components <= _WHOLE:
            out.append(_readings(part, feet, robot.feet))
    return [one for one in out if not _is_spelled_alike(one, robot)]


def _is_of_feet(column: str, robot: KnownRobot) -> bool:
    stem = split_unit(column)[0]
    of_joint = any(within(name).search(column) for name in robot.joints)
    return bool(_FOOT.search(stem)) and not _OTHER.search(stem) and not is_desired(column) and not of_joint


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
    return "moment" if _MOMENT.search(text) else "force" if _FORCE.search(text) else ""


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
