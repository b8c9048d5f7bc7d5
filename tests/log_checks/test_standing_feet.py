"""What feet that stand by their flags show of orientation and joint positions."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from motions import value
from scipy.spatial.transform import Rotation, Slerp
from simulated import QUADRUPED
from stances import stance
from walking import robot_of

from torchid.log_checks import REJECTED, SUSPICIOUS, Finding
from torchid.log_checks.motion import recorded_link_poses, same_poses
from torchid.log_checks.standing_feet import check_standing_feet
from torchid.logs import Log
from torchid.robot import load_robot

STANCE = stance("quadruped", samples=500)
ROBOT, CONTACTS = robot_of(STANCE.machine), STANCE.contacts()


def findings(log: Log) -> list[Finding]:
    """What the motion of the feet gives away."""
    return [one for one in check_standing_feet(log, ROBOT, CONTACTS) if isinstance(one, Finding)]


def test_feet_that_stand_give_no_finding() -> None:
    assert findings(STANCE.measured) == []


def test_feet_that_move_as_much_as_the_base_have_shares_without_an_exponent() -> None:
    """One of 99.5 % and more has three digits."""
    log = STANCE.measured
    position = value(log.base_position_world) * 3.0
    (finding,) = findings(replace(log, base_position_world=position))
    shares = re.findall(r"_foot (\S+) %", finding.found)
    assert max(map(float, shares)) >= 100.0
    assert all(share.isdigit() for share in shares), finding.found


@pytest.mark.parametrize("axis", range(3))
def test_the_pose_in_a_left_handed_world_is_named_with_its_axis(axis: int) -> None:
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    log = STANCE.measured
    quat, position = value(log.base_quat_xyzw) * [*-signs, 1.0], value(log.base_position_world) * signs
    (finding,) = findings(replace(log, base_quat_xyzw=quat, base_position_world=position))
    assert (finding.severity, finding.field) == (REJECTED, "base_quat_xyzw")
    assert f"left-handed world: its {'xyz'[axis]} axis is reversed" in finding.found


@pytest.mark.parametrize(
    ("one", "other"), [("front_left_hip", "rear_right_knee"), ("front_left_thigh", "front_right_knee")]
)
def test_two_joints_of_different_legs_that_are_exchanged_are_named_with_the_right_order(one: str, other: str) -> None:
    """In columns of an order that no program has, so that none of these is an explanation."""
    log, order = STANCE.measured, np.random.default_rng(2).permutation(len(ROBOT.joint_names))
    names = [log.joint_names[column] for column in order]
    shuffled = replace(log, joint_position=log.joint_position[:, order], joint_names=tuple(names))
    partner = {one: other, other: one}
    mistaken = replace(shuffled, joint_names=tuple(partner.get(name, name) for name in names))
    assert findings(shuffled) == []
    (finding,) = findings(mistaken)
    assert (finding.severity, finding.field) == (REJECTED, "joint_names")
    assert sorted(finding.found.partition(" exchanged: ")[0].split(" and ")) == sorted((one, other))
    assert finding.advice.endswith(f"logs.columns.joint_order: [{', '.join(names)}]")


def test_a_reversed_joint_is_named_and_how_to_reverse_it() -> None:
    joint = next(i for i, name in enumerate(ROBOT.joint_names) if "knee" in name)
    log, name = STANCE.measured, STANCE.measured.joint_names[joint]
    position = log.joint_position.copy()
    position[:, joint] *= -1.0
    (finding,) = findings(replace(log, joint_position=position))
    assert (finding.severity, finding.field) == (REJECTED, "joint_position")
    assert finding.found.startswith(f"{name} reversed")
    assert f"{{{name}: -1}}" in finding.advice


@pytest.mark.parametrize("sides_exchanged", [False, True])
def test_the_order_of_a_simulator_is_named_and_stated_for_arrays_without_names(sides_exchanged: bool) -> None:
    """By hips, thighs and knees, as Isaac Lab has them, taken for leg by leg."""
    legs = ["front_left", "front_right", "rear_left", "rear_right"]
    if sides_exchanged:
        legs = [legs[i] for i in (1, 0, 3, 2)]
    true = [f"{leg}_{joint}" for joint in ("hip", "thigh", "knee") for leg in legs]
    log = STANCE.measured
    columns = log.joint_position[:, [log.joint_names.index(name) for name in true]]
    (finding,) = findings(replace(log, joint_names=ROBOT.joint_names, joint_position=columns))
    assert (finding.severity, finding.field) == (REJECTED, "joint_names")
    assert finding.found.startswith("columns in breadth-first order")
    assert finding.advice.endswith(f"logs.columns.joint_order: [{', '.join(true)}]")


@pytest.mark.parametrize("coupled", [False, True])
def test_links_keep_their_poses_where_no_joint_that_carries_them_has_moved(coupled: bool, tmp_path: Path) -> None:
    """Which decides whose poses are worked out anew; a knee that follows a hind hip is moved by it."""
    text, knee = QUADRUPED.read_text(), '<child link="front_left_shank_link"/>'
    assert text.count(knee) == 1
    (tmp_path / "robot.urdf").write_text(
        text.replace(knee, f'{knee}<mimic joint="rear_left_hip"/>') if coupled else text
    )
    robot, feet = load_robot(tmp_path / "robot.urdf"), ["front_left_foot", "rear_right_foot"]
    position = np.random.default_rng(2).normal(size=(3, robot.n))
    log = Log("log", time=np.arange(3.0), joint_names=robot.joint_names, joint_position=position)
    before, same = recorded_link_poses(log, robot), dict[str, bool]()
    for joint, name in enumerate(robot.joint_names):
        other = replace(log, joint_position=position + np.eye(robot.n)[joint])
        after = recorded_link_poses(other, robot)
        same[name] = same_poses(log, other, robot, feet)
        assert same[name] == all(torch.equal(before[foot], after[foot]) for foot in feet), name
        assert same_poses(log, replace(log, joint_position=position.copy()), robot, feet)
    assert sum(same.values()) == (5 if coupled else 6)
    assert same["rear_left_hip"] == (not coupled)


def test_an_orientation_that_never_changes_is_not_passed_over_in_silence() -> None:
    log = STANCE.measured
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1))
    (finding,) = findings(replace(log, base_quat_xyzw=still))
    assert (finding.name, finding.severity, finding.field) == ("standing feet", SUSPICIOUS, "all")
    assert "no usual mistake explains it" in finding.found


@pytest.mark.parametrize(
    ("at", "turn_deg", "late_s", "found"),
    [
        (
            (0.1, -0.05, 0.15),
            (0.0, 0.0, 0.0),
            0.0,
            r"of a point at \((9\d|10\d), -(4\d|5\d), 1[3-6]\d\) mm of the base link$",
        ),
        ((0.0, 0.0, 0.0), (0.0, 10.0, 40.0), 0.0, r"turned about it by \(-?\d, \d+, (39|40|41)\) degrees$"),
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.06, r"is (5[5-9]|6[0-5]) ms late$"),
    ],
    ids=["offset", "turn", "lag"],
)
def test_a_pose_of_another_frame_or_time_is_named_with_where_and_when(
    at: tuple[float, ...], turn_deg: tuple[float, ...], late_s: float, found: str
) -> None:
    log = STANCE.measured
    R, t = Rotation.from_quat(value(log.base_quat_xyzw)), np.clip(log.time - late_s, log.time[0], log.time[-1])
    place = value(log.base_position_world) + R.apply(at)
    moved = Slerp(log.time, R * Rotation.from_rotvec(np.radians(turn_deg)))(t)
    late = np.stack([np.interp(t, log.time, axis) for axis in place.T], axis=1)
    (finding,) = findings(replace(log, base_quat_xyzw=moved.as_quat(), base_position_world=late))
    assert (finding.name, finding.severity, finding.field) == ("frame", SUSPICIOUS, "base_quat_xyzw")
    assert re.search(found, finding.found)


def test_the_foot_that_moves_most_comes_first() -> None:
    names, log = list(STANCE.measured.joint_names), STANCE.measured
    position = log.joint_position.copy()
    for joint, name in enumerate(names):
        if name.startswith("rear_left"):
            position[:, joint] = position[:, joint].mean() + 5.0 * (position[:, joint] - position[:, joint].mean())
    (finding,) = findings(replace(log, joint_position=position))
    assert finding.channels[0] == "rear_left_foot"


@pytest.mark.parametrize(("scale", "zero"), [(1.0, 0.3), (1.5, 0.0)], ids=["zero off by 0.3 rad", "scaled by 1.5"])
def test_the_one_foot_whose_encoder_is_off_is_named(scale: float, zero: float) -> None:
    log, joint = STANCE.measured, next(i for i, name in enumerate(ROBOT.joint_names) if "knee" in name)
    position = log.joint_position.copy()
    position[:, joint] = scale * position[:, joint] + zero
    (finding,) = findings(replace(log, joint_position=position))
    assert (finding.name, finding.severity, finding.field) == ("standing feet", SUSPICIOUS, "joint_position")
    limb = ROBOT.joint_names[joint].removesuffix("_knee")
    assert finding.channels == (f"{limb}_foot",)
    assert finding.found.startswith(f"{limb}_foot moves though its flag is on")
