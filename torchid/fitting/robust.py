"""Robust fits: iteratively re-weighted least squares, in which rows that fit badly count less."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid import distributed
from torchid.errors import UnknownNameError
from torchid.estimators import ConstrainedEstimate
from torchid.fitting.fit import Fit, LogFitter, Solve, with_block_errors
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import Samples, compress_parts
from torchid.problem.chunks import ProgressCallback
from torchid.problem.compression import Part, add_noise_gram, compress_in_blocks
from torchid.problem.row_compressor import RowWeighting
from torchid.problem.samples import concatenate
from torchid.rounding import MAD_PER_STD

TUNING = {"huber": 1.345, "tukey": 4.685}
"""Tuning constants with 95 % efficiency on Gaussian noise; source: Huber, "Robust Statistics", 1981."""

# of the histogram that the median of |residual| is read from: 1.2 % a bin
_DECADES = (-12.0, 12.0)
_BINS = 4800
_LEAST_SLOPE = 0.05  # mean of rho'' below which the loss is flat where the rows are: no standard error
_CONVERGED = 0.03  # rms change of the predicted rows, in their standard errors
_STEADY = 0.02  # relative change of the scale, whose histogram has bins of 1.2 %
_EXACT = 1e-11  # of the predicted rows: less is rounding
_TINY = float(np.finfo(float).tiny)
_ROUGH_SAMPLES = 5000  # least number of evenly spaced samples for the start of a fit to longer logs
# one in so many, unless they are more than so many
_ROUGH_STEP = 8
_MOST_ROUGH = 50_000
_LEAST_ROUGH = 200  # of them in each log, which may have unknowns of its own
_WORTHWHILE = 4  # logs this many times longer are worth such a start
_START = 3  # passes with Huber's loss before Tukey's
_FARTHEST = 1.9  # steps of weighted least squares, a majorizer of the loss: any below 2 makes that smaller


@dataclass(frozen=True)
class RobustLoss:
    """Robust loss rho(u) of scaled residuals u, and the largest number of passes over the logs.

    Attributes:
        kind: "huber", or "tukey" for Tukey's biweight.
        tuning: constant of the loss; `TUNING` has the usual values.
        passes: largest number of passes over the logs.
    """

    kind: str
    tuning: float
    passes: int = 50

    @classmethod
    def named(cls, kind: str, tuning: float | None = None, passes: int = 50) -> RobustLoss:
        """Make a loss by its name, with its usual tuning by default.

        Raises:
            UnknownNameError: the name is not in `TUNING`.
        """
        if kind not in TUNING:
            raise UnknownNameError("arguments", "loss", kind, TUNING)
        return cls(kind, TUNING[kind] if tuning is None else tuning, passes)

    def weight(self, u: Tensor) -> Tensor:
        """Weight rho'(u) / u."""
        if self.kind == "huber":
            return torch.where(u.abs() <= self.tuning, 1.0, self.tuning / u.abs())
        return (1.0 - (u / self.tuning).square()).clamp_min(0.0).square()

    def slope(self, u: Tensor) -> Tensor:
        """Second derivative rho''(u)."""
        if self.kind == "huber":
            return (u.abs() <= self.tuning).to(u)
        x = (u / self.tuning).square()
        return torch.where(x < 1.0, (1.0 - x) * (1.0 - 5.0 * x), 0.0)


@dataclass(frozen=True)
class RobustSummary:
    """How a robust fit went: `scale` of good residuals in stated noise, `mean_weight` of rows, whether it converged."""

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
    parts: Sequence[Part] | None = None,
    solve: Solve | None = None,
    progress: ProgressCallback | None = None,
) -> RobustFit:
    """Fit by iteratively re-weighted least squares; one pass over the logs each, memory independent of their length.

    A pass weights the rows by their residuals at one point and fits them. If the result equals the start, it is the
    last pass. Otherwise the next pass starts at the point of Newton's method, assuming evenly distributed outliers.
    Long logs begin with passes over every k-th sample. Standard errors are those of the robust loss::

        robust = torchid.fit_robustly(logs, fitter, torchid.RobustLoss.named("huber"))
        robust.fit.estimate.phi, robust.summary.mean_weight

    Args:
        logs: bound logs.
        fitter: of the rows.
        loss: of the residuals.
        first: a fit with equal weights, if available.
        parts: the logs compressed by `compress_in_blocks`, if available.
        solve: replaces the fitter's estimator.
        progress: called with the number of samples done.

    Source:
        Huber, "Robust Statistics", 1981, sections 7.6 (standard errors) and 7.8 (re-weighting).
    """
    builder = fitter.builder
    parts = compress_in_blocks(logs, builder, progress=progress) if parts is None else parts
    first = fitter.fit(parts, solve) if first is None else first
    start = _Passes(first, first, first.estimate.residual_std)
    count = sum(map(len, logs))
    step = min(count // _ROUGH_SAMPLES, min(map(len, logs)) // _LEAST_ROUGH)
    step = min(step, max(_ROUGH_STEP, count // _MOST_ROUGH))
    if step >= _WORTHWHILE:
        by_log: dict[str, list[Samples]] = {}
        for log in logs:
            by_log.setdefault(log.source, []).append(log.every(step))
        rough = [replace(concatenate(pieces), fold=0) for pieces in by_log.values()]
        compress = partial(compress_parts, rough, builder)
        start = _passes(start, fitter, lambda weigh: compress(weight_rows=weigh), compress(), loss, 0, solve)
    compress_all = partial(compress_in_blocks, logs, builder, progress)
    passes = _passes(start, fitter, compress_all, parts, loss, _START if step >= _WORTHWHILE else 0, solve)
    reweighting = passes.reweighting
    if reweighting is None:
        raise ValueError(f"passes: found {loss.passes}; accepted: at least 1")
    summary = RobustSummary(
        loss=loss.kind,
        tuning=loss.tuning,
        scale=passes.scale,
        mean_weight=reweighting.mean_weight,
        passes=passes.done,
        converged=passes.converged,
    )
    return RobustFit(_with_errors(passes.fit, reweighting), summary)


@dataclass(frozen=True)
class _Passes:
    """What some passes have come to: the last fit, and the parameters and the scale with which the next weighs rows."""

    fit: Fit
    at: Fit
    scale: float
    reweighting: Reweighting | None = None
    done: int = 0
    converged: bool = False


def _passes(
    start: _Passes,
    fitter: LogFitter,
    compress: Callable[[RowWeighting], list[Part]],
    unweighted: Sequence[Part],
    loss: RobustLoss,
    first_pass: int,
    solve: Solve | None,
) -> _Passes:
    """Passes over rows, the first of them with the number given.

    Args:
        start: where they begin.
        fitter: of the rows.
        compress: the rows with weights.
        unweighted: the same without.
        loss: what residuals cost.
        first_pass: passes that came before.
        solve: instead of the fitter's estimator.
    """
    noise_gram = {part.key: part.factor.noise_gram for part in unweighted if part.factor.noise_gram}
    sources = {part.source for part in unweighted}
    passes = replace(start, done=0, converged=False)
    while passes.done < loss.passes and not passes.converged:
        current = loss
        if loss.kind != "huber" and first_pass + passes.done < _START:  # Huber's loss is convex
            current = replace(loss, kind="huber", tuning=TUNING["huber"])
        at = passes.at
        scale = passes.scale
        by_log = {source: at.columns(fitter.builder, source) for source in sources}
        reweighting = Reweighting(current, by_log, max(scale, _TINY))
        parts = compress(reweighting)
        add_noise_gram(parts, noise_gram, reweighting.mean_weight)
        fit = fitter.fit(parts, solve)
        same = current == loss and _has_converged(fit, at, scale, reweighting.median_scale)
        passes = _Passes(
            fit=fit,
            at=_beyond(at, fit, min(reweighting.newton_ratio, _FARTHEST)),
            scale=reweighting.median_scale,
            reweighting=reweighting,
            done=passes.done + 1,
            converged=distributed.broadcast(same, "convergence"),
        )
    return passes


def _beyond(before: Fit, after: Fit, step: float) -> Fit:
    """A fit of the rows as weighted at the one before, whose parameters moved so many times as far."""
    earlier = {(x.log, x.extra.label): x.value for x in before.extras}
    extras = []
    for x in after.extras:
        value = earlier.get((x.log, x.extra.label), x.value)
        extras.append(replace(x, value=value + step * (x.value - value)))
    phi = before.estimate.phi + step * (after.estimate.phi - before.estimate.phi)
    return replace(after, estimate=replace(after.estimate, phi=phi), extras=extras)


class Reweighting:
    """One pass over the rows: weighs them by their residuals at earlier parameters, and gathers statistics of these."""

    def __init__(self, loss: RobustLoss, parameters: Mapping[str, Tensor], scale: float) -> None:
        """Start a pass.

        Args:
            loss: what residuals cost.
            parameters: by the source of a log, (width,) in the builder's columns.
            scale: of the whitened residuals of good rows.
        """
        self.loss = loss
        self.scale = scale
        self._parameters = parameters
        self._histogram = np.zeros(_BINS)
        self._terms: list[list[float]] = []  # rows, weights, rho'^2, rho'', rho''^2 of each chunk, as they come

    @torch.no_grad()
    def __call__(self, samples: Samples, support: tuple[int, ...], rows: Tensor) -> Tensor:
        """Square roots of the weights of rows (M, len(support) + 1)."""
        theta = self._parameters[samples.source][list(support)].to(rows)
        u = (rows[:, :-1] @ theta - rows[:, -1]) / self.scale
        weights = self.loss.weight(u).sqrt()[:, None]
        u = u if samples.resting is None else u[rows.any(1)]  # without those that a sample has not
        weight = self.loss.weight(u)
        slope = self.loss.slope(u)
        digits = u.abs().log10().clamp(*_DECADES)
        counts = torch.histc(digits, _BINS, *_DECADES).cpu().numpy()
        sums = [len(u), *(float(x.sum()) for x in (weight, (weight * u).square(), slope, slope.square()))]
        self._histogram += counts
        self._terms.append(sums)
        return weights

    def for_worker(self) -> Reweighting:
        """As `RowWeighting.for_worker`."""
        return Reweighting(self.loss, self._parameters, self.scale)

    def add(self, other: Reweighting) -> None:
        """As `RowWeighting.add`."""
        self._histogram += other._histogram
        self._terms += other._terms

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
    def newton_ratio(self) -> float:
        """Newton's step over that of least squares with these weights, and so is what leaving rows out does."""
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


def _has_converged(fit: Fit, before: Fit, scale: float, new_scale: float) -> bool:
    """Whether a pass has moved predicted rows, extra parameters and the scale far less than their errors.

    So it has where nothing but rounding remains to be fitted.
    """
    problem = fit.assembly.problem
    estimate = fit.estimate
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
    estimate = fit.estimate
    problem = fit.assembly.problem
    factor = reweighting.deviation(problem.oversampling * estimate.rank) / max(estimate.residual_std, _TINY)
    if not (np.isfinite(factor) and factor > 0.0):
        return fit
    added = (factor**2 - 1.0) * estimate.cost
    changed: dict[str, Any] = {name: getattr(estimate, name) + added for name in ("cost", "nominal_cost")}
    if isinstance(estimate, ConstrainedEstimate):
        objectives = {name: getattr(estimate, name) for name in ("objective", "unconstrained")}
        changed |= {name: x + added / problem.rows for name, x in objectives.items() if x is not None}
    estimate = replace(estimate, noise_error=factor * estimate.noise_error, **changed)
    assembly = replace(fit.assembly, problem=replace(problem, residual=max(problem.residual + added, 0.0)))
    extras = [replace(x, noise_error=factor * x.noise_error) for x in fit.extras]
    out = replace(fit, assembly=assembly, estimate=estimate, extras=extras)
    return out if fit.jackknife is None else with_block_errors(out, fit.jackknife, reweighting.newton_ratio)
