"""A fit of compressed logs: the problem they pose, its solution, and the unknowns that were eliminated on the way."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from torchid.analysis.calibration import ExtraEstimate, estimate_extras
from torchid.errors import TorchidWarning
from torchid.estimators import Estimate
from torchid.problem import LinearProblem, RowBuilder
from torchid.problem.elimination import Assembly
from torchid.problem.folds import states_together
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


def fits_without_folds(
    parts: Sequence[Part],
    scene: Scene,
    builder: RowBuilder,
    solve: Callable[[LinearProblem], Estimate],
    source: object = "experiment",
) -> list[Fit]:
    """For every fold, in order, the fit of all others; none where there is only one. Arguments as of `fitted`."""
    folds = sorted({part.fold for part in parts})
    if len(folds) < 2:
        return []
    blocks = states_together(parts, builder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # the fit of all of them says the same
        return [
            fitted([block for block in blocks if block.fold != fold], scene, builder, solve, source) for fold in folds
        ]


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
    assembly = assembled(parts, builder, scene.robot, scene.config.estimator, source)
    return solved(parts, assembly, scene, solve)


def solved(parts: list[Part], assembly: Assembly, scene: Scene, solve: Callable[[LinearProblem], Estimate]) -> Fit:
    """Solve what the logs pose. Arguments as of `fitted`."""
    estimate = solve(assembly.problem)
    extras = estimate_extras(assembly, estimate, scene.robot.body_names, scene.config.estimator.rank_tolerance)
    return Fit(parts, assembly, estimate, extras)
