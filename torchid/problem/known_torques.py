"""Torques of joints that the robot's file states and no parameter of a fit stands for: armatures and springs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor
from torch.nn.functional import pad

from torchid.problem.extras import Extra
from torchid.problem.samples import Samples
from torchid.robot import Robot


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
