"""Figures that compare parameter vectors: forces over time, and errors as bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from torchid.parameters import Array
from torchid.report.figures import STYLE

_COLORS = ("tab:orange", "tab:blue", "tab:green", "tab:red", "tab:purple", "tab:gray")


@dataclass(frozen=True)
class Panel:
    """One force over time, (N,), and what every parameter vector predicts."""

    name: str
    unit: str
    true: Array
    predicted: Mapping[str, Array]


@dataclass(frozen=True)
class Bars:
    """Errors of one group of rows: median, least and greatest by parameter vector, as shares."""

    name: str
    heights: Mapping[str, tuple[float, float, float]]


@matplotlib.rc_context(STYLE)
def panel_figure(title: str, time: Array, panels: Sequence[Panel]) -> Figure:
    """Forces on the left, errors of the predictions on the right, one row per panel; time in [s]."""
    figure = Figure(figsize=(10.0, 1.9 * len(panels) + 0.9), layout="constrained")
    axes = figure.subplots(len(panels), 2, sharex=True, squeeze=False)
    for (left, right), panel in zip(axes, panels, strict=True):
        left.plot(time, panel.true, color="black", linewidth=2.0, label="true")
        for (name, predicted), color in zip(panel.predicted.items(), _COLORS, strict=False):
            left.plot(time, predicted, color=color, linewidth=1.0, label=name)
            right.plot(time, predicted - panel.true, color=color, linewidth=1.0)
        left.set_title(panel.name, loc="left", fontsize=9)
        right.set_title("error", loc="left", fontsize=9)
        left.set_ylabel(f"[{panel.unit}]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.suptitle(title, x=0.01, ha="left")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    return figure


@matplotlib.rc_context(STYLE)
def bar_figure(title: str, groups: Sequence[Bars]) -> Figure:
    """Errors as bars on a logarithmic scale, one panel per group of rows; lines from the least to the greatest."""
    figure = Figure(figsize=(2.5 * len(groups) + 0.6, 3.4), layout="constrained")
    axes = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axis, group in zip(axes, groups, strict=True):
        place = np.arange(len(group.heights))
        median, least, greatest = 100.0 * np.array(list(group.heights.values())).T
        axis.bar(place, median, 0.7, color=[*_COLORS[: len(place) - 1], "black"])
        axis.errorbar(place, median, yerr=[median - least, greatest - median], fmt="none", ecolor="0.4", capsize=3)
        for x, y, top in zip(place, median, greatest, strict=True):
            axis.annotate(f"{y:.2g}", (x, top), (0, 2), textcoords="offset points", ha="center", fontsize=7)
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(LogFormatter())  # the default writes formulas, which names forbid, see STYLE
        axis.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False))
        axis.margins(y=0.15)
        axis.set_xticks(place, list(group.heights), rotation=40, ha="right")
        axis.set_title(group.name, loc="left", fontsize=9)
    axes[0].set_ylabel("rms of error / rms of measured [%]")
    figure.suptitle(title, x=0.01, ha="left")
    return figure
