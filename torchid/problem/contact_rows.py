"""Rows of the Jacobian of contacts and loops at samples of a contact state, and null spaces of the unmeasured ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchid.problem.chunk_dynamics import ChunkKinematics
from torchid.problem.contact_state import ContactStateLayout
from torchid.problem.row_blocks import triangularize_base_rows
from torchid.problem.wrench_rows import wrenches_at_ground
from torchid.regressor.regressor import generalized_forces
from torchid.regressor.tree import KinematicTree
from torchid.rounding import KINEMATIC_TOLERANCE, relative_tolerance
from torchid.sensing.limbs import limb_null_space
from torchid.sensing.projection import any_suspect, null_space, whitened_null_space


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
