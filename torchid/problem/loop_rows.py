"""Rows of closed loops: unmeasured forces inside of the robot, in every contact state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchid.parameters import Array
from torchid.problem.chunk_dynamics import ChunkKinematics
from torchid.regressor.loops import LoopClosures, LoopGeometry
from torchid.regressor.regressor import wrenches_at_base
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


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
        """Look up where they close."""
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
