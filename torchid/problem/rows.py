"""Whitened, projected rows of the linear problem, one contact state at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.base_motion import levelled_base_axes
from torchid.problem.contact_state import (
    Columns,
    ContactState,
    ContactStateLayout,
    ContactStateLayouts,
    dof_extra_column,
    extra_columns,
)
from torchid.problem.extras import ExtraTerms, list_extras
from torchid.problem.samples import Samples
from torchid.regressor.columns import all_wrench_columns
from torchid.regressor.kinematics import BodyStates, JointMotion, body_states, joint_motion, joint_screw_axes
from torchid.regressor.regressor import (
    friction_columns,
    generalized_forces,
    joint_row,
    wrench_transform,
    wrenches_at_base,
)
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet
from torchid.sensing.projection import null_space, whitened_null_space


class Workspace:
    """Named buffers of one worker; of each name only the latest is stored."""

    def __init__(self) -> None:
        """Start empty."""
        self._buffers: dict[str, Tensor] = {}

    def zeros(self, name: str, like: Tensor, *shape: int) -> Tensor:
        """A buffer that is zero wherever callers with the same name and shape never write."""
        buffer = self._buffers.get(name)
        if buffer is None or (buffer.shape, buffer.dtype, buffer.device) != (shape, like.dtype, like.device):
            buffer = self._buffers[name] = torch.zeros(shape, dtype=like.dtype, device=like.device)
        return buffer


@dataclass(frozen=True)
class ChunkKinematics:
    """Kinematics of B samples, from which predictions and contact Jacobians are computed.

    Attributes:
        joints: motion of all joints.
        states: of the joint frames of all nodes.
        screw_axes: (6, L, B), see `joint_screw_axes`.
        rotation_world_base: (B, 3, 3), None where it was not recorded.
    """

    joints: JointMotion
    states: BodyStates
    screw_axes: Tensor
    rotation_world_base: Tensor | None


@dataclass(frozen=True)
class ChunkDynamics(ChunkKinematics):
    """Kinematics of B samples with the columns of the inertial parameters, from which rows are computed.

    Attributes:
        wrenches: (6, columns, B), wrench at the base origin of a unit of each inertial parameter.
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
            pick(self.wrenches),
        )


class RowBuilder(nn.Module):
    """Rows of `W^T [K_columns | f]`: W a basis of V_x's span under which the projected sensor noise is white.

    The fast implementation of the equations that `torchid.Projection` computes from `torchid.Regressor` and
    `torchid.FrameJacobian`, up to a rotation of each sample's rows, in fewer columns (see `Columns`). It shares their
    functions in `torchid.regressor` and `torchid.sensing.projection`, but processes samples one contact state at a
    time, where all shapes are constant, and multiplies W^T with the bodies' wrenches without forming K.
    `tests/problem/test_rows_two_ways.py` compares both; read the reference implementation first.

    `frames`: node of each contact, and the pose of the contact frame in the node's joint frame, (4, 4) [m]. `width`:
    number of columns, those of the bodies' parameters and one for each of `extras`.
    """

    def __init__(
        self, robot: Robot, contacts: Sequence[Contact], sensors: SensorSet, terms: ExtraTerms | None = None
    ) -> None:
        """Build the constants.

        Args:
            robot: the robot.
            contacts: all contacts, by the columns of the samples' `active`.
            sensors: which forces are measured, with their noise.
            terms: extra parameters; none by default.
        """
        super().__init__()
        terms = terms or ExtraTerms()
        self.extras = list_extras(robot, contacts, sensors, terms)
        self.tree = KinematicTree(robot, terms.sign_width)
        self.columns = Columns(self.tree)
        self.contacts = tuple(contacts)
        self.sensors = sensors
        self._layouts = ContactStateLayouts(robot, self.columns, contacts, sensors, self.extras)
        self.frames = self._layouts.frames
        self.width = self.columns.count + len(self.extras)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RowBuilder:
        self._layouts.clear()  # their tensors are not buffers of the module
        super()._apply(fn, recurse)
        return self

    def to_columns(self, phi: Array) -> Tensor:
        """Parameters (M, 12 L), or (M, 12 L + E) with values of the `extras`, in these columns: (M, width)."""
        rigid = self.columns.parameter_map
        extra = phi[:, rigid.shape[1] :] if phi.shape[1] > rigid.shape[1] else np.zeros((len(phi), len(self.extras)))
        return torch.from_numpy(np.hstack([phi[:, : rigid.shape[1]] @ rigid.T, extra])).to(self.device)

    @property
    def device(self) -> torch.device:
        """Where the rows are computed."""
        return self.tree.ancestors.device

    def layout(self, state: ContactState) -> ContactStateLayout:
        """Layout of a contact state: its columns, coupled joints and wrench directions."""
        return self._layouts.layout(state)

    def kinematics(self, samples: Samples) -> ChunkKinematics:
        """Kinematics of some samples."""
        motion = samples.motion()
        joints = joint_motion(self.tree, motion)
        states = body_states(self.tree, motion, joints)
        return ChunkKinematics(joints, states, joint_screw_axes(self.tree, states), samples.base.rotation)

    def dynamics(self, samples: Samples, workspace: Workspace | None = None) -> ChunkDynamics:
        """Dynamics of some samples; with a workspace, valid until the next call with the same."""
        kinematics, layout, out = self.kinematics(samples), self.columns.layout, None
        if workspace is not None:
            out = workspace.zeros("wrenches", kinematics.screw_axes, 6, layout.count, len(samples))
        return ChunkDynamics(**vars(kinematics), wrenches=all_wrench_columns(kinematics.states, layout, out))

    def rows(
        self, samples: Samples, state: ContactState, workspace: Workspace | None = None
    ) -> Iterator[tuple[tuple[int, ...], Tensor]]:
        """Blocks of rows for samples that share a contact state; no gradient flows through reused buffers.

        Yields:
            (columns, rows): rows are (M, len(columns) + 1), the right-hand side last, valid until the next
                is requested.
        """
        workspace = workspace or Workspace()
        layout, dynamics = self.layout(state), self.dynamics(samples, workspace)
        for _, _, rows in self._coupled_rows(samples, layout, dynamics, workspace):
            yield layout.support, rows.flatten(1).T
        for joint in layout.uncoupled_joints:
            columns, rows = self._uncoupled_row(joint, samples, dynamics)
            yield columns, rows.T

    def rows_by_sample(self, samples: Samples, state: ContactState) -> tuple[Tensor, Tensor]:
        """The same rows sample by sample, for samples that share a contact state.

        Returns:
            (B, n_rows, width + 1), `W^T [K | f]` with rows of zeros where a sample has fewer than n_rows, and W,
            (B, n_rows, n_rows).
        """
        layout, dynamics = self.layout(state), self.dynamics(samples)
        base, coupled = self.tree.base_rows, self.tree.base_rows + len(layout.coupled_joints)
        n_rows = self.tree.n_rows
        rows = samples.time.new_zeros(len(samples), n_rows, self.width + 1)
        W = samples.time.new_zeros(len(samples), n_rows, n_rows)
        dofs = self._index([*range(base), *(base + joint for joint in layout.coupled_joints)])
        support = self._index([*layout.support, self.width])
        for index, basis, block in self._coupled_rows(samples, layout, dynamics, Workspace()):
            sample = torch.arange(len(samples), device=self.device)[index][:, None, None]
            slots = torch.arange(block.shape[1], device=self.device)
            rows[sample, slots[:, None], support] = block.permute(2, 1, 0)
            W[sample, dofs[:, None], slots] = basis
        for slot, joint in enumerate(layout.uncoupled_joints, start=coupled):
            columns, block = self._uncoupled_row(joint, samples, dynamics)
            rows[:, slot, self._index([*columns, self.width])] = block.T
            W[:, base + joint, slot] = 1.0 / self._layouts.dof_std[joint]
        return rows, W

    def null_space_bases(
        self, state: ContactState, kinematics: ChunkKinematics
    ) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """Orthonormal V_x, (B', base rows + coupled joints, r), with the samples it belongs to, grouped by rank."""
        yield from null_space(self._contact_rows(self.layout(state), kinematics)[0])

    def contact_jacobian(self, samples: Samples) -> Tensor:
        """Jacobians of all contact frames along their own axes, active or not, (B, C, 6, n_rows)."""
        kinematics, joints = self.kinematics(samples), range(self.tree.n_dofs)
        J = kinematics.screw_axes.new_zeros(len(samples), len(self.frames), 6, self.tree.n_rows)
        for contact, (body, T_joint_frame) in enumerate(self.frames):
            units = J.new_tensor(wrench_transform(T_joint_frame).T.copy())
            at_base = wrenches_at_base(kinematics.states, body, units)
            J[:, contact] = generalized_forces(self.tree, kinematics.screw_axes, body, at_base, joints).permute(2, 0, 1)
        return J

    def noise_axes(self, rotation_world_base: Tensor | None) -> Tensor | None:
        """Axes of the stated noise of the base rows, (B, 3, 3); None for the base's own, if its attitude is unknown."""
        return (
            None if rotation_world_base is None or not self.tree.base_rows else levelled_base_axes(rotation_world_base)
        )

    def recorded_wrench(self, samples: Samples, contact: int, kinematics: ChunkKinematics) -> Tensor:
        """Recorded wrench of a contact along its frame's axes, (B, 6) [N, N m], NaN where not recorded."""
        if samples.wrench is None:
            return samples.time.new_full((len(samples), 6), torch.nan)
        wrench = samples.wrench[:, contact]
        if not samples.wrench_in_world:
            return wrench
        return (self._rotation(contact, kinematics).mT @ wrench.unflatten(1, (2, 3)).mT).mT.flatten(1)

    def _rotation(self, contact: int, kinematics: ChunkKinematics) -> Tensor:
        """Rotation contact frame to world, (B, 3, 3), or to a bolted base whose orientation is unknown."""
        body, _ = self.frames[contact]
        rotation = kinematics.states.rotation[:, :, body].permute(2, 0, 1) @ self._layouts.frame_rotation(contact)
        return rotation if kinematics.rotation_world_base is None else kinematics.rotation_world_base @ rotation

    def recorded_torque(self, samples: Samples) -> Tensor:
        """Recorded joint torques and wrenches in limbs, (B, n + 6 F) [N m, N], NaN where not recorded."""
        if samples.torque is None:
            return samples.time.new_full((len(samples), self.tree.n_dofs), torch.nan)
        return samples.torque

    def _uncoupled_row(self, joint: int, samples: Samples, dynamics: ChunkDynamics) -> tuple[tuple[int, ...], Tensor]:
        row = self.columns.joint_rows[joint]
        inertial = joint_row(row, self.tree, self.columns.layout, dynamics.screw_axes, dynamics.wrenches)
        friction = [x for _, *pair in friction_columns(row, self.tree, dynamics.joints) for x in pair]
        own_extras = {
            self.columns.count + number: extra for number, extra in enumerate(self.extras) if extra.dof == joint
        }
        extra = [dof_extra_column(extra, samples, self.tree) for extra in own_extras.values()]
        block = torch.cat([inertial, torch.stack([*friction, *extra, self.recorded_torque(samples)[:, joint]])])
        columns = (*range(row.start, row.end), *self.columns.friction_of(joint), *own_extras)
        return columns, block / self._layouts.dof_std[joint]

    def _coupled_rows(
        self, samples: Samples, layout: ContactStateLayout, dynamics: ChunkDynamics, workspace: Workspace
    ) -> Iterator[tuple[Tensor | slice, Tensor, Tensor]]:
        """Samples of one rank, their W (B', base rows + coupled joints, r) and their rows (columns + 1, r, B')."""
        if not (self.tree.base_rows or layout.coupled_joints):
            return
        unmeasured, measured = self._contact_rows(layout, dynamics)
        torque = self.recorded_torque(samples)[:, self._index(layout.coupled_joints)]
        f = nn.functional.pad(torque, (self.tree.base_rows, 0))
        if len(layout.wrench_std):
            f = f + (measured.mT @ self._measured_wrench(samples, layout, dynamics)[..., None])[..., 0]
        axes = self.noise_axes(dynamics.rotation_world_base) if self.sensors.noise.base_axes_differ else None
        for index, W in whitened_null_space(unmeasured, layout.row_std, measured, layout.wrench_std, axes):
            chosen = dynamics.select(index)
            rows = self._projected_rows(W.permute(1, 2, 0).contiguous(), f[index].T, layout, chosen, workspace)
            if layout.extras:
                rows[-1 - len(layout.extras) : -1] = self._extra_columns(
                    samples[index], layout, chosen, measured[index], W
                )
            yield index, W, rows

    def _extra_columns(
        self, samples: Samples, layout: ContactStateLayout, dynamics: ChunkDynamics, measured: Tensor, W: Tensor
    ) -> Tensor:
        """Columns of the extra parameters, (extras of the layout, r, B)."""
        extras = [self.extras[column - self.columns.count] for column in layout.extras]
        touching = {extra.contact[0] for extra in extras if extra.contact is not None}
        rotations = {k: self._rotation(k, dynamics) for k in touching} if samples.wrench_in_world else {}
        return torch.stack(list(extra_columns(extras, samples, layout, self.tree, measured, W, rotations)))

    def _projected_rows(
        self, W: Tensor, f: Tensor, layout: ContactStateLayout, dynamics: ChunkDynamics, workspace: Workspace
    ) -> Tensor:
        """Rows W^T [K | f], (columns + 1, r, B), for a basis W, (base rows + coupled joints, r, B), and f, (..., B).

        A wrench on body i does work on the base and on the joints above it only. Body i's columns of W^T K are thus
        A_i^T times its wrench columns, with A_i the sum over its path of the rows of W times the joints' screw axes.
        No joint row is ever formed. Columns are contiguous, as the factorization needs them.
        """
        tree, column_layout, inertial = self.tree, self.columns.layout, layout.inertial
        X = workspace.zeros("projected", W, len(layout.support) + 1, *W.shape[1:])
        torch.sum(W * f[:, None], dim=0, out=X[-1])
        moved = {body: index for index, (body, _, _) in enumerate(layout.moved)}
        own = W[self._index(tree.base_rows + position for _, position, _ in layout.moved)]
        own *= layout.ratios[:, None, None]
        velocity = dynamics.joints.velocity[self._index(moved)][:, None]
        friction = X[len(inertial) : len(inertial) + 2 * len(moved)].unflatten(0, (len(moved), 2))
        torch.mul(own, tree.coulomb_sign(velocity), out=friction[:, 0])
        torch.mul(own, velocity, out=friction[:, 1])

        path_sums = workspace.zeros("path_sums", W, 6, tree.n_nodes, *W.shape[1:])
        if tree.base_rows:
            path_sums[:, 0] = W[:6]
        for body in range(1, tree.n_nodes):
            parent = path_sums[:, tree.parents[body]]
            if body in moved:
                torch.addcmul(parent, dynamics.screw_axes[:, body, None], own[moved[body]], out=path_sums[:, body])
            else:
                path_sums[:, body] = parent
        for kept, bodies in column_layout.runs(layout.nodes):
            if kept:
                start, end = column_layout.starts[bodies.start], column_layout.starts[bodies.stop]
                shape = (len(bodies), len(kept))
                n_with_force = sum(column < parameters.INERTIA.start for column in kept)
                columns = X[start - inertial.start : end - inertial.start].unflatten(0, shape)
                wrenches = dynamics.wrenches[:, start:end].unflatten(1, shape)
                self._multiply_wrenches(wrenches, path_sums[:, bodies.start : bodies.stop], n_with_force, columns)
        return X

    @staticmethod
    def _multiply_wrenches(wrenches: Tensor, path_sums: Tensor, n_with_force: int, out: Tensor) -> None:
        """Write A^T w for wrench columns (6, L', c, B) into (L', c, r, B); the first `n_with_force` c have forces."""
        torch.mul(wrenches[3].unsqueeze(2), path_sums[3].unsqueeze(1), out=out)
        for k in (4, 5):
            out.addcmul_(wrenches[k].unsqueeze(2), path_sums[k].unsqueeze(1))
        for k in (0, 1, 2):
            out[:, :n_with_force].addcmul_(wrenches[k, :, :n_with_force].unsqueeze(2), path_sums[k].unsqueeze(1))

    def _contact_rows(self, layout: ContactStateLayout, kinematics: ChunkKinematics) -> tuple[Tensor, Tensor]:
        """Rows of J_C, unmeasured and measured, in base and coupled joints, (B, k, base rows + coupled joints)."""
        samples, base_rows = kinematics.screw_axes.shape[-1], self.tree.base_rows
        sizes = [sum(len(getattr(body, kind)) for body in layout.contact_bodies) for kind in ("unmeasured", "measured")]
        both = kinematics.screw_axes.new_zeros(sum(sizes), len(layout.row_std), samples)
        starts = [0, sizes[0]]
        for contact in layout.contact_bodies:
            joints = [layout.coupled_joints[index] for index in contact.joints]
            columns = [*range(base_rows), *(base_rows + index for index in contact.joints)]
            for kind, wrenches in enumerate((contact.unmeasured, contact.measured)):
                if len(wrenches):
                    at_base = wrenches_at_base(kinematics.states, contact.body, wrenches)
                    rows = generalized_forces(self.tree, kinematics.screw_axes, contact.body, at_base, joints)
                    target = both[starts[kind] : starts[kind] + len(wrenches)]
                    target.index_copy_(1, self._index(columns), rows)
                    starts[kind] += len(wrenches)
        return tuple(both.permute(2, 0, 1).split(sizes, dim=1))

    def _index(self, indices: Iterable[int]) -> Tensor:
        return self.tree.index(indices)

    def _measured_wrench(self, samples: Samples, layout: ContactStateLayout, kinematics: ChunkKinematics) -> Tensor:
        """Measured wrench components along the frames' axes, (B, k_m)."""
        components = [component for body in layout.contact_bodies for component in body.components]
        local = {
            contact: self.recorded_wrench(samples, contact, kinematics)
            for contact in {contact for contact, _ in components}
        }
        return torch.stack([local[contact][:, k] for contact, k in components], dim=1)
