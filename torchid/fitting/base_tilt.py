"""The tilt between the base that logs record and the robot's, by what a fit with it leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from torchid.errors import warn
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.parameters import Array
from torchid.problem import Samples, compress_parts

LARGEST = 0.3
"""Largest tilt about each axis that is tried [rad]: more is another frame than was meant."""

_RIDGE = 1e-6  # the residual is smooth in the tilt where the data determine some parameters badly
_SAMPLES = 2000  # of all logs, evenly spaced
_SETTLED = 1e-6  # of the residual's square
_GAIN = 1e-3  # of the residual, by which a tilt has to beat none


@dataclass(frozen=True)
class TiltChoice:
    """A tilt, and what fits with it and with none leave.

    Attributes:
        tilt: about the base's x and y axes [rad]; 0 if none is worth preferring.
        residual, level_residual: standard deviation of whitened residuals with the best tilt and with none [1].
    """

    tilt: tuple[float, float]
    residual: float
    level_residual: float

    def __str__(self) -> str:
        """The tilt, and what it is for."""
        found = f"{self.residual:.3g}, {self.level_residual:.3g} without"
        if not any(self.tilt):
            return f"none: no tilt of the base explains more (residual {found})"
        x, y = np.rad2deg(self.tilt)
        return f"{x:.2f} and {y:.2f} degrees about the base's x and y axes, chosen by the residual: {found}"


def choose_base_tilt(logs: Sequence[Samples], fitter: LogFitter) -> TiltChoice:
    """The tilt whose fit of a sample of the logs leaves least, as `torchid.load_robot` takes it.

    All other parameters are linear, and fitted anew for each tilt: separable least squares (Golub and Pereyra, 1973).

    Args:
        logs: bound training logs, of a robot without a tilt.
        fitter: of their rows.

    Warns:
        TorchidWarning: the best tilt is beyond `LARGEST`.
    """
    step = max(1, sum(map(len, logs)) // _SAMPLES)
    logs = [log.every(step) for log in logs]
    estimator = LeastSquares(_RIDGE, rank_tolerance=fitter.estimator.rank_tolerance)

    def left(tilt: Array) -> float:
        tilted = [replace(log, base=log.base.tilted(tilt, len(log))) for log in logs]
        return float(fitter.fit(compress_parts(tilted, fitter.builder), estimator.solve).estimate.residual_std ** 2)

    level = left(np.zeros(2))
    scale = max(level, np.finfo(float).tiny)
    found = minimize(
        lambda tilt: left(tilt) / scale,
        np.zeros(2),
        method="L-BFGS-B",
        jac="3-point",
        bounds=[(-LARGEST, LARGEST)] * 2,
        options={"ftol": _SETTLED},
    )
    gains = found.fun < (1.0 - _GAIN) ** 2
    if gains and np.abs(found.x).max() >= LARGEST:
        warn(f"robot.base_tilt: {LARGEST:g} rad or more; is the base's orientation that of another frame?")
    x, y = (float(f"{angle:.4g}") for angle in found.x) if gains else (0.0, 0.0)
    return TiltChoice((x, y), float(np.sqrt(found.fun * level)), float(np.sqrt(level)))
