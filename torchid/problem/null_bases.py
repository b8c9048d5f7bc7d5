"""Bases of the null spaces of unmeasured forces under which the projected noise is white."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchid.problem.contact_state import ContactStateLayout
from torchid.rounding import KINEMATIC_TOLERANCE, relative_tolerance
from torchid.sensing.limbs import limb_null_space
from torchid.sensing.projection import any_suspect, whitened_null_space


@dataclass(frozen=True)
class ContactRows:
    """Rows of J_C of the bodies in contact at B samples, and of loops.

    Attributes:
        unmeasured: of each body or loop that has some: (k, own columns, B), and where these columns are among base rows
            and coupled joints, (own columns,) int64.
        measured: all measured ones, (k, base rows + coupled joints, B).
    """

    unmeasured: Sequence[tuple[Tensor, Tensor]]
    measured: Tensor

    def select(self, index: Tensor | slice) -> ContactRows:
        """Those of some samples."""
        return ContactRows([(rows[..., index], at) for rows, at in self.unmeasured], self.measured[..., index])

    def of_unmeasured(self) -> Tensor:
        """All unmeasured rows, (B, k, base rows + coupled joints)."""
        return spread_columns(self.unmeasured, self.measured).permute(2, 0, 1)


def spread_columns(parts: Sequence[tuple[Tensor, Tensor]], like: Tensor) -> Tensor:
    """Rows of some columns each as rows of all, (k, columns, B); `like`: (..., columns, B)."""
    out = like.new_zeros(sum(len(rows) for rows, _ in parts), *like.shape[-2:])
    start = 0
    for rows, columns in parts:
        out[start : start + len(rows)].index_copy_(1, columns, rows)
        start += len(rows)
    return out


def whitened_bases(
    layout: ContactStateLayout, rows: ContactRows, axes: Tensor | None, order: Tensor, resting: Tensor | None = None
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """Bases W of the null spaces of the unmeasured rows that whiten the projected noise, grouped by rank.

    Args:
        layout: of the samples' contact state.
        rows: of the samples.
        axes: (B, 3, 3) or None, as in `whitened_null_space`.
        order: (m,), as in `whitened_null_space`.
        resting: (joints, B), coupled joints whose torque is unmeasured in a sample; or None.

    Yields:
        (index of the samples, W): W is (m, r, B'), triangular if the layout says so, with a column of zeros for each
            row that a sample loses by `resting`.
    """
    if resting is None:
        yield from _bases_of_measured_joints(layout, rows, axes, order)
        return
    measured = rows.measured
    base = measured.shape[1] - len(resting)
    alone = not rows.unmeasured
    if alone:  # W is triangular, and stays so: noise of contacts then links no resting joint to others
        kept = measured[:, base:].masked_fill(resting, 0.0)
        rows = ContactRows(rows.unmeasured, torch.cat([measured[:, :base], kept], dim=1))
    for index, W in _bases_of_measured_joints(layout, rows, axes, order):
        resting_here = resting[:, index]
        if alone:
            W[base:].masked_fill_(resting_here[:, None], 0.0)
        else:
            leave_out_torques(W, resting_here, layout.row_std)
            if layout.blocks.has_triangular_base:
                triangularize_base_rows(W)
        yield index, W


def _bases_of_measured_joints(
    layout: ContactStateLayout, rows: ContactRows, axes: Tensor | None, order: Tensor
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """As `whitened_bases`, of joints whose torque is measured at every sample."""
    if not layout.has_own_limbs:
        yield from general_bases(layout, rows, axes, order)
        return
    limbs = [part for part, _ in rows.unmeasured]
    joints = [columns[6:] - 6 for _, columns in rows.unmeasured]
    W, suspect = limb_null_space(limbs, joints, layout.row_std, rows.measured, layout.wrench_std, axes)
    lost: list[tuple[Tensor, Tensor]] = []
    if any_suspect(suspect):
        doubtful = torch.nonzero(suspect)[:, 0]
        doubtful_axes = None if axes is None else axes[doubtful]
        for index, basis in general_bases(layout, rows.select(doubtful), doubtful_axes, order):
            if basis.shape[1] == W.shape[1]:
                W[..., doubtful[index]] = basis
            else:
                lost.append((doubtful[index], basis))
    if not lost:
        yield slice(None), W
        return
    is_lost = torch.zeros_like(suspect)
    is_lost[torch.cat([index for index, _ in lost])] = True
    regular = torch.nonzero(~is_lost)[:, 0]
    if len(regular):
        yield regular, W[..., regular]
    yield from lost


def general_bases(
    layout: ContactStateLayout, rows: ContactRows, axes: Tensor | None, order: Tensor
) -> Iterator[tuple[Tensor | slice, Tensor]]:
    """The same by decompositions of all rows together."""
    J_m = rows.measured.permute(2, 0, 1)
    bases = whitened_null_space(rows.of_unmeasured(), layout.row_std, J_m, layout.wrench_std, axes, order)
    for index, basis in bases:
        W = basis.permute(1, 2, 0).contiguous()
        if layout.blocks.has_triangular_base:
            triangularize_base_rows(W)
        yield index, W


def leave_out_torques(W: Tensor, resting: Tensor, row_std: Tensor | None = None) -> None:
    """Remove joints from bases, in place: their torque becomes a further unmeasured force.

    The remaining span of W is orthogonal to `W^T e_j` of each such joint j. A reflection from the right, which keeps
    the noise white, turns this direction into the first non-zero column, which is set to zero. So all shapes stay the
    same. If `W^T e_j` is rounding, no row contained the torque of j.

    Args:
        W: (base rows + joints, r, B).
        resting: (joints, B) bool.
        row_std: (base rows + joints,), noise that divides W; None for 1.
    """
    base = len(W) - len(resting)
    columns = torch.arange(W.shape[1], device=W.device)[:, None]
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


def triangularize_base_rows(W: Tensor) -> None:
    """Make bases triangular in the base rows: only three columns contain its moment, only six its force.

    Uses the R of an RQ decomposition, by Householder reflections from the right, one for each base row, in place.

    Args:
        W: (base rows + coupled joints, r, B).
    """
    last = W.shape[1]
    for row in (5, 4, 3, 2, 1, 0)[: 3 if last <= 6 else 6]:
        if last < 2:
            return
        remaining = W[:, :last]
        v = remaining[row].clone()
        norm = torch.linalg.vector_norm(v, dim=0)
        v[-1] += torch.copysign(norm, v[-1])
        length = (v * v).sum(0)
        v_scaled = v * torch.where(length > 0.0, 2.0 / length, 0.0)
        remaining.addcmul_((remaining * v).sum(1, keepdim=True), v_scaled, value=-1)
        last -= 1
