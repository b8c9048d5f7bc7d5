"""Parameters that a physical robot can have: the convex problem, and its two solvers."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Literal, get_args

import numpy as np

from torchid import parameters
from torchid.errors import InputError, how_to_install
from torchid.estimators.barrier import solve_barrier
from torchid.estimators.conditions import Conditions, check_parameters
from torchid.estimators.conic import ConicProblem, Solution
from torchid.estimators.formulate import Prior, conic_problem
from torchid.estimators.least_squares import BoundEstimate, Regularized, rounding_reported
from torchid.estimators.vanishing import Vanishing, vanishing_ridge
from torchid.parameters import Array
from torchid.problem import LinearProblem

Method = Literal["barrier", "certified"]


@dataclass(frozen=True)
class ConsistentEstimate(BoundEstimate):
    """An estimate that meets its conditions; the entropic prior, which has no other domain, has no unconstrained one.

    Attributes:
        gap: to the dual objective; no parameters that meet the conditions have an objective lower by more (with ridge
            0, none whose prior is at most twice the estimate's).
        certified_gap: difference from the other solver's objective, None unless asked for. Relative to the objective;
            where data without noise leave next to none, relative to 1e-8 of the mean square of the data or 1e-3 of the
            ridge, whichever is larger.
        steps: Newton steps, or iterations of the conic solver.
    """

    gap: float
    certified_gap: float | None
    steps: int


@dataclass(frozen=True)
class Consistent(Regularized):
    """min ||A phi - b||^2 / rows + ridge * prior(phi) over all phi that a physical robot can have.

    With `ridge` 0 the limit for ridge -> 0, the least prior among all minimizers: what data do not determine stays
    nominal. Where conditions are active there may be none, see `vanishing_ridge`.

    What is not free stays nominal, whether or not it meets the conditions: `violations` tells. "barrier" stays inside
    them; "certified" meets them to the accuracy of its solver, mostly 1e-9 of the scale, and warns beyond 1e-7.

    Attributes:
        prior: "euclidean", ||(phi - nominal) / scale||^2; "pullback", sum of ||J_0^-1/2 (J - J_0) J_0^-1/2||^2 over
            the bodies' pseudo-inertias J (Lee, Wensing, Park 2020); "entropic", sum of the log-det divergences
            -log det(J_0^-1 J) + tr(J_0^-1 J) - 4 (Lee, Park 2018). Friction is pulled by the first in any case.
        conditions: on the parameters.
        method: "barrier", the fast path, or "certified", a semidefinite programme.
        certify: solve with the other method as well, and report the difference.
    """

    prior: Prior = "euclidean"
    conditions: Conditions = field(default_factory=Conditions)
    method: Method = "barrier"
    certify: bool = False

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: names the first that is not accepted.
            InputError: the certified method without CVXPY and Clarabel.
        """
        super().__post_init__()
        if (self.certify or self.method == "certified") and not (find_spec("cvxpy") and find_spec("clarabel")):
            found = "needs CVXPY and Clarabel, which are not installed"
            raise InputError("estimator", "certified", found, f"{how_to_install('certified')}, or barrier alone")

    @rounding_reported("consistent")
    def solve(self, problem: LinearProblem) -> ConsistentEstimate:
        """Fit the free parameters.

        Standard errors and ranks are those of least squares with the same ridge: conditions only narrow them.

        Raises:
            InputError: the conditions exclude each other, or a prior of matter starts from bodies that cannot exist.
        """
        plain = self.least_squares.solve(problem)
        data = conic_problem(problem, self.conditions, self.ridge, self.prior)
        chosen = Vanishing(data)
        if self.ridge == 0.0 and len(data.linear):
            chosen = vanishing_ridge(problem, self.conditions, self.prior, self.rank_tolerance)
        conic = chosen.conic
        solution = _solve(conic, self.method, chosen.tolerance)
        certified_gap = None
        if self.certify:
            other = _solve(conic, "certified" if self.method == "barrier" else "barrier", chosen.tolerance)
            compared = max(solution.objective, conic.floor)
            certified_gap = abs(other.objective - solution.objective) / compared
        if conic is not data:
            solution = chosen.judged(solution, data)
        phi = problem.nominal.copy()
        phi[problem.free] += problem.scale[problem.free] * (data.deviations @ solution.x)
        return ConsistentEstimate(
            **(vars(plain) | {"phi": phi, "cost": problem.cost(phi)}),
            objective=solution.objective,
            unconstrained=data.unconstrained,
            distance=problem.prediction_distance(phi, plain.phi),
            eigenvalues=parameters.least_eigenvalues(phi, problem.scale),
            gap=solution.gap,
            certified_gap=certified_gap,
            steps=solution.steps,
        )


@rounding_reported("projection")
def project(
    phi: Array,
    scale: Array,
    conditions: Conditions,
    *,
    prior: Prior = "euclidean",
    nominal: Array | None = None,
    method: Method = "barrier",
) -> Array:
    """The parameters nearest to `phi` that meet the conditions (Mistry, Schaal, Yamane 2009, III-B).

    Bodies without mass stay so; friction of zero stays zero unless a bound or a mirror image says otherwise.

    Args:
        phi: (L, 12), whether a robot can have them or not.
        scale: (L, 12), as in `parameter_scale`.
        conditions: to meet.
        prior: what nearest means, as in `Consistent` with `phi` for the nominal parameters. "entropic" is defined only
            from a `phi` whose bodies can exist.
        nominal: (L, 12), whose pseudo-inertias J_0 measure deviations for "pullback"; None for those of `phi`.
        method: as in `Consistent`.

    Raises:
        InputError: the conditions exclude each other, or pseudo-inertias that a prior of matter starts from are not
            positive definite.
    """
    _check_names(prior, method)
    if nominal is not None and prior != "pullback":
        raise ValueError(f"nominal: found parameters for the {prior} prior; accepted: None, or prior 'pullback'")
    check_parameters(phi=phi, scale=scale, nominal=phi if nominal is None else nominal)
    free = _changeable(phi, conditions)
    nothing = np.zeros((0, phi.size))
    problem = LinearProblem(nothing, np.zeros(0), 0.0, 1, phi.flatten(), scale.flatten(), free.flatten())
    reference = None if nominal is None else nominal.flatten()
    conic = conic_problem(problem, conditions, 1.0, prior, reference)
    solution = _solve(conic, method)
    out = phi.copy()
    out[free] += scale[free] * (conic.deviations @ solution.x)
    return out


def _changeable(phi: Array, conditions: Conditions) -> np.ndarray:
    """What a projection may change, (L, 12) bool."""
    conditions.check_bodies(len(phi))
    lower, _ = conditions.bounds(len(phi))
    free = (phi != 0.0) | (lower > 0.0)
    for mirror in conditions.mirrors:
        pair = [mirror.body, mirror.image]
        free[pair] = free[pair].any(axis=0)
    free[:, parameters.INERTIAL] = phi[:, parameters.INERTIAL].any(axis=1, keepdims=True)
    return np.asarray(free)


def _check_names(prior: str, method: str) -> None:
    for name, value, accepted in (("prior", prior, get_args(Prior)), ("method", method, get_args(Method))):
        if value not in accepted:
            raise ValueError(f"{name}: found {value!r}; accepted: {', '.join(accepted)}")


def _solve(conic: ConicProblem, method: Method, tolerance: float = 1e-9) -> Solution:
    if not len(conic.linear):
        return Solution(np.zeros(0), conic.constant, 0.0, 0)
    if method == "barrier":
        return solve_barrier(conic, tolerance)
    from torchid.estimators.certified import solve_certified

    return solve_certified(conic)
