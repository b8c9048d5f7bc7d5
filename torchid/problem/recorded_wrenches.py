"""Recorded wrenches of contacts, at the frames' origins along the frames' axes, as the rows have them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchid.problem.chunk_dynamics import ChunkKinematics
from torchid.problem.samples import Samples


@dataclass(frozen=True)
class FramePoses:
    """Poses of a contact's frame in the world, or in a bolted base of which no pose was recorded.

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
