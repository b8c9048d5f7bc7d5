"""A derivative compared with what it is the derivative of, without differentiating noise.

The derivative is integrated, and differences of the integral across `LAG` seconds are compared with those of the base:
with x' = v, x(t + h) - x(t) is the same difference of the integral of v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchid.hygiene.neighbours import NORMAL
from torchid.logs.fields import FloatArray

#: Across which time values are compared [s]: a tenth of a second sees motion up to 5 Hz without loss.
LAG = 0.1
#: Shifts tried on either side [samples].
MAX_DELAY = 20
#: Size of a difference, in that of its noise, from which on a channel moves enough to be judged.
_MOVES = 20.0
#: Samples that are compared: every one of a short log, evenly spread ones of a long one.
_COMPARED = 20000


@dataclass(frozen=True, eq=False)
class Comparison:
    """How a derivative compares with what it should be.

    Attributes:
        ratio: (c,) slope of the derivative over what it should be, NaN where the channel hardly moves.
        correlation: (c,) of the two at the best shift, NaN likewise.
        delay: (c,) that shift [samples], positive where the derivative lags, NaN likewise.
        excess: (c,) mean of the derivative beyond what it should be, in its unit.
        misfit: size of the difference of both about their means over that of what it should be, all channels together
            at their best common shift.
    """

    ratio: FloatArray
    correlation: FloatArray
    delay: FloatArray
    excess: FloatArray
    misfit: float


def compare(time: FloatArray, base: FloatArray, derivative: FloatArray, order: int = 1) -> Comparison | None:
    """Compare a derivative (N, c) of some order with its base (N, c), N stamps [s]; None if the log is too short."""
    step = float(np.median(np.diff(time))) if len(time) > 1 else LAG
    lag = max(2, round(LAG / step))
    if len(time) < order * lag + 6 * MAX_DELAY:
        return None
    for _ in range(order):
        derivative = integral(time, derivative)
    wanted, given = (_differences(values, lag, order) for values in (base, derivative))
    at = np.arange(MAX_DELAY, len(wanted) - MAX_DELAY, max(1, len(wanted) // _COMPARED))
    excess = (given[at] - wanted[at]).mean(axis=0) / (lag * step) ** order
    target = wanted[at] - wanted[at].mean(axis=0)
    size = np.square(target).sum(axis=0)
    products, misfits = [], []
    for shift in range(-MAX_DELAY, MAX_DELAY + 1):
        shifted = given[at + shift] - given[at + shift].mean(axis=0)
        products.append(((target * shifted).sum(axis=0), np.square(shifted).sum(axis=0)))
        misfits.append(float(np.sqrt(np.square(shifted - target).sum() / max(size.sum(), 1e-300))))
    inner, norms = (np.array(values) for values in zip(*products, strict=True))
    noise = NORMAL * np.median(np.abs(np.diff(base, n=2, axis=0)), axis=0)
    moves = np.sqrt(size / len(at)) > np.maximum(_MOVES * noise, 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(inner / (np.sqrt(size) * np.sqrt(norms)), posinf=0.0, neginf=0.0)
        best = np.argmax(np.abs(correlation), axis=0)[None]
        ratio, follows = (np.take_along_axis(x, best, axis=0)[0] for x in (inner / size, correlation))
    delay = _refined(np.abs(correlation), best[0]) - MAX_DELAY
    ratio, follows, delay = (np.where(moves, x, np.nan) for x in (ratio, follows, delay))
    return Comparison(ratio, follows, delay, excess, min(misfits))


def integral(time: FloatArray, values: FloatArray) -> FloatArray:
    """Integral over time from the first sample on, (N, c), by the trapezoidal rule."""
    areas = 0.5 * (values[1:] + values[:-1]) * np.diff(time)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])


def _differences(values: FloatArray, lag: int, order: int) -> FloatArray:
    for _ in range(order):
        values = values[lag:] - values[:-lag]
    return values


def _refined(correlation: FloatArray, best: np.ndarray) -> FloatArray:
    """Places (c,) of the largest of (S, c), between the integers by a parabola through it and its neighbours."""
    inside = np.clip(best, 1, len(correlation) - 2)
    left, middle, right = (np.take_along_axis(correlation, inside[None] + k, axis=0)[0] for k in (-1, 0, 1))
    bend = left - 2.0 * middle + right
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = np.where(bend < 0.0, 0.5 * (left - right) / bend, 0.0)
    return np.where(inside == best, best + np.clip(offset, -0.5, 0.5), best)
