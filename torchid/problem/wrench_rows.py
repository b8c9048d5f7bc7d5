"""Wrenches on bodies as the rows have them: of unmeasured directions at each sample, and as contacts recorded them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchid.problem.chunk_dynamics import ChunkKinematics
from torchid.problem.samples import Samples
from torchid.regressor.regressor import forces_at_base, wrenches_at_base


class Acting(NamedTuple):
    """What of forces on a body changes from sample to sample.

    `rolling`: contact whose `rolling_arms` they have, so that they act where it touches the ground. `ground`: contact
    whose `ground_axes` they are along, in its frame's origin; their rows are (k, 3), by these axes.
    """

    rolling: int | None = None
    ground: int | None = None


@dataclass(frozen=True)
class WrenchRows:
    """Wrenches, (k, 6), at a body's joint frame, in its axes.

    `acting`: where and along which axes their forces act, if that is not fixed to the body.
    """

    rows: Tensor
    acting: Acting


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
        rolling, ground = part.acting
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
