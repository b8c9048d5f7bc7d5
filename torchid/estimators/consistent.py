"""The estimator of physically consistent parameters, and the consistent parameters nearest to given ones."""

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
    """An estimate that meets its conditions; `unconstrained` is None with the entropic prior.

    Attributes:
        gap: duality gap: no feasible parameters have an objective that is lower by more.
        steps: Newton steps.
        active: names of the conditions that hold with equality, within `AT_BOUND` of their scale.
    """

    gap: float
    steps: int
    active: tuple[str, ...] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class Consistent(Regularized):
    """Physically consistent parameters: min ||A phi - b||^2 / rows + ridge * prior(phi) over all consistent phi.

    A `ridge` of 0 means the smallest ridge that matters numerically, 1e-14 of the largest eigenvalue of A^T A / rows in
    scaled units. Parameters that the data do not determine then stay nominal. Parameters that are not free, or that
    neither rows nor conditions couple to others, also stay nominal, even if they violate conditions (see `violations`).
    All other conditions hold strictly.

    Attributes:
        prior: "euclidean": ||(phi - nominal) / scale||^2. "pullback": sum of ||J_0^-1/2 (J - J_0) J_0^-1/2||^2 over the
            bodies' pseudo-inertias J (Lee, Wensing, Park 2020). "entropic": sum of the log-det divergences -log
            det(J_0^-1 J) + tr(J_0^-1 J) - 4 (Lee, Park 2018). Friction always has the euclidean prior.
        conditions: on the parameters.
    """

    prior: Prior = "euclidean"
    conditions: Conditions = field(default_factory=Conditions)

    __repr__ = short_repr

    @report_rounding("consistent")
    @one_thread()
    def solve(self, problem: LinearProblem) -> ConsistentEstimate:
        """Fit the free parameters.

        Standard errors and ranks are those of least squares with the same ridge; conditions only reduce them.

        Raises:
            InputError: the conditions contradict each other, or the prior is not euclidean and a nominal body is not
                physically consistent.
            ValueError: the number of columns is not a multiple of 12.
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
        """As `solve`, without statistics; takes four fifths of the time."""
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
    """A minimizer, with its conic problem and solution."""

    minimizer: Minimizer
    conic: ConicProblem
    solution: Solution


def _least_ridge(problem: LinearProblem) -> float:
    """The ridge used for 0: fifty rounding units of the largest eigenvalue; all but 3 of 360 random fits resolve it."""
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
    """Find the physically consistent parameters nearest to given ones (Mistry, Schaal, Yamane 2009, III-B).

    Bodies without mass stay massless. Friction of zero stays zero unless a bound or a mirror image requires more.

    Args:
        phi: (L, 12), physically consistent or not.
        scale: (L, 12), as in `parameter_scale`.
        conditions: to meet.
        prior: distance, as in `Consistent` with `phi` as nominal parameters. "entropic" needs physically consistent
            `phi`.
        nominal: (L, 12), reference pseudo-inertias J_0 for "pullback"; None for those of `phi`.

    Raises:
        InputError: the conditions contradict each other, or pseudo-inertias J_0 are not positive definite.
        ValueError: a shape is wrong, or a number is not finite.
    """
    Consistent(1.0, prior, conditions)  # checks the names
    if nominal is not None and prior != "pullback":
        raise ValueError(f"nominal: set, but the prior is '{prior}'; accepted: None, or prior='pullback'")
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
    """Fix the unobservable bodies and friction whose nominal values meet the conditions.

    A solver ends within a tolerance of the least objective. Parameters that only a small ridge holds hardly change the
    objective: a KUKA's fixed base drifts by 8e-3 of its scale with a ridge of 1e-7.

    Args:
        problem: with the parameters of bodies.
        conditions: on the parameters. Bodies that a condition couples to others (total mass, mirror images) are not
            fixed.
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
    """Parameters that rows, or terms with conditions, depend on, (P,) bool."""
    size = np.linalg.norm(problem.A, axis=0) * problem.scale
    seen = size > relative_tolerance(0.0, problem.A.shape) * size.max(initial=0.0)
    if problem.terms is not None:
        seen |= problem.terms.C.any(axis=0)
        for condition in problem.terms.conditions:
            seen |= condition.parameters != 0.0
    return np.asarray(seen)
