"""The figure of how a ridge was chosen: error on held-out folds against ridge."""

from __future__ import annotations

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from torchid.fitting.cross_validation import RidgeChoice
from torchid.report import palette
from torchid.report.figures import STYLE, decade, label_decades

_CURVE, _CHOSEN, _LEAST = palette.IDENTIFIED, palette.NOMINAL, "0.3"
_WIDE = 5.0  # ratio of errors from which on decades tell more than differences


@matplotlib.rc_context(STYLE)
def ridge_figure(choice: RidgeChoice, of: str = "URDF") -> Figure:
    """Mean square of whitened residuals on held-out folds by ridge, on logarithmic axes.

    The band is a standard error of the difference from the least, fold by fold, on either side; ridges where it reaches
    down to the least are shaded: the data hardly tell them from the chosen one. Ridges of 0 have no place on the axis.
    """
    tried, mean, error = (np.array(x) for x in (choice.tried, choice.mean_square, choice.standard_error))
    least = float(mean.min())
    within = (mean - error <= least) & (tried > 0.0)
    shown = tried > 0.0
    figure = Figure(figsize=(6.4, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    if mean.max() > _WIDE * max(least, np.finfo(float).tiny):
        axes.set_yscale("log")
    low = mean - error if axes.get_yscale() == "linear" else np.maximum(mean - error, 0.5 * least)
    band = axes.fill_between(tried[shown], low[shown], (mean + error)[shown], color=_CURVE, alpha=0.25, linewidth=0)
    (curve,) = axes.plot(tried[shown], mean[shown], "o-", color=_CURVE, markersize=4)
    line = axes.axhline(least, color=_LEAST, linewidth=1.0, linestyle="--")
    handles = [curve, band, line]
    labels = ["held-out folds", "± a standard error of the difference from the least", f"least: {least:.4g}"]
    if within.any():
        edge = np.sqrt(10.0)
        handles.append(
            axes.axvspan(tried[within].min() / edge, tried[within].max() * edge, color="0.9", zorder=0, linewidth=0)
        )
        labels.append("within a standard error of the least")
    if choice.ridge > 0.0:
        at = float(mean[list(choice.tried).index(choice.ridge)])
        (marker,) = axes.plot(choice.ridge, at, "D", color=_CHOSEN, markersize=8, markerfacecolor="none")
        handles.append(marker)
        what = "chosen" if choice.rule == "least" else "chosen, the largest of these"
        labels.append(f"{what}: {choice.ridge:g}, {at:.4g}")
    axes.set_xticks(tried[shown], [decade(ridge) for ridge in tried[shown]])
    axes.minorticks_off()
    if axes.get_yscale() == "log":
        label_decades(axes.yaxis)
    axes.set_xlim(tried[shown].min() / 2.0, tried[shown].max() * 2.0)
    axes.set_xlabel(f"ridge: weight of the {of} against the mean square of the rows [1]")
    axes.set_ylabel("mean square of whitened residuals\non held-out folds [noise²]")
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)
    figure.suptitle("Ridge by cross-validation", x=0.01, ha="left")
    return figure
