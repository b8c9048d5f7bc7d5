"""Unitree's LowState: its messages' definitions, which bags of ROS 2 Humble do not hold, with their decoder.

A message has all motors by number, the IMU, four foot sensors and the robot's own clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, format_count
from torchid.logs.joint_orders import GO, JOINT_ORDERS, MOTORS
from torchid.logs.quaternion import require_unit

if TYPE_CHECKING:
    from torchid.logs.log import FloatArray
    from torchid.logs.ros_topics import LowStateTopic

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
    """Add the types to a typestore of rosbags.

    Args:
        store: the typestore.
        parse: `rosbags.typesys.get_types_from_msg`.
    """
    store.register({key: value for name, text in DEFINITIONS.items() for key, value in parse(text, name).items()})


KEY = "logs.topics.low_state"
#: [rad] less is no motion of a motor that a robot is said not to have.
_MOVED = 1e-3
#: Ticks may be off the times of receipt by this [ns], and by this share of the log: a network stalls, a clock drifts.
_OFF, _OFF_SHARE = 100_000_000, 0.01
_MILLISECOND, _WRAP = 1_000_000, 1 << 32


class LowState:
    """`unitree_go/LowState` or `unitree_hg/LowState`; the accelerometer reads a specific force, +g upwards at rest."""

    types: tuple[str, ...] = tuple(MOTORS)

    def __init__(self, topic: LowStateTopic) -> None:
        """For the messages of a topic, with the motors of a robot or as they are listed."""
        self._topic, self._settings = topic.topic, topic
        self._order = list(topic.order)
        self.names = tuple(name for name in self._order if name is not None)
        self._motors = 0

    def check_options(self, field: str, kind: str) -> None:
        """Refuse settings, of a field, that messages of a type do not fit.

        Raises:
            LogError: the robot has another type, there are fewer motors than joints, or no foot sensors.
        """
        robot, name = JOINT_ORDERS.get(self._settings.robot or ""), self._settings.robot
        if robot is not None and robot.message != kind:
            others = ", ".join(x for x, order in JOINT_ORDERS.items() if order.message == kind)
            found = f"'{name}', which sends {robot.message}, though {self._topic} carries {kind}"
            raise LogError.at_field(f"{field}.robot", found, others)
        if len(self._order) > MOTORS[kind]:
            found = f"{len(self._order)} names, though {kind} has {MOTORS[kind]} motors"
            raise LogError.at_field(f"{field}.joints", found, "at most that many, by number of the motor")
        if self._settings.reads_feet and kind != GO:
            key = "forces" if self._settings.forces else "above"
            raise LogError.at_field(f"{field}.{key}", f"set, though {kind} has no foot sensors", f"no {key}")

    def row(self, message: Any) -> FloatArray:
        """Position, velocity and torque of every motor, specific force, angular velocity, quaternion, foot sensors.

        Raises:
            LogError: ankles and waist by motor rather than by joint.
        """
        if getattr(message, "mode_pr", 0):
            found = f"mode_pr {message.mode_pr}: ankles and waist by their parallel motors (A, B), not by joint"
            raise LogError.at_field(self._topic, found, "messages with mode_pr 0: pitch and roll")
        motors, imu = message.motor_state, message.imu_state
        self._motors = len(motors)
        values = [*(x.q for x in motors), *(x.dq for x in motors), *(x.tau_est for x in motors)]
        arrays = imu.accelerometer, imu.gyroscope, imu.quaternion, getattr(message, "foot_force", np.array([]))
        return np.array([*values, *(x for array in arrays for x in array.tolist())], dtype=np.float64)

    def fields(self, rows: FloatArray) -> dict[str, FloatArray]:
        """Fields (N, n) of the joints, (N, 3) and (N, 4) of the IMU, and the raw readings of feet (N, 4), if any.

        Raises:
            LogError: a joint whose motor is not there, a motor that moves without a joint, or quaternions of no length.
        """
        count = self._motors
        motors = rows[:, : 3 * count].reshape(len(rows), 3, count)
        self._check_motors(motors)
        joints = motors[:, :, [number for number, name in enumerate(self._order) if name is not None]]
        out = dict(zip(("joint_position", "joint_velocity", "joint_torque"), joints.transpose(1, 0, 2), strict=True))
        if self._settings.frame is not None:
            out["imu_specific_force"] = rows[:, 3 * count : 3 * count + 3]
            out["imu_angular_velocity"] = rows[:, 3 * count + 3 : 3 * count + 6]
            out |= self._orientation(rows[:, 3 * count + 6 : 3 * count + 10])
        if rows.shape[1] > 3 * count + 10:
            out["foot_force"] = rows[:, 3 * count + 10 :]
        return out

    def _check_motors(self, motors: FloatArray) -> None:
        """Refuse an order that the motors which are alive do not have; motors (N, 3, count)."""
        alive = np.asarray(np.any(motors != 0.0, axis=(0, 1)))
        listed = [*self._order, *[None] * (len(alive) - len(self._order))]
        name = self._settings.robot
        with np.errstate(invalid="ignore"):  # of infinite positions
            moves = np.ptp(motors[:, 0], axis=0) > _MOVED
        for number, joint in enumerate(listed):
            if joint is not None and not alive[number]:
                found = f"motor {number}, '{joint}', is 0 throughout: no such motor"
                raise LogError.at_field(self._topic, found, self._others(alive, number))
            if joint is None and moves[number] and (name is not None or number >= len(self._order)):
                owner = f"'{name}' has" if name is not None else f"{KEY}.joints names"
                found = f"motor {number} moves, where {owner} no joint"
                raise LogError.at_field(self._topic, found, self._others(alive, number))

    def _others(self, alive: NDArray[np.bool_], number: int) -> str:
        """The robots that have the motors which are alive, or what else may be said of a motor."""
        kind = next(kind for kind, count in MOTORS.items() if count == len(alive))
        numbers = set(np.flatnonzero(alive).tolist())
        fitting = [
            name
            for name, order in JOINT_ORDERS.items()
            if order.message == kind and {i for i, joint in enumerate(order.joints) if joint} == numbers
        ]
        listed = f"{KEY}.joints with a name or null for each of {format_count(len(alive), 'motor')}"
        return f"{KEY}.robot: {' or '.join(fitting)}" if fitting else f"{listed}, null for motor {number} where unused"

    def _orientation(self, wxyz: FloatArray) -> dict[str, FloatArray]:
        """The base's orientation; nothing where quaternions are always the same, as of a driver that does not set them.

        They are in the order in which others' come (xyzw), so that an odometry takes their place.
        """
        if not self._settings.orientation or not np.any(wxyz != wxyz[0]):
            return {}
        return {"base_quat_xyzw": np.roll(require_unit(self._topic, wxyz, KEY), -1, axis=1)}

    # ------------------------------------------------------------------------------------------------------- stamps

    def stamps(self, ticks: NDArray[np.int64], received: NDArray[np.int64]) -> tuple[NDArray[np.int64], bool]:
        """Stamps (N,) [ns] of messages, on the clock of the recording computer, and whether they are the robot's.

        The robot counts milliseconds since it was switched on, on a clock of its own, from 2^32 on again from 0. What
        that clock is off by is the median difference to the times of receipt.

        Args:
            ticks: (N,) [ms] of the messages.
            received: (N,) [ns], times of receipt.

        Raises:
            LogError: ticks that are no milliseconds, where `stamps` does not say that they are meant.
        """
        wanted, constant = self._settings.stamps, not np.any(np.diff(ticks))
        if wanted == "receipt" or (wanted is None and constant and (len(ticks) > 1 or not ticks.any())):
            return received, False
        steps = (np.diff(ticks) + _WRAP // 2) % _WRAP - _WRAP // 2
        elapsed = np.concatenate([[0], np.cumsum(steps)]) * _MILLISECOND
        late = received - received[0] - elapsed
        usual = int(np.clip(np.median(late), -(1 << 62), 1 << 62))  # also for receipts that no clock would give
        off = np.abs(late - usual)
        if wanted is None and off.max() > _OFF + _OFF_SHARE * np.ptp(received):
            found = (
                f"ticks that advance by {np.ptp(elapsed) / 1e9:.4g} s while messages come for "
                f"{np.ptp(received) / 1e9:.4g} s, and are off by up to {off.max() / 1e9:.3g} s"
            )
            accepted = f"ticks of 1 ms, or {KEY}.stamps: receipt, or tick where these are right"
            raise LogError.at_field(self._topic, found, accepted)
        return np.asarray(received[:1] + usual + elapsed, dtype=np.int64), True
