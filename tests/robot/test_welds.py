"""Joints that are welded by name, against Pinocchio's reduced models."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from regressors import assert_close, regressor
from synthetic import random_states
from urdfs import joint, link, write

from torchid.errors import InputError, TorchidWarning
from torchid.logs import Log
from torchid.problem.log_joints import joint_order, without_welded_joints
from torchid.report.urdf_files import identified_urdf
from torchid.robot import Robot, load_robot

TURNED = '<origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.7 1.1"/><axis xyz="0.6 0 0.8"/>'
LIMITS = '<limit lower="-1" upper="2" effort="1" velocity="1"/>'


def _arm(folder: Path) -> Path:
    """A base, an upper arm, a wrist between two moving joints, and a slide."""
    links = [link(name) for name in ("base", "upper", "wrist", "hand", "slide")]
    joints = [
        joint("shoulder", "base", "upper", extra=TURNED + LIMITS),
        joint("roll", "upper", "wrist", extra=TURNED + LIMITS),
        joint("pitch", "wrist", "hand", extra=TURNED + LIMITS),
        joint("push", "wrist", "slide", "prismatic", TURNED + LIMITS),
    ]
    return write(folder, *links, *joints)


def _load(path: Path, weld: dict[str, float], base_link: str | None = None) -> Robot:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        return load_robot(path, base_link, weld=weld)


def _assert_forces_are_those_of_the_reduced_model(robot: Robot) -> None:
    full = pin.buildModelFromUrdf(str(robot.path), pin.JointModelFreeFlyer())
    locked = pin.neutral(full)
    for name, position in robot.welded.items():
        locked[full.joints[full.getJointId(name)].idx_q] = position
    model = pin.buildReducedModel(full, [full.getJointId(name) for name in robot.welded], locked)
    assert tuple(model.names)[2:] == robot.joint_names
    q, v, a = random_states(np.random.default_rng(3), robot.n, 4, False)
    forces = np.stack([pin.rnea(model, model.createData(), *state) for state in zip(q, v, a, strict=True)])
    found = np.einsum("bilk,lk->bi", regressor(robot, q, v, a)[..., :10], robot.nominal[:, :10])
    assert_close(found, forces)


def test_forces_with_a_turned_wrist_and_a_slide_welded_off_zero_are_those_of_pinocchios_reduced_model(
    tmp_path: Path,
) -> None:
    _assert_forces_are_those_of_the_reduced_model(_load(_arm(tmp_path), {"roll": 0.9, "pu*": -0.35}))


@pytest.mark.parametrize("base_link", [None, "hand"])
def test_identified_urdf_has_its_joints_and_gives_the_same_bodies_where_they_are_welded(
    tmp_path: Path, base_link: str | None
) -> None:
    weld = {"roll": 0.9, "push": -0.35}
    robot = _load(_arm(tmp_path), weld, base_link)
    phi = robot.nominal.copy()
    phi[:, :10] *= 1.1
    written = tmp_path / "identified.urdf"
    written.write_bytes(identified_urdf(robot, phi))
    assert_close(_load(written, weld, base_link).nominal, phi)
    moving = load_robot(written)
    assert moving.joint_names == load_robot(robot.path).joint_names


@pytest.mark.parametrize(
    ("weld", "message"),
    [
        ({"rol": 0.0}, "unknown name 'rol'"),
        ({"*finger*": 0.0}, "matches no joint that moves"),
        ({"roll": 2.1}, "2.1 is outside the limits of joint 'roll'; accepted: a position from -1 to 2"),
        ({"roll": 0.1, "r*": 0.2}, "one position per joint"),
        ({"*": 0.0}, "fixes every joint"),
    ],
)
def test_welds_that_do_not_fit_the_robot_are_refused(tmp_path: Path, weld: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=r"robot\.weld") as error:
        load_robot(_arm(tmp_path), weld=weld)
    assert message in str(error.value)


def test_columns_of_welded_joints_are_left_out_and_those_that_move_are_named(tmp_path: Path) -> None:
    robot = _load(_arm(tmp_path), {"roll": 0.9, "push": 0.1})
    names = ("push", "pitch", "roll", "shoulder")
    position = np.tile([0.104, 0.2, 0.94, 0.3], (5, 1))
    log = Log("a.npz", np.arange(5.0), names, position, joint_torque=position)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bare = without_welded_joints(log, robot)
    assert bare.joint_names == ("pitch", "shoulder")
    assert bare.joint_torque is not None
    np.testing.assert_array_equal(bare.joint_torque, position[:, [1, 3]])
    assert joint_order(log, robot) == [3, 1]
    position[2, 0] = 0.11
    with pytest.warns(TorchidWarning, match="'push' is up to 0.01 m away from its welded 0.1 m"):
        without_welded_joints(log, robot)
