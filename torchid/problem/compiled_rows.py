"""Rows of a chunk by the compiled kernels of `torchid.kernels`: the same as `RowBuilder`'s."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchid.kernels import Word, call, lanes
from torchid.parameters import Array
from torchid.problem.contact_state import ContactStateLayout, RowBlock
from torchid.problem.extras import dof_extra_column
from torchid.problem.null_bases import general_bases
from torchid.problem.row_compressor import ColumnLevels
from torchid.problem.rows import BlockRows, RowBuilder, Workspace, subtract_payload
from torchid.problem.samples import Samples
from torchid.regressor.kinematics import Motion, require_precision
from torchid.regressor.tree import KinematicTree
from torchid.sensing.limbs import PIVOT, WELL_CONDITIONED

TILE = lanes()
SPAN = 128  # samples whose rows are multiplied at once, see `kernels/rows.cpp`
_PADDING = 8  # numbers between columns of these rows
_BASE = 6  # columns of W where a robot stands on limbs


class _Motion(NamedTuple):
    """`Motion` of `kernels/spatial.h`."""

    nodes: int
    tiles: int
    parent: np.ndarray
    pose: Array
    slides: Array
    joints: Tensor
    base: Tensor


def _limbs(tree: KinematicTree, layout: ContactStateLayout) -> tuple[Word, ...]:
    """`Limbs` of `kernels/limbs.cpp` for a contact state."""
    table = list[list[int]]()
    wrenches = list[Tensor]()
    dofs = list[int]()
    moved = list[tuple[int, int]]()
    ratios = list[float]()
    for body in layout.contact_bodies:
        first = len(moved)
        for number, joint in enumerate(body.joints):
            for node in tree.path(body.body):
                if ratio := float(tree.joint_map[node, layout.coupled_joints[joint]]):
                    moved.append((number, node))
                    ratios.append(ratio)
        table.append([body.body, len(body.joints), len(dofs), first, len(moved)])
        if body.span is not None:
            wrenches.append(body.span)
        dofs.extend(body.joints)
    arrays = (np.array(table), torch.cat(wrenches), np.array(dofs), np.array(moved), np.array(ratios), layout.row_std)
    return len(table), len(layout.row_std), *arrays


@dataclass(frozen=True)
class _BlockTables:
    """Some blocks as the tables of `Rows` of `kernels/rows.cpp`."""

    blocks: np.ndarray
    moves: np.ndarray
    ratios: Array
    bodies: np.ndarray
    kept: np.ndarray
    path_sums: int

    @classmethod
    def of(cls, blocks: tuple[RowBlock, ...], base: int, dofs: int | None) -> _BlockTables:
        """From blocks, with so many degrees of freedom after those of the base; None for single rows."""
        table = list[list[int]]()
        moves = list[list[int]]()
        ratios = list[float]()
        bodies = list[list[int]]()
        kept = list[int]()
        first = 1  # the first path sum stays 0
        for number, block in enumerate(blocks):
            of_base = int(block.base != "none")
            width = len(block.support) + 1
            if dofs is None:
                table.append([0, 1, width, 0, 0, number, number + 1])
            else:
                count = block.rows.stop - block.rows.start
                table.append([block.rows.start, count, width, 0, first * of_base, 0, base + dofs])
            for place, (node, moving, ratio, above) in enumerate(block.moved):
                upper = 0 if above is None else first + above
                dof = number if dofs is None else base + moving
                column = len(block.inertial) + 2 * place
                moves.append([number, node, dof, first + of_base + place, upper, column])
                ratios.append(ratio)
            column = 0
            for run in block.nodes:
                for place, node in enumerate(run.nodes):
                    path_sum = first + run.sources[place if len(run.sources) > 1 else 0]
                    bodies.append([node, number, path_sum, column, len(kept), len(run.kept)])
                    column += len(run.kept)
                kept.extend(run.kept)
            first += of_base + len(block.moved)
        bodies.sort(key=lambda x: (x[0], -x[5], x[1]))
        integers = (np.array(x, dtype=np.int64) for x in (table, moves, bodies, kept))
        table_array, moves_array, bodies_array, kept_array = integers
        return cls(table_array, moves_array, np.array(ratios), bodies_array, kept_array, first)

    def placed(self, sizes: np.ndarray) -> np.ndarray:
        """The blocks, one after the other in memory, with so many numbers each."""
        out = self.blocks.copy()
        out[:, 3] = np.cumsum(sizes) - sizes
        return out


@dataclass(frozen=True)
class _Group:
    """Blocks of rows that kernels make at once.

    Attributes:
        blocks: the blocks.
        tables: of these.
        motion: of all samples.
        W: tiles (T, degrees of freedom, rank, TILE) of it, or one for all.
        f: measured forces, (B, degrees of freedom).
        joints: of each block, where those that it combines are among the degrees of freedom.
    """

    blocks: tuple[RowBlock, ...]
    tables: _BlockTables
    motion: _Motion
    W: Tensor
    f: Tensor
    joints: Sequence[Mapping[int, int]]

    def arguments(self, placed: np.ndarray, workspace: Workspace) -> tuple[tuple[Word, ...], tuple[Word, ...]]:
        """`Motion` and `Rows` of the kernels."""
        forces = workspace.empty("forces", self.W, *self.f.T.shape)
        forces.copy_(self.f.T)
        tables = self.tables
        step = self.W[0].numel() if len(self.W) > 1 else 0
        lengths = (len(placed), len(tables.moves), len(tables.bodies), tables.path_sums)
        arrays = (placed, tables.moves, tables.ratios, tables.bodies, tables.kept)
        return self.motion, (len(self.f), self.W.shape[2], step, self.W, forces, *lengths, *arrays)


@dataclass(frozen=True)
class CompiledChunk:
    """Rows of a chunk that kernels compute on request; valid until the workspace is used again.

    Attributes:
        builder: of the rows.
        samples: of the chunk.
        groups: of blocks.
        workspace: memory.
    """

    builder: RowBuilder
    samples: Samples
    groups: Sequence[_Group]
    workspace: Workspace

    def rows(self, without: Collection[int] = ()) -> Iterator[tuple[BlockRows, slice]]:
        """As `RowBuilder.blocks`; `without`: identities of blocks that are left out."""
        for group in self.groups:
            if not all(id(block) in without for block in group.blocks):
                yield from ((made, slice(None)) for made in self._written(group) if id(made.block) not in without)

    def grams(
        self, levels: Callable[[tuple[int, ...]], ColumnLevels | None]
    ) -> Iterator[tuple[RowBlock, Array, Array]]:
        """Blocks, squares and Gram matrices as `write_gram` writes them; the rows never leave the caches.

        Only for groups with levels of all their blocks, and without parts that kernels do not know.
        """
        if self.samples.payload is None and not self.builder.extras:
            for group in self.groups:
                known = [block_levels for block in group.blocks if (block_levels := levels(block.support)) is not None]
                if len(known) == len(group.blocks):
                    yield from self._multiplied(group, known)

    def _written(self, group: _Group) -> Iterator[BlockRows]:
        samples = len(self.samples)
        counts, widths = group.tables.blocks[:, 1:3].T
        sizes = widths * (widths + counts * samples)
        placed = group.tables.placed(sizes)
        memory = self.workspace.empty("rows", group.W, int(sizes.sum()))
        call("write_rows", *group.arguments(placed, self.workspace), memory)
        for block, in_W, (_, count, width, *_), flat in zip(
            group.blocks, group.joints, placed.tolist(), memory.split(sizes.tolist()), strict=True
        ):
            stacked = flat.unflatten(0, (width, -1))
            made = BlockRows(block, stacked, stacked[:, width:].unflatten(1, (count, samples)))
            self._complete(made, group, in_W)
            yield made

    def _multiplied(self, group: _Group, levels: Sequence[ColumnLevels]) -> Iterator[tuple[RowBlock, Array, Array]]:
        counts, widths = group.tables.blocks[:, 1:3].T
        sizes = widths * (counts * SPAN + _PADDING)
        scratch = self.workspace.empty("rows", group.W, int(sizes.sum()))
        lower, combination = (
            np.concatenate([getattr(x, name).ravel() for x in levels]) for name in ("lower", "to_lower")
        )
        replaced = np.array([len(x.lower) for x in levels])
        squares = np.empty(len(lower))
        grams = np.empty(int((widths**2).sum()))
        arguments = group.arguments(group.tables.placed(sizes), self.workspace)
        call("write_grams", *arguments, replaced, lower, combination, scratch, squares, grams)
        by_block = np.split(squares, np.cumsum(replaced)[:-1])
        matrices = np.split(grams, np.cumsum(widths**2)[:-1])
        for block, of_block, matrix, width in zip(group.blocks, by_block, matrices, widths.tolist(), strict=True):
            yield block, of_block, matrix.reshape(width, width)

    def _complete(self, made: BlockRows, group: _Group, in_W: Mapping[int, int]) -> None:
        """Add what kernels do not compute: a known payload, and columns of extra parameters; see `_Group`."""
        builder = self.builder
        samples = self.samples
        block = made.block
        subtract_payload(block, made.values, samples.payload, builder.columns.parameter_map)
        first = len(block.inertial) + len(block.friction)
        for out, column in zip(made.values[first:-1], block.extras, strict=True):
            extra = builder.extras[column - builder.columns.count]
            out.zero_()
            for joint in [joint for joint in extra.dofs if joint in in_W]:
                weight = group.W[:, in_W[joint], block.rows].expand(group.motion.tiles, -1, -1)
                weight = weight.transpose(0, 1).flatten(1)[:, : len(samples)]
                out.addcmul_(weight, dof_extra_column(extra, joint, samples, builder.tree))


class CompiledRows:
    """Compiled rows of a builder, float64 on a CPU, without resting joints; extra parameters only of joints."""

    def __init__(self, builder: RowBuilder) -> None:
        """Compute the constants."""
        tree = builder.tree
        self._builder = builder
        self._parent = np.maximum(tree.parents, 0)
        self._pose = np.ascontiguousarray(tree.T_parent_joint[:, :3]).reshape(-1)
        self._slides = np.array(tree.slides, dtype=float)
        moving = tree.joint_map[:, : tree.n].numpy()
        nodes, joints = map(np.ascontiguousarray, np.nonzero(moving))
        first = np.searchsorted(nodes, np.arange(tree.n_nodes + 1))
        kinds = (x.contiguous() for x in (tree.joint_constant, tree.revolute, tree.prismatic))
        self._mechanism: tuple[Word, ...] = (tree.n_nodes, tree.n, first, joints, moving[nodes, joints], *kinds)
        self._limbs: dict[int, tuple[Word, ...]] = {}
        self._tables_by_blocks: dict[int, _BlockTables] = {}

    def chunk(self, samples: Samples, layout: ContactStateLayout, workspace: Workspace) -> CompiledChunk | None:
        """The rows of a chunk, coupled ones first; None if joints rest or ranks of contacts differ."""
        if samples.resting is not None:
            return None
        builder = self._builder
        motion = self._motion(samples.motion(), workspace)
        bases = self._bases_by_kernel if _stands_on_limbs(builder, layout) else self._bases
        coupled = bases(samples, layout, motion, workspace)
        if coupled is None:
            return None
        of_rank = layout.blocks.of_rank(coupled[0].shape[2])
        joints = list(layout.uncoupled_joints)
        apart = tuple(layout.uncoupled_joints.values())
        in_W = {joint: row for row, joint in enumerate(layout.coupled_joints, start=builder.tree.base_rows)}
        weights = torch.from_numpy(1.0 / builder.dof_std[joints])[None, :, None, None].repeat(1, 1, 1, TILE)
        torque = builder.torque_of_bodies(samples)[:, builder.tree.index(joints)]
        groups = (
            _Group(of_rank, self._tables(of_rank, len(layout.coupled_joints)), motion, *coupled, [in_W] * len(of_rank)),
            _Group(apart, self._tables(apart, None), motion, weights, torque, [{x: k} for k, x in enumerate(joints)]),
        )
        return CompiledChunk(builder, samples, [group for group in groups if group.blocks], workspace)

    def _tables(self, blocks: tuple[RowBlock, ...], dofs: int | None) -> _BlockTables:
        key = id(blocks[0]) if blocks else 0  # of those that the builder's layouts keep
        if (tables := self._tables_by_blocks.get(key)) is None:
            tables = self._tables_by_blocks[key] = _BlockTables.of(blocks, self._builder.tree.base_rows, dofs)
        return tables

    def _motion(self, motion: Motion, workspace: Workspace) -> _Motion:
        """Motion of all joints by a kernel, as `joint_motion` gives it."""
        tree = self._builder.tree
        require_precision(tree, vars(motion))
        joint_rows = (motion.joint_position, motion.joint_velocity, motion.joint_acceleration, motion.joint_direction)
        base_rows = (motion.base_angular_velocity, motion.base_angular_acceleration, motion.base_specific_force)
        samples = len(motion.joint_position)
        log: list[Word] = [samples, *(0 if x is None else x.contiguous() for x in (*joint_rows, *base_rows))]
        tiles = -(-samples // TILE)
        joints = workspace.empty("joints", motion.joint_position, tiles, tree.n_nodes, 6, TILE)
        base = workspace.empty("base", joints, tiles, 9, TILE)
        call("write_motion", self._mechanism, tuple(log), tree.sign_width or 0.0, joints, base)
        return _Motion(tree.n_nodes, tiles, self._parent, self._pose, self._slides, joints, base)

    def _bases(
        self, samples: Samples, layout: ContactStateLayout, motion: _Motion, workspace: Workspace
    ) -> tuple[Tensor, Tensor] | None:
        """Tiles (T, degrees of freedom, rank, TILE) of W, forces (B, degrees of freedom); None where ranks differ."""
        builder = self._builder
        if not len(layout.row_std):
            return motion.base.new_empty(1, 0, 0, TILE), motion.base.new_empty(len(samples), 0)
        chunk = builder.kinematics(samples)
        contact = builder.contact_rows(layout, chunk)
        bases = list(builder.whitened_bases(layout, contact, chunk))
        if len(bases) != 1 or bases[0][1].shape[2] != len(samples):
            return None
        basis = bases[0][1]
        by_row = workspace.empty("W by row", basis, *basis.shape[:2], motion.tiles * TILE)
        by_row[..., : len(samples)] = basis
        by_row[..., len(samples) :] = 0.0
        W = workspace.empty("W", basis, motion.tiles, *basis.shape[:2], TILE)
        W.copy_(by_row.unflatten(2, (-1, TILE)).permute(2, 0, 1, 3))
        return W, builder.coupled_forces_with_contacts(layout, contact, chunk)

    def _bases_by_kernel(
        self, samples: Samples, layout: ContactStateLayout, motion: _Motion, workspace: Workspace
    ) -> tuple[Tensor, Tensor] | None:
        """The same where `_stands_on_limbs`."""
        builder = self._builder
        key = id(layout)  # which the builder keeps
        if key not in self._limbs:
            self._limbs[key] = _limbs(builder.tree, layout)
        W = workspace.empty("W", motion.base, motion.tiles, len(layout.row_std), _BASE, TILE)
        suspect = torch.empty(motion.tiles * TILE, dtype=torch.bool)
        axes = builder.noise_axes(samples.base.rotation, builder.sensors.noise)
        along = workspace.empty("axes", motion.base, motion.tiles * TILE, 3, 3)
        along[:] = torch.eye(3)
        if axes is not None:
            along[: len(samples)] = axes
        along = along.view(-1, TILE, 9).mT.contiguous()
        call("write_bases", motion, self._limbs[key], along, WELL_CONDITIONED**2, PIVOT, W, suspect)
        doubtful = torch.nonzero(suspect[: len(samples)])[:, 0]
        if len(doubtful):
            order = builder.tree.index(layout.blocks.order)
            contact = builder.contact_rows(layout, builder.kinematics(samples[doubtful]))
            axes = None if axes is None else axes[doubtful]
            for index, basis in general_bases(layout, contact, axes, order):
                if basis.shape[1] != _BASE:
                    return None
                W[doubtful[index] // TILE, :, :, doubtful[index] % TILE] = basis.permute(2, 0, 1)
        return W, builder.coupled_forces(samples, layout)


def _stands_on_limbs(builder: RowBuilder, layout: ContactStateLayout) -> bool:
    """Whether all contacts are limbs with unmeasured forces that are fixed to bodies."""
    spans = [body.span for body in layout.contact_bodies]
    return layout.has_own_limbs and not layout.measured and all(span is not None for span in spans)
