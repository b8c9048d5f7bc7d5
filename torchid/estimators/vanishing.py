"""Consistent estimates without a ridge: the limit of a vanishing one, so that what data leave open stays nominal."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from torchid.errors import InputError, NumericalWarning, warn
from torchid.estimators.barrier import interior, solve_barrier
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic import REACH, ConicProblem, Solution
from torchid.estimators.formulate import Prior, conic_problem
from torchid.estimators.least_squares import residual_std
from torchid.parameters import Array
from torchid.problem import LinearProblem
from torchid.problem.chunks import one_thread

_RIDGES = 10.0 ** -np.arange(0.0, 15.0, 2.0)  # of the least misfit without conditions, or of what is as good as none
_SETTLED = (
    1e-5  # change of the misfit, relative, to a hundredth of the ridge; what is left is a hundredth of it or less
)
_STAYS = 0.01  # and of the prior: where parameters grow without bound it is a factor of two and more
_BOUNDED = 1.25  # growth up to which a path that rounding ends has come near its limit
_EXACT = 1e-7  # excess of a misfit that counts as none, relative
_NEAR = 1e-3  # excess over the least misfit without conditions, relative, at which these may cost nothing at all
_INSIDE = 1e-6  # least slack of a point that shows that what the data determine leaves the conditions room
_SEARCH = 60  # Newton steps for such a point: one that exists is found in 10 to 40
_CLOSE = 0.1  # of the excess: how closely it is met
_TRIES = 12
_RESOLVED = 1e-7  # of the prior
_FAR = 10.0  # times the reach of the data: where no limit is looked for any more
_BELIEVED = 10.0  # scales: a limit further away follows the noise


@dataclass(frozen=True)
class Vanishing:
    """The problem that stands for a ridge that vanishes.

    Attributes:
        conic: its minimizer is the estimate.
        misfit: that of the estimate where equalities hold what the data determine; None where `conic` has a ridge.
        tolerance: relative gap at which a small ridge's part of the objective is resolved.
    """

    conic: ConicProblem
    misfit: float | None = None
    tolerance: float = 1e-9

    def judged(self, solution: Solution, data: ConicProblem) -> Solution:
        """A minimizer of `conic` as one of the misfit: none of up to twice its prior is better by more than the gap."""
        objective = data.objective(solution.x)
        gap = objective - self.misfit if self.misfit is not None else solution.gap + solution.objective - objective
        return replace(solution, objective=objective, gap=max(gap, 0.0))


@one_thread()
def vanishing_ridge(problem: LinearProblem, conditions: Conditions, prior: Prior, rank_tolerance: float) -> Vanishing:
    """The well-posed problem whose minimizer is the limit for ridge -> 0: the least prior among all of least misfit.

    Where conditions leave room at the misfit of least squares, what the data determine is held by equalities, and the
    prior alone is minimized. Else the ridge is so small that a hundredth of it changes nothing.

    A limit need not exist: nothing bounds a body's inertia from above, and at an active condition the misfit can go on
    falling, ever more slowly, while parameters that the data do not determine grow without bound, or until one is tens
    or hundreds of its scales away. Then the least prior is taken among all whose misfit is at most what the true
    parameters' is expected to be.

    Args:
        problem: the data.
        conditions: on the parameters.
        prior: what pulls to the nominal parameters.
        rank_tolerance: as in `LeastSquares`: what the data determine.

    Raises:
        InputError: the conditions exclude each other, or a prior of matter starts from bodies that cannot exist.

    Warns:
        NumericalWarning: there is no limit, or none to believe.
    """
    path = _Path(problem, conditions, prior)
    interior(path.data)  # names what is excluded
    held = _Held.of(path, rank_tolerance)
    if (found := held.through(np.zeros(len(path.data.linear)))) is not None:
        return found
    unit, steps, searched = max(held.misfit, path.data.floor), list[_Step](), False
    for share in _RIDGES:
        ridge = float(share * unit / max(1.0, steps[0].prior if steps else 1.0))
        step = path.towards(ridge, steps[-1].ridge) if steps else path.at(ridge)
        if step is None:
            break
        steps.append(step)
        found = held.through(step.x)
        if found is None and not searched and step.misfit - held.misfit <= _NEAR * unit:
            found, searched = held.searched(step.x), True
        if found is not None:
            return found
        blocked = step.ridge > ridge and _change(steps) <= _NEAR * max(step.misfit, path.data.floor)
        if blocked or path.away(step) > _FAR * REACH:
            break
        if len(steps) > 1 and _change(steps) <= _SETTLED * max(step.misfit, path.data.floor) and _stays(steps, _STAYS):
            break
    if not steps:
        raise np.linalg.LinAlgError("no ridge gives a minimizer")
    as_near_as_rounding_allows = len(steps) == 1 or path.away(steps[-1]) <= _BOUNDED * path.away(steps[-2])
    if as_near_as_rounding_allows and path.furthest(steps[-1]) <= _BELIEVED:
        return steps[-1].vanishing
    return path.near_the_least(steps, held.rank)


@dataclass(frozen=True)
class _Step:
    """The minimizer x, (n,), with some ridge: its convex problem, its misfit and its prior."""

    ridge: float
    conic: ConicProblem
    x: Array
    misfit: float
    prior: float

    @property
    def vanishing(self) -> Vanishing:
        share = self.ridge * self.prior / max(self.misfit, self.conic.floor)
        return Vanishing(self.conic, tolerance=float(np.clip(_RESOLVED * share, 1e-15, 1e-9)))


class _Path:
    """Minimizers of one problem by their ridge."""

    def __init__(self, problem: LinearProblem, conditions: Conditions, prior: Prior) -> None:
        self.problem, self.conditions, self.prior = problem, conditions, prior
        self.data = conic_problem(problem, conditions, 0.0, prior)

    def at(self, ridge: float) -> _Step | None:
        """The minimizer with a ridge, None where rounding hides it."""
        conic = conic_problem(self.problem, self.conditions, ridge, self.prior)
        with warnings.catch_warnings():
            warnings.simplefilter("error", NumericalWarning)
            try:
                x = solve_barrier(conic).x
            except (NumericalWarning, np.linalg.LinAlgError):
                return None
        misfit = self.data.objective(x)
        return _Step(ridge, conic, x, misfit, (conic.objective(x) - misfit) / ridge)

    def towards(self, ridge: float, before: float) -> _Step | None:
        """The minimizer with the ridge that is nearest to `ridge`, coming from `before`, which rounding leaves."""
        while ridge <= 0.5 * before:
            if (step := self.at(ridge)) is not None:
                return step
            ridge = float(np.sqrt(ridge * before))
        return None

    def away(self, step: _Step) -> float:
        """Distance from the nominal parameters, in units of their scale."""
        return float(np.linalg.norm(self.data.deviations @ step.x))

    def furthest(self, step: _Step) -> float:
        """Largest distance of a parameter from its nominal value, in units of its scale."""
        return float(np.abs(self.data.deviations @ step.x).max())

    def prior_alone(self) -> ConicProblem:
        """The same conditions without data."""
        nothing = np.zeros((0, len(self.problem.nominal)))
        problem = replace(self.problem, A=nothing, b=np.zeros(0), residual=0.0, rows=1)
        return conic_problem(problem, self.conditions, 1.0, self.prior)

    def near_the_least(self, steps: list[_Step], rank: int) -> Vanishing:
        """The least prior at the misfit expected of the true parameters (Morozov's discrepancy principle).

        That is the least, at the end of `steps`, and the noise's variance for each combination that the data determine;
        the stated noise's where no more rows than those are left to show it.
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
            "estimator: with ridge 0 the misfit goes on falling while parameters that the data do not determine grow "
        )
        message += f"beyond belief ({self.furthest(steps[-1]):.0f} scales); taken is the least prior at the misfit "
        message += f"expected of the true parameters, as with ridge {below.ridge:.1g}; accepted: a ridge"
        warn(message, NumericalWarning)
        return below.vanishing


@dataclass(frozen=True)
class _Held:
    """The prior alone, with the `rank` combinations that the `data` determine held at the least misfit."""

    conic: ConicProblem
    data: ConicProblem
    misfit: float
    rank: int

    @classmethod
    def of(cls, path: _Path, rank_tolerance: float) -> _Held:
        plain = conic_problem(path.problem, path.conditions, 0.0, "euclidean")  # whose x is in units of the scale
        start = plain.E.T @ plain.e
        U, values, right = np.linalg.svd(plain.root @ plain.moves, full_matrices=False)
        tolerance = max(rank_tolerance, np.finfo(float).eps * max(plain.root.shape, default=1))
        rank = int((values > tolerance * values.max(initial=0.0)).sum())
        basis = plain.moves @ right[:rank].T
        step = basis @ (U[:, :rank].T @ (plain.target - plain.root @ start) / values[:rank])
        misfit = plain.objective(start + step)
        alone = path.prior_alone()
        rows = basis.T @ alone.deviations
        size = np.linalg.norm(rows, axis=1)
        orthonormal, triangle = np.linalg.qr(np.vstack([alone.E, rows / size[:, None]]).T)
        e = np.linalg.solve(triangle.T, np.append(alone.e, basis.T @ (start + step) / size))
        return cls(replace(alone, E=orthonormal.T, e=e), path.data, misfit, rank)

    def through(self, x: Array) -> Vanishing | None:
        """What is held, if the nearest point to x, (n,), that meets the equalities is inside the conditions."""
        nearest = self.nearest(x)
        exact = self.data.objective(nearest) - self.misfit <= _EXACT * max(self.misfit, self.data.floor)
        if not exact or self.conic.slack(nearest).min(initial=np.inf) <= _INSIDE:
            return None
        return Vanishing(replace(self.conic, start=nearest), self.misfit)

    def nearest(self, x: Array) -> Array:
        """The point next to x, (n,), with what is held."""
        return np.asarray(x - self.conic.E.T @ (self.conic.E @ x - self.conic.e))

    def searched(self, x: Array) -> Vanishing | None:
        """What is held, if from x, (n,), a point inside the conditions is soon found."""
        try:
            return self.through(interior(replace(self.conic, start=self.nearest(x)), _SEARCH)[0])
        except (InputError, np.linalg.LinAlgError):
            return None


def _change(steps: list[_Step]) -> float:
    """Of the misfit in the last step."""
    return steps[-2].misfit - steps[-1].misfit


def _stays(steps: list[_Step], share: float) -> bool:
    """Whether the last step left the prior where it was."""
    return abs(steps[-1].prior - steps[-2].prior) <= share * steps[-1].prior
