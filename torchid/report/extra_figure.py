"""The figure of offsets, scales and terms of actuators."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.time_range import log_title
from torchid.report import palette
from torchid.report.figures import STYLE
from torchid.report.parameter_figure import INTERVAL

#: Rows of a panel (`parameters.json` has all), longest error bar over the largest value, and vertical
#: offsets for logs in one row.
_MAX_PANEL_ROWS, _MAX_ERROR_RATIO, _LANES = 40, 4, 5


@matplotlib.rc_context(STYLE)
def extra_figure(extras: Sequence[ExtraEstimate]) -> Figure:
    """Extra parameters: a panel for each unit, a row for each, a point for each log with its 95 % interval.

    Hollow points are confounded with other parameters.
    """
    units = list(dict.fromkeys(x.extra.unit for x in extras))
    logs = list(dict.fromkeys(x.log for x in extras))
    rows = {
        unit: list(dict.fromkeys(x.extra.label for x in extras if x.extra.unit == unit))[:_MAX_PANEL_ROWS]
        for unit in units
    }
    height = 1.2 + 0.24 * sum(map(len, rows.values())) + 0.6 * len(units)
    figure = Figure(figsize=(9.0, max(height, 2.4)), layout="constrained")
    heights = [len(rows[unit]) + 1 for unit in units]
    axes = figure.subplots(len(units), 1, squeeze=False, gridspec_kw={"height_ratios": heights})
    chosen = [color for color in palette.CATEGORIES[::-1] if color != palette.NOMINAL]
    colors = {log: chosen[number % len(chosen)] for number, log in enumerate(logs)}
    for axis, unit in zip(axes[:, 0], units, strict=True):
        in_panel = [x for x in extras if x.extra.unit == unit and x.extra.label in rows[unit]]
        _draw_panel(axis, in_panel, rows[unit], colors)
        kinds = {x.extra.what for x in in_panel}
        named = f"{kinds.pop()} " if len(kinds) == 1 else ""
        axis.set_xlabel(f"{named}[{unit.replace('^2', '²')}]" if unit != "1" else "scale less 1 [1]")
    axes[0, 0].set_title("95 % intervals; hollow: confounded with other parameters", loc="left", fontsize=8)
    # made by hand: a log need not have a point in every panel, nor a filled one
    keys = [Line2D([], [], marker="o", linestyle="", color=color) for color in colors.values()]
    names = [log_title(log) or "all logs" for log in logs]
    if names != ["all logs"]:
        figure.legend(keys, names, loc="outside upper right", ncols=min(len(logs), 4))
    return figure


def _draw_panel(axis: Axes, extras: Sequence[ExtraEstimate], rows: Sequence[str], colors: Mapping[str, str]) -> None:
    """Values with their intervals; the logs of a row have vertical offsets around its middle."""
    longest = _MAX_ERROR_RATIO * max(abs(x.value) for x in extras) or 1.0
    for number, log in enumerate(logs := [log for log in colors if any(x.log == log for x in extras)]):
        points = [x for x in extras if x.log == log]
        offset = 0.15 * (number % _LANES - (min(len(logs), _LANES) - 1) / 2)
        values, index = [x.value for x in points], [rows.index(x.extra.label) + offset for x in points]
        error = [
            min(INTERVAL * x.standard_error, longest) if math.isfinite(x.standard_error) else longest for x in points
        ]
        axis.errorbar(values, index, xerr=error, fmt="none", ecolor=colors[log], elinewidth=1.0)
        faces = [colors[log] if x.separable else "white" for x in points]
        axis.scatter(values, index, c=faces, edgecolors=colors[log], s=22, zorder=3)
    axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    axis.set_yticks(range(len(rows)), rows, fontsize=8)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    _leave_room(axis, extras, rows)


def _leave_room(axis: Axes, extras: Sequence[ExtraEstimate], rows: Sequence[str]) -> None:
    """Cut the axis off where confounded values would leave those that are known no room; an arrow has what is cut."""
    bars = [(x.value, INTERVAL * x.standard_error) for x in extras if x.separable and math.isfinite(x.standard_error)]
    low, high = min((v - e for v, e in bars), default=0.0), max((v + e for v, e in bars), default=0.0)
    low, high = min(low, 0.0), max(high, 0.0)
    left, right = axis.get_xlim()
    if not high > low or right - left <= _MAX_ERROR_RATIO * (high - low):
        return
    margin = 0.3 * (high - low)
    axis.set_xlim(low - margin, high + margin)
    for x in extras:
        if not low - margin <= x.value <= high + margin:
            left_side = x.value < low
            text = f"◂ {x.value:.2g}" if left_side else f"{x.value:.2g} ▸"
            place = 0.005 if left_side else 0.995, rows.index(x.extra.label)
            where = axis.get_yaxis_transform()
            axis.text(*place, text, transform=where, ha="left" if left_side else "right", va="bottom", fontsize=7)
