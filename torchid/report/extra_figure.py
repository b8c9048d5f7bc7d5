"""Offsets and scales of sensors and terms of actuators, in one picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from torchid.analysis.calibration import ExtraEstimate
from torchid.report.figures import STYLE

_ROWS = 40  # in a panel; the rest is in parameters.json
_MOST = 4  # standard errors beyond this many times the largest value are cut off


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
    for axis, unit in zip(axes[:, 0], units, strict=True):
        of_unit = [x for x in found if x.extra.unit == unit and x.extra.label in rows[unit]]
        reach = _MOST * max(abs(x.value) for x in of_unit) or 1.0
        for number, log in enumerate(logs):
            points = [x for x in of_unit if x.log == log]
            if not points:
                continue
            place = [rows[unit].index(x.extra.label) + 0.15 * (number % 5) for x in points]
            error = [min(1.96 * x.standard_error, reach) if math.isfinite(x.standard_error) else reach for x in points]
            color = f"C{number}"
            axis.errorbar([x.value for x in points], place, xerr=error, fmt="none", ecolor=color, elinewidth=1.0)
            fill = [color if x.told_apart else "white" for x in points]
            axis.scatter([x.value for x in points], place, c=fill, edgecolors=color, s=22, zorder=3,
                         label=Path(log).name or "all logs")  # fmt: skip
        axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
        axis.set_yticks(range(len(rows[unit])), rows[unit], fontsize=8)
        axis.invert_yaxis()
        axis.set_xlabel(f"[{unit}]" if unit != "1" else "scale less 1 [1]")
    axes[0, 0].set_title("95 % intervals; hollow: not told from other unknowns", loc="left", fontsize=8)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=min(len(logs), 4))
    return figure
