"""Force/torque sensors in limbs, and the set of sensors of a run, as `torchid init` proposes them."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

from torchid.errors import InputError
from torchid.logs import Log
from torchid.robot import Robot, load_robot
from torchid.robot.urdf import fixed_joints

_SENSOR = r"(?<![a-z])(ft|force|torque|load_?cell)(?![a-z])"
_MOST_SENSORS = 16  # in limbs that are looked at


def limb_sensors(robot: Robot) -> dict[str, str]:
    """Children of fixed joints in limbs whose names say that a force/torque sensor is there, by joint."""
    found = fixed_joints(robot.path)
    named = {joint: child for joint, child in found.items() if re.search(_SENSOR, f"{joint} {child}", re.IGNORECASE)}
    in_limbs = {joint: child for joint, child in named.items() if child in robot.links and robot.links[child][0]}
    return {joint: child for joint, child in list(in_limbs.items())[:_MOST_SENSORS] if _can_be_split(robot, joint)}


def read_sensors(robot: Robot, log: Log | InputError) -> list[str]:
    """Sensors in limbs that a log has readings of, of those that the robot can be split at."""
    names = () if isinstance(log, InputError) else log.ft_names
    joints = fixed_joints(robot.path) if names else {}
    return [name for name in names[:_MOST_SENSORS] if name in joints and _can_be_split(robot, name)]


def _can_be_split(robot: Robot, joint: str) -> bool:
    """Whether both sides of a fixed joint have mass."""
    try:
        load_robot(robot.path, ft_joints=[joint])
    except InputError:
        return False
    return True


def sensor_set(fields: Collection[str], limbs: Sequence[str]) -> str | dict[str, object]:
    """The set of sensors of a run, with those in limbs at fixed joints."""
    wrench = bool({"contact_wrench_local", "contact_wrench_world"} & set(fields))
    named = ("full" if wrench else "joints") if "joint_torque" in fields else "contacts"
    if not limbs:
        return named
    return ({"set": named} if wrench or named == "joints" else {}) | {"ft_sensors": list(limbs)}
