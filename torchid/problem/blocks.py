"""How logs are cut into folds and blocks, and the rows of a chunk by blocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchid.problem.chunk_dynamics import Workspace
from torchid.problem.row_blocks import RowBlock
from torchid.problem.samples import Samples, concatenate


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
