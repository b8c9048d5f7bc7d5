"""Masses that a scale has told, of the whole robot or of single bodies, as equations of a linear problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid import parameters
from torchid.config.estimator import EstimatorConfig
from torchid.errors import ConfigError, UnknownNameError
from torchid.identifiability.confounding import mass_weights
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.problem.chunks import one_thread
from torchid.robot import Robot

TOTAL = "estimator.total_mass"
"""Key of the mass of the whole robot."""

_WEIGHT = 10.0
"""Of an exact equation, in the largest singular value of all others.

They have no part along it (see `with_known_masses`), so that the weight matters only beside a ridge: one of 1e-3 leaves
1e-7 of the difference from the URDF. Each further ten takes a digit of the tolerance of rank.
"""

_LEAST_NOISE = 0.1
"""Of whitened rows: those of exact data, beside which a scale would count for nothing, have 1e-12."""


@dataclass(frozen=True)
class KnownMass:
    """A mass that is known, `weights @ phi = value`.

    Attributes:
        field: key of the experiment file.
        weights: (12 L,), 1 at each mass that it is the sum of.
        value: [kg].
        std: standard deviation [kg], 0 if it is exact.
    """

    field: str
    weights: Array
    value: float
    std: float = 0.0


def known_masses(settings: EstimatorConfig, robot: Robot) -> tuple[KnownMass, ...]:
    """The masses that an experiment file states.

    Raises:
        UnknownNameError: a body that the robot does not have.
        ConfigError: a mass of a body that is not fitted, or none left for those that are.
    """
    stated = settings.masses
    for name in stated:
        field = f"estimator.masses.{name}"
        if name not in robot.body_names:
            raise UnknownNameError.at_field("estimator.masses", name, robot.body_names)
        if name in settings.frozen:
            raise ConfigError.at_field(field, "a mass of a body that is frozen", "one of the two")
        if robot.bodies[robot.body_names.index(name)].massless:
            raise ConfigError.at_field(field, f"a mass, but {name} has none in the {robot.format}", "a body that has")
        if "m" in (settings.bounds or {}).get(name, {}):
            raise ConfigError.at_field(field, f"a mass, beside estimator.bounds.{name}.m", "one of the two")
    out = [
        KnownMass(f"estimator.masses.{name}", _weight_of(robot, name), mass.value, mass.std)
        for name, mass in stated.items()
    ]
    if settings.total_mass is not None:
        _check_total(settings, robot)
        mass = settings.total_mass
        out.append(KnownMass(TOTAL, mass_weights(len(robot.bodies)), mass.value, mass.std))
    return tuple(out)


def _weight_of(robot: Robot, body: str) -> Array:
    weights = np.zeros((len(robot.bodies), PER_BODY))
    weights[robot.body_names.index(body), parameters.MASS] = 1.0
    return weights.flatten()


def _check_total(settings: EstimatorConfig, robot: Robot) -> None:
    """Refuse a total that known and frozen bodies leave nothing of, or too much."""
    total = settings.total_mass
    if total is None:
        return
    held = {name: float(robot.nominal[robot.body_names.index(name), parameters.MASS]) for name in settings.frozen}
    held |= {name: mass.value for name, mass in settings.masses.items()}
    free = [body.name for body in robot.bodies if not body.massless and body.name not in held]
    if sum(held.values()) >= total.value:
        found = f"{total.value:g} kg, of which {', '.join(held)} alone are {sum(held.values()):.4g} kg"
        raise ConfigError.at_field(TOTAL, found, "the mass of the whole robot, as weighed")
    if not free:
        found = f"{total.value:g} kg, with the mass of every body frozen or known"
        raise ConfigError.at_field(TOTAL, found, "no such key, or a body whose mass is fitted")


@one_thread()
def with_known_masses(
    problem: LinearProblem, masses: Sequence[KnownMass], noise: float = 1.0, homogeneous: bool = False
) -> LinearProblem:
    """A problem with known masses as further rows.

    Exact ones are first eliminated from the other rows: these see deviations orthogonal to them (in units of the
    scale) and what the known masses make of the measured forces. Their own rows then hold to rounding, however far the
    data are from them and whatever their weight.

    Args:
        problem: in the bodies' parameters.
        masses: that are known.
        noise: standard deviation of whitened rows, correlation counted, by which stated deviations are weighted.
        homogeneous: whether the rows say nothing of how large all forces are. None at all fit them best then, so that a
            mass with a standard deviation would shrink: one is eliminated too, and its row has the deviation alone.
    """
    noise = max(noise, _LEAST_NOISE)
    kept = [mass for mass in masses if not mass.std]
    if homogeneous and not kept:
        kept = [*masses[-1:]]  # the total one, if any
    A, b, rows, values = _eliminated(problem, kept, noise)
    uncertain = [mass for mass in masses if mass not in kept]
    if uncertain:
        free, scale = problem.free, problem.scale[problem.free]
        weights, (equations, missing) = (
            noise / np.array([mass.std for mass in uncertain]),
            _equations(problem, uncertain),
        )
        more = np.zeros((len(weights), len(free)))
        more[:, free] = weights[:, None] * equations / scale
        rows = np.concatenate([rows, more])
        values = np.append(values, weights * missing + more @ problem.nominal)
    held = problem.held
    if held is not None:
        held = np.concatenate([held, np.zeros((len(rows), held.shape[1]))])
    return replace(
        problem, A=np.concatenate([A, rows]), b=np.append(b, values), rows=problem.rows + len(values), held=held
    )


def _eliminated(problem: LinearProblem, masses: Sequence[KnownMass], noise: float) -> tuple[Array, Array, Array, Array]:
    """A and b of a problem that depend on no deviation along some masses, and the rows and right-hand side of these."""
    free, scale = problem.free, problem.scale[problem.free]
    rows = np.zeros((len(masses), len(free)))
    if not masses:
        return problem.A, problem.b, rows, np.zeros(0)
    equations, missing = _equations(problem, masses)
    Q, R = np.linalg.qr(equations.T)
    target = np.linalg.solve(R.T, missing) + Q.T @ (problem.nominal[free] / scale)  # along Q, orthonormal columns
    scaled, A = problem.A[:, free] * scale, problem.A.copy()
    along = scaled @ Q
    A[:, free] -= along @ (Q.T / scale)
    weight = _WEIGHT * float(np.linalg.norm(scaled - along @ Q.T, 2))
    if masses[0].std:
        weight = min(weight, noise / masses[0].std * float(np.linalg.norm(equations)))
    rows[:, free] = weight * Q.T / scale
    return A, problem.b - along @ target, rows, weight * target


def _equations(problem: LinearProblem, masses: Sequence[KnownMass]) -> tuple[Array, Array]:
    """Rows (k, P') and right-hand sides (k,) in scaled deviations of the free parameters from the nominal ones."""
    free, scale = problem.free, problem.scale[problem.free]
    weights = np.array([mass.weights for mass in masses]).reshape(len(masses), len(free))
    missing = np.array([mass.value for mass in masses]) - weights @ problem.nominal
    return weights[:, free] * scale, missing
