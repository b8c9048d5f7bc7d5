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


@dataclass(frozen=True)
class BoundEstimate(Estimate):
    """An estimate that is bound by conditions, beside what is best without.

    Attributes:
        objective: mean squared whitened residual plus prior.
        unconstrained: the least objective without conditions; None where it is not known.
        distance: rms difference of the projected whitened forces from those of `LeastSquares` with the same ridge.
        eigenvalues: (L,), smallest eigenvalue of every body's scaled pseudo-inertia, NaN for bodies without mass.
    """

    objective: float
    unconstrained: float | None
    distance: float
    eigenvalues: Array

    @property
    def price(self) -> float | None:
        """What the conditions cost: objective less the unconstrained one; None where that is not known."""
        return None if self.unconstrained is None else self.objective - self.unconstrained

    @property
    def relative_price(self) -> float | None:
        """The price as a share of the unconstrained objective; None where that is not known or 0."""
        return None if self.price is None or not self.unconstrained else self.price / self.unconstrained
