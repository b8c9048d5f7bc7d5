"""Columns of the unknowns beside the bodies' parameters, sample by sample."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from torchid.problem.extras import Extra
from torchid.problem.plan import StatePlan
from torchid.problem.samples import Samples
from torchid.regressor.tree import KinematicTree


def dof_column(extra: Extra, samples: Samples, tree: KinematicTree) -> Tensor:
    """What one unit of an unknown of a degree of freedom adds to its row, (B,)."""
    if extra.dof is None:
        raise ValueError(f"extra: found {extra.label}; accepted: one of a degree of freedom")
    if extra.what == "scale":
        reading = samples.torque
        return samples.time.new_full((len(samples),), torch.nan) if reading is None else -reading[:, extra.dof]
    if extra.what == "armature":
        return samples.joint_acceleration[:, extra.dof]
    if extra.what == "asymmetric_coulomb":
        return tree.coulomb_sign(samples.joint_velocity[:, extra.dof]).abs()
    return torch.ones_like(samples.time)


def reading_column(extra: Extra, samples: Samples, contact: int, axis: int) -> Tensor:
    """What one unit of a contact sensor's unknown takes from its reading along a recorded axis, (B,)."""
    if extra.what == "offset":
        return samples.active[:, contact].to(samples.time) if samples.share is None else samples.share[:, contact]
    reading = samples.wrench
    return samples.time.new_full((len(samples),), torch.nan) if reading is None else -reading[:, contact, axis]


def mixed_columns(
    extras: Sequence[Extra],
    samples: Samples,
    plan: StatePlan,
    tree: KinematicTree,
    measured: Tensor,
    W: Tensor,
    rotations: dict[int, Tensor],
) -> Iterator[Tensor]:
    """Columns of some unknowns in mixed rows, (r, B) each.

    Args:
        extras: which.
        samples: B of one contact state and rank.
        plan: of that state.
        tree: of the robot.
        measured: (B, k_m, base rows + mixed joints), rows of the contact Jacobian of the measured components.
        W: (B, base rows + mixed joints, r), the basis.
        rotations: by contact, (B, 3, 3) from its frame to the recorded axes where these are the world's.
    """
    through = (measured @ W).permute(1, 2, 0)  # how each measured component enters the rows
    places = [place for body in plan.contact_bodies for place in body.components]
    for extra in extras:
        if extra.dof is not None:
            row = W[:, tree.base_rows + plan.mixed_joints.index(extra.dof)]
            yield row.T * dof_column(extra, samples, tree)
            continue
        contact, axis = extra.contact or (0, 0)
        column, reading = W.new_zeros(W.shape[2], len(samples)), reading_column(extra, samples, contact, axis)
        vector = range(3) if axis < 3 else range(3, 6)
        for k in vector if contact in rotations else [axis]:
            if (contact, k) in places:
                turned = rotations[contact][:, axis % 3, k % 3] * reading if contact in rotations else reading
                column = column + through[places.index((contact, k))] * turned
        yield column
