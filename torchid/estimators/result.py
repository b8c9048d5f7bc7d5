"""What an estimator returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchid.parameters import Array


@dataclass(frozen=True)
class Estimate:
    """Parameters with the figures that say how far to trust them.

    Attributes:
        phi: (P,) estimated parameters; those that were not free are nominal.
        standard_error: (P,), NaN where the data do not determine the parameter.
        identifiable: (P,) bool, whether the data alone determine the parameter.
        rank: of the scaled problem without the pull to the nominal parameters.
        condition_number: ratio of its largest singular value to the smallest that is not zero.
        cost, nominal_cost: sum of squared whitened residuals at `phi` and at the nominal parameters.
        rows: number of scalar equations.
    """

    phi: Array
    standard_error: Array
    identifiable: np.ndarray
    rank: int
    condition_number: float
    cost: float
    nominal_cost: float
    rows: int

    @property
    def residual_std(self) -> float:
        """Standard deviation of the whitened residual: 1 where the stated sensor noise explains everything."""
        return float(np.sqrt(self.cost / max(self.rows - self.rank, 1)))
