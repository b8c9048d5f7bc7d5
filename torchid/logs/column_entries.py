"""Entries of a map of columns: where one field of a log is, or what it is computed from."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError, excerpt
from torchid.settings import STRICT, Name, Number, Positive

KEY = "logs.columns"
Names = list[Name]
_EVERYTHING = "*"
_Three = tuple[Number, Number, Number]
_GAINS = ("value", "column", "columns", "order", "first_index")


def for_all(value: Any) -> Any:
    """A map of values by pattern, where one value is for all names."""
    return value if isinstance(value, Mapping) else {_EVERYTHING: value}


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
        column: its name, or a pattern: `{joint}`, `{contact}` or `{sensor}` stands for a name, `{index}` for the number
            of one in `order` (or of a component), `{axis}` for a component (x, y, z; w, x, y, z; fx to mz), `{AXIS}`
            for the same in capitals.
        columns: by name or component, its column, in place of a pattern.
        order: names, by number; null for a number that is no joint (contact, sensor) of the robot.
        first_index: number of the first of them.
        unit: by pattern of a name or component, or one for all; SI units by default.
        scale: what numbers are multiplied by, likewise: -1 turns a sign.
    """

    column: Name | None = None
    columns: dict[Name, Name] = dataclasses.field(default_factory=dict)
    order: Annotated[list[Name | None], Field(min_length=1)] | None = None
    first_index: int = 0
    unit: Annotated[dict[str, Name], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)
    scale: Annotated[dict[str, Number], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)


FRACTIONS = {"nanoseconds": "ns", "microseconds": "us"}
"""Units of what may be added to whole seconds, by key."""

Entry = Annotated[ColumnEntry, BeforeValidator(_column)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class TimeEntry(ColumnEntry):
    """Stamps as a column.

    Attributes:
        nanoseconds, microseconds: column of what is added to it [ns, us], of stamps in two columns.
        step: in place of a column, how much later each sample is than the one before, in the unit.
    """

    nanoseconds: Name | None = None
    microseconds: Name | None = None
    step: Positive | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class AngleEntry(ColumnEntry):
    """Positions of joints; `turn_from`: where the turn begins that angles are counted in, in their unit.

    Of an encoder that jumps from 359 to 0 deg, -180 makes 359 deg -1 deg.
    """

    turn_from: Annotated[dict[str, Number], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)


@dataclass(config=STRICT, frozen=True, kw_only=True)
class QuaternionEntry(ColumnEntry):
    """The base's orientation as columns of a quaternion.

    Attributes:
        rpy: in its place, angles (roll, pitch, yaw) as a URDF has them: about the world's x, then y, then z.
    """

    rpy: Entry | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Gains(ColumnEntry):
    """Gains [N m/rad, N m s/rad]: `value` by pattern of the joint or one for all, or columns, or an array (n,)."""

    value: Annotated[dict[str, Number], BeforeValidator(for_all)] = dataclasses.field(default_factory=dict)


GainsEntry = Annotated[Gains, BeforeValidator(_gains)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class PdLaw:
    """kp (position - q) + kd (velocity - dq) + feed_forward, with desired values; what is not given is 0."""

    kp: GainsEntry | None = None
    kd: GainsEntry | None = None
    position: Entry | None = None
    velocity: Entry | None = None
    feed_forward: Entry | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class CurrentEntry(ColumnEntry):
    """Currents of motors as columns [A], of which torques are made.

    Attributes:
        torque_constant: by pattern of the joint or one for all, torque of the motor for its current [N m/A].
        gear_ratio: likewise, turns of the motor for one of the joint (radians for a metre of a slide).
    """

    torque_constant: Annotated[dict[str, Number], BeforeValidator(for_all)]
    gear_ratio: Annotated[dict[str, Number], BeforeValidator(for_all)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class TorqueEntry(ColumnEntry):
    """Torques as columns, of a PD law, or of the currents of motors."""

    pd: PdLaw | None = None
    current: CurrentEntry | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class FlagEntry(ColumnEntry):
    """Contact flags as columns.

    Attributes:
        above: contacts are active where the number is above this, in its unit; without columns that of the contact's
            force [N].
        always: contacts that are active throughout, in place of columns.
    """

    above: Number | None = None
    always: Names = dataclasses.field(default_factory=list)


@dataclass(config=STRICT, frozen=True, kw_only=True)
class VectorEntry(ColumnEntry):
    """Moments or points as columns of their components; `axes`: those that have one, others are 0."""

    axes: Annotated[list[Literal["x", "y", "z"]], Field(min_length=1)] | None = None


Vector = Annotated[VectorEntry, BeforeValidator(_column)]


@dataclass(config=STRICT, frozen=True, kw_only=True)
class WrenchEntry(ColumnEntry):
    """Wrenches as columns of all components, or forces and moments each for themselves (x, y, z); no moments: NaN."""

    force: Entry | None = None
    moment: Vector | None = None


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Plate:
    """Pose of a force plate, of the axes and the origin that its readings have, in the world.

    Attributes:
        position: [m], of the origin.
        rpy_deg: [deg], roll, pitch and yaw of the axes as in a URDF: about the world's x, then y, then z.
    """

    position: _Three = (0.0, 0.0, 0.0)
    rpy_deg: _Three = (0.0, 0.0, 0.0)


@dataclass(config=STRICT, frozen=True, kw_only=True)
class Episodes:
    """Recordings side by side in a file of arrays, which become one after the other.

    Attributes:
        axis: of arrays, that counts them: 0 of (episodes, samples, ...), 1 of (samples, episodes, ...).
        lengths: array with the number of samples of each, where arrays are filled up behind these; or one of these,
            which is 0, NaN or its last sample from there on.
        groups: in place of an axis, name of the groups that hold one each, with * for their number: `data/demo_*`.
    """

    axis: Literal[0, 1] = 0
    lengths: Name | None = None
    groups: Name | None = None


def check_episodes(entry: Episodes | None) -> None:
    """Raise ConfigError where groups have no number, or lengths beside them."""
    if entry is not None and entry.groups is not None and (entry.groups.count("*") != 1 or entry.lengths is not None):
        found = "lengths beside groups" if entry.lengths is not None else f"groups: '{excerpt(entry.groups)}'"
        accepted = "a name with one * for the number of a group, such as data/demo_*, without lengths"
        raise ConfigError.at_field(f"{KEY}.episodes", found, accepted)


Stamps = Annotated[TimeEntry, BeforeValidator(_column)]
Quaternion = Annotated[QuaternionEntry, BeforeValidator(_column)]
Angle = Annotated[AngleEntry, BeforeValidator(_column)]
Torque = Annotated[TorqueEntry, BeforeValidator(_column)]
Flags = Annotated[FlagEntry, BeforeValidator(_column)]
Wrench = Annotated[WrenchEntry, BeforeValidator(_column)]


OF_FILE = "::"
"""Between the name of a file and that of a column that others have, too."""


def as_in_file(value: Any, file: str, others: Collection[str] = ()) -> Any:
    """A map, or a part of one, with the names of a file's columns without that of the file before them.

    Of columns by name, such as `{l_foot: "left.csv::f{axis}", r_foot: "right.csv::f{axis}"}`, those of the file alone,
    if it has any; `others`: the names of all files.
    """
    if isinstance(value, str):
        return value.removeprefix(f"{file}{OF_FILE}")
    if isinstance(value, list):
        return [as_in_file(one, file, others) for one in value]
    if isinstance(value, dict):
        own = {key: as_in_file(one, file, others) for key, one in value.items()}
        elsewhere = tuple(f"{other}{OF_FILE}" for other in others if other != file)
        kept = {key: one for key, one in own.items() if not (isinstance(one, str) and one.startswith(elsewhere))}
        return kept or own
    is_entry = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return (
        dataclasses.replace(value, **{key: as_in_file(one, file, others) for key, one in vars(value).items()})
        if is_entry
        else value
    )
