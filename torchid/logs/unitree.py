"""Robots of Unitree: the orders in which they number motors and feet, and the definitions of their LowState messages.

Numbers are those of `motor_state` in the robots' own messages, names those of their URDFs. Sources: the enumerations of
joints in the examples of unitree_sdk2 (`go2`, `b2`, `h1`, `g1`) and unitree_legged_sdk (`a1`, `go1`), and the URDFs of
unitree_ros. H1-2 is not here: public sources disagree about its hips (yaw, pitch, roll or yaw, roll, pitch).

A message has all motors by number, the IMU, four foot sensors and the robot's own clock. Bags of ROS 2 Humble do not
hold the messages' definitions.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from torchid.errors import ConfigError

if TYPE_CHECKING:
    pass


GO = "unitree_go/msg/LowState"
HG = "unitree_hg/msg/LowState"
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


def suitable_orders(joints: Collection[str], robot: str = "") -> list[str]:
    """Robots whose joints a URDF has, those with most of them first, then one that a text names."""
    fitting = [name for name, order in JOINT_ORDERS.items() if set(order.names) <= set(joints)]
    return sorted(fitting, key=lambda name: (-len(JOINT_ORDERS[name].names), name not in robot))


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
        reason = f"'{robot}' has a joint '{absent[0]}', your robot has not"
        accepted = ", ".join(suitable_orders(joints))
        accepted = accepted or "joint names by number: no known robot has these joints"
        raise ConfigError.at_field(field, reason, accepted)


def robot_with_order(order: Collection[str | None] | None) -> str:
    """The robot that a list of joints by number is the order of, as `order_by_name` has it; "" for none."""
    return next((name for name in JOINT_ORDERS if order == order_by_name("joint", name)), "")


_GO = {
    "IMUState": "float32[4] quaternion|float32[3] gyroscope|float32[3] accelerometer|float32[3] rpy|int8 temperature",
    "MotorState": "uint8 mode|float32 q|float32 dq|float32 ddq|float32 tau_est|float32 q_raw|float32 dq_raw"
    "|float32 ddq_raw|int8 temperature|uint32 lost|uint32[2] reserve",
    "BmsState": "uint8 version_high|uint8 version_low|uint8 status|uint8 soc|int32 current|uint16 cycle"
    "|int8[2] bq_ntc|int8[2] mcu_ntc|uint16[15] cell_vol",
    "LowState": "uint8[2] head|uint8 level_flag|uint8 frame_reserve|uint32[2] sn|uint32[2] version|uint16 bandwidth"
    "|IMUState imu_state|MotorState[20] motor_state|BmsState bms_state|int16[4] foot_force|int16[4] foot_force_est"
    "|uint32 tick|uint8[40] wireless_remote|uint8 bit_flag|float32 adc_reel|int8 temperature_ntc1"
    "|int8 temperature_ntc2|float32 power_v|float32 power_a|uint16[4] fan_frequency|uint32 reserve|uint32 crc",
}
_HG = {
    "IMUState": "float32[4] quaternion|float32[3] gyroscope|float32[3] accelerometer|float32[3] rpy|int16 temperature",
    "MotorState": "uint8 mode|float32 q|float32 dq|float32 ddq|float32 tau_est|int16[2] temperature|float32 vol"
    "|uint32[2] sensor|uint32 motorstate|uint32[4] reserve",
    "LowState": "uint32[2] version|uint8 mode_pr|uint8 mode_machine|uint32 tick|IMUState imu_state"
    "|MotorState[35] motor_state|uint8[40] wireless_remote|uint32[4] reserve|uint32 crc",
}
DEFINITIONS: dict[str, str] = {
    f"{package}/msg/{name}": text.replace("|", "\n")
    for package, messages in (("unitree_go", _GO), ("unitree_hg", _HG))
    for name, text in messages.items()
}
"""Text of each message type, as in its .msg file."""


def register(store: Any, parse: Any) -> None:
    """Add the types to a typestore of rosbags; `parse`: `rosbags.typesys.get_types_from_msg`."""
    store.register({key: value for name, text in DEFINITIONS.items() for key, value in parse(text, name).items()})
