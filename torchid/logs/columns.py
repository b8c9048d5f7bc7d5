"""The map of foreign columns and arrays, `logs.columns` of an experiment file: its entries and their checks."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from functools import partial
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError, LogError, UnknownNameError, excerpt, join_names
from torchid.logs.log import NAME_FIELDS, SHAPES, VARIANTS, WRENCHES, UnknownFieldError, field_shape, is_quaternion
from torchid.logs.unitree import order_by_name, require_joints_of, robot_with_order
from torchid.logs.units import quantities_of, unit_factor
from torchid.parameters import WRENCH_COMPONENTS
from torchid.settings import STRICT, Name, Number, Positive

KEY = "logs.columns"
FILL_IN = "FILL_IN"
"""Placeholder of `torchid init` for a value that the user must fill in."""

COLUMN_FIELDS = tuple(name for name in (*SHAPES, *VARIANTS) if name not in NAME_FIELDS)
"""Fields of a log that columns of a table may have."""

KINDS = {"joint_names": "joint", "contact_names": "contact", "ft_names": "sensor"}
PLACEHOLDER = re.compile(r"\{([^{}:]*)(?::(0\d))?\}")
"""`{joint}`, `{index}`, `{index:02}`, `{axis}`, `{AXIS}`."""

AXES = ("axis", "AXIS", "component")
MOST_LISTED = 12
"""Most names that a message lists."""

_UNNAMED = re.compile(r"column_\d+")  # of a table of text that has no line of names, by their place
OF_FILE = "::"
"""Between the name of a file and that of a column that others have, too."""

Names = list[Name]
_X = TypeVar("_X")
_Three = tuple[Number, Number, Number]
_GAINS = ("value", "column", "columns", "order", "first_index")
_XYZ = ("x", "y", "z")
_RPY = ("roll", "pitch", "yaw")


def component_names(field: str) -> tuple[str, ...]:
    """Names of the components of a field; none for fields without components."""
    size = field_shape(field)[-1] if len(field_shape(field)) > 1 else None
    if size == 6:
        return WRENCH_COMPONENTS
    if is_quaternion(field):
        return tuple(field.rpartition("_")[2])
    return _XYZ if size == 3 else ()


def names_field(field: str) -> str:
    """The field with the names of a field's columns (`joint_names`, ...), or ""."""
    letter = next((x for x in field_shape(field)[1:2] if isinstance(x, str)), None)
    return next((name for name, letter_of_field in NAME_FIELDS.items() if letter_of_field == letter), "")


def format_pattern(field: str) -> str:
    """The pattern of torchid's own columns of a field, such as `ft_wrench.{sensor}.{axis}`."""
    kind = f".{{{KINDS[names_field(field)]}}}" if names_field(field) else ""
    return field + kind + (".{axis}" if component_names(field) else "")


def unknown_columns(columns: Sequence[str], has_map: bool) -> LogError:
    """The error for columns or arrays that neither the log format nor the map knows."""
    field = columns[0].partition(".")[0]
    if has_map:
        accepted = f"an entry for each column, or its name in {KEY}.ignore"
        return LogError.at_field(KEY, f"no entry for {join_names(columns, MOST_LISTED)}", accepted)
    if len(columns) == 1 and field in COLUMN_FIELDS and "[" not in columns[0]:
        accepted = format_pattern(field).replace("{axis}", "{" + ", ".join(component_names(field)) + "}")
        return LogError.at_field(f"column '{columns[0]}'", "this field has no such component", accepted)
    is_misspelt = field not in COLUMN_FIELDS and difflib.get_close_matches(field, COLUMN_FIELDS, cutoff=0.6)
    if len(columns) == 1 and is_misspelt:
        return UnknownFieldError.at_field(f"column '{columns[0]}'", field, COLUMN_FIELDS)
    reason = f"{len(columns)} unknown: {join_names(columns, MOST_LISTED)}"
    if all(map(_UNNAMED.fullmatch, columns)):
        reason = f"{len(columns)} columns of numbers without a line of names"
    accepted = "names of the log format, or a map of the columns (logs.columns) in an experiment file"
    return LogError.at_field("columns", reason, f"{accepted}; torchid init writes one")


# --------------------------------------------------------------------------------------------------- entries of a map


def for_all(value: Any) -> Any:
    """Values by pattern; a single value becomes the value of all names."""
    return value if isinstance(value, Mapping) else {"*": value}


def _column(value: object) -> object:
    return {"column": value} if isinstance(value, str) else value


def _gains(value: object) -> object:
    if isinstance(value, str):
        return {"column": value}
    if isinstance(value, Gains) or (isinstance(value, Mapping) and set(value) & set(_GAINS)):
        return value
    return {"value": value}


@dataclass(config=STRICT, frozen=True, kw_only=True)
class ColumnEntry:
    """The columns, or the array, of one field.

    Attributes:
        column: its name, or a pattern: `{joint}`, `{contact}` or `{sensor}` stands for a name, `{index}` for its number
            in `order` (or that of a component), `{axis}` for a component (x, y, z; w, x, y, z; fx to mz), `{AXIS}`
            for the same in capitals.
        columns: the column of each name or component, instead of a pattern.
        order: names by number; null for a number without a joint (contact, sensor) of the robot.
        first_index: number of the first name.
        unit: one for all, or by pattern of the name or component; SI units by default.
        scale: factor of the numbers, one for all or by pattern; -1 reverses a sign.
    """

    column: Name | None = None
    columns: dict[Name, Name] = dataclasses.field(default_factory=dict)
    order: Annotated[list[Name | None], Field(min_length=1)] | None = None
    first_index: int = 0
    unit: Annotated[dict[str, Name], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)
    scale: Annotated[dict[str, Number], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)


FRACTIONS = {"nanoseconds": "ns", "microseconds": "us"}
"""Units of the fractions that may be added to whole seconds, by key."""

Entry = Annotated[ColumnEntry, BeforeValidator(_column)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class TimeEntry(ColumnEntry):
    """Stamps as a column.

    Attributes:
        nanoseconds, microseconds: column with the fraction [ns, us], for stamps in two columns.
        step: constant step between samples in the unit, instead of a column.
    """

    nanoseconds: Name | None = None
    microseconds: Name | None = None
    step: Positive | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class AngleEntry(ColumnEntry):
    """Positions of joints; `turn_from`: the smallest angle of the turn, in the unit of the angles.

    Example: an encoder jumps from 359 to 0 deg; with `turn_from: -180`, 359 deg becomes -1 deg.
    """

    turn_from: Annotated[dict[str, Number], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)


@dataclass(config=STRICT, frozen=True, kw_only=True)
class QuaternionEntry(ColumnEntry):
    """The base's orientation as columns of a quaternion.

    Attributes:
        rpy: angles (roll, pitch, yaw) as in a URDF (about the world's x, then y, then z), instead of a quaternion.
    """

    rpy: Entry | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Gains(ColumnEntry):
    """Gains [N m/rad, N m s/rad]: `value` by pattern of the joint or one for all, or columns, or an array (n,)."""

    value: Annotated[dict[str, Number], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)


GainsEntry = Annotated[Gains, BeforeValidator(_gains)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class PdLaw:
    """kp (position - q) + kd (velocity - dq) + feed_forward, with desired values; missing terms are 0."""

    kp: GainsEntry | None = None
    kd: GainsEntry | None = None
    position: Entry | None = None
    velocity: Entry | None = None
    feed_forward: Entry | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class CurrentEntry(ColumnEntry):
    """Motor currents as columns [A]; torques are computed from them.

    Attributes:
        torque_constant: motor torque per current [N m/A], one for all or by pattern of the joint.
        gear_ratio: motor turns per joint turn (radians per metre of a slide), one for all or by pattern of the joint.
    """

    torque_constant: Annotated[dict[str, Number], BeforeValidator(for_all)]
    gear_ratio: Annotated[dict[str, Number], BeforeValidator(for_all)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class TorqueEntry(ColumnEntry):
    """Torques as columns, from a PD law, or from motor currents."""

    pd: PdLaw | None = None
    current: CurrentEntry | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class FlagEntry(ColumnEntry):
    """Contact flags as columns.

    Attributes:
        above: a contact is active while its number is above this; without columns, while its force is [N].
        always: contacts that are active in all samples, instead of columns.
    """

    above: Number | None = None
    always: Names = dataclasses.field(default_factory=list)


@dataclass(config=STRICT, frozen=True, kw_only=True)
class VectorEntry(ColumnEntry):
    """Moments or points as columns of their components; `axes`: components with a column, the others are 0."""

    axes: Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)] | None = None


Vector = Annotated[VectorEntry, BeforeValidator(_column)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class WrenchEntry(ColumnEntry):
    """Wrenches as columns of all components, or as separate forces and moments (x, y, z); missing moments are NaN."""

    force: Entry | None = None
    moment: Vector | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Plate:
    """Pose of a force plate in the world: the axes and the origin of its readings.

    Attributes:
        position: [m], of the origin.
        rpy_deg: [deg], roll, pitch and yaw of the axes as in a URDF: about the world's x, then y, then z.
    """

    position: _Three = (0.0, 0.0, 0.0)
    rpy_deg: _Three = (0.0, 0.0, 0.0)


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Episodes:
    """Several recordings in one file of arrays; they are read one after the other.

    Attributes:
        axis: of the episodes: 0 for arrays (episodes, samples, ...), 1 for (samples, episodes, ...).
        lengths: array with the number of samples of each episode, if arrays are padded.
        groups: instead of an axis, the name of the groups with one episode each, with * for the number: `data/demo_*`.
    """

    axis: Literal[0, 1] = 0
    lengths: Name | None = None
    groups: Name | None = None


Stamps = Annotated[TimeEntry, BeforeValidator(_column)]
Quaternion = Annotated[QuaternionEntry, BeforeValidator(_column)]
Angle = Annotated[AngleEntry, BeforeValidator(_column)]
Torque = Annotated[TorqueEntry, BeforeValidator(_column)]
Flags = Annotated[FlagEntry, BeforeValidator(_column)]
Wrench = Annotated[WrenchEntry, BeforeValidator(_column)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Columns:
    """Meaning of the columns of a table, or of the arrays of a file; names of the log format need no entry.

    Keys are the fields of a log, and:

    Attributes:
        imu_frame: the URDF frame of the IMU: the name itself, not a column.
        other_times: entries like `time`, for files without its column.
        joint_order: joint names by number, for entries without `order`; or the name of a robot with a known order
            (`go2`). `contact_order`, `sensor_order`: likewise.
        joint_name: URDF name of the joint that the file calls {joint}, such as `{joint}_joint`.
        contact_name: the same for {contact}.
        plates: by pattern of the contact, pose of the force plate; `contact_wrench_world` and
            `contact_wrench_point_world` are read in its axes, about its origin.
        rows_of: the column with the joint's name, for a table with one row per joint and stamp; its other columns
            are then `position.l_knee`, ...
        episodes: for arrays, or groups of arrays, with several recordings.
        ignore: columns that are not needed; * and ? stand for other letters.
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

    def name_of(self, kind: str) -> str:
        """The pattern of the URDF's names of a kind."""
        return str(getattr(self, f"{kind}_name", f"{{{kind}}}"))


def fits(name: str, pattern: str) -> bool:
    """Whether a name fits a pattern; * and ? stand for other letters, brackets for themselves."""
    return fnmatchcase(name, pattern.replace("[", "[[]"))


def letters_of(pattern: str) -> int:
    """Number of fixed letters of a pattern: if a name fits several patterns, the one with the most letters counts."""
    return len(re.sub(r"[*?]", "", PLACEHOLDER.sub("", pattern)))


def values_by_name(key: str, given: Mapping[str, _X], labels: Sequence[str]) -> dict[str, _X]:
    """Values by name, from values by pattern; the pattern with the most letters counts.

    Raises:
        ConfigError: two patterns with equally many letters have different values.
        UnknownNameError: no name fits a pattern.
    """
    out: dict[str, tuple[int, _X]] = {}
    for pattern, value in given.items():
        letters = letters_of(pattern)
        matching = [label for label in labels if fits(label, pattern)]
        if not matching and letters:
            raise UnknownNameError.at_field(key, excerpt(pattern), labels)
        for label in matching:
            most = out.get(label, (-1, value))
            if most[0] == letters and most[1] != value:
                raise ConfigError.at_field(key, f"two values for {label}", "one value; the longer pattern counts")
            out[label] = max(most, (letters, value), key=lambda pair: pair[0])
    return {label: value for label, (_, value) in out.items()}


def values_of_all(key: str, what: str, given: Mapping[str, _X], kind: str, labels: Sequence[str]) -> list[_X]:
    """Values of all names, from values by pattern; as `values_by_name`, and ConfigError for a name without a value."""
    values = values_by_name(key, given, labels)
    without = [label for label in labels if label not in values]
    if without:
        raise ConfigError.at_field(key, f"no {what} for {without[0]}", f"one for every {kind}; * stands for all others")
    return [values[label] for label in labels]


@dataclasses.dataclass(frozen=True)
class EntryPart:
    """One entry of a map: a field of a log, or a quantity from which a field is computed.

    Attributes:
        key: below `logs.columns`.
        entry: of the map.
        names_field: `joint_names`, ... or "" without names.
        components: `x`, ...; none for one number each.
        quantities: by component, the quantities of `quantities_of` for its unit; under "" without components.
        is_native: whether its columns have torchid's own names, without an entry in the map.
    """

    key: str
    entry: ColumnEntry
    names_field: str
    components: tuple[str, ...]
    quantities: Mapping[str, tuple[str, ...]]
    is_native: bool = False

    @property
    def kind(self) -> str:
        """Word for one of its names: joint, contact or sensor; "" without names."""
        return KINDS.get(self.names_field, "")

    @property
    def where(self) -> str:
        """Its name in messages."""
        return self.key if self.is_native else f"{KEY}.{self.key}"

    @property
    def patterns(self) -> list[str]:
        """Patterns of its columns."""
        return [text for text in (self.entry.column, *self.entry.columns.values()) if text]


def _part(key: str, field: str, entry: ColumnEntry) -> EntryPart:
    """An entry with the names, components and units of a field."""
    components = tuple(getattr(entry, "axes", None) or component_names(field))
    has_unit = not isinstance(entry, (FlagEntry, Gains))
    quantities = {name: quantities_of(field, name) if has_unit else () for name in components or ("",)}
    return EntryPart(key, entry, names_field(field), components, quantities)


def native_part(field: str) -> EntryPart:
    """The entry of a field whose columns in a table have torchid's own names."""
    kind = FlagEntry if field == "contact_active" else ColumnEntry
    return dataclasses.replace(_part(field, field, kind(column=format_pattern(field))), is_native=True)


def list_parts(columns: Columns) -> dict[str, EntryPart]:
    """All entries that have columns or arrays of their own, by key."""
    parts: list[EntryPart] = []
    for field in columns.fields:
        entry = getattr(columns, field)
        if entry.column or entry.columns:
            parts.append(_part(field, field, entry))
        for name, unit in FRACTIONS.items():
            if column := getattr(entry, name, None):
                parts.append(_part(f"{field}.{name}", "time", ColumnEntry(column=column, unit={"*": unit})))
        for name, quantity in (("force", "force"), ("moment", "torque")):
            if (inner := getattr(entry, name, None)) is not None:
                axes = tuple(getattr(inner, "axes", None) or _XYZ)
                quantities = dict.fromkeys(axes, (quantity,))
                parts.append(EntryPart(f"{field}.{name}", inner, names_field(field), axes, quantities))
        if (angles := getattr(entry, "rpy", None)) is not None:
            parts.append(EntryPart(f"{field}.rpy", angles, "", _RPY, dict.fromkeys(_RPY, ("angle",))))
        if isinstance(entry, TorqueEntry):
            parts += _torque_parts(field, entry)
    return {part.key: part for part in parts}


def _torque_parts(field: str, entry: TorqueEntry) -> list[EntryPart]:
    parts = []
    if entry.current is not None:
        parts.append(EntryPart(f"{field}.current", entry.current, names_field(field), (), {"": ("current",)}))
    for name, like in _LAW.items():
        inner = getattr(entry.pd, name, None)
        if inner is not None and (inner.column or inner.columns):
            parts.append(_part(f"{field}.pd.{name}", like, inner))
    return parts


_LAW = {
    "position": "joint_position", "velocity": "joint_velocity", "feed_forward": "joint_torque",
    "kp": "joint_torque", "kd": "joint_torque",
}  # fmt: skip
"""Fields with the same names, components and units as the parts of a PD law."""


# --------------------------------------------------------------------------------------------------- checks of a map


def check_columns(columns: Columns) -> None:
    """Check the parts of a map that do not depend on a file.

    Raises:
        ConfigError: an entry has no columns, or two kinds of them; a placeholder or a unit is unknown; an order has a
            name twice.
    """
    for kind in KINDS.values():
        _check_order(f"{KEY}.{kind}_order", getattr(columns, f"{kind}_order"))
    for kind in ("joint", "contact"):
        if columns.name_of(kind).count(f"{{{kind}}}") != 1:
            accepted = f"a pattern with one {{{kind}}}, such as {{{kind}}}_link"
            raise ConfigError.at_field(f"{KEY}.{kind}_name", f"found '{excerpt(columns.name_of(kind))}'", accepted)
    times = [("other_times", entry) for entry in columns.other_times]
    for field, entry in (*((field, getattr(columns, field)) for field in columns.fields), *times):
        _check_given(field, entry)
    if columns.plates and columns.contact_wrench_world is None:
        accepted = f"an entry {WRENCHES[1]} with the readings in the plates' axes, or no plates"
        raise ConfigError.at_field(f"{KEY}.plates", f"given without {KEY}.{WRENCHES[1]}", accepted)
    groups = None if columns.episodes is None else columns.episodes.groups
    if groups is not None and (groups.count("*") != 1 or (columns.episodes and columns.episodes.lengths)):
        accepted = "a name with one * for the number, such as data/demo_*, and no lengths"
        raise ConfigError.at_field(f"{KEY}.episodes", f"groups: '{excerpt(groups)}'", accepted)
    for part in (*list_parts(columns).values(), *(_part(name, "time", entry) for name, entry in times)):
        _check_part(part)


def _check_order(key: str, order: list[str | None] | None) -> None:
    names = [name for name in order or () if name is not None]
    again = [name for name in names if names.count(name) > 1]
    if again:
        raise ConfigError.at_field(key, f"'{excerpt(again[0])}' twice", "every name once; null for an unused column")
    if order is not None and not names:
        raise ConfigError.at_field(key, "no name", "names in the order of the columns")


_WAYS = ("column", "columns", "pd", "current", "always", "force", "step", "rpy")
"""Keys for the source of an entry's numbers; each entry has exactly one of them."""


def _check_given(field: str, entry: ColumnEntry) -> None:
    """Refuse an entry with no source of numbers, or with two."""
    key = f"{KEY}.{field}"
    given = [name for name in _WAYS if getattr(entry, name, None)]
    if not given and getattr(entry, "above", None) is not None:
        given = ["above"]
    if len(given) != 1:
        reason = f"{' and '.join(given)} together" if given else "has no column"
        raise ConfigError.at_field(key, reason, f"one of {', '.join(name for name in _WAYS if hasattr(entry, name))}")
    (way,) = given
    unsaid = (
        "scale",
        "order",
        *FRACTIONS,
        *(["unit"] if way != "step" else []),
        *(["above"] if way != "above" else []),
    )
    beside = [name for name in unsaid if getattr(entry, name, None)] if way not in ("column", "columns") else []
    if beside:
        reason = f"{beside[0]} has no effect together with {way}"
        raise ConfigError.at_field(key, reason, f"{way} without {beside[0]}")
    if getattr(entry, "moment", None) is not None and way != "force":
        raise ConfigError.at_field(key, "moment without force", "force, with or without moment")
    if isinstance(entry, TorqueEntry) and entry.pd is not None:
        _check_law(entry.pd)
    if isinstance(entry, TorqueEntry) and entry.current is not None:
        _check_given(f"{field}.current", entry.current)


def _check_law(law: PdLaw) -> None:
    key = f"{KEY}.joint_torque.pd"
    if (law.kp is None) != (law.position is None):
        reason = "position without kp" if law.kp is None else "kp without position"
        raise ConfigError.at_field(key, reason, "kp and the desired position together")
    if law.kd is None and (law.velocity is not None or law.kp is None):
        reason = "no gain" if law.velocity is None else "velocity without kd"
        raise ConfigError.at_field(key, reason, "kp with position, or kd with or without velocity, or both")
    for name in ("kp", "kd"):
        gains = getattr(law, name)
        if gains is not None and bool(gains.value) + bool(gains.column) + bool(gains.columns) != 1:
            accepted = "a number, numbers by joint, a column or an array"
            raise ConfigError.at_field(f"{key}.{name}", "needs exactly one of value, column and columns", accepted)


def _check_part(part: EntryPart) -> None:
    """Check patterns, names and units of an entry."""
    key = f"{KEY}.{part.key}"
    entry = part.entry
    if entry.column and entry.columns:
        raise ConfigError.at_field(key, "column and columns together", "one of the two")
    _check_order(f"{key}.order", entry.order)
    for text in part.patterns:
        if text == FILL_IN:
            accepted = "the name of a column, or a pattern; torchid init lists all columns below its map"
            raise ConfigError.at_field(key, f"still {FILL_IN}", accepted)
        _check_pattern(key, part, text)
    if entry.columns and not part.kind and set(entry.columns) != set(part.components):
        reason = f"components {', '.join(entry.columns)}"
        accepted = f"all of {', '.join(part.components)}" if part.components else "column: this is one number"
        raise ConfigError.at_field(f"{key}.columns", reason, accepted)
    quantities = tuple(dict.fromkeys(quantity for given in part.quantities.values() for quantity in given))
    for unit in entry.unit.values():
        unit_factor(f"{key}.unit", unit, quantities)


def _check_pattern(key: str, part: EntryPart, text: str) -> None:
    allowed = [*([part.kind] if part.kind else []), "index", *(AXES if part.components else ())]
    names = [name for name, _ in PLACEHOLDER.findall(text)]
    wrong = [name for name in names if name not in allowed or names.count(name) > 1]
    if wrong or len({part.kind, "index"} & set(names)) > 1 or len(set(names) & set(AXES)) > 1:
        accepted = f"at most one of each: {', '.join(f'{{{x}}}' for x in allowed)}"
        raise ConfigError.at_field(key, f"{{{(wrong or names)[0]}}} in '{excerpt(text)}'", accepted)


def require_names(columns: Columns, known: Mapping[str, Collection[str]]) -> None:
    """Check that the robot has all names in a map.

    Args:
        columns: the map.
        known: names by their kind: joint, contact.

    Raises:
        InputError: the robot has no such name.
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
            reason = f"the robot has no {kind} {join_names(given)}. Is it the recorded robot?"
            raise ConfigError.at_field(f"{KEY}.{key}", reason, f"names of the robot: {join_names(list(known[kind]))}")
        if unknown:
            raise UnknownNameError.at_field(f"{KEY}.{key}", unknown[0], known[kind])


def as_in_file(value: Any, file: str, others: Collection[str] = ()) -> Any:
    """A map, or a part of one, for one file: without the file's name before its columns.

    Columns by name, such as `{l_foot: "left.csv::f{axis}", r_foot: "right.csv::f{axis}"}`, keep only those of the file,
    if it has any; `others`: the names of all files.
    """
    if isinstance(value, str):
        return value.removeprefix(f"{file}{OF_FILE}")
    if isinstance(value, list):
        return [as_in_file(item, file, others) for item in value]
    if isinstance(value, dict):
        in_file = {key: as_in_file(item, file, others) for key, item in value.items()}
        elsewhere = tuple(f"{other}{OF_FILE}" for other in others if other != file)
        kept = {
            key: item for key, item in in_file.items() if not (isinstance(item, str) and item.startswith(elsewhere))
        }
        return kept or in_file
    is_entry = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return (
        dataclasses.replace(value, **{key: as_in_file(item, file, others) for key, item in vars(value).items()})
        if is_entry
        else value
    )
