"""How far identified parameters are from the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from legged.robots import Legged, TrueRobot, nominal_robot
from torchid.identifiability.base_parameters import BaseParameters, base_parameters, structural_problem
from torchid.parameters import PER_BODY, Array
from torchid.sensing import named_sensors

_FRICTION_FROM = 10  # number of a friction parameter among those of a body


@cache
def structural_base(legged: Legged) -> BaseParameters:
    """Base parameters of a robot in flight with all its sensors: of all motions, friction included."""
    robot = nominal_robot(legged)
    return base_parameters(structural_problem(robot, (), named_sensors("full", robot.n, 0), [()]))


@dataclass(frozen=True)
class ParameterErrors:
    """Errors of base parameters as shares of the URDF's: their medians, and the share that the URDF has better.

    `inertial`: without friction, of which the URDF knows nothing.
    """

    median: float
    inertial: float
    friction: float
    worse: float
    mass: float


def parameter_errors(true: TrueRobot, phi: Array) -> ParameterErrors:
    """Errors of parameters (L, 12) or (12 L,)."""
    base = structural_base(true.legged)
    found, truth, urdf = (base.reduce(x.flatten()) for x in (phi, true.phi, true.robot.nominal))
    ratio = np.abs(found - truth) / np.maximum(np.abs(urdf - truth), 1e-12)
    friction = base.kept % PER_BODY >= _FRICTION_FROM
    mass = float(np.reshape(phi, (-1, PER_BODY))[:, 0].sum())
    return ParameterErrors(
        median=float(np.median(ratio)),
        inertial=float(np.median(ratio[~friction])),
        friction=float(np.median(ratio[friction])),
        worse=float(np.mean(ratio > 1.0)),
        mass=mass,
    )
