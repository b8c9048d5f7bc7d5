"""Constants of the kinematic tree: a node per body, and five massless ones per weld with a force/torque sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from torchid.errors import InputError, join_names
from torchid.parameters import Array
from torchid.robot import Robot

_SAME = 1e-6  # [m], or of a unit vector: the same robot has the same constants to rounding, averaged states included


@dataclass(frozen=True)
class Node:
    """A frame that a joint moves.

    `kind`: "base", "revolute", "prismatic", "welded" (the body beyond a force/torque sensor) or "massless" (a node
    before it). `body`: of the robot; None if massless. `position_map`, (n + 6 F,), and `offset`: the position is
    `position_map @ dofs + offset`, with the robot's degrees of freedom. Poses as in `JointGeometry`.
    """

    kind: str
    body: int | None
    parent: int
    axis: Array
    slides: bool
    T_parent_joint: Array
    T_joint_link: Array
    position_map: Array
    offset: float


def tree_nodes(robot: Robot) -> list[Node]:
    """All nodes, depth first."""
    geometry = robot.geometry
    (matrix, constant) = robot.joint_map
    dofs = np.eye(robot.n_dofs)
    nodes = list[Node]()
    node_of = list[int]()
    for index, body in enumerate(robot.bodies):
        parent = node_of[body.parent] if index else -1
        T_parent_joint = geometry.T_parent_joint[index]
        T_joint_link = geometry.T_joint_link[index]
        if body.joint is not None and geometry.welded[index]:
            first = robot.dof_names.index(f"{body.joint.name}.fx")
            sign = geometry.axis[index, 2]
            for k in range(6):
                last = k == 5
                nodes.append(
                    Node(
                        kind="welded" if last else "massless",
                        body=index if last else None,
                        parent=len(nodes) - 1 if k else parent,
                        axis=sign * np.eye(3)[k % 3],
                        slides=k < 3,
                        T_parent_joint=np.eye(4) if k else T_parent_joint,
                        T_joint_link=T_joint_link if last else np.eye(4),
                        position_map=dofs[first + k],
                        offset=0.0,
                    )
                )
        else:
            slides = bool(geometry.prismatic[index])
            kind = "base" if not index else "prismatic" if slides else "revolute"
            position_map = np.pad(matrix[index - 1], (0, robot.n_dofs - robot.n)) if index else np.zeros(robot.n_dofs)
            offset = float(constant[index - 1]) if index else 0.0
            axis = geometry.axis[index]
            nodes.append(Node(kind, index, parent, axis, slides, T_parent_joint, T_joint_link, position_map, offset))
        node_of.append(len(nodes) - 1)
    return nodes


class KinematicTree(nn.Module):
    """Constant tensors of a robot, batch-last: a trailing axis of length 1 broadcasts over samples.

    Attributes (buffers, so `.to()` moves and casts them):
        pose: (3, 4, L, 1), rotation and offset [m] of every joint frame at position 0 in its parent's joint frame,
            nodes sorted by depth (`by_depth`). L counts nodes here.
        link_rotation, (3, 3, L, 1), and link_offset, (3, L, 1): the node's link frame in its joint frame.
        revolute, prismatic: (L, 1) of 0 and 1.
        parent: (L,), index of the parent node, 0 for the base.
        ancestors: (L, L), 1 where column j's joint moves node i.
        joint_map, (L, n + 6 F), joint_constant: positions of the base (0) and all L - 1 joints from the robot's degrees
            of freedom, of which the first n move.

    `n_nodes`: one for each body, and five more for every force/torque sensor in a limb. `sign_width`: as in
    `Regressor`. `stribeck`: Stribeck velocity [rad/s or m/s], None without such friction. `node_of`: node of each of
    the robot's bodies. `body_of`: body of each node; for a massless node the body beyond the weld. `depth_first`: place
    of each node among those sorted by depth. `has_link_offsets`: whether any `link_offset` is not 0.
    """

    pose: Tensor
    by_depth: Tensor
    link_rotation: Tensor
    link_offset: Tensor
    revolute: Tensor
    prismatic: Tensor
    parent: Tensor
    ancestors: Tensor
    joint_map: Tensor
    joint_constant: Tensor
    parent_in_level: Tensor

    def __init__(self, robot: Robot, sign_width: float | None = None, stribeck: float | None = None) -> None:
        super().__init__()
        if not isinstance(robot, Robot):
            raise TypeError(f"robot: found {type(robot).__name__}; accepted: a Robot from torchid.load_robot")
        self.sign_width = sign_width
        self.stribeck = stribeck
        self._indices: dict[tuple[int, ...], Tensor] = {}
        self._path_maps: dict[tuple[int, ...], tuple[slice | Tensor, Tensor | None]] = {}
        nodes = tree_nodes(robot)
        self._nodes = nodes
        self._body_names = robot.body_names
        self.node_of = [index for index, node in enumerate(nodes) if node.body is not None]
        self.body_of = np.searchsorted(self.node_of, np.arange(len(nodes))).tolist()
        self.parents = [node.parent for node in nodes]
        self.slides = [node.slides for node in nodes]
        self.kinds = [node.kind for node in nodes]
        self.base_rows = robot.base_rows
        self.n = robot.n
        self.n_dofs = robot.n_dofs
        self.n_rows = robot.n_rows
        count = self.n_nodes = len(nodes)
        joint_frame = np.tile(np.eye(4), (count, 1, 1))
        for index, node in enumerate(nodes[1:], start=1):
            joint_frame[index, :3, :3] = _rotation_to_z(*node.axis.tolist())
        T_parent_joint: Array = np.stack([node.T_parent_joint for node in nodes])
        in_parent: Array = np.asarray(np.linalg.inv(joint_frame[self.parents]) @ T_parent_joint @ joint_frame, float)
        in_parent[0] = np.eye(4)
        self.T_parent_joint: Array = in_parent
        T_joint_link = np.stack([node.T_joint_link for node in nodes])
        self.T_joint_link: Array = np.asarray(np.linalg.inv(joint_frame) @ T_joint_link)
        self.has_link_offsets = bool(self.T_joint_link[:, :3, 3].any())

        is_ancestor = np.eye(count)
        depth = np.zeros(count, dtype=int)
        for body in range(1, count):
            is_ancestor[body] += is_ancestor[self.parents[body]]
            depth[body] = depth[self.parents[body]] + 1
        self.subtree_end = [body + int(is_ancestor[:, body].sum()) for body in range(count)]
        is_ancestor[:, 0] = 0.0
        by_depth = np.argsort(depth, kind="stable")
        position = np.argsort(by_depth)
        self.level_sizes = np.bincount(depth).tolist()
        self.depth_first = position.tolist()

        moving = np.arange(count) > 0
        self._register("pose", in_parent[by_depth, :3].transpose(1, 2, 0)[..., None])
        self._register("link_rotation", self.T_joint_link[:, :3, :3].transpose(1, 2, 0)[..., None])
        self._register("link_offset", self.T_joint_link[:, :3, 3].T[..., None])
        self._register("revolute", (moving & ~np.array(self.slides))[:, None])
        self._register("prismatic", np.array(self.slides)[:, None])
        self._register("ancestors", is_ancestor)
        self._position_maps: list[list[float]] = [node.position_map.tolist() for node in nodes]
        self._register("joint_map", np.array(self._position_maps))
        self._register("joint_constant", np.array([node.offset for node in nodes])[:, None])
        parent = np.maximum(self.parents, 0)
        level_start = np.repeat(np.cumsum([0, 0, *self.level_sizes[:-1]])[:-1], self.level_sizes)
        self._register("parent", parent)
        self._register("by_depth", by_depth)
        self._register("parent_in_level", position[parent[by_depth]] - level_start)

    def extra_repr(self) -> str:
        """What `repr` says."""
        return f"{len(self.node_of)} bodies, {self.n} joints, {self.n_rows} rows of K"

    def _register(self, name: str, value: np.ndarray) -> None:
        dtype = torch.int64 if value.dtype.kind == "i" else torch.float64
        self.register_buffer(name, torch.tensor(np.ascontiguousarray(value), dtype=dtype), persistent=False)

    def get_extra_state(self) -> Tensor:
        """Robot constants for a `state_dict`, (L, 31 + n + 6 F) float64: all that the regressor depends on."""
        rows = []
        for node in self._nodes:
            kind = [node.parent, node.slides, self.base_rows, node.offset]
            poses = np.concatenate([node.T_parent_joint[:3], node.T_joint_link[:3]])
            rows.append(np.concatenate([kind, node.axis, poses.ravel(), node.position_map]))
        return torch.tensor(np.array(rows), dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Raise InputError if the `state_dict` belongs to another robot."""
        expected = self.get_extra_state()
        if state.shape != expected.shape:
            sizes = [
                f"{len(x)} frames and {x.shape[1] - expected.shape[1] + self.n_dofs} joints" for x in (state, expected)
            ]
            reason = f"another robot, with {' instead of '.join(sizes)}"
        elif differs := ((state.to(expected) - expected).abs().amax(dim=1) > _SAME).nonzero()[:, 0].tolist():
            bodies = dict.fromkeys(self._body_names[self.body_of[node]] for node in differs)
            reason = f"another robot: {join_names(list(bodies))} differ"
        else:
            return
        raise InputError("load_state_dict", "robot", reason, "the state of a module of the same robot")

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> KinematicTree:
        self._indices.clear()
        self._path_maps.clear()
        super()._apply(fn, recurse)
        return self

    def index(self, numbers: Iterable[int]) -> Tensor:
        """Numbers as an index on the module's device, (len,) int64, cached to avoid repeated copies to a GPU."""
        key = tuple(numbers)
        if key not in self._indices:
            with torch.inference_mode(False):  # others may come back to it with gradients
                self._indices[key] = torch.tensor(key, dtype=torch.int64, device=self.ancestors.device)
        return self._indices[key]

    def path_map(self, body: int, joints: Sequence[int]) -> tuple[slice | Tensor, Tensor | None]:
        """Nodes whose joints move a node, and the ratios of their motion to independent joints', made once.

        Returns:
            (nodes, ratios): an index, from the base outward, and (joints, nodes); None if they are one joint each.
        """
        key = (body, *joints)
        if key not in self._path_maps:
            path = self.path(body)
            ratios = [[self._position_maps[node][joint] for node in path] for joint in joints]
            one_each = [[float(node == other) for other in range(len(path))] for node in range(len(path))]
            follow = bool(path) and path == list(range(path[0], body + 1))
            with torch.inference_mode(False):
                self._path_maps[key] = (
                    slice(path[0], body + 1) if follow else self.index(path),
                    None if ratios == one_each else self.joint_map[self.index(path)][:, self.index(joints)].T,
                )
        return self._path_maps[key]

    def coulomb_sign(self, velocity: Tensor) -> Tensor:
        """Factor (...) of Coulomb friction at velocities (...) [rad/s or m/s]: sign, or tanh with a width."""
        return torch.sign(velocity) if self.sign_width is None else torch.tanh(velocity / self.sign_width)

    def stribeck_share(self, velocity: Tensor) -> Tensor:
        """Factor (...) of Stribeck friction at velocities (...) [rad/s or m/s]."""
        return self.coulomb_sign(velocity) * torch.exp(-((velocity / (self.stribeck or torch.inf)) ** 2))

    def frame(self, robot: Robot, link: str, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[int, Array]:
        """Node that carries a URDF link of the robot, and the link's pose, (4, 4) [m], in the node's joint frame.

        `origin`: (3,) [m], a point of the link that counts as its origin.

        Raises:
            UnknownNameError: the URDF has no such link.
        """
        body, T_body_link = robot.link(link)
        node = self.node_of[body]
        T = self.T_joint_link[node] @ T_body_link
        T[:3, 3] += T[:3, :3] @ np.array(origin)
        return node, T

    def path(self, body: int) -> list[int]:
        """Nodes whose joints move node `body`, from the base outward, including itself, without the base."""
        path: list[int] = []
        while body > 0:
            path.insert(0, body)
            body = self.parents[body]
        return path


@lru_cache  # a few axes take half of the time of a tree
def _rotation_to_z(x: float, y: float, z: float) -> Array:
    """A rotation whose third column is an axis."""
    return np.eye(3) if z == 1.0 else Rotation.align_vectors([[x, y, z]], [[0.0, 0.0, 1.0]])[0].as_matrix()
