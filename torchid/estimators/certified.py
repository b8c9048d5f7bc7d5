"""The conic problem solved by Clarabel, a primal-dual solver (the only module that imports CVXPY)."""

from __future__ import annotations

import warnings

import cvxpy as cp
import numpy as np

from torchid.errors import InputError, NumericalWarning, warn
from torchid.estimators.barrier import find_strictly_feasible
from torchid.estimators.conic_problem import ConicProblem, Solution
from torchid.parameters import Array
from torchid.problem.chunks import one_thread

_LOOSE = 1e-6  # relative gap beyond which another try is made, and in the end a warning
_OUTSIDE = 1e-8  # violation of a condition, in units of the scale, beyond which another try is made; rarely exceeded
_FAR = 1e-7  # and beyond which, in the end, a warning
_TRIES = ((1.0, 1.0), (0.1, 1.0), (0.01, 10.0), (10.0, 10.0), (0.1, 100.0), (100.0, 1000.0))
"""Units of the objective and of the tolerance: Clarabel stalls on one in 300 problems with an entropic prior."""
_AGAIN = ((0.1, 1.0), (1.0, 1.0), (0.01, 10.0), (0.1, 100.0))  # units of the objective before anything is explained


def solve_certified(problem: ConicProblem, tolerance: float = 1e-10) -> Solution:
    """Solve with Clarabel, a primal-dual find_strictly_feasible-point method: its multipliers certify what it finds.

    Raises:
        InputError: the conditions exclude each other, or the solver found no solution.

    Warns:
        NumericalWarning: the solution is not as accurate as it should be.
    """
    size = max(problem.constant, problem.floor, 10.0 * float(problem.weights.max(initial=0.0)))
    whole = max(problem.constant + float(problem.target @ problem.target), size)
    tries = [(unit * size, share) for unit, share in _TRIES] + [(unit * whole, share) for unit, share in _AGAIN]
    found, status = [], ""
    for unit, share in tries:
        try:
            found.append(_solve(problem, unit, share * tolerance))
        except cp.SolverError as error:
            status = str(error)
            continue
        if _excess(problem, found[-1]) <= 1.0:
            return found[-1]
    if not found:
        with one_thread():
            find_strictly_feasible(problem)  # names what is excluded
        raise InputError("estimator", "method", f"certified, but Clarabel says {status}", "barrier")
    best = min(found, key=lambda solution: _excess(problem, solution))
    if best.gap <= _LOOSE * max(best.objective, problem.floor) and _violation(problem, best) <= _FAR:
        return best
    message = f"estimator: the conic solver stopped at a gap of {best.gap:.1g} to {best.objective:.3g}"
    message += f", {_violation(problem, best):.1g} outside the conditions"
    warn(message, NumericalWarning)
    return best


def _excess(problem: ConicProblem, solution: Solution) -> float:
    """The gap or the largest violation, whichever is larger, in units of what is accepted."""
    gap = solution.gap / max(solution.objective, problem.floor)
    return max(gap / _LOOSE, _violation(problem, solution) / _OUTSIDE)


def _violation(problem: ConicProblem, solution: Solution) -> float:
    """The largest violation of a condition, 0 if all are met."""
    return -float(problem.slack(solution.x).min(initial=0.0))


def _solve(problem: ConicProblem, size: float, tolerance: float) -> Solution:
    """Solve in units of the objective: tolerances are absolute for small numbers."""
    x = cp.Variable(len(problem.linear))
    objective = cp.sum_squares((problem.root @ x - problem.target) / np.sqrt(size)) + (problem.linear / size) @ x
    blocks = []
    for F0, F, variables, weight in zip(problem.F0, problem.F, problem.variables, problem.weights, strict=True):
        block = cp.reshape(F.reshape(10, 16).T @ x[variables] + F0.ravel(), (4, 4), order="C")
        blocks.append(block >> 0)
        if weight > 0.0:
            objective -= (weight / size) * cp.log_det(block)
    rows = [problem.G @ x >= problem.h] if len(problem.h) else []
    held = [problem.E @ x == problem.e] if len(problem.e) else []
    programme = cp.Problem(cp.Minimize(objective), [*blocks, *rows, *held])
    _run(programme, tolerance)
    best = x.value - problem.E.T @ (problem.E @ x.value - problem.e)
    Z = size * np.array([_positive(block.dual_value) for block in blocks]).reshape(-1, 4, 4)
    y = size * np.array([np.maximum(row.dual_value, 0.0) for row in rows]).reshape(-1)
    weighted = problem.weights > 0.0
    Z[weighted] += problem.weights[weighted, None, None] * np.linalg.inv(problem.blocks(best)[weighted])
    gap = abs(problem.gap(best, Z, y))  # negative where the solver's accuracy leaves x outside
    return Solution(best, problem.objective(best), gap, int(programme.solver_stats.num_iters or 0))


def _run(programme: cp.Problem, tolerance: float) -> None:
    """Solve, accepting a solution that is not quite optimal: the gap says by how much.

    Raises:
        SolverError: nothing was found.
    """
    accuracy = {"tol_gap_abs": tolerance, "tol_gap_rel": tolerance, "tol_feas": tolerance}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of an inaccurate solution
        programme.solve(solver=cp.CLARABEL, **accuracy)
    if programme.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise cp.SolverError(programme.status)


def _positive(Z: Array) -> Array:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(Z)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, dtype=np.float64)
