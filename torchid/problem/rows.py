"""Whitened, projected rows of the linear problem, one contact state at a time, and the null spaces behind them.

Samples of one contact state become rows in three steps: their kinematics (`Chunk`), a basis W of the null space of
their unmeasured forces under which the noise is white (`null_bases.whitened_bases`), and blocks of `W^T [K | f]`
(`BlockRows`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from torch import Tensor, nn

from torchid.parameters import Array
from torchid.problem.contact_state import (
    ContactBody,
    ContactState,
    ContactStateLayout,
    ContactStateLayouts,
    MotorForces,
    RowBlock,
    RowColumns,
)
from torchid.problem.extras import (
    ExtraTerms,
    KnownTorques,
    NoiseGroups,
    contact_extra_column,
    dof_extra_column,
    list_extras,
)
from torchid.problem.motion import levelled_base_axes
from torchid.problem.null_bases import ContactRows, spread_columns, whitened_bases
from torchid.problem.samples import Samples
from torchid.regressor.columns import all_wrench_columns
from torchid.regressor.kinematics import BodyStates, JointMotion, body_states, joint_motion, joint_screw_axes
from torchid.regressor.regressor import (
    contact_arms,
    forces_at_base,
    generalized_forces,
    ground_axes,
    wrench_transform,
    wrenches_at_base,
)
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

if TYPE_CHECKING:
    from torchid.problem.compiled_rows import CompiledRows

EVERY = slice(None)


class Workspace:
    """Named, reused buffers of one worker (allocating large arrays takes as long as the arithmetic on them)."""

    def __init__(self) -> None:
        self._buffers: dict[str, Tensor] = {}

    def empty(self, name: str, like: Tensor, *shape: int) -> Tensor:
        """A contiguous array with arbitrary values, valid until the next request with this name."""
        buffer = self._buffers.get(name)
        size = math.prod(shape)
        if buffer is None or buffer.numel() < size or (buffer.dtype, buffer.device) != (like.dtype, like.device):
            buffer = self._buffers[name] = like.new_empty(size)
        return buffer[:size].view(shape)


class Workspaces:
    """Pool of workspaces for workers.

    The first access to new memory takes as long as one or two chunks.
    """

    def __init__(self) -> None:
        self._idle: list[Workspace] = []

    def take(self) -> Workspace:
        """Take one that nobody else uses until it is given back."""
        try:
            return self._idle.pop()  # no lock: one bytecode
        except IndexError:
            return Workspace()

    def give_back(self, workspace: Workspace) -> None:
        """Return one; its arrays are then no longer valid."""
        self._idle.append(workspace)


# ------------------------------------------------------------------------------------------------------ kinematics


@dataclass(frozen=True)
class Chunk:
    """B samples with their kinematics, for predictions, contact Jacobians and rows.

    Attributes:
        samples: on the device of the work.
        joints: motion of all joints.
        states: of the joint frames of all nodes.
        screw_axes: (6, L, B), see `joint_screw_axes`.
        rotation: (B, 3, 3), base to world; None if not recorded.
        arms: (3, 3, B) [m] by rolling contact, see `torchid.regressor.regressor.rolling_arms`.
        ground_axes: (3, 3, B) in base axes by contact with a scalar sensor, see
            `torchid.regressor.regressor.ground_axes`.
        wrenches: (6, columns, B), wrench at the base origin per unit of each inertial parameter; no columns in
            `RowBuilder.kinematics`. The zero forces of inertias may not be written, see `RowBuilder.dynamics`.
    """

    samples: Samples
    joints: JointMotion
    states: BodyStates
    screw_axes: Tensor
    rotation: Tensor | None
    arms: Mapping[int, Tensor]
    ground_axes: Mapping[int, Tensor]
    wrenches: Tensor

    def __len__(self) -> int:
        return len(self.samples)

    @property
    def resting(self) -> Tensor | None:
        """Joints whose torque counts as unmeasured, (n, B) bool, see `Samples`; or None."""
        return None if self.samples.resting is None else self.samples.resting.T

    def without_rest(self, forces: Tensor, base_rows: int, value: float = math.nan) -> Tensor:
        """Generalized forces (M, B, n_rows) with a given value in the rows of resting joints."""
        if self.resting is None:
            return forces
        at = nn.functional.pad(self.resting.T, (base_rows, forces.shape[2] - base_rows - len(self.resting)))
        return forces.masked_fill(at, value)

    def select(self, index: Tensor | slice) -> Self:
        """Select samples; a slice gives views."""
        if index == EVERY:
            return self
        return replace(
            self,
            samples=self.samples[index],
            joints=JointMotion(*(x[..., index] for x in vars(self.joints).values())),
            states=BodyStates(*(x[..., index] for x in vars(self.states).values())),
            screw_axes=self.screw_axes[..., index],
            rotation=None if self.rotation is None else self.rotation[index],
            arms={contact: arms[..., index] for contact, arms in self.arms.items()},
            ground_axes={contact: axes[..., index] for contact, axes in self.ground_axes.items()},
            wrenches=self.wrenches[..., index],
        )


# ------------------------------------------------------------------------------------------------------------- rows


@dataclass(frozen=True)
class BlockRows:
    """Rows of a block at B samples.

    `stacked`: (columns + 1, columns + 1 + r B), the rows by column, right-hand side last, after space for a factor.
    `values`: (columns + 1, r, B), the rows in it. `absent`: (r, B) bool, rows of zeros of samples with a further
    unmeasured torque; None without any.
    """

    block: RowBlock
    stacked: Tensor
    values: Tensor
    absent: Tensor | None = None


class RowBuilder(nn.Module):
    """Fast implementation of the fit's equations: rows of `W^T [K_columns | f]`.

    W is a basis of the span of V_x (see `torchid.Projection`) that whitens the projected sensor noise. The rows equal
    those of `torchid.Projection` applied to `torchid.Regressor` and `torchid.FrameJacobian`, up to a rotation of each
    sample's rows, in fewer columns (see `RowColumns`). Samples are processed one contact state at a time, so all shapes
    are constant. W^T multiplies the bodies' wrenches directly; K is never formed. Read the reference implementation
    first; `tests/problem/test_rows_two_ways.py` compares both.

    Attributes:
        frames: node of each contact, and the pose of the contact frame in the node's joint frame, (4, 4) [m].
        width: number of columns: those of the bodies' parameters, and one for each of `extras`.
        workspaces: reused buffers.
        noise_sources: group (of `noise_groups`) of each base row and each measured force.
        compiled: compiled kernels for `blocks`, see `torchid.problem.chunks.map_chunks`; None for torch.
        task_weights: (n_rows,), of the rows of K; None for equal weights.
    """

    task_weights: Tensor | None
    frame_rotation: Tensor
    frame_origin: Tensor
    frame_wrenches: Tensor
    normals: Tensor

    def __init__(
        self, robot: Robot, contacts: Sequence[Contact], sensors: SensorSet, terms: ExtraTerms | None = None
    ) -> None:
        """Build the constants.

        Args:
            robot: the robot.
            contacts: all contacts, in the order of the columns of `Samples.active`.
            sensors: which forces are measured, with their noise.
            terms: extra parameters; none by default.
        """
        super().__init__()
        terms = terms or ExtraTerms()
        self.extras = list_extras(robot, contacts, sensors, terms)
        self.known_torques = KnownTorques(robot, self.extras)
        self.motors = MotorForces(robot)
        self.tree = KinematicTree(robot, terms.sign_width, terms.stribeck)
        self.columns = RowColumns(self.tree)
        self.contacts = tuple(contacts)
        self.sensors = sensors
        self.noise_groups = NoiseGroups.of(robot)
        self.noise_sources = self.noise_groups.sources(contacts, sensors, self.tree.base_rows)
        self._layouts = ContactStateLayouts(robot, self.columns, contacts, sensors, self.extras)
        self.frames = self._layouts.frames
        self.width = self.columns.count + len(self.extras)
        self.dof_std = self._layouts.dof_std
        poses = np.array([pose for _, pose in self.frames]).reshape(-1, 4, 4)
        normals = np.array([contact.normal for contact in contacts], dtype=float).reshape(-1, 3)
        weights = sensors.task_weights
        self.register_buffer("frame_rotation", torch.from_numpy(poses[:, :3, :3].copy()), persistent=False)
        self.register_buffer("frame_origin", torch.from_numpy(poses[:, :3, 3].copy()), persistent=False)
        wrenches = np.array([wrench_transform(T).T for T in poses]).reshape(-1, 6, 6)
        self.register_buffer("frame_wrenches", torch.from_numpy(wrenches), persistent=False)
        self.register_buffer("normals", torch.from_numpy(normals), persistent=False)
        self.register_buffer("task_weights", None if weights is None else torch.from_numpy(weights), persistent=False)
        self.workspaces = Workspaces()
        self.compiled: CompiledRows | None = None

    def __repr__(self) -> str:
        return f"RowBuilder: {len(self.contacts)} contacts, {self.width} columns, {self.sensors!r}"

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RowBuilder:
        self._layouts.clear()  # their tensors are not buffers of the module
        self.workspaces = Workspaces()
        self.compiled = None
        super()._apply(fn, recurse)
        return self

    @property
    def device(self) -> torch.device:
        """Where the rows are computed."""
        return self.tree.ancestors.device

    def to_columns(self, phi: Array) -> Tensor:
        """Convert parameters (M, 12 L), or (M, 12 L + E) with values of the `extras`, to (M, width)."""
        rigid = self.columns.parameter_map
        extra = phi[:, rigid.shape[1] :] if phi.shape[1] > rigid.shape[1] else np.zeros((len(phi), len(self.extras)))
        return torch.from_numpy(np.hstack([phi[:, : rigid.shape[1]] @ rigid.T, extra])).to(self.device)

    def layout(self, state: ContactState, recorded_normals: bool = False) -> ContactStateLayout:
        """Layout of a contact state: its columns, coupled joints and directions, with or without recorded normals."""
        return self._layouts.layout(state, recorded_normals)

    def layout_of(self, samples: Samples, state: ContactState) -> ContactStateLayout:
        """Layout of samples that share a contact state."""
        return self._layouts.layout(state, samples.contact_normal is not None)

    # ------------------------------------------------------------------------------------------------- kinematics

    def kinematics(self, samples: Samples) -> Chunk:
        """Kinematics of samples."""
        motion = samples.motion()
        joints = joint_motion(self.tree, motion)
        states = body_states(self.tree, motion, joints)
        rotation = samples.base.rotation
        arms = {}
        axes = {}
        for index, contact in enumerate(self.contacts):
            if not (contact.radius or contact.along_normal):
                continue
            recorded = samples.contact_normal
            normal = self.normals[index].expand(len(samples), 3) if recorded is None else recorded[:, index]
            if rotation is not None:
                normal = (normal[:, None] @ rotation)[:, 0]
            if contact.radius:
                body = self.frames[index][0]
                in_joint = self.frame_rotation[index]
                arms[index] = contact_arms(states, body, in_joint, contact.radius, normal.T, contact.rolling_axis)
            if contact.along_normal:
                axes[index] = ground_axes(normal.T)
        screw_axes = joint_screw_axes(self.tree, states)
        return Chunk(samples, joints, states, screw_axes, rotation, arms, axes, screw_axes[:, :0])

    def dynamics(self, samples: Samples, workspace: Workspace | None = None, whole: bool = False) -> Chunk:
        """Kinematics of samples with `wrenches`; with a workspace, valid until the next call with the same workspace.

        `whole`: whether the zero forces of inertia columns are written too.
        """
        chunk = self.kinematics(samples)
        layout = self.columns.layout
        out = None
        if workspace is not None:
            out = workspace.empty("wrenches", chunk.screw_axes, 6, layout.count, len(samples))
            if whole:
                out[:3].zero_()
        return replace(chunk, wrenches=all_wrench_columns(chunk.states, layout, out))

    def unit_wrenches(self, chunk: Chunk, contact: int, components: Sequence[int], std: Array | None = None) -> Tensor:
        """Wrenches at the base origin, (6, k, B) [N, N m], for a unit of each of a contact's components, in order.

        `std`: (6,), values to use instead of a unit.
        """
        body = self.frames[contact][0]
        arms = chunk.arms.get(contact)
        axes = chunk.ground_axes.get(contact)
        in_frame = [k for k in components if axes is None or k >= 3]
        units = self.frame_wrenches[contact][self.tree.index(in_frame)]
        if std is not None:
            units = units * units.new_tensor(std[in_frame])[:, None]
        wrenches = wrenches_at_base(chunk.states, body, units, arms)
        if axes is None:
            return wrenches
        along = [k for k in components if k < 3]
        forces = axes[:, self.tree.index(along)]
        if std is not None:
            forces = forces * axes.new_tensor(std[along])[:, None]
        at_point = forces_at_base(chunk.states, body, self.frame_origin[contact], forces, arms)
        return torch.cat([at_point, wrenches], dim=1)

    def contact_jacobian(self, samples: Samples) -> Tensor:
        """Jacobians of all contacts along their frames' axes, active or not, (B, C, 6, n_rows).

        Linear velocities are those of the frames' origins, or of the material points where contacts roll. For scalar
        sensors they are along the axes of the ground.
        """
        chunk = self.kinematics(samples)
        joints = range(self.tree.n_dofs)
        J = chunk.screw_axes.new_zeros(len(samples), len(self.frames), 6, self.tree.n_rows)
        for contact, (body, _) in enumerate(self.frames):
            at_base = self.unit_wrenches(chunk, contact, range(6))
            J[:, contact] = generalized_forces(self.tree, chunk.screw_axes, body, at_base, joints).permute(2, 0, 1)
        return J

    def contact_rows(self, layout: ContactStateLayout, chunk: Chunk) -> ContactRows:
        """Unmeasured and measured rows of J_C for the bodies in contact and for loops."""
        tree = self.tree
        unmeasured = list[tuple[Tensor, Tensor]]()
        measured = list[tuple[Tensor, Tensor]]()
        for body in layout.contact_bodies:
            joints = [layout.coupled_joints[index] for index in body.joints]
            columns = tree.index([*range(tree.base_rows), *(tree.base_rows + index for index in body.joints)])
            for wrenches, parts in (
                (self._unmeasured_wrenches(body, chunk), unmeasured),
                (self._measured_wrenches(body, chunk), measured),
            ):
                if wrenches is not None:
                    forces = generalized_forces(tree, chunk.screw_axes, body.body, wrenches, joints)
                    parts.append((forces, columns))
        for loop in layout.loops:
            columns = tree.index(tree.base_rows + index for index in loop.joints)
            unmeasured.append((loop.forces(tree, chunk.states, chunk.screw_axes), columns))
        like = chunk.screw_axes[0, :1].expand(len(layout.row_std), -1)
        return ContactRows(unmeasured, spread_columns(measured, like))

    def _unmeasured_wrenches(self, body: ContactBody, chunk: Chunk) -> Tensor | None:
        """Unmeasured wrenches on a body at the base origin, (6, count, B); of more, a basis of what they span.

        Where they span less at some sample, the basis has directions too many: it costs equations, but lets no
        unmeasured force in.
        """
        if not body.unmeasured:
            return None
        if body.span is not None:
            return wrenches_at_base(chunk.states, body.body, body.span)
        at_base = torch.cat([self.unit_wrenches(chunk, *unmeasured) for unmeasured in body.unmeasured], dim=1)
        if at_base.shape[1] == body.count:
            return at_base
        Vh: Tensor = torch.linalg.svd(at_base.permute(2, 1, 0), full_matrices=False).Vh
        return Vh[:, : body.count].permute(2, 1, 0)

    def _measured_wrenches(self, body: ContactBody, chunk: Chunk) -> Tensor | None:
        """Units of the measured components of the contacts of a body, (6, k, B)."""
        if not body.measured:
            return None
        components: dict[int, list[int]] = {}
        for contact, k in body.measured:
            components.setdefault(contact, []).append(k)
        return torch.cat([self.unit_wrenches(chunk, *chosen) for chosen in components.items()], dim=1)

    # ------------------------------------------------------------------------------------------------- null spaces

    def null_space_bases(self, state: ContactState, chunk: Chunk) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """Orthonormal V_x, (B', base rows + coupled joints, r), with the indices of the samples, grouped by rank."""
        layout = self.layout_of(chunk.samples, state)
        alike = replace(layout, row_std=torch.ones_like(layout.row_std), wrench_std=layout.wrench_std[:0])
        rows = self.contact_rows(layout, chunk)
        bare = ContactRows(rows.unmeasured, rows.measured[:0])
        order = self.tree.index(layout.blocks.order)
        for index, V in whitened_bases(alike, bare, None, order):
            yield index, V.permute(2, 0, 1)

    def whitened_bases(
        self, layout: ContactStateLayout, rows: ContactRows, chunk: Chunk
    ) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """W, (base rows + coupled joints, r, B'), with the indices of the samples, grouped by rank.

        Task weights D multiply the errors K phi - f. With W' the basis for the unmeasured rows A_x D, W = D W' removes
        the unmeasured forces, and W W^T = D W' W'^T D. The sum of squares is then the least, over all unmeasured forces
        x, of (K phi - f - A_x^T x)^T D S^-1 D (K phi - f - A_x^T x), with S the noise covariance.

        Source: Mistry, Schaal, Yamane 2009, IV-E; weighted least squares with nuisance parameters.
        """
        axes = self.noise_axes(chunk.rotation, self.sensors.noise)
        order = self.tree.index(layout.blocks.order)
        resting = self.coupled_at_rest(layout, chunk)
        if self.task_weights is None:
            yield from whitened_bases(layout, rows, axes, order, resting)
            return
        D = self.task_weights[self._coupled_dofs(layout)]
        weighted = ContactRows([(part * D[at, None], at) for part, at in rows.unmeasured], rows.measured)
        for index, W in whitened_bases(layout, weighted, axes, order, resting):
            yield index, W * D[:, None, None]

    def coupled_at_rest(self, layout: ContactStateLayout, chunk: Chunk) -> Tensor | None:
        """Coupled joints at rest, whose torque counts as unmeasured, (k, B); None without any."""
        resting = chunk.resting
        if resting is None or not layout.coupled_joints:
            return None
        in_limbs = resting.new_zeros(self.tree.n_dofs - len(resting), resting.shape[1])
        return torch.cat([resting, in_limbs])[self.tree.index(layout.coupled_joints)]

    def noise_axes(self, rotation: Tensor | None, noise: SensorNoise | None = None) -> Tensor | None:
        """Axes of the stated noise of the base rows, (B, 3, 3); None for those of the base."""
        if rotation is None or not self.tree.base_rows or (noise and not noise.base_axes_differ):
            return None
        return levelled_base_axes(rotation)

    def _coupled_dofs(self, layout: ContactStateLayout) -> Tensor:
        """Which rows of the dynamics the base rows and coupled joints are, (base rows + coupled joints,) int64."""
        base = self.tree.base_rows
        return self.tree.index([*range(base), *(base + joint for joint in layout.coupled_joints)])

    # ---------------------------------------------------------------------------------------------- measured forces

    def recorded_wrench(self, chunk: Chunk, contact: int) -> Tensor:
        """Recorded wrench of a contact along the axes of its components, (B, 6) [N, N m], NaN where not recorded."""
        samples = chunk.samples
        if samples.wrench is None:
            return samples.time.new_full((len(samples), 6), torch.nan)
        wrench = samples.wrench[:, contact]
        if not samples.wrench_in_world or self.contacts[contact].along_normal:
            return wrench
        return self._in_contact_frame(chunk, contact, wrench)

    def _in_contact_frame(self, chunk: Chunk, contact: int, wrench: Tensor) -> Tensor:
        """Wrenches along the world's axes, (B, 6) [N, N m], along those of a contact's frame, about its origin.

        A fixed base of which no pose was recorded is the world. Moments are about the origin already where the
        position of the base is not known.
        """
        node = self.frames[contact][0]
        position = chunk.samples.base.position
        rotation = chunk.states.rotation[:, :, node].permute(2, 0, 1)
        force, moment = wrench.unflatten(1, (2, 3)).unbind(1)
        if position is not None:
            arm = chunk.states.position[:, node].T + rotation @ self.frame_origin[contact]
            arm = arm if chunk.rotation is None else (chunk.rotation @ arm[..., None])[..., 0]
            moment = moment - torch.linalg.cross(position + arm, force)
        axes = rotation @ self.frame_rotation[contact]
        axes = axes if chunk.rotation is None else chunk.rotation @ axes
        return (axes.mT @ torch.stack([force, moment], dim=2)).mT.flatten(1)

    def recorded_torque(self, samples: Samples) -> Tensor:
        """Recorded joint torques and limb sensor wrenches, (B, n + 6 F) [N m, N], NaN where not recorded."""
        if samples.torque is None:
            return samples.time.new_full((len(samples), self.tree.n_dofs), torch.nan)
        return samples.torque

    def torque_of_bodies(self, samples: Samples) -> Tensor:
        """Recorded torques and wrenches minus the torques of known armatures and springs, (B, n + 6 F) [N m, N]."""
        torque = self.recorded_torque(samples)
        return torque if self.known_torques.none else torque - self.known_torques.of(samples)

    def coupled_forces(self, samples: Samples, layout: ContactStateLayout) -> Tensor:
        """Zeros for the base, then measured torques of coupled joints, (B, base rows + coupled joints) [N m, N]."""
        torque = self.torque_of_bodies(samples)[:, self.tree.index(layout.coupled_joints)]
        return nn.functional.pad(torque, (self.tree.base_rows, 0))

    def coupled_forces_with_contacts(self, layout: ContactStateLayout, rows: ContactRows, chunk: Chunk) -> Tensor:
        """As `coupled_forces`, with the measured forces of contacts."""
        forces = self.coupled_forces(chunk.samples, layout)
        if not layout.measured:
            return forces
        wrenches = {
            contact: self.recorded_wrench(chunk, contact) for contact in {contact for contact, _ in layout.measured}
        }
        measured = torch.stack([wrenches[contact][:, k] for contact, k in layout.measured], dim=1)
        return forces + (rows.measured.permute(2, 1, 0) @ measured[..., None])[..., 0]

    # -------------------------------------------------------------------------------------------------------- rows

    def rows(
        self, samples: Samples, state: ContactState, workspace: Workspace | None = None
    ) -> Iterator[tuple[tuple[int, ...], Tensor]]:
        """Blocks of rows for samples that share a contact state. No gradient flows through reused buffers.

        Yields:
            (columns, rows): rows are (M, len(columns) + 1), right-hand side last, valid until the next item.
        """
        for rows, _ in self.blocks(samples, state, workspace):
            support = rows.block.support
            yield support, rows.stacked.T[len(support) + 1 :]

    def blocks(
        self, samples: Samples, state: ContactState, workspace: Workspace | None = None
    ) -> Iterator[tuple[BlockRows, Tensor | slice]]:
        """As `rows`, as `BlockRows` with the samples of each block, in order."""
        workspace = workspace or Workspace()
        layout = self.layout_of(samples, state)
        if self.compiled is not None and (compiled := self.compiled.chunk(samples, layout, workspace)) is not None:
            yield from compiled.rows()
            return
        chunk = self.dynamics(samples, workspace)
        for index, _, blocks in self._coupled_rows(layout, chunk, workspace):
            yield from ((rows, index) for rows in blocks)
        yield from ((rows, EVERY) for _, _, rows in self._uncoupled_rows(layout, chunk, workspace))

    def rows_by_sample(self, samples: Samples, state: ContactState) -> tuple[Tensor, Tensor]:
        """As `rows`, sample by sample.

        Returns:
            `W^T [K | f]`, (B, n_rows, width + 1), padded with rows of zeros, and W, (B, n_rows, n_rows).
        """
        layout = self.layout_of(samples, state)
        chunk = self.dynamics(samples)
        n_rows = self.tree.n_rows
        rows = samples.time.new_zeros(len(samples), n_rows, self.width + 1)
        W = samples.time.new_zeros(len(samples), n_rows, n_rows)
        dofs = self._coupled_dofs(layout)
        workspace = Workspace()
        every = torch.arange(len(samples), device=self.device)
        for index, basis, blocks in self._coupled_rows(layout, chunk, workspace):
            sample = every[index][:, None, None]
            for part in blocks:
                slots = torch.arange(part.block.rows.start, part.block.rows.stop, device=self.device)
                support = self.tree.index([*part.block.support, self.width])
                rows[sample, slots[:, None], support] = part.values.permute(2, 1, 0)
            W[sample, dofs[:, None], torch.arange(basis.shape[1], device=self.device)] = basis.permute(2, 0, 1)
        uncoupled = self._uncoupled_rows(layout, chunk, workspace)
        for slot, (joint, weight, part) in enumerate(uncoupled, start=len(dofs)):
            rows[:, slot, self.tree.index([*part.block.support, self.width])] = part.values[:, 0].T
            W[:, self.tree.base_rows + joint, slot] = weight
        return rows, W

    def _coupled_rows(
        self, layout: ContactStateLayout, chunk: Chunk, workspace: Workspace
    ) -> Iterator[tuple[Tensor | slice, Tensor, Iterator[BlockRows]]]:
        """Samples of one rank, their W, (base rows + coupled joints, r, B'), and their rows, block by block."""
        if not len(layout.row_std):
            return
        rows = self.contact_rows(layout, chunk)
        forces = self.coupled_forces_with_contacts(layout, rows, chunk)
        places = {joint: row for row, joint in enumerate(layout.coupled_joints, start=self.tree.base_rows)}
        for index, W in self.whitened_bases(layout, rows, chunk):
            part = chunk.select(index)
            f = forces[index].T
            measured = dict(zip(layout.measured, rows.measured[..., index], strict=True))
            yield (
                index,
                W,
                (
                    self._block_rows(block, W[:, block.rows], f, part, places, measured, self.tree.base_rows, workspace)
                    for block in layout.blocks.of_rank(W.shape[1])
                ),
            )

    def _uncoupled_rows(
        self, layout: ContactStateLayout, chunk: Chunk, workspace: Workspace
    ) -> Iterator[tuple[int, Tensor, BlockRows]]:
        """Uncoupled joints, W of each, (B,) [1 / N m], and its row."""
        torque = self.torque_of_bodies(chunk.samples)
        resting = chunk.resting
        for joint, block in layout.uncoupled_joints.items():
            weighted = 1.0 if self.task_weights is None else float(self.task_weights[self.tree.base_rows + joint])
            weight = torque.new_full((len(chunk),), weighted / self.dof_std[joint])
            if resting is not None and joint < len(resting):
                weight.masked_fill_(resting[joint], 0.0)
            f = torque[:, joint][None]
            yield joint, weight, self._block_rows(block, weight[None, None], f, chunk, {joint: 0}, {}, 0, workspace)

    def _block_rows(
        self,
        block: RowBlock,
        W: Tensor,
        f: Tensor,
        chunk: Chunk,
        places: Mapping[int, int],
        measured: Mapping[tuple[int, int], Tensor],
        base_rows: int,
        workspace: Workspace,
    ) -> BlockRows:
        """Rows `W^T [K | f]` of a block.

        Args:
            block: of the rows.
            W: (m, r, B), its columns for them.
            f: (m, B), measured forces.
            chunk: of the samples, with `wrenches`.
            places: of joints among the m degrees of freedom.
            measured: rows of measured components of contacts, (m, B), by contact and component.
            base_rows: how many of the m are those of the base.
            workspace: that the rows are written to.
        """
        width = len(block.support) + 1
        (_, r, samples) = W.shape
        stacked = workspace.empty("rows", W, width, width + r * samples)
        rows = stacked[:, width:].unflatten(1, (r, samples))
        torch.sum(W * f[:, None], dim=0, out=rows[-1])
        self._project(block, W, base_rows, chunk, rows, workspace)
        subtract_payload(block, rows, chunk.samples.payload, self.columns.parameter_map)
        for column, out in zip(block.extras, rows[len(block.inertial) + len(block.friction) : -1], strict=True):
            extra = self.extras[column - self.columns.count]
            out.zero_()
            for dof in extra.dofs:
                if dof in places:
                    out.addcmul_(W[places[dof]], dof_extra_column(extra, dof, chunk.samples, self.tree))
            for contact, axis in extra.contacts:
                reading = contact_extra_column(extra, chunk.samples, contact, axis)
                for k, along in self._along_components(chunk, contact, axis).items():
                    if (contact, k) in measured:
                        out.addcmul_((W * measured[contact, k][:, None]).sum(0), along * reading)
        return BlockRows(block, stacked, rows, None if chunk.resting is None else ~W.any(0))

    def _along_components(self, chunk: Chunk, contact: int, axis: int) -> dict[int, Tensor | float]:
        """What a unit along a recorded axis of a contact's wrench is along its components, (B,) or a number each."""
        if not chunk.samples.wrench_in_world or self.contacts[contact].along_normal:
            return {axis: 1.0}
        unit = chunk.screw_axes.new_zeros(len(chunk), 6)
        unit[:, axis] = 1.0
        return dict(enumerate(self._in_contact_frame(chunk, contact, unit).unbind(1)))

    def _project(
        self, block: RowBlock, W: Tensor, base_rows: int, chunk: Chunk, X: Tensor, workspace: Workspace
    ) -> None:
        """Write the columns W^T K of some rows X, (columns, r, B), the first ones, but not those of extra parameters.

        A wrench on body i does work on the base and on the joints above it only. Body i's columns of W^T K are thus
        A_i^T times its wrench columns, with A_i the sum over its path of the rows of W times the joints' screw axes. No
        joint row is ever formed. Columns are contiguous, as the factorization needs them.
        """
        torques = _moved_rows(block, W[base_rows:])
        nodes = self.tree.index(node for node, *_ in block.moved)
        friction = X[len(block.inertial) :][: 2 * len(nodes)].unflatten(0, (len(nodes), 2))
        torch.mul(torques, chunk.joints.direction[nodes, None], out=friction[:, 0])
        torch.mul(torques, chunk.joints.velocity[nodes, None], out=friction[:, 1])

        first = int(block.base != "none")
        path_sums = workspace.empty("path_sums", W, 6, first + len(nodes), *W.shape[1:])
        if first:
            path_sums[:, 0] = W[:base_rows]
        for number, (node, _, _, above) in enumerate(block.moved):
            screw_axis = chunk.screw_axes[:, node, None]
            path_sum = path_sums[:, first + number]
            if above is None:
                torch.mul(screw_axis, torques[number], out=path_sum)
            else:
                torch.addcmul(path_sums[:, above], screw_axis, torques[number], out=path_sum)
        start = 0
        for run in block.nodes:
            end = start + len(run.nodes) * len(run.kept)
            columns = chunk.wrenches[:, run.columns.start : run.columns.stop].unflatten(1, (-1, len(run.all_kept)))
            _multiply_wrenches(
                columns[:, :, : len(run.kept)],
                path_sums[:, run.sources.start : run.sources.stop],
                run.n_with_force,
                X[start:end].unflatten(0, (len(run.nodes), len(run.kept))),
            )
            start = end


def _moved_rows(block: RowBlock, W_joints: Tensor) -> Tensor:
    """Rows of the basis, (joints, r, B), at each node that a block moves, times the motion's ratio, (moved, r, B)."""
    moved = [(joint, ratio) for _, joint, ratio, _ in block.moved]
    first = moved[0][0] if moved else 0
    if moved == [(joint, 1.0) for joint in range(first, first + len(moved))]:
        return W_joints[first : first + len(moved)]
    return torch.stack([ratio * W_joints[joint] for joint, ratio in moved])


def _multiply_wrenches(wrenches: Tensor, path_sums: Tensor, n_with_force: int, out: Tensor) -> None:
    """Write A^T w for wrench columns (6, L', c, B) into (L', c, r, B); the first `n_with_force` c have forces.

    `path_sums`: (6, L', r, B), or (6, 1, r, B) if they are the same for all bodies.
    """
    torch.mul(wrenches[3].unsqueeze(2), path_sums[3].unsqueeze(1), out=out)
    for k in (4, 5):
        out.addcmul_(wrenches[k].unsqueeze(2), path_sums[k].unsqueeze(1))
    for k in (0, 1, 2):
        out[:, :n_with_force].addcmul_(wrenches[k, :, :n_with_force].unsqueeze(2), path_sums[k].unsqueeze(1))


def subtract_payload(block: RowBlock, rows: Tensor, payload: Array | None, parameter_map: Array) -> None:
    """Take what a payload needs off the right-hand side of rows: W^T f becomes W^T (f - K payload).

    Readings keep their columns of scales and offsets: the payload is known as it is, whatever a sensor reads.

    Args:
        block: of the rows.
        rows: (columns + 1, r, B), the right-hand side last.
        payload: (12 L,), None for nothing.
        parameter_map: (columns, 12 L), of all columns but those of extra parameters.
    """
    if payload is not None:
        known = [*block.inertial, *block.friction]
        added = torch.from_numpy(parameter_map[known] @ payload).to(rows)
        rows[-1] -= torch.tensordot(added, rows[: len(known)], dims=1)
