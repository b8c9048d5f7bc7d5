"""What `torchid init` proposes for the contacts, welds and sensors of a robot, by names in its file and in the log."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from torchid.errors import InputError, TorchidWarning
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, WRENCHES
from torchid.parameters import WRENCH_COMPONENTS
from torchid.proposals.names import within
from torchid.proposals.samples import FileSample, stated_names
from torchid.robot import CollisionShapes, Robot, load_robot
from torchid.robot.urdf import fixed_joints, position_limits

_FEET = (r"foot|feet", r"sole", r"ankle_roll|ankle_flexion", r"toe|ankle|paw|hoof")
"""Words in names of links that touch the ground, the surest first."""

_ON_FEET = r"sensor|imu|camera|bumper|laser"
_IN_LIMBS = r"(?<![a-z])ft(?![a-z])"
_NAMED = r"foot|feet|sole"
_NO_FEET = r"finger|thumb|hand|palm|grip|wheel|caster"


@dataclass(frozen=True)
class GuessedContact:
    """A frame that touches the ground, and the type of its contact, as an experiment file has them."""

    frame: str
    type: Literal["point", "flat"]
    radius: float | None = None

    @property
    def entry(self) -> dict[str, object]:
        """As in the file."""
        return {key: value for key, value in vars(self).items() if value is not None}


def stated_contacts(sample: FileSample, robot: Robot) -> list[str]:
    """Contacts that a log in the format names, as far as the robot has them."""
    names = stated_names(sample, "contact_names")
    names += [name.split(".")[1] for name in sample if re.fullmatch(r"contact_active\.[^.]+", name)]
    return [name for name in dict.fromkeys(names) if name in robot.links]


def guess_contacts(robot: Robot, stated: Sequence[str], texts: Sequence[str]) -> list[GuessedContact]:
    """Feet: links of outermost bodies with the surest word in their names, one of each body, spheres first.

    Those that the log names, in one of its texts, count before all others.
    """
    shapes = CollisionShapes(robot)

    def is_ball(name: str) -> bool:
        return shapes.about(name, meshes=False) is not None

    inner = {body.parent for body in robot.bodies}
    texts = [text.lower() for text in texts if not re.search(_IN_LIMBS, text, re.IGNORECASE)]
    named = [name for name in robot.links if any(within(name.lower()).search(text) for text in texts)]
    frames = list(stated)
    for words, links in ((_NAMED, named), *((words, list(robot.links)) for words in _FEET)) if not frames else ():
        by_body: dict[int, list[str]] = {}
        for name in links:
            body, is_foot = robot.links[name][0], re.search(words, name, re.IGNORECASE)
            if body and body not in inner and is_foot and not re.search(_ON_FEET, name, re.IGNORECASE):
                by_body.setdefault(body, []).append(name)
        frames = [
            min(
                names,
                key=lambda name: (not is_ball(name), "sole" not in name.lower(), len(name)),
            )
            for names in by_body.values()
        ]
        if len(frames) > 1:
            break
        frames = []
    frames = frames or _balls_of_limbs(robot, shapes)
    flat = len(frames) < 3
    return [GuessedContact(x, "flat" if flat and shapes.about(x) is None else "point") for x in frames]


def without_rolling(contacts: Sequence[GuessedContact], robot: Robot) -> list[GuessedContact]:
    """The same with balls that do not roll, as of a log without the orientation that says where the ground is."""
    shapes = CollisionShapes(robot)
    rolling = [contact.type == "point" and shapes.about(contact.frame) is not None for contact in contacts]
    return [replace(x, radius=0.0) if rolls else x for x, rolls in zip(contacts, rolling, strict=True)]


def _balls_of_limbs(robot: Robot, shapes: CollisionShapes) -> list[str]:
    """Balls at the ends of limbs: of more than two that begin at the base, or called feet; no fingers or wheels."""
    if re.search(_NO_FEET, robot.base_link, re.IGNORECASE):  # of a hand
        return []
    parents, limbs = [body.parent for body in robot.bodies], dict[int, str]()
    for name in robot.links:
        body = root = robot.links[name][0]
        while root and parents[root]:
            root = parents[root]
        shape = shapes.about(name, meshes=False) if body and body not in parents else None
        if shape is not None and shape.kind == "sphere" and not re.search(_NO_FEET, name, re.IGNORECASE):
            limbs.setdefault(root, name)
    called = [name for name in limbs.values() if re.search("|".join(_FEET), name, re.IGNORECASE)]
    return list(limbs.values()) if len(limbs) > 2 else called


def held_joints(robot: Robot, lacking: Sequence[str]) -> list[str]:
    """Joints that a log lacks, but for those without a motor in loops, which follow from the others."""
    return [name for name in lacking if name not in robot.passive]


def welded_at(robot: Robot, held: Sequence[str]) -> list[str] | dict[str, float]:
    """Joints that are held, each at 0, or at the middle of its range if that is elsewhere."""
    limits = position_limits(robot.path)
    ranges = {name: limits.get(name, (-math.inf, math.inf)) for name in held}
    at = {name: 0.0 if low <= 0.0 <= high else float(f"{(low + high) / 2:.4g}") for name, (low, high) in ranges.items()}
    return at if any(at.values()) else list(at)


_SENSOR = r"(?<![a-z])(ft|force|torque|load_?cell)(?![a-z])"
_MOST_SENSORS = 16  # in limbs that are looked at


def limb_sensors(robot: Robot) -> dict[str, str]:
    """Children of fixed joints in limbs whose names say that a force/torque sensor is there, by joint."""
    found = fixed_joints(robot.path)
    named = {joint: child for joint, child in found.items() if re.search(_SENSOR, f"{joint} {child}", re.IGNORECASE)}
    in_limbs = {joint: child for joint, child in named.items() if child in robot.links and robot.links[child][0]}
    return {joint: child for joint, child in list(in_limbs.items())[:_MOST_SENSORS] if _can_be_split(robot, joint)}


def read_sensors(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Sensors in limbs that recordings have readings of, of those that the robot can be split at."""
    names = logs[0].ft_names if logs else ()
    joints = fixed_joints(robot.path) if names else {}
    return [name for name in names[:_MOST_SENSORS] if name in joints and _can_be_split(robot, name)]


def _can_be_split(robot: Robot, joint: str) -> bool:
    """Whether both sides of a fixed joint have mass."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # said of the whole robot
            load_robot(robot.path, ft_joints=[joint], total_mass=float(robot.nominal[:, 0].sum()))
    except InputError:
        return False
    return True


def measured_torques(robot: Robot, logs: Sequence[Log]) -> list[str]:
    """Joints whose torque recordings have, if they have that of some driven ones alone; none otherwise."""
    of_joints = [zip(x.joint_names, x.joint_torque.T, strict=True) for x in logs if x.joint_torque is not None]
    if not of_joints:
        return []
    finite = [(name, bool(np.isfinite(torque).any())) for of_log in of_joints for name, torque in of_log]
    known = {name: any(x for other, x in finite if other == name) for name, _ in finite}
    driven = [name for name in robot.joint_names if name in known and name not in robot.passive]
    measured = [name for name in driven if known[name]]
    return measured if len(measured) < len(driven) else []


def proposed_sensors(
    fields: Collection[str],
    limbs: Sequence[str],
    contacts: Sequence[GuessedContact] = (),
    torques: Sequence[str] = (),
) -> str | dict[str, object]:
    """The set of sensors of a run, with those in limbs at fixed joints; `torques`: joints, if only some have one."""
    wrench, torque = bool(set(WRENCHES) & set(fields)), "joint_torque" in fields
    of_contacts = wrench or FORCE_NORMAL in fields
    named = ("full" if wrench else "joints") if torque or not of_contacts else "contacts"
    of_limbs: dict[str, object] = {"ft_sensors": list(limbs)} if limbs else {}
    if torques:
        components = {x.frame: list(WRENCH_COMPONENTS[: 6 if x.type == "flat" else 3]) for x in contacts}
        return of_limbs | {"joint_torques": list(torques)} | ({"contact_wrenches": components} if wrench else {})
    if not limbs:
        return named
    return of_limbs | ({"set": named} if wrench or torque else {})
