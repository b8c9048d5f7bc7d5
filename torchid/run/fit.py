"""A fit of compressed logs: the problem they pose, its solution, and the unknowns that were eliminated on the way."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from torchid.analysis.calibration import ExtraEstimate, estimate_extras
from torchid.errors import TorchidWarning
from torchid.estimators import Estimate, LeastSquares
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
    """For every fold, in order, the fit of all others; none where there is only one.

    Args:
        parts: of a fit, with the weights that they have in it.
        scene: as of `fitted`, with the others.
        builder: of the rows.
        solve: an estimator.
        source: named in errors.
    """
    folds = sorted({part.fold for part in parts})
    if len(folds) < 2:
        return []
    blocks = states_together(parts, builder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # the fit of all of them says the same
        fits = []
        for fold in folds:
            rest = [block for block in blocks if block.fold != fold]
            assembly = assembled(rest, builder, scene.robot, scene.config.estimator, source)
            fits.append(solved(rest, assembly, scene, solve))
        return fits


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
    return solved(*posed(parts, scene, builder, source), scene, solve)


def posed(
    parts: Sequence[Part], scene: Scene, builder: RowBuilder, source: object = "experiment"
) -> tuple[list[Part], Assembly]:
    """The problem that logs pose, and their parts with the weights that they have in it. Arguments as of `fitted`."""
    settings = scene.config.estimator
    assembly = assembled(parts, builder, scene.robot, settings, source)
    if not any(part.unloaded for part in parts):
        return list(parts), assembly
    first = LeastSquares(settings.pull, settings.rank_tolerance).solve(assembly.problem)
    weighed = [_with_own_noise(part, first.residual_std) for part in parts]
    return weighed, assembled(weighed, builder, scene.robot, settings, source)


def solved(parts: list[Part], assembly: Assembly, scene: Scene, solve: Callable[[LinearProblem], Estimate]) -> Fit:
    """Solve what the logs pose. Arguments as of `fitted`."""
    estimate = solve(assembly.problem)
    extras = estimate_extras(assembly, estimate, scene.robot.body_names, scene.config.estimator.rank_tolerance)
    return Fit(parts, assembly, estimate, extras)


def _with_own_noise(part: Part, residual_std: float) -> Part:
    """A part whose readings in the air keep the noise that they show, where all others have more than is stated.

    What accelerations and models get wrong on the ground says nothing of a sensor that nothing touches.
    """
    if not part.unloaded or residual_std <= 1.0:
        return part
    return replace(part, factor=part.factor.times(residual_std))
