"""Robust fits: passes over the logs in which rows that fit badly count less."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.problem import RowBuilder, Samples
from torchid.problem.robust import TUNING, Reweighting, RobustLoss
from torchid.problem.streaming import Part, compress_parts
from torchid.run.fit import Fit

_CONVERGED = 0.03  # rms change of the predicted rows, in their standard errors
_STEADY = 0.02  # relative change of the scale, whose histogram has bins of 1.2 %
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
        reweighting = Reweighting(current, by_log, max(scale, float(np.finfo(float).tiny)))
        before, done = fit, done + 1
        fit = solve(compress_parts(logs, builder, progress=progress, weigh=reweighting))
        moved = fit.assembly.problem.distance(fit.estimate.phi, before.estimate.phi)
        rows = fit.assembly.problem.rows / fit.assembly.problem.oversampling
        least = _CONVERGED * scale * float(np.sqrt(fit.estimate.rank / rows))
        settled = abs(reweighting.median_scale - scale) <= _STEADY * scale and moved <= least
        converged = settled and current == loss
        scale = reweighting.median_scale
    found = RobustSummary(loss.kind, loss.tuning, scale, reweighting.mean_weight, done, converged)
    factor = reweighting.deviation / fit.estimate.residual_std
    if not np.isfinite(factor):
        factor = 1.0
    estimate = replace(fit.estimate, standard_error=factor * fit.estimate.standard_error)
    extras = [replace(x, standard_error=factor * x.standard_error) for x in fit.extras]
    return replace(fit, estimate=estimate, extras=extras), found


def loss_of(kind: str, tuning: float | None) -> RobustLoss:
    """The loss of a name, with its usual tuning if none is given."""
    return RobustLoss(kind, TUNING[kind] if tuning is None else tuning)
