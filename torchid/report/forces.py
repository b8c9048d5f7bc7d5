"""The figure of measured and predicted forces, and of errors against the noise that no model predicts."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchid.parameters import Array
from torchid.problem.metrics import BASE_ROWS
from torchid.report.figure_style import IDENTIFIED_COLOR, MEASURED_COLOR, NOMINAL_COLOR, STYLE

_NOISE = "0.8"
_MOST_ROWS = 6
_NEAR_0 = 0.1  # share of the time within which axes begin at 0
_OF_A_CLOCK = 100.0  # times as long as a log lasts: stamps that say when it was recorded, as since 1970
_SHOWN = 1.6  # errors are shown up to so many times the largest of the identified ones, or of the noise


@dataclass(frozen=True)
class ForceSeries:
    """Forces of one log for plotting: `measured`, `nominal`, `identified`, (N, n_rows) each, NaN where unknown.

    `noise`, (N, n_rows): standard deviation that the noise of the readings gives the measured; None where unknown.
    """

    source: str
    time: Array
    measured: Array
    nominal: Array
    identified: Array
    noise: Array | None = None


@matplotlib.rc_context(STYLE)
def force_figure(
    series: ForceSeries, dof_names: Sequence[str], base_rows: int, sliding: Collection[str] = (), of: str = "URDF"
) -> Figure:
    """Forces over time, and beside them their errors: the largest base force and moment, then the largest others.

    `dof_names`, `base_rows` and `sliding` are those of the robot, `of` is what its nominal parameters are from.
    """
    rows = largest_rows(series, base_rows, _MOST_ROWS)
    series, since = _from_its_start(series)
    figure = Figure(figsize=(12.0, 1.7 * max(len(rows), 1) + 0.8), layout="constrained")
    axes = figure.subplots(max(len(rows), 1), 2, sharex=True, squeeze=False, width_ratios=(3, 2))
    for (forces, errors), row in zip(axes, rows, strict=False):
        forces.plot(series.time, series.measured[:, row], color=MEASURED_COLOR, linewidth=1.6, label="measured")
        forces.plot(series.time, series.nominal[:, row], color=NOMINAL_COLOR, linewidth=1.0, label=f"predicted, {of}")
        label = "predicted, identified"
        forces.plot(series.time, series.identified[:, row], color=IDENTIFIED_COLOR, linewidth=1.0, label=label)
        name, unit = name_row(row, base_rows, dof_names, sliding)
        forces.set_title(name, loc="left", fontsize=9)
        forces.set_ylabel(f"[{unit}]")
        _draw_errors(errors, series, row, f"[{unit}]")
    if rows:
        handles, labels = (a + b for a, b in zip(*(x.get_legend_handles_labels() for x in axes[0]), strict=True))
        figure.legend(handles, labels, loc="outside lower center", ncols=4)
    for axis in axes[-1]:
        axis.set_xlabel(f"time{since} [s]")
    if len(series.time) and 0.0 <= series.time[0] < _NEAR_0 * series.time[-1]:
        axes[0, 0].set_xlim(left=0.0)
    figure.suptitle(f"Generalized forces, {series.source}, and errors: predicted - measured", x=0.01, ha="left")
    return figure


def _from_its_start(series: ForceSeries) -> tuple[ForceSeries, str]:
    """Forces over the time since the first sample where stamps are those of a clock, and a remark on it; else as is."""
    if not len(series.time) or series.time[0] < _OF_A_CLOCK * (series.time[-1] - series.time[0]):
        return series, ""
    return replace(series, time=series.time - series.time[0]), " since the first sample"


def _draw_errors(axis: Axes, series: ForceSeries, row: int, unit: str) -> None:
    """Errors of both predictions, with the noise of the readings as a band of two standard deviations."""
    nominal, identified = (x[:, row] - series.measured[:, row] for x in (series.nominal, series.identified))
    largest = float(np.nanmax(np.abs(identified), initial=0.0))
    text = ""
    if series.noise is not None and np.isfinite(series.noise[:, row]).any():
        std = series.noise[:, row]
        label = "± 2 standard deviations of the readings' noise"
        axis.fill_between(series.time, -2.0 * std, 2.0 * std, color=_NOISE, linewidth=0, label=label)
        largest = max(largest, float(2.0 * np.nanmax(std)))
        text = f", noise alone {np.sqrt(np.nanmean(std**2)):.3g}"
    axis.plot(series.time, nominal, color=NOMINAL_COLOR, linewidth=0.8)
    axis.plot(series.time, identified, color=IDENTIFIED_COLOR, linewidth=0.8)
    if largest > 0.0:
        axis.set_ylim(-_SHOWN * largest, _SHOWN * largest)
    rms = np.sqrt(np.nanmean(np.square(identified))) if np.isfinite(identified).any() else np.nan
    axis.set_title(f"identified: rms {rms:.3g}{text} {unit}", loc="left", fontsize=9)


def name_row(row: int, base_rows: int, dof_names: Sequence[str], sliding: Collection[str]) -> tuple[str, str]:
    """Name and unit of a row of the dynamics of a robot with such `sliding` joints."""
    if row < base_rows:
        return BASE_ROWS[row], "N" if row < min(base_rows, 3) else "N m"
    name = dof_names[row - base_rows]
    return name, "N" if name in sliding or name.endswith((".fx", ".fy", ".fz")) else "N m"


def largest_rows(series: ForceSeries, base_rows: int, max_rows: int) -> list[int]:
    """Numbers of the rows to plot: by rms of the measured force."""
    size = np.sqrt(np.nanmean(np.square(np.nan_to_num(series.measured)), axis=0))
    size[~np.isfinite(series.measured).any(axis=0)] = -1.0
    base = [max(rows, key=lambda row: size[row]) for rows in (range(3), range(3, 6))] if base_rows else []
    base = [row for row in base if size[row] >= 0.0]
    joints = sorted((row for row in range(base_rows, len(size)) if size[row] >= 0.0), key=lambda row: -size[row])
    return base + sorted(joints[: max_rows - len(base)])
