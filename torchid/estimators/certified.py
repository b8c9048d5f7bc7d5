"""The certified path: the same problem as a semidefinite programme (the only module that imports CVXPY)."""

from __future__ import annotations

import warnings

try:
    import cvxpy as cp
except ImportError as error:
    raise ImportError("the certified method needs CVXPY and Clarabel: pip install 'torchid[certified]'") from error
import numpy as np

from torchid.errors import InputError, NumericalWarning
from torchid.estimators.barrier import Solution
from torchid.estimators.conic import ConicProblem

_LEAST_SIZE = 1e-6  # of the objective at the start: what the solver sees must not vanish


def solve_certified(problem: ConicProblem, tolerance: float = 1e-9) -> Solution:
    """Solve with Clarabel, an interior-point method that returns a dual certificate.

    The solver sees the objective from the unconstrained minimum up, in units of its size: its tolerances are absolute
    for small numbers.

    Raises:
        InputError: the conditions exclude each other, or the solver gave up.

    Warns:
        NumericalWarning: the solver stopped short of its tolerance.
    """
    values, vectors = np.linalg.eigh(problem.H)
    kept = values > 1e-14 * max(float(values[-1]), np.finfo(float).tiny)
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    centre = -inverse @ problem.c
    linear = problem.c + problem.H @ centre  # what the quadratic cannot take in
    lowest = 0.5 * problem.c @ centre + problem.constant
    size = max(abs(lowest), _LEAST_SIZE * abs(problem.constant), np.finfo(float).tiny)
    root = (vectors[:, kept] * np.sqrt(values[kept] / size)).T

    d = cp.Variable(len(problem.c))
    x = centre + d
    objective = 0.5 * cp.sum_squares(root @ d) + (linear / size) @ d
    conditions = []
    for base, slopes, variables, weight in zip(
        problem.base, problem.slopes, problem.variables, problem.weights, strict=True
    ):
        block = base + sum(x[int(index)] * slope for index, slope in zip(variables, slopes, strict=True) if slope.any())
        symmetric = cp.Variable((4, 4), symmetric=True)
        conditions += [symmetric == block, symmetric >> 0]
        if weight > 0.0:
            objective -= (weight / size) * cp.log_det(symmetric)
    if len(problem.h):
        conditions.append(problem.G @ x >= problem.h)
    if len(problem.e):
        conditions.append(problem.E @ x == problem.e)
    programme = cp.Problem(cp.Minimize(objective), conditions)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of its own; the status says the same
            programme.solve(solver=cp.CLARABEL, tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=1e-9)
    except cp.SolverError as error:
        raise InputError("estimator", "method", f"Clarabel gave up: {error}", "method: barrier") from error
    if d.value is None:
        found = f"{programme.status}: the conditions exclude each other"
        raise InputError("estimator", "conditions", found, "conditions that some robot can meet")
    if programme.status != cp.OPTIMAL:
        warnings.warn(f"estimator: the conic solver stopped early ({programme.status})", NumericalWarning, stacklevel=3)
    best = centre + np.asarray(d.value, dtype=np.float64)
    stats = programme.solver_stats
    gap = size * abs(float(stats.extra_stats.obj_val) - float(stats.extra_stats.obj_val_dual))
    return Solution(best, problem.objective(best), gap, int(stats.num_iters or 0))
