"""Definitions of Unitree's messages, which bags of ROS 2 Humble do not hold.

The fields are those of the packages unitree_go and unitree_hg of unitree_ros2, in the order in which they are sent.
"""

from __future__ import annotations

from typing import Any

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
