"""Least squares with the nominal parameters as prior, and the estimate that every estimator returns."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchid.errors import InputError
from torchid.estimators.posterior import nominal_spread
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import LinearProblem
from torchid.reprs import short_repr
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE, relative_tolerance
from torchid.settings import NotNegative, Tolerance, validate_settings

IDENTIFIED = "identified"
PRIOR = "dominated by the prior"
COMBINED = "only in combination"
UNOBSERVABLE = "unobservable"
FIXED = "fixed"
VERDICTS = (IDENTIFIED, PRIOR, COMBINED, UNOBSERVABLE, FIXED)

_OBSERVABLE = 1e-12  # squared component in the row space; a finger in a sum with the trunk's mass has 1e-7


@dataclass(frozen=True)
class Estimate:
    """Estimated parameters with statistics of their reliability.

    Attributes:
        phi: (P,), estimated parameters; parameters that were not free are nominal.
        noise_error: (P,), standard errors for independent residuals; NaN where the data do not determine the parameter.
        observable: (P,) bool, whether the data depend on the parameter at all.
        identifiable: (P,) bool, whether the data alone determine the parameter.
        data_share: (P,), diagonal of the resolution matrix of the scaled problem with its euclidean ridge: 1 if the
            data alone determine the estimate, 0 if the nominal value does, NaN for fixed parameters. Independent of the
            right-hand side.
        singular_values: of the scaled problem without its ridge, descending.
        rank: of the scaled problem without its ridge.
        condition_number: largest singular value over the smallest non-zero one.
        cost, nominal_cost: sums of squared whitened residuals at `phi` and at the nominal parameters.
        rows: number of scalar equations.
        oversampling: of the rows, as in `LinearProblem`.
        block_error: (P,), standard errors from the scatter between blocks of the logs, see `Jackknife`; None with too
            few blocks.
        kept_error: (P,), standard errors from the error of the nominal parameters that the ridge keeps, see
            `nominal_spread`; None without a ridge.
        gain_error: (P,), standard errors from gain errors of the torque sensors; or None.
        psi: (M,), values of the problem's `terms` if conditions bound them; None for the best fit.
    """

    phi: Array
    noise_error: Array
    observable: np.ndarray
    identifiable: np.ndarray
    data_share: Array
    singular_values: Array
    rank: int
    condition_number: float
    cost: float
    nominal_cost: float
    rows: int
    oversampling: float
    block_error: Array | None = field(default=None, kw_only=True)
    kept_error: Array | None = field(default=None, kw_only=True)
    gain_error: Array | None = field(default=None, kw_only=True)
    psi: Array | None = field(default=None, kw_only=True)

    __repr__ = short_repr

    def _headline(self) -> str:
        counts = ", ".join(f"{count} {verdict}" for verdict, count in self.verdict_counts().items() if count)
        return f"rank {self.rank} of {self.phi.size} parameters ({counts}), residual {self.residual_std:.3g} x noise"

    @property
    def standard_error(self) -> Array:
        """The larger of `noise_error` and `block_error`, combined with `kept_error` and `gain_error`, (P,).

        NaN where the data do not determine the parameter.

        Source: intervals from the mean squared error of a biased estimate cover the truth in 95 % of cases, on average
        over parameters (Nychka, Journal of the American Statistical Association 83, 1988, on smoothing splines).
        """
        out = self.noise_error if self.block_error is None else np.maximum(self.noise_error, self.block_error)
        for more in (self.kept_error, self.gain_error):
            out = out if more is None else np.hypot(out, more)
        return out

    @property
    def residual_std(self) -> float:
        """Standard deviation of the whitened residual: 1 if the stated sensor noise explains all of it."""
        return residual_std(self.cost, self.rows, self.rank, self.oversampling)

    @property
    def verdict(self) -> np.ndarray:
        """Verdict on every parameter, one of `VERDICTS`, (P,).

        "identified": the data determine the parameter and dominate the prior. "dominated by the prior": the data
        determine it, but the nominal value dominates. "only in combination": the data determine only sums with other
        parameters. "unobservable": no row depends on it. "fixed": not free.

        Source: the three kinds of Atkeson, An, Hollerbach, IJRR 1986, and the prior.
        """
        decided = [np.isnan(self.data_share), ~self.observable, ~self.identifiable, self.data_share < 0.5]
        return np.select(decided, [FIXED, UNOBSERVABLE, COMBINED, PRIOR], IDENTIFIED)

    def verdict_counts(self) -> dict[str, int]:
        """Number of parameters by verdict."""
        return {verdict: int((self.verdict == verdict).sum()) for verdict in VERDICTS}


def residual_std(cost: float, rows: int, rank: int, oversampling: float) -> float:
    """Standard deviation of whitened residuals whose noise fills 1/oversampling of the frequency band.

    A fit of slow motions removes `oversampling` times the variance of one row for each independent parameter. In a log
    so short that no variance would remain, the motion extends beyond the band; its rows then count as independent but
    fewer.
    """
    return float(np.sqrt(cost / max(rows - oversampling * rank, (rows - rank) / oversampling, 1.0)))


class Minimizer(NamedTuple):
    """Minimizer of an estimator's objective: `phi` and `psi` of its `Estimate`, without statistics."""

    phi: Array
    psi: Array | None = None


@dataclass(frozen=True, repr=False)
class ConstrainedEstimate(Estimate):
    """An estimate under conditions, compared with the unconstrained optimum.

    Attributes:
        objective: mean squared whitened residual plus prior.
        unconstrained: the least objective without conditions; None if unknown.
        distance: rms difference of the projected whitened forces from those of `LeastSquares` with the same ridge.
        eigenvalues: (L,), smallest eigenvalue of every body's scaled pseudo-inertia; NaN for bodies without mass.
    """

    objective: float
    unconstrained: float | None
    distance: float
    eigenvalues: Array

    @property
    def increase(self) -> float | None:
        """Increase of the objective by the conditions; None if the unconstrained one is unknown."""
        return None if self.unconstrained is None else self.objective - self.unconstrained

    @property
    def relative_increase(self) -> float | None:
        """The increase relative to the unconstrained objective; None if that is unknown or 0."""
        return None if self.increase is None or not self.unconstrained else self.increase / self.unconstrained

    @property
    def deviation(self) -> float:
        """Distance from the unconstrained optimum in standard errors, rms over the determined combinations."""
        if self.increase is None or not self.unconstrained or not self.rank:
            return 0.0
        noise = residual_std(self.unconstrained * self.rows, self.rows, self.rank, self.oversampling)
        squared = max(self.increase, 0.0) * self.rows / (self.oversampling * self.rank)
        return float(np.sqrt(squared)) / max(noise, 1e-300)


@contextmanager
def report_rounding(estimator: str) -> Iterator[None]:
    """Turn a failure of an estimator's linear algebra into an InputError that says what to change."""
    try:
        yield
    except (np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        reason = f"{estimator} failed numerically ({error})"
        accepted = "a larger ridge, fewer free parameters, or nominal bodies with plausible masses and sizes"
        raise InputError("estimator", "name", reason, accepted) from error


@dataclass(frozen=True)
class Regularized:
    """Settings of all estimators.

    Attributes:
        ridge: weight of the prior (squared deviation from the nominal parameters) against the mean squared whitened
            residual.
        rank_tolerance: singular values of the scaled problem below this fraction of the largest count as zero.
    """

    ridge: NotNegative = 0.0
    rank_tolerance: Tolerance = field(default=RANK_TOLERANCE, kw_only=True)

    def __post_init__(self) -> None:
        """Check the settings; ValueError names the first wrong one."""
        validate_settings(self)

    @property
    def least_squares(self) -> LeastSquares:
        """Least squares with the same ridge and the same rank."""
        return LeastSquares(self.ridge, rank_tolerance=self.rank_tolerance)


@dataclass(frozen=True)
class LeastSquares(Regularized):
    """Least squares with the nominal parameters as prior.

    Minimizes ||A phi - b||^2 / rows + ridge ||(phi - nominal) / scale||^2. With `ridge` 0 the result is the minimizer
    whose scaled deviation from the nominal parameters has the least norm. Solved by `torch.linalg.lstsq` (LAPACK
    gelsd), with P more rows for a ridge.
    """

    @report_rounding("least_squares")
    @one_thread()
    def minimize(self, problem: LinearProblem) -> Minimizer:
        """As `solve`, without statistics.

        Raises:
            InputError: a decomposition failed.
        """
        return Minimizer(self.minimize_all(problem, [self.ridge])[0])

    @report_rounding("least_squares")
    @one_thread()
    def minimize_all(self, problem: LinearProblem, ridges: Sequence[float]) -> Array:
        """Parameters for each of K ridges, (K, P), by one batch of least-squares problems.

        Raises:
            InputError: a decomposition failed.
        """
        misfit = torch.from_numpy(problem.b - problem.A @ problem.nominal)
        moves = self._inverse(problem).solve(problem.rows * np.asarray(ridges), misfit[:, None])[..., 0]
        phi = np.tile(problem.nominal, (len(ridges), 1))
        phi[:, problem.free] += problem.scale[problem.free] * moves.numpy()
        return phi

    def _inverse(self, problem: LinearProblem) -> _Inverse:
        """Pseudoinverse of the free, scaled columns; all ridges share it."""
        key = "inverse", self.rank_tolerance
        return problem.shared(key, lambda: _Inverse.of(problem, self.rank_tolerance))

    @report_rounding("least_squares")
    @one_thread()  # twice as fast as two on some hundred columns
    def solve(self, problem: LinearProblem) -> Estimate:
        """Fit the free parameters.

        Standard errors (`noise_error`) propagate the sensor noise, scaled to the observed residual, through the
        estimator. They count only independent rows. The prior's bias is included as far as `shrinkage` of the problem
        describes it; `kept_error` has that of the ridge. They are NaN where the data alone do not determine the
        parameter.

        Raises:
            InputError: a decomposition failed.
        """
        free = problem.free
        scale = problem.scale[problem.free]
        inverse = self._inverse(problem)
        phi = self.minimize(problem).phi
        A = inverse.A.numpy()
        values = inverse.values.numpy()
        rank = inverse.rank
        gain = inverse.solve(np.array([problem.rows * self.ridge]), torch.eye(len(A), dtype=torch.float64))[0].numpy()
        null_share = np.linalg.norm(np.eye(A.shape[1]) - inverse.row_space.numpy(), axis=1)  # of each in the null space
        cost = problem.cost(phi)
        noise = np.sqrt(problem.oversampling) * residual_std(cost, problem.rows, rank, problem.oversampling)
        observable = np.zeros(len(phi), dtype=bool)
        identifiable = np.zeros(len(phi), dtype=bool)
        observable[free] = null_share**2 < 1.0 - _OBSERVABLE
        identifiable[free] = null_share < UNOBSERVABLE_SHARE
        noise_error = np.full(len(phi), np.nan)
        data_share = np.full(len(phi), np.nan)
        noise_error[free] = noise * scale * np.linalg.norm(gain, axis=1)
        by_data = A
        if problem.shrinkage is not None and problem.parameter_shrinkage is not None:
            noise_error[free] = np.hypot(noise_error[free], scale * np.linalg.norm(gain @ problem.shrinkage, axis=1))
            by_data = A - problem.parameter_shrinkage
        noise_error[~identifiable] = np.nan
        kept_error = None
        if self.ridge:
            kept = np.eye(A.shape[1]) - gain @ A
            kept_error = np.where(identifiable & free, 0.0, np.nan)
            kept_error[free] += scale * np.linalg.norm(kept * nominal_spread(problem, noise), axis=1)
        data_share[free] = np.clip(np.einsum("pr,rp->p", gain, by_data), 0.0, 1.0)  # diagonal of gain @ A
        return Estimate(
            phi=phi,
            noise_error=noise_error,
            observable=observable,
            identifiable=identifiable,
            data_share=data_share,
            singular_values=values,
            rank=rank,
            condition_number=float(values[0] / values[rank - 1]) if rank else float("nan"),
            cost=cost,
            nominal_cost=problem.cost(problem.nominal),
            rows=problem.rows,
            oversampling=problem.oversampling,
            kept_error=kept_error,
        )


@dataclass(frozen=True)
class _Inverse:
    """Pseudoinverse, singular values and numerical rank of columns A, (R, P), by `torch.linalg.lstsq`.

    `row_space`: (P, P), projector to the combinations that the rows determine.
    """

    A: Tensor
    pseudoinverse: Tensor
    row_space: Tensor
    values: Tensor
    rank: int

    @classmethod
    def of(cls, problem: LinearProblem, tolerance: float) -> _Inverse:
        A = torch.from_numpy(problem.A[:, problem.free] * problem.scale[problem.free])
        unit = torch.eye(len(A), dtype=A.dtype)
        if not A.numel():  # LAPACK takes no empty matrix
            return cls(A, A.mT, A.mT @ A, A.new_zeros(0), 0)
        solved = torch.linalg.lstsq(A, unit, rcond=relative_tolerance(tolerance, A.shape), driver="gelsd")
        return cls(A, solved.solution, solved.solution @ A, solved.singular_values, int(solved.rank))

    def solve(self, weights: Array, B: Tensor) -> Tensor:
        """Minimizers X of ||A X - B||^2 + weight ||X||^2 for each of K weights, (K, P, M), of least norm for weight 0.

        A weight adds P rows below those of A.
        """
        out = (self.pseudoinverse @ B).repeat(len(weights), 1, 1)
        damped = np.flatnonzero(weights)
        if len(damped) and self.rank:
            unit = torch.eye(self.A.shape[1], dtype=B.dtype)
            below = torch.from_numpy(np.sqrt(weights[damped]))[:, None, None] * unit
            rows = torch.cat([(self.A @ self.row_space).expand(len(damped), -1, -1), below], dim=1)
            target = torch.cat([B, B.new_zeros(len(unit), B.shape[1])]).expand(len(damped), -1, -1)
            out[damped] = torch.linalg.lstsq(rows, target, driver="gelsd").solution
        return out
