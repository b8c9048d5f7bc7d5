"""Series with stamps of their own at the common stamps of a log: topics of a bag, files of one recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchid.errors import LogError, warn_about_file
from torchid.logs.log import FloatArray, is_quaternion, normalize_quaternions
from torchid.logs.quaternion import make_sign_continuous
from torchid.logs.timeline import JITTER, LONGEST_STEP, spline_derivatives


@dataclass(frozen=True, eq=False)
class Series:
    """Fields of a log (K, ...) with stamps (K,) [s], strictly increasing, counted as those of the log.

    `name`: of the topic, "" for what messages name already. `whole`: what it is a part of, "bag" or "file".
    """

    name: str
    stamps: FloatArray
    fields: Mapping[str, FloatArray]
    whole: str

    def _field(self, field: str) -> str:
        return f"{self.name}: {field}" if self.name else field

    def at(self, time: FloatArray) -> dict[str, FloatArray]:
        """The fields at stamps (N,) [s] that the series covers: unchanged for equal stamps, else by a quintic spline.

        Quaternions are interpolated as in `preprocess`, component by component without sign flips, then normalised.
        A channel with any NaN becomes NaN throughout.

        Raises:
            LogError: too long a gap in a series that must be interpolated.

        Warns:
            TorchidWarning: a field is NaN in some samples.
        """
        same = self.same_stamps(time)
        if same is not None:
            return {name: values[same] for name, values in self.fields.items()}
        run = self._unbroken(time)
        return {name: self._interpolated(time, run, name) for name in self.fields}

    def hold(self, values: NDArray[np.float64], time: FloatArray) -> FloatArray:
        """The last values (K, ...) of the series before each stamp, (N, ...)."""
        return np.asarray(values[np.searchsorted(self.stamps, time + stamp_slack(time), side="right") - 1])

    def same_stamps(self, time: FloatArray) -> slice | None:
        """The samples that have the stamps (N,) [s]; None where others are needed."""
        slack = stamp_slack(time)
        first = int(np.searchsorted(self.stamps, time[0] - slack))
        last = int(np.searchsorted(self.stamps, time[-1] + slack, side="right"))
        stamps = self.stamps[first:last]
        same = len(stamps) == len(time) and bool(np.all(np.abs(stamps - time) <= slack))
        return slice(first, last) if same else None

    def _unbroken(self, time: FloatArray) -> slice:
        """The samples around the log's time, checked for gaps that are too long to be interpolated."""
        steps = np.diff(self.stamps)
        long = np.flatnonzero(steps > LONGEST_STEP * np.median(steps)) if len(steps) else steps.astype(np.intp)
        inside = long[(self.stamps[long + 1] > time[0]) & (self.stamps[long] < time[-1])]
        if len(inside):
            found = (
                f"a gap of {steps[inside[0]]:.4g} s from {self.stamps[inside[0]]:.4g} s on, "
                f"where the median step is {np.median(steps):.4g} s"
            )
            accepted = f"steps of at most {LONGEST_STEP:g} median steps: cut the {self.whole} there"
            raise LogError.at_field(self.name or "time", found, accepted)
        before, after = np.searchsorted(self.stamps[long], time[[0, -1]])
        start = int(long[before - 1]) + 1 if before else 0
        return slice(start, int(long[after]) + 1 if after < len(long) else len(self.stamps))

    def _interpolated(self, time: FloatArray, run: slice, name: str) -> FloatArray:
        values, stamps = self.fields[name][run], self.stamps[run]
        if is_quaternion(name):
            quat = make_sign_continuous(normalize_quaternions(self._field(name), values))
            quat = spline_derivatives(stamps, quat, time, (0,))[0]
            return np.asarray(quat / np.linalg.norm(quat, axis=1, keepdims=True))
        gaps = np.isnan(values).any(axis=0)
        if gaps.any() and not np.isnan(values[:, gaps]).all():
            where = f"{self.name}: NaN in part of {name}" if self.name else f"{name}: NaN in part of it"
            warn_about_file(f"{where}: NaN throughout after interpolation")
        out = np.full((len(time), *values.shape[1:]), np.nan)
        out[:, ~gaps] = spline_derivatives(stamps, values[:, ~gaps], time, (0,))[0]
        return out


def stamp_slack(time: FloatArray) -> float:
    """By how much two stamps may differ [s] that are one, but for rounding."""
    return JITTER * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
