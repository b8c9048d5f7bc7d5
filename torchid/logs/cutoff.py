"""The cutoff of the low-pass filter that keeps the motion and its harmonics, and little of its noise."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchid.errors import LogError
from torchid.logs.log import FloatArray, Log, SignalNoise
from torchid.logs.low_pass import import_signal
from torchid.logs.preprocess import lacks_derivatives
from torchid.logs.quaternion import make_sign_continuous
from torchid.logs.signal_noise import STATED_FIELDS, signal_noise
from torchid.logs.timeline import LONGEST_MEDIAN_STEP, spline_derivatives
from torchid.parameters import GRAVITY

_LOWEST_HZ = 1.0
_STEPS_PER_DECADE = 40
_SEGMENT_S = 8.0  # of the spectra: lines 1/8 Hz apart
_USUAL_HZ = 10.0  # robots and people move below 5 Hz
_RATE_SHARE = 0.2  # largest cutoff over the sample rate
#: Share of noise in the power of derived accelerations: parameters that rest on them come out as much too small where
#: nothing is taken off.
_NOISE_SHARE = 5e-4
#: What a filter must leave, whatever the noise, and where a motion ends, as shares of the power of accelerations.
_KEPT_SHARE = 0.95
_MOTION_SHARE = 0.99
#: Of the power of gravity, what noise of the base's derived linear acceleration may be, whatever motion is lost: masses
#: come out as much too small, while a filter leaves equations true that are linear in the motion.
_WEIGHT_SHARE = 0.01
#: Forces of a motion have its harmonics: gravity and Coriolis terms are not linear in wide angles.
_HARMONICS = 6.0
#: Bins of a spectrum per decade, up to a share of the sample rate that splines leave as it is, and how many times the
#: noise a bin may have.
_BINS_PER_DECADE = 20
_TOP_SHARE = 0.25
_ABOVE_NOISE = 3.0
#: What an acceleration is worked out of, the first that was recorded, with the number of derivatives.
_SOURCES = (
    (("joint_acceleration", 0), ("joint_velocity", 1), ("joint_position", 2)),
    (
        ("imu_angular_acceleration", 0),
        ("imu_angular_velocity", 1),
        ("base_angular_acceleration_base", 0),
        ("base_angular_velocity_base", 1),
        ("base_quat_xyzw", 2),
    ),
    (
        ("imu_specific_force", 0),
        ("base_linear_acceleration_world", 0),
        ("base_linear_velocity_world", 1),
        ("base_position_world", 2),
    ),
)
_OF_WEIGHT = ("base_linear_velocity_world", "base_position_world")


@dataclass(frozen=True)
class CutoffChoice:
    """A cutoff, and the reason for it.

    Attributes:
        cutoff_hz: [Hz]; None: nothing is derived, and nothing filtered.
        by_noise: whether noise of the motion was found; else it is the usual one.
        limit_hz: the cutoff by noise and motion alone, where a fit to a narrower band predicts better; else None.
        motion_hz: below which 99 % of the power of the motion's accelerations lie [Hz], None without noise.
    """

    cutoff_hz: float | None
    by_noise: bool
    motion_hz: float | None = None
    limit_hz: float | None = None

    def __str__(self) -> str:
        if self.limit_hz is not None:
            return f"{self.cutoff_hz:g} Hz; a higher one, up to {self.limit_hz:g} Hz, predicts this band worse"
        if self.cutoff_hz is None:
            return "none: accelerations were recorded"
        if self.by_noise:
            return f"{self.cutoff_hz:g} Hz, from the noise; the motion reaches {self.motion_hz:g} Hz"
        return f"{self.cutoff_hz:g} Hz, the default: the logs show no noise of the motion"


def usual_cutoff_hz(sample_rate_hz: float) -> float:
    """The default cutoff [Hz]."""
    return min(_USUAL_HZ, _RATE_SHARE * sample_rate_hz)


def choose_cutoff(
    logs: Sequence[Log],
    stated: Mapping[str, float] | None = None,
    sample_rate_hz: float | None = None,
    base_is_derived: bool = False,
) -> CutoffChoice:
    """Choose one cutoff for all logs: forces of the filtered motion must nearly equal the filtered forces.

    Motion and forces pass the same filter, so that motion beyond its cutoff is no error of equations that are linear in
    it. Gravity and Coriolis terms are not: of wide angles they have harmonics, which a filter takes off the forces and
    changes in those of the filtered motion. The cutoff is therefore six times as high as the motion, but for noise: it
    is at most 0.05 % of the power of the derived accelerations, unless a twentieth of the motion's power would be lost.
    Joints [rad or m] and the base [rad, m] count together. In the linear acceleration of a base, where it is derived,
    noise is at most 1 % of the power of gravity, whatever would be lost.

    Args:
        logs: as recorded, or long parts of them.
        stated: standard deviations of noise in the motion, as `signal_noise` takes them.
        sample_rate_hz: that the logs are resampled to, None for their own.
        base_is_derived: whether the motion of the base is worked out of that of the joints.

    Raises:
        LogError: steps of time are too long for any motion of a robot.
    """
    derived = [log for log in logs if lacks_derivatives(log)]
    if not derived:
        return CutoffChoice(None, by_noise=False)
    steps = [float(np.median(np.diff(log.time))) for log in derived]
    if (step := max(steps)) > LONGEST_MEDIAN_STEP:
        accepted = f"steps of at most {LONGEST_MEDIAN_STEP:g} s, or the right unit in logs.columns.time"
        raise LogError(derived[steps.index(step)].source, "time", f"a median step of {step:.3g} s", accepted)
    slowest = 1.0 / step
    slowest = slowest if sample_rate_hz is None else min(slowest, sample_rate_hz)
    decades = np.log10(max(_RATE_SHARE * slowest / _LOWEST_HZ, 1.0))
    candidates = _LOWEST_HZ * np.logspace(0.0, decades, 1 + int(_STEPS_PER_DECADE * decades))
    motion, noise, of_base = np.zeros((3, len(candidates)))  # of_base: noise of its derived linear acceleration
    gravity = 0.0
    for log in derived:
        known = {name for key in stated or {} for name in STATED_FIELDS[key]}
        for of_motion, of_noise, name in _powers(
            log, signal_noise(log, None, stated), candidates, base_is_derived, known
        ):
            motion = motion + of_motion
            noise = noise + of_noise
            if name in _OF_WEIGHT:
                of_base += of_noise
                gravity += float(log.time[-1] - log.time[0]) * GRAVITY**2
    usual = usual_cutoff_hz(slowest)
    if not noise.any():
        return CutoffChoice(float(f"{usual:.2g}"), by_noise=False)
    last = int(np.argmax(motion - noise))  # beyond, there is more noise than motion
    least, end = (candidates[np.argmax(motion >= share * motion[last])] for share in (_KEPT_SHARE, _MOTION_SHARE))
    quiet = candidates[noise <= _NOISE_SHARE * motion[last]].max(initial=least)
    still = candidates[of_base <= _WEIGHT_SHARE * gravity].max(initial=candidates[0])
    cutoff = min(still, max(least, min(quiet, max(usual, _HARMONICS * end))))
    return CutoffChoice(float(f"{cutoff:.2g}"), by_noise=True, motion_hz=float(f"{end:.2g}"))


def _powers(
    log: Log, noise: SignalNoise, candidates: FloatArray, base_is_derived: bool, known: Collection[str]
) -> Iterator[tuple[FloatArray, FloatArray, str]]:
    """Power of accelerations up to each cutoff (n,) [Hz], of the motion and of its noise, times the log's length.

    With each the field that they are worked out of. `known`: those whose noise is stated.
    """
    for name, every, std, order in _noisy_sources(log, noise, base_is_derived):
        measured = np.isfinite(every).all(axis=1)  # gaps, whose samples are left out later, are passed over
        values = every[measured]
        time = log.time[measured]
        if len(time) < 2:
            continue
        rate = (len(time) - 1) / float(time[-1] - time[0])
        even = spline_derivatives(time, values, np.linspace(time[0], time[-1], len(time)), (0,))[0]
        length = min(len(time), int(np.ceil(_SEGMENT_S * rate)))
        frequency, power = import_signal().welch(even, fs=rate, nperseg=length, axis=0, detrend="linear")
        total = power.sum(axis=1)
        of_noise = np.full(len(frequency), 2.0 * float(np.square(std).sum()) / rate)
        if name not in known:
            steps = np.abs(np.diff(values, axis=0))
            step = np.min(steps, axis=0, where=steps > 0.0, initial=np.inf)
            of_quantization = float(np.square(step[step < np.inf]).sum()) / 12.0
            of_noise = _with_coloured_noise(frequency, total, of_noise, of_quantization)
        densities = np.stack([total - of_noise, of_noise])
        upto = np.cumsum(densities * (2.0 * np.pi * frequency) ** (2 * order), axis=1) * frequency[1] * len(time) / rate
        yield np.interp(candidates, frequency, upto[0]), np.interp(candidates, frequency, upto[1]), name


def _with_coloured_noise(
    frequency: FloatArray, power: FloatArray, white: FloatArray, of_quantization: float
) -> FloatArray:
    """The density of noise (F,) where there is more than white noise, which differences of neighbours do not show.

    Encoders with coarse steps, and samples that were lost, repeat readings: most differences of a high order are then
    0. But the spectrum beyond the motion shows the noise: it falls with the inverse of the frequency at most, but for
    lines of no more power than quantization has. Where it falls faster there is motion, whose noise is that of the
    octave above twice this frequency.
    """
    edges = _LOWEST_HZ * 10.0 ** np.arange(0.0, np.log10(_TOP_SHARE * 2.0 * frequency[-1]), 1.0 / _BINS_PER_DECADE)
    starts = np.unique(np.searchsorted(frequency, edges))
    lines = np.diff(starts)
    at = frequency[starts[:-1]]
    density = np.add.reduceat(power[: starts[-1]], starts[:-1]) / lines
    floor = _ABOVE_NOISE * np.minimum.accumulate((density * at)[::-1])[::-1] / at
    more = np.cumsum((np.maximum(density - floor, 0.0) * lines)[::-1])[::-1] * frequency[1]
    motion = np.flatnonzero((density > floor) & (more > of_quantization))
    first = starts[motion[-1] + 1] if len(motion) else starts[0]
    noise = np.full_like(power, power[2 * first : 4 * first].mean())
    noise[2 * first :] = power[2 * first :]
    return np.asarray(np.maximum(noise, white))


def _noisy_sources(
    log: Log, noise: SignalNoise, base_is_derived: bool
) -> Iterator[tuple[str, FloatArray, FloatArray, int]]:
    """What accelerations are worked out of: field, channels (N, c) with noise, its standard deviations, how often."""
    for sources in _SOURCES[: 1 if base_is_derived else None]:
        name, order = next((pair for pair in sources if getattr(log, pair[0]) is not None), ("", 0))
        std = noise.std.get(name)
        if std is None or not std.any():
            continue
        values: FloatArray = getattr(log, name)
        if name == "base_quat_xyzw":
            yield name, 2.0 * make_sign_continuous(values), std, order  # half angles
        else:
            yield name, values[:, std > 0.0], std[std > 0.0], order
