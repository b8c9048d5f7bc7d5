"""Rows of wrenches on a body, and the wrenches at the base origin that they are at each sample."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchid.problem.chunk_dynamics import ChunkKinematics
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
