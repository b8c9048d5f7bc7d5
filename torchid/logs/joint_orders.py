"""Orders in which robots of Unitree number their motors and feet, by name of the robot.

Numbers are those of `motor_state` in the robots' own messages, names those of their URDFs. Sources: the enumerations of
joints in the examples of unitree_sdk2 (`go2`, `b2`, `h1`, `g1`) and unitree_legged_sdk (`a1`, `go1`), and the URDFs of
unitree_ros. H1-2 is not here: public sources disagree about its hips (yaw, pitch, roll or yaw, roll, pitch).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from torchid.errors import ConfigError
from torchid.logs.name_matching import KnownRobot

GO, HG = "unitree_go/msg/LowState", "unitree_hg/msg/LowState"
MOTORS = {GO: 20, HG: 35}
"""Motors in a message of a type, used or not."""


@dataclass(frozen=True)
class JointOrder:
    """The motors of a robot.

    Attributes:
        joints: of the URDF, by number of the motor; None for a number without a joint.
        message: type of the messages that the robot's state has.
        feet: frames of the URDF by number of `foot_force`.
    """

    joints: tuple[str | None, ...]
    message: str
    feet: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All joints."""
        return tuple(name for name in self.joints if name is not None)


_LEGS = ("FR", "FL", "RR", "RL")
_QUADRUPED = JointOrder(
    tuple(f"{leg}_{joint}_joint" for leg in _LEGS for joint in ("hip", "thigh", "calf")),
    GO,
    tuple(f"{leg}_foot" for leg in _LEGS),
)


def _sides(*joints: str) -> tuple[str, ...]:
    return tuple(f"{side}_{joint}_joint" for side in ("left", "right") for joint in joints)


_LEG = _sides("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
_G1 = (*_LEG, "waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint", *_sides(*_ARM))
_ABSENT_IN_23 = ("waist_roll", "waist_pitch", "wrist_pitch", "wrist_yaw")
_H1 = (
    *("right_hip_roll_joint", "right_hip_pitch_joint", "right_knee_joint"),
    *("left_hip_roll_joint", "left_hip_pitch_joint", "left_knee_joint"),
    *("torso_joint", "left_hip_yaw_joint", "right_hip_yaw_joint", None, "left_ankle_joint", "right_ankle_joint"),
    *(f"{side}_{joint}_joint" for side in ("right", "left") for joint in _ARM[:4]),
)

JOINT_ORDERS: dict[str, JointOrder] = {
    **dict.fromkeys(("go2", "b2", "a1", "go1"), _QUADRUPED),
    "g1": JointOrder(_G1, HG),
    "g1_23dof": JointOrder(tuple(None if any(x in name for x in _ABSENT_IN_23) else name for name in _G1), HG),
    "h1": JointOrder(_H1, GO),
}
"""By name of the robot. `g1` has 29 joints, `g1_23dof` the same numbers without waist and wrists."""


def order_by_name(kind: str, order: object) -> object:
    """Names by number where an order is the name of a robot, with None for the motors of its messages that it has not.

    Args:
        kind: joint or contact.
        order: anything else comes back as it is, for others to refuse.
    """
    robot = JOINT_ORDERS.get(order) if isinstance(order, str) else None
    if robot is None:
        return order
    if kind == "contact":
        return list(robot.feet) or order
    return [*robot.joints, *[None] * (MOTORS[robot.message] - len(robot.joints))]


def names_by_number(order: Sequence[str] | str) -> list[str]:
    """Joints of an order that a map states, without those that the robot has not."""
    return list(JOINT_ORDERS[order].names) if isinstance(order, str) else list(order)


def suitable_orders(joints: Collection[str], robot: str = "") -> list[str]:
    """Robots whose joints a URDF has, those with most of them first, then one that a text names."""
    fitting = [name for name, order in JOINT_ORDERS.items() if set(order.names) <= set(joints)]
    return sorted(fitting, key=lambda name: (-len(JOINT_ORDERS[name].names), name not in robot))


def usual_order(kind: str, robot: KnownRobot, count: int) -> tuple[list[str | None] | list[str] | str, str]:
    """The order of numbers that joints or feet probably have, or the name of the robot that has it; and whose that is.

    Args:
        kind: joint or contact.
        robot: whose names they are.
        count: of the numbers.
    """
    names = robot.joints if kind == "joint" else robot.feet
    for name in suitable_orders(robot.joints, robot.name) if kind == "joint" else ():
        order = JOINT_ORDERS[name]
        is_whole = set(order.names) == set(names) or count < len(names)
        if is_whole and count >= len(order.joints):
            return name, f"that of {name}, whose joints the robot has"
    if kind == "joint" and count == len(robot.moving) > len(names):
        return [x if x in names else None for x in robot.moving], "as in the robot's file, with those that mimic others"
    if kind == "joint" and count < len(names):
        return numbered_joints(names, count), "names that differ in a number"
    is_alike = any("thigh" in joint or "calf" in joint for joint in robot.joints)
    if names and is_alike and all(name.partition("_")[0] in _LEGS for name in names):
        return sorted(names, key=lambda name: _LEGS.index(name.partition("_")[0])), "as Unitree numbers legs"
    return list(names), "as in the robot's file"


def numbered_joints(joints: Sequence[str], count: int) -> list[str]:
    """Joints whose names differ in a number alone, if that are so many; all but those of hands likewise; else none."""
    alike = defaultdict[str, list[str]](list)
    for name in joints:
        alike[re.sub(r"\d+", "#", name)].append(name)
    without = [name for name in joints if not re.search(r"finger|gripper|hand|thumb", name, re.IGNORECASE)]
    return next((names for names in (*alike.values(), without) if len(names) == count), [])


def require_joints_of(field: str, robot: str, joints: Collection[str]) -> None:
    """Make sure that a URDF has the joints of a robot.

    Args:
        field: of the settings that names the robot.
        robot: one of `JOINT_ORDERS`.
        joints: of the URDF.

    Raises:
        ConfigError: it has not; the message names the robots whose joints it has.
    """
    absent = [name for name in JOINT_ORDERS[robot].names if name not in joints]
    if absent:
        found = f"'{robot}', whose joint '{absent[0]}' the robot has not"
        raise ConfigError.at_field(field, found, _nearest_orders(joints))


def _nearest_orders(joints: Collection[str]) -> str:
    """The robots whose joints a URDF has, in words."""
    return ", ".join(suitable_orders(joints)) or "names of joints by number, as no robot known by name has these"


def robot_with_order(order: Collection[str | None] | None) -> str:
    """The robot that a list of joints by number is the order of, as `order_by_name` has it; "" for none."""
    return next((name for name in JOINT_ORDERS if order == order_by_name("joint", name)), "")
