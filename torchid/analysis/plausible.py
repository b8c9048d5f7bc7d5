"""What no robot can be: a fit that says that signs, units or frames of the data are wrong."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid import parameters
from torchid.analysis.known import TotalMass
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.problem.linear import LinearProblem
from torchid.problem.threads import one_thread
from torchid.robot import Robot

OFF = 10.0
"""Factor that no model of a robot is off by: units are by a thousand, a gear by 50 to 160."""

_GRAVITY = 9.81  # m/s^2
_CLEAR = (
    0.5  # correlation of the forces of the URDF's bodies with the measured ones, from which on their factor is clear
)


def implausible(problem: LinearProblem, phi: Array, mass: TotalMass, robot: Robot) -> str | None:
    """In words what a sane person would not print of fitted parameters, None if nothing.

    What the data do not determine is no reason: it is not printed as a result.

    Args:
        problem: that was solved.
        phi: (12 L,), its solution.
        mass: how well the total mass is known.
        robot: the robot.
    """
    gain = force_gain(problem)
    if mass.determined and absurd(mass.value / mass.nominal):
        known = f"{mass.value:.4g} ± {mass.standard_error:.2g} kg where the URDF weighs {mass.nominal:.4g} kg"
        return f"the fit's total mass is {known}{_told(mass.value / mass.nominal)}"
    if gain is not None and absurd(gain):
        return f"the measured forces are {gain:.3g} times what the URDF's bodies need{_told(gain)}"
    return next(_beyond_bounds(phi.reshape(-1, PER_BODY), robot), None)


def absurd(ratio: float) -> bool:
    """Whether what was found cannot be so many times what the URDF says."""
    return not 1.0 / OFF <= ratio <= OFF


def _told(ratio: float) -> str:
    return ", the opposite sign" if ratio < 0.0 else ""


@one_thread()
def force_gain(problem: LinearProblem) -> float | None:
    """The factor of the forces that nominal bodies need which fits best, None if it is not clear.

    Friction is whatever fits. Unlike a total mass it is there for arms as well, and does not depend on the estimator.
    """
    inertial = np.zeros((len(problem.nominal) // PER_BODY, PER_BODY), dtype=bool)
    inertial[:, parameters.INERTIAL] = True
    chosen = inertial.flatten()
    needed = problem.A[:, chosen] @ problem.nominal[chosen]
    free, fixed = ~chosen & problem.free, ~chosen & ~problem.free
    measured = problem.b - problem.A[:, fixed] @ problem.nominal[fixed]
    U, values, _ = np.linalg.svd(problem.A[:, free] * problem.scale[free], full_matrices=False)
    friction = U[:, values > 1e-10 * values.max(initial=0.0)]
    needed, measured = (x - friction @ (friction.T @ x) for x in (needed, measured))
    size = np.linalg.norm(needed) * np.sqrt(measured @ measured + problem.residual)
    if not size > 0.0 or abs(needed @ measured) < _CLEAR * size:
        return None
    return float(needed @ measured / (needed @ needed))


def _beyond_bounds(phi: Array, robot: Robot) -> Iterator[str]:
    """Parameters, (L, 12), that are beyond what `OFF` whole robots at full reach could make of one body."""
    total = float(robot.nominal[:, parameters.MASS].sum())
    reach = _reach(robot)
    bound = np.empty(PER_BODY)
    bound[parameters.MASS], bound[parameters.FIRST_MOMENT] = total, total * reach
    bound[parameters.INERTIA], bound[parameters.FRICTION] = total * reach**2, total * _GRAVITY * max(reach, 1.0)
    beyond = ~(np.abs(phi) <= OFF * np.maximum(bound, np.abs(robot.nominal)))
    for body, parameter in np.argwhere(beyond):
        found = f"{robot.body_names[body]} has {PARAMETERS[parameter]} = {phi[body, parameter]:.3g}"
        yield f"the fit's {found}, beyond {OFF:g} times the whole URDF's {bound[parameter]:.3g}"


def _reach(robot: Robot) -> float:
    """Length of the longest chain of bodies [m], with the size of its last."""
    mass = np.maximum(robot.nominal[:, parameters.MASS], np.finfo(float).tiny)
    radius = np.sqrt(np.maximum(np.trace(parameters.inertia_matrix(robot.nominal), axis1=1, axis2=2) / 2.0 / mass, 0.0))
    radius[robot.nominal[:, parameters.MASS] <= 0.0] = 0.0
    away = np.zeros(len(robot.bodies))
    for number, body in enumerate(robot.bodies):
        if body.joint is not None:
            away[number] = away[body.parent] + np.linalg.norm(body.joint.T_parent_joint[:3, 3])
    return float((away + radius).max())
