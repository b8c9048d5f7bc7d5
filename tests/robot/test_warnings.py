"""What a URDF may be and is warned of, what defaults mean, and all URDFs of example-robot-data."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from regressors import of_every_robot
from synthetic import G1, PANDA, ROBOTS, SOLO12, joint_map
from urdfs import ARM, BASE, HINGE, inertial, joint, link, refusal, warned, write

from torchid.errors import MasslessBodyWarning, UnknownNameError, UnphysicalInertiaWarning, UrdfError
from torchid.robot import load_robot


@pytest.mark.parametrize(
    ("element", "expected"),
    [
        (inertial(ixx="0.3"), "the largest principal inertia (0.3 kg m^2) exceeds the sum of the others, 0.2"),
        (inertial(izz="-0.1"), "principal inertias (-0.1, 0.1, 0.1 kg m^2) must be positive"),
        (inertial(ixy="0.2"), "must be positive"),
        (inertial(mass="0"), "the mass is 0, but the inertia is not"),
    ],
    ids=["triangle", "negative", "indefinite", "mass 0"],
)
def test_an_inertia_of_no_body_is_warned_of_by_link_and_kept_as_written(
    element: str, expected: str, tmp_path: Path
) -> None:
    path = write(tmp_path, BASE, link("arm", element), HINGE)
    robot, caught = warned(path)
    assert [w.category for w in caught] == [UnphysicalInertiaWarning]
    message = str(caught[0].message)
    assert message.startswith(f"{path}: link 'arm': ")
    assert expected in message
    assert "\n" not in message
    assert robot.massless == ()
    numbers = re.search(r'ixx="(\S+)" ixy="(\S+)"', element)
    assert numbers is not None
    np.testing.assert_array_equal(robot.nominal[1, [4, 5]], [float(x) for x in numbers.groups()])


@pytest.mark.parametrize("element", ["", inertial(mass="0", ixx="0", iyy="0", izz="0")], ids=["no inertial", "zeros"])
def test_a_limb_that_ends_in_a_massless_body_is_warned_of(element: str, tmp_path: Path) -> None:
    path = write(tmp_path, BASE, link("arm", element), HINGE)
    robot, caught = warned(path)
    assert [w.category for w in caught] == [MasslessBodyWarning]
    assert str(caught[0].message).startswith(f"{path}: link 'arm' at the end of a limb has no inertia")
    assert robot.massless == ("arm",)


def test_axis_and_numbers_left_out_have_the_values_the_urdf_specification_gives(tmp_path: Path) -> None:
    follower = joint("wrist", "arm", "hand", "prismatic", '<mimic joint="elbow"/>')
    robot = load_robot(write(tmp_path, BASE, ARM, joint("elbow", "base", "arm", extra=""), link("hand"), follower))
    elbow, wrist = (body.joint for body in robot.bodies[1:])
    assert elbow is not None
    assert wrist is not None
    np.testing.assert_array_equal(elbow.axis, [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(elbow.T_parent_joint, np.eye(4))
    assert (elbow.damping, elbow.friction) == (0.0, 0.0)
    assert wrist.mimic is not None
    assert (wrist.mimic.master, wrist.mimic.multiplier, wrist.mimic.offset) == ("elbow", 1.0, 0.0)


def test_joint_friction_of_the_urdf_is_nominal(tmp_path: Path) -> None:
    rub = joint("elbow", "base", "arm", extra='<axis xyz="0 0 1"/><dynamics damping="0.25" friction="1.5"/>')
    robot = load_robot(write(tmp_path, BASE, ARM, rub))
    np.testing.assert_array_equal(robot.nominal[1, 10:], [1.5, 0.25])
    elbow = robot.bodies[1].joint
    assert elbow is not None
    assert (elbow.friction, elbow.damping) == (1.5, 0.25)


REAL = sorted(ROBOTS.rglob("*.urdf"))
REFUSED = {
    "ur3.urdf": (UrdfError, "link: none found"),
    "alex_psyonic_hands.urdf": (UnknownNameError, "joint 'Left_index_q2', <mimic>: unknown name 'index_q1'"),
}


def test_there_are_69_real_robots() -> None:
    assert len(REAL) == 69


@of_every_robot([SOLO12, G1, PANDA, *(path for path in REAL if path.name in REFUSED)], REAL)
def test_a_real_robot_is_read_whole_or_refused_for_its_true_fault(urdf: Path) -> None:
    if urdf.name in REFUSED:
        kind, expected = REFUSED[urdf.name]
        assert expected in refusal(urdf, kind)
        return
    robot, caught = warned(urdf)
    assert {w.category for w in caught} <= {UnphysicalInertiaWarning, MasslessBodyWarning}
    moving = joint_map(urdf, robot.joint_names)
    assert set(moving) == {body.joint.name for body in robot.bodies if body.joint is not None}
    independent = [name for name, (row, _) in moving.items() if name in robot.joint_names and row.sum() == 1.0]
    assert sorted(independent) == sorted(robot.joint_names)
    assert sorted(robot.links) == sorted(link for body in robot.bodies for link in body.links)
    assert np.isfinite(robot.nominal).all()


def test_inertias_of_no_body_are_said_in_one_line(tmp_path: Path) -> None:
    parts = [link("arm", inertial(ixx="0.3")), HINGE, link("tip", inertial(mass="0")), joint("wrist", "arm", "tip")]
    _, caught = warned(write(tmp_path, BASE, *parts))
    (message,) = [str(w.message) for w in caught]
    assert "link 'arm': the largest principal inertia (0.3 kg m^2) exceeds" in message
    assert message.endswith("; also physically inconsistent: tip; it is used as it is")
