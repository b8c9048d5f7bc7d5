"""Parameters that a robot most probably has, by its torques and the contacts that were detected with its URDF's."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from torchid import ranks
from torchid.logs.log import FloatArray
from torchid.parameters import FRICTION, PER_BODY
from torchid.problem.compression import compress_parts
from torchid.problem.elimination import assemble
from torchid.problem.extras import ExtraTerms
from torchid.problem.linear import PRIOR_DEVIATION, LinearProblem
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

_PASSES = 3  # over the variance of what the parameters leave, which settles at once


def fitted_parameters(samples: Samples, robot: Robot, contacts: Sequence[Contact]) -> FloatArray:
    """Parameters (L, 12) of a robot without friction, which was fitted with them, as armatures were.

    Args:
        samples: with joint torques and the contacts that stand; torques without a value count as not measured.
        robot: for the prior.
        contacts: none of which is measured.
    """
    sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
    if samples.torque is not None:
        sensors = dataclasses.replace(sensors, torque=sensors.torque & samples.torque.isfinite().all(dim=0).numpy())
    builder = RowBuilder(robot, contacts, sensors, ExtraTerms(armature=True))
    with ranks.apart():  # each process has logs of its own
        problem = assemble(compress_parts([samples], builder), builder, robot).problem
    phi = most_probable(problem).reshape(-1, PER_BODY)
    phi[:, FRICTION] = robot.nominal[:, FRICTION]
    return phi


def most_probable(problem: LinearProblem) -> FloatArray:
    """Parameters (P,) that are most probable by data and nominal values, with the noise that the data themselves show.

    The prior is that of `PRIOR_DEVIATION`; MacKay, Bayesian Interpolation, 1992, with the prior's width known.
    """
    unit = problem.scale[problem.free] * PRIOR_DEVIATION
    A, b = problem.A[:, problem.free] * unit, problem.b - problem.A @ problem.nominal
    information, x = A.T @ A, np.zeros(len(unit))
    for _ in range(_PASSES):
        left = A @ x - b
        variance = problem.oversampling * (left @ left + problem.residual) / max(problem.rows, 1)
        x = np.linalg.lstsq(information + variance * np.eye(len(unit)), A.T @ b, rcond=None)[0]
    out = problem.nominal.copy()
    out[problem.free] += unit * x
    return out
