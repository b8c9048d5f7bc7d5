"""The filter of the velocities whose sign dry friction goes with: as wide as their noise allows.

A low-pass filter for accelerations takes vibration off the velocities, and with it their reversals: the mean of the
sign comes out too large. The sign needs no derivative, so that it bears more of the noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from torchid.logs.log import FloatArray, Log
from torchid.logs.low_pass import LowPass
from torchid.logs.signal_noise import MOST_SAMPLES, rough_noise
from torchid.logs.timeline import JITTER, Timeline, spline_derivatives

_FEWEST = 100  # samples
_WIDEST = 0.4  # largest cutoff over the sample rate
_EVIDENT = 0.01  # share of the velocities' power by which the error must fall: less is a few per cent of the reversals


def with_sign_filter(timeline: Timeline, log: Log) -> Timeline:
    """A timeline of a log, or of one whose start this is, with the filter of `wider_low_pass`."""
    return replace(timeline, sign_low_pass=wider_low_pass(log, timeline))


def wider_low_pass(log: Log, timeline: Timeline) -> LowPass | None:
    """The filter of velocities that leaves their least error, of motion that is lost and noise that is left together.

    None for that of the timeline, unless a wider one is clearly better.

    Source: Stein's unbiased estimate of the risk (Annals of Statistics 9, 1981), of a linear filter; the noise is
    whatever is not smooth from sample to sample, quantization included, so that it is rather too large.

    Args:
        log: as recorded, or its start.
        timeline: that it is preprocessed to.
    """
    cutoff, low_pass = timeline.cutoff_hz, timeline.low_pass
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
    candidates = [low_pass]
    while (cutoff := 2.0 * cutoff) < _WIDEST / step:
        candidates.append(LowPass.butterworth(cutoff, step))
    errors = [_error(one, values, correlation) for one in candidates]
    best = int(np.argmin(errors))
    power = float(np.square(values).mean(axis=0).sum())
    return candidates[best] if errors[0] - errors[best] > _EVIDENT * power else None


def _error(low_pass: LowPass, values: FloatArray, correlation: FloatArray) -> float:
    """Mean squared error of filtered channels (M, n), summed, but for a constant.

    `correlation`: of the noise with itself and with that of the next sample, summed over channels.
    """
    impulse = np.zeros(2 * low_pass.padding + 2 * low_pass.settling + 1)
    impulse[len(impulse) // 2] = 1.0
    response = low_pass(impulse[:, None])[len(impulse) // 2 :, 0]
    lost = float(np.square(values - low_pass(values)).mean(axis=0).sum())
    return lost + 2.0 * float(response[0] * correlation[0] + 2.0 * response[1] * correlation[1])
