"""Batch least squares with a pull to the nominal parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from torchid.estimators.result import Estimate, residual_std, rounding_reported
from torchid.parameters import Array
from torchid.problem.linear import LinearProblem
from torchid.problem.threads import one_thread

_SEEN = 1e-12  # a finger's share in a sum with the trunk's mass is 1e-7, that of no row but rounding
_HIDDEN = 1e-6  # far above rounding (1e-10 on a humanoid) and below any share found in a robot (1e-4)


@dataclass(frozen=True)
class LeastSquares:
    """min ||A phi - b||^2 / rows + ridge ||(phi - nominal) / scale||^2.

    With `ridge` 0 the deviation from the nominal parameters of least scaled norm among all minimizers.

    Attributes:
        ridge: weight of the pull to the nominal parameters against the mean square of the whitened residual.
        rank_tolerance: a singular value of the scaled problem below this share of the largest counts as zero.
    """

    ridge: float = 0.0
    rank_tolerance: float = 1e-10

    def __post_init__(self) -> None:
        """Check the weights."""
        if not (np.isfinite(self.ridge) and self.ridge >= 0.0):
            raise ValueError(f"ridge: found {self.ridge}; accepted: a finite number of at least 0")
        if not 0.0 < self.rank_tolerance < 1.0:
            raise ValueError(f"rank_tolerance: found {self.rank_tolerance}; accepted: a number between 0 and 1")

    @rounding_reported("least_squares")
    @one_thread()  # twice as fast as two on some hundred columns
    def solve(self, problem: LinearProblem) -> Estimate:
        """Fit the free parameters.

        Standard errors propagate the sensor noise, scaled to the residual that was found, through the estimator, and
        count only as many rows as the filtered noise leaves independent; they say nothing of the pull's bias. They are
        NaN where the data alone do not determine the parameter.
        """
        free, scale = problem.free, problem.scale[problem.free]
        A = problem.A[:, free] * scale
        b = problem.b - problem.A @ problem.nominal
        pinv, values, rank = _pseudo_inverse(A, self.rank_tolerance)
        hidden = np.linalg.norm(np.eye(A.shape[1]) - pinv @ A, axis=1)  # share in directions that no row sees
        gain = pinv
        if self.ridge > 0.0:
            pull = np.sqrt(self.ridge * problem.rows)
            stacked = np.vstack([A, pull * np.eye(A.shape[1])])
            gain = _pseudo_inverse(stacked, 0.0)[0][:, : len(b)]
            gain = pinv @ (A @ gain)  # what no row sees stays nominal: a tiny pull would leave it to rounding
        step = gain @ b

        phi = problem.nominal.copy()
        phi[free] += scale * step
        cost = problem.cost(phi)
        noise = np.sqrt(problem.oversampling) * residual_std(cost, problem.rows, rank, problem.oversampling)
        seen, identifiable = np.zeros(len(phi), dtype=bool), np.zeros(len(phi), dtype=bool)
        seen[free], identifiable[free] = hidden**2 < 1.0 - _SEEN, hidden < _HIDDEN
        standard_error, data_share = np.full(len(phi), np.nan), np.full(len(phi), np.nan)
        standard_error[free] = noise * scale * np.linalg.norm(gain, axis=1)
        standard_error[~identifiable] = np.nan
        data_share[free] = np.clip(np.einsum("pr,rp->p", gain, A), 0.0, 1.0)  # diagonal of gain @ A
        return Estimate(
            phi=phi,
            standard_error=standard_error,
            seen=seen,
            identifiable=identifiable,
            data_share=data_share,
            singular_values=values,
            rank=rank,
            condition_number=float(values[0] / values[rank - 1]) if rank else float("nan"),
            cost=cost,
            nominal_cost=problem.cost(problem.nominal),
            rows=problem.rows,
            oversampling=problem.oversampling,
        )


def _pseudo_inverse(A: Array, tolerance: float) -> tuple[Array, Array, int]:
    """Minimum-norm inverse, singular values and rank, from one call of `torch.linalg.lstsq`."""
    identity = torch.eye(A.shape[0], dtype=torch.float64)
    rcond = max(tolerance, np.finfo(float).eps * max(A.shape))
    solved = torch.linalg.lstsq(torch.from_numpy(np.ascontiguousarray(A)), identity, rcond=rcond, driver="gelss")
    return solved.solution.numpy(), solved.singular_values.numpy(), int(solved.rank)
