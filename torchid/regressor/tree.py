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
        pose: (3, 4, L, 1), rotation and offset [m] of every joint frame at position 0 in its parent's joint frame,
            bodies sorted by depth (`by_depth`; `depth_first` sorts back).
        link_rotation, (3, 3, L, 1), and link_offset, (3, L, 1): the body's link frame in its joint frame.
        revolute, prismatic: (L, 1) of 0 and 1.
        parent: (L,), index of the parent body, 0 for the base.
        ancestors: (L, L), 1 where column j's joint moves body i.
        joint_map, joint_constant: positions of the base (0) and all L - 1 joints from the n independent ones.
    """

    pose: Tensor
    by_depth: Tensor
    depth_first: Tensor
    link_rotation: Tensor
    link_offset: Tensor
    revolute: Tensor
    prismatic: Tensor
    parent: Tensor
    ancestors: Tensor
    joint_map: Tensor
    joint_constant: Tensor
    place_above: Tensor

    def __init__(self, robot: Robot) -> None:
        super().__init__()
        geometry = robot.geometry
        self.parents = [body.parent for body in robot.bodies]
        self.is_prismatic = [bool(p) for p in geometry.prismatic]
        self.base_rows = robot.base_rows
        count = len(self.parents)
        joint_frame = np.tile(np.eye(4), (count, 1, 1))
        for body in range(1, count):
            joint_frame[body, :3, :3] = _rotation_to_z(geometry.axis[body])
        in_parent = np.linalg.inv(joint_frame[self.parents]) @ geometry.T_parent_joint @ joint_frame
        in_parent[0] = np.eye(4)
        self.T_parent_joint: Array = in_parent
        self.T_joint_link: Array = np.linalg.inv(joint_frame) @ geometry.T_joint_link

        is_ancestor = np.eye(count)
        depth = np.zeros(count, dtype=int)
        for body in range(1, count):
            is_ancestor[body] += is_ancestor[self.parents[body]]
            depth[body] = depth[self.parents[body]] + 1
        self.subtree_end = [body + int(is_ancestor[:, body].sum()) for body in range(count)]
        is_ancestor[:, 0] = 0.0
        by_depth = np.argsort(depth, kind="stable")
        place = np.argsort(by_depth)
        self.level_sizes = np.bincount(depth).tolist()

        moving = np.arange(count) > 0
        matrix, constant = robot.joint_map
        self._register("pose", in_parent[by_depth, :3].transpose(1, 2, 0)[..., None])
        self._register("link_rotation", self.T_joint_link[:, :3, :3].transpose(1, 2, 0)[..., None])
        self._register("link_offset", self.T_joint_link[:, :3, 3].T[..., None])
        self._register("revolute", (moving & ~geometry.prismatic)[:, None])
        self._register("prismatic", (moving & geometry.prismatic)[:, None])
        self._register("ancestors", is_ancestor)
        self._register("joint_map", np.vstack([np.zeros(robot.n), matrix]))
        self._register("joint_constant", np.append(0.0, constant)[:, None])
        parent = np.maximum(self.parents, 0)
        level_start = np.repeat(np.cumsum([0, 0, *self.level_sizes[:-1]])[:-1], self.level_sizes)
        self._register("parent", parent)
        self._register("by_depth", by_depth)
        self._register("depth_first", place)
        self._register("place_above", place[parent[by_depth]] - level_start)

    def _register(self, name: str, value: np.ndarray) -> None:
        dtype = torch.int64 if value.dtype.kind == "i" else torch.float64
        self.register_buffer(name, torch.tensor(np.ascontiguousarray(value), dtype=dtype), persistent=False)

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
