"""What foreign columns and arrays hold: `logs.columns` of an experiment file."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from typing import Annotated, TypeVar

from pydantic import BeforeValidator
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError, UnknownNameError, excerpt, join_names
from torchid.logs.column_entries import (
    FRACTIONS,
    KEY,
    Angle,
    ColumnEntry,
    Entry,
    Episodes,
    FlagEntry,
    Flags,
    Gains,
    Names,
    PdLaw,
    Plate,
    Quaternion,
    QuaternionEntry,
    Stamps,
    TimeEntry,
    Torque,
    TorqueEntry,
    Vector,
    Wrench,
    WrenchEntry,
    check_episodes,
)
from torchid.logs.columns import KINDS, component_names, names_field
from torchid.logs.log import WRENCHES
from torchid.logs.unitree import order_by_name, require_joints_of, robot_with_order
from torchid.logs.units import quantities_of, unit_factor
from torchid.settings import STRICT, Name

FILL_IN = "FILL_IN"
"""What `torchid init` writes where a person has to say something."""
_X = TypeVar("_X")
_XYZ, _RPY = ("x", "y", "z"), ("roll", "pitch", "yaw")
#: `{joint}`, `{index}`, `{index:02}`, `{axis}`, `{AXIS}`.
PLACEHOLDER = re.compile(r"\{([^{}:]*)(?::(0\d))?\}")
AXES = ("axis", "AXIS", "component")


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Columns:
    """What the columns of a table, or the arrays of a file, hold; those with names of the log format need no entry.

    Keys are the fields of a log, and:

    Attributes:
        imu_frame: the frame of the URDF that the IMU sits at: no column, but the name itself.
        other_times: entries like `time`, for files without its column.
        joint_order: names of joints by number, for entries without `order`, or the robot whose order it is (`go2`);
            `contact_order`, `sensor_order`: as well.
        joint_name: what the joint that the file calls {joint} is called in the URDF, such as `{joint}_joint`.
        contact_name: as well, of {contact}.
        plates: by pattern of the contact, pose of the force plate whose axes and origin `contact_wrench_world` and
            `contact_wrench_point_world` have.
        rows_of: the column that names the joint of a row, of a table with a row for each joint at each stamp: its
            other columns are then `position.l_knee`, ...
        episodes: where recordings lie side by side in arrays, or in groups of these.
        ignore: columns that are not needed; * and ? stand for others.
    """

    time: Stamps | None = None
    other_times: list[Entry] = dataclasses.field(default_factory=list)
    joint_position: Angle | None = None
    joint_velocity: Entry | None = None
    joint_acceleration: Entry | None = None
    joint_torque: Torque | None = None
    base_quat_xyzw: Quaternion | None = None
    base_quat_wxyz: Quaternion | None = None
    base_position_world: Entry | None = None
    base_linear_velocity_world: Entry | None = None
    base_linear_velocity_base: Entry | None = None
    base_angular_velocity_base: Entry | None = None
    base_angular_velocity_world: Entry | None = None
    base_linear_acceleration_world: Entry | None = None
    base_linear_acceleration_base: Entry | None = None
    base_angular_acceleration_base: Entry | None = None
    base_angular_acceleration_world: Entry | None = None
    contact_active: Flags | None = None
    contact_wrench_local: Wrench | None = None
    contact_wrench_world: Wrench | None = None
    contact_wrench_point_world: Vector | None = None
    contact_normal_world: Entry | None = None
    contact_force_normal: Entry | None = None
    ft_wrench: Wrench | None = None
    imu_frame: Name | None = None
    imu_specific_force: Entry | None = None
    imu_angular_velocity: Entry | None = None
    imu_angular_acceleration: Entry | None = None
    joint_order: Annotated[list[Name | None], BeforeValidator(partial(order_by_name, "joint"))] | None = None
    contact_order: Annotated[list[Name | None], BeforeValidator(partial(order_by_name, "contact"))] | None = None
    sensor_order: list[Name | None] | None = None
    joint_name: Name = "{joint}"
    contact_name: Name = "{contact}"
    plates: dict[Name, Plate] = dataclasses.field(default_factory=dict)
    rows_of: Name | None = None
    episodes: Episodes | None = None
    ignore: Names = dataclasses.field(default_factory=list)

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields of a log that have an entry."""
        return tuple(name for name, entry in vars(self).items() if isinstance(entry, ColumnEntry))

    def order_of(self, entry: ColumnEntry, kind: str) -> list[str | None] | None:
        """Names by number, of an entry for a kind of names (`joint`, ...)."""
        return entry.order or getattr(self, f"{kind}_order")

    def name_of(self, kind: str) -> str:
        """The pattern of the URDF's names of a kind."""
        return str(getattr(self, f"{kind}_name", f"{{{kind}}}"))


def fits(name: str, pattern: str) -> bool:
    """Whether a name fits a pattern, in which * and ? stand for other letters and brackets for themselves."""
    return fnmatchcase(name, pattern.replace("[", "[[]"))


def letters_of(pattern: str) -> int:
    """How much a pattern says: of several that a name fits, the one with most letters counts."""
    return len(re.sub(r"[*?]", "", PLACEHOLDER.sub("", pattern)))


def values_by_name(key: str, given: Mapping[str, _X], labels: Sequence[str]) -> dict[str, _X]:
    """Values by name, of values by pattern: that with most letters counts.

    Raises:
        ConfigError: two that say as much.
        UnknownNameError: a pattern that no name fits.
    """
    out: dict[str, tuple[int, _X]] = {}
    for pattern, value in given.items():
        letters, found = letters_of(pattern), [label for label in labels if fits(label, pattern)]
        if not found and letters:
            raise UnknownNameError.at_field(key, excerpt(pattern), labels)
        for label in found:
            most = out.get(label, (-1, value))
            if most[0] == letters and most[1] != value:
                raise ConfigError.at_field(key, f"two values of {label}", "patterns of which one has more letters")
            out[label] = max(most, (letters, value), key=lambda pair: pair[0])
    return {label: value for label, (_, value) in out.items()}


def values_of_all(key: str, what: str, given: Mapping[str, _X], kind: str, labels: Sequence[str]) -> list[_X]:
    """Values of all names, of values by pattern; errors as `values_by_name`, and ConfigError for a name without one."""
    found = values_by_name(key, given, labels)
    without = [label for label in labels if label not in found]
    if without:
        raise ConfigError.at_field(key, f"no {what} of {without[0]}", f"one for every {kind}; * stands for all others")
    return [found[label] for label in labels]


@dataclasses.dataclass(frozen=True)
class EntryPart:
    """A field of a log, or a part that it is computed from, as one entry gives it.

    Attributes:
        key: below `logs.columns`.
        entry: of the map.
        names_field: `joint_names`, ... or "" without names.
        components: `x`, ...; none for one number each.
        quantities: by component that its unit may be of, as `quantities_of` says; of one number under "".
    """

    key: str
    entry: ColumnEntry
    names_field: str
    components: tuple[str, ...]
    quantities: Mapping[str, tuple[str, ...]]

    @property
    def kind(self) -> str:
        """Word for one of its names: joint, contact or sensor; "" without names."""
        return KINDS.get(self.names_field, "")

    @property
    def placeholders(self) -> tuple[str, ...]:
        """Placeholders that its pattern may have."""
        return (*([self.kind] if self.kind else []), "index", *(AXES if self.components else ()))


def list_parts(columns: Columns) -> dict[str, EntryPart]:
    """All entries that have columns or arrays of their own, by key."""
    parts: dict[str, EntryPart] = {}
    for field in columns.fields:
        entry = getattr(columns, field)
        if entry.column or entry.columns:
            parts[field] = _part(field, field, entry)
        if isinstance(entry, TimeEntry):
            parts |= _fraction_parts(field, entry)
        if isinstance(entry, WrenchEntry):
            for name, quantity in (("force", "force"), ("moment", "torque")):
                if (inner := getattr(entry, name)) is not None:
                    axes = tuple(getattr(inner, "axes", None) or _XYZ)
                    quantities = dict.fromkeys(axes, (quantity,))
                    parts[f"{field}.{name}"] = EntryPart(f"{field}.{name}", inner, names_field(field), axes, quantities)
        if isinstance(entry, QuaternionEntry) and entry.rpy is not None:
            quantities = dict.fromkeys(_RPY, ("angle",))
            parts[f"{field}.rpy"] = EntryPart(f"{field}.rpy", entry.rpy, "", _RPY, quantities)
        if isinstance(entry, TorqueEntry) and entry.pd is not None:
            parts |= _pd_parts(entry.pd)
        if isinstance(entry, TorqueEntry) and entry.current is not None:
            key = f"{field}.current"
            parts[key] = EntryPart(key, entry.current, names_field(field), (), {"": ("current",)})
    return parts


def _fraction_parts(field: str, entry: TimeEntry) -> dict[str, EntryPart]:
    """What is added to whole seconds."""
    given = {f"{field}.{name}": (column, unit) for name, unit in FRACTIONS.items() if (column := getattr(entry, name))}
    entries = {key: ColumnEntry(column=column, unit={"*": unit}) for key, (column, unit) in given.items()}
    return {key: EntryPart(key, more, "", (), {"": ("time",)}) for key, more in entries.items()}


def _part(key: str, field: str, entry: ColumnEntry) -> EntryPart:
    """An entry that is like a field of a log."""
    components = tuple(getattr(entry, "axes", None) or component_names(field))
    raw = isinstance(entry, (FlagEntry, Gains))
    quantities = {name: () if raw else quantities_of(field, name) for name in components or ("",)}
    return EntryPart(key, entry, names_field(field), components, quantities)


def _pd_parts(law: PdLaw) -> dict[str, EntryPart]:
    like = {"position": "joint_position", "velocity": "joint_velocity", "feed_forward": "joint_torque"}
    like |= dict.fromkeys(("kp", "kd"), "joint_torque")
    parts = {}
    for name, field in like.items():
        entry = getattr(law, name)
        if entry is not None and (entry.column or entry.columns):
            parts[f"joint_torque.pd.{name}"] = _part(f"joint_torque.pd.{name}", field, entry)
    return parts


# --------------------------------------------------------------------------------------------------- checks of a map


def check_columns(columns: Columns) -> None:
    """Check whatever of a map does not depend on a file.

    Raises:
        ConfigError: an entry without columns or with two kinds of them, a placeholder that stands for nothing, a name
            twice in an order, a unit that is none.
    """
    for kind in KINDS.values():
        _check_order(f"{KEY}.{kind}_order", getattr(columns, f"{kind}_order"))
    for kind in ("joint", "contact"):
        if columns.name_of(kind).count(f"{{{kind}}}") != 1:
            accepted = f"a pattern with {{{kind}}} once, such as {{{kind}}}_link"
            raise ConfigError.at_field(f"{KEY}.{kind}_name", f"found '{excerpt(columns.name_of(kind))}'", accepted)
    times = [("other_times", entry) for entry in columns.other_times]
    for field, entry in (*((field, getattr(columns, field)) for field in columns.fields), *times):
        _check_given(field, entry)
    _check_plates(columns)
    check_episodes(columns.episodes)
    for part in (*list_parts(columns).values(), *(_part(name, "time", entry) for name, entry in times)):
        _check_part(part)


def _check_order(key: str, order: list[str | None] | None) -> None:
    names = [name for name in order or () if name is not None]
    again = [name for name in names if names.count(name) > 1]
    if again:
        raise ConfigError.at_field(key, f"'{excerpt(again[0])}' twice", "every name once, null for what is left out")
    if order is not None and not names:
        raise ConfigError.at_field(key, "no name", "names in the order of the columns")


def _check_given(field: str, entry: ColumnEntry) -> None:
    """Refuse an entry that says nothing, or the same in two ways."""
    ways = {
        "column": entry.column,
        "columns": entry.columns,
        "pd": getattr(entry, "pd", None),
        "current": getattr(entry, "current", None),
        "always": getattr(entry, "always", None),
        "force": getattr(entry, "force", None),
        "step": getattr(entry, "step", None),
        "rpy": getattr(entry, "rpy", None),
    }
    given = [name for name, value in ways.items() if value]
    own = [name for name in ways if hasattr(entry, name)]
    if isinstance(entry, FlagEntry) and entry.above is not None:
        _check_unscaled(field, [x for x in given if x == "always"], "above")
        given = given or ["above"]
    if len(given) != 1:
        found = f"{' and '.join(given)} together" if given else "nothing that says where it is"
        raise ConfigError.at_field(f"{KEY}.{field}", found, f"one of {', '.join(own)}")
    if given[0] not in ("column", "columns"):
        _check_unscaled(field, [name for name in FRACTIONS if getattr(entry, name, None)], given[0])
        unsaid = ("scale", "order") if given[0] == "step" else ("unit", "scale", "order")
        _check_unscaled(field, [x for x in unsaid if getattr(entry, x)], given[0])
    if isinstance(entry, WrenchEntry) and entry.moment is not None and entry.force is None:
        raise ConfigError.at_field(f"{KEY}.{field}", "moment without force", "force, with or without moment")
    if isinstance(entry, TorqueEntry) and entry.pd is not None:
        _check_law(entry.pd)
    if isinstance(entry, TorqueEntry) and entry.current is not None:
        _check_given(f"{field}.current", entry.current)


def _check_unscaled(field: str, given: list[str], beside: str) -> None:
    if given:
        found = f"{given[0]} beside {beside}, which it says nothing about"
        raise ConfigError.at_field(f"{KEY}.{field}", found, f"{beside} without {given[0]}")


def _check_plates(columns: Columns) -> None:
    if columns.plates and columns.contact_wrench_world is None:
        accepted = f"an entry of {WRENCHES[1]}, readings along the plates' axes, or no plates"
        raise ConfigError.at_field(f"{KEY}.plates", f"given without {KEY}.{WRENCHES[1]}", accepted)


def _check_law(law: PdLaw) -> None:
    key = f"{KEY}.joint_torque.pd"
    if (law.kp is None) != (law.position is None):
        found = "position without kp" if law.kp is None else "kp without position"
        raise ConfigError.at_field(key, found, "kp together with position, the desired one")
    if law.velocity is not None and law.kd is None:
        raise ConfigError.at_field(key, "velocity without kd", "kd, with or without velocity, the desired one")
    if law.kp is None and law.kd is None:
        raise ConfigError.at_field(key, "no gain", "kp with position, or kd, or both")
    for name in ("kp", "kd"):
        gains = getattr(law, name)
        if gains is not None and bool(gains.value) + bool(gains.column) + bool(gains.columns) != 1:
            accepted = "a number, numbers by joint, or a column or an array"
            raise ConfigError.at_field(f"{key}.{name}", "not one of value, column and columns", accepted)


def _check_part(part: EntryPart) -> None:
    """Check patterns, names and units of an entry."""
    key, entry = f"{KEY}.{part.key}", part.entry
    if entry.column and entry.columns:
        raise ConfigError.at_field(key, "column and columns together", "one of the two")
    _check_order(f"{key}.order", entry.order)
    for text in (entry.column, *entry.columns.values()):
        if text == FILL_IN:
            accepted = "a name of a column, or a pattern; torchid init lists what the file has below its map"
            raise ConfigError.at_field(key, f"{FILL_IN}, which is to be filled in", accepted)
        _check_pattern(key, part, text or "")
    if entry.columns and part.components and not part.kind and set(entry.columns) != set(part.components):
        found = f"components {', '.join(entry.columns)}"
        raise ConfigError.at_field(f"{key}.columns", found, f"each of {', '.join(part.components)}")
    if entry.columns and not part.components and not part.kind:
        raise ConfigError.at_field(f"{key}.columns", "several columns", "column, as it is one number")
    quantities = tuple(dict.fromkeys(one for of in part.quantities.values() for one in of))
    for unit in entry.unit.values():
        unit_factor(f"{key}.unit", unit, quantities)


def _check_pattern(key: str, part: EntryPart, text: str) -> None:
    found = [name for name, _ in PLACEHOLDER.findall(text)]
    wrong = [name for name in found if name not in part.placeholders]
    several = [name for name in found if found.count(name) > 1]
    if not wrong and not several and len(set(found) & {part.kind, "index"}) < 2 and len(set(found) & set(AXES)) < 2:
        return
    named = f"{{{(wrong or several or found)[0]}}}"
    allowed = ", ".join(f"{{{name}}}" for name in part.placeholders)
    accepted = f"at most one each of {allowed}, and one of them for the names"
    raise ConfigError.at_field(key, f"{named} in '{excerpt(text)}'", accepted)


def require_names(columns: Columns, known: Mapping[str, Collection[str]]) -> None:
    """Make sure that all names which a map states are those of a robot.

    Args:
        columns: the map.
        known: names by their kind: joint, contact.

    Raises:
        InputError: one that is not.
    """
    if (robot := robot_with_order(columns.joint_order)) and "joint" in known:
        require_joints_of(f"{KEY}.joint_order", robot, known["joint"])
    stated: list[tuple[str, str, Iterable[str | None]]]
    stated = [(kind, f"{kind}_order", getattr(columns, f"{kind}_order") or ()) for kind in known]
    for part in list_parts(columns).values():
        stated.append((part.kind, f"{part.key}.order", part.entry.order or ()))
        stated.append((part.kind, f"{part.key}.columns", part.entry.columns))
    if columns.contact_active is not None:
        stated.append(("contact", "contact_active.always", columns.contact_active.always))
    for kind, key, names in stated:
        given = [name for name in names if name is not None]
        unknown = [name for name in given if kind in known and name not in known[kind]]
        if len(unknown) > 1 and unknown == given:
            found = f"none of {join_names(given)} is a {kind} of the robot; is it the one that was recorded?"
            raise ConfigError.at_field(f"{KEY}.{key}", found, f"names of the robot: {join_names(list(known[kind]))}")
        if unknown:
            raise UnknownNameError.at_field(f"{KEY}.{key}", unknown[0], known[kind])
