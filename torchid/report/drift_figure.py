"""The figure of how far a replayed robot drifts from a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from torchid.fitting.calibration import Comparison
from torchid.parameters import Array
from torchid.report import palette
from torchid.report.figures import STYLE, label_decades


@matplotlib.rc_context(STYLE)
def drift_figure(
    source: str,
    time: Array,
    quartiles: Mapping[str, Comparison[Array]],
    by_joint: Mapping[str, Comparison[float]],
    units: Sequence[str],
    of: str,
) -> Figure:
    """Drift over the time since the beginning of a window, median and quartiles, and at its end by joint.

    On logarithmic axes, as robots that spin and those that hardly drift are compared.

    Args:
        source: name of the log.
        time: (T,) [s].
        quartiles: (3, T) each, over windows, by what drifts, with its unit.
        by_joint: at the end of the windows.
        units: of the joints, "rad" or "m".
        of: what the robot's file is.
    """
    tall = max(0.22 * len(by_joint) + 1.4, 1.9 * len(quartiles) + 0.8)
    figure = Figure(figsize=(11.0, tall), layout="constrained")
    grid = figure.add_gridspec(len(quartiles), 2, width_ratios=(1.0, 1.1))
    for row, (name, (nominal, identified)) in enumerate(quartiles.items()):
        axis = figure.add_subplot(grid[row, 0])
        for label, color, (low, middle, high) in (
            (of, palette.NOMINAL, nominal),
            ("identified", palette.IDENTIFIED, identified),
        ):
            axis.fill_between(time, low, high, color=color, alpha=0.2, linewidth=0.0)
            axis.plot(time, middle, color=color, label=label)
        if min(nominal.min(), identified.min()) > 0.0:
            axis.set_yscale("log")
            label_decades(axis.yaxis)
        axis.set_ylabel(f"drift, {name}")
        axis.set_xlim(0.0, float(time[-1]))
    axis.set_xlabel("time since the beginning of a window [s]")
    joints = figure.add_subplot(grid[:, 1])
    rows = np.arange(len(by_joint))
    nominal, identified = (
        np.array([getattr(pair, x) for pair in by_joint.values()]) for x in ("nominal", "identified")
    )
    for color, values in ((palette.NOMINAL, nominal), (palette.IDENTIFIED, identified)):
        joints.plot(values, rows, "o", color=color)
    if min(nominal.min(), identified.min()) > 0.0:
        joints.set_xscale("log")
        label_decades(joints.xaxis)
    joints.set_yticks(rows, list(by_joint))
    joints.invert_yaxis()
    joints.set_xlabel(f"median drift after {time[-1]:g} s [{', '.join(dict.fromkeys(units))}]")
    figure.suptitle(
        f"Drift of a robot driven by the torques of {source}: median of windows, and quartiles", x=0.01, ha="left"
    )
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
