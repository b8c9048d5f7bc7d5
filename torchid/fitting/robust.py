"""Robust fits: iteratively re-weighted least squares, in which rows that fit badly count less."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid import ranks
from torchid.errors import UnknownNameError
from torchid.estimators import ConstrainedEstimate
from torchid.fitting.fit import Fit, LogFitter, Solve, with_block_errors
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples, compress_parts
from torchid.problem.chunks import ProgressCallback, one_thread
from torchid.problem.compression import (
    Part,
    add_surplus,
    compress_in_blocks,
    cut_into_blocks,
    merge_factors,
    surplus_by_part,
)
from torchid.rounding import MAD_PER_STD

TUNING = {"huber": 1.345, "tukey": 4.685}
"""Tuning constants with 95 % efficiency on Gaussian noise; source: Huber, "Robust Statistics", 1981."""

_DECADES, _BINS = (-12.0, 12.0), 4800  # of the histogram that the median of |residual| is read from: 1.2 % a bin
_LEAST_SLOPE = 0.05  # mean of rho'' below which the loss is flat where the rows are: no standard error
_CONVERGED = 0.03  # rms change of the predicted rows, in their standard errors
_STEADY = 0.02  # relative change of the scale, whose histogram has bins of 1.2 %
_EXACT = 1e-11  # of the predicted rows: less is rounding
_TINY = float(np.finfo(float).tiny)
_ROUGH_SAMPLES = 5000  # evenly spaced, that a fit of longer logs starts from: of 6 or 7 passes over all 3 or 4 are left
_LEAST_ROUGH = 200  # of them in each log, which may have unknowns of its own
_WORTHWHILE = 4  # times as many samples, from which on that saves more than it costs
_START = 3  # passes with Huber's loss before Tukey's
_SAME = 1e-3  # change of the extra parameters of one log


@dataclass(frozen=True)
class RobustLoss:
    """A loss rho(u) of residuals u in units of their scale, and how many passes over the logs it may take.

    Attributes:
        kind: "huber", or "tukey" for Tukey's biweight.
        tuning: constant of the loss; `TUNING` has the usual ones.
        passes: over the logs, at most.
    """

    kind: str
    tuning: float
    passes: int = 50

    @classmethod
    def named(cls, kind: str, tuning: float | None = None, passes: int = 50) -> RobustLoss:
        """A loss by its name, with its usual tuning if none is given.

        Raises:
            UnknownNameError: a name not in `TUNING`.
        """
        if kind not in TUNING:
            raise UnknownNameError("arguments", "loss", kind, TUNING)
        return cls(kind, TUNING[kind] if tuning is None else tuning, passes)

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


@dataclass(frozen=True)
class RobustSummary:
    """How a robust fit went: `scale` of good residuals in stated noise, `mean_weight` of rows, whether it settled."""

    loss: str
    tuning: float
    scale: float
    mean_weight: float
    passes: int
    converged: bool


@dataclass(frozen=True)
class RobustFit:
    """A fit in which outliers count less, and how it went."""

    fit: Fit
    summary: RobustSummary


@one_thread()
def fit_robustly(
    logs: Sequence[Samples],
    fitter: LogFitter,
    loss: RobustLoss,
    *,
    first: Fit | None = None,
    solve: Solve | None = None,
    progress: ProgressCallback | None = None,
) -> RobustFit:
    """Iteratively re-weighted least squares, a pass over the logs each time, memory flat in their length.

    Long logs begin with passes over every k-th sample. Standard errors are those of the loss, not of the last weighted
    least squares::

        robust = torchid.fit_robustly(logs, fitter, torchid.RobustLoss.named("huber"))
        robust.fit.estimate.phi, robust.summary.mean_weight

    Args:
        logs: bound logs.
        fitter: of their rows.
        loss: what residuals cost.
        first: the fit of all rows alike, if there is one already.
        solve: instead of the fitter's estimator.
        progress: called with the number of samples done.

    Source:
        Huber, "Robust Statistics", 1981, sections 7.6 (standard errors) and 7.8 (re-weighting).
    """
    fit = fitter.fit(compress_in_blocks(logs, fitter.builder, progress=progress), solve) if first is None else first
    scale, first_pass = fit.estimate.residual_std, 0
    step = min(sum(map(len, logs)) // _ROUGH_SAMPLES, min(map(len, logs)) // _LEAST_ROUGH)
    if step >= _WORTHWHILE:
        rough = _passes([log.every(step) for log in logs], fitter, loss, fit, scale, solve=solve)
        fit, scale, first_pass = rough.fit, rough.scale, _START
    found = _passes(logs, fitter, loss, fit, scale, first_pass, solve, progress)
    summary = RobustSummary(
        loss=loss.kind,
        tuning=loss.tuning,
        scale=found.scale,
        mean_weight=found.reweighting.mean_weight,
        passes=found.done,
        converged=found.converged,
    )
    return RobustFit(_with_errors(found.fit, found.reweighting), summary)


@dataclass(frozen=True)
class _Passes:
    """What some passes have come to."""

    fit: Fit
    scale: float
    reweighting: Reweighting
    done: int
    converged: bool


def _passes(
    logs: Sequence[Samples],
    fitter: LogFitter,
    loss: RobustLoss,
    fit: Fit,
    scale: float,
    first_pass: int = 0,
    solve: Solve | None = None,
    progress: ProgressCallback | None = None,
) -> _Passes:
    """Passes over some logs from a fit and the scale of its residuals on, the first of them with the number given."""
    builder, sources, converged, done = fitter.builder, {samples.source for samples in logs}, False, 0
    surplus = surplus_by_part(cut_into_blocks(logs, builder), builder)
    while done < loss.passes and not converged:
        current = _loss_of_pass(loss, first_pass + done)
        by_log = {source: fit.columns(builder, source) for source in sources}
        reweighting = Reweighting(current, by_log, max(scale, _TINY))
        before, done = fit, done + 1
        parts = compress_in_blocks(logs, builder, progress=progress, weight_rows=reweighting)
        reweighting.gather()
        add_surplus(parts, surplus, reweighting.mean_weight)
        fit = fitter.fit(parts, solve)
        settled = current == loss and _settled(fit, before, scale, reweighting.median_scale)
        converged = ranks.as_first(settled, "convergence")
        scale = reweighting.median_scale
    return _Passes(fit, scale, reweighting, done, converged)


def fit_extras_robustly(
    log: Samples,
    builder: RowBuilder,
    solve: Callable[[list[Part]], Array],
    columns: Callable[[Array], Tensor],
    loss: RobustLoss,
) -> Array:
    """Extra parameters of a log, (M,), with outliers weighed down and everything else known, as in `fit_robustly`.

    Args:
        log: a bound log.
        builder: of its rows.
        solve: the extra parameters that fit compressed parts of the log best.
        columns: all parameters in the builder's columns for given extra parameters, (width,).
        loss: what residuals cost.
    """
    parts = compress_parts([log], builder)
    values = solve(parts)
    factor = merge_factors((part.factor for part in parts), builder)
    misfit = factor.triangle() @ torch.cat([columns(values), torch.tensor([-1.0], dtype=torch.float64)])
    scale = float(misfit.norm()) / np.sqrt(max(factor.rows, 1))
    for done in range(loss.passes):
        current = _loss_of_pass(loss, done)
        reweighting = Reweighting(current, {log.source: columns(values)}, max(scale, _TINY))
        before, values = values, solve(compress_parts([log], builder, weight_rows=reweighting))
        reweighting.gather()
        steady = abs(reweighting.median_scale - scale) <= _STEADY * scale
        scale = reweighting.median_scale
        settled = current == loss and steady and np.allclose(values, before, rtol=_SAME, atol=_SAME)
        if ranks.as_first(settled, "convergence"):
            break
    return values


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
        self._terms: list[list[float]] = []  # rows, weights, rho'^2, rho'', rho''^2 of each chunk, as they come

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
            self._terms.append(sums)
        return rows * weight.sqrt()[:, None]

    def gather(self) -> None:
        """End the pass, where processes share the work: the statistics are those of all rows from now on."""
        if ranks.world_size() > 1:
            both = ranks.gather((self._histogram, self._terms), "residuals")
            self._histogram = np.sum([histogram for histogram, _ in both], axis=0)
            self._terms = [sums for _, terms in both for sums in terms]

    @property
    def _sums(self) -> Array:
        """Of all chunks, rounded once, so that their order makes no difference."""
        return np.array([math.fsum(column) for column in zip(*self._terms, strict=True)] or [0.0] * 5)

    @property
    def median_scale(self) -> float:
        """Scale of the residuals of this pass, from the median of their size; within a bin of it they count as even."""
        counts = np.cumsum(self._histogram)
        half = 0.5 * counts[-1]
        index = int(np.searchsorted(counts, half))
        inside = (half - (counts[index - 1] if index else 0.0)) / max(self._histogram[index], 1.0)
        low, high = _DECADES
        return float(self.scale * 10.0 ** (low + (high - low) * (index + inside) / _BINS) / MAD_PER_STD)

    @property
    def mean_weight(self) -> float:
        """Of all rows."""
        return float(self._sums[1] / max(self._sums[0], 1.0))

    @property
    def stretch(self) -> float:
        """By how much leaving rows out moves the estimate, over what it does in least squares with these weights."""
        return float(self._sums[1] / self._sums[3]) if self._sums[3] > _LEAST_SLOPE * self._sums[0] else 1.0

    def deviation(self, unknowns: float) -> float:
        """Standard deviation of independent rows with the same standard errors, in least squares with these weights.

        Source: Huber 1981, section 7.6: var = K^2 scale^2 sum(rho'^2) / (rows - unknowns) / mean(rho'')^2 (X^T X)^-1
        with K = 1 + unknowns / rows var(rho'') / mean(rho'')^2; the weighted X^T X is about the mean weight times that
        without. All rows count as equally contaminated: where one sensor alone is, its own errors come out too small.

        Args:
            unknowns: number of fitted parameters, times the rows that make one independent row.

        Returns:
            NaN where the rows do not determine it.
        """
        rows = self._sums[0]
        weight, square, slope, steep = self._sums[1:] / max(rows, 1.0)
        if rows <= unknowns or slope < _LEAST_SLOPE:
            return math.nan
        correction = 1.0 + unknowns / rows * (steep - slope**2) / slope**2
        return float(correction * self.scale * np.sqrt(weight * square * rows / (rows - unknowns)) / slope)


def _loss_of_pass(loss: RobustLoss, done: int) -> RobustLoss:
    """Huber's loss, which is convex, for the first passes."""
    return loss if loss.kind == "huber" or done >= _START else replace(loss, kind="huber", tuning=TUNING["huber"])


def _settled(fit: Fit, before: Fit, scale: float, new_scale: float) -> bool:
    """Whether a pass has moved predicted rows, extra parameters and the scale far less than their errors.

    So it has where nothing but rounding remains to be fitted.
    """
    problem, estimate = fit.assembly.problem, fit.estimate
    moved = problem.prediction_distance(estimate.phi, before.estimate.phi)
    if max(moved, new_scale) <= _EXACT * problem.prediction_distance(estimate.phi, np.zeros_like(estimate.phi)):
        return True
    rows = problem.rows / problem.oversampling
    if moved > _CONVERGED * scale * np.sqrt(estimate.rank / rows) or abs(new_scale - scale) > _STEADY * scale:
        return False
    earlier = {(x.log, x.extra.label): x.value for x in before.extras}
    return all(
        abs(x.value - earlier.get((x.log, x.extra.label), np.inf)) <= _CONVERGED * x.standard_error for x in fit.extras
    )


def _with_errors(fit: Fit, reweighting: Reweighting) -> Fit:
    """The fit with standard errors of the loss, as if its rows were independent ones with these errors."""
    estimate, problem = fit.estimate, fit.assembly.problem
    factor = reweighting.deviation(problem.oversampling * estimate.rank) / max(estimate.residual_std, _TINY)
    if not (np.isfinite(factor) and factor > 0.0):
        return fit
    added = (factor**2 - 1.0) * estimate.cost
    changed: dict[str, Any] = {name: getattr(estimate, name) + added for name in ("cost", "nominal_cost")}
    if isinstance(estimate, ConstrainedEstimate):
        objectives = {name: getattr(estimate, name) for name in ("objective", "unconstrained")}
        changed |= {name: x + added / problem.rows for name, x in objectives.items() if x is not None}
    estimate = replace(estimate, noise_error=factor * estimate.noise_error, **changed)
    assembly = replace(fit.assembly, problem=replace(problem, residual=problem.residual + added))
    extras = [replace(x, noise_error=factor * x.noise_error) for x in fit.extras]
    out = replace(fit, assembly=assembly, estimate=estimate, extras=extras)
    return out if fit.scatter is None else with_block_errors(out, fit.scatter, reweighting.stretch)
