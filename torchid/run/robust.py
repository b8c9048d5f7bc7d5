"""Robust fits: passes over the logs in which rows that fit badly count less."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torchid.estimators import BoundEstimate
from torchid.problem import RowBuilder, Samples
from torchid.problem.robust import TUNING, Reweighting, RobustLoss
from torchid.problem.streaming import Part, compress_parts
from torchid.run.fit import Fit

_CONVERGED = 0.03  # rms change of the predicted rows, in their standard errors
_STEADY = 0.02  # relative change of the scale, whose histogram has bins of 1.2 %
_EXACT = 1e-11  # of the predicted rows: what is left below is rounding
_TINY = float(np.finfo(float).tiny)
_START = 3  # passes with Huber's loss, which is convex, before Tukey's


@dataclass(frozen=True)
class RobustSummary:
    """How a robust fit went: `scale` of good residuals in stated noise, `mean_weight` of rows, whether it settled."""

    loss: str
    tuning: float
    scale: float
    mean_weight: float
    passes: int
    converged: bool


def robust_fit(
    first: Fit,
    loss: RobustLoss,
    passes: int,
    logs: Sequence[Samples],
    builder: RowBuilder,
    solve: Callable[[list[Part]], Fit],
    progress: Callable[[int], None] | None = None,
) -> tuple[Fit, RobustSummary]:
    """Iteratively re-weighted least squares, a pass over the logs each time, memory flat in their length.

    Standard errors are those of the loss, not of the last weighted least squares.

    Args:
        first: the fit of all rows alike.
        loss: what residuals cost.
        passes: at most.
        logs: bound logs.
        builder: of their rows.
        solve: fits compressed logs.
        progress: called with the number of samples done.
    """
    fit, scale, converged, done = first, first.estimate.residual_std, False, 0
    sources = {samples.source for samples in logs}
    while done < passes and not converged:
        current = loss if loss.kind == "huber" or done >= _START else RobustLoss("huber", TUNING["huber"])
        by_log = {source: fit.columns(builder, source) for source in sources}
        reweighting = Reweighting(current, by_log, max(scale, _TINY))
        before, done = fit, done + 1
        fit = solve(compress_parts(logs, builder, progress=progress, weigh=reweighting))
        converged = current == loss and _settled(fit, before, scale, reweighting.median_scale)
        scale = reweighting.median_scale
    found = RobustSummary(loss.kind, loss.tuning, scale, reweighting.mean_weight, done, converged)
    return _with_errors(fit, reweighting), found


def _settled(fit: Fit, before: Fit, scale: float, new_scale: float) -> bool:
    """Whether a pass has moved predicted rows, unknowns beside the parameters and the scale far less than their errors.

    So it has where nothing but rounding is left to be fitted.
    """
    problem, estimate = fit.assembly.problem, fit.estimate
    moved = problem.distance(estimate.phi, before.estimate.phi)
    if max(moved, new_scale) <= _EXACT * problem.distance(estimate.phi, np.zeros_like(estimate.phi)):
        return True
    rows = problem.rows / problem.oversampling
    if moved > _CONVERGED * scale * np.sqrt(estimate.rank / rows) or abs(new_scale - scale) > _STEADY * scale:
        return False
    earlier = {(x.log, x.extra.label): x.value for x in before.extras}
    return all(
        abs(x.value - earlier.get((x.log, x.extra.label), np.inf)) <= _CONVERGED * x.standard_error for x in fit.extras
    )


def _with_errors(fit: Fit, reweighting: Reweighting) -> Fit:
    """The fit with standard errors of the loss: rows count as independent ones of the same errors."""
    estimate, problem = fit.estimate, fit.assembly.problem
    factor = reweighting.deviation(problem.oversampling * estimate.rank) / max(estimate.residual_std, _TINY)
    if not (np.isfinite(factor) and factor > 0.0):
        return fit
    added = (factor**2 - 1.0) * estimate.cost
    changed: dict[str, Any] = {name: getattr(estimate, name) + added for name in ("cost", "nominal_cost")}
    if isinstance(estimate, BoundEstimate):
        objectives = {name: getattr(estimate, name) for name in ("objective", "unconstrained")}
        changed |= {name: x + added / problem.rows for name, x in objectives.items() if x is not None}
    estimate = replace(estimate, standard_error=factor * estimate.standard_error, **changed)
    assembly = replace(fit.assembly, problem=replace(problem, residual=problem.residual + added))
    extras = [replace(x, standard_error=factor * x.standard_error) for x in fit.extras]
    return replace(fit, assembly=assembly, estimate=estimate, extras=extras)


def loss_of(kind: str, tuning: float | None) -> RobustLoss:
    """The loss of a name, with its usual tuning if none is given."""
    return RobustLoss(kind, TUNING[kind] if tuning is None else tuning)
