"""Squares of the residuals of whitened rows, of samples or of factors that they were compressed to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchid.fitting.calibration import Calibration
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunk_dynamics import Workspace
from torchid.problem.chunks import map_chunks, one_thread
from torchid.problem.compressed_log import Block
from torchid.problem.compression import Part, compress_unloaded
from torchid.problem.contact_state import ContactState


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
    """Squares of the residuals of compressed rows at the parameters of each calibration.

    Args:
        builder: of the rows.
        logs: bound logs.
        parts: of these, compressed.
        calibrations: parameters.
    """
    by_source = {log.source: log for log in reversed(logs)}
    out = [ResidualSquares() for _ in calibrations]
    for part in parts:
        R, factor = part.factor.triangle(), part.factor
        for one, squares in zip(calibrations, out, strict=True):
            residual = R[:, :-1] @ one.columns(builder, by_source[part.source]).cpu() - R[:, -1]
            sums = float(residual @ residual), float(R[:, -1] @ R[:, -1])
            squares.add(ResidualSquares(*sums, factor.independent_rows, factor.rows))
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
    measured, noise, count, workspace = error.new_zeros(()), 0.0, 0, Workspace()
    for samples, state in chunks:
        for support, rows in builder.rows(samples, state, workspace):
            residual = rows[:, :-1] @ phi[samples.source][builder.tree.index(support)] - rows[:, -1:]
            error += residual.square().sum(0)
            measured += rows[:, -1].square().sum()
            noise, count = noise + len(rows) / samples.oversampling, count + len(rows)
    return error.tolist(), float(measured), noise, count
