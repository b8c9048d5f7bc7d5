"""The certified path: the same problem as a semidefinite programme (the only module that imports CVXPY)."""

from __future__ import annotations

import warnings

try:
    import cvxpy as cp
except ImportError as error:
    raise ImportError("the certified method needs CVXPY and Clarabel: pip install 'torchid[certified]'") from error
import numpy as np

from torchid.errors import InputError, NumericalWarning
from torchid.estimators.conic import ConicProblem, Solution
from torchid.parameters import Array

_LEAST_SIZE = 1e-6  # of the problem's size: what the solver sees must not vanish
_LOOSE = 1e-6  # relative gap worth a warning


def solve_certified(problem: ConicProblem, tolerance: float = 1e-10) -> Solution:
    """Solve with Clarabel, a primal-dual interior-point method: its multipliers certify what it finds.

    Raises:
        InputError: the conditions exclude each other, or the solver gave up.

    Warns:
        NumericalWarning: the solver stopped short.
    """
    size = max(problem.constant, _LEAST_SIZE * problem.size)
    x = cp.Variable(len(problem.linear))
    objective = cp.sum_squares((problem.root @ x - problem.target) / np.sqrt(size)) + (problem.linear / size) @ x
    blocks = []
    for base, slopes, variables, weight in zip(
        problem.base, problem.slopes, problem.variables, problem.weights, strict=True
    ):
        block = cp.reshape(slopes.reshape(10, 16).T @ x[variables] + base.ravel(), (4, 4), order="C")
        blocks.append(block >> 0)
        if weight > 0.0:
            objective -= (weight / size) * cp.log_det(block)
    rows = problem.G @ x >= problem.h
    programme = cp.Problem(cp.Minimize(objective), [*blocks, rows, problem.E @ x == problem.e])
    _run(programme, tolerance)
    best = np.asarray(x.value, dtype=np.float64)
    Z, y = size * np.array([_positive(block.dual_value) for block in blocks]), size * np.maximum(rows.dual_value, 0.0)
    weighted = problem.weights > 0.0
    Z[weighted] += problem.weights[weighted, None, None] * np.linalg.inv(problem.blocks(best)[weighted])
    value = problem.objective(best)
    gap = problem.gap(best, Z, y)
    if not gap <= _LOOSE * max(value, _LEAST_SIZE * problem.size):
        warnings.warn(
            f"estimator: the conic solver stopped at a gap of {gap:.1g} to {value:.3g}", NumericalWarning, stacklevel=4
        )
    return Solution(best, value, gap, int(programme.solver_stats.num_iters or 0))


def _run(programme: cp.Problem, tolerance: float) -> None:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an inaccurate solution: the gap says how much
            programme.solve(
                solver=cp.CLARABEL, tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance, accept_unknown=True
            )
    except cp.SolverError as error:
        raise InputError("estimator", "method", f"Clarabel gave up: {error}", "method: barrier") from error
    if programme.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        found = f"{programme.status}: the conditions exclude each other"
        raise InputError("estimator", "conditions", found, "conditions that some robot can meet")


def _positive(Z: Array) -> Array:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(Z)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, dtype=np.float64)
