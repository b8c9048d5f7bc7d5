"""Parameters that a physical robot can have: the convex problem, and its two solvers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from torchid import parameters
from torchid.estimators.barrier import Solution, solve_barrier
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic import ConicProblem
from torchid.estimators.formulate import Prior, conic_problem
from torchid.estimators.least_squares import LeastSquares
from torchid.estimators.result import Estimate
from torchid.parameters import PER_BODY, Array
from torchid.problem.linear import LinearProblem

Method = Literal["barrier", "certified"]


@dataclass(frozen=True)
class ConsistentEstimate(Estimate):
    """An estimate that meets its conditions.

    Attributes:
        objective: mean squared whitened residual plus prior.
        unconstrained: the least objective without conditions, for the Euclidean prior; None for the others.
        gap: bound on how far the objective is above the least one that the conditions allow.
        certified_gap: relative difference from the other solver's objective, None unless asked for.
        eigenvalues: (L,), smallest eigenvalue of every body's scaled pseudo-inertia, NaN for bodies without mass.
        steps: Newton steps, or iterations of the conic solver.
    """

    objective: float
    unconstrained: float | None
    gap: float
    certified_gap: float | None
    eigenvalues: Array
    steps: int


@dataclass(frozen=True)
class Consistent:
    """min ||A phi - b||^2 / rows + ridge * prior(phi) over all phi that a physical robot can have.

    Attributes:
        ridge: weight of the prior against the mean square of the whitened residual.
        prior: "euclidean", ||(phi - nominal) / scale||^2; "pullback", sum of ||J_0^-1/2 (J - J_0) J_0^-1/2||^2 over
            the bodies' pseudo-inertias J (Lee, Wensing, Park 2020); "entropic", sum of the log-det divergences
            -log det(J_0^-1 J) + tr(J_0^-1 J) - 4 (Lee, Park 2018).
        conditions: on the parameters.
        method: "barrier", the fast path, or "certified", a semidefinite programme.
        certify: solve with the other method as well, and report the difference.
        rank_tolerance: as in `LeastSquares`, for the statistics.
    """

    ridge: float = 1e-4
    prior: Prior = "euclidean"
    conditions: Conditions = field(default_factory=Conditions)
    method: Method = "barrier"
    certify: bool = False
    rank_tolerance: float = 1e-10

    def __post_init__(self) -> None:
        """Check the names."""
        for name, value, accepted in (
            ("prior", self.prior, get_args(Prior)),
            ("method", self.method, get_args(Method)),
        ):
            if value not in accepted:
                raise ValueError(f"{name}: found {value!r}; accepted: {', '.join(accepted)}")

    def solve(self, problem: LinearProblem) -> ConsistentEstimate:
        """Fit the free parameters.

        Standard errors and ranks are those of least squares with the same ridge: conditions only narrow them.

        Raises:
            InputError: the conditions exclude each other.
        """
        plain = LeastSquares(self.ridge, self.rank_tolerance).solve(problem)
        conic = conic_problem(problem, self.conditions, self.ridge, self.prior)
        solution = _solve(conic, self.method)
        certified_gap = None
        if self.certify:
            other = _solve(conic, "certified" if self.method == "barrier" else "barrier")
            size = max(abs(solution.objective), np.finfo(float).tiny)
            certified_gap = abs(other.objective - solution.objective) / size
        phi = problem.nominal.copy()
        phi[problem.free] += problem.scale[problem.free] * solution.x
        scaled = (phi / problem.scale).reshape(-1, PER_BODY)
        eigenvalues = np.asarray(np.linalg.eigvalsh(parameters.pseudo_inertia(scaled))[:, 0], dtype=np.float64)
        eigenvalues[~scaled[:, parameters.INERTIAL].any(axis=1)] = np.nan
        deviation = (plain.phi - problem.nominal) / problem.scale
        unconstrained = plain.cost / max(problem.rows, 1) + self.ridge * float(deviation @ deviation)
        return ConsistentEstimate(
            phi=phi,
            standard_error=plain.standard_error,
            identifiable=plain.identifiable,
            rank=plain.rank,
            condition_number=plain.condition_number,
            cost=problem.cost(phi),
            nominal_cost=plain.nominal_cost,
            rows=problem.rows,
            objective=solution.objective,
            unconstrained=unconstrained if self.prior == "euclidean" else None,
            gap=solution.gap,
            certified_gap=certified_gap,
            eigenvalues=eigenvalues,
            steps=solution.steps,
        )


def project(phi: Array, scale: Array, conditions: Conditions, method: Method = "barrier") -> Array:
    """The parameters nearest to `phi`, (L, 12), that meet the conditions, in the scaled Euclidean metric.

    Source: Mistry, Schaal, Yamane 2009, III-B.

    Raises:
        InputError: the conditions exclude each other.
    """
    flat = phi.flatten()
    free = phi != 0.0  # friction that there is
    free[:, parameters.INERTIAL] = phi[:, parameters.INERTIAL].any(axis=1, keepdims=True)
    free = free.flatten()
    nothing = np.zeros((0, len(flat)))
    problem = LinearProblem(nothing, np.zeros(0), 0.0, 1, flat, scale.flatten(), free)
    solution = _solve(conic_problem(problem, conditions, 1.0, "euclidean"), method)
    flat[free] += scale.flatten()[free] * solution.x
    return flat.reshape(phi.shape)


def _solve(conic: ConicProblem, method: Method) -> Solution:
    if not len(conic.c):
        return Solution(np.zeros(0), conic.constant, 0.0, 0)
    if method == "barrier":
        return solve_barrier(conic)
    from torchid.estimators.certified import solve_certified  # CVXPY takes a second to import

    return solve_certified(conic)
