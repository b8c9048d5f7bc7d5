"""Robust losses on whitened rows, by weights: rows that fit badly count less in the next pass."""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchid.problem.samples import Samples

TUNING = {"huber": 1.345, "tukey": 4.685}
"""Tuning constants with 95 % efficiency on Gaussian noise; source: Huber, "Robust Statistics", 1981."""

_DECADES, _BINS = (-12.0, 12.0), 4800  # of the histogram that the median of |residual| is read from: 1.2 % a bin
_LEAST_SLOPE = 0.05  # mean of rho'' below which the loss is flat where the rows are: their spread says nothing
_NORMAL = 0.6745  # median of |x| of standard normal x


@dataclass(frozen=True)
class RobustLoss:
    """A loss rho(u) of residuals u in units of their scale, by `kind`: "huber" or "tukey" (its biweight)."""

    kind: str
    tuning: float

    def weight(self, u: Tensor) -> Tensor:
        """rho'(u) / u."""
        if self.kind == "huber":
            return torch.where(u.abs() <= self.tuning, 1.0, self.tuning / u.abs())
        return (1.0 - (u / self.tuning).square()).clamp_min(0.0).square()

    def slope(self, u: Tensor) -> Tensor:
        """rho''(u)."""
        if self.kind == "huber":
            return (u.abs() <= self.tuning).to(u)
        x = (u / self.tuning).square()
        return torch.where(x < 1.0, (1.0 - x) * (1.0 - 5.0 * x), 0.0)


class Reweighting:
    """One pass over the rows: weighs them by their residuals at earlier parameters, and gathers statistics of these."""

    def __init__(self, loss: RobustLoss, parameters: Mapping[str, Tensor], scale: float) -> None:
        """Start a pass.

        Args:
            loss: what residuals cost.
            parameters: by the source of a log, (width,) in the builder's columns.
            scale: of the whitened residuals of good rows.
        """
        self.loss, self.scale = loss, scale
        self._parameters = parameters
        self._lock = threading.Lock()
        self._histogram = np.zeros(_BINS)
        self._sums = np.zeros(5)  # rows, weights, rho'^2, rho'', rho''^2

    @torch.no_grad()
    def __call__(self, samples: Samples, support: tuple[int, ...], rows: Tensor) -> Tensor:
        """The rows (M, len(support) + 1) times the square root of their weights."""
        theta = self._parameters[samples.source][list(support)].to(rows)
        u = (rows[:, :-1] @ theta - rows[:, -1]) / self.scale
        weight, slope = self.loss.weight(u), self.loss.slope(u)
        digits = u.abs().log10().clamp(*_DECADES)
        counts = torch.histc(digits, _BINS, *_DECADES).cpu().numpy()
        sums = [len(u), *(float(x.sum()) for x in (weight, (weight * u).square(), slope, slope.square()))]
        with self._lock:
            self._histogram += counts
            self._sums += sums
        return rows * weight.sqrt()[:, None]

    @property
    def median_scale(self) -> float:
        """Scale of the residuals of this pass, from the median of their size; within a bin of it they count as even."""
        counts = np.cumsum(self._histogram)
        half = 0.5 * counts[-1]
        place = int(np.searchsorted(counts, half))
        inside = (half - (counts[place - 1] if place else 0.0)) / max(self._histogram[place], 1.0)
        low, high = _DECADES
        return float(self.scale * 10.0 ** (low + (high - low) * (place + inside) / _BINS) / _NORMAL)

    @property
    def mean_weight(self) -> float:
        """Of all rows."""
        return float(self._sums[1] / max(self._sums[0], 1.0))

    def deviation(self, unknowns: float) -> float:
        """Standard deviation of independent rows with the same standard errors, in least squares with these weights.

        Source: Huber 1981, section 7.6: var = K^2 scale^2 sum(rho'^2) / (rows - unknowns) / mean(rho'')^2 (X^T X)^-1
        with K = 1 + unknowns / rows var(rho'') / mean(rho'')^2; the weighted X^T X is about the mean weight times that
        without. All rows are taken to be spoilt alike: where one sensor alone is, its own errors come out too small.

        Args:
            unknowns: fitted, times the rows that make one independent row.

        Returns:
            NaN where that cannot be said.
        """
        rows = self._sums[0]
        weight, square, slope, steep = self._sums[1:] / max(rows, 1.0)
        if rows <= unknowns or slope < _LEAST_SLOPE:
            return math.nan
        correction = 1.0 + unknowns / rows * (steep - slope**2) / slope**2
        return float(correction * self.scale * np.sqrt(weight * square * rows / (rows - unknowns)) / slope)
