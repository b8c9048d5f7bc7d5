"""Time stamps of a log and of the preprocessed log, with the filter and the quintic splines between the two."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.interpolate import make_interp_spline

from torchid.errors import InputError, LogError, format_count, warn_about_file
from torchid.logs.log import BoolArray, FloatArray, check_time
from torchid.logs.low_pass import DROPPED_PERIODS, REACH_PERIODS, LowPass
from torchid.settings import AUTO

# -------------------------------------------------------------------------------------------------------------- splines

#: Samples per spline. One spline through a long log needs 22 numbers a sample for its banded matrix alone; through
#: blocks the temporaries stay small.
SPLINE_BLOCK = 4096
#: Samples added on both sides of a block: on a uniform grid a sample's influence fades by 0.43 per step, so the cut
#: has no effect beyond 128.
SPLINE_OVERLAP = 128


def spline_degree(samples: int) -> int:
    """The spline's degree: 5, or 3 or 1 where fewer than 6 or 4 samples leave no choice."""
    return 5 if samples >= 6 else 3 if samples >= 4 else 1


def spline_derivatives(
    time: FloatArray, values: FloatArray, at: FloatArray, orders: Sequence[int], block: int = SPLINE_BLOCK
) -> list[FloatArray]:
    """Derivatives of the spline through `values` (with not-a-knot ends), one array (K, ...) per order.

    Args:
        time: (N,) [s], strictly increasing, N >= 2.
        values: (N, ...), finite.
        at: (K,) [s], increasing, within `time`.
        orders: order of each derivative wanted, 0 being the value itself.
        block: samples per spline.
    """
    return joint_spline_derivatives(time, [values], at, orders, block)[0]


def joint_spline_derivatives(
    time: FloatArray, fields: Sequence[FloatArray], at: FloatArray, orders: Sequence[int], block: int = SPLINE_BLOCK
) -> list[list[FloatArray]]:
    """As `spline_derivatives` of each of some fields (N, ...): one matrix is factorized for all.

    Returns the derivatives (K, ...) of each field, by order, at the K stamps `at` [s].
    """
    flat = [values.reshape(len(time), -1) for values in fields]
    out = [[np.zeros((len(at), values.shape[1])) for _ in orders] for values in flat]
    ends = np.cumsum([values.shape[1] for values in flat])
    degree = spline_degree(len(time))
    for start in range(0, len(time) if any(values.size for values in flat) else 0, block):
        stop = start + block
        first = int(np.searchsorted(at, time[start])) if start else 0
        last = int(np.searchsorted(at, time[stop])) if stop < len(time) else len(at)
        if first < last:
            near = slice(max(0, start - SPLINE_OVERLAP), stop + SPLINE_OVERLAP)
            together = flat[0][near] if len(flat) == 1 else np.concatenate([values[near] for values in flat], axis=1)
            spline = make_interp_spline(time[near], together, k=degree)
            for number, order in enumerate(orders):
                found = np.split(spline(at[first:last], order), ends[:-1], axis=1)
                for derivatives, part in zip(out, found, strict=True):
                    derivatives[number][first:last] = part
    return [
        [derivative.reshape(len(at), *values.shape[1:]) for derivative in derivatives]
        for derivatives, values in zip(out, fields, strict=True)
    ]


# ------------------------------------------------------------------------- stamps of a log, and the filter between them

#: Steps that differ by less than this share of the median step count as uniform.
JITTER = 1e-6


@dataclass(frozen=True, eq=False)
class Timeline:
    """Three sets of time stamps [s], all counted from the log's first sample.

    Attributes:
        native: (N,) the log's own stamps.
        grid: (M,) the stamps at which channels are filtered: `native`, or a uniform grid where that is jittered.
        kept: the samples of `grid` that neither filter nor spline spoils, or every k-th of them.
        output: (K,) stamps of the preprocessed log, None for those of `kept`.
        low_pass: the filter, None without one.
        reach: how far the filter smears what it filters [s], 0 without one.
        origin: stamp of the log's first sample [s].
        bandwidth_hz: [Hz], up to where the filter leaves white noise white, None without one.
        sign_width: of Coulomb friction's sign [rad/s or m/s], as in `KinematicTree`, None for the sign itself.
        stribeck: Stribeck velocity [rad/s or m/s], as in `KinematicTree`, None without one.
        sign_low_pass: wider filter of the velocities that this sign is of, None for `low_pass`.
        sign_noise: (n,), of these velocities behind their filter [rad/s or m/s], infinite of joints that move less than
            that; None for none.
        finds_rest: whether joints at rest are found.
        rest_speed: (n,), of joints at rest at most [rad/s or m/s], see `torchid.logs.dry_friction`; None without these.
    """

    native: FloatArray
    grid: FloatArray
    kept: slice
    output: FloatArray | None
    low_pass: LowPass | None
    reach: float
    origin: float = 0.0
    bandwidth_hz: float | None = None
    sign_width: float | None = None
    stribeck: float | None = None
    sign_low_pass: LowPass | None = None
    sign_noise: FloatArray | None = None
    finds_rest: bool = False
    rest_speed: FloatArray | None = None

    @property
    def output_stamps(self) -> FloatArray:
        """Stamps (K,) of the preprocessed log, counted from the log's first sample."""
        return self.grid[self.kept] if self.output is None else self.output

    @property
    def cutoff_hz(self) -> float | None:
        """Cutoff of the filter [Hz], None without one."""
        return REACH_PERIODS / self.reach if self.reach else None

    @property
    def keeps_stamps(self) -> bool:
        """Whether the preprocessed log's stamps are the log's own, but for those dropped at the ends."""
        return self.output is None and self.grid is self.native

    def smooth(self, values: FloatArray) -> FloatArray:
        """The channels (N, ...) on the grid, (M, ...), low-pass filtered; `values` itself where nothing changes."""
        if self.grid is not self.native:
            values = spline_derivatives(self.native, values, self.grid, (0,))[0]
        return values if self.low_pass is None else self.low_pass(values)

    def evaluate(self, smoothed: FloatArray, orders: Sequence[int]) -> list[FloatArray]:
        """Derivatives (K, ...) of the given orders of channels on the grid (M, ...), at the output's stamps."""
        return self.evaluate_jointly([smoothed], orders)[0]

    def evaluate_jointly(self, smoothed: Sequence[FloatArray], orders: Sequence[int]) -> list[list[FloatArray]]:
        """As `evaluate` of each of some fields (M, ...) on the grid: their derivatives (K, ...) by order."""
        if self.output is None and orders[0] == 0:
            kept = [values[self.kept] for values in smoothed]
            if len(orders) == 1:
                return [[values] for values in kept]
            derived = joint_spline_derivatives(self.grid, smoothed, self.output_stamps, orders[1:])
            return [[values, *derivatives] for values, derivatives in zip(kept, derived, strict=True)]
        return joint_spline_derivatives(self.grid, smoothed, self.output_stamps, orders)

    def hold(self, values: FloatArray) -> FloatArray:
        """Values (N, ...) as recorded, at the output's stamps (K, ...): each holds until the next sample."""
        if self.keeps_stamps:
            return values[self.kept]
        slack = JITTER * float(np.median(np.diff(self.native)))  # a stamp may round to just before its sample
        last = np.searchsorted(self.native, self.output_stamps + slack, side="right") - 1
        return values[np.maximum(last, 0)]

    def widen_flags(self, flags: BoolArray, of_grid: bool = False) -> BoolArray:
        """Flags (N, ...) at the output's stamps (K, ...): true where they are within `reach` of the stamp.

        A flag holds until the next sample. `of_grid`: flags (M, ...) at the stamps of the grid.
        """
        if self.keeps_stamps and not self.reach:
            return flags[self.kept]
        stamps = self.grid if of_grid else self.native
        slack = JITTER * float(np.median(np.diff(stamps)))  # a stamp may round to just before its sample
        first, last = (
            np.searchsorted(stamps, self.output_stamps + slack + reach, side="right") - 1
            for reach in (-self.reach, self.reach)
        )
        count = np.concatenate([np.zeros((1, *flags.shape[1:]), dtype=np.intp), np.cumsum(flags, axis=0)])
        return np.asarray(count[last + 1] > count[np.maximum(first, 0)])


def nearest_known(normals: FloatArray) -> FloatArray:
    """Normals (N, C, 3), where NaN those of the nearest sample in which they are known: filters widen contacts."""
    out = normals.copy()
    known = np.asarray(np.isfinite(normals).all(axis=2))
    every = np.arange(len(normals))
    for contact in np.flatnonzero(known.any(axis=0) & ~known.all(axis=0)):
        samples = np.flatnonzero(known[:, contact])
        after = np.searchsorted(samples, every).clip(0, len(samples) - 1)
        before = (after - 1).clip(0)
        nearer_before = np.abs(every - samples[before]) < np.abs(samples[after] - every)
        out[:, contact] = normals[samples[np.where(nearer_before, before, after)], contact]
    return out


# --------------------------------------------------------------------------------------------------------------- layout

#: Samples dropped at each end where an unfiltered log is differentiated: the spline multiplies noise 8.5 times more at
#: the first sample than inside the log, 2.4 times more at the second and 1.3 times at the third.
DROPPED_SAMPLES = 2
#: Fewest samples that can be filtered, or differentiated so that some are left.
FEWEST_FILTERED = 2
FEWEST_DIFFERENTIATED = 2 * DROPPED_SAMPLES + 1
#: Longest step, in median steps, across which a spline is drawn.
LONGEST_STEP = 10.0
#: A step shorter than this, in median steps, is worth a warning.
SHORTEST_STEP = 0.1
#: Longest median step [s], as the checks of logs have it: longer ones are of another unit.
LONGEST_MEDIAN_STEP = 0.5
#: Highest sample rate to resample to, in median sample rates.
FASTEST = 10.0
#: Lowest rate that samples of a filtered log may have without loss, in cutoffs: rows are products of filtered signals.
LOSSLESS_RATE = 5.0

SampleRate: TypeAlias = float | Literal["auto"] | None
"""Sample rate of a preprocessed log [Hz]: a number, every k-th sample at `LOSSLESS_RATE`, or the log's own."""


def lay_out_timeline(
    time: FloatArray, cutoff_hz: float | None, sample_rate_hz: SampleRate, differentiates: bool
) -> Timeline:
    """Lay out the stamps of a log that is filtered, resampled or differentiated.

    Args:
        time: (N,) [s].
        cutoff_hz: low-pass cutoff [Hz], None for no filter.
        sample_rate_hz: output's sample rate [Hz]; auto, the least that is `LOSSLESS_RATE` cutoffs and keeps every k-th
            sample, all without a filter; None for the log's own.
        differentiates: whether a derivative is missing in the log.

    Raises:
        InputError: the cutoff or the sample rate does not suit the log.
        LogError: the time stamps cannot be filtered, resampled or differentiated.
    """
    check_time(time)
    fewest = FEWEST_DIFFERENTIATED if differentiates else FEWEST_FILTERED
    if len(time) < fewest:
        accepted = f"at least {fewest} to filter, resample or differentiate"
        raise LogError.at_field("time", format_count(len(time), "sample"), accepted)
    native = time - time[0]
    step = _median_step(native)
    grid = native
    low_pass = None
    dropped = DROPPED_SAMPLES if differentiates else 0
    kept = slice(dropped, len(native) - dropped)
    if cutoff_hz is not None:
        unit = f" (steps of {step:.6g} s: are stamps in seconds?)" if step > LONGEST_MEDIAN_STEP else ""
        _check_rate("cutoff_hz", cutoff_hz, 0.5 / step, f"half the log's median sample rate{unit}")
        if np.max(np.abs(np.diff(native) - step)) > JITTER * step:
            grid = step * np.arange(math.floor(native[-1] / step + JITTER) + 1)
        low_pass = LowPass.butterworth(cutoff_hz, step)
        kept = _unspoiled(grid, step, cutoff_hz, low_pass.padding)
    output = None
    if sample_rate_hz == AUTO:
        each = 1 if cutoff_hz is None else int(1.0 / (step * LOSSLESS_RATE * cutoff_hz) + JITTER)
        kept = slice(kept.start, kept.stop, max(min(each, kept.stop - kept.start - 1), 1))
    elif sample_rate_hz is not None:
        kept, output = _resampled(grid, step, kept, cutoff_hz, sample_rate_hz)
    if low_pass is None or cutoff_hz is None:
        return Timeline(native, grid, kept, output, None, 0.0, float(time[0]))
    between = step if grid is native else float(np.median(np.diff(grid)))
    passed = low_pass.noise_share * 0.5 / between
    return Timeline(native, grid, kept, output, low_pass, REACH_PERIODS / cutoff_hz, float(time[0]), passed)


def _resampled(
    grid: FloatArray, step: float, kept: slice, cutoff_hz: float | None, sample_rate_hz: float
) -> tuple[slice, FloatArray | None]:
    """The samples of the grid that are kept, and the stamps at a sample rate where these are no every k-th of them."""
    accepted = f"{FASTEST:g} times the log's median sample rate"
    _check_rate("sample_rate_hz", sample_rate_hz, FASTEST / step, accepted)
    if cutoff_hz is not None and cutoff_hz >= 0.5 * sample_rate_hz:
        accepted = f"a rate above {2.0 * cutoff_hz:g} Hz (twice the cutoff) to avoid aliasing"
        raise InputError.at_field("preprocessing.sample_rate_hz", f"{sample_rate_hz:g}", accepted)
    output = _uniform(grid[kept], sample_rate_hz)
    if len(output) < 2:
        reason = f"{sample_rate_hz:g} leaves one sample"
        accepted = f"more than {1.0 / (grid[kept][-1] - grid[kept][0]):.3g} Hz for this log"
        raise InputError.at_field("preprocessing.sample_rate_hz", reason, accepted)
    if (each := _share_kept(grid, 1.0 / sample_rate_hz)) is not None:  # no spline has to find what is there
        return slice(kept.start, kept.stop, each), None
    return kept, output


def _median_step(native: FloatArray) -> float:
    """The median step [s]; LogError on a step too long to draw a spline across, a warning on very short ones."""
    steps = np.diff(native)
    step = float(np.median(steps))
    longest = int(np.argmax(steps))
    shortest = int(np.argmin(steps))
    if steps[longest] > LONGEST_STEP * step:
        reason = f"a step of {steps[longest]:.6g} s after sample {longest}"
        accepted = f"steps of at most {LONGEST_STEP:g} times the median of {step:.6g} s; split the log there"
        raise LogError.at_field("time", reason, accepted)
    if steps[shortest] < SHORTEST_STEP * step:
        what = f"a step of {steps[shortest]:.6g} s after sample {shortest} (median {step:.6g} s)"
        warn_about_file(f"time: {what}: interpolation amplifies noise there")
    return step


def _check_rate(field: str, value: object, limit: float, meaning: str) -> None:
    """Raise InputError unless `value` [Hz] is above 0 and below `limit`, which is `meaning`."""
    if isinstance(value, numbers.Real) and not isinstance(value, bool) and 0.0 < float(value) < limit:
        return
    accepted = f"a number above 0 and below {limit:.6g} Hz, {meaning}"
    raise InputError.at_field(f"preprocessing.{field}", repr(value), accepted)


def _unspoiled(grid: FloatArray, step: float, cutoff_hz: float, padding: int) -> slice:
    """The samples of the grid that are far enough from both ends, LogError where there are none."""
    margin = DROPPED_PERIODS / cutoff_hz - JITTER * step
    inside = np.flatnonzero((grid >= margin) & (grid <= grid[-1] - margin))
    if not len(inside) or len(grid) <= padding:
        shortest = max(2.0 * margin, padding * step)
        accepted = f"more than {shortest:.6g} s: the {cutoff_hz:g} Hz filter loses both ends of a log"
        raise LogError.at_field("time", f"{grid[-1]:.6g} s ({len(grid)} samples)", accepted)
    return slice(int(inside[0]), int(inside[-1]) + 1)


def _share_kept(grid: FloatArray, step: float) -> int | None:
    """Every how many-th stamp of a uniform grid makes one of another step [s]; None where none does."""
    grid_step = float(grid[-1] - grid[0]) / (len(grid) - 1)
    each = max(round(step / grid_step), 1)
    uniform = np.abs(np.diff(grid) - grid_step).max() <= JITTER * grid_step
    return each if uniform and abs(step / (each * grid_step) - 1.0) <= JITTER else None


def _uniform(kept: FloatArray, rate_hz: float) -> FloatArray:
    """Stamps [s] at `rate_hz` from the first to at most the last of `kept`."""
    count = math.floor((kept[-1] - kept[0]) * rate_hz + JITTER) + 1
    return np.asarray(np.minimum(kept[0] + np.arange(count) / rate_hz, kept[-1]), dtype=np.float64)
