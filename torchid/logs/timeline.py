"""How samples move from a log's time stamps to those of the preprocessed log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal

from torchid.logs.fields import BoolArray, FloatArray
from torchid.logs.spline import BLOCK, OVERLAP, spline_derivatives

#: Steps that differ by less than this share of the median step count as uniform.
JITTER = 1e-6
_FREQUENCIES = 2**16
#: What is left of a value that a block of a log does not hold: a hundredth of rounding, for modes of a filter that runs
#: twice decay like a polynomial times an exponential.
_SETTLED = 1e-18


@dataclass(frozen=True, eq=False)
class LowPass:
    """A zero-phase filter: the second-order sections of one pass, and how many samples each end is extended by."""

    sections: FloatArray
    padding: int

    def __call__(self, values: FloatArray) -> FloatArray:
        """Filter every channel of uniformly sampled values (M, ...) forward and backward."""
        flat = values.reshape(len(values), -1)
        out = np.empty(flat.shape)
        for column in range(flat.shape[1]):  # one by one: the filter makes several copies of what it is given
            out[:, column] = signal.sosfiltfilt(self.sections, flat[:, column], padlen=self.padding)
        return out.reshape(values.shape)

    @property
    def settling(self) -> int:
        """Samples after which nothing is left of what lies before: the slowest mode has decayed to rounding."""
        slowest = max(float(np.max(np.abs(np.roots(section[3:])))) for section in self.sections)
        return math.ceil(math.log(_SETTLED) / math.log(slowest))

    @property
    def noise_share(self) -> float:
        """Share of the power of white noise that passes: equivalent noise bandwidth over half the sample rate."""
        _, response = signal.sosfreqz(self.sections, worN=_FREQUENCIES, whole=True)
        return float(np.mean(np.abs(response) ** 4))  # two passes, and power goes with the amplitude squared


@dataclass(frozen=True, eq=False)
class Timeline:
    """Three sets of time stamps [s], all counted from the log's first sample.

    Attributes:
        native: (N,) the log's own stamps.
        grid: (M,) the stamps at which channels are filtered: `native`, or a uniform grid where that is jittered.
        kept: the samples of `grid` that neither filter nor spline spoils.
        output: (K,) stamps of the preprocessed log, None for those of `kept`.
        low_pass: the filter, None without one.
        reach: how far the filter smears what it filters [s], 0 without one.
        origin: stamp of the log's first sample [s].
        bandwidth_hz: [Hz], up to where the filter leaves white noise white, None without one.
    """

    native: FloatArray
    grid: FloatArray
    kept: slice
    output: FloatArray | None
    low_pass: LowPass | None
    reach: float
    origin: float = 0.0
    bandwidth_hz: float | None = None

    @property
    def at(self) -> FloatArray:
        """Stamps (K,) of the preprocessed log, counted from the log's first sample."""
        return self.grid[self.kept] if self.output is None else self.output

    @property
    def keeps_stamps(self) -> bool:
        """Whether the preprocessed log's stamps are the log's own, but for those dropped at the ends."""
        return self.output is None and self.grid is self.native

    def part(self, first: int, last: int) -> tuple[slice, Timeline]:
        """What a part of the output's stamps depends on: samples of the log, and the timeline from these to the part.

        The same numbers come out as from the whole, but for a remainder of `_SETTLED` and rounding: filter and spline
        reach into the neighbourhood, and the spline is drawn through the same blocks of samples.
        """
        at = self.at[first:last]
        beyond = OVERLAP + (0 if self.low_pass is None else self.low_pass.settling + self.low_pass.padding)
        grid = _around(self.grid, at, beyond)
        samples = grid if self.grid is self.native else _around(self.native, self.grid[grid][[0, -1]], OVERLAP)
        native = self.native[samples]
        start = self.kept.start - grid.start
        return samples, replace(
            self,
            native=native,
            grid=native if self.grid is self.native else self.grid[grid],
            kept=slice(start + first, start + last) if self.output is None else slice(0),
            output=None if self.output is None else at,
        )

    def smooth(self, values: FloatArray) -> FloatArray:
        """The channels (N, ...) on the grid, (M, ...), low-pass filtered; `values` itself where nothing changes."""
        if self.grid is not self.native:
            values = spline_derivatives(self.native, values, self.grid, (0,))[0]
        return values if self.low_pass is None else self.low_pass(values)

    def evaluate(self, smoothed: FloatArray, orders: Sequence[int]) -> list[FloatArray]:
        """Derivatives (K, ...) of the given orders of channels on the grid (M, ...), at the output's stamps."""
        if self.output is None and orders[0] == 0:
            rest = spline_derivatives(self.grid, smoothed, self.at, orders[1:]) if len(orders) > 1 else []
            return [smoothed[self.kept], *rest]
        return spline_derivatives(self.grid, smoothed, self.at, orders)

    def held(self, values: FloatArray) -> FloatArray:
        """Values (N, ...) as recorded, at the output's stamps (K, ...): each holds until the next sample."""
        if self.keeps_stamps:
            return values[self.kept]
        slack = JITTER * float(np.median(np.diff(self.native)))  # a stamp may round to just before its sample
        last = np.searchsorted(self.native, self.at + slack, side="right") - 1
        return values[np.maximum(last, 0)]

    def active(self, flags: BoolArray) -> BoolArray:
        """Flags (N, ...) at the output's stamps (K, ...): true where they are within `reach` of the stamp.

        A flag holds until the next sample.
        """
        if self.keeps_stamps and not self.reach:
            return flags[self.kept]
        slack = JITTER * float(np.median(np.diff(self.native)))  # a stamp may round to just before its sample
        first, last = (
            np.searchsorted(self.native, self.at + slack + reach, side="right") - 1
            for reach in (-self.reach, self.reach)
        )
        count = np.concatenate([np.zeros((1, *flags.shape[1:]), dtype=np.intp), np.cumsum(flags, axis=0)])
        return np.asarray(count[last + 1] > count[np.maximum(first, 0)])


def _around(stamps: FloatArray, at: FloatArray, beyond: int) -> slice:
    """Samples up to some beyond the first and last of `at`, in whole blocks of the spline."""
    first = int(np.searchsorted(stamps, at[0], side="right")) - 1 - beyond
    last = int(np.searchsorted(stamps, at[-1])) + 1 + beyond
    return slice(max(0, first // BLOCK * BLOCK), min(len(stamps), -(-last // BLOCK) * BLOCK + OVERLAP))
