"""Rows of a chunk by the compiled kernels of `torchid.kernels`: the same as `RowBuilder`'s."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchid.kernels import limbs, rows, states
from torchid.kernels.gram import SPAN, write_gram, write_grams
from torchid.kernels.tiles import TILE
from torchid.parameters import Array
from torchid.problem.contact_state import ContactStateLayout, RowBlock
from torchid.problem.extras import dof_extra_column
from torchid.problem.null_bases import general_bases
from torchid.problem.row_compressor import ColumnLevels
from torchid.problem.rows import BlockRows, Chunk, RowBuilder, Workspace, subtract_payload
from torchid.problem.samples import Samples
from torchid.regressor.kinematics import BodyStates, JointMotion, Motion, joint_motion
from torchid.regressor.tree import KinematicTree
from torchid.sensing.limbs import PIVOT, WELL_CONDITIONED


@dataclass(frozen=True)
class _Tiles:
    """Motion of all joints, (6, L, P), and states of all nodes, (P / TILE, L, STATE, TILE), as the kernels have them.

    `samples`: B, the first ones of the P. `motion`: of their joints, as torch has it.
    """

    joints: Tensor
    states: Tensor
    samples: int
    motion: JointMotion

    def chunk(self, samples: Samples, index: Tensor) -> Chunk:
        """Some of the samples: what the rows of contacts that are fixed to bodies are made of."""
        parts = self.states[index // TILE, :, :, index % TILE].permute(2, 1, 0)
        rotation = parts[: states.POSITION].unflatten(0, (3, 3))
        starts = (states.POSITION, states.OMEGA, states.ALPHA, states.FORCE, states.SCREW)
        vectors = (parts[start : start + 3] for start in starts[:-1])
        joints = JointMotion(*(x[:, index] for x in vars(self.motion).values()))
        screw_axes = parts[states.SCREW :]
        body_states = BodyStates(rotation, *vectors)
        return Chunk(samples[index], joints, body_states, screw_axes, None, {}, {}, screw_axes[:, :0])


class _Limbs(NamedTuple):
    """Arguments of `limbs.write_bases` for a contact state, in order."""

    limbs: np.ndarray
    wrenches: Array
    dofs: np.ndarray
    moved: np.ndarray
    ratios: Array
    row_std: Array

    @classmethod
    def of(cls, tree: KinematicTree, layout: ContactStateLayout) -> _Limbs:
        table = list[list[int]]()
        wrenches = list[Tensor]()
        dofs = list[int]()
        moved = list[tuple[int, int]]()
        ratios = list[float]()
        for body in layout.contact_bodies:
            first = len(moved)
            count = len(body.joints)
            for number, joint in enumerate(body.joints):
                for node in tree.path(body.body):
                    if ratio := float(tree.joint_map[node, layout.coupled_joints[joint]]):
                        moved.append((number, node))
                        ratios.append(ratio)
            table.append([body.body, count, len(dofs), first, len(moved)])
            if body.span is not None:
                wrenches.append(body.span)
            dofs.extend(body.joints)
        flat = torch.cat(wrenches).flatten().numpy()
        return cls(np.array(table), flat, np.array(dofs), np.array(moved), np.array(ratios), layout.row_std.numpy())


@dataclass(frozen=True)
class _BlockTables:
    """Some blocks as the integer tables that `rows.write_rows` takes."""

    blocks: np.ndarray
    moved: np.ndarray
    ratios: Array
    bodies: np.ndarray
    kept: np.ndarray

    @classmethod
    def of(cls, blocks: tuple[RowBlock, ...], base: int, dofs: int | None) -> _BlockTables:
        """From blocks, with so many degrees of freedom after those of the base; None for single rows."""
        table = list[list[int]]()
        moved = list[list[int]]()
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
                moved.append([number, node, dof, first + of_base + place, upper, column])
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
        return cls(
            np.array([[*row, first] for row in table]),
            np.array(moved, dtype=int).reshape(-1, 6),
            np.array(ratios, dtype=float),
            np.array(bodies, dtype=int).reshape(-1, 6),
            np.array(kept, dtype=int),
        )

    @property
    def of_bodies(self) -> tuple[np.ndarray, Array, np.ndarray, np.ndarray]:
        """What follows the blocks in the arguments of `rows.write_rows`."""
        return self.moved, self.ratios, self.bodies, self.kept

    def placed(self, samples: int) -> tuple[np.ndarray, int]:
        """The blocks, one after the other in memory for so many samples, and how many numbers they are."""
        out = self.blocks.copy()
        width = self.blocks[:, 2]
        sizes = width * (width + self.blocks[:, 1] * samples)
        out[:, 3] = _starts(sizes)
        return out, int(sizes.sum())


@dataclass(frozen=True)
class _Group:
    """Blocks of rows that kernels make at once.

    Attributes:
        blocks: the blocks.
        tables: of these.
        tiles: of all samples.
        W: tiles (T, degrees of freedom, rank, TILE) of it, or one for all.
        f: measured forces, (B, degrees of freedom).
        joints: of each block, where those that it combines are among the degrees of freedom.
    """

    blocks: tuple[RowBlock, ...]
    tables: _BlockTables
    tiles: _Tiles
    W: Tensor
    f: Tensor
    joints: Sequence[Mapping[int, int]]

    def arrays(self, workspace: Workspace) -> tuple[Array, Array, int, int, Array, int, int, Array]:
        """The first arguments of `rows.write_rows`."""
        joints = self.tiles.joints
        samples = self.tiles.samples
        forces = workspace.empty("forces", self.W, self.f.shape[1], samples)
        forces.copy_(self.f.T)
        step = self.W[0].numel() if len(self.W) > 1 else 0
        of_tiles = _flat(self.tiles.states), _flat(joints), joints.shape[1], samples
        return *of_tiles, _flat(self.W), self.W.shape[2], step, _flat(forces)


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
        """Blocks, squares and Gram matrices as `GramWriter` writes them; the rows never leave the caches.

        Only for groups with levels of all their blocks, and without parts that kernels do not know.
        """
        if self.samples.payload is None and not self.builder.extras:
            for group in self.groups:
                known = [block_levels for block in group.blocks if (block_levels := levels(block.support)) is not None]
                if len(known) == len(group.blocks):
                    yield from self._multiplied(group, known)

    def _written(self, group: _Group) -> Iterator[BlockRows]:
        count = len(self.samples)
        placed, size = group.tables.placed(count)
        flat = self.workspace.empty("rows", group.W, size)
        rows.write_rows(*group.arrays(self.workspace), placed, *group.tables.of_bodies, flat.numpy())
        for block, in_W, (_, each, width, start, *_) in zip(group.blocks, group.joints, placed.tolist(), strict=True):
            stacked = flat[start:][: width * (width + each * count)].unflatten(0, (width, -1))
            made = BlockRows(block, stacked, stacked[:, width:].unflatten(1, (each, count)))
            self._complete(made, group.W, in_W)
            yield made

    def _multiplied(self, group: _Group, levels: Sequence[ColumnLevels]) -> Iterator[tuple[RowBlock, Array, Array]]:
        tables = group.tables
        placed, size = tables.placed(min(SPAN, group.tiles.samples))
        flat = self.workspace.empty("rows", group.W, size)
        widths = tables.blocks[:, 2]
        counts = np.array([len(x.lower) for x in levels])
        lower, combination = (
            np.concatenate([getattr(x, name).ravel() for x in levels]) for name in ("lower", "to_lower")
        )
        table = np.column_stack([_starts(counts), counts, _starts(counts * widths), _starts(widths**2)])
        squares = np.empty(len(lower))
        grams = np.empty(int((widths**2).sum()))
        write_grams(
            *(*group.arrays(self.workspace), placed, *tables.of_bodies, table, lower, combination, flat.numpy()),
            *(squares, grams),
        )
        for block, (first, count, _, start), width in zip(group.blocks, table.tolist(), widths.tolist(), strict=True):
            gram = grams[start : start + width**2].reshape(width, width)
            yield block, squares[first : first + count], gram

    def _complete(self, made: BlockRows, W: Tensor, in_W: Mapping[int, int]) -> None:
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
                weight = W[:, in_W[joint], block.rows].expand(-(-len(samples) // TILE), -1, -1)
                weight = weight.transpose(0, 1).flatten(1)[:, : len(samples)]
                out.addcmul_(weight, dof_extra_column(extra, joint, samples, builder.tree))


class CompiledRows:
    """Compiled rows of a builder, float64 on a CPU, without resting joints; extra parameters only of joints.

    `write_gram`: the kernel that multiplies them.
    """

    write_gram = staticmethod(write_gram)

    def __init__(self, builder: RowBuilder) -> None:
        """Compute the constants."""
        tree = builder.tree
        self._builder = builder
        self._parent = np.maximum(tree.parents, 0)
        self._pose = np.ascontiguousarray(tree.T_parent_joint[:, :3]).reshape(-1)
        self._slides = np.array(tree.slides, dtype=float)
        self._limbs: dict[int, _Limbs] = {}
        self._tables_by_blocks: dict[int, _BlockTables] = {}

    def chunk(self, samples: Samples, layout: ContactStateLayout, workspace: Workspace) -> CompiledChunk | None:
        """The rows of a chunk, coupled ones first; None if joints rest or ranks of contacts differ."""
        if samples.resting is not None:
            return None
        builder = self._builder
        tiles = self._tiles(samples.motion(), workspace)
        bases = self._bases_by_kernel if _stands_on_limbs(builder, layout) else self._bases
        coupled = bases(samples, layout, tiles, workspace)
        if coupled is None:
            return None
        of_rank = layout.blocks.of_rank(coupled[0].shape[2])
        joints = list(layout.uncoupled_joints)
        apart = tuple(layout.uncoupled_joints.values())
        in_W = {joint: row for row, joint in enumerate(layout.coupled_joints, start=builder.tree.base_rows)}
        weights = torch.from_numpy(1.0 / builder.dof_std[joints])[None, :, None, None].repeat(1, 1, 1, TILE)
        torque = builder.torque_of_bodies(samples)[:, builder.tree.index(joints)]
        groups = (
            _Group(of_rank, self._tables(of_rank, len(layout.coupled_joints)), tiles, *coupled, [in_W] * len(of_rank)),
            _Group(apart, self._tables(apart, None), tiles, weights, torque, [{x: k} for k, x in enumerate(joints)]),
        )
        return CompiledChunk(builder, samples, [group for group in groups if group.blocks], workspace)

    def _tables(self, blocks: tuple[RowBlock, ...], dofs: int | None) -> _BlockTables:
        key = id(blocks[0]) if blocks else 0  # of those that the builder's layouts keep
        if (tables := self._tables_by_blocks.get(key)) is None:
            tables = self._tables_by_blocks[key] = _BlockTables.of(blocks, self._builder.tree.base_rows, dofs)
        return tables

    def _tiles(self, motion: Motion, workspace: Workspace) -> _Tiles:
        joints = joint_motion(self._builder.tree, motion)
        nodes, samples = joints.position.shape
        padded = -(-samples // TILE) * TILE
        out = workspace.empty("joints", joints.position, 6, nodes, padded)
        base = workspace.empty("base", joints.position, 9, padded)
        out[..., samples:] = 0.0
        base[:, samples:] = 0.0
        used = out[..., :samples]
        angle = joints.position * self._builder.tree.revolute
        torch.cos(angle, out=used[states.COSINE])
        torch.sin(angle, out=used[states.SINE])
        torch.mul(joints.position, self._builder.tree.prismatic, out=used[states.SLIDE])
        used[states.VELOCITY] = joints.velocity
        used[states.ACCELERATION] = joints.acceleration
        used[states.DIRECTION] = joints.direction
        of_base = (motion.base_angular_velocity, motion.base_angular_acceleration, motion.base_specific_force)
        torch.cat([x.T for x in of_base], out=base[:, :samples])
        made = workspace.empty("states", base, padded // TILE, nodes, states.STATE, TILE)
        states.write_states(self._parent, self._pose, self._slides, _flat(out), _flat(base), _flat(made))
        return _Tiles(out, made, samples, joints)

    def _bases(
        self, samples: Samples, layout: ContactStateLayout, tiles: _Tiles, workspace: Workspace
    ) -> tuple[Tensor, Tensor] | None:
        """Tiles (T, degrees of freedom, rank, TILE) of W, forces (B, degrees of freedom); None where ranks differ."""
        builder = self._builder
        m = len(layout.row_std)
        if not m:
            return tiles.states.new_empty(1, 0, 0, TILE), tiles.states.new_empty(tiles.samples, 0)
        chunk = builder.kinematics(samples)
        contact = builder.contact_rows(layout, chunk)
        bases = list(builder.whitened_bases(layout, contact, chunk))
        if len(bases) != 1 or bases[0][1].shape[2] != tiles.samples:
            return None
        basis = bases[0][1]
        padded = workspace.empty("W by row", basis, *basis.shape[:2], len(tiles.states) * TILE)
        padded[..., : tiles.samples] = basis
        padded[..., tiles.samples :] = 0.0
        W = workspace.empty("W", basis, len(tiles.states), *basis.shape[:2], TILE)
        W.copy_(padded.unflatten(2, (-1, TILE)).permute(2, 0, 1, 3))
        return W, builder.coupled_forces_with_contacts(layout, contact, chunk)

    def _bases_by_kernel(
        self, samples: Samples, layout: ContactStateLayout, tiles: _Tiles, workspace: Workspace
    ) -> tuple[Tensor, Tensor] | None:
        """The same where `_stands_on_limbs`."""
        key = id(layout)  # which the builder keeps
        if key not in self._limbs:
            self._limbs[key] = _Limbs.of(self._builder.tree, layout)
        table = self._limbs[key]
        count, nodes = tiles.states.shape[:2]
        W = workspace.empty("W", tiles.states, count, len(table.row_std), limbs.BASE, TILE)
        suspect = torch.empty(count * TILE, dtype=torch.bool)
        axes = self._builder.noise_axes(samples.base.rotation, self._builder.sensors.noise)
        along = workspace.empty("axes", tiles.states, 3, 3, count * TILE)
        along[..., : tiles.samples] = torch.eye(3)[..., None] if axes is None else axes.permute(1, 2, 0)
        along[..., tiles.samples :] = 0.0
        chunk_arrays = _flat(tiles.states), _flat(along), nodes
        limbs.write_bases(*chunk_arrays, *table, WELL_CONDITIONED**2, PIVOT, _flat(W), suspect.numpy())
        doubtful = torch.nonzero(suspect[: tiles.samples])[:, 0]
        if len(doubtful):
            order = self._builder.tree.index(layout.blocks.order)
            contact = self._builder.contact_rows(layout, tiles.chunk(samples, doubtful))
            axes = None if axes is None else axes[doubtful]
            for index, basis in general_bases(layout, contact, axes, order):
                if basis.shape[1] != limbs.BASE:
                    return None
                W[doubtful[index] // TILE, :, :, doubtful[index] % TILE] = basis.permute(2, 0, 1)
        return W, self._builder.coupled_forces(samples, layout)


def _stands_on_limbs(builder: RowBuilder, layout: ContactStateLayout) -> bool:
    """Whether all contacts are limbs with unmeasured forces that are fixed to bodies."""
    spans = [body.span for body in layout.contact_bodies]
    return layout.has_own_limbs and not layout.measured and all(span is not None for span in spans)


def _starts(sizes: np.ndarray) -> np.ndarray:
    """Where things of some sizes start, one after the other."""
    return np.cumsum(sizes) - sizes


def _flat(x: Tensor) -> Array:
    return x.view(-1).numpy()
