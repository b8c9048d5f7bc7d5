"""Whitened, projected rows of the linear problem, one contact state at a time, and the null spaces behind them."""

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
    ContactState,
    ContactStateLayout,
    ContactStateLayouts,
    FramePoses,
    MotorForces,
    RowColumns,
    wrenches_at_ground,
)
from torchid.problem.extras import ExtraTerms, KnownTorques, NoiseGroups, dof_extra_column, extra_columns, list_extras
from torchid.problem.motion import levelled_base_axes
from torchid.problem.row_blocks import (
    RowBlock,
    moved_rows,
    multiply_wrenches,
    subtract_payload,
    triangularize_base_rows,
)
from torchid.problem.samples import Samples
from torchid.regressor.columns import all_wrench_columns
from torchid.regressor.kinematics import BodyStates, JointMotion, body_states, joint_motion, joint_screw_axes
from torchid.regressor.regressor import (
    forces_at_base,
    generalized_forces,
    wrench_transform,
    wrenches_at_base,
)
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.rounding import KINEMATIC_TOLERANCE, relative_tolerance
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.limbs import limb_null_space
from torchid.sensing.projection import any_suspect, null_space, whitened_null_space

if TYPE_CHECKING:
    from torchid.problem.compiled_rows import CompiledRows


class Workspace:
    """Named buffers of one worker, reused: fresh memory for large arrays takes as long as the arithmetic on them."""

    def __init__(self) -> None:
        self._buffers: dict[str, Tensor] = {}

    def empty(self, name: str, like: Tensor, *shape: int) -> Tensor:
        """A contiguous array with arbitrary values, valid until the next request with this name."""
        buffer, size = self._buffers.get(name), math.prod(shape)
        if buffer is None or buffer.numel() < size or (buffer.dtype, buffer.device) != (like.dtype, like.device):
            buffer = self._buffers[name] = like.new_empty(size)
        return buffer[:size].view(shape)


class Workspaces:
    """Workspaces of workers that come and go: what one has given back, the next one takes.

    The first touch of so much memory takes as long as a chunk or two.
    """

    def __init__(self) -> None:
        self._idle: list[Workspace] = []

    def take(self) -> Workspace:
        """One that nobody else has until it is given back."""
        try:
            return self._idle.pop()  # no lock: one bytecode
        except IndexError:
            return Workspace()

    def give_back(self, workspace: Workspace) -> None:
        """Leave one to others; what was read from it is then no longer valid."""
        self._idle.append(workspace)


@dataclass(frozen=True)
class ChunkKinematics:
    """Kinematics of B samples, from which predictions and contact Jacobians are computed.

    Attributes:
        joints: motion of all joints.
        states: of the joint frames of all nodes.
        screw_axes: (6, L, B), see `joint_screw_axes`.
        rotation_world_base: (B, 3, 3), None where it was not recorded.
        arms: (3, 3, B) [m] by rolling contact, see `torchid.regressor.regressor.rolling_arms`.
        recorded_normals: whether each of these has normals of its own.
        ground_axes: (3, 3, B) in base axes by contact that is read along the ground's normal, see
            `torchid.regressor.regressor.ground_axes`.
        resting: (n, B) bool, joints whose torque counts as unmeasured, see `Samples`; None for none.
    """

    joints: JointMotion
    states: BodyStates
    screw_axes: Tensor
    rotation_world_base: Tensor | None
    arms: Mapping[int, Tensor]
    recorded_normals: bool
    ground_axes: Mapping[int, Tensor]
    resting: Tensor | None

    def without_rest(self, forces: Tensor, base_rows: int, value: float = math.nan) -> Tensor:
        """Generalized forces (M, B, n_rows) with a value in the rows of joints at rest."""
        if self.resting is None:
            return forces
        at = nn.functional.pad(self.resting.T, (base_rows, forces.shape[2] - base_rows - len(self.resting)))
        return forces.masked_fill(at, value)

    def select(self, index: Tensor | slice) -> Self:
        """Those of some samples; views by a slice."""
        if index == slice(None):
            return self

        def pick(x: Tensor) -> Tensor:
            return x[..., index]

        return replace(
            self,
            joints=JointMotion(*map(pick, vars(self.joints).values())),
            states=BodyStates(*map(pick, vars(self.states).values())),
            screw_axes=pick(self.screw_axes),
            rotation_world_base=None if self.rotation_world_base is None else self.rotation_world_base[index],
            arms={contact: pick(arms) for contact, arms in self.arms.items()},
            ground_axes={contact: pick(axes) for contact, axes in self.ground_axes.items()},
            resting=None if self.resting is None else pick(self.resting),
        )


@dataclass(frozen=True)
class ChunkDynamics(ChunkKinematics):
    """Kinematics of B samples with the columns of the inertial parameters, from which rows are computed.

    Attributes:
        wrenches: (6, columns, B), wrench at the base origin of a unit of each inertial parameter; the forces of
            inertias, which are zero, need not have been written, see `RowBuilder.dynamics`.
    """

    wrenches: Tensor

    def select(self, index: Tensor | slice) -> Self:
        """Those of some samples; views by a slice."""
        return replace(super().select(index), wrenches=self.wrenches[..., index])


@dataclass(frozen=True)
class ChunkPart:
    """Samples of one rank: their generalized forces f, (base rows + coupled joints, B), and measured contact rows."""

    samples: Samples
    f: Tensor
    measured: Tensor
    dynamics: ChunkDynamics


@dataclass(frozen=True)
class BlockRows:
    """Rows of a block at B samples.

    `stacked`: (columns + 1, columns + 1 + r B), the rows by column, the right-hand side last, after room for a factor;
    `values`: (columns + 1, r, B), the rows in it. `absent`: (r, B) bool, rows of zeros, which a sample has not, as one
    torque more is unmeasured there; None if all are there.
    """

    block: RowBlock
    stacked: Tensor
    values: Tensor
    absent: Tensor | None

    @classmethod
    def empty(
        cls, block: RowBlock, rows: int, like: Tensor, workspace: Workspace, absent: Tensor | None = None
    ) -> BlockRows:
        """Memory for so many rows at each of the samples of a tensor (..., B)."""
        width, samples = len(block.support) + 1, like.shape[-1]
        stacked = workspace.empty("rows", like, width, width + rows * samples)
        return cls(block, stacked, stacked[:, width:].unflatten(1, (rows, samples)), absent)


@dataclass(frozen=True)
class ContactRows:
    """Rows of J_C of the bodies in contact, each in the base rows and the joints that move its body, and of loops.

    Attributes:
        unmeasured, measured: (k, base rows + own joints, B) of each body that has any, then of loops, without the base.
        unmeasured_columns, measured_columns: where these are among base rows and coupled joints, (columns,) int64 each.
        width: number of base rows and coupled joints.
        like: a tensor of the rows' type, (..., B).
    """

    unmeasured: Sequence[Tensor]
    measured: Sequence[Tensor]
    unmeasured_columns: Sequence[Tensor]
    measured_columns: Sequence[Tensor]
    width: int
    like: Tensor

    def of_unmeasured(self, index: Tensor | slice) -> Tensor:
        """All unmeasured rows of some samples, (B', k, base rows + coupled joints)."""
        parts = [part[..., index] for part in self.unmeasured]
        return _together(parts, self.unmeasured_columns, self.width, self.like[..., index]).permute(2, 0, 1)

    def of_measured(self) -> Tensor:
        """All measured rows, (k, base rows + coupled joints, B)."""
        return _together(self.measured, self.measured_columns, self.width, self.like)


def _together(parts: Sequence[Tensor], columns: Sequence[Tensor], width: int, like: Tensor) -> Tensor:
    rows, start = like.new_zeros(sum(map(len, parts)), width, like.shape[-1]), 0
    for part, at in zip(parts, columns, strict=True):
        rows[start : start + len(part)].index_copy_(1, at, part)
        start += len(part)
    return rows


def contact_rows(
    tree: KinematicTree, layout: ContactStateLayout, kinematics: ChunkKinematics, origin: Callable[[int], Tensor]
) -> ContactRows:
    """The rows at B samples.

    Args:
        tree: the robot's constants.
        layout: of the samples' contact state.
        kinematics: of the samples.
        origin: of a contact frame in its node's joint frame, (3,) [m].
    """
    rows: tuple[list[Tensor], list[Tensor]] = ([], [])
    columns: tuple[list[Tensor], list[Tensor]] = ([], [])
    for contact in layout.contact_bodies:
        joints = [layout.coupled_joints[index] for index in contact.joints]
        own = tree.index([*range(tree.base_rows), *(tree.base_rows + index for index in contact.joints)])
        counts = contact.count, len(contact.components)
        for kind, parts in enumerate((contact.unmeasured, contact.measured)):
            if parts:
                at_base = wrenches_at_ground(parts, counts[kind], kinematics, contact.body, origin)
                rows[kind].append(generalized_forces(tree, kinematics.screw_axes, contact.body, at_base, joints))
                columns[kind].append(own)
    for loop in layout.loops:
        rows[0].append(loop.forces(tree, kinematics))
        columns[0].append(tree.index(tree.base_rows + index for index in loop.joints))
    return ContactRows(*rows, *columns, len(layout.row_std), kinematics.screw_axes)


def orthonormal_bases(
    layout: ContactStateLayout, rows: ContactRows, order: Tensor
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Orthonormal bases V of the null spaces of the unmeasured rows, grouped by rank; arguments as `whitened_bases`.

    Yields:
        (index of the samples, V): V is (B', m, r).
    """
    if not layout.has_own_limbs:
        yield from null_space(rows.of_unmeasured(slice(None)))
        return
    alike = replace(layout, row_std=torch.ones_like(layout.row_std), wrench_std=layout.wrench_std[:0])
    nothing = rows.like.new_empty(0, rows.width, rows.like.shape[-1])
    for index, W in whitened_bases(alike, rows, nothing, None, order):
        yield index, W.permute(2, 0, 1)


def whitened_bases(
    layout: ContactStateLayout,
    rows: ContactRows,
    measured: Tensor,
    axes: Tensor | None,
    order: Tensor,
    resting: Tensor | None = None,
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Bases W of the null spaces of the unmeasured rows under which the projected noise is white, grouped by rank.

    Args:
        layout: of the samples' contact state.
        rows: of the samples.
        measured: (k, m, B), those that are measured.
        axes: (B, 3, 3) or None, as of `whitened_null_space`.
        order: (m,), as of `whitened_null_space`.
        resting: (joints, B), coupled joints whose torque is unmeasured at a sample; None for none.

    Yields:
        (index of the samples, W): W is (m, r, B'), triangular where the layout says so, with a column of zeros for each
        row that a sample loses by `resting`.
    """
    if resting is None:
        yield from _measured_bases(layout, rows, measured, axes, order)
        return
    base, alone = rows.width - len(resting), not rows.unmeasured
    if alone:  # W is triangular, and stays so: noise of contacts then links no resting joint to others
        measured = torch.cat([measured[:, :base], measured[:, base:].masked_fill(resting, 0.0)], dim=1)
    for index, W in _measured_bases(layout, rows, measured, axes, order):
        own = resting[:, index]
        if alone:
            W[base:].masked_fill_(own[:, None], 0.0)
        else:
            leave_out_torques(W, own, layout.row_std)
            if layout.blocks.has_triangular_base:
                triangularize_base_rows(W)
        yield index, W


def leave_out_torques(W: Tensor, resting: Tensor, row_std: Tensor | None = None) -> None:
    """Make rows of bases zero in place, of joints whose torque is one more unmeasured force.

    What is left of the span of W is orthogonal to `W^T e_j` of each such joint j. A reflection from the right, which
    keeps the noise white, turns that direction into the first column that is not zero yet, which then becomes zero:
    shapes are the same for all samples, whatever rests. Where `W^T e_j` is rounding, no row had a torque of j.

    Args:
        W: (base rows + joints, r, B).
        resting: (joints, B) bool.
        row_std: (base rows + joints,), noise that W is divided by; None for 1.
    """
    base, columns = len(W) - len(resting), torch.arange(W.shape[1], device=W.device)[:, None]
    least = relative_tolerance(KINEMATIC_TOLERANCE, W.shape[:2], torch.finfo(W.dtype).eps)
    left_out = resting.new_zeros(resting.shape[1], dtype=torch.int64)
    for joint, rests in enumerate(resting, start=base):
        if W.device.type == "cpu" and not rests.any():
            continue
        size = torch.linalg.vector_norm(W[joint], dim=0)
        rests = rests & (size > (least if row_std is None else least / row_std[joint]))
        v = W[joint] * rests
        target = (columns == left_out) & rests
        v += target * torch.copysign(size, v)
        length = (v * v).sum(0)
        W.addcmul_((W * v).sum(1, keepdim=True), v * torch.where(length > 0.0, 2.0 / length, 0.0), value=-1)
        W.masked_fill_(target, 0.0)
        left_out += rests
    W[base:].masked_fill_(resting[:, None], 0.0)


def _measured_bases(
    layout: ContactStateLayout, rows: ContactRows, measured: Tensor, axes: Tensor | None, order: Tensor
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """As `whitened_bases`, of joints whose torque is measured at every sample."""
    if not layout.has_own_limbs:
        yield from general_bases(layout, rows, slice(None), measured, axes, order)
        return
    joints = [columns[6:] - 6 for columns in rows.unmeasured_columns]
    W, suspect = limb_null_space(rows.unmeasured, joints, layout.row_std, measured, layout.wrench_std, axes)
    lost: list[tuple[Tensor, Tensor]] = []
    if any_suspect(suspect):
        doubtful = torch.nonzero(suspect)[:, 0]
        some_axes = None if axes is None else axes[doubtful]
        for index, basis in general_bases(layout, rows, doubtful, measured[..., doubtful], some_axes, order):
            if basis.shape[1] == W.shape[1]:
                W[..., doubtful[index]] = basis
            else:
                lost.append((doubtful[index], basis))
    if not lost:
        yield slice(None), W
        return
    suspect.fill_(False)
    for index, _ in lost:
        suspect[index] = True
    regular = torch.nonzero(~suspect)[:, 0]
    if len(regular):
        yield regular, W[..., regular]
    yield from lost


def general_bases(
    layout: ContactStateLayout,
    rows: ContactRows,
    index: Tensor | slice,
    measured: Tensor,
    axes: Tensor | None,
    order: Tensor,
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """The same by decompositions of all rows together; `measured` and `axes` are those of the samples in question."""
    A, J_m = rows.of_unmeasured(index), measured.permute(2, 0, 1)
    for part, basis in whitened_null_space(A, layout.row_std, J_m, layout.wrench_std, axes, order):
        W = basis.permute(1, 2, 0).contiguous()
        if layout.blocks.has_triangular_base:
            triangularize_base_rows(W)
        yield part, W


class RowBuilder(nn.Module):
    """Rows of `W^T [K_columns | f]`: W a basis of V_x's span under which the projected sensor noise is white.

    The fast implementation of the equations that `torchid.Projection` computes from `torchid.Regressor` and
    `torchid.FrameJacobian`, up to a rotation of each sample's rows, in fewer columns (see `RowColumns`). It shares
    their functions in `torchid.regressor` and `torchid.sensing.projection`, but processes samples one contact state
    at a time, where all shapes are constant, and multiplies W^T with the bodies' wrenches without forming K.
    `tests/problem/test_rows_two_ways.py` compares both; read the reference implementation first.

    `frames`: node of each contact, and the pose of the contact frame in the node's joint frame, (4, 4) [m]. `width`:
    number of columns, those of the bodies' parameters and one for each of `extras`. `workspaces`: of passes over rows.
    `noise_sources`: of `noise_groups`, the group of each base row and of each measured force. `compiled`: kernels that
    `blocks` takes its rows from, see `torchid.problem.chunks.map_chunks`; None for torch's. `task_weights`: of the
    rows of K, (n_rows,); None for all alike.
    """

    task_weights: Tensor | None

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
        weights = sensors.task_weights
        own = None if weights is None else torch.from_numpy(weights)
        self.register_buffer("task_weights", own, persistent=False)
        self.workspaces = Workspaces()
        self.compiled: CompiledRows | None = None

    def __repr__(self) -> str:
        return f"RowBuilder: {len(self.contacts)} contacts, {self.width} columns, {self.sensors!r}"

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> RowBuilder:
        self._layouts.clear()  # their tensors are not buffers of the module
        self.workspaces, self.compiled = Workspaces(), None
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

    def layout(self, state: ContactState, recorded_normals: bool = False) -> ContactStateLayout:
        """Layout of a contact state: its columns, coupled joints and, with or without recorded normals, directions."""
        return self._layouts.layout(state, recorded_normals)

    def kinematics(self, samples: Samples) -> ChunkKinematics:
        """Kinematics of some samples."""
        motion = samples.motion()
        joints = joint_motion(self.tree, motion)
        states, rotation = body_states(self.tree, motion, joints), samples.base.rotation
        arms, along = self._layouts.ground(states, samples.contact_normal, rotation)
        screw_axes, recorded_normals = joint_screw_axes(self.tree, states), samples.contact_normal is not None
        resting = None if samples.resting is None else samples.resting.T
        return ChunkKinematics(joints, states, screw_axes, rotation, arms, recorded_normals, along, resting)

    def dynamics(self, samples: Samples, workspace: Workspace | None = None, whole: bool = False) -> ChunkDynamics:
        """Dynamics of some samples; with a workspace, valid until the next call with the same.

        `whole`: whether forces of inertias, which are zero, are written to it too.
        """
        kinematics, layout, out = self.kinematics(samples), self.columns.layout, None
        if workspace is not None:
            out = workspace.empty("wrenches", kinematics.screw_axes, 6, layout.count, len(samples))
            if whole:
                out[:3].zero_()
        return ChunkDynamics(**vars(kinematics), wrenches=all_wrench_columns(kinematics.states, layout, out))

    def rows(
        self, samples: Samples, state: ContactState, workspace: Workspace | None = None
    ) -> Iterator[tuple[tuple[int, ...], Tensor]]:
        """Blocks of rows for samples that share a contact state; no gradient flows through reused buffers.

        Yields:
            (columns, rows): rows are (M, len(columns) + 1), the right-hand side last, valid until the next
                is requested.
        """
        for rows, _ in self.blocks(samples, state, workspace):
            support = rows.block.support
            yield support, rows.stacked.T[len(support) + 1 :]

    def blocks(
        self, samples: Samples, state: ContactState, workspace: Workspace | None = None
    ) -> Iterator[tuple[BlockRows, Tensor | slice]]:
        """The same as `BlockRows`, with the samples that each block is of, in order."""
        workspace, layout = workspace or Workspace(), self.layout(state, samples.contact_normal is not None)
        if self.compiled is not None and (chunk := self.compiled.chunk(samples, layout, workspace)) is not None:
            yield from chunk.rows()
            return
        dynamics = self.dynamics(samples, workspace)
        for index, _, blocks in self._coupled_rows(samples, layout, dynamics, workspace):
            yield from ((rows, index) for rows in blocks)
        yield from ((rows, slice(None)) for _, rows in self._uncoupled_rows(samples, layout, dynamics, workspace))

    def rows_by_sample(self, samples: Samples, state: ContactState) -> tuple[Tensor, Tensor]:
        """The same rows sample by sample, for samples that share a contact state.

        Returns:
            (B, n_rows, width + 1), `W^T [K | f]` with rows of zeros where a sample has fewer than n_rows, and W,
            (B, n_rows, n_rows).
        """
        dynamics = self.dynamics(samples)
        layout = self._layouts.layout(state, dynamics.recorded_normals)
        base, coupled = self.tree.base_rows, self.tree.base_rows + len(layout.coupled_joints)
        n_rows = self.tree.n_rows
        rows = samples.time.new_zeros(len(samples), n_rows, self.width + 1)
        W = samples.time.new_zeros(len(samples), n_rows, n_rows)
        dofs = self.tree.index([*range(base), *(base + joint for joint in layout.coupled_joints)])
        workspace, every = Workspace(), torch.arange(len(samples), device=self.device)
        for index, basis, blocks in self._coupled_rows(samples, layout, dynamics, workspace):
            sample = every[index][:, None, None]
            for part in blocks:
                slots = torch.arange(part.block.rows.start, part.block.rows.stop, device=self.device)
                support = self.tree.index([*part.block.support, self.width])
                rows[sample, slots[:, None], support] = part.values.permute(2, 1, 0)
            W[sample, dofs[:, None], torch.arange(basis.shape[1], device=self.device)] = basis.permute(2, 0, 1)
        for slot, (joint, part) in enumerate(self._uncoupled_rows(samples, layout, dynamics, workspace), start=coupled):
            rows[:, slot, self.tree.index([*part.block.support, self.width])] = part.values[:, 0].T
            W[:, base + joint, slot] = self._uncoupled_weight(joint, dynamics)
        return rows, W

    def null_space_bases(
        self, state: ContactState, kinematics: ChunkKinematics
    ) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """Orthonormal V_x, (B', base rows + coupled joints, r), with the samples it belongs to, grouped by rank."""
        layout = self._layouts.layout(state, kinematics.recorded_normals)
        rows, order = self.contact_rows(layout, kinematics), self.tree.index(layout.blocks.order)
        yield from orthonormal_bases(layout, rows, order)

    def contact_rows(self, layout: ContactStateLayout, kinematics: ChunkKinematics) -> ContactRows:
        """Rows of J_C, unmeasured and measured, of the bodies that are in contact."""
        return contact_rows(self.tree, layout, kinematics, self._layouts.frame_origin)

    def whitened_bases(
        self, layout: ContactStateLayout, rows: ContactRows, measured: Tensor, kinematics: ChunkKinematics
    ) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """W, (base rows + coupled joints, r, B'), of contact rows with the samples it belongs to, grouped by rank.

        Task weights D multiply the errors K phi - f: with W' the basis of unmeasured rows A_x D, W = D W' keeps them
        out and W W^T = D W' W'^T D, so that the sum of squares is the least over all unmeasured forces x of
        (K phi - f - A_x^T x)^T D S^-1 D (K phi - f - A_x^T x), S being the covariance of the noise.

        Source: Mistry, Schaal, Yamane 2009, IV-E; weighted least squares under nuisance parameters.
        """
        rotation, resting = kinematics.rotation_world_base, self.coupled_at_rest(layout, kinematics)
        axes, order = self.noise_axes(rotation, self.sensors.noise), self.tree.index(layout.blocks.order)
        if self.task_weights is None:
            yield from whitened_bases(layout, rows, measured, axes, order, resting)
            return
        base = self.tree.base_rows
        D = self.task_weights[self.tree.index([*range(base), *(base + joint for joint in layout.coupled_joints)])]
        parts = zip(rows.unmeasured, rows.unmeasured_columns, strict=True)
        weighted = replace(rows, unmeasured=[part * D[columns, None] for part, columns in parts])
        for index, W in whitened_bases(layout, weighted, measured, axes, order, resting):
            yield index, W * D[:, None, None]

    def coupled_at_rest(self, layout: ContactStateLayout, kinematics: ChunkKinematics) -> Tensor | None:
        """Which coupled joints and readings in limbs have torques that count as unmeasured, (k, B); None for none."""
        resting = kinematics.resting
        if resting is None or not layout.coupled_joints:
            return None
        in_limbs = resting.new_zeros(self.tree.n_dofs - len(resting), resting.shape[1])
        return torch.cat([resting, in_limbs])[self.tree.index(layout.coupled_joints)]

    def contact_jacobian(self, samples: Samples) -> Tensor:
        """Jacobians of all contacts along their frames' axes, active or not, (B, C, 6, n_rows).

        Linear velocities are those of frames' origins, or of the material points where contacts roll; they are along
        the ground's axes where its normal is what a contact is read along.
        """
        kinematics, joints = self.kinematics(samples), range(self.tree.n_dofs)
        J = kinematics.screw_axes.new_zeros(len(samples), len(self.frames), 6, self.tree.n_rows)
        for contact, (body, _) in enumerate(self.frames):
            at_base = self.unit_wrenches(kinematics, contact, range(6))
            J[:, contact] = generalized_forces(self.tree, kinematics.screw_axes, body, at_base, joints).permute(2, 0, 1)
        return J

    def unit_wrenches(
        self, kinematics: ChunkKinematics, contact: int, components: Sequence[int], std: Array | None = None
    ) -> Tensor:
        """Wrenches at the base origin of a unit of each of a contact's components, in order, (6, k, B) [N, N m].

        `std`: (6,), what to have of each component in place of a unit.
        """
        body, T_joint_frame = self.frames[contact]
        std = np.ones(6) if std is None else std
        arms, axes = kinematics.arms.get(contact), kinematics.ground_axes.get(contact)
        in_frame = [k for k in components if axes is None or k >= 3]
        units = kinematics.screw_axes.new_tensor((wrench_transform(T_joint_frame) * std).T[in_frame])
        wrenches = wrenches_at_base(kinematics.states, body, units, arms)
        if axes is None:
            return wrenches
        along = [k for k in components if k < 3]
        forces = axes[:, along] * axes.new_tensor(std[along])[:, None]
        point = self._layouts.frame_origin(contact)
        return torch.cat([forces_at_base(kinematics.states, body, point, forces, arms), wrenches], dim=1)

    def noise_axes(self, rotation_world_base: Tensor | None, noise: SensorNoise | None = None) -> Tensor | None:
        """Axes of the stated noise of base rows, (B, 3, 3); None for the base's own: no attitude, or alike noise."""
        if rotation_world_base is None or not self.tree.base_rows or (noise and not noise.base_axes_differ):
            return None
        return levelled_base_axes(rotation_world_base)

    def recorded_wrench(self, samples: Samples, contact: int, kinematics: ChunkKinematics) -> Tensor:
        """Recorded wrench of a contact along the axes of its components, (B, 6) [N, N m], NaN where not recorded."""
        if samples.wrench is None:
            return samples.time.new_full((len(samples), 6), torch.nan)
        wrench = samples.wrench[:, contact]
        if not samples.wrench_in_world or self.contacts[contact].along_normal:
            return wrench
        return self._frame_poses(contact, samples, kinematics).in_frame(wrench)

    def _frame_poses(self, contact: int, samples: Samples, kinematics: ChunkKinematics) -> FramePoses:
        axes, origin = self._layouts.frame_rotation(contact), self._layouts.frame_origin(contact)
        return FramePoses.of(samples, kinematics, self.frames[contact][0], axes, origin)

    def recorded_torque(self, samples: Samples) -> Tensor:
        """Recorded joint torques and wrenches in limbs, (B, n + 6 F) [N m, N], NaN where not recorded."""
        if samples.torque is None:
            return samples.time.new_full((len(samples), self.tree.n_dofs), torch.nan)
        return samples.torque

    def torque_of_bodies(self, samples: Samples) -> Tensor:
        """Recorded torques and wrenches without what known armatures and springs need, (B, n + 6 F) [N m, N]."""
        torque = self.recorded_torque(samples)
        return torque if self.known_torques.none else torque - self.known_torques.of(samples)

    def _uncoupled_rows(
        self, samples: Samples, layout: ContactStateLayout, dynamics: ChunkDynamics, workspace: Workspace
    ) -> Iterator[tuple[int, BlockRows]]:
        """Uncoupled joints, and the row of each."""
        torque = self.torque_of_bodies(samples)
        for joint, block in layout.uncoupled_joints.items():
            weight = self._uncoupled_weight(joint, dynamics)
            W = weight[None, None]
            absent = None if dynamics.resting is None else W[0] == 0.0
            rows = BlockRows.empty(block, 1, W, workspace, absent)
            torch.mul(torque[:, joint], weight, out=rows.values[-1, 0])
            self._project(None, W, dynamics, rows, workspace)
            subtract_payload(block, rows.values, samples.payload, self.columns.parameter_map)
            for number, column in enumerate(block.extras, start=len(block.inertial) + len(block.friction)):
                extra = self.extras[column - self.columns.count]
                torch.mul(dof_extra_column(extra, joint, samples, self.tree), weight, out=rows.values[number, 0])
            yield joint, rows

    def _uncoupled_weight(self, joint: int, dynamics: ChunkDynamics) -> Tensor:
        """W of an uncoupled joint, (B,) [1 / N m]."""
        screw_axes, resting = dynamics.screw_axes, dynamics.resting
        weighted = 1.0 if self.task_weights is None else float(self.task_weights[self.tree.base_rows + joint])
        weight = screw_axes.new_full(screw_axes.shape[-1:], weighted / self._layouts.dof_std[joint])
        return weight if resting is None or joint >= len(resting) else weight.masked_fill_(resting[joint], 0.0)

    def _coupled_rows(
        self, samples: Samples, layout: ContactStateLayout, dynamics: ChunkDynamics, workspace: Workspace
    ) -> Iterator[tuple[Tensor | slice, Tensor, Iterator[BlockRows]]]:
        """Samples of one rank, their W, (base rows + coupled joints, r, B'), and their rows, block by block."""
        if not (self.tree.base_rows or layout.coupled_joints):
            return
        rows = self.contact_rows(layout, dynamics)
        measured = rows.of_measured()
        f = self.coupled_forces(samples, layout, measured, dynamics)
        for index, W in self.whitened_bases(layout, rows, measured, dynamics):
            own = measured[..., index].permute(2, 0, 1)
            part = ChunkPart(samples[index], f[index].T, own, dynamics.select(index))
            yield index, W, self._projected_blocks(W, part, layout, workspace)

    def coupled_forces(
        self, samples: Samples, layout: ContactStateLayout, measured: Tensor | None, kinematics: ChunkKinematics | None
    ) -> Tensor:
        """Measured forces in the base rows and coupled joints, (B, m); of contacts by their `measured` rows."""
        torque = self.torque_of_bodies(samples)[:, self.tree.index(layout.coupled_joints)]
        f = nn.functional.pad(torque, (self.tree.base_rows, 0))
        if measured is None or kinematics is None or not len(layout.wrench_std):
            return f
        return f + (measured.permute(2, 1, 0) @ self._measured_wrench(samples, layout, kinematics)[..., None])[..., 0]

    def _projected_blocks(
        self, W: Tensor, part: ChunkPart, layout: ContactStateLayout, workspace: Workspace
    ) -> Iterator[BlockRows]:
        base = self.tree.base_rows
        absent = None if part.dynamics.resting is None else ~W.any(0)
        for block in layout.blocks.of_rank(W.shape[1]):
            own = W[:, block.rows]
            rows = BlockRows.empty(block, own.shape[1], W, workspace, None if absent is None else absent[block.rows])
            torch.sum(own * part.f[:, None], dim=0, out=rows.values[-1])
            self._project(own[:base] if base else None, own[base:], part.dynamics, rows, workspace)
            subtract_payload(block, rows.values, part.samples.payload, self.columns.parameter_map)
            if block.extras:
                rows.values[-1 - len(block.extras) : -1] = self._extra_columns(part, layout, block, own)
            yield rows

    def _extra_columns(self, part: ChunkPart, layout: ContactStateLayout, block: RowBlock, W: Tensor) -> Tensor:
        """Columns of a block's extra parameters, (extras, r, B)."""
        extras = [self.extras[column - self.columns.count] for column in block.extras]
        touching = {contact for extra in extras for contact, _ in extra.contacts}
        turned = touching.difference(self._layouts.along_normal) if part.samples.wrench_in_world else ()
        poses = {k: self._frame_poses(k, part.samples, part.dynamics) for k in turned}
        basis = W.permute(2, 0, 1)
        columns = extra_columns(extras, part.samples, layout, self.tree, part.measured, basis, poses)
        return torch.stack(list(columns))

    def _project(
        self,
        W_base: Tensor | None,
        W_joints: Tensor,
        dynamics: ChunkDynamics,
        rows: BlockRows,
        workspace: Workspace,
    ) -> None:
        """Write the columns W^T K of some rows, the first ones, but not those of extra parameters.

        `W_base`, (6, r, B), None for a fixed base, and `W_joints`, (joints, r, B): its part of the basis. A wrench on
        body i does work on the base and on the joints above it only. Body i's columns of W^T K are thus A_i^T times its
        wrench columns, with A_i the sum over its path of the rows of W times the joints' screw axes. No joint row is
        ever formed. Columns are contiguous, as the factorization needs them.
        """
        block, X = rows.block, rows.values
        torques = moved_rows(block, W_joints)
        nodes = self.tree.index(node for node, *_ in block.moved)
        friction = X[len(block.inertial) :][: 2 * len(nodes)].unflatten(0, (len(nodes), 2))
        torch.mul(torques, dynamics.joints.direction[nodes, None], out=friction[:, 0])
        torch.mul(torques, dynamics.joints.velocity[nodes, None], out=friction[:, 1])

        of_base = int(W_base is not None and block.base != "none")
        path_sums = workspace.empty("path_sums", W_joints, 6, of_base + len(nodes), *W_joints.shape[1:])
        if W_base is not None and of_base:
            path_sums[:, 0] = W_base
        for number, (node, _, _, above) in enumerate(block.moved):
            screw_axis, path_sum = dynamics.screw_axes[:, node, None], path_sums[:, of_base + number]
            if above is None:
                torch.mul(screw_axis, torques[number], out=path_sum)
            else:
                torch.addcmul(path_sums[:, above], screw_axis, torques[number], out=path_sum)
        start = 0
        for run in block.nodes:
            end = start + len(run.nodes) * len(run.kept)
            columns = dynamics.wrenches[:, run.columns.start : run.columns.stop].unflatten(1, (-1, len(run.all_kept)))
            multiply_wrenches(
                columns[:, :, : len(run.kept)],
                path_sums[:, run.sources.start : run.sources.stop],
                run.n_with_force,
                X[start:end].unflatten(0, (len(run.nodes), len(run.kept))),
            )
            start = end

    def _measured_wrench(self, samples: Samples, layout: ContactStateLayout, kinematics: ChunkKinematics) -> Tensor:
        """Measured wrench components along the frames' axes, (B, k_m)."""
        components = [component for body in layout.contact_bodies for component in body.components]
        local = {
            contact: self.recorded_wrench(samples, contact, kinematics)
            for contact in {contact for contact, _ in components}
        }
        return torch.stack([local[contact][:, k] for contact, k in components], dim=1)
