"""The regressor K(q, v, a) and frame Jacobians J as modules, and the functions that compute their rows, batch-last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.parameters import Array
from torchid.regressor.columns import ColumnLayout, all_columns, all_wrench_columns, full_layout, regrouped_columns
from torchid.regressor.compiled import (
    Referenced,
    call,
    frame_jacobian,
    inverse_dynamics,
    is_marked,
    marked,
    regressor,
    robot_tables,
    write_regressor,
)
from torchid.regressor.kinematics import (
    GRAVITY_WORLD,
    BodyStates,
    JointMotion,
    Motion,
    body_states,
    cross_product,
    independent_positions,
    joint_motion,
    joint_screw_axes,
    link_states,
    motion_from_state,
    require_precision,
    require_state,
    rotation_matrix,
    states_at_rest,
)
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot


class Regressor(Referenced):
    """Regressor K(q, v, a) with `K phi = S^T tau + J_C^T lambda` (Mistry et al. 2009, eq. 5).

    Columns: 12 per body, bodies in the order of `robot.body_names`, parameters in the order of `torchid.parameters`.
    Rows: base force and base moment (base frame, about the base origin), then `robot.dof_names`: joint torques and
    wrenches of limb force/torque sensors. A fixed base has no base rows.

    On a CPU, in float64 and float32, compiled kernels compute K and its gradient, where torchid was installed with a
    C++ compiler. They are operators that `torch.compile`, `torch.export` and `torch.func` know. Elsewhere, and for
    higher derivatives, torch's operators compute the same.

    Attributes:
        reduction: (columns, 12 L), None unless `regrouped`: `K_regrouped @ reduction` is K, and `reduction @ phi` are
            the parameters of the columns.
    """

    reduction: Tensor | None
    table: Tensor
    reals: Tensor

    def __init__(
        self,
        robot: Robot,
        gravity: tuple[float, float, float] = GRAVITY_WORLD,
        sign_width: float | None = None,
        regrouped: bool = False,
    ) -> None:
        """Build the constants.

        Args:
            robot: the robot.
            gravity: (3,), in the world (in the base frame if the base is fixed) [m/s^2].
            sign_width: replaces the sign of Coulomb friction by tanh(velocity / sign_width) [rad/s or m/s].
            regrouped: whether K has only the columns that remain after regrouping (Gautier 1990), and the friction of
                joints. For a floating base these are base parameters.
        """
        super().__init__()
        self.gravity = gravity
        self.tree = KinematicTree(robot, sign_width)
        self._inertial = full_layout(self.tree)
        self._columns = ColumnLayout((tuple(range(parameters.PER_BODY)),) * self.tree.n_nodes)
        self._rows = joint_rows(self.tree, self._columns)
        columns, frames, reduction = (regrouped_columns if regrouped else all_columns)(self.tree)
        self.shape = self.tree.n_rows, max((column + 1 for own in columns for column in own), default=0)
        table, reals = robot_tables(self.tree, columns, frames, gravity)
        for name, constants in (("reduction", reduction), ("table", table), ("reals", reals)):
            self.register_buffer(name, constants, persistent=False)

    def forward(self, q: Tensor, v: Tensor, a: Tensor, out: Tensor | None = None) -> Tensor:
        """Compute the regressor at generalized coordinates.

        Args:
            q: (..., n + 7): base position [m], base quaternion x, y, z, w (it is normalized; norm 0 means no rotation),
                joint positions [rad or m]; (..., n) for a fixed base. Any number of leading dimensions, or none.
            v: (..., nv): base linear and angular velocity in the base frame [m/s, rad/s], joint velocities.
            a: (..., nv): time derivative of `v`.
            out: what an earlier call returned for arguments of these shapes; is written and returned, and no memory is
                allocated. If it is as this module left it, constant zeros of K are not written again.

        Returns:
            (..., nv + 6 F, 12 L) for L bodies and F limb force/torque sensors. It is a strided view of a batch-last
            tensor; call `.contiguous()` if the memory layout matters.

        Raises:
            TypeError: an argument is not a tensor, has another dtype or device than the module, or requires a gradient
                beside `out`.
            ValueError: a shape is wrong.
        """
        samples, state = self.batch(q, v, a)
        constants = self.table, self.reals
        compiled = self.runs_compiled(q)
        if out is None:
            K = call(regressor, *state, *constants, *self.shape, self.number) if compiled else self.reference(*state)
            return marked(K.permute(2, 0, 1).reshape(*samples, *self.shape), self.number)
        K = self._memory(out, samples, state)
        if compiled:
            if not is_marked(out, self.number):
                K.zero_()
            write_regressor(*state, *constants, K)
            if not out.is_inference():
                torch.autograd.graph.increment_version(out)
        else:
            K.copy_(self.reference(*state))
        return marked(out, self.number)

    def batch(self, q: Tensor, v: Tensor, a: Tensor) -> tuple[torch.Size, tuple[Tensor, Tensor, Tensor]]:
        """Leading dimensions of generalized coordinates, and these as (B, width) each; errors as of `forward`."""
        require_precision(self.tree, {"q": q, "v": v, "a": a})
        require_state(q, v, a, self.tree.n, not self.tree.base_rows)
        samples = q.shape[:-1]
        if len(samples) == 1:
            return samples, (q, v, a)
        count = samples.numel()  # -1 would say nothing where there are no samples
        (q, v, a) = (x.reshape(count, x.shape[-1]) for x in (q, v, a))
        return samples, (q, v, a)

    def reference(self, *arguments: Tensor) -> Tensor:
        """K, (rows, columns, B), of q, v and a, (B, width) each, by torch's operators."""
        (q, v, a) = arguments
        motion = motion_from_state(q, v, a, self.tree.n, not self.tree.base_rows, self.gravity)
        return self.from_motion(motion).permute(1, 2, 0)

    def _memory(self, out: Tensor, samples: torch.Size, state: Sequence[Tensor]) -> Tensor:
        """`out` as (rows, columns, B), contiguous."""
        if not isinstance(out, Tensor):
            raise TypeError(f"out: found {type(out).__name__}; accepted: a tensor that an earlier call returned")
        if torch.is_grad_enabled() and any(x.requires_grad for x in (*state, out)):
            raise TypeError("out: found arguments that require a gradient; accepted: no out, or torch.no_grad()")
        require_precision(self.tree, {"out": out})
        if out.shape == (*samples, *self.shape):
            K = out.reshape(len(state[0]), *self.shape).permute(1, 2, 0)
            if K.is_contiguous():
                return K
        shape = f"shape {tuple(out.shape)}, strides {out.stride()}"
        raise ValueError(f"out: found {shape}; accepted: what an earlier call returned for samples {tuple(samples)}")

    def from_motion(self, motion: Motion) -> Tensor:
        """Compute the regressor, (B, nv + 6 F, 12 L), from a `Motion`, by torch's operators."""
        tree = self.tree
        columns = self._columns
        joints = joint_motion(tree, motion)
        states = body_states(tree, motion, joints)
        screw_axes = joint_screw_axes(tree, states)
        inertial = all_wrench_columns(link_states(tree, states), self._inertial).unflatten(1, (tree.n_nodes, -1))
        wrenches = nn.functional.pad(inertial, (0, 0, 0, parameters.PER_BODY - inertial.shape[2])).flatten(1, 2)
        zeros = wrenches.new_zeros(1, 1).expand(wrenches.shape[1:])
        blocks = list(wrenches) if tree.base_rows else [zeros[:0]]
        for row in self._rows:
            block = joint_row(row, tree, columns, screw_axes, wrenches)
            for body, coulomb, viscous in friction_columns(row, joints):
                start = columns.starts[body] - row.start
                block[start : start + parameters.PER_BODY][parameters.FRICTION] = torch.stack([coulomb, viscous])
            blocks += [zeros[: row.start], block, zeros[row.end :]]
        K = torch.cat(blocks).unflatten(
            0, (-1, tree.n_nodes, parameters.PER_BODY)
        )  # in place, gradients copy all of it
        if len(tree.node_of) < tree.n_nodes:
            K = K[:, tree.node_of]
        K = K.flatten(1, 2).permute(2, 0, 1)
        return K if self.reduction is None else K @ torch.linalg.pinv(self.reduction)


class InverseDynamics(Referenced):
    """Generalized forces `K(q, v, a) phi` without K: base wrench and joint torques, friction included.

    Rows as of `Regressor`. Compiled and differentiable like it, by q, v, a and the parameters.
    """

    def __init__(
        self, robot: Robot, gravity: tuple[float, float, float] = GRAVITY_WORLD, sign_width: float | None = None
    ) -> None:
        """Build the constants; arguments as of `Regressor`."""
        super().__init__()
        self.regressor = Regressor(robot, gravity, sign_width)

    def forward(self, q: Tensor, v: Tensor, a: Tensor, phi: Tensor) -> Tensor:
        """Compute the forces.

        Args:
            q: (..., n + 7), or (..., n) for a fixed base; see `Regressor`.
            v: (..., nv).
            a: (..., nv).
            phi: (12 L,) for all samples, or (..., 12 L) of each; `robot.nominal.flatten()` has the URDF's.

        Returns:
            (..., nv + 6 F): base force [N] and moment [N m], then joint torques [N m or N].

        Raises:
            TypeError: an argument is not a tensor, or has another dtype or device than the module.
            ValueError: a shape is wrong.
        """
        module = self.regressor
        samples, state = module.batch(q, v, a)
        if not isinstance(phi, Tensor):
            raise TypeError(f"phi: found {type(phi).__name__}; accepted: a tensor")
        columns = module.shape[1]
        require_precision(module.tree, {"phi": phi})
        if phi.shape[-1:] != (columns,) or phi.shape[:-1] not in (samples, ()):
            accepted = f"({columns},) or {(*samples, columns)}"
            raise ValueError(f"phi: found shape {tuple(phi.shape)}; accepted: {accepted}")
        if phi.ndim > 1:
            phi = phi.reshape(samples.numel(), columns)
        inputs = (*state, phi)
        if self.runs_compiled(q):
            constants = module.table, module.reals
            forces = call(inverse_dynamics, *inputs, *constants, *module.shape, self.number)
        else:
            forces = self.reference(*inputs)
        return forces.reshape(*samples, module.shape[0])

    def reference(self, *arguments: Tensor) -> Tensor:
        """K phi, (B, rows), by torch's operators."""
        *state, phi = arguments
        K = self.regressor.reference(*state).permute(2, 0, 1)
        return (K @ phi[..., None])[..., 0]


@dataclass(frozen=True)
class JointRow:
    """Where the row of an independent joint can differ from zero.

    `moved`: the bodies whose joints follow it (its own and mimic joints', in the order of bodies) with their
    multipliers; `start` and `end`: the hull of their subtrees' columns.
    """

    moved: tuple[tuple[int, float], ...]
    start: int
    end: int


def joint_rows(tree: KinematicTree, layout: ColumnLayout) -> list[JointRow]:
    """One per independent joint."""
    rows = []
    for column in tree.joint_map[1:].T.tolist():
        moved = [(joint + 1, ratio) for joint, ratio in enumerate(column) if ratio]
        start = min(layout.starts[body] for body, _ in moved)
        end = max(layout.starts[tree.subtree_end[body]] for body, _ in moved)
        rows.append(JointRow(tuple(moved), start, end))
    return rows


def joint_row(row: JointRow, tree: KinematicTree, layout: ColumnLayout, screw_axes: Tensor, wrenches: Tensor) -> Tensor:
    """Inertial part of one joint's row, (row.end - row.start, B)."""
    body, ratio = row.moved[0]
    if len(row.moved) == 1:
        return ratio * _torque(screw_axes[:, body], wrenches[:, row.start : row.end])
    total = wrenches.new_zeros(row.end - row.start, wrenches.shape[-1])
    for body, ratio in row.moved:
        start = layout.starts[body]
        end = layout.starts[tree.subtree_end[body]]
        part = ratio * _torque(screw_axes[:, body], wrenches[:, start:end])
        total = total + torch.nn.functional.pad(part, (0, 0, start - row.start, row.end - end))
    return total


def friction_columns(row: JointRow, joints: JointMotion) -> list[tuple[int, Tensor, Tensor]]:
    """Friction entries of one joint's row: body, column of fc, column of fv, each (B,).

    Friction adds `fc sign(v) + fv v` to the actuator's torque. In a filtered log this term is filtered too.
    """
    entries = []
    for body, ratio in row.moved:
        entries.append((body, ratio * joints.direction[body], ratio * joints.velocity[body]))
    return entries


def _torque(screw_axis: Tensor, wrenches: Tensor) -> Tensor:
    (x, *axes), (first, *others) = screw_axis.unbind(), wrenches.unbind()
    total = x * first
    for axis, wrench in zip(axes, others, strict=True):
        total.addcmul_(axis, wrench)
    return total


def wrenches_at_base(states: BodyStates, body: int, wrenches: Tensor, arms: Tensor | None = None) -> Tensor:
    """Wrenches, (k, 6) in a node's joint frame, at the base origin in base axes, (6, k, B) [N, N m].

    `arms`: (3, 3, B), of `rolling_arms`, if their forces act where a contact rolls rather than in its frame's origin.
    """
    rotation = states.rotation[:, :, body]
    position = states.position[:, body]
    force = wrenches[:, :3] @ rotation
    moment = wrenches[:, 3:] @ rotation + cross_product(position[:, None].expand_as(force), force)
    if arms is not None:
        moment = moment + (arms[:, :, None] * force).sum(1)
    return torch.cat([force, moment])


def forces_at_base(states: BodyStates, body: int, point: Tensor, forces: Tensor, arms: Tensor | None = None) -> Tensor:
    """Wrenches at the base origin, (6, k, B) [N, N m], of forces (3, k, B) in base axes that act at a point of a node.

    `point`: (3,) [m] in the node's joint frame; `arms` as of `wrenches_at_base`.
    """
    at = states.position[:, body] + point @ states.rotation[:, :, body]
    moments = cross_product(at[:, None].expand_as(forces), forces)
    if arms is not None:
        moments = moments + (arms[:, :, None] * forces).sum(1)
    return torch.cat([forces, moments])


def ground_axes(normal: Tensor) -> Tensor:
    """Axes of the ground, (3, 3, B) as columns: two across its normals, (3, B) unit vectors, and these."""
    least = torch.zeros_like(normal).scatter(0, normal.abs().argmin(dim=0, keepdim=True), 1.0)
    across = cross_product(normal, least)
    across = across / torch.linalg.vector_norm(across, dim=0)
    return torch.stack([across, cross_product(normal, across), normal], dim=1)


def rolling_arms(radius: float, normal: Tensor, axis: Tensor | None = None) -> Tensor:
    """Moments about a contact frame's origin of unit forces of the ground on a sphere or cylinder about it.

    A force f at -r n has the moment -r n x f. On a cylinder n is taken across the axis a, and only the moment about a
    counts: those across it are free, so that the part of f along a may act anywhere in the plane of a and n.

    Args:
        radius: r [m].
        normal: n, (3, B), unit vectors away from the ground.
        axis: a, (3, B), unit vectors along a cylinder; None for a sphere.

    Returns:
        (3, 3, B) [m]: moment by force, in the axes of the arguments.
    """
    if axis is None:
        x, y, z = (radius * normal).unbind()
        zero = torch.zeros_like(x)
        return torch.stack([zero, z, -y, -z, zero, x, y, -x, zero]).unflatten(0, (3, 3))
    across = cross_product(axis, normal)
    length = torch.linalg.vector_norm(across, dim=0).clamp_min(torch.finfo(across.dtype).tiny)
    return axis[:, None] * (-radius / length * across)


def generalized_forces(
    tree: KinematicTree, screw_axes: Tensor, body: int, wrenches: Tensor, joints: Sequence[int]
) -> Tensor:
    """Generalized forces of wrenches on a body: their power per unit of base twist and joint velocity.

    Args:
        tree: the robot's constants.
        screw_axes: from `joint_screw_axes`, (6, L, B).
        body: the node that they act on.
        wrenches: at the base origin, (6, k, B) [N, N m].
        joints: independent joints to give columns for, after the base's six (none for a fixed base).

    Returns:
        (k, base rows + len(joints), B).
    """
    path, ratios = tree.path_map(body, joints)
    screws = screw_axes[:, path] if ratios is None else ratios @ screw_axes[:, path]
    torque = wrenches[0, :, None] * screws[0]  # a product at a time: all six at once are six times the memory
    for wrench, screw in zip(wrenches[1:].unsqueeze(2), screws[1:], strict=True):
        torque.addcmul_(wrench, screw)
    return torch.cat([wrenches.transpose(0, 1), torque], dim=1) if tree.base_rows else torque


def wrench_transform(T: Array) -> Array:
    """Matrix (6, 6) that expresses a wrench at a frame, in its axes, in another, where `T`, (4, 4) [m], is its pose."""
    R = T[:3, :3]
    p = T[:3, 3]
    return np.block([[R, np.zeros((3, 3))], [np.cross(np.eye(3), p) @ R, R]])


def contact_arms(
    states: BodyStates, body: int, axes: Tensor, radius: float, normal: Tensor, axis: str | None
) -> Tensor:
    """`rolling_arms` of a frame on a body in base axes.

    Args:
        states: of the joint frames.
        body: the node that carries the frame.
        axes: of the frame, (3, 3), in the node's joint frame, as columns.
        radius: [m].
        normal: of the ground, (3, B), in base axes.
        axis: x, y or z of the frame, along which a cylinder is; None for a sphere.
    """
    along = None if axis is None else axes[:, "xyz".index(axis)] @ states.rotation[:, :, body]
    return rolling_arms(radius, normal, along)


class FrameJacobian(Referenced):
    """Jacobian of a URDF frame: `J(q) v` is the twist of its origin in its own axes, linear velocity first.

    With a radius, the frame rolls on the ground as a sphere about its origin c, or as a cylinder about `axis` (see
    `torchid.Contact`). The linear velocity is then that of the material point at c - radius n on the ground;
    along a cylinder's axis it is that of c. `J^T` maps the wrench of the ground, measured at c.
    """

    table: Tensor
    reals: Tensor

    def __init__(
        self,
        robot: Robot,
        frame: str,
        radius: float = 0.0,
        axis: str | None = None,
        centre: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        """Build the constants.

        Args:
            robot: the robot.
            frame: name of a URDF link.
            radius: of the sphere or cylinder [m].
            axis: x, y or z, the cylinder's axis; None for a sphere.
            centre: c in the frame, (3,) [m].

        Raises:
            UnknownNameError: the robot has no such link.
        """
        super().__init__()
        self.tree = KinematicTree(robot)
        self._body, T_joint_frame = self.tree.frame(robot, frame, centre)
        unit_wrenches = wrench_transform(T_joint_frame).T
        self.register_buffer("unit_wrenches", torch.tensor(unit_wrenches.copy()), persistent=False)
        self.radius = radius
        self.axis = axis
        table, reals = robot_tables(
            self.tree, [()] * self.tree.n_nodes, self.tree.T_joint_link, GRAVITY_WORLD, (self._body, T_joint_frame)
        )
        for name, constants in (("table", table), ("reals", reals)):
            self.register_buffer(name, constants, persistent=False)

    def forward(self, q: Tensor, normal: Tensor | None = None) -> Tensor:
        """Compute the Jacobian.

        Args:
            q: (..., n + 7), or (..., n) for a fixed base (see `Regressor`).
            normal: of the ground under a rolling frame, (..., 3) or (3,), unit vectors in the world (in the base frame
                if the base is fixed); None for z.

        Returns:
            (..., 6, n_rows) with n_rows = nv + 6 F: each of F limb force/torque sensors adds six columns at the end.

        Raises:
            TypeError: `q` is not a tensor, or has another dtype or device than the module.
            ValueError: the shape of `q` is wrong.
        """
        positions = independent_positions(self.tree, q)
        samples = q.shape[:-1]
        q = q.reshape(len(positions), q.shape[-1])
        if self.radius:
            J = self._rolling(q, q.new_tensor([0.0, 0.0, 1.0]) if normal is None else normal.to(q))
        elif self.runs_compiled(q):
            shape = self.tree.n_rows, 0
            J = call(frame_jacobian, q, self.table, self.reals, *shape, self.number)
        else:
            J = self.reference(q)
        return J.permute(2, 0, 1).reshape(*samples, *J.shape[:2])

    def reference(self, *arguments: Tensor) -> Tensor:
        """The Jacobian, (6, n_rows, B), of q, (B, width), by torch's operators, without a radius."""
        (q,) = arguments
        return self._of_wrenches(states_at_rest(self.tree, independent_positions(self.tree, q)), None)

    def _rolling(self, q: Tensor, normal: Tensor) -> Tensor:
        states = states_at_rest(self.tree, independent_positions(self.tree, q))
        up = normal.reshape(-1, 3).expand(len(q), 3)
        if self.tree.base_rows:
            up = (rotation_matrix(q[:, 3:7]).mT @ up[..., None])[..., 0]
        axes = self.get_buffer("unit_wrenches")[:3, :3].T
        return self._of_wrenches(states, contact_arms(states, self._body, axes, self.radius, up.T, self.axis))

    def _of_wrenches(self, states: BodyStates, arms: Tensor | None) -> Tensor:
        tree = self.tree
        wrenches = wrenches_at_base(states, self._body, self.get_buffer("unit_wrenches"), arms)
        joints = range(tree.n_dofs)
        return generalized_forces(tree, joint_screw_axes(tree, states), self._body, wrenches, joints)
