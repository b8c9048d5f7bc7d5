"""What tests of the regressor share."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import torch
from hypothesis import settings
from hypothesis import strategies as st
from synthetic import (
    Array,
    Oracle,
)
from torch import Tensor

from torchid import parameters
from torchid.regressor import Regressor
from torchid.robot import Robot

base_kinds = pytest.mark.parametrize("fixed_base", [False, True], ids=["floating", "bolted"])
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=15, deadline=None, derandomize=True)


def of_robots(*urdfs: Path) -> pytest.MarkDecorator:
    """A test per robot."""
    return pytest.mark.parametrize("urdf", urdfs, ids=lambda path: path.stem)


def of_every_robot(always: Sequence[Path], urdfs: Iterable[Path]) -> pytest.MarkDecorator:
    """A test per robot, all but some of which run by `-m every_robot`."""
    cases = [
        pytest.param(urdf, id=urdf.stem, marks=() if urdf in always else pytest.mark.every_robot) for urdf in urdfs
    ]
    return pytest.mark.parametrize("urdf", cases)


def tensors(*arrays: Array) -> tuple[Tensor, ...]:
    """Arrays as tensors."""
    return tuple(map(torch.from_numpy, arrays))


def regressor(robot: Robot, *state: Array) -> Array:
    """K, (B, nv + 6 F, L, 12)."""
    K = Regressor(robot)(*tensors(*state)).numpy()
    return K.reshape(*K.shape[:2], len(robot.bodies), parameters.PER_BODY)


def assert_close(found: Array, expected: Array, relative: float = 1e-14) -> None:
    """Equal to a share of the largest number."""
    size = np.abs(expected).max(initial=0.0)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=relative * size)


def without_shapes(urdf: Path, folder: Path) -> Path:
    """The URDF without meshes and mimic tags (MuJoCo makes soft constraints of these)."""
    tree = ElementTree.parse(urdf)
    for link in tree.findall("link"):
        for element in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(element)
    for joint in tree.findall("joint"):
        for element in joint.findall("mimic"):
            joint.remove(element)
    for tag in ("transmission", "gazebo", "material", "mujoco"):
        for element in tree.getroot().findall(tag):
            tree.getroot().remove(element)
    tree.write(folder / urdf.name)
    return folder / urdf.name


def seen_from(oracle: Oracle, frame: str, q: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
    """The same motion in coordinates whose base is another frame; joints as they were."""
    index = oracle.model.getFrameId(frame, pin.FrameType.BODY)
    moved = []
    for state in zip(q, v, a, strict=True):
        full, velocity, acceleration = oracle.coordinates(state[0]), oracle.expand @ state[1], oracle.expand @ state[2]
        pin.forwardKinematics(oracle.model, oracle.data, full, velocity, acceleration)
        pin.updateFramePlacements(oracle.model, oracle.data)
        pose = pin.SE3ToXYZQUAT(oracle.data.oMf[index])
        twist = pin.getFrameVelocity(oracle.model, oracle.data, index, pin.LOCAL).vector
        change = pin.getFrameAcceleration(oracle.model, oracle.data, index, pin.LOCAL).vector
        moved.append((pose, twist, change))
    pose, twist, change = map(np.array, zip(*moved, strict=True))
    return np.hstack([pose, q[:, 7:]]), np.hstack([twist, v[:, 6:]]), np.hstack([change, a[:, 6:]])


def by_joints_of(robot: Robot, other: Robot, base: int, x: Array) -> Array:
    """Joint columns in another robot's order."""
    order = [robot.joint_names.index(name) for name in other.joint_names]
    return np.hstack([x[:, :base], x[:, base:][:, order]])
