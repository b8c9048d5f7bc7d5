"""Closed loops: the gaps between their frames, and the generalized forces of loop forces, batch-last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor, nn

from torchid.parameters import Array
from torchid.regressor.kinematics import (
    BodyStates,
    Motion,
    along_frame,
    body_states,
    frame_acceleration,
    independent_positions,
    joint_motion,
    joint_screw_axes,
    states_at_rest,
)
from torchid.regressor.regressor import wrench_transform, wrenches_at_base
from torchid.regressor.tree import KinematicTree
from torchid.robot import Loop, Robot
from torchid.rounding import KINEMATIC_TOLERANCE, is_significant

_POSTURES = 16  # random ones, to find the constant directions that do no work
_LARGEST = 1.5  # rad or m, of their joint positions
_CLOSED = 1e-12  # m or rad: a gap that is rounding
_STANDS = 1e-10  # rad or m: after a smaller step, the next of Gauss-Newton is rounding
# of Gauss-Newton, and of a joint in one of them [rad or m]
_MOST_STEPS = 100
_LARGEST_STEP = 0.3
_DAMPING = 1e-10  # of squares of a loop Jacobian's singular values, as a share of their sum


@dataclass(frozen=True)
class LoopGeometry:
    """Where a loop closes in a tree.

    Attributes:
        loop: its frames and type.
        nodes: that carry both frames.
        poses: of the frames, (4, 4) [m], in the nodes' joint frames.
        moving: nodes whose joints move one of the two alone, with 1 where it is the first and -1 where the other.
    """

    loop: Loop
    nodes: tuple[int, int]
    poses: tuple[Array, Array]
    moving: tuple[tuple[int, float], ...]

    @classmethod
    def of(cls, loop: Loop, robot: Robot, tree: KinematicTree) -> LoopGeometry:
        """The geometry of a loop in a robot's tree."""
        (first, T_one), (second, T_other) = (tree.frame(robot, frame) for frame in loop.frames)
        paths = [set(tree.path(node)) for node in (first, second)]
        apart = sorted(paths[0] ^ paths[1])
        return cls(loop, (first, second), (T_one, T_other), tuple((x, 1.0 if x in paths[0] else -1.0) for x in apart))

    @cached_property
    def unit_wrenches(self) -> Array:
        """Unit wrenches, (k, 6), that the first body takes, in its node's joint frame, along the frame's axes."""
        return wrench_transform(self.poses[0]).T[list(self.loop.components)]

    def dofs(self, tree: KinematicTree) -> list[int]:
        """Degrees of freedom between both frames: joints, and those of force/torque sensors in limbs."""
        moved = tree.joint_map[[node for node, _ in self.moving]]
        out: list[int] = torch.nonzero((moved != 0.0).any(0))[:, 0].tolist()
        return out

    def forces(self, tree: KinematicTree, screw_axes: Tensor, wrenches: Tensor, dofs: Sequence[int]) -> Tensor:
        """Torques of wrenches on the first body and their opposite, at the same point, on the other; none on the base.

        Args:
            tree: the robot's constants.
            screw_axes: from `joint_screw_axes`, (6, L, B).
            wrenches: at the base origin, (6, k, B) [N, N m].
            dofs: degrees of freedom to give columns for.

        Returns:
            (k, len(dofs), B) [N m or N].
        """
        nodes, signs = zip(*self.moving, strict=True)
        index = tree.index(nodes)
        at = tree.index(dofs)
        signed = tree.joint_map[index][:, at] * tree.joint_map.new_tensor(signs)[:, None]
        screws = signed.T @ screw_axes[:, index]
        return (wrenches[:, :, None] * screws[:, None]).sum(0)

    def jacobian(self, tree: KinematicTree, states: BodyStates, dofs: Sequence[int]) -> Tensor:
        """Rows of the unit wrenches, (k, len(dofs), B)."""
        at_base = wrenches_at_base(states, self.nodes[0], states.position.new_tensor(self.unit_wrenches))
        return self.forces(tree, joint_screw_axes(tree, states), at_base, dofs)

    def deviation(self, rotation: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Offset (3, B) [m] and rotation (3, 3, B) of the second frame from the first, along its axes.

        Args:
            rotation: of the joint frames, (3, 3, L, B).
            position: of their origins, (3, L, B) [m].
        """
        (R, p), (R_other, p_other) = (
            _frame(rotation, position, *at) for at in zip(self.nodes, self.poses, strict=True)
        )
        return ((p_other - p)[:, None] * R).sum(0), (R[:, :, None] * R_other[:, None]).sum(0)


def _frame(rotation: Tensor, position: Tensor, node: int, pose: Array) -> tuple[Tensor, Tensor]:
    """Rotation (3, 3, B) and position (3, B) of a frame on a node."""
    T = rotation.new_tensor(pose)
    R = rotation[:, :, node]
    origin = position[:, node] + (R * T[:3, 3, None]).sum(1)
    return (R[:, :, None] * T[None, :3, :3, None]).sum(1), origin


def _rotation_angle(R: Tensor) -> Tensor:
    """Angles (B,) [rad], from 0 to pi, of rotations (3, 3, B)."""
    return torch.atan2(torch.linalg.vector_norm(_sines(R), dim=0), 0.5 * (R.diagonal().sum(-1) - 1.0))


def _rotation_vector(R: Tensor) -> Tensor:
    """Rotation vectors (3, B) [rad] of rotations (3, 3, B) by less than half a turn."""
    sine = _sines(R)
    size = torch.linalg.vector_norm(sine, dim=0)
    tiny = torch.finfo(R.dtype).tiny
    return sine * torch.where(size > 0.0, _rotation_angle(R) / size.clamp_min(tiny), 1.0)


def _damped(matrix: Tensor) -> Tensor:
    """Products (B, k, k) of Jacobians with a little added to the diagonal, as redundant rows make them singular."""
    unit = torch.eye(matrix.shape[1], dtype=matrix.dtype)
    return matrix + _DAMPING * matrix.diagonal(dim1=1, dim2=2).sum(1)[:, None, None] * unit


def _sines(R: Tensor) -> Tensor:
    return 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


class LoopClosures:
    """The loops of a robot at joint positions.

    `geometries`: one for each loop. `dofs`: degrees of freedom that they depend on.
    """

    def __init__(self, robot: Robot) -> None:
        self.tree = KinematicTree(robot)
        self.geometries = [LoopGeometry.of(loop, robot, self.tree) for loop in robot.loops]
        self.dofs = sorted({dof for loop in self.geometries for dof in loop.dofs(self.tree)})

    def gaps(self, joint_position: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Distance [m] and angle [rad] of each loop's frames, (B,) each, at joint positions (B, n).

        The angle of a point is 0.
        """
        poses = self._poses(joint_position)
        out = []
        for loop in self.geometries:
            offset, turned = loop.deviation(*poses)
            angle = _rotation_angle(turned) if loop.loop.kind == "weld" else torch.zeros_like(offset[0])
            out.append((torch.linalg.vector_norm(offset, dim=0), angle))
        return out

    def deviations(self, joint_position: Tensor) -> Tensor:
        """Deviations of all loops that `jacobian` has rows for, (B, k) [m, rad], at joint positions (B, n)."""
        poses = self._poses(joint_position)
        rows = []
        for loop in self.geometries:
            offset, turned = loop.deviation(*poses)
            rows += [offset] if loop.loop.kind == "point" else [offset, _rotation_vector(turned)]
        return torch.cat(rows).T

    def jacobian(self, joint_position: Tensor) -> Tensor:
        """Velocities of all loops' first frames relative to the second, by velocities, (B, k, n + 6 F).

        Along the first frame's axes; where the loops are closed, minus the derivative of the deviations.
        """
        states = states_at_rest(self.tree, joint_position)
        none = states.position.new_zeros(0, self.tree.n_dofs, len(joint_position))
        rows = (loop.jacobian(self.tree, states, range(self.tree.n_dofs)) for loop in self.geometries)
        return torch.cat([none, *rows]).permute(2, 0, 1)

    def effective_wrenches(self, number: int, dofs: Sequence[int]) -> Array:
        """Unit wrenches of a loop on its first body, (k, 6), without those that never do work on measured joints.

        What a four-bar's pins exert across its plane moves nothing. Such directions are told by the loop's Jacobian at
        random positions, closed or not: singular values below `KINEMATIC_TOLERANCE` of the largest. What is redundant
        at single samples beyond these is left to the null space of each.

        Args:
            number: of the loop.
            dofs: degrees of freedom that are measured.
        """
        loop = self.geometries[number]
        n = self.tree.n
        generator = torch.Generator().manual_seed(0)
        q = _LARGEST * (2.0 * torch.rand(_POSTURES, n, generator=generator, dtype=torch.float64) - 1.0)
        work = loop.jacobian(self.tree, states_at_rest(self.tree, q), dofs).flatten(1).numpy()  # (k, dofs x postures)
        U, values, _ = np.linalg.svd(work, full_matrices=False)
        kept: Array = U[:, is_significant(values, KINEMATIC_TOLERANCE)].T @ loop.unit_wrenches
        return kept

    def closed(self, joint_position: Tensor) -> tuple[Tensor, Tensor]:
        """Where loops are closed near joint positions (B, n) [rad or m], by Gauss-Newton steps of least norm.

        Returns:
            Positions (B, n), and whether the loops are closed there, (B,) bool; others may be anywhere.
        """
        q = joint_position.clone()
        for _ in range(_MOST_STEPS):
            gap = self.deviations(q)
            if bool((gap.abs().amax(1) < _CLOSED).all()):
                break
            J = self.jacobian(q)[:, :, : self.tree.n]
            step = (J.mT @ torch.linalg.solve(_damped(J @ J.mT), gap[..., None]))[..., 0]
            size = step.abs().amax(1, keepdim=True)
            q += step * (_LARGEST_STEP / size.clamp_min(_LARGEST_STEP))
        return q, self.deviations(q).abs().amax(1) < _CLOSED

    def fitted(self, joint_position: Tensor, free: Sequence[int]) -> Tensor:
        """Positions (B, n) of which some joints move to where the loops are least open, by Gauss-Newton steps."""
        q = joint_position.clone()
        moving = list(free)
        for _ in range(_MOST_STEPS):
            J = self.jacobian(q)[:, :, moving]
            gap = self.deviations(q)
            step = torch.linalg.solve(_damped(J.mT @ J), J.mT @ gap[..., None])[..., 0]
            size = step.abs().amax(1, keepdim=True)
            q[:, moving] += step * (_LARGEST_STEP / size.clamp_min(_LARGEST_STEP))
            if bool((size < _STANDS).all()):
                break
        return q

    def drift(self, joint_position: Tensor, joint_velocity: Tensor) -> Tensor:
        """dJ/dt v of `jacobian`, (B, k), at positions of closed loops and velocities (B, n) that keep them closed."""
        zero = torch.zeros_like(joint_position)
        still = zero.new_zeros(len(zero), 3)
        motion = Motion(joint_position, joint_velocity, zero, still, still, still)
        rows = []
        states = body_states(self.tree, motion, joint_motion(self.tree, motion))
        for loop in self.geometries:
            poses = [zero.new_tensor(pose) for pose in loop.poses]
            first, second = (frame_acceleration(states, *at) for at in zip(loop.nodes, poses, strict=True))
            rows.append(along_frame(states, loop.nodes[0], poses[0], first - second)[list(loop.loop.components)])
        return torch.cat(rows).T

    def _poses(self, joint_position: Tensor) -> tuple[Tensor, Tensor]:
        states = states_at_rest(self.tree, joint_position)
        return states.rotation, states.position


class LoopJacobian(nn.Module):
    """Jacobian of a robot's closed loops: `J(q) v` is the twist of each loop's first frame relative to its second.

    The twist is taken at the first frame's origin, along its axes: three rows for a point, six for a weld. Loop forces
    enter the dynamics as `J^T f`, like unmeasured contacts that are always active: append the rows to J_C for
    `torchid.Projection`. The columns of the base are 0, because internal forces do not move the base.
    """

    def __init__(self, robot: Robot) -> None:
        """Build the constants.

        Args:
            robot: with its loops; without loops J has no rows.
        """
        super().__init__()
        self.closures = LoopClosures(robot)
        self.tree = self.closures.tree

    def forward(self, q: Tensor) -> Tensor:
        """Compute the Jacobian, (B, k, n_rows), at `q`, (B, n + 7), or (B, n) for a fixed base (see `Regressor`).

        Raises:
            TypeError: `q` is not a tensor, or has another dtype or device than the module.
            ValueError: the shape of `q` is wrong.
        """
        joint_position = independent_positions(self.tree, q)
        return nn.functional.pad(self.closures.jacobian(joint_position), (self.tree.base_rows, 0))
