"""Streaming logs into a triangular factor, chunk by chunk, memory flat in the number of samples."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from torchid import parameters
from torchid.problem.chunks import CHUNK, Progress, over_chunks
from torchid.problem.linear import LinearProblem, parameter_scale
from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.triangular import TriangularFactor
from torchid.problem.workspace import Workspace
from torchid.robot import Robot


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

    def fold(chunks: Iterator[tuple[Samples, State]]) -> dict[State, TriangularFactor]:
        factors: dict[State, TriangularFactor] = {}
        workspace = Workspace()
        for samples, state in chunks:
            factor = factors.setdefault(state, TriangularFactor(builder.columns.count))
            for support, rows in builder.rows(samples, state, workspace):
                factor.add(support, rows)
        return factors

    parts = over_chunks(logs, builder, fold, chunk, threads, progress)
    states = dict.fromkeys(state for part in parts for state in part)
    return {state: merged((part[state] for part in parts if state in part), builder) for state in states}


def merged(factors: Iterable[TriangularFactor], builder: RowBuilder) -> TriangularFactor:
    """The factor of all that some factors have seen."""
    out = TriangularFactor(builder.columns.count)
    for factor in factors:
        out.merge(factor)
    return out


def linear_problem(factor: TriangularFactor, builder: RowBuilder, robot: Robot, friction: bool = True) -> LinearProblem:
    """The problem in all 12 L parameters from the factor of the regrouped columns.

    Inertia of massless bodies stays out, and friction if `friction` is False.
    """
    R = factor.triangle().numpy()
    free = np.ones(robot.nominal.shape, dtype=bool)
    free[[body.massless for body in robot.bodies], parameters.INERTIAL] = False
    free[0, parameters.FRICTION] = False
    if not friction:
        free[:, parameters.FRICTION] = False
    return LinearProblem(
        A=R[:-1, :-1] @ builder.columns.from_parameters(),
        b=R[:-1, -1],
        residual=float(R[-1, -1] ** 2),
        rows=factor.rows,
        nominal=robot.nominal.flatten(),
        scale=parameter_scale(robot.nominal).flatten(),
        free=free.flatten(),
    )
