"""Offsets and scales of sensors and terms of actuators, in one picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchid.analysis.calibration import ExtraEstimate
from torchid.report.figures import STYLE

_ROWS = 40  # in a panel; the rest is in parameters.json
_MOST = 4  # standard errors beyond this many times the largest value are cut off
_LANES = 5  # logs side by side in a row; more start again at its top


@matplotlib.rc_context(STYLE)
def extra_figure(found: Sequence[ExtraEstimate]) -> Figure:
    """A panel for each unit, a row for each unknown, a point for each log with its 95 % interval.

    Hollow points cannot be told from other unknowns.
    """
    units = list(dict.fromkeys(x.extra.unit for x in found))
    logs = list(dict.fromkeys(x.log for x in found))
    rows = {unit: list(dict.fromkeys(x.extra.label for x in found if x.extra.unit == unit))[:_ROWS] for unit in units}
    height = 1.2 + 0.24 * sum(map(len, rows.values())) + 0.6 * len(units)
    figure = Figure(figsize=(9.0, max(height, 2.4)), layout="constrained")
    heights = [len(rows[unit]) + 1 for unit in units]
    axes = figure.subplots(len(units), 1, squeeze=False, gridspec_kw={"height_ratios": heights})
    colors = {log: f"C{number}" for number, log in enumerate(logs)}
    for axis, unit in zip(axes[:, 0], units, strict=True):
        shown = [x for x in found if x.extra.unit == unit and x.extra.label in rows[unit]]
        _draw_panel(axis, shown, rows[unit], colors)
        axis.set_xlabel(f"[{unit}]" if unit != "1" else "scale less 1 [1]")
    axes[0, 0].set_title("95 % intervals; hollow: not told from other unknowns", loc="left", fontsize=8)
    # of all panels, and never hollow: a log need not have a point in every one of them
    keys = [Line2D([], [], marker="o", linestyle="", color=color) for color in colors.values()]
    names = [Path(log).name or "all logs" for log in logs]
    figure.legend(keys, names, loc="outside upper right", ncols=min(len(logs), 4))
    return figure


def _draw_panel(axis: Axes, found: Sequence[ExtraEstimate], rows: Sequence[str], colors: Mapping[str, str]) -> None:
    """Values with their intervals, the logs of a row below each other around its middle."""
    reach = _MOST * max(abs(x.value) for x in found) or 1.0
    logs = [log for log in colors if any(x.log == log for x in found)]
    for number, log in enumerate(logs):
        points = [x for x in found if x.log == log]
        below = 0.15 * (number % _LANES - (min(len(logs), _LANES) - 1) / 2)
        values, place = [x.value for x in points], [rows.index(x.extra.label) + below for x in points]
        error = [min(1.96 * x.standard_error, reach) if math.isfinite(x.standard_error) else reach for x in points]
        axis.errorbar(values, place, xerr=error, fmt="none", ecolor=colors[log], elinewidth=1.0)
        fill = [colors[log] if x.told_apart else "white" for x in points]
        axis.scatter(values, place, c=fill, edgecolors=colors[log], s=22, zorder=3)
    axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    axis.set_yticks(range(len(rows)), rows, fontsize=8)
    axis.set_ylim(len(rows) - 0.5, -0.5)
