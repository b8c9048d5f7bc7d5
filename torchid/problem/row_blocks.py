"""Blocks of a contact state's coupled rows, each with the columns in which its rows can differ from zero.

Rows `W^T [K | f]` stay those of one problem when W is multiplied by any orthogonal matrix from the right. That freedom
is used for zeros, as a factorization takes time with the square of the columns: at most three rows combine the moment
on the base, the next three its force, but not its moment, so that inertias of bodies which no coupled joint moves are
not in them, and all others combine joints alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.regressor.columns import ColumnLayout
from torchid.regressor.tree import KinematicTree

_WORTH_TRIANGULARIZING = 0.8  # of the factorization's operations, what is left at most if it is to pay


@dataclass(frozen=True)
class Nodes:
    """Consecutive nodes whose wrench columns meet the rows of a block in one product.

    Attributes:
        nodes: numbers of them.
        kept: the inertial parameters of each that matter: the first of those that its columns are of.
        all_kept: those that its columns are of.
        columns: the columns, among those of all nodes.
        sources: numbers of the path sums, one for each node, or one for all.
    """

    nodes: range
    kept: tuple[int, ...]
    all_kept: tuple[int, ...]
    columns: range
    sources: range

    @property
    def n_with_force(self) -> int:
        """Number of the parameters that demand a force; inertias demand moments only."""
        return sum(column < parameters.INERTIA.start for column in self.kept)


@dataclass(frozen=True)
class RowBlock:
    """Rows that combine the same degrees of freedom.

    Attributes:
        rows: which of a sample's.
        base: base rows that they combine: "all", "force" or "none".
        moved: nodes that the joints move whose rows they combine, parents first: node, number of the joint, ratio of
            its motion, and the number of the path sum that the node's adds to, None if it starts from nothing.
        nodes: on whose inertial parameters they depend.
        inertial: the columns of these.
        friction: columns of the joints' friction.
        extras: columns of extra parameters.
    """

    rows: slice
    base: str
    moved: tuple[tuple[int, int, float, int | None], ...]
    nodes: tuple[Nodes, ...]
    inertial: tuple[int, ...]
    friction: tuple[int, ...]
    extras: tuple[int, ...]

    @property
    def support(self) -> tuple[int, ...]:
        """Columns in which the rows can differ from zero."""
        return (*self.inertial, *self.friction, *self.extras)

    @property
    def operations(self) -> int:
        """Of a factorization, for one sample, in units of two."""
        return (self.rows.stop - self.rows.start) * (len(self.support) + 1) ** 2


class RowBlocks:
    """The blocks of a contact state's coupled rows.

    `order`: of the degrees of freedom (base rows, then coupled joints), for a W that is triangular: joints from the
    leaves to the base, then the base's force, then its moment. `has_triangular_base`: whether another W is
    to be triangular in the base rows (see `triangularize_base_rows`).
    """

    def __init__(
        self,
        tree: KinematicTree,
        layout: ColumnLayout,
        moved: Sequence[tuple[int, int, float]],
        friction: Sequence[tuple[int, int]],
        contacts: Sequence[Sequence[int]],
        unmeasured: int,
        extras: Sequence[tuple[int, Sequence[int], bool]],
        held: Sequence[int] = (),
    ) -> None:
        """Work out what combines with what.

        Args:
            tree: the robot's constants.
            layout: of its inertial columns.
            moved: nodes that coupled joints move directly, ascending, with the joint's number and the motion's ratio.
            friction: the two friction columns of each of these.
            contacts: coupled joints above each body in contact.
            unmeasured: number of unmeasured wrench components in contact.
            extras: extra parameters: column, joints that it depends on, whether it depends on the base.
            held: nodes whose contacts exert all six components of a wrench, unmeasured ones.
        """
        self._held = held
        self._tree, self._layout, self._moved, self._friction = tree, layout, moved, friction
        self._extras, self._unmeasured = extras, unmeasured
        joints = {joint: node for node, joint, _ in moved}  # the last node that each moves
        leaves_first = sorted(joints, key=lambda joint: -joints[joint])
        self.order = (*(tree.base_rows + joint for joint in leaves_first), *range(tree.base_rows))
        self._all = tuple(sorted(joints))
        self._triangular = tuple(self._triangular_blocks(leaves_first, contacts))
        self._by_rank: dict[int, tuple[RowBlock, ...]] = {}
        rank = max(len(self.order) - unmeasured, 0)
        self.has_triangular_base = False
        if tree.base_rows and unmeasured and rank:
            together, apart = self._together(rank), self._apart(rank)
            self.has_triangular_base = sum(x.operations for x in apart) <= _WORTH_TRIANGULARIZING * together.operations

    def of_rank(self, rank: int) -> tuple[RowBlock, ...]:
        """The blocks of samples that have so many coupled rows."""
        if not self._unmeasured:
            return self._triangular
        if rank not in self._by_rank:
            blocks = self._apart(rank) if self.has_triangular_base else (self._together(rank),)
            self._by_rank[rank] = blocks if rank else ()
        return self._by_rank[rank]

    def _together(self, rank: int) -> RowBlock:
        return self._block(slice(0, rank), self._all, "all" if self._tree.base_rows else "none")

    def _apart(self, rank: int) -> tuple[RowBlock, ...]:
        moment = min(3, rank)
        force = min(3, rank - moment)
        joints = rank - moment - force
        sizes = {"none": slice(0, joints), "force": slice(joints, joints + force), "all": slice(joints + force, rank)}
        return tuple(self._block(rows, self._all, base) for base, rows in sizes.items() if rows.start < rows.stop)

    def _triangular_blocks(self, leaves_first: Sequence[int], contacts: Sequence[Sequence[int]]) -> Iterator[RowBlock]:
        """Blocks of limbs that share no joint, and of the base; W combines a joint with those before it in its limb."""
        linked = np.eye(len(self._all), dtype=bool)
        position = {joint: number for number, joint in enumerate(self._all)}
        for contact in contacts:
            members = [position[joint] for joint in contact]
            linked[np.ix_(members, members)] = True
        limb = connected_components(linked, directed=False)[1]
        start = 0
        for own, run in groupby(leaves_first, key=lambda joint: int(limb[position[joint]])):
            end = start + len(list(run))
            members = [joint for joint in leaves_first[:end] if limb[position[joint]] == own]
            yield self._block(slice(start, end), tuple(sorted(members)), "none")
            start = end
        if self._tree.base_rows:
            yield self._block(slice(start, start + 3), self._all, "force")
            yield self._block(slice(start + 3, start + 6), self._all, "all")

    def _block(self, rows: slice, joints: tuple[int, ...], base: str) -> RowBlock:
        chosen = [(*moved, friction) for moved, friction in zip(self._moved, self._friction, strict=True)]
        extras = tuple(
            column
            for column, of_joints, of_base in self._extras
            if (of_base and base != "none") or not set(joints).isdisjoint(of_joints)
        )
        moved = [x for x in chosen if x[1] in joints]
        return row_block(self._tree, self._layout, rows, moved, base, extras, self._held)


def row_block(
    tree: KinematicTree,
    layout: ColumnLayout,
    rows: slice,
    moved: Sequence[tuple[int, int, float, tuple[int, int]]],
    base: str = "none",
    extras: tuple[int, ...] = (),
    held: Sequence[int] = (),
) -> RowBlock:
    """A block of rows.

    What W combines moves no node that the ground holds: `A_x W = 0` says so. Their path sums are zero, and with them
    the columns of all nodes that move with one.

    Args:
        tree: the robot's constants.
        layout: of its inertial columns.
        rows: which of a sample's.
        moved: nodes that the joints move, ascending: node, joint, ratio of its motion, its two friction columns.
        base: base rows that are combined: "all", "force" or "none".
        extras: columns of extra parameters.
        held: nodes that the ground holds, each by six unmeasured components of a wrench.
    """
    numbers = {node: number for number, (node, *_) in enumerate(moved, start=base != "none")}
    sources: list[int | None] = [None if base == "none" else 0]
    for node in range(1, tree.n_nodes):
        sources.append(numbers.get(node, sources[tree.parents[node]]))
    light = [base == "force" and source == 0 for source in sources]
    zero = {None, *(sources[node] for node in held)}
    kept = [
        () if source in zero else tuple(k for k in all_kept if not is_light or k < parameters.INERTIA.start)
        for all_kept, is_light, source in zip(layout.kept, light, sources, strict=True)
    ]
    nodes = tuple(_runs(layout, kept, sources))
    inertial = (
        run.columns.start + len(run.all_kept) * number + k
        for run in nodes
        for number in range(len(run.nodes))
        for k in range(len(run.kept))
    )
    return RowBlock(
        rows,
        base,
        tuple((node, joint, ratio, sources[tree.parents[node]]) for node, joint, ratio, _ in moved),
        nodes,
        tuple(inertial),
        tuple(column for *_, friction in moved for column in friction),
        extras,
    )


def _runs(layout: ColumnLayout, kept: Sequence[tuple[int, ...]], sources: Sequence[int | None]) -> Iterator[Nodes]:
    """Runs of consecutive nodes that keep the same parameters and have one path sum in common, or successive ones."""
    start = 0
    while start < len(sources):
        end = start + 1
        if kept[start]:  # which no node without a path sum has
            steps: list[int] = []
            while (
                end < len(sources)
                and (layout.kept[end], kept[end]) == (layout.kept[start], kept[start])
                and (step := (sources[end] or 0) - (sources[end - 1] or 0)) in (0, 1)
                and step == (steps or [step])[0]
            ):
                steps.append(step)
                end += 1
            yield Nodes(
                nodes=range(start, end),
                kept=kept[start],
                all_kept=layout.kept[start],
                columns=range(layout.starts[start], layout.starts[end]),
                sources=range(sources[start] or 0, (sources[end - 1] or 0) + 1),
            )
        start = end


def triangularize_base_rows(W: Tensor) -> None:
    """Make bases triangular in the base rows: zero but for three columns in its moment, but for six in its force.

    The R of an RQ decomposition, by Householder reflections from the right, one for each base row, in place.

    Args:
        W: (base rows + coupled joints, r, B).
    """
    last = W.shape[1]
    for row in (5, 4, 3, 2, 1, 0)[: 3 if last <= 6 else 6]:
        if last < 2:
            return
        left = W[:, :last]
        v = left[row].clone()
        norm = torch.linalg.vector_norm(v, dim=0)
        v[-1] += torch.copysign(norm, v[-1])
        length = (v * v).sum(0)
        v_scaled = v * torch.where(length > 0.0, 2.0 / length, 0.0)
        left.addcmul_((left * v).sum(1, keepdim=True), v_scaled, value=-1)
        last -= 1


def moved_rows(block: RowBlock, W_joints: Tensor) -> Tensor:
    """Rows of the basis, (joints, r, B), at each node that a block moves, times the motion's ratio, (moved, r, B)."""
    moved = [(joint, ratio) for _, joint, ratio, _ in block.moved]
    first = moved[0][0] if moved else 0
    if moved == [(joint, 1.0) for joint in range(first, first + len(moved))]:
        return W_joints[first : first + len(moved)]
    return torch.stack([ratio * W_joints[joint] for joint, ratio in moved])


def multiply_wrenches(wrenches: Tensor, path_sums: Tensor, n_with_force: int, out: Tensor) -> None:
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
