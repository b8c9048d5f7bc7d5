"""The limit of consistent estimates for ridge -> 0: parameters that the data do not determine stay nominal."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from torchid.errors import InputError, NumericalWarning, warn
from torchid.estimators.barrier import find_strictly_feasible, solve_barrier
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic_formulation import Prior, build_conic_problem
from torchid.estimators.conic_problem import SEARCH_RADIUS, ConicProblem, Solution
from torchid.estimators.least_squares import residual_std
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import LinearProblem

_RIDGES = 10.0 ** -np.arange(0.0, 15.0, 2.0)  # relative to the least misfit without conditions, or to the floor
_SETTLED = 1e-5  # relative change of the misfit, with a hundredth of the ridge, at which the path has converged
_STEADY = 0.01  # relative change of the prior at convergence; where parameters grow without bound it doubles or more
_BOUNDED = 1.25  # growth of the deviation up to which a path that rounding ends is taken as converged
_EXACT = 1e-7  # relative excess of a misfit that counts as 0
_NEAR = 1e-3  # relative excess over the least misfit without conditions below which a feasible point is searched
_SLACK = 1e-6  # least slack of that point
_SEARCH = 60  # Newton steps for that point: if it exists, 10 to 40 find it
_CLOSE = 0.1  # tolerance of the discrepancy principle, relative to the excess
_TRIES = 12  # ridges for the discrepancy principle
_RESOLVED = 1e-7  # relative accuracy of the prior
_FAR = 10.0  # distance from nominal, in `SEARCH_RADIUS`, at which the path ends
_PLAUSIBLE = 10.0  # largest deviation, in scales, of a plausible limit: beyond, it fits the noise


@dataclass(frozen=True)
class RidgeLimit:
    """The well-posed problem whose minimizer is the limit for ridge -> 0.

    Attributes:
        conic: the problem.
        misfit: of the limit, if equalities fix what the data determine; None if `conic` has a small ridge instead.
        tolerance: relative gap that resolves the small ridge's part of the objective.
    """

    conic: ConicProblem
    misfit: float | None = None
    tolerance: float = 1e-9

    def without_ridge(self, solution: Solution, data: ConicProblem) -> Solution:
        """A minimizer of `conic` with objective and gap of the misfit alone.

        No feasible point of up to twice its prior has a misfit lower by more than the gap.
        """
        objective = data.objective(solution.x)
        gap = objective - self.misfit if self.misfit is not None else solution.gap + solution.objective - objective
        return replace(solution, objective=objective, gap=max(gap, 0.0))


@one_thread()
def ridge_limit(problem: LinearProblem, conditions: Conditions, prior: Prior, rank_tolerance: float) -> RidgeLimit:
    """The well-posed problem whose minimizer is the limit for ridge -> 0: the least prior among all of least misfit.

    If the conditions are strictly feasible at the misfit of least squares, equalities fix what the data determine, and
    the prior alone is minimized. Else the ridge is so small that a hundredth of it changes nothing.

    A limit need not exist: nothing bounds a body's inertia from above, and at an active condition the misfit can keep
    decreasing while parameters that the data do not determine grow without bound, or to hundreds of their scales. Then
    the result is the least prior at the misfit expected of the true parameters (Morozov's discrepancy principle).

    Args:
        problem: the data.
        conditions: on the parameters.
        prior: the distance from the nominal parameters, as in `Consistent`.
        rank_tolerance: as in `LeastSquares`.

    Raises:
        InputError: the conditions exclude each other, or a prior other than the Euclidean one has nominal bodies that
            are not physically consistent.

    Warns:
        NumericalWarning: there is no limit, or none that is plausible.
    """
    path = _RegularizationPath(problem, conditions, prior)
    find_strictly_feasible(path.data)  # its error names the condition
    fixed = _EqualityProblem.of(path, rank_tolerance)
    if (limit := fixed.at_nearest(np.zeros(len(path.data.linear)))) is not None:
        return limit
    unit, steps, searched = max(fixed.misfit, path.data.floor), list[_Step](), False
    for share in _RIDGES:
        ridge = float(share * unit / max(1.0, steps[0].prior if steps else 1.0))
        step = path.towards(ridge, steps[-1].ridge) if steps else path.at(ridge)
        if step is None:
            break
        steps.append(step)
        limit = fixed.at_nearest(step.x)
        if limit is None and not searched and step.misfit - fixed.misfit <= _NEAR * unit:
            limit, searched = fixed.at_feasible(step.x), True
        if limit is not None:
            return limit
        if path.has_ended(steps, ridge):
            break
    if not steps:
        raise np.linalg.LinAlgError("no ridge gives a minimizer")
    converged = len(steps) == 1 or steps[-1].distance <= _BOUNDED * steps[-2].distance
    if converged and steps[-1].largest_deviation <= _PLAUSIBLE:
        return steps[-1].limit
    return path.by_discrepancy_principle(steps, fixed.rank)


@dataclass(frozen=True)
class _Step:
    """The minimizer x, (n,), with some ridge, its conic problem, its misfit and its prior.

    `distance`: norm of its deviation from the nominal parameters, in units of the scale; `largest_deviation`: of one.
    """

    ridge: float
    conic: ConicProblem
    x: Array
    misfit: float
    prior: float
    distance: float
    largest_deviation: float

    @property
    def limit(self) -> RidgeLimit:
        share = self.ridge * self.prior / max(self.misfit, self.conic.floor)
        return RidgeLimit(self.conic, tolerance=float(np.clip(_RESOLVED * share, 1e-15, 1e-9)))


class _RegularizationPath:
    """The minimizers of one problem as a function of the ridge."""

    def __init__(self, problem: LinearProblem, conditions: Conditions, prior: Prior) -> None:
        self.problem, self.conditions, self.prior = problem, conditions, prior
        self.data = build_conic_problem(problem, conditions, 0.0, prior)

    def at(self, ridge: float) -> _Step | None:
        """The minimizer with a ridge; None if it cannot be computed for rounding."""
        conic = build_conic_problem(self.problem, self.conditions, ridge, self.prior)
        with warnings.catch_warnings():
            warnings.simplefilter("error", NumericalWarning)
            try:
                x = solve_barrier(conic).x
            except (NumericalWarning, np.linalg.LinAlgError):
                return None
        misfit, deviation = self.data.objective(x), self.data.deviations @ x
        prior = (conic.objective(x) - misfit) / ridge
        return _Step(ridge, conic, x, misfit, prior, float(np.linalg.norm(deviation)), float(np.abs(deviation).max()))

    def towards(self, ridge: float, before: float) -> _Step | None:
        """The minimizer with `ridge` or, if it cannot be computed, the nearest one towards the ridge `before`."""
        while ridge <= 0.5 * before:
            if (step := self.at(ridge)) is not None:
                return step
            ridge = float(np.sqrt(ridge * before))
        return None

    def has_ended(self, steps: list[_Step], ridge: float) -> bool:
        """Whether the last step, towards `ridge`, is far from nominal, converged, or as close as rounding allows."""
        step = steps[-1]
        if len(steps) == 1 or step.distance > _FAR * SEARCH_RADIUS:
            return step.distance > _FAR * SEARCH_RADIUS
        decrease, size = steps[-2].misfit - step.misfit, max(step.misfit, self.data.floor)
        steady = abs(step.prior - steps[-2].prior) <= _STEADY * step.prior
        return (decrease <= _NEAR * size and step.ridge > ridge) or (decrease <= _SETTLED * size and steady)

    def by_discrepancy_principle(self, steps: list[_Step], rank: int) -> RidgeLimit:
        """The least prior at the misfit expected of the true parameters (Morozov's discrepancy principle).

        That is the least misfit, at the end of `steps`, plus the variance of the noise for each combination that the
        data determine; the variance of the stated noise if there are no more rows than combinations.
        """
        rows, least, oversampling = self.problem.rows, steps[-1].misfit, self.problem.oversampling
        noise = residual_std(least * rows, rows, rank, oversampling) if rows > rank else 1.0
        target = least + max(rank * oversampling * noise**2 / max(rows, 1), self.data.floor)
        below, above, step = steps[-1], None, steps[0]
        for step in reversed(steps):
            if step.misfit > target:
                above = step
                break
            below = step
        for _ in range(_TRIES):
            if abs(below.misfit - target) <= _CLOSE * (target - least):
                break
            ridge = 100.0 * below.ridge if above is None else float(np.sqrt(below.ridge * above.ridge))
            if (between := self.at(ridge)) is None:
                break
            below, above = (between, above) if between.misfit <= target else (below, between)
        message = (
            "estimator: with ridge 0 the misfit keeps decreasing while parameters that the data do not determine grow "
            f"to {steps[-1].largest_deviation:.0f} scales; the estimate is that of the discrepancy principle, with "
            f"ridge {below.ridge:.1g}; accepted: a ridge above 0"
        )
        warn(message, NumericalWarning)
        return below.limit


@dataclass(frozen=True)
class _EqualityProblem:
    """The prior alone, with equalities that fix the `rank` combinations that the data determine at the least misfit."""

    conic: ConicProblem
    data: ConicProblem
    misfit: float
    rank: int

    @classmethod
    def of(cls, path: _RegularizationPath, rank_tolerance: float) -> _EqualityProblem:
        plain = build_conic_problem(path.problem, path.conditions, 0.0, "euclidean")  # whose x is in units of the scale
        start = plain.E.T @ plain.e
        U, values, right = np.linalg.svd(plain.root @ plain.null_space, full_matrices=False)
        tolerance = max(rank_tolerance, np.finfo(float).eps * max(plain.root.shape, default=1))
        rank = int((values > tolerance * values.max(initial=0.0)).sum())
        basis = plain.null_space @ right[:rank].T
        step = basis @ (U[:, :rank].T @ (plain.target - plain.root @ start) / values[:rank])
        misfit = plain.objective(start + step)
        nothing = np.zeros((0, len(path.problem.nominal)))
        terms = None if path.problem.terms is None else path.problem.terms.without_rows()
        without_data = replace(
            path.problem, A=nothing, b=np.zeros(0), residual=0.0, rows=1, shrinkage=None, terms=terms
        )
        alone = build_conic_problem(without_data, path.conditions, 1.0, path.prior)
        rows = basis.T @ alone.deviations
        size = np.linalg.norm(rows, axis=1)
        orthonormal, triangle = np.linalg.qr(np.vstack([alone.E, rows / size[:, None]]).T)
        e = np.linalg.solve(triangle.T, np.append(alone.e, basis.T @ (start + step) / size))
        return cls(replace(alone, E=orthonormal.T, e=e), path.data, misfit, rank)

    def at_nearest(self, x: Array) -> RidgeLimit | None:
        """This problem, if the point nearest to x, (n,), that meets the equalities is strictly feasible."""
        nearest = self.nearest(x)
        exact = self.data.objective(nearest) - self.misfit <= _EXACT * max(self.misfit, self.data.floor)
        if not exact or self.conic.slack(nearest).min(initial=np.inf) <= _SLACK:
            return None
        return RidgeLimit(replace(self.conic, start=nearest), self.misfit)

    def nearest(self, x: Array) -> Array:
        """The point nearest to x, (n,), that meets the equalities."""
        return np.asarray(x - self.conic.E.T @ (self.conic.E @ x - self.conic.e))

    def at_feasible(self, x: Array) -> RidgeLimit | None:
        """This problem, if phase I from x, (n,), finds a strictly feasible point in a few steps."""
        try:
            return self.at_nearest(find_strictly_feasible(replace(self.conic, start=self.nearest(x)), _SEARCH)[0])
        except (InputError, np.linalg.LinAlgError):
            return None
