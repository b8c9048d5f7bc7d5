"""Forces of a whole log in few points for a page: envelopes, contact states over time, spectra of errors."""

from __future__ import annotations

import base64
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchid.parameters import Array
from torchid.report.forces import ForceSeries, largest_rows, name_row

_BINS = 1000  # of an envelope, each a minimum and a maximum
_MOST_ROWS = 6
_MOST_SPANS = 300  # of contact states
_GAP = 5.0  # median steps that are a gap
_SHORTEST, _LONGEST = 64, 1024  # samples of a window of a spectrum
_BEYOND = 2.0  # frequencies are shown up to so many times the band of the noise


@dataclass(frozen=True)
class LogForces:
    """Forces of a log from its first to its last sample.

    Attributes:
        recorded: as the sensors read them.
        projected: in the rows of the fit, where nothing unmeasured is left; its noise is that of the fit's weights.
        states: names of the contact states.
        state: (N,), number of each sample's.
        step: every so many samples of the log are here.
        bandwidth: up to which frequency there is noise [Hz].
    """

    recorded: ForceSeries
    projected: ForceSeries
    states: tuple[str, ...]
    state: np.ndarray
    step: int
    bandwidth: float


def traces_document(
    forces: LogForces, base_rows: int, dof_names: Sequence[str], sliding: Collection[str] = ()
) -> dict[str, Any]:
    """The largest rows, thinned to what a figure can show, for JSON; time is from the first sample [s].

    Args:
        forces: of a log.
        base_rows: of the robot.
        dof_names: likewise.
        sliding: likewise.
    """
    time = forces.recorded.time - forces.recorded.time[0]
    thin = _Thinned(time)
    kinds = {"recorded": forces.recorded, "projected": forces.projected}
    panels = {
        kind: [
            {"row": row} | dict(zip(("name", "unit"), name_row(row, base_rows, dof_names, sliding), strict=True))
            | _panel(series, row, thin) | {"spectrum": _spectrum(series, row, time, forces.bandwidth)}
            for row in largest_rows(series, base_rows, _MOST_ROWS)
        ]
        for kind, series in kinds.items()
    }  # fmt: skip
    return {
        "source": forces.recorded.source,
        "samples": len(time),
        "step": forces.step,
        "seconds": float(time[-1]),
        "time": packed(thin.time),
        "states": {"names": list(forces.states), "spans": _spans(time, forces.state)},
        **panels,
    }


def packed(values: Array) -> dict[str, str]:
    """Numbers as Plotly's typed arrays, which may hold NaN."""
    return {"dtype": "f4", "bdata": base64.b64encode(values.astype("<f4").tobytes()).decode()}


def _panel(series: ForceSeries, row: int, thin: _Thinned) -> dict[str, Any]:
    """One row: forces and errors, with the rms of these and of the noise."""
    measured, nominal, identified = (x[:, row] for x in (series.measured, series.nominal, series.identified))
    known = {} if series.noise is None else {"noise": series.noise[:, row]}
    errors = {"nominal_error": nominal - measured, "identified_error": identified - measured}
    lines = {"measured": measured, "nominal": nominal, "identified": identified} | errors
    return {
        "lines": {name: packed(thin(values)) for name, values in lines.items()},
        "rms": {name: _rms(values) for name, values in (errors | known).items()},
    }


def _rms(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else None


class _Thinned:
    """Envelopes of series over bins of time, which keep peaks, and gaps as NaN; short series stay as they are."""

    def __init__(self, time: Array) -> None:
        """Set the stamps (N,) [s]."""
        steps = np.diff(time)
        self._gaps = np.flatnonzero(steps > _GAP * np.median(steps)) + 1 if len(steps) else np.empty(0, int)
        self._starts: np.ndarray | None = None
        if len(time) <= 2 * _BINS:
            self.time = np.insert(time, self._gaps, np.nan)
            return
        edges = np.linspace(time[0], time[-1], _BINS + 1)
        starts = np.searchsorted(time, edges[:-1])
        self._filled = np.diff(np.append(starts, len(time))) > 0
        self._starts = starts[self._filled]
        width = edges[1] - edges[0]
        self.time = (edges[:-1, None] + width * np.array([0.25, 0.75])).ravel()

    def __call__(self, values: Array) -> Array:
        """The points of a series (N,): of each bin the least and the largest, in the order in which it goes."""
        if self._starts is None:
            return np.insert(values, self._gaps, np.nan)
        least, most = (extreme.reduceat(values, self._starts) for extreme in (np.fmin, np.fmax))
        last = np.append(self._starts[1:], len(values)) - 1
        falls = values[last] < values[self._starts]
        out = np.full((_BINS, 2), np.nan)
        out[self._filled] = np.where(falls[:, None], np.stack([most, least], 1), np.stack([least, most], 1))
        return out.ravel()


def _spans(time: Array, state: np.ndarray) -> list[tuple[float, float, int]]:
    """Start and end [s] of each stay in a contact state, and its number; short ones are left out of many."""
    steps = np.diff(time)
    gap = steps > _GAP * np.median(steps) if len(steps) else np.zeros(0, bool)
    changes = np.flatnonzero((np.diff(state) != 0) | gap)
    first, last = np.append(0, changes + 1), np.append(changes, len(time) - 1)
    after = np.append(gap, True)[last]  # a stay lasts until the next sample, unless that is far
    end = time[np.where(after, last, np.minimum(last + 1, len(time) - 1))]
    order = np.sort(np.argsort(time[first] - end)[:_MOST_SPANS])
    return [(round(float(time[first[k]]), 4), round(float(end[k]), 4), int(state[first[k]])) for k in order]


def _spectrum(series: ForceSeries, row: int, time: Array, bandwidth: float) -> dict[str, Any] | None:
    """Amplitude density of both errors in the longest segment without gaps, and that of the noise; None if short."""
    errors = np.stack([series.nominal[:, row], series.identified[:, row]]) - series.measured[:, row]
    segment = _longest_segment(time, np.asarray(np.isfinite(errors).all(axis=0)))
    count = segment.stop - segment.start
    if count < _SHORTEST or not bandwidth > 0.0:
        return None
    rate = (count - 1) / (time[segment.stop - 1] - time[segment.start])
    from scipy.signal import welch  # takes 0.1 s, which commands that draw nothing need not

    window = int(np.clip(count // 4, _SHORTEST, _LONGEST))
    frequency, density = welch(errors[:, segment], rate, nperseg=window)
    shown = (frequency > 0.0) & (frequency <= _BEYOND * bandwidth)
    noise = None if series.noise is None else _rms(series.noise[segment, row])
    return {
        "frequency": packed(frequency[shown]),
        "nominal": packed(np.sqrt(density[0, shown])),
        "identified": packed(np.sqrt(density[1, shown])),
        "noise": None if noise is None else noise / float(np.sqrt(bandwidth)),
        "band": [float(frequency[1]), bandwidth],
    }


def _longest_segment(time: Array, known: np.ndarray) -> slice:
    """Samples in a row that are known and without a gap."""
    steps = np.diff(time)
    breaks = np.append(steps > _GAP * np.median(steps), True) if len(steps) else np.ones(len(time), bool)
    best, start = slice(0, 0), 0
    for number in range(len(time)):
        if not known[number]:
            start = number + 1
        elif number + 1 - start > best.stop - best.start:
            best = slice(start, number + 1)
        if breaks[number]:
            start = number + 1
    return best
