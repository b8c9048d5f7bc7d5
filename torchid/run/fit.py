"""A fit of compressed logs: the problem they pose, its solution, and the unknowns that were eliminated on the way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from torchid.analysis.calibration import ExtraEstimate, estimate_extras
from torchid.estimators import Estimate, LeastSquares
from torchid.problem import LinearProblem, RowBuilder
from torchid.problem.elimination import Assembly
from torchid.problem.streaming import Part
from torchid.run.estimation import assembled
from torchid.run.experiment import Scene


@dataclass(frozen=True)
class Fit:
    """Compressed logs, what they pose, and its solution."""

    parts: list[Part]
    assembly: Assembly
    estimate: Estimate
    extras: list[ExtraEstimate]

    def columns(self, builder: RowBuilder, log: str) -> Tensor:
        """Parameters in the builder's columns for the rows of a log, (width,)."""
        values = {x.extra.label: x.value for x in self.extras if x.log in ("", log)}
        extras = [values.get(extra.label, 0.0) for extra in builder.extras]
        return builder.columns_of(np.append(self.estimate.phi, extras)[None])[0]


def fitted(
    parts: list[Part],
    scene: Scene,
    builder: RowBuilder,
    solve: Callable[[LinearProblem], Estimate],
    source: object = "experiment",
) -> Fit:
    """Fit the logs that have been compressed.

    Args:
        parts: of the logs.
        scene: robot and settings.
        builder: of the rows.
        solve: an estimator.
        source: named in errors.
    """
    settings, robot = scene.config.estimator, scene.robot
    assembly = assembled(parts, builder, robot, settings, source)
    if any(part.unloaded for part in parts):
        first = LeastSquares(settings.ridge, settings.rank_tolerance).solve(assembly.problem)
        parts = [_with_own_noise(part, first.residual_std) for part in parts]
        assembly = assembled(parts, builder, robot, settings, source)
    estimate = solve(assembly.problem)
    extras = estimate_extras(assembly, estimate, robot.body_names, settings.rank_tolerance)
    return Fit(parts, assembly, estimate, extras)


def _with_own_noise(part: Part, residual_std: float) -> Part:
    """A part whose readings in the air keep the noise that they show, where all others have more than is stated.

    What accelerations and models get wrong on the ground says nothing of a sensor that nothing touches.
    """
    if not part.unloaded or residual_std <= 1.0:
        return part
    return replace(part, factor=part.factor.times(residual_std))
