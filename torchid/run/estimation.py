"""The estimator that an experiment file asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchid.config.estimator import EstimatorConfig
from torchid.errors import UnknownNameError
from torchid.estimators import Conditions, Consistent, LeastSquares
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem, RowBuilder
from torchid.problem.elimination import Assembly, assemble
from torchid.problem.streaming import Part
from torchid.robot import Robot
from torchid.run.conditions import conditions_from


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
    if settings.consistency == "penalties" or not settings.pull:
        return LeastSquares(settings.pull, settings.rank_tolerance)
    return Consistent(settings.pull, conditions=conditions, rank_tolerance=settings.rank_tolerance)


def batch_estimator(settings: EstimatorConfig, conditions: Conditions) -> LeastSquares | Consistent:
    """What solves a compressed problem in one go, `least_squares` or `consistent`.

    Raises:
        InputError: the certified method without CVXPY and Clarabel.
    """
    if settings.name == "least_squares":
        return LeastSquares(settings.pull, settings.rank_tolerance)
    return Consistent(
        settings.pull, settings.prior, conditions, settings.method, settings.certify, settings.rank_tolerance
    )
