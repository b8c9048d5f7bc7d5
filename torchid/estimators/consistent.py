"""Physically consistent parameters: the estimator, and the consistent parameters nearest to any given ones."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from torchid import parameters
from torchid.estimators.conditions import Conditions, validate_parameters, violations
from torchid.estimators.conic import ConicProblem, Prior, Solution, build_conic_problem, solve_barrier
from torchid.estimators.least_squares import ConstrainedEstimate, Minimizer, Regularized, report_rounding
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.problem.linear import AT_BOUND
from torchid.reprs import short_repr
from torchid.rounding import relative_tolerance


@dataclass(frozen=True, repr=False)
class ConsistentEstimate(ConstrainedEstimate):
    """An estimate that meets its conditions; with the entropic prior, `unconstrained` is None.

    Attributes:
        gap: to the dual objective; no parameters that meet the conditions have an objective lower by more.
        steps: Newton steps.
        active: names of the conditions that hold with equality, to within `AT_BOUND` of their scale.
    """

    gap: float
    steps: int
    active: tuple[str, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class Consistent(Regularized):
    """min ||A phi - b||^2 / rows + ridge * prior(phi) over all physically consistent phi.

    `ridge` 0 is the least that is one numerically, 1e-14 of the largest eigenvalue of A^T A / rows in units of the
    scale: parameters that the data do not determine stay nominal.

    Parameters that are not free stay nominal, whether or not they meet the conditions (see `violations`); so do those
    that neither rows nor conditions couple to others. The conditions are met strictly.

    Attributes:
        prior: "euclidean", ||(phi - nominal) / scale||^2; "pullback", sum of ||J_0^-1/2 (J - J_0) J_0^-1/2||^2 over
            the bodies' pseudo-inertias J (Lee, Wensing, Park 2020); "entropic", sum of the log-det divergences
            -log det(J_0^-1 J) + tr(J_0^-1 J) - 4 (Lee, Park 2018). The prior of friction is the first in any case.
        conditions: on the parameters.
    """

    prior: Prior = "euclidean"
    conditions: Conditions = field(default_factory=Conditions)

    __repr__ = short_repr

    @report_rounding("consistent")
    @one_thread()
    def solve(self, problem: LinearProblem) -> ConsistentEstimate:
        """Fit the free parameters.

        Standard errors and ranks are those of least squares with the same ridge: conditions only narrow them.

        Raises:
            InputError: the conditions exclude each other, or a prior other than the Euclidean one has nominal bodies
                that are not physically consistent.
            ValueError: columns that are not twelve for each body.
        """
        problem.require_bodies()
        plain = self.least_squares.solve(problem)
        minimum = self._minimum(problem)
        phi, psi = minimum.minimizer
        return ConsistentEstimate(
            **(vars(plain) | {"phi": phi, "psi": psi, "cost": problem.cost(phi, psi)}),
            objective=minimum.solution.objective,
            unconstrained=minimum.conic.unconstrained,
            distance=problem.prediction_distance(phi, plain.phi),
            eigenvalues=parameters.least_eigenvalues(phi, problem.scale),
            gap=minimum.solution.gap,
            steps=minimum.solution.steps,
            active=minimum.conic.active(minimum.solution.x, AT_BOUND),
        )

    @report_rounding("consistent")
    @one_thread()
    def minimize(self, problem: LinearProblem) -> Minimizer:
        """The parameters of `solve` alone, in four fifths of the time. Raises as `solve`."""
        return self._minimum(problem).minimizer

    def _minimum(self, problem: LinearProblem) -> _Minimum:
        coupled = _with_decoupled_fixed(problem, self.conditions)
        conic = build_conic_problem(coupled, self.conditions, self.ridge or _least_ridge(coupled), self.prior)
        solution = _solve(conic, 1e-9 if self.ridge else 1e-12)
        phi = problem.nominal.copy()
        psi = None
        moved, terms = np.split(conic.deviations @ solution.x, [int(coupled.free.sum())])
        phi[coupled.free] += problem.scale[coupled.free] * moved
        if problem.terms is not None:
            psi = problem.terms.size * terms
        return _Minimum(Minimizer(phi, psi), conic, solution)


@dataclass(frozen=True)
class _Minimum:
    """A minimizer, and the conic problem with its solution that it is from."""

    minimizer: Minimizer
    conic: ConicProblem
    solution: Solution


def _least_ridge(problem: LinearProblem) -> float:
    """The ridge for 0, fifty roundings of the largest eigenvalue; all but 3 of 360 random fits resolve it."""
    A = problem.A[:, problem.free] * problem.scale[problem.free]
    largest = float(np.linalg.norm(A, 2)) if A.size else 0.0
    return 1e-14 * largest**2 / max(problem.rows, 1) or 1.0


@report_rounding("projection")
def nearest_consistent(
    phi: Array,
    scale: Array,
    conditions: Conditions,
    *,
    prior: Prior = "euclidean",
    nominal: Array | None = None,
) -> Array:
    """The physically consistent parameters nearest to given ones (Mistry, Schaal, Yamane 2009, III-B).

    Bodies without mass stay massless; friction of zero stays zero unless a bound or a mirror image requires more.

    Args:
        phi: (L, 12), physically consistent or not.
        scale: (L, 12), as in `parameter_scale`.
        conditions: to meet.
        prior: the distance, as in `Consistent` with `phi` for the nominal parameters. "entropic" is defined only for a
            `phi` whose bodies are physically consistent.
        nominal: (L, 12), whose pseudo-inertias J_0 measure deviations for "pullback"; None for those of `phi`.

    Raises:
        InputError: the conditions exclude each other, or pseudo-inertias J_0 are not positive definite.
        ValueError: shapes, or numbers that are not finite.
    """
    Consistent(1.0, prior, conditions)  # checks the names
    if nominal is not None and prior != "pullback":
        raise ValueError(f"nominal: found parameters for the {prior} prior; accepted: None, or prior 'pullback'")
    validate_parameters(phi=phi, scale=scale, nominal=phi if nominal is None else nominal)
    free = _changeable(phi, conditions)
    nothing = np.zeros((0, phi.size))
    problem = LinearProblem(nothing, np.zeros(0), 0.0, 1, phi.flatten(), scale.flatten(), free.flatten())
    reference = None if nominal is None else nominal.flatten()
    conic = build_conic_problem(problem, conditions, 1.0, prior, reference)
    solution = _solve(conic, 1e-12)  # parameters are as near as the root of the gap
    out = phi.copy()
    out[free] += scale[free] * (conic.deviations @ solution.x)
    return out


def _changeable(phi: Array, conditions: Conditions) -> np.ndarray:
    """Parameters that may change, (L, 12) bool."""
    conditions.validate_bodies(len(phi))
    lower, _ = conditions.bounds(len(phi))
    free = (phi != 0.0) | (lower > 0.0)
    for mirror in conditions.mirrors:
        pair = [mirror.body, mirror.image]
        free[pair] = free[pair].any(axis=0)
    free[:, parameters.INERTIAL] = phi[:, parameters.INERTIAL].any(axis=1, keepdims=True)
    return np.asarray(free)


def _solve(conic: ConicProblem, tolerance: float) -> Solution:
    if not len(conic.linear):
        return Solution(np.zeros(0), conic.constant, 0.0, 0)
    return solve_barrier(conic, tolerance)


# ------------------------------------------------------------------------------------------------- what nothing couples


def _with_decoupled_fixed(problem: LinearProblem, conditions: Conditions) -> LinearProblem:
    """The problem with unobservable bodies and friction fixed whose nominal values are allowed.

    A solver ends within a tolerance of the least objective, which parameters that only a small ridge holds hardly
    change: a KUKA's fixed base drifts by 8e-3 of its scale with a ridge of 1e-7. It also keeps away from conditions
    that nothing pushes them to.

    Args:
        problem: its parameters are those of bodies.
        conditions: on the parameters. Bodies that one ties to others (the total mass, mirror images) stay as they are.
    """
    unobservable = (problem.free & ~_observable(problem)).reshape(-1, PER_BODY)
    if not unobservable.any():
        return problem
    nominal, scale = (x.reshape(-1, PER_BODY) for x in (problem.nominal, problem.scale))
    apart = replace(conditions, total_mass=None, mirrors=())
    for violation in violations(nominal, scale, apart, tolerance=0.0):
        if violation.body is not None:
            unobservable[violation.body] = False
    for mirror in conditions.mirrors:
        unobservable[[mirror.body, mirror.image]] = False
    inertial = unobservable[:, parameters.INERTIAL]
    inertial[:] = inertial.all(axis=1, keepdims=True) & (conditions.total_mass is None)
    return replace(problem, free=problem.free & ~unobservable.ravel()) if unobservable.any() else problem


def _observable(problem: LinearProblem) -> np.ndarray:
    """Parameters that rows, or terms that conditions bound, depend on, (P,) bool."""
    size = np.linalg.norm(problem.A, axis=0) * problem.scale
    seen = size > relative_tolerance(0.0, problem.A.shape) * size.max(initial=0.0)
    if problem.terms is not None:
        seen |= problem.terms.C.any(axis=0)
        for condition in problem.terms.conditions:
            seen |= condition.parameters != 0.0
    return np.asarray(seen)
