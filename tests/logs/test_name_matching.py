"""Names of recordings against those of a robot: spellings, limbs, and what is not to be confused."""

from __future__ import annotations

import pytest

from torchid.logs.name_matching import limbs, match_joints, match_names, propose_field, spelled

FEET = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")


@pytest.mark.parametrize(
    ("names", "texts", "expected"),
    [
        (FEET, ["/contact/lf_foot", "/contact/rh_foot"], ["LF_FOOT", "RH_FOOT"]),
        (FEET, ["front_left", "hind_right"], ["LF_FOOT", "RH_FOOT"]),
        (("l_sole", "r_sole"), ["/right/wrench", "/left/wrench"], ["r_sole", "l_sole"]),
        (("l_sole", "r_sole"), ["left_foot_sensor /ft/1", "right_foot_sensor /ft/0"], ["l_sole", "r_sole"]),
        (("left_sole_link", "right_sole_link"), ["LeftFootF", "RightFootF"], ["left_sole_link", "right_sole_link"]),
        (("l_sole", "r_sole"), ["left_heel", "left_toe"], []),
        (("l_sole", "r_sole"), ["/battery", "/temperature"], []),
        (("FL_foot", "FR_foot"), ["left", "right"], []),
    ],
)  # fmt: skip
def test_texts_mean_the_name_they_contain_or_that_of_the_same_limb_alone(
    names: tuple[str, ...], texts: list[str], expected: list[str]
) -> None:
    assert match_names(texts, names, "contact") == dict(zip(texts, expected, strict=False))


def test_limbs_are_words_and_letters_of_their_own() -> None:
    assert limbs("LH_FOOT") == limbs("left_hind") == limbs("RearLeftLeg") == {"l", "b"}
    assert limbs("l_sole") == limbs("LeftFoot") == {"l"}
    assert limbs("lower_roll_link") == limbs("frame") == set()


@pytest.mark.parametrize(
    ("stem", "column", "found"),
    [
        ("left_hip_pitch", "LeftHipPitch.Position", True),
        ("left_hip_pitch", "q_left-hip-pitch", True),
        ("LF_HAA", "q_lf_haa", True),
        ("LHipYaw", "l_hip_yaw_vel", True),
        ("hip", "q_ship", False),
        ("joint1", "joint_12", False),
        ("hip", "hips", False),
    ],
)
def test_a_spelling_is_found_whole(stem: str, column: str, found: bool) -> None:
    assert bool(spelled(stem).search(column)) == found


def test_stamps_of_simulink_are_a_log_s_and_torques_out_of_a_motor_are_none() -> None:
    assert propose_field("out/tout") == propose_field("tout") == "time"
    assert propose_field("tau_out") == "joint_torque"
    assert [propose_field(x) for x in ("J_1", "hip_phi", "dtau_J")] == ["joint_position", "joint_position", ""]
    assert [propose_field(x) for x in ("hip_dphi", "micros", "imu_q0")] == ["joint_velocity", "time", "base_quat_wxyz"]


def test_fields_that_differ_in_what_they_are_of_are_not_alike() -> None:
    assert propose_field("imu/linear_acceleration") == "imu_specific_force"
    assert propose_field("imu_angular_velocty") == "imu_angular_velocity"
    assert propose_field("joint_torqe") == "joint_torque"


@pytest.mark.parametrize(
    ("joints", "texts", "expected"),
    [
        (["FL_hip_joint", "FR_hip_joint"], ["fr_hip", "fl_hip"], ["FR_hip_joint", "FL_hip_joint"]),
        (["LF_HAA", "RF_HAA"], ["robot/lf_haa_joint", "robot/rf_haa_joint"], ["LF_HAA", "RF_HAA"]),
        (["left_hip_pitch_joint", "left_hip_yaw_joint"], ["LeftHipYaw"], ["left_hip_yaw_joint"]),
        (["l_knee", "r_knee"], ["left_knee", "right_knee"], ["l_knee", "r_knee"]),
        (["panda_joint1", "panda_joint2"], ["joint2", "joint1"], ["panda_joint2", "panda_joint1"]),
        (["l_knee", "l_knee_2"], ["l_knee"], ["l_knee"]),
        (["arm_knee", "leg_knee"], ["knee"], []),
        (["hip"], ["a_hip", "b_hip"], []),
        (["l_hip"], ["r_hip", "l_ship", "hip", "joint"], []),
    ],
)
def test_joints_are_told_by_their_words_and_limbs_and_doubtful_ones_by_none(
    joints: list[str], texts: list[str], expected: list[str]
) -> None:
    assert match_joints(texts, joints) == dict(zip(texts, expected, strict=False))


def test_an_angular_velocity_of_the_body_is_no_linear_one() -> None:
    assert propose_field("base_ang_vel_body").startswith("base_angular_velocity")
    assert propose_field("base/v_world").startswith("base_linear_velocity")
    assert propose_field("velBody").startswith("base_linear_velocity")


@pytest.mark.parametrize(
    ("field", "spelled"),
    [
        ("joint_velocity", "dq qd qdot q_dot q.dot QDot dqdt dq/dt dq_dt dotq qdots d_q"),
        ("joint_velocity", "theta_dot thetadot ThetaDot dtheta thDot phi_dot jvel q_vel joint_spd"),
        ("joint_velocity", "pos_dot dpos posDot joint_position_dot angleDot joint_angular_velocity omega_joint"),
        ("joint_acceleration", "ddq qdd qddot q_ddot q_dot_dot d2q theta_ddot ddtheta pos_ddot q_acc dof_acc"),
        ("joint_torque", "tau trq torq joint_moment actuator_force joint_forces tau_est"),
        ("", "q_dot_des qd_ref base_pos_dot q_d theta_dot_cmd"),
    ],
)  # fmt: skip
def test_a_derivative_is_no_position_however_it_is_spelled(field: str, spelled: str) -> None:
    """Alone, with a number, in front of a number and behind the name of a joint."""
    forms = ("{}", "{}1", "{}_1", "FL_hip_{}", "{}.l_knee")
    found = {text: propose_field(text) for name in spelled.split() for form in forms if (text := form.format(name))}
    assert {text: of for text, of in found.items() if of != field} == {}
