"""Measured and predicted forces over time, with errors against the noise, and the spectra of these errors."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from torchid.logs.low_pass import import_signal
from torchid.parameters import Array
from torchid.problem.metrics import BASE_ROWS
from torchid.report.figure_style import (
    CATEGORY_COLORS,
    IDENTIFIED_COLOR,
    MEASURED_COLOR,
    NOISE_COLOR,
    NOMINAL_COLOR,
    STYLE,
    WIDTH,
    draw_panels,
    label_decades,
    set_headline,
)

_NOISE = "0.8"
_MOST_ROWS = 6
_NEAR_0 = 0.1  # share of the time within which axes begin at 0
_OF_A_CLOCK = 100.0  # times as long as a log lasts: stamps that say when it was recorded, as since 1970
_SHOWN = 1.6  # errors are shown up to so many times the largest of the identified ones, or of the noise
_BINS = 1000  # of an envelope, each a minimum and a maximum
_MOST_SPANS = 300  # of contact states
_NAMED_STATES = 11  # in the legend
_CURVES = 4  # entries of the legend beside those
_LEGEND_ROW = 0.2  # inches
_GAP = 5.0  # median steps that are a gap
_SHORTEST = 64  # samples of a window of a spectrum
_LONGEST = 1024
_BEYOND = 2.0  # frequencies are shown up to so many times the band of the noise


@dataclass(frozen=True)
class ForceSeries:
    """Forces of one log for plotting.

    Attributes:
        source: what the log is called.
        time: (N,) [s].
        measured: (N, n_rows) [N, N m], NaN where unknown.
        nominal: predicted by the nominal parameters.
        identified: predicted by the identified parameters.
        noise: standard deviation that the noise of the readings gives the errors; None where unknown.
        pressure: (3, N, 3) [m], measured, nominal and identified centres of pressure; None without any.
        recovered: whether these are joint torques, predicted with the contact forces that fit best.
        states: names of the contact states.
        state: (N,), number of the contact state of each sample.
        rate: of the log [Hz], which may have more samples.
        bandwidth: up to which frequency there is noise [Hz].
    """

    source: str
    time: Array
    measured: Array
    nominal: Array
    identified: Array
    noise: Array | None = None
    pressure: Array | None = None
    recovered: bool = False
    states: tuple[str, ...] = ()
    state: np.ndarray | None = None
    rate: float = np.nan
    bandwidth: float = np.nan

    @property
    def known(self) -> bool:
        """Whether any force was measured in full; of legs that all stand on feet without sensors none is."""
        return bool(np.isfinite(self.measured).any())


def force_figure(
    series: ForceSeries,
    dof_names: Sequence[str],
    base_rows: int,
    sliding: Collection[str] = (),
    nominal_label: str = "URDF",
    rows: Sequence[int] | None = None,
) -> Figure:
    """Forces over time, and beside them their errors; colours behind them are contact states.

    `dof_names`, `base_rows` and `sliding` are those of the robot, `nominal_label` is its kind of file. `rows`: which;
    the largest if not given.
    """
    shown_rows = _largest(series, base_rows) if rows is None else rows
    names = {row: name_row(row, base_rows, dof_names, sliding) for row in shown_rows}
    known = int(np.isfinite(series.measured).any(axis=0).sum())
    kind = (
        "Joint torques, predicted with the contact forces that fit best" if series.recovered else "Generalized forces"
    )
    shown = f"; the {len(names)} largest of {known}" if rows is None and len(names) < known else ""
    return _figure(series, names, f"{kind}: {series.source}{shown}", nominal_label)


@matplotlib.rc_context(STYLE)
def _figure(series: ForceSeries, rows: Mapping[int, tuple[str, str]], title: str, nominal_label: str) -> Figure:
    """Some rows over time, by name and unit, and their errors."""
    series, since = _from_its_start(series)
    thin = _Thinned(series.time)
    spans = [] if series.state is None else _spans(series.time, series.state)
    lasted = [sum(end - start for start, end, number in spans if number == k) for k in range(len(series.states))]
    colored = np.argsort(lasted)[::-1][1:].tolist()  # the longest stays white
    colors = {k: CATEGORY_COLORS[place % len(CATEGORY_COLORS)] for place, k in enumerate(colored)}
    patches = [Patch(color=color, alpha=0.25, label=series.states[k]) for k, color in colors.items()][:_NAMED_STATES]
    columns = 3 if patches else 4  # of the legend
    legend = _LEGEND_ROW * -(-(_CURVES + len(patches)) // columns)
    size = WIDTH, 1.7 * max(len(rows), 1) + 0.8
    figure, axes = draw_panels(
        max(len(rows), 1), 2, size, bottom=0.5 + legend, down=0.36, sharex=True, width_ratios=(3, 2)
    )
    for (forces, errors), (row, (name, unit)) in zip(axes, rows.items(), strict=False):
        for values, color, width, label in (
            (series.measured, MEASURED_COLOR, 1.6, "measured"),
            (series.nominal, NOMINAL_COLOR, 1.0, f"predicted, {nominal_label}"),
            (series.identified, IDENTIFIED_COLOR, 1.0, "predicted, identified"),
        ):
            forces.plot(thin.time, thin(values[:, row]), color=color, linewidth=width, label=label)
        forces.set_title(name, loc="left", fontsize=9)
        forces.set_ylabel(f"[{unit}]")
        _draw_errors(errors, series, row, thin, unit, nominal_label)
        for axis in (forces, errors):
            for state, color in colors.items():
                stays = [(start, end - start) for start, end, number in spans if number == state]
                style: dict[str, Any] = {"color": color, "alpha": 0.25, "linewidth": 0.0, "zorder": 0}
                axis.broken_barh(stays, (0.0, 1.0), transform=axis.get_xaxis_transform(), **style)
    if rows:
        handles, labels = (a + b for a, b in zip(*(x.get_legend_handles_labels() for x in axes[0]), strict=True))
        labels += [str(patch.get_label()) for patch in patches]
        figure.legend([*handles, *patches], labels, loc="lower center", ncols=columns)
    for axis in axes[-1]:
        axis.set_xlabel(f"time{since} [s]" + "; gaps: samples left out" * thin.has_gaps)
    if len(series.time) and 0.0 <= series.time[0] < _NEAR_0 * series.time[-1]:
        axes[0, 0].set_xlim(left=0.0)
    set_headline(figure, f"{title} (left), and errors, predicted - measured (right)")
    return figure


def pressure_figure(points: ForceSeries, nominal_label: str = "URDF") -> Figure:
    """As `force_figure`, of centres of pressure from the base link's origin instead of forces."""
    rows = {0: ("along the base's x axis", "m"), 1: ("along the base's y axis", "m")}
    return _figure(points, rows, f"Centre of pressure from the base link's origin: {points.source}", nominal_label)


def _from_its_start(series: ForceSeries) -> tuple[ForceSeries, str]:
    """Forces over the time since the first sample where stamps are those of a clock, and a remark on it; else as is."""
    if not len(series.time) or series.time[0] < _OF_A_CLOCK * (series.time[-1] - series.time[0]):
        return series, ""
    return replace(series, time=series.time - series.time[0]), " since the first sample"


def _draw_errors(axis: Axes, series: ForceSeries, row: int, thin: _Thinned, unit: str, nominal_label: str) -> None:
    """Errors of both predictions; on the scale of the readings' noise, two standard deviations, where it is known."""
    nominal, identified = (x[:, row] - series.measured[:, row] for x in (series.nominal, series.identified))
    text = f"rms error: {nominal_label} {_rms(nominal):.3g}, identified {_rms(identified):.3g}"
    if series.noise is not None and np.isfinite(series.noise[:, row]).any():
        std = series.noise[:, row]
        label = "noise of the readings, ± 2 standard deviations"
        axis.fill_between(thin.time, -2.0 * thin(std), 2.0 * thin(std), color=_NOISE, linewidth=0, label=label)
        largest = max(float(np.nanmax(np.abs(identified), initial=0.0)), float(2.0 * np.nanmax(std)))
        if largest > 0.0:
            axis.set_ylim(-_SHOWN * largest, _SHOWN * largest)
        text += f", noise {_rms(std):.3g}"
    axis.plot(thin.time, thin(nominal), color=NOMINAL_COLOR, linewidth=0.8)
    axis.plot(thin.time, thin(identified), color=IDENTIFIED_COLOR, linewidth=0.8)
    axis.set_title(f"{text} {unit}", loc="left", fontsize=9)


def name_row(row: int, base_rows: int, dof_names: Sequence[str], sliding: Collection[str]) -> tuple[str, str]:
    """Name and unit of a row of the dynamics of a robot with such `sliding` joints."""
    if row < base_rows:
        return BASE_ROWS[row], "N" if row < min(base_rows, 3) else "N m"
    name = dof_names[row - base_rows]
    return name, "N" if name in sliding or name.endswith((".fx", ".fy", ".fz")) else "N m"


def _largest(series: ForceSeries, base_rows: int) -> list[int]:
    """The rows to plot, the largest by rms of the measured force; all of the base where no joint is known."""
    size = np.sqrt(np.nanmean(np.square(np.nan_to_num(series.measured)), axis=0))
    size[~np.isfinite(series.measured).any(axis=0)] = -1.0
    joints = sorted((row for row in range(base_rows, len(size)) if size[row] >= 0.0), key=lambda row: -size[row])
    base = list(range(base_rows))
    if base and joints:
        base = [max(rows, key=lambda row: size[row]) for rows in (range(3), range(3, 6))]
    base = [row for row in base if size[row] >= 0.0]
    return base + sorted(joints[: _MOST_ROWS - len(base)])


@matplotlib.rc_context(STYLE)
def spectrum_figure(
    series: ForceSeries,
    dof_names: Sequence[str],
    base_rows: int,
    sliding: Collection[str] = (),
    nominal_label: str = "URDF",
) -> Figure:
    """Amplitude densities of the errors, and that of the readings' noise."""
    names = {row: name_row(row, base_rows, dof_names, sliding) for row in _largest(series, base_rows)}
    spectra = {row: _spectrum(series, row, series.time - series.time[0]) for row in names}
    shown = {row: spectrum for row, spectrum in spectra.items() if spectrum is not None}
    rows = -(-max(len(shown), 1) // 3)
    size = WIDTH, 2.2 * rows + 0.8
    if not shown:
        figure = Figure(figsize=size)
        set_headline(figure, "Errors by frequency: the log has no segment that is long enough")
        return figure
    scales = {"xscale": "log", "yscale": "log"}
    figure, grid = draw_panels(rows, min(len(shown), 3), size, bottom=0.75, down=0.7, subplot_kw=scales)
    axes = grid.ravel()
    for axis, (row, spectrum) in zip(axes, shown.items(), strict=False):
        for density, color, label in (
            (spectrum.nominal, NOMINAL_COLOR, f"error, {nominal_label}"),
            (spectrum.identified, IDENTIFIED_COLOR, "error, identified"),
        ):
            axis.plot(spectrum.frequency, density, color=color, linewidth=1.2, label=label)
        if spectrum.noise is not None:
            band = [spectrum.frequency[0], series.bandwidth]
            axis.plot(band, [spectrum.noise] * 2, "--", color=NOISE_COLOR, label="noise of the readings")
        name, unit = names[row]
        axis.set_title(f"{name} [{unit}/√Hz]", loc="left", fontsize=9)
        axis.set_xlabel("frequency [Hz]")
        label_decades(axis.xaxis)
        label_decades(axis.yaxis)
    for axis in axes[len(shown) :]:
        axis.remove()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="lower center", ncols=3)
    noise = any(spectrum.noise is not None for spectrum in shown.values())
    remark = "; where they are above the noise, the model lacks something" if noise else ""
    set_headline(figure, f"Errors by frequency: {series.source}{remark}")
    return figure


def _rms(values: Array) -> float:
    """Of what is known, NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else np.nan


class _Thinned:
    """Envelopes of series over bins of time, which keep peaks, and gaps as NaN; short series stay as they are."""

    def __init__(self, time: Array) -> None:
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

    @property
    def has_gaps(self) -> bool:
        """Whether samples are missing."""
        return len(self._gaps) > 0

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
    first = np.append(0, changes + 1)
    last = np.append(changes, len(time) - 1)
    after = np.append(gap, True)[last]  # a stay lasts until the next sample, unless that is far
    end = time[np.where(after, last, np.minimum(last + 1, len(time) - 1))]
    order = np.sort(np.argsort(time[first] - end)[:_MOST_SPANS])
    return [(round(float(time[first[k]]), 4), round(float(end[k]), 4), int(state[first[k]])) for k in order]


@dataclass(frozen=True)
class _Spectrum:
    """Amplitude densities of both errors over frequency [Hz], and that of the noise."""

    frequency: Array
    nominal: Array
    identified: Array
    noise: float | None


def _spectrum(series: ForceSeries, row: int, time: Array) -> _Spectrum | None:
    """Amplitude densities in the longest segment without gaps; None if it is short."""
    errors = np.stack([series.nominal[:, row], series.identified[:, row]]) - series.measured[:, row]
    segment = _longest_segment(time, np.asarray(np.isfinite(errors).all(axis=0)))
    count = segment.stop - segment.start
    if count < _SHORTEST or not series.bandwidth > 0.0:
        return None
    rate = (count - 1) / (time[segment.stop - 1] - time[segment.start])
    window = int(np.clip(count // 4, _SHORTEST, _LONGEST))
    frequency, density = import_signal().welch(errors[:, segment], rate, nperseg=window)
    shown = (frequency > 0.0) & (frequency <= _BEYOND * series.bandwidth)
    noise = None if series.noise is None else _rms(series.noise[segment, row]) / float(np.sqrt(series.bandwidth))
    nominal, identified = np.sqrt(density[:, shown])
    return _Spectrum(frequency[shown], nominal, identified, noise if noise and np.isfinite(noise) else None)


def _longest_segment(time: Array, known: np.ndarray) -> slice:
    """Samples in a row that are known and without a gap."""
    steps = np.diff(time)
    breaks = np.append(steps > _GAP * np.median(steps), True) if len(steps) else np.ones(len(time), bool)
    best = slice(0, 0)
    start = 0
    for number in range(len(time)):
        if not known[number]:
            start = number + 1
        elif number + 1 - start > best.stop - best.start:
            best = slice(start, number + 1)
        if breaks[number]:
            start = number + 1
    return best
