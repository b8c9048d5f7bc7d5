"""The robot of an experiment file."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, FiniteFloat, PlainSerializer, PlainValidator, TypeAdapter
from pydantic.dataclasses import dataclass

from torchid.config.sensors import as_list
from torchid.errors import ConfigError
from torchid.robot.constraints import MAX_ANGLE, MAX_GAP, Loop
from torchid.robot.xml_files import is_mjcf
from torchid.settings import AUTO, STRICT, Number, Positive


def _at_zero(value: object) -> object:
    """A list of names as a mapping to positions of 0."""
    if isinstance(value, list) and value and all(isinstance(name, str) and name for name in value):
        return dict.fromkeys(value, 0.0)
    return value


MJCF_SUFFIXES = (".xml", ".mjcf")
"""Of a robot's file that is MJCF, where nothing says what it is."""

WELDS_ACCEPTED = "a list of joints or patterns, or a mapping to positions [rad or m]: {'*finger*': 0.3}"
Welds = Annotated[dict[str, FiniteFloat], BeforeValidator(_at_zero)]


def _tilt(value: object) -> object:
    """Two angles, auto or none."""
    if value is None or value == AUTO:
        return value
    try:
        x, y = _ANGLES.validate_python(value)
    except ValueError as error:
        raise ValueError("auto, null, or two angles [rad] about the base's x and y axes: [0.01, -0.02]") from error
    return x, y


_ANGLES: TypeAdapter[list[float]] = TypeAdapter(Annotated[list[Number], Field(min_length=2, max_length=2)])
BaseTilt = Annotated[tuple[float, float] | Literal["auto"] | None, PlainValidator(_tilt), PlainSerializer(as_list)]


LOOPS_ACCEPTED = "a list of mappings: [{frames: [l_rod_end, l_ankle_pin], type: point}]"


def _frames(value: object) -> object:
    if isinstance(value, (list, tuple)) and len(value) == 2 and all(isinstance(name, str) and name for name in value):
        return list(value)
    raise ValueError("two frames of the robot: [l_rod_end, l_ankle_pin]")


Frames = Annotated[list[str], PlainValidator(_frames)]


@dataclass(config=STRICT, frozen=True)
class LoopConfig:
    """A closed loop: two frames of the robot that coincide, as a joint that the tree of the file leaves out keeps them.

    `type`: point for their origins (a ball joint, and a pin between parallel ones), weld for their axes too. `max_gap`
    [m] and `max_angle` [rad]: rms distance over a log up to which they count as together.
    """

    frames: Frames
    type: Literal["point", "weld"] = "point"
    max_gap: Positive = MAX_GAP
    max_angle: Positive = MAX_ANGLE

    @property
    def loop(self) -> Loop:
        """The loop as the robot has it."""
        one, other = self.frames
        return Loop((one, other), self.type, self.max_gap, self.max_angle)


@dataclass(config=STRICT, frozen=True)
class RobotFile:
    """A robot's file, `urdf` or `mjcf`: one of both."""

    urdf: Path | None = None
    mjcf: Path | None = None

    @property
    def path(self) -> Path:
        """The one of both files that is given."""
        return self.urdf or self.mjcf or Path()


def require_one_file(robot: RobotFile) -> None:
    """Refuse a robot of no file or of two. Raises ConfigError: names both keys."""
    if (robot.urdf is None) == (robot.mjcf is None):
        found = "missing" if robot.urdf is None else "set together with robot.mjcf"
        raise ConfigError.at_field("robot.urdf", found, "a path to a URDF, or robot.mjcf: a path to a MuJoCo model")


def require_kind(robot: RobotFile) -> None:
    """Refuse a file under the key of the other kind.

    Raises:
        ConfigError: names the key that it belongs under.
        UrdfError: it cannot be read.
    """
    if is_mjcf(robot.path) != (robot.mjcf is not None):
        key, other = ("robot.urdf", "mjcf") if robot.mjcf is None else ("robot.mjcf", "urdf")
        accepted = f"robot: {{{other}: {robot.path.name}}}"
        raise ConfigError.at_field(key, f"'{robot.path}', no {key[6:].upper()}", accepted)


@dataclass(config=STRICT, frozen=True)
class ConstrainedRobot(RobotFile):
    """A robot's file, and constraints and missing motors of its joints that the file may not state.

    `weld`: names or patterns of joints that are held still, at 0 or at the position [rad or m] that a mapping gives.
    `loops`: closed loops beside those of an MJCF file. `passive`: names or patterns of joints without a motor, whose
    torque is 0; None for those that no actuator of an MJCF file with loops drives.
    """

    weld: Welds = dataclasses.field(default_factory=dict)
    loops: list[LoopConfig] = dataclasses.field(default_factory=list)
    passive: list[str] | None = None


@dataclass(config=STRICT, frozen=True)
class RobotConfig(ConstrainedRobot):
    """The robot, `urdf` or `mjcf`; `base_link` defaults to the URDF's root.

    `mjcf`: a MuJoCo model, read by MuJoCo (the extra [sim]); its tree of most degrees of freedom is the robot.
    `base_tilt`: two angles [rad] about the base's x and y axes by which it is turned from the base that logs record, as
    on a table that is not level; auto, those that leave least of the training logs; None for none.
    """

    base_link: str | None = None
    fixed_base: bool = False
    base_tilt: BaseTilt = None

    @property
    def tilt(self) -> tuple[float, float]:
        """The angles, 0 where there are none, or they have not been chosen."""
        return (0.0, 0.0) if self.base_tilt is None or isinstance(self.base_tilt, str) else self.base_tilt
