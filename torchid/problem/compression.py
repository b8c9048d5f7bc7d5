"""Parts of logs (by log, contact state, fold and block): how logs are cut, what each part compresses to, merging."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchid import distributed
from torchid.parallel import one_thread
from torchid.problem.chunks import (
    ProgressCallback,
    chunks_by_state,
    map_chunks,
    span_of_samples,
    worker_count,
)
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import TriangularFactor
from torchid.problem.noise_gram import NoiseGram, PartKey, estimate_noise_gram
from torchid.problem.row_compressor import RowCompressor, RowWeighting
from torchid.problem.rows import BlockRows, RowBuilder, Workspace
from torchid.problem.samples import Samples
from torchid.problem.unloaded_sensors import unloaded_offset_equations
from torchid.reprs import short_repr

FOLDS = 5
"""Number of cross-validation folds of the training samples."""

LEAST_PER_FOLD = 20
"""Independent samples per fold, so that the filter correlates only a small part of them with neighbours."""

BLOCKS = 20
"""Smallest number of training blocks for standard errors from their scatter, if there are enough samples."""

_LEAST_PER_BLOCK = 10  # independent samples
_FACTOR_BYTES = 2**30  # of the factors of all parts

BY_FOLD = ("source", "fold", "unloaded")
"""Fields of `Part` for `merge` that join the contact states and blocks of each fold."""

SampleSpan = tuple[int, int]
"""First sample and end of successive samples of a log."""


@dataclass
class Part:
    """Compressed rows of one log (named by `source`) in one contact state, one fold and one block of it.

    Equations of unloaded contact sensors are in parts of their own, `unloaded`, which count no samples. `masked`:
    indices of extras that are offsets without such an equation, because their readings in the air are masked.
    """

    source: str
    state: ContactState
    factor: TriangularFactor
    samples: int
    fold: int = 0
    block: int = 0
    unloaded: bool = False
    masked: set[int] = field(default_factory=set)

    __repr__ = short_repr

    @property
    def key(self) -> PartKey:
        """Which rows it has."""
        return PartKey(self.source, self.state, self.fold, self.block, self.unloaded)


# ------------------------------------------------------------------------------------------------------------- merging


@one_thread()
def merge_factors(factors: Iterable[TriangularFactor], builder: RowBuilder) -> TriangularFactor:
    """One factor of the rows of several."""
    out = TriangularFactor(builder.width)
    out.merge(*factors)
    return out


def merge(parts: Sequence[Part], builder: RowBuilder, *by: str) -> list[Part]:
    """Merge all parts that agree in some fields of `Part`, on the CPU; the given parts do not change.

    The merged part has the contact state and fold of its first part. Without "block" in `by` its block is 0.

    Args:
        parts: of logs.
        builder: that made the rows.
        by: names of fields. Keep equations of unloaded sensors apart.
    """
    alike: dict[tuple[object, ...], list[Part]] = {}
    for part in parts:
        alike.setdefault(tuple(getattr(part, name) for name in by), []).append(part)
    out = []
    for members in alike.values():
        factor = merge_factors((part.factor.to_cpu() for part in members), builder)
        samples = sum(part.samples for part in members)
        masked = set[int]().union(*(part.masked for part in members))
        block = members[0].block if "block" in by else 0
        out.append(replace(members[0], factor=factor, samples=samples, masked=masked, block=block))
    return out


# ------------------------------------------------------------------------------------------------------------- cutting


def split_into_folds(logs: Sequence[Samples], builder: RowBuilder) -> list[Samples]:
    """Cut logs, in order, into blocks that are contiguous in time, and assign each to a cross-validation fold.

    Successive errors are correlated, so randomly drawn samples would test a fit on its training data. A log is cut in
    proportion to its share of all samples. With many logs, whole logs are held out. There are fewer folds, down to one,
    if samples or memory are short.

    Args:
        logs: bound logs.
        builder: that makes the rows.
    """
    independent = sum(len(log) / log.oversampling for log in logs)
    count = _fold_count(independent, _count_states(logs), builder)
    out = []
    for log, blocks in zip(logs, _lay_out_folds([len(log) for log in logs], count), strict=True):
        for start, stop, fold in blocks:
            out.append(replace(log if len(blocks) == 1 else log[start:stop], fold=fold))
    return out


def _lay_out_folds(
    lengths: Sequence[int], count: int, most: Sequence[int] | None = None
) -> list[list[tuple[int, int, int]]]:
    """Blocks of each log: first sample, end and fold.

    Args:
        lengths: samples of each log.
        count: number of folds.
        most: blocks of each log at most.
    """
    total = sum(lengths)
    preceding = 0
    out = []
    for index, length in enumerate(lengths):
        blocks = max(1, round(count * length / max(total, 1)))
        spans = block_spans(length, blocks if most is None else min(blocks, most[index]))
        middles = (preceding + (start + stop) / 2 for start, stop in spans)
        folds = (min(int(count * middle / max(total, 1)), count - 1) for middle in middles)
        out.append([(*span, fold) for span, fold in zip(spans, folds, strict=True)])
        preceding += length
    used = sorted({fold for blocks in out for _, _, fold in blocks})  # rounding may leave a fold empty
    return [[(start, stop, used.index(fold)) for start, stop, fold in blocks] for blocks in out]


def block_spans(length: int, blocks: int) -> list[SampleSpan]:
    """First sample and end of each of some blocks of a log."""
    return list(pairwise(length * k // blocks for k in range(blocks + 1)))


def in_blocks(logs: Sequence[Samples], spans: Sequence[Sequence[SampleSpan]]) -> list[Samples]:
    """The logs, to be compressed in a part for each block; `spans`: first sample and end of the blocks of each log."""
    out = []
    for log, spans_of_log in zip(logs, spans, strict=True):
        numbers = np.repeat(range(len(spans_of_log)), np.diff(spans_of_log)[:, 0])
        of_samples = np.column_stack([np.full_like(numbers, log.fold), numbers])
        out.append(replace(log, blocks=torch.from_numpy(of_samples)))
    return out


def _count_states(logs: Sequence[Samples]) -> int:
    """Number of contact states, counted log by log."""
    return len({(log.source, state) for log in logs for state, _ in chunks_by_state(log)})


def _fold_count(independent: float, states: int, builder: RowBuilder) -> int:
    """Number of folds, at most `FOLDS`, of so many independent samples in so many contact states."""
    count = max(1, min(FOLDS, int(independent / LEAST_PER_FOLD), _most_factors(states, builder)))
    return distributed.broadcast(count, "folds")


def _most_factors(states: int, builder: RowBuilder) -> int:
    """Number of factors of each of some contact states that there is memory for."""
    return _FACTOR_BYTES // (8 * (builder.width + 1) ** 2 * max(states, 1) * worker_count(builder.device))


# --------------------------------------------------------------------------------------------------------- compressing


def compress(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> TriangularFactor:
    """Compress all samples of logs into one triangular factor, in one pass. Arguments as in `map_chunks`."""
    return merge_factors((part.factor for part in compress_parts(logs, builder, chunk, threads, progress)), builder)


def compress_parts(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    weight_rows: RowWeighting | None = None,
) -> list[Part]:
    """As `compress`, with one factor for every contact state, fold and block of every log, in the order of the logs.

    Logs with the same source count as one. If contact sensors have unknown offsets, readings in the air make further
    parts. `weight_rows` weights all other rows before they are added; their factors then have no noise Gram matrix, see
    `add_noise_gram`.
    """

    def reduce(chunks: Iterator[tuple[Samples, ContactState]]) -> tuple[list[Part], RowWeighting | None]:
        weighting = None if weight_rows is None else weight_rows.for_worker()
        return _compress_chunks(builder, chunks, weighting), weighting

    loaded = [replace(log, unloaded=None) for log in logs]
    done = map_chunks(loaded, builder, reduce, chunk, threads, progress)
    parts = merge([part for of_worker, _ in done for part in of_worker], builder, *PartKey._fields)
    if weight_rows is None:
        add_noise_gram(parts, estimate_noise_gram(loaded, builder))
    else:
        for _, weighting in done:
            weight_rows.add(weighting)
    parts += compress_unloaded(logs, builder)
    order = list(dict.fromkeys(log.source for log in logs))
    return sorted(parts, key=lambda part: (part.unloaded, order.index(part.source)))


def compress_in_blocks(
    logs: Sequence[Samples],
    builder: RowBuilder,
    progress: ProgressCallback | None = None,
    weight_rows: RowWeighting | None = None,
) -> list[Part]:
    """As `compress_parts`, with each fold cut into blocks of successive samples. Their scatter widens standard errors.

    The blocks are about equally long, `BLOCKS` in all, or fewer if samples or memory are short.

    Args:
        logs: from `split_into_folds`.
        builder: that makes the rows.
        progress: called with the number of samples done.
        weight_rows: as in `compress_parts`.
    """
    independent = sum(len(log) / log.oversampling for log in logs)
    count = min(BLOCKS, int(independent / _LEAST_PER_BLOCK), _most_factors(_count_states(logs), builder))
    count = distributed.broadcast(count, "blocks")
    total = max(sum(map(len, logs)), 1)
    spans = [block_spans(len(log), max(1, round(count * len(log) / total))) for log in logs]
    return compress_parts(in_blocks(logs, spans), builder, progress=progress, weight_rows=weight_rows)


def _compress_chunks(
    builder: RowBuilder, chunks: Iterator[tuple[Samples, ContactState]], weight_rows: RowWeighting | None
) -> list[Part]:
    """Compress chunks, the rows of each of which are made at once, into the parts of their blocks."""
    parts: dict[PartKey, Part] = {}
    compressors: dict[PartKey, RowCompressor] = {}  # of the blocks that the last chunk has rows of
    absent: list[tuple[TriangularFactor, Tensor, float]] = []  # rows of zeros, counted where they were made
    workspace = builder.workspaces.take()

    for samples, state in chunks:
        spans = PartKey.spans(samples, state)
        _begin_blocks(spans, parts, compressors, builder)
        alone = compressors[spans[0][0]] if weight_rows is None and len(spans) == 1 else None
        for rows, index in _rows_to_add(builder, samples, state, workspace, alone):
            support = rows.block.support
            if weight_rows is not None:
                weighted = rows.stacked.T[len(support) + 1 :]
                weighted *= weight_rows(samples, support, weighted)
            for key, start, end in spans:
                first, last = span_of_samples(index, start, end)
                compressors[key].add(support, _stacked(rows, first, last, workspace), samples.oversampling)
                if rows.absent is not None:
                    absent.append((parts[key].factor, rows.absent[:, first:last].sum(), samples.oversampling))
    _begin_blocks([], parts, compressors, builder)
    for factor, count, oversampling in absent:
        factor.count(-int(count), oversampling)
    builder.workspaces.give_back(workspace)
    return list(parts.values())


def _begin_blocks(
    spans: Sequence[tuple[PartKey, int, int]],
    parts: dict[PartKey, Part],
    compressors: dict[PartKey, RowCompressor],
    builder: RowBuilder,
) -> None:
    """Open the blocks that a chunk has samples of; finish those before, which no later chunk has any of."""
    if not spans or spans[0][0] not in compressors:
        for compressor in compressors.values():
            compressor.finish()
        compressors.clear()
    for key, start, end in spans:
        if key not in parts:
            parts[key] = Part(key.source, key.state, TriangularFactor(builder.width), 0, key.fold, key.block)
        if key not in compressors:
            compressors[key] = RowCompressor(parts[key].factor)
        parts[key].samples += end - start


def _rows_to_add(
    builder: RowBuilder,
    samples: Samples,
    state: ContactState,
    workspace: Workspace,
    compressor: RowCompressor | None,
) -> Iterator[tuple[BlockRows, Tensor | slice]]:
    """The rows of a chunk, but for those whose Gram matrices compiled kernels have added to a compressor.

    `compressor`: that takes all rows of the chunk as they are; None if there is none.
    """
    layout = builder.layout_of(samples, state)
    chunk = None if builder.compiled is None else builder.compiled.chunk(samples, layout, workspace)
    if chunk is None:
        return builder.blocks(samples, state, workspace)
    if compressor is None:
        return chunk.rows()
    added = set[int]()
    for block, squares, gram in chunk.grams(compressor.levels):
        count = (block.rows.stop - block.rows.start) * len(samples)
        if compressor.add_gram(block.support, squares, gram, count, samples.oversampling):
            added.add(id(block))
    return chunk.rows(added)


def _stacked(rows: BlockRows, first: int, last: int, workspace: Workspace) -> Tensor:
    """The rows of some of the samples, as `RowCompressor.add` takes them; where these are all, without a copy."""
    width, each, count = rows.values.shape
    if last - first == count:
        return rows.stacked.T
    out = workspace.empty("rows of some samples", rows.values, width, width + each * (last - first))
    out[:, width:].unflatten(1, (each, last - first)).copy_(rows.values[..., first:last])
    return out.T


def add_noise_gram(parts: Sequence[Part], noise_gram: Mapping[PartKey, NoiseGram], weight: float = 1.0) -> None:
    """Add its noise Gram matrix to the factor of each part, times the mean weight of its rows."""
    for part in parts:
        part.factor.add_noise_gram(noise_gram.get(part.key, {}), weight)


@one_thread()
def compress_unloaded(logs: Sequence[Samples], builder: RowBuilder) -> list[Part]:
    """Those parts of `compress_parts` that are of readings in the air, where there are offsets to find by them."""
    parts: dict[PartKey, Part] = {}
    if not any(extra.what == "offset" and extra.contact is not None for extra in builder.extras):
        return []
    for log in logs:
        for state, index in chunks_by_state(log) if log.unloaded is not None else ():
            samples = log[index]
            key = PartKey(log.source, state, log.fold, 0, True)
            for channel in unloaded_offset_equations(builder, samples):
                part = parts.setdefault(key, Part(log.source, state, TriangularFactor(builder.width), 0, *key[2:]))
                if channel.masked:
                    part.masked.add(channel.offset)
                else:
                    part.factor.add(*channel.row(builder), samples.oversampling)
    return list(parts.values())


# ------------------------------------------------------------------------------------------------------ compressed logs


@dataclass(frozen=True)
class CompressedLog:
    """Factors of one log, in pieces that later fits merge to blocks.

    Blocks are those of `split_into_folds`: one for a log among many, several for a long log. Equations of readings in
    the air are means over whole blocks, so they are stored for every block of every number of blocks. A piece has one
    factor for all contact states. Each contact state has one factor for the whole log.

    Attributes:
        source: name of the log.
        samples: number of samples.
        oversampling, noise_left: as in `Samples`.
        blocks: largest number of blocks.
        pieces: a factor for each of `piece_spans`, in time order.
        by_state: a factor for each contact state of the whole log.
        unloaded: equations of readings in the air, by block.
    """

    source: str
    samples: int
    oversampling: float
    noise_left: float
    blocks: int
    pieces: list[Part]
    by_state: list[Part]
    unloaded: dict[SampleSpan, list[Part]]

    __repr__ = short_repr

    def _headline(self) -> str:
        return f"{self.rows} equations from {self.samples} samples in up to {self.blocks} blocks"

    def __len__(self) -> int:
        return self.samples

    @property
    def rows(self) -> int:
        """Number of equations, without those of readings in the air."""
        return sum(part.factor.rows for part in self.pieces)

    def block(self, start: int, stop: int, fold: int) -> CompressedBlock:
        """A block of the log."""
        spans = zip(piece_spans(self.samples, self.blocks), self.pieces, strict=True)
        pieces = [part for (first, last), part in spans if start <= first and last <= stop]
        parts = [replace(part, fold=fold, block=number) for number, part in enumerate(pieces)]
        parts += [replace(part, fold=fold) for part in self.unloaded.get((start, stop), [])]
        return CompressedBlock(self.source, fold, stop - start, self.noise_left, parts)


@dataclass(frozen=True)
class CompressedBlock:
    """A block of a compressed log in a fold; it replaces the samples.

    Attributes:
        source: name of the log.
        fold: number of the fold.
        samples: number of samples.
        noise_left: as in `Samples`.
        parts: one factor for all contact states (its `state` has no meaning), and equations of readings in the air.
    """

    source: str
    fold: int
    samples: int
    noise_left: float
    parts: list[Part]

    def __len__(self) -> int:
        return self.samples


Block = Samples | CompressedBlock
"""Samples of one log in one fold, or their compressed form."""


def piece_spans(samples: int, blocks: int) -> list[SampleSpan]:
    """Pieces of a log that make up the blocks of every number of blocks up to a largest one."""
    ends = {end for count in range(1, blocks + 1) for span in block_spans(samples, count) for end in span}
    return list(pairwise(sorted(ends)))


def compress_log(log: Samples, builder: RowBuilder, progress: ProgressCallback | None = None) -> CompressedLog:
    """Compress one log, to fit it later together with others.

    For example::

        compressed = [torchid.compress_log(log, builder) for log in logs]
        blocks = torchid.fold_compressed(compressed, builder)
        fit = fitter.fit([part for block in blocks for part in block.parts])

    The result equals that of `split_into_folds` and `compress_parts` for logs that are all in memory.

    Args:
        log: a bound log.
        builder: that makes the rows.
        progress: called with the number of samples done.
    """
    folds = round(len(log) / log.oversampling / LEAST_PER_FOLD)  # rounded, as its share of the folds of a fit is
    blocks = _fold_count(LEAST_PER_FOLD * folds, _count_states([log]), builder)
    (in_pieces,) = in_blocks([replace(log, unloaded=None)], [piece_spans(len(log), blocks)])
    parts = compress_parts([in_pieces], builder, progress=progress)
    unloaded: dict[SampleSpan, list[Part]] = {}
    for count in range(1, blocks + 1):
        spans = block_spans(len(log), count)
        whole_blocks = [replace(log[slice(*span)], fold=number) for number, span in enumerate(spans)]
        for part in compress_unloaded(whole_blocks, builder):
            unloaded.setdefault(spans[part.fold], []).append(_compact(part))
    pieces = sorted(merge(parts, builder, "block"), key=lambda part: part.block)
    return CompressedLog(
        source=log.source,
        samples=len(log),
        oversampling=log.oversampling,
        noise_left=log.noise_left,
        blocks=blocks,
        pieces=list(map(_compact, pieces)),
        by_state=list(map(_compact, merge(parts, builder, "state"))),
        unloaded=unloaded,
    )


def fold_compressed(logs: Sequence[CompressedLog], builder: RowBuilder) -> list[CompressedBlock]:
    """Cut compressed logs, in order, into the blocks and folds that `split_into_folds` makes of their samples.

    Args:
        logs: compressed logs with different names.
        builder: that made the rows.
    """
    independent = sum(len(log) / log.oversampling for log in logs)
    count = _fold_count(independent, sum(len(log.by_state) for log in logs), builder)
    layout = _lay_out_folds([len(log) for log in logs], count, [log.blocks for log in logs])
    return [log.block(*block) for log, blocks in zip(logs, layout, strict=True) for block in blocks]


@one_thread()
def _compact(part: Part) -> Part:
    return replace(part, factor=part.factor.compact())
