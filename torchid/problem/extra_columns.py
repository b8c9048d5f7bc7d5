"""Columns of extra parameters in the rows, and torques of those that the robot's file states: armatures, springs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchid.problem.contact_state import ContactStateLayout
from torchid.problem.extras import DELAYED, Extra
from torchid.problem.samples import Samples
from torchid.problem.wrench_rows import FramePoses
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


def dof_extra_column(extra: Extra, dof: int, samples: Samples, tree: KinematicTree) -> Tensor:
    """Column of an extra parameter in the row of one of its degrees of freedom, (B,)."""
    if extra.what == "scale":
        reading = samples.torque
        return samples.time.new_full((len(samples),), torch.nan) if reading is None else -reading[:, dof]
    if extra.what == DELAYED and samples.delayed_torque is not None:
        return samples.delayed_torque[:, extra.number, dof]
    if extra.what == "armature":
        return samples.joint_acceleration[:, dof]
    if extra.what == "stiffness":
        return samples.joint_position[:, dof]
    if extra.what == "asymmetric_coulomb":
        return tree.coulomb_sign(samples.joint_velocity[:, dof]).abs()
    if extra.what == "stribeck":
        filtered = samples.stribeck
        return tree.stribeck_share(samples.joint_velocity[:, dof]) if filtered is None else filtered[:, dof]
    return torch.ones_like(samples.time)


def contact_extra_column(extra: Extra, samples: Samples, contact: int, axis: int) -> Tensor:
    """Column of a contact sensor's extra parameter, subtracted from its reading along a recorded axis, (B,)."""
    if extra.what == "offset":
        return samples.active[:, contact].to(samples.time) if samples.share is None else samples.share[:, contact]
    reading = samples.wrench
    return samples.time.new_full((len(samples),), torch.nan) if reading is None else -reading[:, contact, axis]


def extra_columns(
    extras: Sequence[Extra],
    samples: Samples,
    layout: ContactStateLayout,
    tree: KinematicTree,
    measured: Tensor,
    W: Tensor,
    poses: dict[int, FramePoses],
) -> Iterator[Tensor]:
    """Columns of extra parameters in coupled rows, (r, B) each.

    Args:
        extras: the parameters.
        samples: B of one contact state and rank.
        layout: of that state.
        tree: of the robot.
        measured: (B, k_m, base rows + coupled joints), rows of the contact Jacobian of the measured components.
        W: (B, base rows + coupled joints, r), the basis.
        poses: by contact, of its frame in the world where wrenches were recorded along the world's axes; none of a
            contact that is read along the ground's normal.
    """
    projected = (measured @ W).permute(1, 2, 0)  # rows per unit of each measured component
    components = [component for body in layout.contact_bodies for component in body.components]
    for extra in extras:
        column = W.new_zeros(W.shape[2], len(samples))
        for dof in extra.dofs:
            if dof in layout.coupled_joints:
                row = W[:, tree.base_rows + layout.coupled_joints.index(dof)]
                column = column + row.T * dof_extra_column(extra, dof, samples, tree)
        for contact, axis in extra.contacts:
            reading = contact_extra_column(extra, samples, contact, axis)
            own = poses.get(contact)
            unit = None if own is None else own.of_unit(axis)
            for k in [axis] if own is None else own.reached(axis):
                if (contact, k) in components:
                    along = reading if unit is None else unit[:, k] * reading
                    column = column + projected[components.index((contact, k))] * along
        yield column


class KnownTorques:
    """What armatures and springs of an MJCF robot need, `armature * acceleration + stiffness * position + constant`.

    Armatures and stiffnesses that are among the extra parameters are not known: these stand for all of them.
    """

    def __init__(self, robot: Robot, extras: Sequence[Extra]) -> None:
        """Of a robot, those that are not `extras`."""
        fitted = {what: [dof for x in extras if x.what == what for dof in x.dofs] for what in ("armature", "stiffness")}
        self._armature, self._stiffness = robot.armature.copy(), robot.stiffness.copy()
        self._armature[fitted["armature"]] = self._stiffness[fitted["stiffness"]] = 0.0
        self._constant, self._others = robot.spring_torque, robot.n_dofs - robot.n
        self.none = not np.any([self._armature, self._stiffness, self._constant])

    def of(self, samples: Samples) -> Tensor:
        """Of some samples, (B, n + 6 F) [N m or N], 0 at force/torque sensors."""
        armature, stiffness, constant = (
            samples.time.new_tensor(x) for x in (self._armature, self._stiffness, self._constant)
        )
        known = armature * samples.joint_acceleration + stiffness * samples.joint_position + constant
        return known if not self._others else pad(known, (0, self._others))
