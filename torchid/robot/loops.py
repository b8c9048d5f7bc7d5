"""Closed loops of a robot: pairs of frames that a joint, cut to make a tree, keeps together; joints without a motor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from torchid.errors import ConfigError, UnknownNameError, warn
from torchid.parameters import Array
from torchid.robot.urdf import TreeJoint, parse_xml
from torchid.robot.welds import matching_joints
from torchid.robot.xml_files import OWN

LOOPS_FIELD, PASSIVE_FIELD = "robot.loops", "robot.passive"
MAX_GAP, MAX_ANGLE = 0.005, 0.05
"""Rms distance [m] and angle [rad] over a log up to which a loop counts as closed, unless it states its own."""


@dataclass(frozen=True)
class Loop:
    """A loop closure (a cut joint): two frames of the robot that coincide.

    `frames`: names of links. `kind`: "point" keeps their origins together (a ball joint, MuJoCo's `connect`), "weld"
    their axes too. What it exerts acts on both bodies, equal and opposite, and is not measured. `max_gap` [m] and
    `max_angle` [rad]: rms over a log by which they may be apart.
    """

    frames: tuple[str, str]
    kind: str = "point"
    max_gap: float = MAX_GAP
    max_angle: float = MAX_ANGLE

    @property
    def components(self) -> tuple[int, ...]:
        """Indices in `WRENCH_COMPONENTS` of what it can exert."""
        return tuple(range(3 if self.kind == "point" else 6))

    @property
    def label(self) -> str:
        """Both frames."""
        return f"{self.frames[0]} and {self.frames[1]}"


def loops_of_file(path: Path) -> tuple[Loop, ...]:
    """The loops that a robot's file has: `connect` and `weld` of MJCF; a URDF never says.

    Warns:
        TorchidWarning: some hold the robot to what is no part of it, as a mocap body: contacts, if they are named.
    """
    root = parse_xml(path).getroot()
    for tie in root.findall(f"{OWN}tie"):
        held = "holds the robot to what is no part of it, by a force that is left out"
        contact = f"{{frame: {tie.get('frame')}, type: {'point' if tie.get('type') == 'point' else 'flat'}}}"
        warn(f"{path}: {tie.get('where')}: {held}; where it acted in a log: contacts: [{contact}]")
    found = root.findall(f"{OWN}loop")
    return tuple(Loop((str(x.get("one")), str(x.get("other"))), str(x.get("type"))) for x in found)


def validate_loops(loops: Sequence[Loop], links: Mapping[str, tuple[int, Array]]) -> None:
    """Make sure that loops are between different bodies of a robot.

    Args:
        loops: by the number that they have in the settings.
        links: body and pose of each link.

    Raises:
        UnknownNameError: a frame that the robot does not have.
        ConfigError: two frames of one body.
    """
    for number, loop in enumerate(loops):
        field = f"{LOOPS_FIELD}[{number}].frames"
        for frame in loop.frames:
            if frame not in links:
                raise UnknownNameError.at_field(field, frame, links)
        one, other = loop.frames
        if links[one][0] == links[other][0]:
            found = f"{one} and {other}, frames of one body, which no joint moves"
            raise ConfigError.at_field(field, found, "frames of two bodies that joints move relative to each other")


def passive_joints(joints: Sequence[TreeJoint], names: Sequence[str] | None, moving: Iterable[str]) -> tuple[str, ...]:
    """Names of joints without a motor, in the order of `moving`.

    Args:
        joints: of the robot's file.
        names: names or patterns; None for those that the file says are passive.
        moving: the robot's independent joints.

    Raises:
        UnknownNameError: a name that no joint has which moves by itself.
        ConfigError: a pattern that matches none.
    """
    moving = list(moving)
    if names is None:
        chosen = {joint.name for joint in joints if joint.passive}
    else:
        chosen = {name for key in names for name in matching_joints(PASSIVE_FIELD, key, moving)}
    return tuple(name for name in moving if name in chosen)
