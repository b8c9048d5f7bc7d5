"""Streaming logs into triangular factors, chunk by chunk, by contact state and by folds for cross-validation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchid import distributed
from torchid.problem.blocks import (
    BlockRows,
    block_spans,
    blocks_in,
    cut_logs,
    lay_out_folds,
    rows_of_samples,
    span_of_samples,
)
from torchid.problem.chunk_dynamics import Workspace
from torchid.problem.chunks import ProgressCallback, chunks_by_state, map_chunks, worker_count
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import TriangularFactor
from torchid.problem.noise_gram import NoiseGram, estimate_noise_gram
from torchid.problem.parts import Part, PartKey, merge_factors, merge_parts
from torchid.problem.row_compressor import RowCompressor, RowWeighting
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.unloaded_sensors import unloaded_offset_equations

FOLDS = 5
"""Number of cross-validation folds of the training samples."""

LEAST_PER_FOLD = 20
"""Independent samples per fold: the filter correlates only a small part of these with neighbours."""

BLOCKS = 20
"""Number of blocks of the training samples whose scatter gives standard errors, at least where there are so many."""

_LEAST_PER_BLOCK = 10  # independent samples

_MEMORY = 2**30  # [bytes] of factors


def compress(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> TriangularFactor:
    """Stream all samples of some logs into one triangular factor.

    Args: as `map_chunks`.
    """
    return merge_factors(compress_by_state(logs, builder, chunk, threads, progress).values(), builder)


def compress_by_state(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> dict[ContactState, TriangularFactor]:
    """As `compress`, but with a factor for every contact state in the logs."""
    reduce = partial(_compress_chunks, builder, by_log=False)
    parts = merge_parts(map_chunks(logs, builder, reduce, chunk, threads, progress))
    add_noise_gram(parts, estimate_noise_gram(logs, builder, lambda _, state: _key(None, state)))
    return {part.state: part.factor for part in parts}


def compress_parts(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
    weight_rows: RowWeighting | None = None,
) -> list[Part]:
    """As `compress`, but with a factor for every contact state in every log and fold, in the order of the logs.

    Logs of one source count as one. Unknown offsets of contact sensors have further parts, of readings in the air.
    `weight_rows` weights all other rows before they are added; their factors then have no noise Gram matrix, see
    `add_noise_gram`.
    """
    return _compress_parts(logs, logs, builder, chunk, threads, progress, weight_rows)


def _compress_parts(
    logs: Sequence[Samples],
    pieces: Sequence[Samples],
    builder: RowBuilder,
    chunk: int | None,
    threads: int | None,
    progress: ProgressCallback | None,
    weight_rows: RowWeighting | None,
) -> list[Part]:
    """As `compress_parts`; `pieces`: the logs, cut where parts are."""

    def reduce(chunks: Iterator[tuple[Samples, ContactState]]) -> tuple[list[Part], RowWeighting | None]:
        weighting = None if weight_rows is None else weight_rows.for_worker()
        return _compress_chunks(builder, chunks, by_log=True, weight_rows=weighting), weighting

    done = map_chunks(logs, builder, reduce, chunk, threads, progress)
    parts = merge_parts(of_worker for of_worker, _ in done)
    if weight_rows is None:
        add_noise_gram(parts, noise_gram_by_part(pieces, builder, progress))
    else:
        for _, weighting in done:
            weight_rows.add(weighting)
    order = list(dict.fromkeys(samples.source for samples in logs))
    return sorted(parts, key=lambda part: order.index(part.source))


def compress_in_blocks(
    logs: Sequence[Samples],
    builder: RowBuilder,
    progress: ProgressCallback | None = None,
    weight_rows: RowWeighting | None = None,
) -> list[Part]:
    """As `compress_parts`, but each fold in blocks of successive samples, whose scatter widens standard errors.

    Args:
        logs: as `split_into_folds` cuts them.
        builder: of their rows.
        progress: called with the number of samples done.
        weight_rows: as in `compress_parts`.
    """
    parts = compress_spans(logs, _spans_of_blocks(logs, builder), builder, progress, weight_rows)
    return [*parts, *_unloaded_for_offsets(logs, builder)]


def _unloaded_for_offsets(logs: Sequence[Samples], builder: RowBuilder) -> list[Part]:
    """`compress_unloaded` where there are offsets to find."""
    fitted = any(extra.what == "offset" and extra.contact is not None for extra in builder.extras)
    return compress_unloaded(logs, builder) if fitted else []


def compress_in_folds(logs: Sequence[Samples], builder: RowBuilder) -> list[Part]:
    """What `merge_blocks_of_folds` makes of the parts of `compress_in_blocks`, without factors of the blocks."""
    pieces = [replace(piece, block=0) for piece in cut_into_blocks(logs, builder)]
    parts = _compress_parts([replace(log, unloaded=None) for log in logs], pieces, builder, None, None, None, None)
    return [*parts, *_unloaded_for_offsets(logs, builder)]


def compress_spans(
    logs: Sequence[Samples],
    spans: Sequence[Sequence[tuple[int, int]]],
    builder: RowBuilder,
    progress: ProgressCallback | None = None,
    weight_rows: RowWeighting | None = None,
) -> list[Part]:
    """As `compress_in_blocks`, without readings in the air; `spans`: first sample and end of the blocks of each log."""
    numbers = [np.repeat(range(len(own)), np.diff(own)[:, 0]) for own in spans]
    numbered = [
        replace(log, unloaded=None, blocks=torch.from_numpy(np.column_stack([np.full_like(own, log.fold), own])))
        for log, own in zip(logs, numbers, strict=True)
    ]
    return _compress_parts(numbered, cut_logs(numbered, spans), builder, None, None, progress, weight_rows)


def cut_into_blocks(logs: Sequence[Samples], builder: RowBuilder) -> list[Samples]:
    """The logs in blocks of about equal length, some `BLOCKS` in all; fewer where samples or memory are short."""
    return cut_logs(logs, _spans_of_blocks(logs, builder))


def _spans_of_blocks(logs: Sequence[Samples], builder: RowBuilder) -> list[list[tuple[int, int]]]:
    """First sample and end of the blocks of each log."""
    independent = sum(len(log) / log.oversampling for log in logs)
    states = len({(log.source, state) for log in logs for state, _ in chunks_by_state(log)})
    count = min(BLOCKS, int(independent / _LEAST_PER_BLOCK), _most_factors(states, builder))
    count, total = distributed.broadcast(count, "blocks"), sum(map(len, logs))
    return [block_spans(len(log), max(1, round(count * len(log) / max(total, 1)))) for log in logs]


def _compress_chunks(
    builder: RowBuilder,
    chunks: Iterator[tuple[Samples, ContactState]],
    by_log: bool,
    weight_rows: RowWeighting | None = None,
    loaded: bool = True,
) -> list[Part]:
    """Compress chunks into parts: one per log, contact state and fold, or one per contact state unless `by_log`.

    Without `loaded`, those of readings in the air alone.
    """
    parts, workspace = _Parts(builder, by_log), builder.workspaces.take()
    for samples, state in chunks:
        if loaded:
            parts.add(samples, state, workspace, weight_rows)
        for channel in unloaded_offset_equations(builder, samples):
            in_the_air = parts.part(samples, state, samples.fold, samples.block, unloaded=True)
            if channel.masked:
                in_the_air.masked.add(channel.offset)
            else:
                in_the_air.factor.add(*channel.row(builder), samples.oversampling)
    parts.close()
    builder.workspaces.give_back(workspace)
    return list(parts.parts.values())


class _Parts:
    """Parts that chunks are compressed to, with a compressor for each block that the last chunk has rows of."""

    def __init__(self, builder: RowBuilder, by_log: bool) -> None:
        self.parts: dict[PartKey, Part] = {}
        self._builder, self._by_log = builder, by_log
        self._compressors: dict[PartKey, RowCompressor] = {}
        self._absent: dict[tuple[PartKey, float], Tensor] = {}  # rows of zeros by oversampling, on the device

    def part(self, samples: Samples, state: ContactState, fold: int, block: int, unloaded: bool = False) -> Part:
        key = (samples.source, state, fold, block, unloaded) if self._by_log else _key(None, state)
        source, at, in_fold, in_block, in_the_air = key
        return self.parts.setdefault(
            key, Part(source, at, TriangularFactor(self._builder.width), 0, in_fold, in_block, in_the_air)
        )

    def add(
        self, samples: Samples, state: ContactState, workspace: Workspace, weight_rows: RowWeighting | None
    ) -> None:
        """Add the rows of a chunk, which are made at once, to the parts of its blocks."""
        spans = [(self.part(samples, state, fold, at), start, end) for fold, at, start, end in blocks_in(samples)]
        if spans[0][0].key not in self._compressors:  # no later chunk is of the blocks before
            self.finish()
        compressors = [self._compressors.setdefault(part.key, self._compressor()) for part, *_ in spans]
        for part, start, end in spans:
            part.samples += end - start
        one = weight_rows is None and len(spans) == 1
        for rows, index in self._remaining_rows(
            samples, state, workspace, spans[0][0], compressors[0] if one else None
        ):
            support, stacked = rows.block.support, rows.stacked.T
            if weight_rows is not None:
                weighted = stacked[len(support) + 1 :]
                weighted *= weight_rows(samples, support, weighted)
            for compressor, (part, start, end) in zip(compressors, spans, strict=True):
                own = rows_of_samples(rows, *span_of_samples(index, start, end), workspace)
                compressor.add(part.factor, support, own, samples.oversampling)
                if rows.absent is not None:
                    key, first, last = (part.key, samples.oversampling), *span_of_samples(index, start, end)
                    self._absent[key] = self._absent.get(key, 0) + rows.absent[:, first:last].sum()

    def _remaining_rows(
        self,
        samples: Samples,
        state: ContactState,
        workspace: Workspace,
        part: Part,
        compressor: RowCompressor | None,
    ) -> Iterator[tuple[BlockRows, Tensor | slice]]:
        """Add Gram matrices of a chunk's rows to a part, where kernels give them; gives all rows that were not added.

        `compressor`: of the part; None if rows are not to be added as they are.
        """
        kernels, layout = self._builder.compiled, self._builder.layout(state, samples.contact_normal is not None)
        chunk = None if kernels is None else kernels.chunk(samples, layout, workspace)
        if chunk is None or compressor is None:
            return self._builder.blocks(samples, state, workspace) if chunk is None else chunk.rows()
        added = set[int]()
        for block, squares, gram in chunk.grams(partial(compressor.levels, part.factor)):
            count = (block.rows.stop - block.rows.start) * len(samples)
            if compressor.add_gram(part.factor, block.support, squares, gram, count, samples.oversampling):
                added.add(id(block))
        return chunk.rows(added)

    def _compressor(self) -> RowCompressor:
        kernels = self._builder.compiled
        return RowCompressor() if kernels is None else RowCompressor(kernels.write_gram)

    def close(self) -> None:
        """Bring the factors, and their numbers of rows, up to date, for which the host waits for a GPU."""
        self.finish()
        for (key, oversampling), absent in self._absent.items():
            self.parts[key].factor.count(-int(absent), oversampling)
        self._absent.clear()

    def finish(self) -> None:
        """Bring the factors up to date."""
        for compressor in self._compressors.values():
            compressor.finish()
        self._compressors.clear()


def noise_gram_by_part(
    logs: Sequence[Samples], builder: RowBuilder, progress: ProgressCallback | None = None
) -> dict[PartKey, NoiseGram]:
    """The noise Gram matrix of each part of some logs, to `add_noise_gram`.

    Args: as `estimate_noise_gram`.
    """
    return estimate_noise_gram(logs, builder, _key, progress)


def _key(samples: Samples | None, state: ContactState, unloaded: bool = False) -> PartKey:
    """Of the part of a piece of a log in a contact state, or of all of a state without samples."""
    if samples is None:
        return "", state, 0, 0, False
    return samples.source, state, samples.fold, samples.block, unloaded


def add_noise_gram(parts: Sequence[Part], noise_gram: Mapping[PartKey, NoiseGram], weight: float = 1.0) -> None:
    """Add its noise Gram matrix to the factor of each part, times the mean weight of its rows."""
    for part in parts:
        part.factor.add_noise_gram(noise_gram.get(part.key, {}), weight)


def compress_unloaded(logs: Sequence[Samples], builder: RowBuilder) -> list[Part]:
    """Those parts of `compress_parts` that are of readings in the air."""
    return merge_parts(map_chunks(logs, builder, partial(_compress_chunks, builder, by_log=True, loaded=False)))


def split_into_folds(logs: Sequence[Samples], builder: RowBuilder) -> list[Samples]:
    """The logs, in order, cut into blocks contiguous in time, with the fold of each.

    Errors of successive samples are correlated: samples drawn at random would test a fit on its training data. A log is
    cut in proportion to its share of all samples; where there are many, whole logs are held out. Folds are fewer, down
    to a single one, if there are too few samples or too little memory for their factors.

    Args:
        logs: bound logs.
        builder: of their rows.
    """
    states: set[tuple[str, ContactState]] = {(log.source, state) for log in logs for state, _ in chunks_by_state(log)}
    count = fold_count(sum(len(log) / log.oversampling for log in logs), len(states), builder)
    out = []
    for log, blocks in zip(logs, lay_out_folds([len(log) for log in logs], count), strict=True):
        for start, stop, fold in blocks:
            out.append(replace(log if len(blocks) == 1 else log[start:stop], fold=fold))
    return out


def fold_count(independent: float, states: int, builder: RowBuilder) -> int:
    """Number of folds, at most `FOLDS`.

    Args:
        independent: number of independent samples.
        states: number of contact states, counted log by log.
        builder: of the rows.
    """
    count = max(1, min(FOLDS, int(independent / LEAST_PER_FOLD), _most_factors(states, builder)))
    return distributed.broadcast(count, "folds")


def _most_factors(states: int, builder: RowBuilder) -> int:
    """Number of factors of each of some contact states that there is memory for."""
    return _MEMORY // (8 * (builder.width + 1) ** 2 * max(states, 1) * worker_count(builder.device))
