"""Streaming logs into triangular factors, by contact state and by folds: of several logs, or one by one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from torchid import distributed
from torchid.parallel import one_thread
from torchid.problem.chunk_dynamics import (
    BlockRows,
    Workspace,
    block_spans,
    blocks_in,
    cut_logs,
    lay_out_folds,
    rows_of_samples,
    span_of_samples,
)
from torchid.problem.chunks import ProgressCallback, chunks_by_state, map_chunks, worker_count
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import TriangularFactor
from torchid.problem.noise_gram import NoiseGram, estimate_noise_gram
from torchid.problem.row_compressor import RowCompressor, RowWeighting
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.unloaded_sensors import unloaded_offset_equations
from torchid.reprs import short_repr

PartKey = tuple[str, ContactState, int, int, bool]  # source, state, fold, block, unloaded


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
        return self.source, self.state, self.fold, self.block, self.unloaded


@one_thread()
def merge_parts(of_workers: Iterable[list[Part]]) -> list[Part]:
    """The parts of all workers, those of one log, contact state and fold merged, on the CPU."""
    total: dict[PartKey, list[Part]] = {}
    for part in chain.from_iterable(of_workers):
        part.factor = part.factor.to_cpu()
        total.setdefault(part.key, []).append(part)
    for first, *others in total.values():
        first.samples += sum(part.samples for part in others)
        first.masked = first.masked.union(*(part.masked for part in others))
        first.factor.merge(*(part.factor for part in others))
    return [first for first, *_ in total.values()]


@one_thread()
def merge_factors(factors: Iterable[TriangularFactor], builder: RowBuilder) -> TriangularFactor:
    """One factor of the rows of several."""
    out = TriangularFactor(builder.width)
    out.merge(*factors)
    return out


def merge_states(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """Parts with the contact states of each log and fold merged; offset equations of unloaded sensors stay apart."""
    return merge_by_key(parts, [(part.source, part.fold, part.unloaded) for part in parts], builder)


def merge_folds(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """Parts with the folds of each log and contact state merged; offset equations of unloaded sensors stay apart."""
    return merge_by_key(parts, [(part.source, part.state, part.unloaded) for part in parts], builder)


def merge_blocks_of_folds(parts: Sequence[Part], builder: RowBuilder) -> list[Part]:
    """Parts with the blocks of each log, contact state and fold merged."""
    if not any(part.block for part in parts):
        return list(parts)
    keys = [(part.source, part.state, part.fold, part.unloaded) for part in parts]
    return [replace(part, block=0) for part in merge_by_key(parts, keys, builder)]


@one_thread()
def merge_by_key(parts: Sequence[Part], keys: Sequence[tuple[object, ...]], builder: RowBuilder) -> list[Part]:
    """One part for each key, with whatever else of the first; the factors of the parts stay as they are."""
    alike: dict[tuple[object, ...], list[Part]] = {}
    for part, key in zip(parts, keys, strict=True):
        alike.setdefault(key, []).append(part)
    out = []
    for own in alike.values():
        factor, masked = merge_factors((part.factor for part in own), builder), set().union(*(x.masked for x in own))
        out.append(replace(own[0], factor=factor, samples=sum(part.samples for part in own), masked=masked))
    return out


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


SampleSpan = tuple[int, int]
"""First of some successive samples of a log, and the end."""


@dataclass(frozen=True)
class CompressedLog:
    """Factors of a log, in pieces that make up as many blocks as a fit with other logs may cut it into.

    Blocks are those of `split_into_folds`: one for a log among many, several for a long one. Factors of pieces merge
    into those of blocks. Equations of readings in the air do not, as they come from means over whole blocks: they are
    there for every block of every number of blocks. No fit needs a contact state of a piece: a piece has all of them in
    one factor, and each contact state has one of the whole log, which takes a fraction of the room.

    Attributes:
        source: name of the log.
        samples: their number.
        oversampling: of the samples, as `Samples` has it.
        noise_left: likewise.
        blocks: their largest number.
        pieces: a factor of each of `piece_spans`, all contact states together, in time.
        by_state: a factor of each contact state of the whole log.
        unloaded: equations of readings in the air, by the block that they are of.
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
        return f"{self.rows} equations of {self.samples} samples, up to {self.blocks} blocks"

    def __len__(self) -> int:
        return self.samples

    @property
    def rows(self) -> int:
        """Number of equations, without those of readings in the air."""
        return sum(part.factor.rows for part in self.pieces)

    def block(self, start: int, stop: int, fold: int) -> CompressedBlock:
        """A block of the log."""
        spans = piece_spans(self.samples, self.blocks)
        pieces = zip(spans, self.pieces, strict=True)
        loaded = [part for (first, last), part in pieces if start <= first and last <= stop]
        loaded, unloaded = (
            [replace(part, fold=fold) for part in parts] for parts in (loaded, self.unloaded.get((start, stop), []))
        )
        loaded = [replace(part, block=number) for number, part in enumerate(loaded)]
        return CompressedBlock(self.source, fold, stop - start, self.noise_left, [*loaded, *unloaded])


@dataclass(frozen=True)
class CompressedBlock:
    """A block of a compressed log in a fold, which stands in for its samples.

    Attributes:
        source: name of the log.
        fold: number of the fold.
        samples: their number.
        noise_left: as `Samples` has it.
        parts: one with all contact states, whose own state means nothing, and equations of readings in the air.
    """

    source: str
    fold: int
    samples: int
    noise_left: float
    parts: list[Part]

    def __len__(self) -> int:
        return self.samples


Block = Samples | CompressedBlock
"""Samples of one log in one fold, or what they compress to."""


def piece_spans(samples: int, blocks: int) -> list[SampleSpan]:
    """Pieces of a log that make up the blocks of every number of blocks up to a largest one."""
    ends = sorted({end for count in range(1, blocks + 1) for span in block_spans(samples, count) for end in span})
    return list(zip(ends, ends[1:], strict=False))


def compress_log(log: Samples, builder: RowBuilder, progress: ProgressCallback | None = None) -> CompressedLog:
    """Compress one log for later fits with others.

    As `split_into_folds` and `compress_parts` do for logs that are all there::

        compressed = [torchid.compress_log(log, builder) for log in logs]
        blocks = torchid.fold_compressed(compressed, builder)
        fit = fitter.fit(torchid.merge_blocks(blocks, builder))

    Args:
        log: a bound log.
        builder: of its rows.
        progress: called with the number of samples done.
    """
    states = {state for state, _ in chunks_by_state(log)}
    folds = round(len(log) / log.oversampling / LEAST_PER_FOLD)  # rounded, as its share of the folds of a fit is
    blocks = fold_count(LEAST_PER_FOLD * folds, len(states), builder)
    parts = compress_spans([log], [piece_spans(len(log), blocks)], builder, progress)
    unloaded: dict[SampleSpan, list[Part]] = {}
    for count in range(1, blocks + 1):
        spans = block_spans(len(log), count)
        for part in _compact(compress_unloaded(_cut(log, spans), builder)):
            unloaded.setdefault(spans[part.fold], []).append(part)
    pieces = merge_by_key(sorted(parts, key=lambda part: part.block), sorted((part.block,) for part in parts), builder)
    by_state = merge_by_key(parts, [(part.state,) for part in parts], builder)
    return CompressedLog(
        log.source, len(log), log.oversampling, log.noise_left, blocks, _compact(pieces), _compact(by_state), unloaded
    )


def fold_compressed(logs: Sequence[CompressedLog], builder: RowBuilder) -> list[CompressedBlock]:
    """The logs, in order, in blocks with folds: those that `split_into_folds` makes of their samples.

    Args:
        logs: compressed logs, of different names.
        builder: of their rows.
    """
    count = fold_count(
        sum(len(log) / log.oversampling for log in logs), sum(len(log.by_state) for log in logs), builder
    )
    layout = lay_out_folds([len(log) for log in logs], count, [log.blocks for log in logs])
    return [log.block(*block) for log, blocks in zip(logs, layout, strict=True) for block in blocks]


def merge_blocks(blocks: Sequence[CompressedBlock], builder: RowBuilder) -> list[Part]:
    """The factors of all blocks, as `LogFitter.fit` takes them; readings in the air merged for each log and fold."""
    parts = [part for block in blocks for part in block.parts]
    loaded = [part for part in parts if not part.unloaded]
    unloaded = [part for part in parts if part.unloaded]
    keys = [(part.source, part.state, part.fold) for part in unloaded]
    return [*loaded, *merge_by_key(unloaded, keys, builder)]


@one_thread()
def _compact(parts: Sequence[Part]) -> list[Part]:
    return [replace(part, factor=part.factor.compact()) for part in parts]


def _cut(log: Samples, spans: Sequence[SampleSpan]) -> list[Samples]:
    """The samples of each span, with its number as their fold."""
    return [replace(log if len(spans) == 1 else log[start:stop], fold=k) for k, (start, stop) in enumerate(spans)]
