"""Streaming logs into a triangular factor, chunk by chunk, memory flat in the number of samples."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain

import numpy as np
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.chunks import CHUNK, Progress, over_chunks
from torchid.problem.linear import LinearProblem, parameter_scale
from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.threads import one_thread
from torchid.problem.triangular import TriangularFactor
from torchid.problem.unloaded import unloaded_channels
from torchid.problem.workspace import Workspace
from torchid.robot import Robot

Weighing = Callable[[Samples, tuple[int, ...], Tensor], Tensor]
_Key = tuple[str, State, int, bool]


@dataclass
class Part:
    """What is kept of the samples of one log, by its source, in one contact state and one fold (see `in_folds`).

    Equations of sensors whose contact is in the air are in a part of their own, `unloaded`, which counts no samples;
    `gated`: numbers, among the extras, of the offsets that have none because the readings there are exactly 0.
    """

    source: str
    state: State
    factor: TriangularFactor
    samples: int
    fold: int = 0
    unloaded: bool = False
    gated: set[int] = field(default_factory=set)


def compress(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: Progress | None = None,
) -> TriangularFactor:
    """Stream all samples of some logs into one triangular factor.

    Args: as `over_chunks`.
    """
    return merged(compress_by_state(logs, builder, chunk, threads, progress).values(), builder)


def compress_by_state(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: Progress | None = None,
) -> dict[State, TriangularFactor]:
    """As `compress`, but with a factor for every contact state in the logs."""
    found = over_chunks(logs, builder, partial(_fold, builder, by_log=False), chunk, threads, progress)
    return {part.state: part.factor for part in _together(found)}


def compress_parts(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: Progress | None = None,
    weigh: Weighing | None = None,
) -> list[Part]:
    """As `compress`, but with a factor for every contact state in every log and fold, in the order of the logs.

    Logs of one source count as one. Unknown offsets of contact sensors have further parts: readings in the air.
    `weigh` may change other rows before they are added: called with the samples they come from, their columns and
    themselves.
    """
    fold = partial(_fold, builder, by_log=True, weigh=weigh)
    parts = _together(over_chunks(logs, builder, fold, chunk, threads, progress))
    order = list(dict.fromkeys(samples.source for samples in logs))
    return sorted(parts, key=lambda part: order.index(part.source))


def _fold(
    builder: RowBuilder, chunks: Iterator[tuple[Samples, State]], by_log: bool, weigh: Weighing | None = None
) -> list[Part]:
    """Parts of some chunks, all logs together unless `by_log`."""
    parts: dict[_Key, Part] = {}
    workspace = Workspace()

    def part(samples: Samples, state: State, unloaded: bool) -> Part:
        key = (samples.source, state, samples.fold, unloaded) if by_log else ("", state, 0, False)
        return parts.setdefault(key, Part(*key[:2], TriangularFactor(builder.width), 0, *key[2:]))

    for samples, state in chunks:
        own = part(samples, state, False)
        own.samples += len(samples)
        for support, rows in builder.rows(samples, state, workspace):
            weighed = rows if weigh is None else weigh(samples, support, rows)
            own.factor.add(support, weighed, samples.oversampling)
        for channel in unloaded_channels(builder, samples):
            of_air = part(samples, state, True)
            if channel.gated:
                of_air.gated.add(channel.offset)
            else:
                of_air.factor.add(*channel.row(builder), samples.oversampling)
    return list(parts.values())


@one_thread()
def _together(of_workers: Iterable[list[Part]]) -> list[Part]:
    """The parts that workers have made of their chunks."""
    total: dict[_Key, Part] = {}
    for part in chain.from_iterable(of_workers):
        same = total.setdefault((part.source, part.state, part.fold, part.unloaded), part)
        if same is not part:
            same.samples += part.samples
            same.gated |= part.gated
            same.factor.merge(part.factor)
    return list(total.values())


@one_thread()
def merged(factors: Iterable[TriangularFactor], builder: RowBuilder) -> TriangularFactor:
    """The factor of all that some factors have seen."""
    out = TriangularFactor(builder.width)
    for factor in factors:
        out.merge(factor)
    return out


def free_parameters(robot: Robot, friction: bool = True) -> np.ndarray:
    """What can be fitted, (12 L,) bool: no inertia of massless bodies, no friction of welds, none if not `friction`."""
    free = np.ones(robot.nominal.shape, dtype=bool)
    free[[body.massless for body in robot.bodies], parameters.INERTIAL] = False
    still = [body.joint is None or body.joint.kind == "fixed" for body in robot.bodies]
    free[still if friction else slice(None), parameters.FRICTION] = False
    return free.flatten()


@one_thread()
def linear_problem(factor: TriangularFactor, builder: RowBuilder, robot: Robot, friction: bool = True) -> LinearProblem:
    """The problem in all 12 L parameters from the factor of the regrouped columns.

    What is free is said by `free_parameters`.

    Raises:
        ValueError: the builder has unknowns beside these parameters, which take `assemble`.
    """
    if builder.extras:
        raise ValueError("builder: found extra terms; accepted: one without, or torchid.assemble")
    return posed(factor.triangle().numpy(), factor.rows, factor.oversampling, builder, robot, friction)


def posed(
    R: Array, rows: int, oversampling: float, builder: RowBuilder, robot: Robot, friction: bool = True
) -> LinearProblem:
    """The problem of a triangular factor in the regrouped columns, right-hand side last.

    Args:
        R: (M, columns + 1).
        rows: that went into it.
        oversampling: of them.
        builder: of the rows.
        robot: the robot.
        friction: whether friction is free.
    """
    count = builder.columns.count
    return LinearProblem(
        A=R[:count, :-1] @ builder.columns.from_parameters(),
        b=R[:count, -1],
        residual=float(np.square(R[count:, -1]).sum()),
        rows=rows,
        nominal=robot.nominal.flatten(),
        scale=parameter_scale(robot.nominal).flatten(),
        free=free_parameters(robot, friction),
        oversampling=oversampling,
    )
