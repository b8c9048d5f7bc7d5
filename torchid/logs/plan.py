"""Lay out a timeline: check what is asked of a log against its time stamps, and decide what its ends lose."""

from __future__ import annotations

import math
import numbers
import warnings

import numpy as np
from scipy import signal

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs.checks import check_time
from torchid.logs.fields import FloatArray
from torchid.logs.timeline import JITTER, LowPass, Timeline

#: Order of the Butterworth filter, which runs forward and backward: the gain at the cutoff is 1/2.
FILTER_ORDER = 4
#: Periods of the cutoff that are dropped at each end of a filtered log. The filter does not know what came before, and
#: its error on an acceleration is 5 % of that signal's rms after 1 period, 2 to 3 % after 1.5, under 1 % after 2
#: (3 % for a base that spins once a second, whose quaternion has a large second derivative even at constant rate).
DROPPED_PERIODS = 2.0
#: Periods of the cutoff over which the filter smears a force: 2 % of a step are left beyond, 0.05 % of one that takes
#: two periods.
REACH_PERIODS = 1.0
#: Samples dropped at each end where an unfiltered log is differentiated: the spline multiplies noise 8.5 times more at
#: the first sample than inside the log, 2.4 times more at the second and 1.3 times at the third.
DROPPED_SAMPLES = 2
#: Fewest samples that can be filtered, or differentiated so that some are left.
FEWEST_FILTERED, FEWEST_DIFFERENTIATED = 2, 2 * DROPPED_SAMPLES + 1
#: Longest step, in median steps, across which a spline is drawn.
LONGEST_STEP = 10.0
#: A step shorter than this, in median steps, is worth a warning.
SHORTEST_STEP = 0.1
#: Highest sample rate to resample to, in median sample rates.
FASTEST = 10.0


def plan(
    source: str, time: FloatArray, cutoff_hz: float | None, sample_rate_hz: float | None, differentiates: bool
) -> Timeline:
    """Lay out the stamps of a log that is filtered, resampled or differentiated.

    Args:
        source: the log's file name.
        time: (N,) [s].
        cutoff_hz: low-pass cutoff [Hz], None for no filter.
        sample_rate_hz: output's sample rate [Hz], None for the log's own.
        differentiates: whether a derivative is missing in the log.

    Raises:
        InputError: the cutoff or the sample rate does not suit the log.
        LogError: the time stamps cannot be filtered, resampled or differentiated.
    """
    check_time(source, time)
    fewest = FEWEST_DIFFERENTIATED if differentiates else FEWEST_FILTERED
    if len(time) < fewest:
        accepted = f"at least {fewest} to filter, resample or differentiate"
        raise LogError(source, "time", f"{len(time)} samples", accepted)
    native = time - time[0]
    step = _median_step(source, native)
    grid, low_pass = native, None
    dropped = DROPPED_SAMPLES if differentiates else 0
    kept = slice(dropped, len(native) - dropped)
    if cutoff_hz is not None:
        _check_rate(source, "cutoff_hz", cutoff_hz, 0.5 / step, "half the log's median sample rate")
        if np.max(np.abs(np.diff(native) - step)) > JITTER * step:
            grid = step * np.arange(math.floor(native[-1] / step + JITTER) + 1)
        low_pass = LowPass(
            sections=signal.butter(FILTER_ORDER, cutoff_hz, fs=1.0 / step, output="sos"),
            padding=max(15, math.ceil(1.0 / (cutoff_hz * step))),
        )
        kept = _unspoiled(source, grid, step, cutoff_hz, low_pass.padding)
    output = None
    if sample_rate_hz is not None:
        accepted = f"{FASTEST:g} times the log's median sample rate"
        _check_rate(source, "sample_rate_hz", sample_rate_hz, FASTEST / step, accepted)
        if cutoff_hz is not None and cutoff_hz >= 0.5 * sample_rate_hz:
            accepted = f"a rate above {2.0 * cutoff_hz:g} Hz, twice the cutoff, so that nothing aliases"
            raise InputError(source, "preprocessing.sample_rate_hz", f"{sample_rate_hz:g}", accepted)
        output = _uniform(grid[kept], sample_rate_hz)
        if len(output) < 2:
            found = f"{sample_rate_hz:g}, which leaves one sample"
            accepted = f"more than {1.0 / (grid[kept][-1] - grid[kept][0]):.3g} Hz for this log"
            raise InputError(source, "preprocessing.sample_rate_hz", found, accepted)
    if low_pass is None or cutoff_hz is None:
        return Timeline(native, grid, kept, output, None, 0.0, float(time[0]))
    passed = low_pass.noise_share * 0.5 / float(np.median(np.diff(grid)))
    return Timeline(native, grid, kept, output, low_pass, REACH_PERIODS / cutoff_hz, float(time[0]), passed)


def _median_step(source: str, native: FloatArray) -> float:
    """The median step [s]; LogError on a step too long to draw a spline across, a warning on very short ones."""
    steps = np.diff(native)
    step = float(np.median(steps))
    longest, shortest = int(np.argmax(steps)), int(np.argmin(steps))
    if steps[longest] > LONGEST_STEP * step:
        found = f"a step of {steps[longest]:.6g} s after sample {longest}"
        accepted = f"steps of at most {LONGEST_STEP:g} times the median of {step:.6g} s; split the log there"
        raise LogError(source, "time", found, accepted)
    if steps[shortest] < SHORTEST_STEP * step:
        message = (
            f"{source}: time: a step of {steps[shortest]:.6g} s after sample {shortest}, the median being {step:.6g} s:"
            " interpolation multiplies the noise there"
        )
        warnings.warn(message, TorchidWarning, stacklevel=5)
    return step


def _check_rate(source: str, field: str, value: object, limit: float, meaning: str) -> None:
    """Raise InputError unless `value` [Hz] is above 0 and below `limit`, which is `meaning`."""
    if isinstance(value, numbers.Real) and not isinstance(value, bool) and 0.0 < float(value) < limit:
        return
    accepted = f"a number above 0 and below {limit:.6g} Hz, {meaning}"
    raise InputError(source, f"preprocessing.{field}", repr(value), accepted)


def _unspoiled(source: str, grid: FloatArray, step: float, cutoff_hz: float, padding: int) -> slice:
    """The samples of the grid that are far enough from both ends, LogError where there are none."""
    margin = DROPPED_PERIODS / cutoff_hz - JITTER * step
    inside = np.flatnonzero((grid >= margin) & (grid <= grid[-1] - margin))
    if not len(inside) or len(grid) <= padding:
        shortest = max(2.0 * margin, padding * step)
        accepted = f"more than {shortest:.6g} s for a cutoff of {cutoff_hz:g} Hz, which spoils both ends of a log"
        raise LogError(source, "time", f"{grid[-1]:.6g} s ({len(grid)} samples)", accepted)
    return slice(int(inside[0]), int(inside[-1]) + 1)


def _uniform(kept: FloatArray, rate_hz: float) -> FloatArray:
    """Stamps [s] at `rate_hz` from the first to at most the last of `kept`."""
    count = math.floor((kept[-1] - kept[0]) * rate_hz + JITTER) + 1
    return np.asarray(np.minimum(kept[0] + np.arange(count) / rate_hz, kept[-1]), dtype=np.float64)
