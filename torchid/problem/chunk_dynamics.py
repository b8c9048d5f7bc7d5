"""Chunks of samples: pieces of logs in folds and blocks, kinematics and dynamics, rows, and reused memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchid.problem.row_blocks import RowBlock
from torchid.problem.samples import Samples, concatenate
from torchid.regressor.kinematics import BodyStates, JointMotion


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

    def some(self, index: slice) -> ChunkKinematics:
        """The kinematics of some samples, views."""
        return ChunkKinematics(
            JointMotion(*(x[..., index] for x in vars(self.joints).values())),
            BodyStates(*(x[..., index] for x in vars(self.states).values())),
            self.screw_axes[..., index],
            None if self.rotation_world_base is None else self.rotation_world_base[index],
            {contact: arm[..., index] for contact, arm in self.arms.items()},
            self.recorded_normals,
            {contact: axes[..., index] for contact, axes in self.ground_axes.items()},
            None if self.resting is None else self.resting[..., index],
        )


@dataclass(frozen=True)
class ChunkDynamics(ChunkKinematics):
    """Kinematics of B samples with the columns of the inertial parameters, from which rows are computed.

    Attributes:
        wrenches: (6, columns, B), wrench at the base origin of a unit of each inertial parameter; the forces of
            inertias, which are zero, need not have been written.
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
            {contact: pick(arms) for contact, arms in self.arms.items()},
            self.recorded_normals,
            {contact: pick(axes) for contact, axes in self.ground_axes.items()},
            None if self.resting is None else pick(self.resting),
            pick(self.wrenches),
        )


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


def lay_out_folds(
    lengths: Sequence[int], count: int, most: Sequence[int] | None = None
) -> list[list[tuple[int, int, int]]]:
    """Blocks of each log: first sample, end and fold.

    Args:
        lengths: samples of each log.
        count: number of folds.
        most: blocks of each log at most.
    """
    total, preceding, out = sum(lengths), 0, []
    for index, length in enumerate(lengths):
        blocks = max(1, round(count * length / max(total, 1)))
        spans = block_spans(length, blocks if most is None else min(blocks, most[index]))
        middles = (preceding + (start + stop) / 2 for start, stop in spans)
        folds = (min(int(count * middle / max(total, 1)), count - 1) for middle in middles)
        out.append([(*span, fold) for span, fold in zip(spans, folds, strict=True)])
        preceding += length
    used = sorted({fold for blocks in out for _, _, fold in blocks})  # rounding may leave a fold empty
    return [[(start, stop, used.index(fold)) for start, stop, fold in blocks] for blocks in out]


def block_spans(length: int, blocks: int) -> list[tuple[int, int]]:
    """First sample and end of each of some blocks of a log."""
    ends = [length * k // blocks for k in range(blocks + 1)]
    return list(zip(ends, ends[1:], strict=False))


def cut_logs(logs: Sequence[Samples], spans: Sequence[Sequence[tuple[int, int]]]) -> list[Samples]:
    """Pieces of each log, numbered as blocks, by first sample and end."""
    return [
        replace(log if len(own) == 1 else log[slice(*span)], block=number, blocks=None)
        for log, own in zip(logs, spans, strict=True)
        for number, span in enumerate(own)
    ]


def are_of_one_log(piece: Samples, other: Samples) -> bool:
    """Whether two pieces differ in samples, folds and blocks alone, and have no readings in the air.

    Each fold, and each chunk, has equations of its own of these readings.
    """
    if piece.unloaded is not None or other.unloaded is not None:
        return False
    own, others = (
        {name: x for name, x in (vars(log) | vars(log.base)).items() if name not in ("base", "fold", "block", "blocks")}
        for log in (piece, other)
    )
    return all(
        x is others[name] or isinstance(x, Tensor) is isinstance(others[name], Tensor) is True
        for name, x in own.items()
    )


def join_pieces(pieces: Sequence[Samples]) -> Samples:
    """Pieces of one log as one, which has the fold and block of each sample."""
    if len(pieces) == 1:
        return pieces[0]
    numbers = [
        torch.tensor([[piece.fold, piece.block]]).expand(len(piece), 2) if piece.blocks is None else piece.blocks
        for piece in pieces
    ]
    return replace(concatenate([replace(piece, blocks=None) for piece in pieces]), blocks=torch.cat(numbers))


def blocks_in(samples: Samples) -> list[tuple[int, int, int, int]]:
    """Fold, number, first sample and end of the blocks that a chunk has samples of."""
    if samples.blocks is None:
        return [(samples.fold, samples.block, 0, len(samples))]
    numbers, counts = torch.unique_consecutive(samples.blocks, return_counts=True, dim=0)
    ends = counts.cumsum(0).tolist()
    spans = zip(numbers.tolist(), [0, *ends[:-1]], ends, strict=True)
    return [(fold, number, start, end) for (fold, number), start, end in spans]


def folds_in(samples: Samples) -> list[tuple[int, int, int]]:
    """Number, first sample and end of the folds that a chunk has samples of."""
    spans = [(fold, start, end) for fold, _, start, end in blocks_in(samples)]
    starts = [at for at, (fold, *_) in enumerate(spans) if not at or fold != spans[at - 1][0]]
    return [(*spans[at][:2], spans[last - 1][2]) for at, last in zip(starts, [*starts[1:], len(spans)], strict=True)]


def span_of_samples(index: Tensor | slice, start: int, end: int) -> tuple[int, int]:
    """Which of the samples of some rows, all or some of those of a chunk, lie between two of the chunk."""
    if isinstance(index, Tensor):  # of samples whose contacts have one rank
        start, end = torch.searchsorted(index, torch.tensor([start, end]).to(index)).tolist()
    return start, end


def rows_of_samples(rows: BlockRows, first: int, last: int, workspace: Workspace) -> Tensor:
    """The rows of some of the samples, as `RowCompressor.add` takes them; where these are all, without a copy."""
    width, each, count = rows.values.shape
    if last - first == count:
        return rows.stacked.T
    out = workspace.empty("rows of some samples", rows.values, width, width + each * (last - first))
    out[:, width:].unflatten(1, (each, last - first)).copy_(rows.values[..., first:last])
    return out.T
