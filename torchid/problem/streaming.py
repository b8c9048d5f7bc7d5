"""Streaming logs into a triangular factor, chunk by chunk, memory flat in the number of samples."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import torch

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.linear import LinearProblem
from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.threads import share_out, worker_count
from torchid.problem.triangular import TriangularFactor
from torchid.problem.workspace import Workspace
from torchid.robot import Robot

CHUNK = 2048
"""Samples per chunk: fewer lose to dispatch, more to memory traffic (measured on CPU)."""

Progress = Callable[[int], None]


def by_state(samples: Samples, chunk: int = CHUNK) -> Iterator[tuple[State, slice | torch.Tensor]]:
    """Chunks of samples that share a contact state: the state and an index into the samples."""
    active = samples.active.cpu().numpy()
    packed = np.packbits(active, axis=1) if active.shape[1] else np.zeros((len(active), 1), np.uint8)
    keys, first, which = np.unique(packed.view(f"V{packed.shape[1]}")[:, 0], return_index=True, return_inverse=True)
    for number, example in enumerate(first):
        if len(keys) == 1:
            pieces: Iterable[slice | torch.Tensor] = (slice(i, i + chunk) for i in range(0, len(active), chunk))
        else:
            pieces = torch.from_numpy(np.flatnonzero(which == number)).split(chunk)
        for piece in pieces:
            yield tuple(active[example].tolist()), piece


def compress(
    logs: Sequence[Samples],
    builder: RowBuilder,
    chunk: int = CHUNK,
    threads: int | None = None,
    progress: Progress | None = None,
) -> TriangularFactor:
    """Stream all samples of some logs into one triangular factor.

    Args:
        logs: bound logs; each is moved to the builder's device chunk by chunk.
        builder: makes the rows.
        chunk: samples per chunk.
        threads: worker threads, each with one intra-op thread (small arrays do not profit from more); by default one
            per intra-op thread torch would use, one if the builder is on a GPU.
        progress: called with the number of samples done since the last call.
    """
    device = builder.device
    work = [(samples, state, index) for samples in logs for state, index in by_state(samples, chunk)]
    for _, state, _ in work:
        builder.plan(state)
    lock = threading.Lock()

    def run(part: Sequence[tuple[Samples, State, slice | torch.Tensor]]) -> TriangularFactor:
        factor, workspace = TriangularFactor(builder.columns.count), Workspace()
        for samples, state, index in part:
            piece = samples[index].to(device)
            for support, rows in builder.rows(piece, state, workspace):
                factor.add(support, rows)
            if progress is not None:
                with lock:
                    progress(len(piece))
        return factor

    factors = share_out(work, run, threads or worker_count(device))
    for other in factors[1:]:
        factors[0].merge(other)
    return factors[0]


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


def parameter_scale(nominal: Array) -> Array:
    """Size of a plausible deviation of each parameter, (L, 12): what the pull to the URDF is measured in.

    Mass m of the body; first moments m r; inertias m r^2, with r the body's radius of gyration about its link origin;
    friction 1 N m and 1 N m s/rad.
    """
    mass = nominal[:, parameters.MASS]
    typical = mass[mass > 0.0].mean()
    mass = np.maximum(mass, 1e-3 * typical)
    gyration = np.trace(parameters.inertia_matrix(nominal), axis1=1, axis2=2) / 2.0 / mass
    radius = np.sqrt(np.maximum(gyration, 1e-4))  # at least a centimetre
    scale = np.ones_like(nominal)
    scale[:, parameters.MASS] = mass
    scale[:, parameters.FIRST_MOMENT] = (mass * radius)[:, None]
    scale[:, parameters.INERTIA] = (mass * radius**2)[:, None]
    return scale
