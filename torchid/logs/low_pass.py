"""The low-pass filter of all signals of a log: motion and forces pass the same one, without a shift in time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from types import ModuleType

import numpy as np

from torchid.logs.log import FloatArray

#: Order of the Butterworth filter, which runs forward and backward: the gain at the cutoff is 1/2.
FILTER_ORDER = 4
#: Periods of the cutoff that are dropped at each end of a filtered log. The filter does not know what came before, and
#: its error on an acceleration is 5 % of that signal's rms after 1 period, 2 to 3 % after 1.5, under 1 % after 2
#: (3 % for a base that spins once a second, whose quaternion has a large second derivative even at constant rate).
DROPPED_PERIODS = 2.0
#: Periods of the cutoff over which the filter smears a force: 2 % of a step are left beyond, 0.05 % of one that takes
#: two periods.
REACH_PERIODS = 1.0
_FREQUENCIES = 2**16
#: Remaining effect of a sample outside of a block: a hundredth of rounding, since modes of a filter that runs twice
#: decay like a polynomial times an exponential.
_SETTLED = 1e-18
#: Values that are filtered by one call, which makes several copies of them.
_FILTERED_AT_ONCE = 2**16


@cache
def import_signal() -> ModuleType:
    """`scipy.signal`, imported late: it takes 0.1 s, and some runs need no filter."""
    from scipy import signal

    return signal


@dataclass(frozen=True, eq=False)
class LowPass:
    """A zero-phase filter: the second-order sections of one pass, and how many samples each end is extended by."""

    sections: FloatArray
    padding: int

    @classmethod
    @cache  # takes 1 ms, and a log is filtered by the same ones over and over
    def butterworth(cls, cutoff_hz: float, step: float) -> LowPass:
        """A Butterworth filter of that cutoff [Hz], for samples at steps of so many seconds."""
        sections = import_signal().butter(FILTER_ORDER, cutoff_hz, fs=1.0 / step, output="sos")
        return cls(sections, padding=max(15, math.ceil(1.0 / (cutoff_hz * step))))

    def __call__(self, values: FloatArray) -> FloatArray:
        """Filter every channel of uniformly sampled values (M, ...) forward and backward, M above the padding."""
        flat = values.reshape(len(values), -1)
        out = np.empty(flat.shape)
        filtered = import_signal().sosfiltfilt
        together = max(1, _FILTERED_AT_ONCE // max(len(flat), 1))
        for first in range(0, flat.shape[1], together):
            channels = np.ascontiguousarray(flat[:, first : first + together].T)
            out[:, first : first + together] = filtered(self.sections, channels, padlen=self.padding).T
        return out.reshape(values.shape)

    @cached_property
    def settling(self) -> int:
        """Samples after which earlier ones have no effect: the slowest mode has decayed to rounding."""
        slowest = max(float(np.max(np.abs(np.roots(section[3:])))) for section in self.sections)
        return math.ceil(math.log(_SETTLED) / math.log(slowest))

    @cached_property
    def impulse_response(self) -> FloatArray:
        """Response of the filter to a single sample of 1, (M,), with that sample in the middle."""
        reach = self.settling + self.padding
        impulse = np.zeros(2 * reach + 1)
        impulse[reach] = 1.0
        return self(impulse[:, None])[:, 0]

    @property
    def noise_share(self) -> float:
        """Share of the power of white noise that passes: equivalent noise bandwidth over half the sample rate."""
        return _noise_share(self.sections.tobytes())

    def gain(self, cycles: FloatArray) -> FloatArray:
        """Gain of amplitudes at frequencies (K,) [1/samples], for both passes together."""
        _, response = import_signal().sosfreqz(self.sections, worN=2.0 * np.pi * cycles)
        return np.asarray(np.square(np.abs(response)))


@cache  # takes 20 ms, and logs, or segments of one, mostly have one filter
def _noise_share(sections: bytes) -> float:
    """Of a filter, from its second-order sections."""
    _, response = import_signal().sosfreqz(np.frombuffer(sections).reshape(-1, 6), worN=_FREQUENCIES, whole=True)
    return float(np.mean(np.abs(response) ** 4))  # two passes, and power goes with the amplitude squared
