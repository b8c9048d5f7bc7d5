"""Wrenches on bodies and forces of closed loops in the rows: of unmeasured directions, and as generalized forces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchid.parameters import Array
from torchid.problem.chunk_dynamics import ChunkKinematics
from torchid.problem.samples import Samples
from torchid.regressor.loops import LoopClosures, LoopGeometry
from torchid.regressor.regressor import forces_at_base, wrenches_at_base
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


class LineOfAction(NamedTuple):
    """What of forces on a body changes from sample to sample.

    `rolling`: contact whose `rolling_arms` they have, so that they act where it touches the ground. `ground`: contact
    whose `ground_axes` they are along, in its frame's origin; their rows are (k, 3), by these axes.
    """

    rolling: int | None = None
    ground: int | None = None


@dataclass(frozen=True)
class WrenchRows:
    """Wrenches, (k, 6), at a body's joint frame, in its axes.

    `line_of_action`: where and along which axes their forces act, if that is not fixed to the body.
    """

    rows: Tensor
    line_of_action: LineOfAction


def wrenches_at_ground(
    parts: Sequence[WrenchRows], count: int, kinematics: ChunkKinematics, body: int, origin: Callable[[int], Tensor]
) -> Tensor:
    """Wrenches on a body at the base origin in base axes, (6, count, B); of more, a basis of what they span.

    Where they span less at some sample, the basis has directions too many: it costs equations, but lets no
    unmeasured force in.

    Args:
        parts: of the rows.
        count: of the wrenches.
        kinematics: of B samples.
        body: that the wrenches act on.
        origin: of a contact frame in the node's joint frame, (3,) [m].
    """
    rows, states = [], kinematics.states
    for part in parts:
        rolling, ground = part.line_of_action
        arms = None if rolling is None else kinematics.arms[rolling]
        if ground is None:
            rows.append(wrenches_at_base(states, body, part.rows, arms))
        else:
            forces = part.rows @ kinematics.ground_axes[ground]
            rows.append(forces_at_base(states, body, origin(ground), forces, arms))
    at_base = rows[0] if len(rows) == 1 else torch.cat(rows, dim=1)
    if at_base.shape[1] == count:
        return at_base
    Vh: Tensor = torch.linalg.svd(at_base.permute(2, 1, 0), full_matrices=False).Vh
    return Vh[:, :count].permute(2, 1, 0)


@dataclass(frozen=True)
class FramePoses:
    """Poses of a contact's frame in the world, or in a fixed base of which no pose was recorded.

    `rotation`: (B, 3, 3), frame to world. `origin`: (B, 3) [m]; None for wrenches that are about it already.
    """

    rotation: Tensor
    origin: Tensor | None

    @classmethod
    def of(cls, samples: Samples, kinematics: ChunkKinematics, body: int, axes: Tensor, origin: Tensor) -> FramePoses:
        """Those of a frame with such axes, (3, 3), and origin, (3,) [m], in the joint frame of a body."""
        R_world_base, position = kinematics.rotation_world_base, samples.base.position
        rotation = kinematics.states.rotation[:, :, body].permute(2, 0, 1)
        arm = None if position is None else kinematics.states.position[:, body].T + rotation @ origin
        rotation = rotation @ axes
        if R_world_base is not None:
            rotation = R_world_base @ rotation
            arm = None if arm is None else (R_world_base @ arm[..., None])[..., 0]
        return cls(rotation, None if arm is None or position is None else position + arm)

    def in_frame(self, wrench: Tensor) -> Tensor:
        """Wrenches as recorded, (B, 6) [N, N m], at the frame's origin along its axes."""
        force, moment = wrench.unflatten(1, (2, 3)).unbind(1)
        if self.origin is not None:
            moment = moment - torch.linalg.cross(self.origin, force)
        return (self.rotation.mT @ torch.stack([force, moment], dim=2)).mT.flatten(1)

    def of_unit(self, axis: int) -> Tensor:
        """What a recorded component of 1 is there, (B, 6)."""
        unit = self.rotation.new_zeros(len(self.rotation), 6)
        unit[:, axis] = 1.0
        return self.in_frame(unit)

    def reached(self, axis: int) -> range:
        """Components there to which a recorded one adds."""
        first, last = (0, 3) if axis < 3 else (3, 6)
        return range(first, last if self.origin is None else 6)


@dataclass(frozen=True)
class LoopRows:
    """What a loop exerts.

    `wrenches`, (k, 6): on its first body, at the node's joint frame, without directions that never do work. `joints`:
    measured ones on which they do, by their place among the coupled joints; `dofs`: by their number.
    """

    geometry: LoopGeometry
    wrenches: Tensor
    joints: tuple[int, ...]
    dofs: tuple[int, ...]

    def forces(self, tree: KinematicTree, kinematics: ChunkKinematics) -> Tensor:
        """Torques of a unit of each on its joints, (k, joints, B)."""
        at_base = wrenches_at_base(kinematics.states, self.geometry.nodes[0], self.wrenches)
        return self.geometry.forces(tree, kinematics.screw_axes, at_base, self.dofs)


class LoopLayouts:
    """The loops of a robot; `dofs`: degrees of freedom that some of them depends on."""

    def __init__(self, robot: Robot) -> None:
        self._closures = LoopClosures(robot) if robot.loops else None
        self.dofs = frozenset() if self._closures is None else frozenset(self._closures.dofs)
        self._wrenches: dict[tuple[int, tuple[int, ...]], Array] = {}

    def rows(self, coupled: Sequence[int], like: Tensor) -> Iterator[LoopRows]:
        """Rows of each loop that does work on a measured joint.

        Args:
            coupled: measured joints whose rows the projection combines.
            like: a tensor of the rows' type.
        """
        closures = self._closures
        if closures is None:
            return
        for number, loop in enumerate(closures.geometries):
            own = set(loop.dofs(closures.tree))
            joints = tuple(index for index, joint in enumerate(coupled) if joint in own)
            dofs = tuple(coupled[index] for index in joints)
            if (number, dofs) not in self._wrenches:
                self._wrenches[number, dofs] = closures.effective_wrenches(number, dofs)
            if len(wrenches := self._wrenches[number, dofs]):
                yield LoopRows(loop, torch.tensor(wrenches, dtype=like.dtype, device=like.device), joints, dofs)


_DETERMINED = 1e-6  # share of a Jacobian's size: a motor moves the passive joints if no more of its column is left


@dataclass(frozen=True)
class _Group:
    """Loops that share joints, with their degrees of freedom: those of passive joints, and others."""

    loops: tuple[LoopGeometry, ...]
    passive: tuple[int, ...]
    driven: tuple[int, ...]


class MotorForces:
    """Rows of generalized forces as the motors of closed loops feel them.

    With the loops' Jacobian J = [J_a, J_p] by motors and passive joints, a motor's motion moves the passive joints by
    G = -J_p^+ J_a. Of generalized forces f, what goes through the loops drops out of f_a + G^T f_p: the principle of
    virtual work. `none`: the robot has no loops, and rows stay as they are.
    """

    def __init__(self, robot: Robot) -> None:
        self.none = not robot.loops
        self._base, self._groups = robot.base_rows, list[_Group]()
        if self.none:
            return
        closures = LoopClosures(robot)
        dofs = [set(loop.dofs(closures.tree)) for loop in closures.geometries]
        linked = np.array([[bool(one & other) for other in dofs] for one in dofs])
        _, label = connected_components(linked, directed=False)
        for group in range(label.max() + 1):
            members = np.flatnonzero(label == group).tolist()
            own = sorted(set[int]().union(*(dofs[k] for k in members)))
            passive = tuple(dof for dof in own if robot.is_passive[dof])
            driven = tuple(dof for dof in own if not robot.is_passive[dof])
            self._groups.append(_Group(tuple(closures.geometries[k] for k in members), passive, driven))

    @property
    def passive(self) -> tuple[int, ...]:
        """Joints without a motor in loops."""
        return tuple(dof for group in self._groups for dof in group.passive)

    def above(self, dofs: Iterable[int]) -> set[int]:
        """Degrees of freedom with those of all loops that some of them are in, but for passive joints in these."""
        own, out = set(dofs), set(dofs)
        for group in self._groups:
            if own & {*group.passive, *group.driven}:
                out = (out | set(group.driven)) - set(group.passive)
        return out

    def of(self, tree: KinematicTree, kinematics: ChunkKinematics, forces: Tensor) -> Tensor:
        """Generalized forces (..., B, n_rows) with those of motors in loops; NaN at passive joints in them.

        Also NaN where motors do not determine how the passive joints move.

        Args:
            tree: the robot's constants.
            kinematics: of the samples.
            forces: rows as in K.
        """
        if self.none:
            return forces
        out = forces.clone()
        for group in self._groups:
            motion, determined = _passive_motion(tree, kinematics, group)  # (B, p, a), (B, a)
            driven, passive = (tree.index(self._base + k for k in x) for x in (group.driven, group.passive))
            through = (forces[..., passive][..., None, :] @ motion)[..., 0, :]
            out[..., driven] = torch.where(determined, forces[..., driven] + through, torch.nan)
            out[..., passive] = torch.nan
        return out


def _passive_motion(tree: KinematicTree, kinematics: ChunkKinematics, group: _Group) -> tuple[Tensor, Tensor]:
    """Motion of passive joints by that of motors, (B, p, a), and which motors (B, a) determine it."""
    J_p, J_a = (
        torch.cat([loop.jacobian(tree, kinematics.states, dofs) for loop in group.loops]).permute(2, 0, 1)
        for dofs in (group.passive, group.driven)
    )
    values, p = torch.linalg.svdvals(J_p), len(group.passive)
    size = torch.linalg.matrix_norm(torch.cat([J_p, J_a], dim=2))[:, None]
    motion = -torch.linalg.pinv(J_p, rtol=_DETERMINED) @ J_a
    left = torch.linalg.vector_norm(J_a + J_p @ motion, dim=1)
    determined = left <= _DETERMINED * size
    if values.shape[1] < p:  # more passive joints than constraints
        return motion, torch.zeros_like(determined)
    return motion, determined & (values[:, p - 1 : p] > _DETERMINED * size if p else determined)
