"""Jacobians, by virtual work: the rows of J are the generalized forces of unit wrenches."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from torchid.parameters import Array
from torchid.regressor.kinematics import (
    GRAVITY_WORLD,
    BodyStates,
    body_states,
    cross_product,
    joint_motion,
    motion_from_state,
)
from torchid.regressor.regressor import joint_screw_axes
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


def wrenches_at_base(states: BodyStates, body: int, wrenches: Tensor) -> Tensor:
    """Wrenches that are constant in a body's joint frame, (k, 6), at the base origin in base axes, (6, k, B)."""
    rotation, position = states.rotation[:, :, body], states.position[:, body]
    force = wrenches[:, :3] @ rotation
    return torch.cat([force, wrenches[:, 3:] @ rotation + cross_product(position[:, None].expand_as(force), force)])


def generalized_forces(
    tree: KinematicTree, directions: Tensor, body: int, wrenches: Tensor, joints: Sequence[int]
) -> Tensor:
    """Work of wrenches on a body, per unit of base twist and joint velocity.

    Args:
        tree: the robot's constants.
        directions: from `joint_screw_axes`, (6, L, B).
        body: which body.
        wrenches: at the base origin, (6, k, B).
        joints: independent joints to give columns for, after the base's six (none for a fixed base).

    Returns:
        (k, base rows + len(joints), B).
    """
    path = tree.path(body)
    screws = tree.joint_map[path][:, list(joints)].T @ directions[:, path]
    torque = (wrenches[:, :, None] * screws[:, None]).sum(0)
    return torch.cat([wrenches.transpose(0, 1), torque], dim=1) if tree.base_rows else torque


def wrench_transform(T: Array) -> Array:
    """Matrix (6, 6) that takes a wrench at a frame, in its axes, to the frame that `T` (4, 4) gives its pose in."""
    R, p = T[:3, :3], T[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [np.cross(np.eye(3), p) @ R, R]])


class FrameJacobian(nn.Module):
    """Jacobian of a URDF frame: `J(q) v` is the twist of its origin in its own axes, linear velocity first."""

    def __init__(self, robot: Robot, frame: str) -> None:
        """Build the constants.

        Args:
            robot: the robot.
            frame: name of a URDF link.

        Raises:
            UnknownNameError: the URDF has no such link.
        """
        super().__init__()
        self.tree = KinematicTree(robot)
        self._body, T_joint_frame = self.tree.frame(robot, frame)
        unit_wrenches = wrench_transform(T_joint_frame).T
        self.register_buffer("unit_wrenches", torch.tensor(unit_wrenches.copy()), persistent=False)
        self._joints = range(robot.n_dofs)

    def forward(self, q: Tensor) -> Tensor:
        """Jacobian (B, 6, nv) at coordinates `q`, (B, n + 7) or (B, n) for a fixed base (see `Regressor`).

        Force/torque sensors in limbs add six columns each, after those of the joints.
        """
        tree = self.tree
        still = q.new_zeros(q.shape[0], tree.n + tree.base_rows)
        motion = motion_from_state(q, still, still, tree.n, not tree.base_rows, GRAVITY_WORLD)
        states = body_states(tree, motion, joint_motion(tree, motion))
        wrenches = wrenches_at_base(states, self._body, self.get_buffer("unit_wrenches"))
        J = generalized_forces(tree, joint_screw_axes(tree, states), self._body, wrenches, self._joints)
        return J.permute(2, 0, 1)
