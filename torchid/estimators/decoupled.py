"""Parameters that neither data nor conditions couple to anything: any prior leaves them at their nominal values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchid import parameters
from torchid.estimators.conditions import Conditions, violations
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem
from torchid.rounding import relative_tolerance


def with_decoupled_fixed(problem: LinearProblem, conditions: Conditions) -> LinearProblem:
    """The problem with bodies and friction fixed that no row sees and whose nominal values are allowed.

    A solver ends within a tolerance of the least objective, which parameters that only a small ridge holds hardly
    change: a KUKA's fixed base drifts by 8e-3 of its scale with a ridge of 1e-7. It also keeps away from conditions
    that nothing pushes them to.

    Args:
        problem: its parameters are those of bodies.
        conditions: on the parameters. Bodies that one ties to others (the total mass, mirror images) stay as they are.
    """
    unseen = (problem.free & ~_seen(problem)).reshape(-1, PER_BODY)
    nominal, scale = (x.reshape(-1, PER_BODY) for x in (problem.nominal, problem.scale))
    apart = replace(conditions, total_mass=None, mirrors=())
    for violation in violations(nominal, scale, apart, tolerance=0.0):
        if violation.body is not None:
            unseen[violation.body] = False
    for mirror in conditions.mirrors:
        unseen[[mirror.body, mirror.image]] = False
    inertial = unseen[:, parameters.INERTIAL]
    inertial[:] = inertial.all(axis=1, keepdims=True) & (conditions.total_mass is None)
    return replace(problem, free=problem.free & ~unseen.ravel()) if unseen.any() else problem


def _seen(problem: LinearProblem) -> np.ndarray:
    """Parameters that rows, or terms that conditions bound, depend on, (P,) bool."""
    size = np.linalg.norm(problem.A, axis=0) * problem.scale
    seen = size > relative_tolerance(0.0, problem.A.shape) * size.max(initial=0.0)
    if problem.terms is not None:
        seen |= problem.terms.C.any(axis=0)
        for condition in problem.terms.conditions:
            seen |= condition.parameters != 0.0
    return np.asarray(seen)
