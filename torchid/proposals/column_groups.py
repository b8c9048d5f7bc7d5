"""Foreign columns that belong together, as those that differ in a name, number or axis, and a map proposed for them."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.logs.arrays import TRANSPOSED
from torchid.logs.column_entries import OF_FILE
from torchid.logs.column_map import PLACEHOLDER
from torchid.logs.name_matching import SUFFIXES, KnownRobot, is_current, joints_by_place, propose_field, spelled, within
from torchid.logs.units import OF_JOINTS, quantities_with, split_unit
from torchid.proposals.file_samples import FileSample

_NUMBER = re.compile(r"\d+")
_AXIS = re.compile(
    r"(?<=[._\-/\[ '])([wxyz])(?=$|\]|'\)?$)|(?<=[a-zFM_.\-/\[ \u0080-\uffff])([WXYZ])(?=$|[\]])|(?<=[a-zFM])([wxyz])$"
    r"|(?<=[a-z])([XYZ])(?=[/_.])|^([wxyzWXYZ])$|(?<=(?<![A-Za-z])[PQ])([WXYZwxyz])$",
)
_BEHIND = re.compile(
    r"([_./ \[-]+\{axis\}|[_./ \[-]*\{(?!axis\})[^{}]*\})\]?$"
)  # a unit, as in `acc_g.{axis}`, not `l_m{axis}`


_OF_A_JOINT = {"imu_angular_velocity": "joint_velocity", "imu_specific_force": "joint_acceleration"}


@dataclass(frozen=True)
class Family:
    """Columns of one pattern.

    Attributes:
        pattern: with placeholders, as in a map.
        columns: in their order.
        names: of joints or contacts, as the file has them.
        numbers: in the names; none where there are none.
        axes: likewise.
        by_name: by name of the URDF, its column, where the file spells names in another way; a pattern does not do.
        by_place: whether names are those of limbs with a number of the joint in each.
        units: by column, where joints have different ones.
    """

    pattern: str
    columns: list[str]
    names: tuple[str, ...]
    numbers: tuple[int, ...]
    axes: tuple[str, ...]
    by_name: Mapping[str, str] = field(default_factory=dict)
    by_place: bool = False
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def proposed(self) -> str:
        """The field that its words say it is, "" if none; of joints angular velocity and acceleration are theirs."""
        found = propose_field(self.words)
        return _OF_A_JOINT.get(found, found) if "{joint}" in self.pattern else found

    @property
    def words(self) -> str:
        """All that is neither a name nor a number nor an axis."""
        return PLACEHOLDER.sub(" ", self.pattern)

    @property
    def stem(self) -> str:
        """The same without a unit, in small letters."""
        return PLACEHOLDER.sub(" ", split_unit(self.pattern)[0]).strip(" _./").lower()

    @property
    def as_ignored(self) -> list[str]:
        """Patterns of `ignore` that its columns fit, as the file names them; no column of another name fits all."""
        pattern = PLACEHOLDER.sub("*", self.pattern.removesuffix(TRANSPOSED))
        return self.columns if pattern == "*" or "*" in pattern.rpartition(OF_FILE)[0] else [pattern]

    @property
    def unit(self) -> str:
        """What the columns say of their unit, "" if nothing."""
        return split_unit(_BEHIND.sub("", self.pattern))[1] or split_unit(self.pattern)[1]

    @property
    def is_current(self) -> bool:
        """Whether the columns may be currents of motors."""
        return is_current(self.words.replace("_", " "), self.unit)

    def unit_may_be(self, quantity: str) -> bool:
        """Whether they say no unit, or one of a quantity."""
        return not self.unit or quantity in quantities_with(self.unit)

    @property
    def entry(self) -> dict[str, object]:
        """Where the columns are, as a map says it."""
        return {"columns": dict(self.by_name)} if self.by_name else {"column": self.pattern}

    @property
    def counted_entry(self) -> dict[str, object]:
        """Likewise, with the number that counting begins with."""
        first = min(self.numbers, default=0)
        return self.entry | ({"first_index": first} if first > 0 else {})


@dataclass(frozen=True)
class _Stems:
    """What the file calls joints or contacts, with their names in the URDF.

    Attributes:
        kind: joint or contact.
        names: by what is in the file.
        suffix: that the URDF's names have more.
        find: the place of a name in a column.
        exact: whether the file spells names as the URDF does.
        by_place: whether it has limbs with a number of the joint in each.
    """

    kind: str
    names: Mapping[str, str] = field(default_factory=dict)
    suffix: str = ""
    find: Callable[[str], re.Pattern[str]] = within
    exact: bool = True
    by_place: bool = False


def find_families(columns: Sequence[str], robot: KnownRobot) -> tuple[list[Family], dict[str, str]]:
    """Columns by pattern, in their order; and what the file's names are in the URDF, by kind, where that is more.

    Args:
        columns: of a file.
        robot: whose joints and contacts they may name.
    """
    joints = _stems("joint", columns, robot.joints, _Stems("joint"))
    alike = Counter(hole for column in columns for hole, _ in _numbers(split_unit(column)[0]))
    if 2 * len(joints.names) <= len(robot.joints) and (places := joints_by_place(columns, robot.joints)):
        joints = _Stems("joint", places, exact=False, by_place=True)
    kinds = (joints, _stems("contact", columns, robot.feet, joints))
    with_axes = [_pattern(column, kinds, alike) for column in columns]
    axes = defaultdict[str, set[str]](set)
    for pattern, _, _, axis in with_axes:
        axes[pattern].add(axis)
    found = defaultdict[str, list[tuple[str, str, str, str]]](list)
    for column, split in zip(columns, with_axes, strict=True):
        alone = len(axes[split[0]]) == 1  # the y of velocity, the z of the one component that was recorded
        pattern, name, number, axis = _pattern(column, kinds, alike, False) if alone else split
        found[pattern].append((column, name, number, axis))
    out = []
    for patterns in _apart_from_units(found):
        some = [one for pattern in patterns for one in found[pattern]]
        joined = len(patterns) > 1
        out += [_with_units(patterns[0], some, kinds[0])] if joined else _families(patterns[0], some, kinds)
    more = {one.kind: f"{{{one.kind}}}{one.suffix}" for one in kinds if one.names and one.exact and one.suffix}
    return out, more


def _apart_from_units(found: Mapping[str, Sequence[tuple[str, str, str, str]]]) -> list[list[str]]:
    """Patterns of columns, those together that differ in units that joints may have side by side, most columns first.

    A slide's position is in mm, that of a hinge in degrees.
    """
    by_stem = defaultdict[str, list[str]](list)
    for pattern in found:
        of_joints = "{joint}" in pattern or "{index}" in pattern
        by_stem[split_unit(pattern)[0] if of_joints else pattern].append(pattern)
    out = []
    for patterns in by_stem.values():
        units = [set(quantities_with(unit)) for one in patterns if (unit := split_unit(one)[1])]
        members = [(name or number, axis) for one in patterns for _, name, number, axis in found[one]]
        once = len(set(members)) == len(members) and not any(axis for _, axis in members)
        if len(patterns) > 1 and once and any(all(unit & set(pair) for unit in units) for pair in OF_JOINTS.values()):
            out.append(sorted(patterns, key=lambda one: -len(found[one])))
        else:
            out += [[one] for one in patterns]
    return out


def _with_units(pattern: str, members: Sequence[tuple[str, str, str, str]], joints: _Stems) -> Family:
    """The family of columns of joints whose units differ."""
    members = sorted(members, key=lambda member: int(member[2] or 0))
    by_name = {joints.names[name]: column for column, name, *_ in members if name}
    return Family(
        pattern,
        [column for column, *_ in members],
        tuple(name for _, name, *_ in members),
        tuple(int(number) for *_, number, _ in members if number),
        ("",),
        by_name,
        joints.by_place,
        {column: split_unit(column)[1] for column, *_ in members},
    )


def _families(pattern: str, members: Sequence[tuple[str, str, str, str]], kinds: Sequence[_Stems]) -> list[Family]:
    """The family of a pattern; or each column for itself where some are missing."""
    texts, names, numbers, axes = ([x for x in dict.fromkeys(of)] for of in zip(*members, strict=True))
    if "{index}" in pattern and (widths := {len(x) for x in numbers}) == {2} and numbers[0].startswith("0"):
        pattern = pattern.replace("{index}", f"{{index:0{widths.pop()}}}")
    whole = len(members) == max(len(names), 1) * max(len(numbers), 1) * max(len(axes), 1)
    kind = next((one for one in kinds if f"{{{one.kind}}}" in pattern), None)
    other = kind is not None and not kind.exact
    if not whole or (len(members) == 1 and PLACEHOLDER.search(pattern)) or (other and any(axes)):
        return [Family(column, [column], ("",), (), ("",)) for column in texts]
    by_place = kind is not None and kind.by_place
    by_name = {kind.names[name]: column for column, name, *_ in members} if kind is not None and other else {}
    if kind is not None and f"{{{kind.kind}}}" in pattern.rpartition(OF_FILE)[0]:
        by_name = {kind.names[name]: pattern.replace(f"{{{kind.kind}}}", name) for name in names}  # a file for each
    return [
        Family(
            pattern,
            texts,
            tuple(names),
            tuple(int(x) for x in numbers if x),
            tuple(axes),
            by_name,
            by_place,
        )
    ]


def _stems(kind: str, columns: Sequence[str], names: Sequence[str], others: _Stems) -> _Stems:
    """What the file calls joints or contacts, where no longer one of others fits; spelled in another way if need be."""
    best = _Stems(kind)
    longest = {
        column: max((len(x) for x in others.names if others.find(x).search(column)), default=0) for column in columns
    }
    for exact, find in ((True, within), (False, spelled)):
        for suffix in SUFFIXES[kind]:
            if not names or (exact and not all(name.endswith(suffix) and len(name) > len(suffix) for name in names)):
                continue
            stems = {name.removesuffix(suffix) or name: name for name in names}
            seen = {}
            for stem, name in stems.items():
                regex = find(stem)
                if any(n < len(stem) and regex.search(x) for x, n in longest.items()):
                    seen[stem] = name
            if len(seen) > len(best.names):
                best = _Stems(kind, seen, suffix, find, exact)
        if len(best.names) == len(names):
            break
    return best


def _numbers(stem: str) -> list[tuple[str, re.Match[str]]]:
    """The numbers in a name, with what is around each."""
    return [(f"{stem[: found.start()]}#{stem[found.end() :]}", found) for found in _NUMBER.finditer(stem)]


def _pattern(
    column: str, kinds: Sequence[_Stems], alike: Mapping[str, int], split_axes: bool = True
) -> tuple[str, str, str, str]:
    """A column with placeholders, and the name, number and axis in their places; of numbers that of most columns."""
    number = axis = ""
    fitting = [(name, one) for one in kinds for name in one.names if one.find(name).search(column)]
    name, of = max(fitting, key=lambda pair: len(pair[0]), default=("", _Stems("")))
    if name:
        column = of.find(name).sub(f"{{{of.kind}}}", column, count=1)
    stem, _ = split_unit(column)
    column, behind = stem, column[len(stem) :]
    if not name and (numbers := _numbers(column)):
        _, match = max(numbers, key=lambda pair: alike.get(pair[0], 0))
        column, number = f"{column[: match.start()]}{{index}}{column[match.end() :]}", match[0]
    if split_axes and (found := _AXIS.search(column)):
        axis = found[0]
        column = f"{column[: found.start()]}{{{'axis' if axis.islower() else 'AXIS'}}}{column[found.end() :]}"
    return column + behind, name, number, axis


_FEWEST, _ALIKE = 20, 0.9  # samples of which slopes are compared, and their correlation with velocities
_UNIT = 1e-3  # of the length of quaternions from 1
_TWIST = (*["base_linear_velocity_world"] * 3, *["base_angular_velocity_world"] * 3)  # columns of it


def split_arrays(sample: FileSample, names: Sequence[str], joints: Collection[int]) -> list[tuple[str, str, str]]:
    """Arrays that hold several fields side by side: their name, the columns and the field that these are.

    Those of simulators and of libraries for dynamics: a position of the base and a quaternion, whose length is 1
    throughout, with or without positions of joints or six velocities behind; beside them velocities and forces, six of
    the base first.

    Args:
        sample: from `read_sample`.
        names: of arrays that may be.
        joints: how many there may be.
    """
    out, width = list[tuple[str, str, str]](), 0
    for name in names:
        array = np.asarray(sample[name])
        if not has_pose(array):
            continue
        out += [(name, "[0:3]", "base_position_world"), (name, "[3:7]", "base_quat_wxyz")]
        if array.shape[1] - 7 in joints:
            out.append((name, "[7:]", "joint_position"))
            width = array.shape[1] - 7
        elif (n := (array.shape[1] - 7 - len(_TWIST)) // 2) in {0, *joints} and array.shape[1] == 13 + 2 * n:  # a state
            out += [(name, f"[{7 + n}:{10 + n}]", _TWIST[0]), (name, f"[{10 + n}:{13 + n}]", _TWIST[3])]
            out += [(name, f"[7:{7 + n}]", "joint_position"), (name, f"[{13 + n}:]", "joint_velocity")] if n else []
        break
    if not out:
        return _fixed_states(sample, names, joints)
    for name in names if out else ():
        shape, field = np.asarray(sample[name]).shape, propose_field(name)
        if width and shape[1:] == (6 + width,) and field in ("joint_velocity", "joint_torque"):
            of_base = [(name, "[0:3]", _TWIST[0]), (name, "[3:6]", _TWIST[3])] if field == "joint_velocity" else []
            out += [*of_base, (name, "[6:]", field)]
        elif shape[1:] == (len(_TWIST),) and field == _TWIST[0] and (name, "[7:10]", field) not in out:
            out += [(name, "[0:3]", _TWIST[0]), (name, "[3:6]", _TWIST[3])]
    return out


def _fixed_states(sample: FileSample, names: Sequence[str], joints: Collection[int]) -> list[tuple[str, str, str]]:
    """Positions and velocities of joints in the first array that is a state of a robot with a fixed base."""
    for name in names:
        if _is_state(array := np.asarray(sample[name]), joints):
            n = array.shape[1] // 2
            return [(name, f"[0:{n}]", "joint_position"), (name, f"[{n}:]", "joint_velocity")]
    return []


def _is_state(array: NDArray[Any], joints: Collection[int]) -> bool:
    """Whether the first half of the columns of an array (N, 2 n) are positions, and the rest their slopes."""
    if array.ndim != 2 or array.shape[1] // 2 not in joints or array.shape[1] % 2 or len(array) < _FEWEST:
        return False
    position, velocity = np.hsplit(array.astype(float), 2)
    slope = np.gradient(position, axis=0)
    with np.errstate(all="ignore"):
        alike = np.nansum(slope * velocity) / np.sqrt(np.nansum(slope**2) * np.nansum(velocity**2))
    return bool(alike > _ALIKE)


def has_pose(array: NDArray[Any]) -> bool:
    """Whether columns 3 to 6 of an array (N, k) are a quaternion."""
    if array.ndim != 2 or array.shape[1] < 7 or array.dtype.kind != "f" or len(array) < 3:
        return False
    length = np.linalg.norm(array[:, 3:7], axis=1)
    known = length[np.isfinite(length)]
    return bool(len(known)) and float(np.abs(known - 1.0).max()) < _UNIT


_PART = re.compile(r"\[\d*:\d*\]$")  # columns of an array


@dataclass
class MapProposal:
    """What `logs.columns`, or `logs.topics`, may say of a log.

    Attributes:
        columns: the map, as it stands in a file.
        notes: what was guessed, by key.
        left_out: columns that it ignores.
        not_numbers: of these those that are no numbers, but texts or lists of several lengths.
        key: columns or topics.
        fields: of the log, that a map of topics gives.
        lacking: joints of the robot without columns, if most have some.
        partial: by field that is left out for it, joints that have columns of other fields alone.
        like_torques: columns that no field takes, one for each joint, of a log without torques.
        guessed_orders: of joints and contacts, by key, that nothing in the file says.
    """

    columns: dict[str, Any] = field(default_factory=dict)
    not_numbers: list[str] = field(default_factory=list)
    key: str = "columns"
    fields: set[str] = field(default_factory=set)
    notes: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    lacking: list[str] = field(default_factory=list)
    partial: dict[str, list[str]] = field(default_factory=dict)
    like_torques: list[Family] = field(default_factory=list)
    guessed_orders: set[str] = field(default_factory=set)

    def guess_order(self, key: str, order: object, why: str) -> None:
        """Give joints or contacts an order that nothing in the file says."""
        self.columns[key], self.notes[key] = order, why
        self.guessed_orders.add(key)

    def leave_out(self, name: str) -> None:
        """Ignore the columns of an entry instead of reading them, but for those that are a part of an array."""
        entry = self.columns.pop(name)
        texts = entry["columns"].values() if "columns" in entry else [entry["column"]]
        patterns = {PLACEHOLDER.sub("*", text) for text in texts if not _PART.search(text)}
        if ignored := sorted({*self.columns.pop("ignore", []), *patterns}):
            self.columns["ignore"] = ignored
