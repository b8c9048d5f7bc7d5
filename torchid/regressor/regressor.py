"""The regressor K(q, v, a) as a module for anybody's training loop."""

from __future__ import annotations

from torch import Tensor, nn

from torchid import parameters
from torchid.regressor.dynamics import all_wrench_columns, friction_columns, joint_directions, joint_row, joint_rows
from torchid.regressor.kinematics import body_states, joint_states, link_states
from torchid.regressor.motion import GRAVITY_WORLD, Motion, motion_from_state
from torchid.regressor.reduction import full_layout
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


class Regressor(nn.Module):
    """K(q, v, a) with `K phi = S^T tau + J_C^T lambda` (Mistry et al. 2009, eq. 5).

    Differentiable; `.to(device, dtype)` moves it. Columns: 12 per body, bodies in `robot.body_names`' order,
    parameters in `torchid.parameters`' order. Rows: base force, base moment (base frame, about the base origin), then
    `robot.dof_names`: joints, and the wrenches of force/torque sensors in limbs; a fixed base has no base rows.
    """

    def __init__(
        self, robot: Robot, gravity: tuple[float, float, float] = GRAVITY_WORLD, sign_width: float | None = None
    ) -> None:
        """Build the constants.

        Args:
            robot: the robot.
            gravity: (3,), in the world (in the base frame if the base is fixed) [m/s^2].
            sign_width: Coulomb friction goes with tanh(velocity / width) instead of the sign [rad/s or m/s].
        """
        super().__init__()
        self.gravity = gravity
        self.tree = KinematicTree(robot, sign_width)
        self._layout = full_layout(self.tree)
        self._rows = joint_rows(self.tree, self._layout)

    def forward(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Regressor at generalized coordinates.

        Args:
            q: (B, n + 7), base position [m], orientation x y z w, joints [rad or m]; (B, n) for a fixed base.
            v: (B, nv), base linear and angular velocity in the base frame, joints.
            a: (B, nv), d/dt of `v`.

        Returns:
            (B, nv + 6 F, 12 L) for F force/torque sensors in limbs, a strided view of a batch-last tensor: call
            `.contiguous()` where layout matters.

        Raises:
            ValueError: the shapes do not belong together.
        """
        return self.from_motion(motion_from_state(q, v, a, self.tree.n, not self.tree.base_rows, self.gravity))

    def from_motion(self, motion: Motion) -> Tensor:
        """As `forward`, from a `Motion` (which knows no base position, heading or linear velocity)."""
        tree, layout = self.tree, self._layout
        joints = joint_states(tree, motion)
        states = body_states(tree, motion, joints)
        directions = joint_directions(tree, states)
        wrenches = all_wrench_columns(link_states(tree, states), layout)
        K = wrenches.new_zeros(tree.base_rows + len(self._rows), tree.bodies, parameters.PER_BODY, wrenches.shape[-1])
        inertial = K[:, :, parameters.INERTIAL]
        width = parameters.INERTIAL.stop
        if tree.base_rows:
            inertial[: tree.base_rows] = wrenches.unflatten(1, (-1, width))
        for index, row in enumerate(self._rows, start=tree.base_rows):
            part = joint_row(row, tree, layout, directions, wrenches)
            inertial[index, row.start // width : row.end // width] = part.unflatten(0, (-1, width))
            for body, coulomb, viscous in friction_columns(row, tree, joints):
                K[index, body, parameters.COULOMB] = coulomb
                K[index, body, parameters.VISCOUS] = viscous
        if len(tree.node_of) < tree.bodies:
            K = K[:, tree.node_of]
        return K.flatten(1, 2).permute(2, 0, 1)
