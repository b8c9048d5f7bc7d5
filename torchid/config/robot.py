"""The robot of an experiment file, its contacts and its sensors with their noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError
from torchid.logs.signal_noise import STATED_FIELDS
from torchid.problem.extras import CHANNELS
from torchid.robot.tree import MAX_ANGLE, MAX_GAP, Loop
from torchid.robot.xml_files import is_mjcf
from torchid.settings import AUTO, STRICT, Auto, Name, NotNegative, NotNegativeOrAuto, Number, Positive, described


def _at_zero(value: object) -> object:
    """A list of names as a mapping to positions of 0."""
    if isinstance(value, list) and value and all(isinstance(name, str) and name for name in value):
        return dict.fromkeys(value, 0.0)
    return value


MJCF_SUFFIXES = (".xml", ".mjcf")
"""Of a robot's file that is MJCF, where nothing says what it is."""

WELDS_ACCEPTED = "a list of joints or patterns, or a mapping to positions [rad or m]: {'*finger*': 0.3}"
Welds = Annotated[dict[str, FiniteFloat], BeforeValidator(_at_zero)]

BaseTilt = Annotated[
    tuple[Number, Number] | Auto | None,
    described("auto, null, or two angles [rad] about the base's x and y axes: [0.01, -0.02]"),
]

LOOPS_ACCEPTED = "a list of mappings: [{frames: [l_rod_end, l_ankle_pin], type: point}]"
Frames = Annotated[
    list[Name],
    Field(min_length=2, max_length=2),
    described("two frames of the robot: [l_rod_end, l_ankle_pin]"),
]


@dataclass(config=STRICT, frozen=True)
class LoopConfig:
    """A closed loop: two frames of the robot coincide, at a joint that the tree of the robot's file leaves out.

    `type`: point: their origins coincide (ball joint, or a pin between parallel pins); weld: their axes too. `max_gap`
    [m] and `max_angle` [rad]: largest rms error over a log.
    """

    frames: Frames
    type: Literal["point", "weld"] = "point"
    max_gap: Positive = MAX_GAP
    max_angle: Positive = MAX_ANGLE

    @property
    def loop(self) -> Loop:
        """The loop as the robot has it."""
        first, other = self.frames
        return Loop((first, other), self.type, self.max_gap, self.max_angle)


@dataclass(config=STRICT, frozen=True)
class RobotFile:
    """A robot's file: either `urdf` or `mjcf`."""

    urdf: Path | None = None
    mjcf: Path | None = None

    @property
    def path(self) -> Path:
        """The one of both files that is given."""
        return self.urdf or self.mjcf or Path()


def require_one_file(robot: RobotFile) -> None:
    """Refuse a robot without a file or with two. Raises ConfigError: names both keys."""
    if (robot.urdf is None) == (robot.mjcf is None):
        reason = "missing" if robot.urdf is None else "set together with robot.mjcf"
        raise ConfigError.at_field("robot.urdf", reason, "a path to a URDF, or robot.mjcf: a path to a MuJoCo model")


def require_kind(robot: RobotFile) -> None:
    """Refuse a file under the key of the other kind.

    Raises:
        ConfigError: names the key that it belongs under.
        UrdfError: it cannot be read.
    """
    if is_mjcf(robot.path) != (robot.mjcf is not None):
        key, other = ("robot.urdf", "mjcf") if robot.mjcf is None else ("robot.mjcf", "urdf")
        accepted = f"robot: {{{other}: {robot.path.name}}}"
        raise ConfigError.at_field(key, f"'{robot.path}' is not {key[6:].upper()}", accepted)


@dataclass(config=STRICT, frozen=True)
class ConstrainedRobot(RobotFile):
    """A robot's file, with constraints and missing motors of its joints; see `RobotConfig`."""

    weld: Welds = dataclasses.field(default_factory=dict)
    loops: list[LoopConfig] = dataclasses.field(default_factory=list)
    passive: list[str] | None = None


@dataclass(config=STRICT, frozen=True)
class RobotConfig(ConstrainedRobot):
    """The robot.

    Attributes:
        urdf: path to its URDF.
        mjcf: path to a MuJoCo model (extra [sim]); the tree with most degrees of freedom is the robot.
        weld: names or patterns of joints that are held still, at 0 or at a stated position [rad or m].
        loops: closed loops in addition to those of an MJCF file.
        passive: names or patterns of joints without a motor (zero torque); null: those without an actuator in an MJCF
            file with loops.
        base_link: base of a URDF; null: its root.
        fixed_base: whether the base stands still.
        base_tilt: angles about the base's x and y axes from the base in the logs to the base of the file [rad], as on a
            table that is not level; auto: those with the smallest error on the training logs; null: none.
    """

    base_link: str | None = None
    fixed_base: bool = False
    base_tilt: BaseTilt = None

    @property
    def tilt(self) -> tuple[float, float]:
        """The angles, 0 where there are none, or they have not been chosen."""
        return (0.0, 0.0) if self.base_tilt is None or isinstance(self.base_tilt, str) else self.base_tilt


Component = Literal["fx", "fy", "fz", "mx", "my", "mz", "fn"]
COMPONENTS_ACCEPTED = "a list of components: [fx, fy, fz], or [fn] for a force along the ground's normal"
WRENCHES_ACCEPTED = "a mapping from frames of contacts to components: {l_sole: [fx, fy, fz]}"
"""Accepted for measured components of a contact, and of all contacts, in messages."""


def _not_zero(vector: list[float]) -> list[float]:
    if not any(vector):
        raise ValueError("not all 0")
    return vector


Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Normal = Annotated[Vector, AfterValidator(_not_zero), described("three numbers [x, y, z] in the world, not all 0")]
PerJoint = Annotated[
    Positive | dict[Name, Positive],
    described("a number greater than 0, or one by name or pattern of the joints: {'*': 0.5, '*_wrist': 0.02}"),
]
PerAxis = Annotated[
    Positive | tuple[Positive, Positive, Positive],
    described("a number greater than 0, or three for the axes: [x, y, z]"),
]


@dataclass(config=STRICT, frozen=True)
class ContactConfig:
    """A contact at a frame of the robot.

    Attributes:
        frame: its name.
        type: point: a force; line: all but the moment about the line; flat: force and moment.
        line_axis: axis of the frame along a line contact.
        radius: of a rolling sphere (point) or cylinder (line) [m]. auto: of the sphere, wheel, cylinder, or ball of a
            mesh in the robot's file, 0 without one; of a point: of a ball about the origin, if that predicts better.
        centre: of the sphere in the frame [m]; auto: of the shape that gives the radius, else the origin.
        normal: of the ground in the world, if logs do not record it (`contact_normal_world`); null: upwards.
    """

    frame: str
    type: Literal["point", "line", "flat"]
    line_axis: Literal["x", "y", "z"] = "y"
    radius: NotNegativeOrAuto = AUTO
    centre: Annotated[Vector | Auto, described("auto, or three numbers [x, y, z] in the frame [m]")] = AUTO
    normal: Normal | None = None


@dataclass(config=STRICT, frozen=True)
class NoiseConfig:
    """Standard deviations of sensors, of errors of the base rows (`base_`), and of the recorded motion.

    null: estimated from the training logs (`torchid.fitting.noise`; noise of the motion from the high frequencies of
    each log, `torchid.logs.signal_noise`), or the defaults of `SensorNoise` without logs. 0: no noise of the motion.
    `joint_torque`: of all joints, or by name or pattern.
    """

    joint_torque: PerJoint | None = None
    contact_force: Positive | None = None
    contact_moment: Positive | None = None
    base_force: PerAxis | None = None
    base_moment: PerAxis | None = None
    ft_force: Positive | None = None
    ft_moment: Positive | None = None
    joint_position: Annotated[NotNegative, Field(le=1e3)] | None = None
    joint_velocity: Annotated[NotNegative, Field(le=1e3)] | None = None
    base_orientation: Annotated[NotNegative, Field(le=1e3)] | None = None
    angular_velocity: Annotated[NotNegative, Field(le=1e3)] | None = None
    specific_force: Annotated[NotNegative, Field(le=1e3)] | None = None

    @property
    def forces(self) -> dict[str, Any]:
        """What is stated of sensors and base rows, by key."""
        return {name: x for name, x in vars(self).items() if x is not None and name not in STATED_FIELDS}

    @property
    def motion(self) -> dict[str, float]:
        """What is stated of the motion, by key."""
        return {name: x for name, x in vars(self).items() if x is not None and name in STATED_FIELDS}


@dataclass(config=STRICT, frozen=True)
class ChoiceConfig:
    """A named set of sensors, or sensors by name, as under `sensors`. `full` is short for `{set: full}`."""

    set: Literal["full", "contacts", "joints"] | None = None
    joint_torques: list[str] = dataclasses.field(default_factory=list)
    contact_wrenches: dict[str, list[Component]] = dataclasses.field(default_factory=dict)
    ft_sensors: list[str] = dataclasses.field(default_factory=list)

    @property
    def empty(self) -> bool:
        """Whether nothing is chosen."""
        return self.set is None and not (self.joint_torques or any(self.contact_wrenches.values()) or self.ft_sensors)


def _every_channel(value: object) -> object:
    """A scope for every kind of channel, where it is a name alone."""
    return dict.fromkeys(CHANNELS, value) if value in get_args(Scope) else value


def _group(value: object) -> object:
    """A group of patterns, of which one alone needs no list."""
    return [value] if isinstance(value, str) else value


GROUPS_ACCEPTED = "log, all, or a list of groups of joints or frames: [[l_hip, r_hip], '*_knee']"
"""Accepted for the scales of a kind of channels, in messages."""

ChannelKind = Literal["joint_torque", "contact_force", "contact_moment", "ft_force", "ft_moment"]
Scope = Literal["log", "all"]
Scopes = Annotated[dict[ChannelKind, Scope], BeforeValidator(_every_channel)]
Group = Annotated[list[Name], Field(min_length=1), BeforeValidator(_group)]
Groups = Annotated[list[Group], Field(min_length=1)]
Scales = Annotated[
    dict[ChannelKind, Annotated[Scope | Groups, described(GROUPS_ACCEPTED)]], BeforeValidator(_every_channel)
]
SCOPES_ACCEPTED = f"log, all, or a mapping from kinds of channels ({', '.join(CHANNELS)}) to log or all"
"""Accepted for `Scopes`, in messages."""


@dataclass(config=STRICT, frozen=True)
class SensorsConfig(ChoiceConfig):
    """Sensors of a run, their noise and calibration.

    Attributes:
        set: joint torque and contact sensors (full), contact sensors (contacts), or joint torque sensors (joints).
        joint_torques: joints with a torque sensor.
        contact_wrenches: measured components by contact; `fn` alone: the normal force (`contact_force_normal`).
        ft_sensors: fixed joints with a force/torque sensor; may be combined with a named set.
        noise: standard deviations.
        offsets: channels with an unknown offset, for each `log` or for `all`; a scope alone: every kind of channel.
        scales: channels with an unknown scale, likewise; or groups of joints or frames that share one scale.
        gain_error: standard deviation of the gain of each torque sensor; standard errors include it. 0.02 is 2 %.
        on_base_lost: stop (error) or warn if the sensors do not determine the base in a contact state.
    """

    noise: NoiseConfig = dataclasses.field(default_factory=NoiseConfig)
    offsets: Scopes = dataclasses.field(default_factory=dict)
    scales: Scales = dataclasses.field(default_factory=dict)
    gain_error: NotNegative = 0.02
    on_base_lost: Literal["error", "warn"] = "error"


def spelled_out(value: object) -> object:
    """A choice as a mapping, where it may be a name alone."""
    return {"set": value} if isinstance(value, str) else value


CHOICE_ACCEPTED = "full, contacts, joints, or a mapping with sensors by name"
"""Accepted for a choice of sensors, in messages."""

Choice = Annotated[ChoiceConfig, BeforeValidator(spelled_out)]
Sensors = Annotated[SensorsConfig, BeforeValidator(spelled_out)]


def validate_choice(field: str, sensors: ChoiceConfig, may_be_empty: bool = False) -> None:
    """Refuse a named set together with sensors by name, a sensor named twice, and an empty choice.

    Raises:
        ConfigError: one of these.
    """
    if sensors.set is not None and (sensors.joint_torques or sensors.contact_wrenches):
        raise ConfigError.at_field(field, f"set: {sensors.set} together with sensors by name", "one of the two")
    named: dict[str, Sequence[str]] = {"joint_torques": sensors.joint_torques, "ft_sensors": sensors.ft_sensors}
    named |= {f"contact_wrenches.{frame}": components for frame, components in sensors.contact_wrenches.items()}
    for key, names in named.items():
        twice = next((name for k, name in enumerate(names) if name in names[:k]), None)
        if twice is not None:
            raise ConfigError.at_field(f"{field}.{key}", f"'{twice}' is named twice", "each name once")
    if sensors.empty and not may_be_empty:
        accepted = "full, contacts, joints, or joint_torques, contact_wrenches and ft_sensors by name"
        raise ConfigError.at_field(field, "no sensor", accepted)
