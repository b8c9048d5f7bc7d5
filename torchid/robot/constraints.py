"""What constrains joints of a robot: those held at a position, closed loops; and joints without a motor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from torchid.errors import ConfigError, UnknownNameError, join_names, warn
from torchid.parameters import Array
from torchid.robot.tree import joint_origin, joint_transform, resolve_mimics
from torchid.robot.urdf import MOVING_TYPES, TreeJoint, parse_xml, position_limits
from torchid.robot.xml_files import OWN

WELD_FIELD = "robot.weld"

_ROUNDING = 1e-6  # [rad or m] by which a position may exceed a limit: URDFs carry few digits


def weld_positions(path: Path, joints: Sequence[TreeJoint], weld: Mapping[str, float]) -> dict[str, float]:
    """Position [rad or m] of every joint that is welded, by name, in the URDF's order.

    Args:
        path: the URDF.
        joints: its joints.
        weld: position by name or pattern of joints. Joints that mimic a welded one follow it.

    Raises:
        UnknownNameError: a name that no joint has.
        ConfigError: a pattern that matches no joint that moves, two positions for one joint, a position outside of the
            joint's limits, a mimic joint whose master moves, or no joint left that moves.
    """
    if not weld:
        return {}
    moving = {joint.name: joint for joint in joints if joint.type in MOVING_TYPES}
    stated = _stated(joints, moving, weld)
    mimics = {name: mimic for name, mimic in resolve_mimics(path, joints).items() if mimic.master}
    for name, (key, _) in stated.items():
        if name in mimics and mimics[name].master not in stated:
            found = f"joint '{name}', which follows '{mimics[name].master}', which moves"
            raise ConfigError.at_field(_field(key), found, "its master too")
    limits = position_limits(path)
    for name, (key, position) in stated.items():
        low, high = limits.get(name, (-np.inf, np.inf))
        if name not in mimics and not low - _ROUNDING <= position <= high + _ROUNDING:
            found = f"{position:g}, outside of the limits of joint '{name}'"
            accepted = f"a position from {low:g} to {high:g}: weld: {{'{name}': {(low + high) / 2:.4g}}}"
            raise ConfigError.at_field(_field(key), found, accepted)
    welded = {}
    for name in moving:
        mimic = mimics.get(name)
        if mimic is None and name in stated:
            welded[name] = stated[name][1]
        elif mimic is not None and mimic.master in stated:
            welded[name] = mimic.multiplier * stated[mimic.master][1] + mimic.offset
    if len(welded) == len(moving):
        raise ConfigError.at_field(WELD_FIELD, "every joint that moves", "patterns that leave a joint")
    return welded


def _stated(
    joints: Sequence[TreeJoint], moving: Mapping[str, TreeJoint], weld: Mapping[str, float]
) -> dict[str, tuple[str, float]]:
    """Name or pattern and position by name of joint."""
    names, stated = [joint.name for joint in joints], dict[str, tuple[str, float]]()
    for key, position in weld.items():
        for name in matching_joints(WELD_FIELD, key, moving, names):
            other, before = stated.setdefault(name, (key, position))
            if before != position:
                found = f"{position:g} for joint '{name}', which '{other}' holds at {before:g}"
                raise ConfigError.at_field(_field(key), found, "one position for a joint")
    return stated


def matching_joints(field: str, key: str, moving: Iterable[str], names: Iterable[str] = ()) -> list[str]:
    """Joints that a name or pattern stands for.

    Args:
        field: of the settings, for errors.
        key: the name or pattern.
        moving: joints to choose from.
        names: of all joints.

    Raises:
        UnknownNameError: a name that is none of them.
        ConfigError: a pattern that matches none.
    """
    pattern, moving = any(sign in key for sign in "*?"), list(moving)
    matches = [name for name in moving if (fnmatchcase(name, key) if pattern else name == key)]
    if not matches and pattern:
        raise ConfigError.at_field(field, f"'{key}' matches no joint that moves", f"among {join_names(moving)}")
    if not matches:
        raise UnknownNameError.at_field(field, key, moving, "a fixed joint" if key in names else "")
    return matches


def _field(key: str) -> str:
    return f"{WELD_FIELD}.{key}"


def weld_joints(joints: Sequence[TreeJoint], positions: Mapping[str, float]) -> list[TreeJoint]:
    """The joints, those with a position fixed there."""

    def welded(joint: TreeJoint) -> TreeJoint:
        origin = joint_origin(joint) @ joint_transform(joint, positions[joint.name])
        changes: dict[str, Any] = {"type": "fixed", "mimic": None, "origin": origin}
        return replace(joint, **changes)

    return [welded(joint) if joint.name in positions else joint for joint in joints]


def links_beyond(
    joints: Sequence[TreeJoint], welded: Iterable[str], body_of: Mapping[str, int], heads: Sequence[str]
) -> list[str]:
    """Links that a welded joint separates from the link that gives their body its name.

    Args:
        joints: of the URDF.
        welded: names of those that are welded.
        body_of: number of the body of each link.
        heads: names of the bodies.
    """
    welded = set(welded)
    near, reached = dict[str, list[str]](), set(heads)
    for joint in joints:
        if joint.name not in welded and body_of[joint.parent] == body_of[joint.child]:
            near.setdefault(joint.parent, []).append(joint.child)
            near.setdefault(joint.child, []).append(joint.parent)
    queue = list(heads)
    while queue:
        new = [name for name in near.get(queue.pop(), []) if name not in reached]
        reached.update(new)
        queue += new
    return [name for name in body_of if name not in reached]


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
    for one in root.findall(f"{OWN}attachment"):
        held = "holds the robot to what is no part of it, by a force that is left out"
        contact = f"{{frame: {one.get('frame')}, type: {'point' if one.get('type') == 'point' else 'flat'}}}"
        warn(f"{path}: {one.get('where')}: {held}; where it acted in a log: contacts: [{contact}]")
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
