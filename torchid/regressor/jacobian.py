"""Body and frame Jacobians."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from torchid.parameters import Array
from torchid.regressor.dynamics import joint_directions
from torchid.regressor.kinematics import BodyStates, JointStates, body_states, cross, joint_states, rotate
from torchid.regressor.motion import GRAVITY_WORLD, motion_from_state
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


def body_jacobian(tree: KinematicTree, states: BodyStates, directions: Tensor, body: int, joints: list[int]) -> Tensor:
    """Jacobian of a body's joint frame: twist of its origin in its own axes, linear part first.

    Args:
        tree: the robot's constants.
        states: of the joint frames.
        directions: from `joint_directions`, (6, L, B).
        body: which body.
        joints: independent joints to give columns for, after the base's six (none for a fixed base).

    Returns:
        (6, base rows + len(joints), B).
    """
    samples = directions.shape[-1]
    unit = torch.eye(6, dtype=directions.dtype, device=directions.device)[..., None].expand(6, 6, samples)
    path = tree.path(body)
    columns = [unit[:, k] for k in range(tree.base_rows)]
    ratios = tree.joint_map.T.tolist()
    for joint in joints:
        column = torch.zeros_like(directions[:, 0])
        for moved in path:
            if ratios[joint][moved]:
                column = column + ratios[joint][moved] * directions[:, moved]
        columns.append(column)
    if not columns:
        return directions.new_zeros(6, 0, samples)
    screw = torch.stack(columns, dim=1)
    inverse = states.rotation[:, :, body].transpose(0, 1).unsqueeze(2)
    linear = screw[:3] + cross(screw[3:], states.position[:, body].unsqueeze(1).expand_as(screw[3:]))
    return torch.cat([rotate(inverse, linear), rotate(inverse, screw[3:])])


def wrench_map(T: Array) -> Array:
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
        self._body, T_link_frame = robot.link(frame)
        in_joint_frame = wrench_map(self.tree.T_joint_link[self._body] @ T_link_frame)
        self.register_buffer("to_frame", torch.tensor(in_joint_frame.T.copy()), persistent=False)
        self._joints = list(range(robot.n))

    def forward(self, q: Tensor) -> Tensor:
        """Jacobian (B, 6, nv) at coordinates `q`, (B, n + 7) or (B, n) for a fixed base (see `Regressor`)."""
        tree = self.tree
        still = q.new_zeros(q.shape[0], len(self._joints) + tree.base_rows)
        motion = motion_from_state(q, still, still, not tree.base_rows, GRAVITY_WORLD)
        joints: JointStates = joint_states(tree, motion)
        states = body_states(tree, motion, joints)
        J = body_jacobian(tree, states, joint_directions(tree, states), self._body, self._joints)
        return torch.tensordot(self.get_buffer("to_frame"), J, dims=1).permute(2, 0, 1)
