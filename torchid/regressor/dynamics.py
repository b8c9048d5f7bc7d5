"""Rows of the regressor, batch-last, from the wrench columns: the one place that knows its sparsity.

The base rows are the wrench columns themselves. The row of joint j is zero outside joint j's subtree, which is a slice
of columns because bodies are in depth-first order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchid.regressor.columns import wrench_columns
from torchid.regressor.kinematics import BodyStates, JointStates, cross
from torchid.regressor.reduction import ColumnLayout
from torchid.regressor.tree import KinematicTree


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


def joint_directions(tree: KinematicTree, states: BodyStates) -> Tensor:
    """Screw axes of all joints, (6, L, B): `direction . wrench at the base origin` is the torque about the joint."""
    axis = states.rotation[:, 2]
    linear = cross(states.position, axis) * tree.revolute + axis * tree.prismatic
    return torch.cat([linear, axis * tree.revolute])


def all_wrench_columns(states: BodyStates, layout: ColumnLayout, out: Tensor | None = None) -> Tensor:
    """Wrench columns (6, columns, B) of all bodies.

    Args:
        states: of the frames that `layout`'s parameters are expressed in.
        layout: which columns to compute.
        out: a buffer of the result's shape to write to, as it was left by an earlier call with the same layout.
    """
    if out is None:
        out = states.position.new_zeros(6, layout.count, states.position.shape[-1])
    for kept, bodies in layout.runs():
        if kept:
            columns = out[:, layout.starts[bodies.start] : layout.starts[bodies.stop]]
            wrench_columns(states.run(bodies.start, bodies.stop), kept, columns.unflatten(1, (-1, len(kept))))
    return out


def joint_row(row: JointRow, tree: KinematicTree, layout: ColumnLayout, directions: Tensor, wrenches: Tensor) -> Tensor:
    """Inertial part of one joint's row, (row.end - row.start, B)."""
    body, ratio = row.moved[0]
    if len(row.moved) == 1:
        return ratio * _torque(directions[:, body], wrenches[:, row.start : row.end])
    total = wrenches.new_zeros(row.end - row.start, wrenches.shape[-1])
    for body, ratio in row.moved:
        start, end = layout.starts[body], layout.starts[tree.subtree_end[body]]
        part = ratio * _torque(directions[:, body], wrenches[:, start:end])
        total = total + torch.nn.functional.pad(part, (0, 0, start - row.start, row.end - end))
    return total


def friction_columns(row: JointRow, tree: KinematicTree, joints: JointStates) -> list[tuple[int, Tensor, Tensor]]:
    """Friction entries of one joint's row: body, column of fc, column of fv, each (B,).

    Friction resists: it adds `fc sign(v) + fv v` to the torque the actuator must give.
    """
    entries = []
    for body, ratio in row.moved:
        velocity = joints.velocity[body]
        entries.append((body, ratio * tree.coulomb_sign(velocity), ratio * velocity))
    return entries


def _torque(direction: Tensor, wrenches: Tensor) -> Tensor:
    total = direction[0] * wrenches[0]
    for k in range(1, 6):
        total.addcmul_(direction[k], wrenches[k])
    return total
