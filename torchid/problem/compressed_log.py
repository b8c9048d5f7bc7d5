"""Logs compressed one by one, before it is known what other logs a fit has: in blocks from which folds can be made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torchid.parallel import one_thread
from torchid.problem.blocks import block_spans, lay_out_folds
from torchid.problem.chunks import ProgressCallback, chunks_by_state
from torchid.problem.compression import LEAST_PER_FOLD, compress_spans, compress_unloaded, fold_count
from torchid.problem.parts import Part, merge_by_key
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.reprs import short_repr

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
