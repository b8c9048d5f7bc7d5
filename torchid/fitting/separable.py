"""Settings on which rows depend nonlinearly, by separable least squares: each value with a linear fit of all the rest.

Source: Golub and Pereyra, "The differentiation of pseudo-inverses and nonlinear least squares problems", 1973.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize, minimize_scalar

from torchid.copies import share_between_copies
from torchid.errors import warn
from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples, compress_parts
from torchid.problem.chunks import thread_count
from torchid.problem.sampled_rows import SampledRows

LARGEST_TILT = 0.3
"""Largest tilt about each axis that is tried [rad]: more is another frame than was meant."""

_GAIN = 1e-3  # of the residual, by which a value has to beat none
_WIDTHS = tuple(10.0 ** np.arange(-3.0, 0.25, 0.5))
_WIDTH_SETTLED = 1e-3  # of the logarithm of the width, to base 10
_WIDTH_DIGITS = 4
_AT_ONCE = 1024  # samples: fewer lose to dispatch
_TILT_RIDGE = 1e-6  # the residual is smooth in the tilt where the data determine some parameters badly
_TILT_SAMPLES = 2000  # of all logs, evenly spaced
_TILT_SETTLED = 1e-6  # of the residual's square


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
    of_one: list[SampledRows] = []  # rows of the logs with a direction of 1, from which those of any others follow

    def sampled(logs: Sequence[Samples], builder: RowBuilder) -> SampledRows:
        if any(extra.what == "asymmetric_coulomb" for extra in builder.extras):  # its columns depend on the width, too
            return SampledRows(logs, builder, _AT_ONCE)
        if not of_one:
            ones = [replace(log, direction=torch.ones_like(log.joint_velocity)) for log in logs]
            of_one.append(SampledRows(ones, builder, _AT_ONCE))
        return of_one[0].with_directions(logs, builder)

    def left(width: float | None) -> float:
        logs, fitter = logs_and_fitter(width)
        rows = sampled(logs, fitter.builder)
        estimator = LeastSquares(rank_tolerance=fitter.estimator.rank_tolerance)
        problem = fitter.build_problem(rows.compress(np.ones(len(rows.groups)))).assembly.problem
        return estimator.solve(problem).residual_std

    def tried(width: float) -> float:
        found[width] = left(width)
        return found[width]

    first, *others = _WIDTHS
    tried(first)  # reads the logs, which copies of this process then have
    *rest, sign = share_between_copies([*others, None], left, thread_count())
    found |= dict(zip(others, rest, strict=True))
    best = int(np.argmin(list(found.values())))
    between = [np.log10(_WIDTHS[max(best - 1, 0)]), np.log10(_WIDTHS[min(best + 1, len(_WIDTHS) - 1)])]
    minimize_scalar(lambda x: tried(10.0**x), bounds=between, method="bounded", options={"xatol": _WIDTH_SETTLED})
    found[None] = sign
    width = min(found, key=lambda one: found[one])
    gains = found[width] < (1.0 - _GAIN) * sign
    chosen = float(f"{width:.{_WIDTH_DIGITS}g}") if gains and width is not None else None
    return SignWidthChoice(chosen, tuple(found), tuple(found.values()))


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
        TorchidWarning: the best tilt is beyond `LARGEST_TILT`.
    """
    step = max(1, sum(map(len, logs)) // _TILT_SAMPLES)
    logs = [log.every(step) for log in logs]
    estimator = LeastSquares(_TILT_RIDGE, rank_tolerance=fitter.estimator.rank_tolerance)

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
        bounds=[(-LARGEST_TILT, LARGEST_TILT)] * 2,
        options={"ftol": _TILT_SETTLED},
    )
    gains = found.fun < (1.0 - _GAIN) ** 2
    if gains and np.abs(found.x).max() >= LARGEST_TILT:
        warn(f"robot.base_tilt: {LARGEST_TILT:g} rad or more; is the base's orientation that of another frame?")
    x, y = (float(f"{angle:.4g}") for angle in found.x) if gains else (0.0, 0.0)
    return TiltChoice((x, y), float(np.sqrt(found.fun * level)), float(np.sqrt(level)))
