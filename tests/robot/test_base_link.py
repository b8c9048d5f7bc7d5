"""Another base link than the root of the URDF: the same machine, seen from elsewhere."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
import torch
from regressors import by_joints_of, seen_from
from synthetic import (
    BAXTER,
    G1,
    PANDA,
    ROBOTS,
    TIAGO,
    Array,
    Oracle,
    load,
    random_states,
)

from torchid.regressor import FrameJacobian, Regressor
from torchid.robot import Robot


def turned_inertias(urdf: Path, folder: Path) -> Path:
    """The URDF with every inertia frame turned at random and friction in every joint."""
    rng = np.random.default_rng(7)
    tree = ElementTree.parse(urdf)
    for inertial in tree.findall("./link/inertial"):
        origin = inertial.find("origin")
        origin = ElementTree.SubElement(inertial, "origin") if origin is None else origin
        origin.set("rpy", " ".join(map(repr, rng.uniform(-1.5, 1.5, 3).tolist())))
    for element in tree.findall("joint"):
        for dynamics in element.findall("dynamics"):
            element.remove(dynamics)
        damping, friction = rng.uniform(0.5, 2.0, 2).tolist()
        ElementTree.SubElement(element, "dynamics", damping=repr(damping), friction=repr(friction))
    path = folder / urdf.name
    tree.write(path)
    return path


def forces(robot: Robot, *state: Array) -> Array:
    """Nominal inverse dynamics with friction, (B, nv), by the regressor."""
    K = Regressor(robot)(*map(torch.from_numpy, state))
    return (K @ torch.from_numpy(robot.nominal.flatten())).numpy()


def standing_on(robot: Robot, foot: str, *state: Array) -> tuple[Array, Array]:
    """Wrench at a foot's frame that carries the robot alone, (B, 6), and the joint torques with it, (B, n)."""
    needed = forces(robot, *state)
    J = FrameJacobian(robot, foot)(torch.from_numpy(state[0])).numpy()
    wrench = np.linalg.solve(J[:, :, :6].transpose(0, 2, 1), needed[:, :6, None])[..., 0]
    return wrench, needed[:, 6:] - np.einsum("bki,bk->bi", J[:, :, 6:], wrench)


REROOTED = [
    (G1, "left_ankle_roll_link", "right_ankle_roll_link"),
    (G1, "torso_link", "right_ankle_roll_link"),
    (G1, "left_ankle_roll_link", "left_ankle_roll_link"),
    (PANDA, "panda_leftfinger", "panda_hand"),
    (BAXTER, "l_gripper_r_finger", "r_gripper_l_finger"),
    (TIAGO, "torso_lift_link", "arm_7_link"),
    (ROBOTS / "tiago_pro_description/robots/tiago_pro.urdf", "arm_left_tool_link", "base_link"),
]

every_pair_of_links = pytest.mark.parametrize(
    ("urdf", "base_link", "foot"), REROOTED, ids=lambda x: getattr(x, "stem", x)
)
every_other_base = pytest.mark.parametrize(
    ("urdf", "base_link"), [case[:2] for case in REROOTED], ids=lambda x: getattr(x, "stem", x)
)


@every_pair_of_links
def test_what_carries_a_robot_and_moves_its_joints_is_the_same_from_every_base_link(
    urdf: Path, base_link: str, foot: str, tmp_path: Path
) -> None:
    path = turned_inertias(urdf, tmp_path)
    from_root, from_other = load(path), load(path, base_link)
    assert sorted(from_root.joint_names) == sorted(from_other.joint_names)
    state = random_states(np.random.default_rng(3), from_root.n, 6)
    moved = seen_from(Oracle.of(from_root), base_link, *state)
    moved = tuple(by_joints_of(from_root, from_other, k, x) for k, x in zip((7, 6, 6), moved, strict=True))
    wrench, torque = standing_on(from_root, foot, *state)
    wrench_too, torque_too = standing_on(from_other, foot, *moved)
    size = max(np.abs(wrench).max(), np.abs(torque).max())
    np.testing.assert_allclose(wrench_too, wrench, rtol=0.0, atol=1e-12 * size)
    np.testing.assert_allclose(by_joints_of(from_other, from_root, 0, torque_too), torque, rtol=0.0, atol=1e-12 * size)


@every_other_base
def test_the_base_wrench_is_the_same_wrench_at_every_base_link(urdf: Path, base_link: str, tmp_path: Path) -> None:
    path = turned_inertias(urdf, tmp_path)
    from_root, from_other = load(path), load(path, base_link)
    oracle = Oracle.of(from_root)
    state = random_states(np.random.default_rng(4), from_root.n, 6)
    moved = seen_from(oracle, base_link, *state)
    there = forces(
        from_other, *(by_joints_of(from_root, from_other, k, x) for k, x in zip((7, 6, 6), moved, strict=True))
    )
    here = forces(from_root, *state)
    J = oracle.jacobian(state[0], base_link)
    carried = np.einsum("bki,bk->bi", J, there[:, :6])  # by virtual work: to the root and to the joints in between
    carried[:, 6:] += by_joints_of(from_other, from_root, 0, there[:, 6:])
    np.testing.assert_allclose(carried, here, rtol=0.0, atol=1e-12 * np.abs(here).max())
