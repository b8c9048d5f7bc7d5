"""Kinematics and dynamics of a chunk of samples, and the memory that one chunk after the other is worked on in."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from torchid.problem.samples import Samples
from torchid.regressor.kinematics import BodyStates, JointMotion


class Workspace:
    """Named buffers of one worker, reused: fresh memory for large arrays takes as long as the arithmetic on them."""

    def __init__(self) -> None:
        self._buffers: dict[str, Tensor] = {}

    def empty(self, name: str, like: Tensor, *shape: int) -> Tensor:
        """A contiguous array with arbitrary values, valid until the next request with this name."""
        buffer, size = self._buffers.get(name), math.prod(shape)
        if buffer is None or buffer.numel() < size or (buffer.dtype, buffer.device) != (like.dtype, like.device):
            buffer = self._buffers[name] = like.new_empty(size)
        return buffer[:size].view(shape)


class Workspaces:
    """Workspaces of workers that come and go: what one has given back, the next one takes.

    The first touch of so much memory takes as long as a chunk or two.
    """

    def __init__(self) -> None:
        self._idle: list[Workspace] = []

    def take(self) -> Workspace:
        """One that nobody else has until it is given back."""
        try:
            return self._idle.pop()  # no lock: one bytecode
        except IndexError:
            return Workspace()

    def give_back(self, workspace: Workspace) -> None:
        """Leave one to others; what was read from it is then no longer valid."""
        self._idle.append(workspace)


@dataclass(frozen=True)
class ChunkKinematics:
    """Kinematics of B samples, from which predictions and contact Jacobians are computed.

    Attributes:
        joints: motion of all joints.
        states: of the joint frames of all nodes.
        screw_axes: (6, L, B), see `joint_screw_axes`.
        rotation_world_base: (B, 3, 3), None where it was not recorded.
        arms: (3, 3, B) [m] by rolling contact, see `torchid.regressor.regressor.rolling_arms`.
        recorded_normals: whether each of these has normals of its own.
        ground_axes: (3, 3, B) in base axes by contact that is read along the ground's normal, see
            `torchid.regressor.regressor.ground_axes`.
        resting: (n, B) bool, joints whose torque counts as unmeasured, see `Samples`; None for none.
    """

    joints: JointMotion
    states: BodyStates
    screw_axes: Tensor
    rotation_world_base: Tensor | None
    arms: Mapping[int, Tensor]
    recorded_normals: bool
    ground_axes: Mapping[int, Tensor]
    resting: Tensor | None

    def without_rest(self, forces: Tensor, base_rows: int, value: float = math.nan) -> Tensor:
        """Generalized forces (M, B, n_rows) with a value in the rows of joints at rest."""
        if self.resting is None:
            return forces
        at = nn.functional.pad(self.resting.T, (base_rows, forces.shape[2] - base_rows - len(self.resting)))
        return forces.masked_fill(at, value)

    def some(self, index: slice) -> ChunkKinematics:
        """The kinematics of some samples, views."""
        return ChunkKinematics(
            JointMotion(*(x[..., index] for x in vars(self.joints).values())),
            BodyStates(*(x[..., index] for x in vars(self.states).values())),
            self.screw_axes[..., index],
            None if self.rotation_world_base is None else self.rotation_world_base[index],
            {contact: arm[..., index] for contact, arm in self.arms.items()},
            self.recorded_normals,
            {contact: axes[..., index] for contact, axes in self.ground_axes.items()},
            None if self.resting is None else self.resting[..., index],
        )


@dataclass(frozen=True)
class ChunkDynamics(ChunkKinematics):
    """Kinematics of B samples with the columns of the inertial parameters, from which rows are computed.

    Attributes:
        wrenches: (6, columns, B), wrench at the base origin of a unit of each inertial parameter; the forces of
            inertias, which are zero, need not have been written.
    """

    wrenches: Tensor

    def select(self, index: Tensor | slice) -> ChunkDynamics:
        """The dynamics of some samples."""
        if isinstance(index, slice):  # all of them
            return self

        def pick(x: Tensor) -> Tensor:
            return x[..., index]

        return ChunkDynamics(
            JointMotion(*map(pick, vars(self.joints).values())),
            BodyStates(*map(pick, vars(self.states).values())),
            pick(self.screw_axes),
            None if self.rotation_world_base is None else self.rotation_world_base[index],
            {contact: pick(arms) for contact, arms in self.arms.items()},
            self.recorded_normals,
            {contact: pick(axes) for contact, axes in self.ground_axes.items()},
            None if self.resting is None else pick(self.resting),
            pick(self.wrenches),
        )


@dataclass(frozen=True)
class ChunkPart:
    """Samples of one rank: their generalized forces f, (base rows + coupled joints, B), and measured contact rows."""

    samples: Samples
    f: Tensor
    measured: Tensor
    dynamics: ChunkDynamics
