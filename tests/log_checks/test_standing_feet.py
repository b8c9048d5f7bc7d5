"""What feet that stand by their flags show of orientation and joint positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motions import value
from stances import stance
from walking import robot_of

from torchid.log_checks import REJECTED, SUSPICIOUS, Finding
from torchid.log_checks.standing_feet import check_standing_feet
from torchid.logs import Log

STANCE = stance("quadruped", samples=500)
ROBOT, CONTACTS = robot_of(STANCE.machine), STANCE.contacts()


def findings(log: Log) -> list[Finding]:
    """What the motion of the feet gives away."""
    return [one for one in check_standing_feet(log, ROBOT, CONTACTS) if isinstance(one, Finding)]


def test_feet_that_stand_give_no_finding() -> None:
    assert findings(STANCE.measured) == []


@pytest.mark.parametrize("axis", range(3))
def test_the_pose_in_a_left_handed_world_is_named_with_its_axis(axis: int) -> None:
    signs = np.where(np.arange(3) == axis, -1.0, 1.0)
    log = STANCE.measured
    quat, position = value(log.base_quat_xyzw) * [*-signs, 1.0], value(log.base_position_world) * signs
    (finding,) = findings(replace(log, base_quat_xyzw=quat, base_position_world=position))
    assert (finding.severity, finding.field) == (REJECTED, "base_quat_xyzw")
    assert f"left-handed world, whose {'xyz'[axis]} axis is reversed" in finding.found


def test_a_reversed_joint_is_named_and_how_to_reverse_it() -> None:
    joint = next(i for i, name in enumerate(ROBOT.joint_names) if "knee" in name)
    log, name = STANCE.measured, STANCE.measured.joint_names[joint]
    position = log.joint_position.copy()
    position[:, joint] *= -1.0
    (finding,) = findings(replace(log, joint_position=position))
    assert (finding.severity, finding.field) == (REJECTED, "joint_position")
    assert finding.found.startswith(f"{name} reversed")
    assert f"{{{name}: -1}}" in finding.advice


def test_an_orientation_that_never_changes_is_not_passed_over_in_silence() -> None:
    log = STANCE.measured
    still = np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1))
    (finding,) = findings(replace(log, base_quat_xyzw=still))
    assert (finding.name, finding.severity, finding.field) == ("standing feet", SUSPICIOUS, "all")
    assert "no usual mistake explains it" in finding.found


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
    assert finding.found.startswith(f"{limb}_foot moves though it stands")
