"""Directions of joints for dry friction at the stamps of a preprocessed log, and joints at rest.

A low-pass filter for accelerations takes vibration off the velocities, and with it their reversals: the mean of the
sign comes out too large. The sign needs no derivative, so that it bears more of the noise: its filter is as wide as the
noise of the velocities allows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.polynomial.legendre import leggauss

from torchid.errors import about_file, warn_about_file
from torchid.logs.log import BoolArray, FloatArray, Log, SignalNoise
from torchid.logs.low_pass import LowPass, import_signal
from torchid.logs.signal_noise import MOST_SAMPLES, noise_of_derivatives, rough_noise
from torchid.logs.timeline import JITTER, Timeline, spline_derivatives

#: Values that are filtered together: few, so that copies of a long log are small; many, so that a short one needs few
#: calls.
_VALUES_TOGETHER = 2**14
_ROUNDING = 1e-9  # share of a weight


def channels_together(count: int) -> int:
    """How many channels of this many samples are filtered in one call."""
    return max(1, _VALUES_TOGETHER // max(count, 1))


def dry_friction(log: Log, smoothed: Mapping[str, FloatArray], timeline: Timeline) -> dict[str, Any]:
    """`joint_direction` and, with a Stribeck velocity, `joint_stribeck`, (K, n); none without a filter.

    The filter smears its torque as all others; velocities with reversals that it would take off are filtered less.
    Where joints at rest are to be found, `joint_rests` too.

    Args:
        log: the log.
        smoothed: its joint positions and, if it has them, velocities.
        timeline: with the width of the sign (`noisy_width`), and the velocities of joints at rest.
    """
    out = dict[str, Any]()
    if log.joint_rests is not None:
        out["joint_rests"] = timeline.widen_flags(log.joint_rests)
    if log.joint_direction is not None:
        given = {"joint_direction": log.joint_direction, "joint_stribeck": log.joint_stribeck}
        return out | {key: timeline.evaluate(timeline.smooth(x), (0,))[0] for key, x in given.items() if x is not None}
    if timeline.low_pass is None and timeline.rest_speed is None:
        return out
    name = "joint_position" if log.joint_velocity is None else "joint_velocity"
    known = smoothed[name]
    wider = timeline.sign_low_pass
    if wider is not None:
        known = replace(timeline, low_pass=wider).smooth(getattr(log, name))
    if timeline.rest_speed is not None and log.joint_rests is None:
        out["joint_rests"] = _rests(known, name == "joint_position", timeline.rest_speed, timeline)
    low_pass = timeline.low_pass
    return out if low_pass is None else out | _directions(known, name == "joint_position", timeline, low_pass)


def _directions(known: FloatArray, are_positions: bool, timeline: Timeline, low_pass: LowPass) -> dict[str, FloatArray]:
    """Both directions by joint positions, or else velocities, (M, n), behind their filter."""
    steps = np.diff(timeline.grid)
    means = dict[str, Callable[..., FloatArray]](joint_direction=mean_dry)
    if timeline.stribeck is not None:
        means["joint_stribeck"] = partial(mean_stribeck, stribeck=timeline.stribeck)
    out = {key: np.empty((len(timeline.output_stamps), known.shape[1])) for key in means}
    together = channels_together(len(known))
    for start in range(0, known.shape[1], together):
        columns = slice(start, start + together)
        width = noisy_width(timeline, columns)
        x = known[:, columns]
        halfway = np.diff(x, axis=0) / steps[:, None] if are_positions else 0.5 * (x[1:] + x[:-1])
        halfway = np.concatenate([halfway[:1], halfway, halfway[-1:]])
        for key, mean in means.items():
            out[key][:, columns] = timeline.evaluate(low_pass(mean(halfway, width=width)), (0,))[0]
    return out


def _rests(known: FloatArray, are_positions: bool, speed: FloatArray, timeline: Timeline) -> BoolArray:
    """Which joints, (K, n), are no faster than `speed` (n,) at a stamp, or in too much of what a filter mixes there.

    What holds a joint at rest is unknown, up to Coulomb friction either way. Of that the filter leaves the weight of
    the samples at rest at most; as much as a pause weighs that ends its reach before the stamp counts as nothing.
    """
    if are_positions:
        slow = np.abs(np.diff(known, axis=0)) <= speed * np.diff(timeline.grid)[:, None]
        rests = np.concatenate([slow[:1], slow]) | np.concatenate([slow, slow[-1:]])
    else:
        rests = np.abs(known) <= speed
    low_pass = timeline.low_pass
    if low_pass is None:
        return timeline.widen_flags(rests, of_grid=True)
    weights = np.abs(low_pass.impulse_response)
    steps = np.arange(len(weights)) - len(weights) // 2
    accepted = weights[steps * float(np.median(np.diff(timeline.grid))) > timeline.reach].sum()
    out = np.empty((len(timeline.output_stamps), rests.shape[1]), dtype=bool)
    together = channels_together(len(rests))
    for start in range(0, rests.shape[1], together):
        columns = slice(start, start + together)
        at_rest = import_signal().fftconvolve(rests[:, columns].astype(float), weights[:, None], mode="full", axes=0)
        (share,) = timeline.evaluate(at_rest[len(weights) // 2 :][: len(rests)], (0,))
        out[:, columns] = share > (1.0 + _ROUNDING) * accepted
    return out


_FEWEST = 100  # samples
_DOUBLINGS = 8  # of the cutoff
_MUCH = 0.05  # share of the velocities' power that is worth a warning
_REVERSAL = float(np.sqrt(2.0 / np.pi) / np.log(2.0))  # width of tanh over deviation of erf
_LEAST_WIDTH = 1e-9  # [rad/s or m/s] of a joint without noise among others: at once
_LEAST_CHANGE = 1e-4  # of a tanh's argument over a step, across which its mean is its middle
_NODES = 9  # within a step, of what Stribeck friction loses with speed
_WIDEST = 0.4  # largest cutoff over the sample rate
_UNKNOWN = 0.2  # share of the variance of noise by which it may be smaller than estimated
_SURELY = 3.0  # standard deviations of noise, beyond which a joint moves
_SLOW = 0.1  # of a joint's root mean square velocity
OFTEN = 0.2
"""Share of the time at rest that tells: of sines it is 0.05, of Gaussian motion 0.08."""
_EVIDENT = 0.01  # share of the velocities' power by which the error must fall: less is a few per cent of the reversals


def with_sign_filter(timeline: Timeline, log: Log, noise: SignalNoise) -> Timeline:
    """A timeline of a log with the filter of `wider_low_pass` and the noise after it.

    Where joints at rest are to be found, with the velocity that they have at most: a tenth of the root mean square, as
    in `resting_share`, or three standard deviations of noise.

    A joint that moves less than the noise of its velocity all the time has noise without bound: nobody knows its sign.
    Positions tell, further apart the noisier they are, as the mean velocity between two has noise of their own then.

    Args:
        timeline: of the log.
        log: as recorded.
        noise: of its motion, by this timeline.

    Warns:
        TorchidWarning: the timeline's own filter takes off much of the joints' motion.
    """
    wider = wider_low_pass(log, timeline)
    derivatives = noise.derivatives
    if wider is not None:
        if wider.lost > _MUCH:
            with about_file(log.source):
                warn_about_file(str(wider))
        timeline = replace(timeline, sign_low_pass=wider.low_pass)
        step = float(np.median(np.diff(log.time)))
        derivatives = noise_of_derivatives(step, replace(timeline, low_pass=wider.low_pass))
    name, order = ("joint_position", 1) if log.joint_velocity is None else ("joint_velocity", 0)
    std = noise.std.get(name)
    none = np.zeros(len(log.joint_names))
    is_noisy = std is not None and bool(std.any()) and timeline.cutoff_hz is not None
    if not (is_noisy or timeline.finds_rest):
        return timeline
    of_sign = (none if std is None else std) * np.sqrt(derivatives[order, order])
    of_position = noise.std.get("joint_position", none)
    step = float(np.median(np.diff(log.time)))
    noisy = of_sign > 0.0
    ratio = float(np.median(of_position[noisy] / of_sign[noisy])) if noisy.any() else 0.0
    lag = max(1, round(np.sqrt(2.0) * ratio / step))
    velocity = np.diff(log.joint_position[::lag], axis=0) / np.diff(log.time[::lag])[:, None]  # mean, over the lag
    square = np.square(velocity).mean(axis=0) if len(velocity) else np.full(len(none), np.inf)
    expected = (1.0 - _UNKNOWN) * 2.0 * np.square(of_position / (lag * step))  # of the positions' noise, at least
    still = noisy & (square < np.square(of_sign) + expected)
    if timeline.finds_rest:
        slow = np.maximum(_SLOW * np.sqrt(np.where(np.isfinite(square), square, 0.0)), _SURELY * of_sign)
        timeline = replace(timeline, rest_speed=np.where(still, np.inf, slow))
    return replace(timeline, sign_noise=np.where(still, np.inf, of_sign)) if is_noisy else timeline


def with_signs_of(timeline: Timeline, whole: Timeline) -> Timeline:
    """The timeline of a segment with the results of `with_sign_filter` for the whole log."""
    of_log = {name: getattr(whole, name) for name in ("sign_low_pass", "sign_noise", "rest_speed")}
    return replace(timeline, **of_log)


def resting_share(velocity: FloatArray, noise: FloatArray | float = 0.0) -> FloatArray:
    """Share of the time, (n,), in which joints are slower than a tenth of their rms velocity.

    Args:
        velocity: (N, n) [rad/s or m/s].
        noise: standard deviation of that of velocities, (n,) [rad/s or m/s]; three of it are rest, too.
    """
    slow = np.maximum(_SLOW * np.sqrt(np.square(velocity).mean(axis=0)), _SURELY * noise)
    return np.asarray((np.abs(velocity) <= slow).mean(axis=0))


@dataclass(frozen=True)
class WiderLowPass:
    """A filter with a smaller velocity error than that of a timeline.

    Attributes:
        low_pass: the filter.
        cutoff_hz: of it [Hz].
        lost: by how much the error is smaller, as a share of the velocities' power.
    """

    low_pass: LowPass
    cutoff_hz: float
    lost: float

    def __str__(self) -> str:
        """The lost share, and the cutoff that keeps it."""
        lost = f"the filter removes {100.0 * self.lost:.0f} % of the power of joint velocities"
        return f"{lost}; set preprocessing.cutoff_hz to {self.cutoff_hz:.3g} or more"


def wider_low_pass(log: Log, timeline: Timeline) -> WiderLowPass | None:
    """The filter with the smallest velocity error: lost motion plus remaining noise.

    None for that of the timeline, unless a wider one is clearly better.

    Source: Stein's unbiased estimate of the risk (Annals of Statistics 9, 1981), of a linear filter; the noise is
    whatever is not smooth from sample to sample, quantization included, so that it is rather too large.

    Args:
        log: as recorded.
        timeline: that it is preprocessed to.
    """
    cutoff = timeline.cutoff_hz
    low_pass = timeline.low_pass
    start = log.select(slice(0, MOST_SAMPLES))
    if cutoff is None or low_pass is None or len(start) < max(_FEWEST, 2 * low_pass.padding):
        return None
    name = "joint_position" if start.joint_velocity is None else "joint_velocity"
    values: FloatArray = getattr(start, name)
    if not values.shape[1] or not np.isfinite(values).all():
        return None
    step = float(np.median(np.diff(start.time)))
    if np.ptp(np.diff(start.time)) > JITTER * step:
        even = start.time[0] + step * np.arange(int((start.time[-1] - start.time[0]) / step) + 1)
        values = spline_derivatives(start.time, values, even, (0,))[0]
    correlation = np.square(rough_noise(values)).sum() * np.array([1.0, 0.0])
    if name == "joint_position":
        values = np.diff(values, axis=0) / step
        correlation = correlation[0] / step**2 * np.array([2.0, -1.0])
    cutoffs = [cutoff * 2.0**k for k in range(1, _DOUBLINGS) if cutoff * 2.0**k < _WIDEST / step]
    wider = [LowPass.butterworth(filter_, step) for filter_ in cutoffs]
    first, *errors = (_error(filter_, values, correlation) for filter_ in [low_pass, *wider])
    power = float(np.square(values).mean(axis=0).sum())
    best = int(np.argmin([first, *errors])) - 1
    if best < 0 or first - errors[best] <= _EVIDENT * power:
        return None
    return WiderLowPass(wider[best], cutoffs[best], (first - errors[best]) / power)


def _error(low_pass: LowPass, values: FloatArray, correlation: FloatArray) -> float:
    """Mean squared error of filtered channels (M, n), summed, but for a constant.

    `correlation`: of the noise with itself and with that of the next sample, summed over channels.
    """
    response = low_pass.impulse_response
    response = response[len(response) // 2 :]
    lost = float(np.square(values - low_pass(values)).mean(axis=0).sum())
    return lost + 2.0 * float(response[0] * correlation[0] + 2.0 * response[1] * correlation[1])


def mean_sign(velocity: FloatArray) -> FloatArray:
    """Mean sign along straight lines from each value to the next, (M, ...) from (M + 1, ...)."""
    size = np.abs(velocity)
    total = size[:-1] + size[1:]
    return np.divide(velocity[:-1] + velocity[1:], total, out=np.zeros_like(total), where=total > 0.0)


def mean_tanh(velocity: FloatArray) -> FloatArray:
    """Likewise for the hyperbolic tangent; its integral is log cosh."""
    size = np.abs(velocity)
    integral = np.diff(size + np.log1p(np.exp(-2.0 * size)), axis=0)
    change = np.diff(velocity, axis=0)
    tanh = np.tanh(0.5 * (velocity[:-1] + velocity[1:]))
    return np.divide(integral, change, out=tanh, where=np.abs(change) > _LEAST_CHANGE)


def noisy_width(timeline: Timeline, columns: slice) -> float | FloatArray | None:
    """Width over which the mean sign of noisy joint velocities reverses around 0.

    None for at once: a timeline without a width and without noise.

    With Gaussian noise s, as `with_sign_filter` has it, a velocity that is read as u has the mean sign
    erf(u / (sqrt(2) s)). With this width w, tanh(u / w) lacks as much of a sign during a reversal. A fit on sign(u),
    wrong where noise is the larger, finds too little Coulomb friction, and viscous friction in its place.

    Source: regression calibration (Carroll, Ruppert, Stefanski, Crainiceanu, "Measurement Error in Nonlinear Models",
    2006, chapter 4); squares of widths add up as in MacKay's moderated output (Neural Computation 4, 1992).
    """
    if timeline.sign_noise is None:
        return timeline.sign_width
    return np.maximum(np.hypot(timeline.sign_width or 0.0, _REVERSAL * timeline.sign_noise[columns]), _LEAST_WIDTH)


def mean_dry(velocity: FloatArray, width: float | FloatArray | None) -> FloatArray:
    """Mean sign for Coulomb friction, smoothed over a width [rad/s or m/s]; None for a sharp sign."""
    return mean_sign(velocity) if width is None else mean_tanh(velocity / width)


def mean_stribeck(velocity: FloatArray, width: float | FloatArray | None, stribeck: float) -> FloatArray:
    """Mean of this sign times exp(-(v / v_s)^2), by that of the sign less what is lost with speed, smooth where v is 0.

    Args:
        velocity: (M + 1, ...), where each of M successive intervals begins and the last one ends [rad/s or m/s].
        width: as of `mean_dry`.
        stribeck: v_s [rad/s or m/s].
    """
    mean = mean_dry(velocity, width)
    before = velocity[:-1]
    after = velocity[1:]
    for node, weight in zip(*leggauss(_NODES), strict=True):
        v = 0.5 * (before + after) + 0.5 * node * (after - before)
        sign = np.sign(v) if width is None else np.tanh(v / width)
        mean = mean + 0.5 * weight * sign * np.expm1(-((v / stribeck) ** 2))
    return np.asarray(mean)
