"""Posterior of a fit: a Gaussian within conditions; and the width of the prior estimated from the data."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
from scipy.special import chdtri

from torchid import parameters
from torchid.estimators.conditions import Conditions
from torchid.estimators.conic import ConicProblem, build_conic_problem
from torchid.parallel import one_thread
from torchid.parameters import FRICTION, INERTIAL, PER_BODY, Array
from torchid.problem import LinearProblem
from torchid.problem.elimination import eliminate_columns
from torchid.problem.linear import EliminatedTerms, SignCondition
from torchid.reprs import short_repr
from torchid.rounding import RANK_TOLERANCE, is_significant

PRIOR_ERROR = 0.2
"""Default standard deviation of the nominal parameters, relative to each body."""

_LEAST_NOISE = 1e-8  # of rows without noise, relative to the rms of the right-hand side
_THINNEST = 1e-4  # least eigenvalue of the scaled pseudo-inertias that the prior is relative to


@dataclass(frozen=True)
class Posterior:
    """Density exp(-||A phi + D psi - b||^2 / 2) times a prior, within conditions on phi and psi >= `extra_lower`.

    Attributes:
        A: (R, 12 L), of the parameters phi. Rows have unit noise variance.
        D: (R, S), of the extra parameters psi.
        b: (R,).
        nominal, scale: (12 L,), mean of the prior, and units of the parameters.
        free: (12 L,) bool; the other parameters stay nominal.
        conditions: on the parameters.
        extra_size: (S,), prior standard deviation of the extra parameters (mean 0).
        extra_lower: (S,), 0 for extra parameters that are never negative, else minus infinity.
    """

    A: Array
    D: Array
    b: Array
    nominal: Array
    scale: Array
    free: np.ndarray
    conditions: Conditions
    extra_size: Array
    extra_lower: Array

    __repr__ = short_repr

    @one_thread()
    def conic_problem(self, prior_error: float = PRIOR_ERROR) -> ConicProblem:
        """Conic problem with the density exp(-objective / 2) of the posterior.

        Its variables are those of the free parameters (see `build_conic_problem`), then the extra parameters in units
        of their size. The prior is the pull-back one (Lee, Wensing, Park 2020): the entries of J_0^-1/2 (J - J_0)
        J_0^-1/2 of each body's pseudo-inertia have the standard deviation `prior_error`. Friction has the same fraction
        of its scale, at least 1 N m and 1 N m s/rad.

        Raises:
            InputError: the conditions contradict each other.
        """
        count = len(self.nominal)
        extras = len(self.extra_size)
        never_negative = np.eye(extras)[np.isfinite(self.extra_lower)]
        terms = EliminatedTerms(  # the prior of the extra parameters is further rows
            C=np.concatenate([self.A, np.zeros((extras, count))]),
            D=np.concatenate([self.D, np.diag(1.0 / self.extra_size)]),
            z=np.append(self.b, np.zeros(extras)),
            size=self.extra_size,
            labels=("an extra parameter",) * extras,
            conditions=tuple(
                SignCondition("an extra parameter", unit, np.zeros(count), float(unit @ self.extra_size), "")
                for unit in never_negative
            ),
        )
        no_rows = np.zeros((0, count))
        problem = LinearProblem(no_rows, np.zeros(0), 0.0, 1, self.nominal, self.scale, self.free, terms=terms)
        conic = build_conic_problem(problem, self.conditions, prior_error**-2, "pullback", self._metric())
        size = len(conic.linear)
        triangle = np.asarray(np.linalg.qr(np.column_stack([conic.root, conic.target]), mode="r"))
        constant = conic.constant + float(np.square(triangle[size:, size]).sum())
        return replace(conic, root=triangle[:size, :size], target=triangle[:size, size], constant=constant)

    def owners(self) -> np.ndarray:
        """Body of each variable of the conic problem, (n,) int; each extra parameter has its own number."""
        of_extras = len(self.nominal) // PER_BODY + np.arange(len(self.extra_size))
        return np.concatenate([np.flatnonzero(self.free) // PER_BODY, of_extras])

    @property
    def _thinnest(self) -> float:
        """Smallest eigenvalue of scaled pseudo-inertias that the prior refers to."""
        return max(_THINNEST, 2.0 * self.conditions.margin)

    def thin_bodies(self) -> np.ndarray:
        """Whether bodies are rods, plates or points in the file, (L,): errors across them are large."""
        free = self.free.reshape(-1, PER_BODY)[:, parameters.INERTIAL].any(axis=1)
        return np.asarray(free & (parameters.least_eigenvalues(self.nominal, self.scale) < self._thinnest))

    def _metric(self) -> Array:
        """Parameters (12 L,) whose pseudo-inertias the prior refers to: the nominal ones, made positive definite.

        Physically inconsistent bodies, and bodies thinner than the conditions allow, have their smallest eigenvalues
        raised.
        """
        scaled = (self.nominal / self.scale).reshape(-1, PER_BODY)
        values, vectors = np.linalg.eigh(parameters.pseudo_inertia(scaled))
        thin = values[:, 0] < self._thinnest
        raised = (vectors * np.maximum(values, self._thinnest)[:, None]) @ np.swapaxes(vectors, 1, 2)
        scaled[thin, parameters.INERTIAL] = parameters.from_pseudo_inertia(raised[thin])
        return scaled.flatten() * self.scale


@one_thread()
def whitened_rows(
    problem: LinearProblem, noise: float, block_deviations: Array | None, combinations: Array | None = None
) -> tuple[Array, Array]:
    """Rows A, (R, 12 L), and b, (R,), with unit noise variance, for the likelihood of a fit.

    Args:
        problem: of the fit.
        noise: standard deviation of its rows with correlation, as in the standard errors.
        block_deviations: (G, 12 L), of the parameters between blocks of the logs, without regularization; the sum of
            their outer products is a covariance. None without blocks. It replaces the noise along singular vectors of
            the rows where it is larger.
        combinations: (K, 12 L), parameter combinations with reported standard errors; along these the rows are not more
            precise than the scatter. Or None.
    """
    noise = max(noise, _LEAST_NOISE * float(np.linalg.norm(problem.b)) / max(problem.rows, 1) ** 0.5, 1e-300)
    covariance = noise**2 * np.eye(len(problem.b))
    if problem.shrinkage is not None:
        covariance += problem.shrinkage @ problem.shrinkage.T
    L = np.linalg.cholesky(covariance)
    A = scipy.linalg.solve_triangular(L, problem.A, lower=True)
    b = scipy.linalg.solve_triangular(L, problem.b, lower=True)
    if block_deviations is None:
        return A, b
    scale = problem.scale[problem.free]
    U, values, Vt = np.linalg.svd(A[:, problem.free] * scale, full_matrices=False)
    along = (block_deviations[:, problem.free] / scale) @ Vt.T * values
    spread = np.diag(np.maximum(np.square(along).sum(axis=0), 1.0))
    determined = values > RANK_TOLERANCE * values.max(initial=0.0)
    for weights in [] if combinations is None else combinations[:, problem.free] * scale:
        t = np.where(determined, Vt @ weights, 0.0) / np.where(determined, values, 1.0)
        _widen(spread, t, float(np.square(along @ t).sum()))
    L = np.linalg.cholesky(spread)
    A = scipy.linalg.solve_triangular(L, U.T @ A, lower=True)
    return A, scipy.linalg.solve_triangular(L, U.T @ b, lower=True)


def _widen(covariance: Array, weights: Array, least: float) -> None:
    """Raise a covariance (n, n), in place, until the variance along weights (n,) is at least so much.

    Of all Gaussians with that variance it becomes the nearest to the one before (least relative entropy): what is
    uncorrelated with the combination stays as it is.
    """
    along = covariance @ weights
    variance = float(weights @ along)
    if least > variance > 0.0:
        unit = along / np.sqrt(variance)
        covariance += (least / variance - 1.0) * np.outer(unit, unit)


_WIDTHS = np.geomspace(0.01, 10.0, 300)  # relative errors of nominal bodies to consider, in steps of 2.3 %
_LEVEL = 1e-3  # significance level
_MUCH = 1.5  # times the prior's width; smaller factors hardly change the ranges


@dataclass(frozen=True)
class NominalError:
    """Error of the nominal bodies along what the data determine.

    Attributes:
        value: most likely standard deviation, relative to each body, as `prior_error`.
        prior: the width it is compared with.
        evidence: twice the logarithm of the likelihood ratio for `value`.
        combinations: number of inertial combinations that the data determine better than such a prior.
    """

    value: float
    prior: float
    evidence: float
    combinations: int

    @property
    def clear(self) -> bool:
        """Whether the data contradict the prior's width beyond chance.

        Source: the likelihood ratio test of one parameter (Wilks 1938).
        """
        return self.evidence > float(chdtri(1, _LEVEL))

    @property
    def prior_is_narrow(self) -> bool:
        """Whether the bodies' error is significantly and much larger than the prior."""
        return self.clear and self.value > _MUCH * self.prior

    def __str__(self) -> str:
        times = self.value / self.prior
        percent, factor = (f"{x:.0f}" if x > 99.0 else f"{x:.2g}" for x in (100.0 * self.value, times))
        prior = f"{factor} times the prior's {100.0 * self.prior:.3g} %"
        return f"the bodies that the data determine differ from the robot file by {percent} %, {prior}"


@one_thread()
def nominal_error(posterior: Posterior) -> NominalError | None:
    """Width of the prior from the data (empirical Bayes); None if the data determine no inertial parameters.

    Undetermined bodies are assumed to be as wrong as determined ones. Friction and extra parameters are unconstrained,
    because files seldom state them; conditions are ignored.

    Source: as in `_likelihood_of_widths`.
    """
    inertial = np.zeros(len(posterior.nominal), dtype=bool).reshape(-1, PER_BODY)
    inertial[:, INERTIAL] = True
    inertial = inertial.flatten()[posterior.free]
    prior = replace(posterior, A=posterior.A[:0], D=posterior.D[:0], b=posterior.b[:0]).conic_problem(1.0)
    count = len(inertial)
    units = scipy.linalg.solve_triangular(prior.root[:count, :count], prior.deviations[:count, :count].T, trans=1).T
    columns = posterior.A[:, posterior.free] * posterior.scale[posterior.free]
    nuisance = np.hstack([columns[:, ~inertial], posterior.D * posterior.extra_size])
    rows = np.column_stack([columns @ units[:, inertial], posterior.b - posterior.A @ posterior.nominal])
    widths = np.append(_WIDTHS, PRIOR_ERROR)
    rows = eliminate_columns(np.hstack([nuisance, rows]), range(nuisance.shape[1]))
    likelihood = _likelihood_of_widths(rows, widths)
    if likelihood is None:
        return None
    best = int(likelihood.argmax())
    return NominalError(
        value=float(widths[best]),
        prior=PRIOR_ERROR,
        evidence=float(likelihood[best] - likelihood[-1]),
        combinations=int((widths[best] * np.linalg.svd(rows[:, :-1], compute_uv=False) > 1.0).sum()),
    )


def nominal_spread(problem: LinearProblem, noise: float) -> Array:
    """Standard deviation of the nominal values of the free parameters, (P',), in units of their scale.

    One for inertial parameters and one for friction, which files seldom state, each with the other group at its best:
    the root of the mean square over all widths, weighted by their likelihood. The likeliest alone may be the narrowest
    by chance where data say little.

    Args:
        problem: of a fit.
        noise: standard deviation of its rows, correlation counted.
    """
    columns = problem.A[:, problem.free] * problem.scale[problem.free]
    target = problem.b - problem.A @ problem.nominal
    place = np.flatnonzero(problem.free) % PER_BODY
    spread = np.zeros(columns.shape[1])
    size = max(float(np.linalg.norm(problem.b)), float(np.linalg.norm(columns)))
    if size == 0.0:
        return spread
    noise = max(noise, _LEAST_NOISE * size / max(problem.rows, 1) ** 0.5)
    of_friction = (place >= FRICTION.start) & (place < FRICTION.stop)
    for group in (~of_friction, of_friction):
        whole = np.column_stack([columns[:, ~group], columns[:, group], target])
        rows = eliminate_columns(whole, range(np.count_nonzero(~group))) / noise
        likelihood = _likelihood_of_widths(rows, _WIDTHS)
        if likelihood is not None:
            weight = np.exp(0.5 * (likelihood - likelihood.max()))
            spread[group] = np.sqrt(weight @ np.square(_WIDTHS) / weight.sum())
    return spread


def _likelihood_of_widths(rows: Array, widths: Array) -> Array | None:
    """Twice the logarithm of the likelihood of widths (W,), (W,); None where the rows determine nothing.

    Source: type-II maximum likelihood (MacKay, Neural Computation 4, 1992).

    Args:
        rows: (R, c + 1), with noise of unit variance: columns of deviations from the nominal values, and right-hand
            sides that are left at these.
        widths: standard deviations of the deviations.
    """
    U, values, _ = np.linalg.svd(rows[:, :-1], full_matrices=False)
    kept = is_significant(values, RANK_TOLERANCE)
    if not kept.any():
        return None
    explained = np.square(U[:, kept].T @ rows[:, -1])
    of_data = 1.0 + np.outer(np.square(widths), np.square(values[kept]))
    return np.asarray(-(np.log(of_data) + explained / of_data).sum(axis=1))
