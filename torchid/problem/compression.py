"""Streaming logs into triangular factors, chunk by chunk, by contact state and by folds for cross-validation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain

import numpy as np

from torchid import parameters, ranks
from torchid.parameters import Array
from torchid.problem.chunks import ProgressCallback, chunks_by_state, map_chunks, one_thread, worker_count
from torchid.problem.contact_state import ContactState
from torchid.problem.linear import PRIOR_DEVIATION, LinearProblem, TriangularFactor, parameter_scale
from torchid.problem.noise_gram import ColumnPrior, NoiseGram, corrected_triangle, estimate_noise_gram
from torchid.problem.row_compressor import RowCompressor, RowWeighting
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.unloaded_sensors import unloaded_offset_equations
from torchid.reprs import short_repr
from torchid.robot import Robot

FOLDS = 5
"""Number of cross-validation folds of the training samples."""

LEAST_PER_FOLD = 20
"""Independent samples per fold: the filter correlates only a small part of these with neighbours."""

BLOCKS = 20
"""Number of blocks of the training samples whose scatter gives standard errors, at least where there are so many."""

_LEAST_PER_BLOCK = 10  # independent samples

_MEMORY = 2**30  # [bytes] of factors
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
    parts = _merge_parts(map_chunks(logs, builder, reduce, chunk, threads, progress))
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

    def reduce(chunks: Iterator[tuple[Samples, ContactState]]) -> tuple[list[Part], RowWeighting | None]:
        weighting = None if weight_rows is None else weight_rows.for_worker()
        return _compress_chunks(builder, chunks, by_log=True, weight_rows=weighting), weighting

    done = map_chunks(logs, builder, reduce, chunk, threads, progress)
    parts = _merge_parts(of_worker for of_worker, _ in done)
    if weight_rows is None:
        add_noise_gram(parts, noise_gram_by_part(logs, builder, progress))
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
    pieces = [replace(piece, unloaded=None) for piece in cut_into_blocks(logs, builder)]
    parts = compress_parts(pieces, builder, progress=progress, weight_rows=weight_rows)
    if not any(extra.what == "offset" and extra.contact is not None for extra in builder.extras):
        return parts
    return [*parts, *compress_unloaded(logs, builder)]


def cut_into_blocks(logs: Sequence[Samples], builder: RowBuilder) -> list[Samples]:
    """The logs in blocks of about equal length, some `BLOCKS` in all; fewer where samples or memory are short."""
    independent = sum(len(log) / log.oversampling for log in logs)
    states = len({(log.source, state) for log in logs for state, _ in chunks_by_state(log)})
    count = min(BLOCKS, int(independent / _LEAST_PER_BLOCK), _most_factors(states, builder))
    count = ranks.as_first(count, "blocks")
    total, out = sum(map(len, logs)), []
    for log in logs:
        spans = block_spans(len(log), max(1, round(count * len(log) / max(total, 1))))
        for number, (start, stop) in enumerate(spans):
            out.append(replace(log if len(spans) == 1 else log[start:stop], block=number))
    return out


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
    parts: dict[PartKey, Part] = {}
    workspace, compressor = builder.workspaces.take(), RowCompressor()

    def part(samples: Samples, state: ContactState, unloaded: bool) -> Part:
        key = _key(samples, state, unloaded) if by_log else _key(None, state)
        source, at, fold, block, in_the_air = key
        return parts.setdefault(key, Part(source, at, TriangularFactor(builder.width), 0, fold, block, in_the_air))

    for samples, state in chunks:
        if loaded:
            own = part(samples, state, False)
            own.samples += len(samples)
            for support, stacked in builder.stacked_rows(samples, state, workspace):
                if weight_rows is not None:
                    rows = stacked[len(support) + 1 :]
                    rows *= weight_rows(samples, support, rows)
                compressor.add(own.factor, support, stacked, samples.oversampling)
        for channel in unloaded_offset_equations(builder, samples):
            in_the_air = part(samples, state, True)
            if channel.masked:
                in_the_air.masked.add(channel.offset)
            else:
                in_the_air.factor.add(*channel.row(builder), samples.oversampling)
    compressor.finish()
    builder.workspaces.give_back(workspace)
    return list(parts.values())


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
    return _merge_parts(map_chunks(logs, builder, partial(_compress_chunks, builder, by_log=True, loaded=False)))


@one_thread()
def _merge_parts(of_workers: Iterable[list[Part]]) -> list[Part]:
    """The parts of all workers, those of one log, contact state and fold merged, on the CPU."""
    total: dict[PartKey, Part] = {}
    for part in chain.from_iterable(of_workers):
        part.factor = part.factor.to_cpu()
        same = total.setdefault(part.key, part)
        if same is not part:
            same.samples += part.samples
            same.masked |= part.masked
            same.factor.merge(part.factor)
    return list(total.values())


@one_thread()
def merge_factors(factors: Iterable[TriangularFactor], builder: RowBuilder) -> TriangularFactor:
    """One factor of the rows of several."""
    out = TriangularFactor(builder.width)
    for factor in factors:
        out.merge(factor)
    return out


@one_thread()
def linear_problem(factor: TriangularFactor, builder: RowBuilder, robot: Robot, friction: bool = True) -> LinearProblem:
    """Pose the linear problem in all 12 L parameters of the bodies from a factor that `compress` made.

    Raises:
        ValueError: the builder has extra parameters; `assemble` eliminates them.
    """
    if builder.extras:
        raise ValueError("builder: found extra terms; accepted: one without, or torchid.assemble")
    own = corrected_triangle(factor, column_prior(builder, robot, friction))
    return problem_from_triangle(own.R, factor.rows, factor.oversampling, builder, robot, friction, own.held)


def column_prior(builder: RowBuilder, robot: Robot, friction: bool = True) -> ColumnPrior:
    """The nominal parameters in the builder's columns, and deviations within their scale of those that are free."""
    columns, nominal = builder.columns.parameter_map, robot.nominal.flatten()
    scale = np.where(free_parameters(robot, friction), parameter_scale(robot.nominal).flatten(), 0.0)
    return ColumnPrior(columns @ nominal, columns * (PRIOR_DEVIATION * scale))


def problem_from_triangle(
    R: Array, rows: int, oversampling: float, builder: RowBuilder, robot: Robot, friction: bool, held: Array | None
) -> LinearProblem:
    """The problem in all 12 L parameters from a triangle in the regrouped columns, right-hand side last.

    Args:
        R: (M, columns + 1).
        rows: that went into it.
        oversampling: of them.
        builder: of the rows.
        robot: the robot.
        friction: whether friction is free.
        held: (columns, Q), as `CorrectedTriangle` has it.
    """
    count = builder.columns.count
    return LinearProblem(
        A=R[:count, :-1] @ builder.columns.parameter_map,
        b=R[:count, -1],
        residual=float(np.square(R[count:, -1]).sum()),
        rows=rows,
        nominal=robot.nominal.flatten(),
        scale=parameter_scale(robot.nominal).flatten(),
        free=free_parameters(robot, friction),
        oversampling=oversampling,
        held=None if held is None else R[:count, :-1] @ held,
    )


def free_parameters(robot: Robot, friction: bool = True) -> np.ndarray:
    """Parameters that can be fitted, (12 L,) bool.

    All but inertial parameters of massless bodies, friction of welds, and any friction if not `friction`.
    """
    free = np.ones(robot.nominal.shape, dtype=bool)
    free[[body.massless for body in robot.bodies], parameters.INERTIAL] = False
    still = [body.joint is None or body.joint.kind == "fixed" for body in robot.bodies]
    free[still if friction else slice(None), parameters.FRICTION] = False
    return free.flatten()


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
    return ranks.as_first(count, "folds")


def _most_factors(states: int, builder: RowBuilder) -> int:
    """Number of factors of each of some contact states that there is memory for."""
    return _MEMORY // (8 * (builder.width + 1) ** 2 * max(states, 1) * worker_count(builder.device))


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
    out: dict[tuple[object, ...], Part] = {}
    for part, key in zip(parts, keys, strict=True):
        merged = out.setdefault(key, replace(part, factor=TriangularFactor(builder.width), samples=0, masked=set()))
        merged.factor.merge(part.factor)
        merged.masked |= part.masked
        merged.samples += part.samples
    return list(out.values())
