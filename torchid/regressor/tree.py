"""Constants of a robot's tree in the frames the dynamics are computed in.

Every body gets a *joint frame* whose z axis is the joint axis: a joint's motion then touches two columns of a rotation
only, and the parameters that a joint cannot tell from its parent's have fixed places (see `reduction`).
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from torchid.parameters import Array
from torchid.robot import Robot


class KinematicTree(nn.Module):
    """Constant tensors of a robot, batch-last: a trailing axis of length 1 broadcasts over samples.

    Attributes (buffers, so `.to()` moves and casts them):
        rotation: (3, 3, L, 1), joint frame at position 0 in the parent's joint frame; `offset`: (3, L, 1) [m].
        link_rotation, link_offset: the body's link frame in its joint frame.
        revolute, prismatic: (L, 1) of 0 and 1.
        ancestors: (L, L), 1 where column j's joint moves body i.
        joint_map, joint_constant: positions of all L - 1 joints from the n independent ones.
    """

    rotation: Tensor
    offset: Tensor
    link_rotation: Tensor
    link_offset: Tensor
    revolute: Tensor
    prismatic: Tensor
    ancestors: Tensor
    joint_map: Tensor
    joint_constant: Tensor

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        geometry = robot.geometry
        self.parents = [body.parent for body in robot.bodies]
        count = len(self.parents)
        align = np.stack([_rotation_to_z(axis) for axis in geometry.axis])
        align[0] = np.eye(3)
        joint_frame = np.tile(np.eye(4), (count, 1, 1))
        joint_frame[:, :3, :3] = align
        in_parent = np.linalg.inv(joint_frame[self.parents]) @ geometry.T_parent_joint @ joint_frame
        in_parent[0] = np.eye(4)
        self.T_parent_joint: Array = in_parent
        self.T_joint_link: Array = np.linalg.inv(joint_frame) @ geometry.T_joint_link
        self.is_prismatic = [bool(p) for p in geometry.prismatic]

        is_ancestor = np.eye(count)
        for body in range(1, count):
            is_ancestor[body] += is_ancestor[self.parents[body]]
        is_ancestor[:, 0] = 0.0
        moving = np.arange(count) > 0
        for name, value in {
            "rotation": in_parent[:, :3, :3].transpose(1, 2, 0)[..., None],
            "offset": in_parent[:, :3, 3].T[..., None],
            "link_rotation": self.T_joint_link[:, :3, :3].transpose(1, 2, 0)[..., None],
            "link_offset": self.T_joint_link[:, :3, 3].T[..., None],
            "revolute": (moving & ~geometry.prismatic)[:, None],
            "prismatic": (moving & geometry.prismatic)[:, None],
            "ancestors": is_ancestor,
            "joint_map": robot.joint_map[0],
            "joint_constant": robot.joint_map[1],
        }.items():
            self.register_buffer(name, torch.tensor(np.ascontiguousarray(value), dtype=torch.float64), persistent=False)
        self._order_levels()

        self.base_rows = robot.base_rows
        self.subtree_end = [body + int(is_ancestor[:, body].sum()) for body in range(count)]
        self.subtree_end[0] = count

    def _order_levels(self) -> None:
        """Bodies by depth; `levels` holds, per depth, the bodies and their parents' places one level up."""
        depth = [0] * len(self.parents)
        for body, parent in enumerate(self.parents[1:], start=1):
            depth[body] = depth[parent] + 1
        by_depth = [[b for b, d in enumerate(depth) if d == level] for level in range(max(depth) + 1)]
        self.levels = [
            (bodies, [above.index(self.parents[body]) for body in bodies])
            for above, bodies in zip(by_depth, by_depth[1:], strict=False)
        ]
        order = [body for bodies in by_depth for body in bodies]
        self.depth_first = [order.index(body) for body in range(len(order))]

    @property
    def bodies(self) -> int:
        """Number L of bodies."""
        return len(self.parents)

    def path(self, body: int) -> list[int]:
        """Bodies whose joints move `body`, from the base outward, itself included, the base not."""
        path: list[int] = []
        while body > 0:
            path.insert(0, body)
            body = self.parents[body]
        return path


def _rotation_to_z(axis: Array) -> Array:
    """A rotation whose third column is `axis`."""
    return np.eye(3) if axis[2] == 1.0 else Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
