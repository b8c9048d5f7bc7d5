"""Bring the topics of a bag to the stamps of one of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchid.errors import LogError, TorchidWarning
from torchid.logs.checks import unit_quaternion
from torchid.logs.fields import FloatArray, is_quaternion
from torchid.logs.plan import LONGEST_STEP
from torchid.logs.quaternion import sign_continuous
from torchid.logs.ros.series import Series, Stamps
from torchid.logs.spline import spline_derivatives


@dataclass(frozen=True, eq=False)
class Clock:
    """The stamps (N,) [ns] of a log: those of one topic within the time that all topics cover."""

    source: str
    stamps: Stamps

    @property
    def time(self) -> FloatArray:
        """Stamps (N,) [s], counted from the first: since 1970 a float64 would tell no less than 0.2 us apart."""
        return self.seconds(self.stamps)

    def seconds(self, stamps: Stamps) -> FloatArray:
        """Other stamps (K,) [ns] in seconds of this clock."""
        return (stamps - self.stamps[0]) / 1e9

    def aligned(self, series: Series) -> dict[str, FloatArray]:
        """The fields of a topic at the log's stamps: as they are where it has these, by a quintic spline elsewhere.

        Quaternions are interpolated as in `preprocess`, component by component without sign flips, then normalised.
        What is NaN throughout stays so; what is NaN in part becomes NaN throughout.

        Raises:
            LogError: too long a gap in a topic that has to be interpolated.

        Warns:
            TorchidWarning: a field is NaN in part.
        """
        first, last = np.searchsorted(series.stamps, self.stamps[[0, -1]])
        if np.array_equal(series.stamps[first : last + 1], self.stamps):
            return {name: values[first : last + 1] for name, values in series.fields.items()}
        run = self._unbroken(series)
        return {name: self._interpolated(series, run, name) for name in series.fields}

    def held(self, series: Series, values: FloatArray) -> FloatArray:
        """Values (K, ...) of a topic as they were last said, (N, ...)."""
        return np.asarray(values[np.searchsorted(series.stamps, self.stamps, side="right") - 1])

    def _unbroken(self, series: Series) -> slice:
        """The samples around the log's time without a gap across which an interpolation would invent what happened."""
        steps = np.diff(series.stamps)
        long = np.flatnonzero(steps > LONGEST_STEP * np.median(steps)) if len(steps) else steps
        inside = long[(series.stamps[long + 1] > self.stamps[0]) & (series.stamps[long] < self.stamps[-1])]
        if len(inside):
            step, median = steps[inside[0]] / 1e9, np.median(steps) / 1e9
            at = self.seconds(series.stamps[inside])[0]
            found = f"a gap of {step:.4g} s from {at:.4g} s on, where the median step is {median:.4g} s"
            accepted = f"steps of at most {LONGEST_STEP:g} median steps: cut the bag there"
            raise LogError(self.source, series.topic, found, accepted)
        before, after = np.searchsorted(series.stamps[long], self.stamps[[0, -1]])
        start = int(long[before - 1]) + 1 if before else 0
        return slice(start, int(long[after]) + 1 if after < len(long) else len(series.stamps))

    def _interpolated(self, series: Series, run: slice, name: str) -> FloatArray:
        values, stamps = series.fields[name][run], self.seconds(series.stamps[run])
        if is_quaternion(name):
            quat = sign_continuous(unit_quaternion(self.source, f"{series.topic}: {name}", values))
            quat = spline_derivatives(stamps, quat, self.time, (0,))[0]
            return np.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True))
        gaps = np.isnan(values).any(axis=0)
        if gaps.any() and not np.isnan(values[:, gaps]).all():
            message = f"{self.source}: {series.topic}: NaN in part of {name}: NaN throughout after interpolation"
            warnings.warn(message, TorchidWarning, stacklevel=6)
        out = np.full((len(self.stamps), values.shape[1]), np.nan)
        out[:, ~gaps] = spline_derivatives(stamps, values[:, ~gaps], self.time, (0,))[0]
        return out


def clock_of(source: str, rate: Series, others: Mapping[str, Series], events: Mapping[str, Series]) -> Clock:
    """The stamps of the topic `rate` within the time that all topics cover.

    Args:
        source: the bag.
        rate: whose stamps the log takes.
        others: sampled topics, by role.
        events: topics of which a message holds until the next.

    Raises:
        LogError: there are none.
    """
    everyone = {**others, **events}
    start = max(series.stamps[0] for series in everyone.values())
    stop = min(series.stamps[-1] for series in others.values())
    stamps = rate.stamps[(rate.stamps >= start) & (rate.stamps <= stop)]
    if not len(stamps):
        late = max(everyone.values(), key=lambda series: int(series.stamps[0]))
        early = min(others.values(), key=lambda series: int(series.stamps[-1]))
        found = (
            f"{late.topic} starts at {late.stamps[0] / 1e9:.3f} s, {early.topic} ends at {early.stamps[-1] / 1e9:.3f} s"
        )
        raise LogError(source, "time", f"no stamp of {rate.topic} that all topics cover: {found}", "one common clock")
    return Clock(source, stamps)
