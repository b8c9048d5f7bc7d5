"""The estimator that an experiment file asks for."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np

from torchid.config.experiment import EstimatorConfig
from torchid.errors import ConfigError, UnknownNameError
from torchid.estimators import Conditions, Consistent, Estimate, LeastSquares
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem
from torchid.robot import Robot

_SHARED = ("name", "ridge", "rank_tolerance", "friction", "frozen")  # keys that every estimator has


def estimate_parameters(
    problem: LinearProblem, settings: EstimatorConfig, robot: Robot, source: object = "experiment"
) -> Estimate:
    """Solve a problem as an experiment file says.

    Args:
        problem: in the parameters of all bodies of the robot.
        settings: the estimator.
        robot: for the names of frozen bodies.
        source: named in errors.

    Raises:
        ConfigError: a setting of another estimator.
        UnknownNameError: a frozen body that the robot does not have.
        InputError: conditions that exclude each other.
    """
    problem = replace(problem, free=problem.free & ~_frozen(settings, robot, source))
    if settings.name == "least_squares":
        for field in dataclasses.fields(settings):
            if field.name not in _SHARED and getattr(settings, field.name) != field.default:
                found = f"{getattr(settings, field.name)}, which least_squares has not"
                raise ConfigError(source, f"estimator.{field.name}", found, "name: consistent, or no such key")
        return LeastSquares(settings.ridge, settings.rank_tolerance).solve(problem)
    conditions = Conditions(settings.margin, settings.total_mass)
    estimator = Consistent(
        settings.ridge, settings.prior, conditions, settings.method, settings.certify, settings.rank_tolerance
    )
    return estimator.solve(problem)


def _frozen(settings: EstimatorConfig, robot: Robot, source: object) -> np.ndarray:
    """Parameters that stay nominal, (12 L,) bool."""
    frozen = np.zeros((len(robot.bodies), PER_BODY), dtype=bool)
    for name in settings.frozen:
        if name not in robot.body_names:
            raise UnknownNameError(source, "estimator.frozen", name, robot.body_names)
        frozen[robot.body_names.index(name)] = True
    return frozen.flatten()
