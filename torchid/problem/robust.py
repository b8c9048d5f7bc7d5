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
_NORMAL = 0.6745  # median of |x| of standard normal x


@dataclass(frozen=True)
class RobustLoss:
    """A loss rho(u) of residuals u in units of their scale, by `kind`: "huber" or "tukey" (its biweight)."""

    kind: str
    tuning: float

    def weight(self, u: Tensor) -> Tensor:
        """rho'(u) / u."""
        if self.kind == "huber":
            return (self.tuning / u.abs().clamp_min(self.tuning)).clamp_max(1.0)
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
        self._sums = np.zeros(4)  # rows, weights, rho'^2, rho''

    @torch.no_grad()
    def __call__(self, samples: Samples, support: tuple[int, ...], rows: Tensor) -> Tensor:
        """The rows (M, len(support) + 1) times the square root of their weights."""
        theta = self._parameters[samples.source][list(support)].to(rows)
        u = (rows[:, :-1] @ theta - rows[:, -1]) / self.scale
        weight = self.loss.weight(u)
        digits = u.abs().clamp_min(10.0 ** _DECADES[0]).log10()
        counts = torch.histc(digits, _BINS, *_DECADES).cpu().numpy()
        sums = [float(len(u)), float(weight.sum()), float((weight * u).square().sum()), float(self.loss.slope(u).sum())]
        with self._lock:
            self._histogram += counts
            self._sums += sums
        return rows * weight.sqrt()[:, None]

    @property
    def median_scale(self) -> float:
        """Scale of the residuals of this pass, from the median of their size."""
        half = int(np.searchsorted(np.cumsum(self._histogram), 0.5 * self._histogram.sum()))
        low, high = _DECADES
        return float(self.scale * 10.0 ** (low + (high - low) * (half + 0.5) / _BINS) / _NORMAL)

    @property
    def mean_weight(self) -> float:
        """Of all rows."""
        return float(self._sums[1] / max(self._sums[0], 1.0))

    @property
    def deviation(self) -> float:
        """Standard deviation of independent rows with the same standard errors, in least squares with these weights.

        Source: Huber 1981, eq. (7.6.5): var = scale^2 mean(rho'^2) / mean(rho'')^2 (K^T K)^-1; the weighted K^T K is
        about the mean weight times that without.
        """
        rows, weights, square, slope = self._sums
        if not (rows and slope > 0.0):
            return math.nan
        return float(self.scale * np.sqrt(weights / rows * (square / rows)) / (slope / rows))
