"""A fit of compressed logs: the estimator that an experiment file names, the problem it solves, its solution."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from torchid.config.estimator import EstimatorConfig
from torchid.errors import TorchidWarning, UnknownNameError
from torchid.estimators import Conditions, Consistent, Estimate, LeastSquares
from torchid.fitting.experiment import Scene, conditions_from
from torchid.identifiability.confounding import ExtraEstimate, estimate_extras
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem, RowBuilder, assemble
from torchid.problem.compression import Part, states_together
from torchid.problem.elimination import Assembly
from torchid.robot import Robot


def assembled(
    parts: Sequence[Part], builder: RowBuilder, robot: Robot, settings: EstimatorConfig, source: object = "experiment"
) -> Assembly:
    """The problem that parts of logs pose together, with what the settings leave free.

    Raises:
        UnknownNameError: a frozen body that the robot does not have.
    """
    assembly = assemble(parts, builder, robot, settings.friction)
    problem, known = (with_frozen(x, settings, robot, source) for x in (assembly.problem, assembly.if_known))
    return replace(assembly, problem=problem, if_known=known)


def with_frozen(
    problem: LinearProblem, settings: EstimatorConfig, robot: Robot, source: object = "experiment"
) -> LinearProblem:
    """The problem with the parameters of frozen bodies left as they are.

    Raises:
        UnknownNameError: a frozen body that the robot does not have.
    """
    return replace(problem, free=problem.free & ~frozen_parameters(settings, robot, source))


def frozen_parameters(settings: EstimatorConfig, robot: Robot, source: object = "experiment") -> np.ndarray:
    """Parameters of frozen bodies, (12 L,) bool.

    Raises:
        UnknownNameError: a frozen body that the robot does not have.
    """
    frozen = np.zeros((len(robot.bodies), PER_BODY), dtype=bool)
    for name in settings.frozen:
        if name not in robot.body_names:
            raise UnknownNameError(source, "estimator.frozen", name, robot.body_names)
        frozen[robot.body_names.index(name)] = True
    return frozen.flatten()


def stated_conditions(settings: EstimatorConfig, robot: Robot, source: object = "experiment") -> Conditions:
    """What parameters are to meet, as an experiment file says; least squares may break it.

    Raises:
        ConfigError: conditions that do not fit the robot.
    """
    if settings.name == "consistent":
        return conditions_from(settings, robot, source)
    return Conditions(margin=settings.margin if settings.name == "sgd" else 0.0, names=robot.body_names)


def stand_in(settings: EstimatorConfig, conditions: Conditions) -> LeastSquares | Consistent:
    """What solves the same problem in one go: for a descent, what it approaches with the same ridge.

    Penalties that bodies pay for not existing are left out.
    """
    if settings.name != "sgd":
        return batch_estimator(settings, conditions)
    if settings.consistency == "penalties" or not settings.numeric_ridge:
        return settings.least_squares
    return settings.consistent(conditions)


def batch_estimator(settings: EstimatorConfig, conditions: Conditions) -> LeastSquares | Consistent:
    """What solves a compressed problem in one go, `least_squares` or `consistent`.

    Raises:
        InputError: the certified method without Clarabel.
    """
    if settings.name == "least_squares":
        return settings.least_squares
    return settings.consistent(conditions)


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
    first = settings.least_squares.solve(assembly.problem)
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
