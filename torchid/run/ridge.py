"""The ridge that predicts blocks of the training logs best which the fit has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.errors import ConfigError, TorchidWarning
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.folds import states_together
from torchid.problem.streaming import Part
from torchid.run.calibration import Calibration
from torchid.run.estimation import stand_in, stated_conditions
from torchid.run.experiment import Scene
from torchid.run.fit import posed, solved
from torchid.run.validation import residuals
from torchid.sensing import SensorSet

GRID = tuple(float(f"1e{power}") for power in range(-7, 2))
"""Ridges that are tried, in decades: finer steps change predictions by less than their spread over the folds."""


@dataclass(frozen=True)
class RidgeChoice:
    """A ridge, and the mean square of whitened residuals on left-out folds by ridge tried, with standard errors.

    The errors are those of the difference from the best.
    """

    ridge: float
    tried: tuple[float, ...]
    mean_square: tuple[float, ...]
    standard_error: tuple[float, ...]


def chosen_ridge(
    parts: Sequence[Part],
    blocks: Sequence[Samples],
    scene: Scene,
    sensors: SensorSet,
    builder: RowBuilder,
    source: object = "experiment",
    done: Callable[[int], None] | None = None,
) -> RidgeChoice:
    """The largest ridge whose error on left-out folds is within a standard error of the least.

    Source: the one-standard-error rule, Hastie, Tibshirani, Friedman, "The Elements of Statistical Learning", 7.10; the
    error is that of the difference between two ridges, fold by fold, which says whether they differ.

    Args:
        parts: of the blocks, compressed.
        blocks: training logs, as `in_folds` cuts them.
        scene: robot, contacts and settings.
        sensors: of the fit.
        builder: of the rows.
        source: named in errors.
        done: called with the number of fits done.

    Raises:
        ConfigError: too few samples to leave some out.
    """
    folds = sorted({part.fold for part in parts})
    if len(folds) < 2:
        found = "auto, but the training samples are too few to leave blocks of them out"
        raise ConfigError(source, "estimator.ridge", found, "a number, or longer logs")
    together = states_together(parts, builder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # the fit says the same
        squares = np.array([_left_out(fold, together, blocks, scene, sensors, builder, source, done) for fold in folds])
    means = squares.mean(axis=0)
    apart = squares - squares[:, [int(means.argmin())]]
    error = apart.std(axis=0, ddof=1) / np.sqrt(len(folds))
    within = np.flatnonzero(apart.mean(axis=0) <= error)
    return RidgeChoice(float(GRID[within[-1]]), GRID, tuple(means.tolist()), tuple(error.tolist()))


def _left_out(
    fold: int,
    parts: Sequence[Part],
    blocks: Sequence[Samples],
    scene: Scene,
    sensors: SensorSet,
    builder: RowBuilder,
    source: object,
    done: Callable[[int], None] | None,
) -> Array:
    """Mean squares on a fold of what is fitted without it, one for each ridge tried."""
    settings, robot = scene.config.estimator, scene.robot
    rest = [part for part in parts if part.fold != fold]
    rest, assembly = posed(rest, scene, builder, source)
    conditions = stated_conditions(settings, robot, source)
    logs, own = [x for x in blocks if x.fold == fold], [x for x in parts if x.fold == fold]
    out = []
    for ridge in GRID:
        fit = solved(rest, assembly, scene, stand_in(replace(settings, ridge=ridge), conditions).solve)
        _, identified = Calibration.both(scene, sensors, fit.estimate.phi, fit.extras)
        (left,) = residuals(builder, logs, own, [identified])
        out.append(left.error / max(left.rows, 1))
        if done is not None:
            done(1)
    return np.array(out)
