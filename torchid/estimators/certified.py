"""The conic problem solved by Clarabel, a primal-dual solver (the only module that imports it)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import clarabel
import numpy as np
from scipy import sparse

from torchid.errors import InputError, NumericalWarning, warn
from torchid.estimators.barrier import find_strictly_feasible
from torchid.estimators.conic_problem import ConicProblem, Solution
from torchid.parallel import one_thread
from torchid.parameters import Array

_TOLERANCE = 1e-10  # relative gap that Clarabel is asked for
_LOOSE = 1e-6  # relative gap above which the next try follows, and after the last one a warning
_OUTSIDE = 1e-8  # violation of a condition, in units of the scale, above which the next try follows
_FAR = 1e-7  # violation above which there is a warning after the last try
_TRIES = ((1.0, 1.0), (0.1, 1.0), (0.01, 10.0), (10.0, 10.0), (0.1, 100.0), (100.0, 1000.0))
"""Units of the objective and of the tolerance: Clarabel stalls on one in 300 problems with an entropic prior."""
_AGAIN = ((0.1, 1.0), (1.0, 1.0), (0.01, 10.0), (0.1, 100.0))  # the same in units of the objective at nominal
_ENDED = ("Solved", "AlmostSolved", "InsufficientProgress")
"""States of Clarabel with a point; its gap says how accurate it is."""


class _SolverError(Exception):
    """Clarabel found no point."""


def solve_certified(problem: ConicProblem) -> Solution:
    """Solve with Clarabel, a primal-dual interior-point method, whose multipliers certify its solution.

    Raises:
        InputError: the conditions exclude each other, or the solver found no solution.

    Warns:
        NumericalWarning: the solution is not as accurate as it should be.
    """
    size = max(problem.constant, problem.floor, 10.0 * float(problem.weights.max(initial=0.0)))
    whole = max(problem.constant + float(problem.target @ problem.target), size)
    tries = [(unit * size, share) for unit, share in _TRIES] + [(unit * whole, share) for unit, share in _AGAIN]
    solutions, status = [], ""
    for unit, share in tries:
        try:
            solutions.append(_solve(problem, unit, share * _TOLERANCE))
        except _SolverError as error:
            status = str(error)
            continue
        if _excess(problem, solutions[-1]) <= 1.0:
            return solutions[-1]
    if not solutions:
        with one_thread():
            find_strictly_feasible(problem)  # its error names the condition
        raise InputError("estimator", "method", f"certified, but Clarabel ends with {status}", "barrier")
    best = min(solutions, key=lambda solution: _excess(problem, solution))
    if best.gap <= _LOOSE * max(best.objective, problem.floor) and _violation(problem, best) <= _FAR:
        return best
    message = f"estimator: the conic solver stopped at a gap of {best.gap:.1g} to {best.objective:.3g}"
    message += f", {_violation(problem, best):.1g} outside the conditions"
    warn(message, NumericalWarning)
    return best


def _excess(problem: ConicProblem, solution: Solution) -> float:
    """The larger of gap and largest violation, each relative to its tolerance."""
    gap = solution.gap / max(solution.objective, problem.floor)
    return max(gap / _LOOSE, _violation(problem, solution) / _OUTSIDE)


def _violation(problem: ConicProblem, solution: Solution) -> float:
    """The largest violation of a condition, 0 if all are met."""
    return -float(problem.slack(solution.x).min(initial=0.0))


@dataclass
class _Program:
    """min 1/2 x^T P x + q^T x, with A x + s = b and s in a product of cones: Clarabel's form.

    Attributes:
        P: diagonal of P.
        q: as above.
        rows: blocks of A with their columns.
        b: as above, by block.
        cones: of the blocks.
    """

    P: Array
    q: Array
    rows: list[tuple[Array, np.ndarray]] = field(default_factory=list)
    b: list[Array] = field(default_factory=list)
    cones: list[Any] = field(default_factory=list)

    def require(self, cone: Any, A: Array, columns: np.ndarray, b: Array) -> slice:
        """Require b - A x[columns] to be in a cone; returns the slice of its multipliers."""
        start = sum(map(len, self.b))
        self.rows.append((A, columns))
        self.b.append(b)
        self.cones.append(cone)
        return slice(start, start + len(b))

    def matrix(self) -> sparse.csc_matrix:
        blocks = []
        for A, columns in self.rows:
            index = np.repeat(np.arange(len(A)), len(columns)), np.tile(columns, len(A))
            blocks.append(sparse.coo_matrix((A.ravel(), index), (len(A), len(self.q))))
        A = sparse.csc_matrix(sparse.vstack(blocks))
        A.eliminate_zeros()  # else the factorization takes two to six times as long
        return A


def _solve(problem: ConicProblem, size: float, tolerance: float) -> Solution:
    """Solve in units `size` of the objective: Clarabel's tolerances are absolute for small numbers.

    The misfit is a variable of its own, as squares of R would cost digits. A weighted log det F is the sum of t_i, with
    exp(t_i) <= L_ii and [[F, L], [L^T, diag(L)]] >= 0 for a lower triangular L.
    """
    n, m = len(problem.linear), len(problem.target)
    weighted, unit = problem.weights > 0.0, np.sqrt(size)
    count = int(weighted.sum())
    width = n + m + (len(_LOWER[0]) + 4) * count
    program = _Program(np.zeros(width), np.zeros(width))
    program.P[n : n + m], program.q[:n] = 2.0, problem.linear / size
    x = np.arange(n)
    misfit = np.hstack([problem.root / unit, -np.eye(m)])
    program.require(clarabel.ZeroConeT(m), misfit, np.arange(n + m), problem.target / unit)
    if len(problem.e):
        program.require(clarabel.ZeroConeT(len(problem.e)), problem.E, x, problem.e)
    at_rows = slice(0, 0)
    if len(problem.h):
        at_rows = program.require(clarabel.NonnegativeConeT(len(problem.h)), -problem.G, x, -problem.h)
    at_blocks = [
        program.require(
            clarabel.PSDTriangleConeT(4), -_svec(problem.F[k]).T, problem.variables[k], _svec(problem.F0[k])
        )
        for k in np.flatnonzero(~weighted)
    ]
    for number, k in enumerate(np.flatnonzero(weighted)):
        _require_log_det(program, problem, int(k), n + m + number * (width - n - m) // count, size)
    result = _run(program, tolerance)
    best, multipliers = np.array(result.x)[:n], size * np.array(result.z)
    best = best - problem.E.T @ (problem.E @ best - problem.e)
    Z = np.zeros_like(problem.F0)
    Z[~weighted] = np.array([_positive(_smat(multipliers[at])) for at in at_blocks]).reshape(-1, 4, 4)
    Z[weighted] = problem.weights[weighted, None, None] * np.linalg.inv(problem.blocks(best)[weighted])
    y = np.maximum(multipliers[at_rows], 0.0)
    gap = abs(problem.gap(best, Z, y))  # negative where the solver's accuracy leaves x outside
    return Solution(best, problem.objective(best), gap, int(result.iterations))


def _require_log_det(program: _Program, problem: ConicProblem, block: int, start: int, size: float) -> None:
    """Add -w log det F of a block to the objective; L and t, 10 and 4 variables, begin at `start`."""
    rows, columns = _LOWER
    L = np.zeros((len(rows), 8, 8))
    for number, (i, j) in enumerate(zip(rows.tolist(), columns.tolist(), strict=True)):
        L[number, i, 4 + j] = L[number, 4 + j, i] = 1.0
        L[number, 4 + i, 4 + j] = float(i == j)
    F0, F = (np.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, 4)] * 2) for x in (problem.F0[block], problem.F[block]))
    at = np.concatenate([problem.variables[block], start + np.arange(len(rows))])
    program.require(clarabel.PSDTriangleConeT(8), -_svec(np.concatenate([F, L])).T, at, _svec(F0))
    for i, diagonal in enumerate(np.flatnonzero(rows == columns).tolist()):
        t = start + len(rows) + i
        A = np.array([[-1.0, 0.0], [0.0, 0.0], [0.0, -1.0]])
        program.require(clarabel.ExponentialConeT(), A, np.array([t, start + diagonal]), np.array([0.0, 1.0, 0.0]))
        program.q[t] = -problem.weights[block] / size


def _run(program: _Program, tolerance: float) -> Any:
    """Clarabel's solution, optimal or not: the gap says by how much. Raises _SolverError: nothing was found."""
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    P = sparse.csc_matrix(sparse.diags(program.P))
    A, b = program.matrix(), np.concatenate(program.b)
    result = clarabel.DefaultSolver(P, program.q, A, b, program.cones, settings).solve()
    if str(result.status) not in _ENDED or not np.isfinite(result.x).all():
        raise _SolverError(str(result.status))
    return result


_LOWER = np.tril_indices(4)
"""Rows and columns of a lower triangle."""


def _svec(M: Array) -> Array:
    """Symmetric matrices (..., k, k) as vectors of the same norm: upper triangles, column by column."""
    columns, rows = np.tril_indices(M.shape[-1])
    return M[..., rows, columns] * np.where(rows == columns, 1.0, np.sqrt(2.0))


def _smat(v: Array) -> Array:
    """The matrix (4, 4) of a vector of `_svec`."""
    columns, rows = _LOWER
    M = np.zeros((4, 4))
    M[rows, columns] = M[columns, rows] = v / np.where(rows == columns, 1.0, np.sqrt(2.0))
    return M


def _positive(Z: Array) -> Array:
    values, vectors = np.linalg.eigh(Z)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T, dtype=np.float64)
