"""Which field of a log columns that belong together may be: by their names, units and number."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from torchid.logs.column_groups import Family
from torchid.logs.column_proposals import OF_BASE, OF_PLATES, is_no_torque
from torchid.logs.file_samples import FileSample, increases, listed_order, side_by_side, stated_names
from torchid.logs.joint_orders import JOINT_ORDERS, MOTORS, numbered_joints, suitable_orders
from torchid.logs.name_matching import KnownRobot
from torchid.logs.units import quantities_with

FORCE = re.compile(r"force|(?<![a-z])f\{axis", re.IGNORECASE)
MOMENT = re.compile(r"moment|torque|(?<![a-z])[mt]\{axis", re.IGNORECASE)
"""In patterns of columns."""

_SIDEWAYS = re.compile(r"(?<![a-z])(f[xy]|m[xyz])(?![a-z])", re.IGNORECASE)  # components that tell of no contact
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

    def __init__(self, sample: FileSample, robot: KnownRobot) -> None:
        self.sample, self.robot = sample, robot
        self.stated = stated_names(sample, "joint_names")
        self.names_stated = bool(self.stated) and set(self.stated) <= set(robot.joints)
        self.named_joints = set(self.stated) if self.names_stated else set[str]()
        self.partial, self._suffix = dict[str, list[str]](), ""

    def look_at(self, families: Sequence[Family], more: Mapping[str, str]) -> None:
        """Learn which joints the columns of a file name; `more` as from `find_families`."""
        self._suffix = more.get("joint", "").removeprefix("{joint}")
        self.named_joints = self.named_joints or self._all_named(families)

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
            return count == 1
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
            whole = named == (self.named_joints or set(self.robot.joints))
            if not whole and 2 * len(named) > len(self.robot.joints):
                self.partial[field] = [x for x in self.robot.joints if x in self.named_joints - named]
        else:
            whole = count in (len(self.robot.joints), *slots, *([len(self.named_joints)] if self.names_stated else []))
            whole |= not self.names_stated and len(numbered_joints(self.robot.joints, count)) == count > 2
            whole |= listed_order(self.sample, "joint", self.robot, count) is not None
        enough = whole or (count >= len(self.robot.joints) and bool(family.numbers))
        return enough and len(self.robot.joints) > 0 and not any(family.axes)
