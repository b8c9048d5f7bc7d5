"""How well combinations of the bodies' parameters are known, and whether that hangs on offsets and the like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchid import parameters
from torchid.estimators.result import Estimate
from torchid.parameters import Array
from torchid.problem.elimination import Assembly
from torchid.problem.linear import LinearProblem
from torchid.problem.threads import one_thread

APART = 10.0
"""An unknown whose standard error grows more than this by not knowing all others cannot be told from them.

It is a variance inflation of 100, ten times what is commonly taken for serious collinearity; source: Belsley, Kuh,
Welsch, "Regression Diagnostics", 1980.
"""

ROUNDING = 1e-6
"""Share of a direction below which what no row sees of it is rounding."""


@dataclass(frozen=True)
class Known:
    """What the rows say of the free parameters, in units of their scale and of the rows' noise.

    `root`, (P', rank): its outer product is their covariance; `hidden`, (P', ...): directions that no row sees;
    `values`: singular values that belong to the columns of both.
    """

    root: Array
    hidden: Array
    values: Array
    scale: Array
    free: np.ndarray

    @classmethod
    def of(cls, problem: LinearProblem, rank_tolerance: float) -> Known:
        """Of the rows of a problem; `rank_tolerance` as in `LeastSquares`."""
        scale = problem.scale[problem.free]
        _, values, Vt = np.linalg.svd(problem.A[:, problem.free] * scale, full_matrices=True)
        least = max(rank_tolerance, np.finfo(float).eps * max(problem.A.shape)) * values.max(initial=0.0)
        rank = int((values > least).sum())
        values = np.pad(values, (0, len(Vt) - len(values)))
        values[rank:] = 0.0
        return cls(Vt[:rank].T / values[:rank], Vt[rank:].T, values, scale, problem.free)

    def blamed(self, sensitivity: Array, noise: float) -> Array:
        """Share of the variance along sensitivities (P',) that each parameter brings in, of the largest such share.

        None is taken to be off by more than its scale: else the worst known would be named, however little it weighs.
        """
        noise = max(noise, ROUNDING**2)  # of exact data, where the least known is to blame
        rank = self.root.shape[1]
        directions = np.hstack([self.root * self.values[:rank], self.hidden])
        along = directions.T @ sensitivity / (1.0 + (self.values / noise) ** 2)
        shares = sensitivity * (directions @ along)
        return np.asarray(shares / max(np.abs(shares).max(initial=0.0), np.finfo(float).tiny))

    def reached(self, sensitivity: Array) -> Array:
        """Sensitivities to all parameters, (M, 12 L), as those to the scaled free ones, (M, P')."""
        return np.asarray(sensitivity[:, self.free] * self.scale)


@dataclass(frozen=True)
class TotalMass:
    """The total mass and how well it is known [kg]: `standard_error`, infinite where the data do not determine it.

    `told_apart`: whether they tell it from offsets and scales of sensors, as of `ExtraEstimate`. `nominal`: the URDF's.
    """

    standard_error: float
    told_apart: bool
    value: float
    nominal: float

    @property
    def determined(self) -> bool:
        """Whether the data say anything of it: a 95 % interval no wider than the URDF's mass on either side."""
        return self.told_apart and 2.0 * self.standard_error <= self.nominal


def total_mass(assembly: Assembly, estimate: Estimate, rank_tolerance: float = 1e-10) -> TotalMass:
    """Of the estimated parameters."""
    weights = np.zeros((len(estimate.phi) // parameters.PER_BODY, parameters.PER_BODY))
    weights[:, parameters.MASS] = 1.0
    error, if_known = (
        standard_error_of(problem, estimate, weights.flatten(), rank_tolerance)
        for problem in (assembly.problem, assembly.if_known)
    )
    value, nominal = (float(weights.flatten() @ phi) for phi in (estimate.phi, assembly.problem.nominal))
    return TotalMass(error, not np.isfinite(if_known) or error <= APART * if_known, value, nominal)


@one_thread()
def standard_error_of(
    problem: LinearProblem, estimate: Estimate, weights: Array, rank_tolerance: float = 1e-10
) -> float:
    """Standard error of a combination `weights @ phi`, (12 L,), without the pull to nominal parameters.

    Infinite where the data do not determine it; what is not free counts as known.
    """
    known = Known.of(problem, rank_tolerance)
    along = known.reached(weights[None])
    if np.linalg.norm(along @ known.hidden) > ROUNDING * np.linalg.norm(along):
        return float("inf")
    return float(np.sqrt(problem.oversampling) * estimate.residual_std * np.linalg.norm(along @ known.root))
