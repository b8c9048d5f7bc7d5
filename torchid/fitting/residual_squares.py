"""Squares of the whitened residuals of logs' rows at some parameters, from factors or sample by sample."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchid.fitting.calibration import Calibration
from torchid.parallel import one_thread
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunk_dynamics import Workspace
from torchid.problem.chunks import map_chunks
from torchid.problem.compression import Block, Part, compress_unloaded
from torchid.problem.contact_state import ContactState
from torchid.sensing.sensors import recorded_components


def with_all_readings(log: Samples, builder: RowBuilder) -> Samples:
    """The samples of a log that have every reading of the builder's sensors."""
    sensors, known = builder.sensors, torch.ones(len(log), dtype=torch.bool)
    if sensors.torque.any():
        known &= torch.isfinite(builder.recorded_torque(log)[:, torch.from_numpy(sensors.torque)]).all(1)
    needed = torch.from_numpy(recorded_components(builder.contacts, sensors, log.wrench_in_world))
    touched = log.active[..., None] & needed
    lost = touched if log.wrench is None else touched & ~torch.isfinite(log.wrench)
    known &= ~lost.flatten(1).any(1)
    return log if bool(known.all()) else log[known]


@dataclass
class ResidualSquares:
    """Sums of squares of whitened rows: of their residuals, of what was measured, and of the noise a filter leaves."""

    error: float = 0.0
    measured: float = 0.0
    noise: float = 0.0
    rows: int = 0

    def add(self, other: ResidualSquares) -> None:
        """Add those of other rows."""
        self.error += other.error
        self.measured += other.measured
        self.noise += other.noise
        self.rows += other.rows


@one_thread()
def sum_residuals(
    builder: RowBuilder, logs: Sequence[Block], parts: Sequence[Part], calibrations: Sequence[Calibration]
) -> list[ResidualSquares]:
    """Squares of the residuals of bound logs' rows, compressed to `parts`, at the parameters of each calibration."""
    by_source = {log.source: log for log in reversed(logs)}
    out = [ResidualSquares() for _ in calibrations]
    for part in parts:
        R, factor = part.factor.triangle(), part.factor
        for one, squares in zip(calibrations, out, strict=True):
            residual = R[:, :-1] @ one.columns(builder, by_source[part.source]).cpu() - R[:, -1]
            sums = float(residual @ residual), float(R[:, -1] @ R[:, -1])
            squares.add(ResidualSquares(*sums, factor.rows * by_source[part.source].noise_left, factor.rows))
    return out


def residuals_of_samples(
    builder: RowBuilder, logs: Sequence[Samples], calibrations: Sequence[Calibration]
) -> list[ResidualSquares]:
    """As `sum_residuals`, of logs that are not compressed: rows times parameters are less work than their factors.

    Args:
        builder: of the rows.
        logs: bound logs, of other sources each.
        calibrations: parameters.
    """
    phi = {log.source: torch.stack([one.columns(builder, log) for one in calibrations], dim=1) for log in logs}
    total = sum_residuals(builder, logs, compress_unloaded(logs, builder), calibrations)
    for squares, measured, noise, rows in map_chunks(logs, builder, partial(_sum_chunks, builder, phi)):
        for one, error in zip(total, squares, strict=True):
            one.add(ResidualSquares(error, measured, noise, rows))
    return total


def _sum_chunks(
    builder: RowBuilder, phi: Mapping[str, Tensor], chunks: Iterator[tuple[Samples, ContactState]]
) -> tuple[list[float], float, float, int]:
    """Squares of the residuals of rows at parameters (width, M) by log, (M,), and of what was measured; noise, rows."""
    error = next(iter(phi.values())).new_zeros(next(iter(phi.values())).shape[1])
    sums, workspace = error.new_zeros(3, dtype=torch.float64), Workspace()
    for samples, state in chunks:
        for support, rows in builder.rows(samples, state, workspace):
            error += (rows[:, :-1] @ phi[samples.source][builder.tree.index(support)] - rows[:, -1:]).square().sum(0)
            sums[0] += rows[:, -1].square().sum()
            present = len(rows) if samples.resting is None else rows.any(1).sum(dtype=torch.float64)
            sums[1] += present * samples.noise_left
            sums[2] += present
    return error.tolist(), float(sums[0]), float(sums[1]), round(float(sums[2]))
