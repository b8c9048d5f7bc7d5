"""From URDF to a tree of bodies: real robots and small ones written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from scipy.spatial.transform import Rotation
from synthetic import (
    ANYMAL,
    BAXTER,
    DRONE,
    G1,
    PANDA,
    PINOCCHIO_ORDER,
    ROBOTS,
    SOLO12,
    TALOS,
    TALOS_FULL,
    TIAGO,
    UR5,
    Oracle,
    load,
    random_states,
    transform,
)
from urdfs import write

from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.robot import load_robot

REAL = (
    *(ANYMAL, BAXTER, DRONE, G1, PANDA, SOLO12, TALOS, TIAGO, UR5),
    ROBOTS / "romeo_description/urdf/romeo.urdf",
    ROBOTS / "pr2_description/urdf/pr2.urdf",
    TALOS_FULL,
    ROBOTS / "tiago_pro_description/robots/tiago_pro.urdf",
    ROBOTS / "icub_description/robots/icub.urdf",
)

every_real_robot = pytest.mark.parametrize("urdf", REAL, ids=lambda path: path.stem)


def link(name: str) -> str:
    """A link with an inertia like no other's."""
    origin = '<origin xyz="0.1 -0.2 0.3" rpy="0.4 0.5 -0.6"/>'
    inertia = '<inertia ixx="0.3" ixy="0.01" ixz="-0.02" iyy="0.4" iyz="0.03" izz="0.5"/>'
    return f'<link name="{name}"><inertial>{origin}<mass value="2"/>{inertia}</inertial></link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", extra: str = "") -> str:
    """A joint element about or along z."""
    axis = "" if kind == "fixed" else '<axis xyz="0 0 1"/>'
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="1 0.5 0.2" rpy="0.3 -0.2 0.1"/>'
        f'<parent link="{parent}"/><child link="{child}"/>{axis}{extra}</joint>'
    )


def mimic(master: str, multiplier: float, offset: float) -> str:
    """A mimic element."""
    return f'<mimic joint="{master}" multiplier="{multiplier}" offset="{offset}"/>'


ORIGIN = transform(Rotation.from_euler("xyz", [0.3, -0.2, 0.1]).as_matrix(), np.array([1.0, 0.5, 0.2]))


# ---------------------------------------------------------------------------------------------------- real robots


@every_real_robot
def test_a_body_has_the_inertia_of_all_links_welded_to_it(urdf: Path) -> None:
    robot = load(urdf)
    expected = Oracle.of(robot).inertial_parameters(robot)
    np.testing.assert_allclose(robot.nominal[:, parameters.INERTIAL], expected, rtol=0.0, atol=1e-14 * expected.max())


@every_real_robot
def test_every_link_is_where_pinocchio_puts_it(urdf: Path) -> None:
    robot = load(urdf)
    q, _, _ = random_states(np.random.default_rng(0), robot.n, 4)
    q[:, :7] = [0.0] * 6 + [1.0]
    oracle = Oracle.of(robot)
    poses = robot.link_poses(torch.from_numpy(q[:, 7:]))
    assert set(poses) == set(robot.links)
    for name, T_base_link in poses.items():
        rotation, position = oracle.pose(q, name)
        np.testing.assert_allclose(T_base_link[:, :3, :3], rotation, rtol=0.0, atol=1e-14, err_msg=name)
        np.testing.assert_allclose(T_base_link[:, :3, 3], position, rtol=0.0, atol=1e-14, err_msg=name)


@every_real_robot
def test_the_chain_moves_every_joint_by_its_name_and_carries_every_link(urdf: Path) -> None:
    robot = load(urdf)
    names = robot.chain.get_joint_parameter_names()
    assert sorted(names) == sorted(body.joint.name for body in robot.bodies if body.joint is not None)
    matrix, offset = robot.joint_map
    in_order = [body.joint.name for body in robot.bodies if body.joint is not None]
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (3, robot.n))
    positions = (q @ matrix.T + offset)[:, [in_order.index(name) for name in names]]
    transforms = robot.chain.forward_kinematics(torch.from_numpy(positions))
    for name, T_base_link in robot.link_poses(torch.from_numpy(q)).items():
        np.testing.assert_array_equal(transforms[name].get_matrix(), T_base_link)


# ------------------------------------------------------------------------------------------------ written by hand


def test_a_welded_body_weighs_in_by_the_parallel_axes_of_its_turned_frame(tmp_path: Path) -> None:
    robot = load_robot(write(tmp_path, link("base"), link("tool"), joint("weld", "base", "tool", "fixed")))
    assert len(robot.bodies) == 1
    in_link = pin.SE3(Rotation.from_euler("xyz", [0.4, 0.5, -0.6]).as_matrix(), np.array([0.1, -0.2, 0.3]))
    at_com = pin.Inertia(2.0, np.zeros(3), np.array([[0.3, 0.01, -0.02], [0.01, 0.4, 0.03], [-0.02, 0.03, 0.5]]))
    one = in_link.act(at_com)
    both = (one + pin.SE3(ORIGIN).act(one)).toDynamicParameters()
    np.testing.assert_allclose(robot.nominal[0, PINOCCHIO_ORDER], both, rtol=0.0, atol=1e-14)
    body, T_body_link = robot.link("tool")
    assert body == 0
    np.testing.assert_allclose(T_body_link, ORIGIN, rtol=0.0, atol=1e-15)


def test_mimic_joints_that_follow_mimic_joints_end_at_the_one_that_is_free(tmp_path: Path) -> None:
    names = ["base", "a", "b", "c"]
    joints = (
        joint("last", "b", "c", extra=mimic("middle", 3.0, 0.5)),
        joint("middle", "a", "b", "prismatic", mimic("first", -2.0, 0.25)),
        joint("first", "base", "a"),
    )
    robot = load_robot(write(tmp_path, *map(link, names), *joints))
    assert robot.joint_names == ("first",)
    matrix, offset = robot.joint_map
    np.testing.assert_array_equal(matrix, [[1.0], [-2.0], [-6.0]])  # first, middle, last
    np.testing.assert_array_equal(offset, [0.0, 0.25, 3.0 * 0.25 + 0.5])


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
@pytest.mark.parametrize("base_link", ["base", "tip"])
def test_a_joint_that_mimics_a_fixed_one_is_held_at_its_offset(kind: str, base_link: str, tmp_path: Path) -> None:
    path = write(
        tmp_path,
        *map(link, ["base", "stand", "tip"]),
        joint("weld", "base", "stand", "fixed"),
        joint("held", "stand", "tip", kind, mimic("weld", 2.0, 0.7)),
    )
    with pytest.warns(TorchidWarning, match="'weld' is fixed, so this joint is fixed too"):
        robot = load_robot(path, base_link)
    assert (robot.n, robot.body_names) == (0, (base_link,))
    turn = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_matrix()
    slid, turned = transform(np.eye(3), np.array([0.0, 0.0, 0.7])), transform(turn, np.zeros(3))
    T_base_tip = ORIGIN @ ORIGIN @ (slid if kind == "prismatic" else turned)
    _, T = robot.link("tip" if base_link == "base" else "base")
    np.testing.assert_allclose(
        T, T_base_tip if base_link == "base" else np.linalg.inv(T_base_tip), rtol=0.0, atol=1e-14
    )
