"""What an estimator returns."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from torchid.errors import InputError
from torchid.parameters import Array

IDENTIFIED, PRIOR, COMBINED = "identified", "dominated by the prior", "only in combination"
UNSEEN, FIXED = "cannot be seen", "fixed"
VERDICTS = (IDENTIFIED, PRIOR, COMBINED, UNSEEN, FIXED)


@dataclass(frozen=True)
class Estimate:
    """Parameters with the figures that say how far to trust them.

    Attributes:
        phi: (P,) estimated parameters; those that were not free are nominal.
        standard_error: (P,), NaN where the data do not determine the parameter.
        seen: (P,) bool, whether the data depend on the parameter at all.
        identifiable: (P,) bool, whether the data alone determine the parameter.
        data_share: (P,), diagonal of the resolution matrix of the scaled problem with its Euclidean ridge: 1 where the
            data alone make the estimate, 0 where the nominal value does, NaN where the parameter was not free. It needs
            no right-hand side.
        singular_values: of the scaled problem without the pull to the nominal parameters, descending.
        rank: its rank.
        condition_number: ratio of its largest singular value to the smallest that is not zero.
        cost, nominal_cost: sum of squared whitened residuals at `phi` and at the nominal parameters.
        rows: number of scalar equations.
        oversampling: of the rows, as in `LinearProblem`.
    """

    phi: Array
    standard_error: Array
    seen: np.ndarray
    identifiable: np.ndarray
    data_share: Array
    singular_values: Array
    rank: int
    condition_number: float
    cost: float
    nominal_cost: float
    rows: int
    oversampling: float

    @property
    def residual_std(self) -> float:
        """Standard deviation of the whitened residual: 1 where the stated sensor noise explains everything."""
        return residual_std(self.cost, self.rows, self.rank, self.oversampling)

    @property
    def verdict(self) -> np.ndarray:
        """One of `VERDICTS` for every parameter, (P,).

        "identified": the data determine it and have the larger share; "dominated by the prior": they determine it, but
        the nominal value has the larger share; "only in combination": they determine it together with others, not
        alone, however large their share; "cannot be seen": they do not depend on it; "fixed": not free.

        Source: the three kinds of Atkeson, An, Hollerbach, IJRR 1986, and a pull to nominal values.
        """
        larger_share = self.data_share >= 0.5
        decided = [np.isnan(self.data_share), ~self.seen, ~self.identifiable, ~larger_share]
        return np.select(decided, [FIXED, UNSEEN, COMBINED, PRIOR], IDENTIFIED)

    def verdict_counts(self) -> dict[str, int]:
        """Number of parameters by verdict."""
        return {verdict: int((self.verdict == verdict).sum()) for verdict in VERDICTS}


def residual_std(cost: float, rows: int, rank: int, oversampling: float) -> float:
    """Standard deviation of whitened residuals whose noise fills 1/oversampling of the band.

    A fit of slow motions removes `oversampling` times the variance of one row for each independent parameter. In a log
    so short that nothing would be left, some of the motion must lie outside the band, and the residual counts as if its
    rows were independent but fewer.
    """
    return float(np.sqrt(cost / max(rows - oversampling * rank, (rows - rank) / oversampling, 1.0)))


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


@contextmanager
def rounding_reported(estimator: str) -> Iterator[None]:
    """Run an estimator, whose linear algebra fails on numbers that no rounding allows for.

    Raises:
        InputError: it failed.
    """
    try:
        yield
    except (np.linalg.LinAlgError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        found = f"{estimator} comes to no result: rounding hides it ({error})"
        accepted = "a larger ridge, fewer free parameters, or nominal bodies of plausible masses and sizes"
        raise InputError("estimator", "name", found, accepted) from error
