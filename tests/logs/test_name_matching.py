"""What names of columns mean: words for quantities, units behind them, and names of a robot spelled otherwise."""

from __future__ import annotations

import pytest

from torchid.logs.units import quantities_with, split_unit, unit_factor
from torchid.proposals.names import exchange_affixes, find_spelling, propose_field


@pytest.mark.parametrize(
    ("field", "spelled"),
    [
        ("joint_position", "q qpos pos position angle joint_positions jointPosition q_actual"),
        ("joint_velocity", "dq qd qdot q_dot qvel vel velocity speed"),
        ("joint_acceleration", "ddq qdd qddot q_ddot qacc acc"),
        ("joint_torque", "tau trq torque effort tau_est"),
        ("time", "t time stamp timestamp header.stamp"),
        ("imu_angular_velocity", "gyro omega angular_velocity"),
        ("imu_specific_force", "imu/linear_acceleration imu_acc accelerometer"),
        ("base_position_world", "base_pos pelvis.position"),
        ("", "q_des dq_ref tau_d tau_ext target_q note kp velocity_torque"),
    ],
)  # fmt: skip
def test_a_word_says_what_a_column_has(field: str, spelled: str) -> None:
    assert {text: propose_field(text) for text in spelled.split()} == dict.fromkeys(spelled.split(), field)


@pytest.mark.parametrize(
    ("names", "texts", "expected"),
    [
        (["panda_joint1", "panda_joint2"], ["fer_joint1", "fer_joint2"], ["panda_joint1", "panda_joint2"]),
        (["FL_hip_joint", "FR_hip_joint"], ["FR_hip", "FL_hip", "x"], ["FR_hip_joint", "FL_hip_joint"]),
        (["l_knee", "r_knee"], ["r_knee", "gripper"], ["r_knee"]),
        (["hip"], ["a_hip", "b_hip"], []),
        (["l_knee", "r_knee"], ["left_knee", "right_knee"], []),
        (["j1", "j2"], ["a1", "a2"], []),
    ],
)
def test_one_prefix_or_suffix_may_stand_for_another(names: list[str], texts: list[str], expected: list[str]) -> None:
    assert list(exchange_affixes(texts, names).values()) == expected


def test_names_without_what_all_of_them_have_are_found_within_columns() -> None:
    found = find_spelling(["touch_LF", "touch_RF"], ["LF_FOOT", "RF_FOOT"])
    assert (found.names, found.suffix) == ({"LF": "LF_FOOT", "RF": "RF_FOOT"}, "_FOOT")
    assert not find_spelling(["q_ship", "q_2"], ["hip", "joint1"]).names


@pytest.mark.parametrize(
    ("column", "name", "unit"),
    [
        ("q1 [deg]", "q1", "deg"),
        ("t[ms]", "t", "ms"),
        ("tau_hip (Nm)", "tau_hip", "Nm"),
        ("Fz_N", "Fz", "N"),
        ("time_us", "time", "us"),
        ("pos_mm", "pos", "mm"),
        ("vel_rad/s", "vel", "rad/s"),
        ("vel_deg_s", "vel", "deg/s"),
        ("a_m_per_s2", "a", "m/s2"),
        ("acc_g", "acc", "g"),
        ("w [rad s^-1]", "w", "rad s^-1"),
        ("quat_w [-]", "quat_w", "-"),
        ("angle [gon]", "angle", "gon"),
        ("motor_state[3]", "motor_state[3]", ""),
        ("acc[x]", "acc[x]", ""),
        ("left_hip_pitch", "left_hip_pitch", ""),
        ("angle_gon", "angle_gon", ""),
    ],
)
def test_a_unit_is_what_brackets_hold_or_a_suffix_that_is_known(column: str, name: str, unit: str) -> None:
    assert split_unit(column) == (name, unit)


@pytest.mark.parametrize("unit", ["1/min", "r / min", "r/min"])
def test_turns_per_minute_are_rpm(unit: str) -> None:
    assert unit_factor("x", unit, ("angular velocity",)) == unit_factor("x", "rpm", ("angular velocity",))
    assert quantities_with("Nm/min") == ()


def test_a_unit_tells_the_field_where_the_name_says_nothing() -> None:
    assert propose_field("LF_HAA [deg]") == "joint_position"
    assert propose_field("LF_HAA (deg/s)") == "joint_velocity"
    assert propose_field("LF_HAA_Nm") == "joint_torque"
    assert propose_field("oil [degC]") == ""
