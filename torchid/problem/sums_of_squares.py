"""Sums and sums of squares by row, that merge, and what they say of rms and deviation."""

from __future__ import annotations

import numpy as np
import torch

from torchid.parameters import Array


class SumsOfSquares:
    """Sums and sums of squares by row, over the samples in which the row is finite."""

    def __init__(self, rows: int) -> None:
        """Start empty."""
        self.sum, self.squares, self.count = np.zeros(rows), np.zeros(rows), np.zeros(rows)

    def add(self, x: torch.Tensor, weight: float = 1.0) -> None:
        """Add samples (N, rows), NaN where unknown, each of which counts as `weight` samples."""
        values = x.cpu().numpy()
        known = np.isfinite(values)
        if not known.all():
            values = np.where(known, values, 0.0)
        self.sum += weight * values.sum(0)
        self.squares += weight * np.einsum("ij,ij->j", values, values)
        self.count += weight * known.sum(0)

    def add_squares(self, squares: float, count: int) -> None:
        """Add the sum of squares of one row over `count` samples; their sum stays unknown."""
        self.squares += squares
        self.count += count

    def rms(self, rows: slice = slice(None)) -> Array:
        """Rms row by row."""
        return root_mean(self.squares[rows], self.count[rows])

    def pooled(self, rows: slice) -> float:
        """Rms over all components of some rows."""
        count = self.count[rows].sum()
        return float(np.sqrt(self.squares[rows].sum() / count)) if count else np.nan

    def deviation(self, rows: slice) -> float:
        """Rms about the mean of each row, over all of them."""
        known = self.count[rows] > 0
        count, total = self.count[rows][known], self.sum[rows][known]
        if not len(count):
            return np.nan
        return float(np.sqrt(max((self.squares[rows][known] - total**2 / count).sum(), 0.0) / count.sum()))

    def merge(self, other: SumsOfSquares) -> None:
        """Add the sums of another."""
        self.sum += other.sum
        self.squares += other.squares
        self.count += other.count


def root_mean(squares: Array, count: Array) -> Array:
    """Square root of a mean, NaN of nothing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.sqrt(squares / count)
