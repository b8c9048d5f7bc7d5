"""The width over which Coulomb friction reverses, by what a fit with it leaves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.problem import Samples
from torchid.problem.sampled_rows import SampledRows

_WIDTHS = tuple(10.0 ** np.arange(-3.0, 0.25, 0.5))
_SETTLED = 1e-3  # of the logarithm of the width, to base 10
_GAIN = 1e-3  # of the residual, by which a width has to beat the sign
_DIGITS = 4


@dataclass(frozen=True)
class SignWidthChoice:
    """A width, and what fits with others leave.

    Attributes:
        width: [rad/s or m/s]; None for the sign, to which no width is worth preferring.
        tried: (W,) widths, the sign last.
        residual: (W,) standard deviation of whitened residuals of their fits [1].
    """

    width: float | None
    tried: tuple[float | None, ...]
    residual: tuple[float, ...]

    def __str__(self) -> str:
        """The width, and what it is for."""
        if self.width is None:
            return "none: Coulomb friction with tanh(velocity / width) explains no more than with the sign"
        least, sign = min(self.residual), self.residual[-1]
        return f"{self.width:g} rad/s (m/s), chosen by the residual: {least:.3g}, {sign:.3g} with the sign"


def choose_sign_width(
    logs_and_fitter: Callable[[float | None], tuple[Sequence[Samples], LogFitter]],
) -> SignWidthChoice:
    """The width [rad/s or m/s] whose fit of a sample of the logs leaves least.

    All other parameters are linear, and fitted anew for each width: separable least squares (Golub and Pereyra, 1973).

    Args:
        logs_and_fitter: bound training logs, preprocessed with a width, and a fitter with rows of that width; None for
            the sign.
    """
    found: dict[float | None, float] = {}

    def left(width: float | None) -> float:
        logs, fitter = logs_and_fitter(width)
        rows = SampledRows(logs, fitter.builder)
        estimator = LeastSquares(rank_tolerance=fitter.estimator.rank_tolerance)
        residual = fitter.fit(rows.compress(np.ones(len(rows.groups))), estimator.solve).estimate.residual_std
        found[width] = np.inf if residual is None else residual
        return found[width]

    best = int(np.argmin([left(width) for width in _WIDTHS]))
    between = [np.log10(_WIDTHS[max(best - 1, 0)]), np.log10(_WIDTHS[min(best + 1, len(_WIDTHS) - 1)])]
    minimize_scalar(lambda x: left(10.0**x), bounds=between, method="bounded", options={"xatol": _SETTLED})
    width = min(found, key=lambda one: found[one])
    gains = found[width] < (1.0 - _GAIN) * left(None)
    chosen = float(f"{width:.{_DIGITS}g}") if gains and width is not None else None
    return SignWidthChoice(chosen, tuple(found), tuple(found.values()))
