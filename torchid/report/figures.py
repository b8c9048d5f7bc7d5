"""Figures of a run (the only module that imports matplotlib)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from torchid import parameters
from torchid.errors import during
from torchid.parameters import Array
from torchid.report.metrics import BASE_ROWS, SHOWN, Metrics, group_name
from torchid.text import escaped

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "text.parse_math": False,  # names may hold dollar signs
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.3,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def save_figure(figure: Figure, path: Path, kind: str | None = None) -> None:
    """Write a figure as a file, its texts without control characters.

    In the same style as it was made, for labels of ticks are made now, and may hold dollar signs as well.
    """
    with during("drawing", path), matplotlib.rc_context(STYLE):
        for text in figure.findobj(Text):
            text.set_text(escaped(text.get_text(), "\n"))
        figure.savefig(path, dpi=130, format=kind)


_MEASURED, _NOMINAL, _IDENTIFIED = "black", "tab:orange", "tab:blue"


@dataclass(frozen=True)
class ForceSeries:
    """Forces of one log for plotting: `measured` (N, nv), `nominal` and `identified` (N, nv), NaN where unknown."""

    source: str
    time: Array
    measured: Array
    nominal: Array
    identified: Array


@matplotlib.rc_context(STYLE)
def force_figure(series: ForceSeries, dof_names: Sequence[str], base_rows: int, most: int = 6) -> Figure:
    """Measured and predicted forces over time: the largest base force and moment, then the largest of the others."""
    rows = _rows_to_show(series, base_rows, most)
    figure = Figure(figsize=(9.0, 1.7 * max(len(rows), 1) + 0.8), layout="constrained")
    axes = figure.subplots(max(len(rows), 1), 1, sharex=True, squeeze=False)[:, 0]
    for axis, row in zip(axes, rows, strict=False):
        axis.plot(series.time, series.measured[:, row], color=_MEASURED, linewidth=1.6, label="measured")
        axis.plot(series.time, series.nominal[:, row], color=_NOMINAL, linewidth=1.0, label="predicted, URDF")
        axis.plot(
            series.time, series.identified[:, row], color=_IDENTIFIED, linewidth=1.0, label="predicted, identified"
        )
        name = BASE_ROWS[row] if row < base_rows else dof_names[row - base_rows]
        force = row < min(base_rows, 3) or name.endswith((".fx", ".fy", ".fz"))
        axis.set_title(name, loc="left", fontsize=9)
        axis.set_ylabel("[N]" if force else "[N m]")
    if rows:
        axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(f"Generalized forces, {series.source}", x=0.01, ha="left")
    return figure


def _rows_to_show(series: ForceSeries, base_rows: int, most: int) -> list[int]:
    size = np.sqrt(np.nanmean(np.square(np.nan_to_num(series.measured)), axis=0))
    size[~np.isfinite(series.measured).any(axis=0)] = -1.0
    base = [max(rows, key=lambda row: size[row]) for rows in (range(3), range(3, 6))] if base_rows else []
    base = [row for row in base if size[row] >= 0.0]
    joints = sorted((row for row in range(base_rows, len(size)) if size[row] >= 0.0), key=lambda row: -size[row])
    return base + sorted(joints[: most - len(base)])


@matplotlib.rc_context(STYLE)
def error_figure(sets: Mapping[str, tuple[Metrics, Metrics]]) -> Figure:
    """Relative error by group of rows, URDF against identified, one panel per set of logs."""
    figure = Figure(figsize=(4.2 * len(sets) + 0.6, 3.2), layout="constrained")
    axes = figure.subplots(1, len(sets), sharey=True, squeeze=False)[0]
    for axis, (name, (nominal, identified)) in zip(axes, sets.items(), strict=True):
        groups = [group for group in SHOWN if nominal.relative.get(group) is not None]
        place = np.arange(len(groups))
        for shift, metrics, color, label in (
            (-0.2, nominal, _NOMINAL, "URDF"),
            (0.2, identified, _IDENTIFIED, "identified"),
        ):
            heights = [100.0 * (metrics.relative.get(group) or 0.0) for group in groups]
            bars = axis.bar(place + shift, heights, 0.38, color=color, label=label)
            axis.bar_label(bars, fmt="%.3g", fontsize=8)
        axis.set_xticks(place, [group_name(group).replace(" ", "\n") for group in groups])
        axis.set_title(name, loc="left")
    axes[0].set_ylabel("rms of error / rms of measured [%]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


@matplotlib.rc_context(STYLE)
def parameter_figure(body_names: Sequence[str], nominal: Array, identified: Array, standard_error: Array) -> Figure:
    """Mass, first moment and inertia of every body with mass; bars on the masses the data determine: standard error."""
    shown = np.flatnonzero(nominal[:, parameters.INERTIAL].any(axis=1))
    nominal, identified, standard_error = nominal[shown], identified[shown], standard_error[shown]
    place = np.arange(len(shown))
    figure = Figure(figsize=(9.0, 0.24 * len(shown) + 1.4), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    mass = parameters.MASS
    error = np.nan_to_num(standard_error[:, mass])
    for axis, quantity, unit in zip(axes, _QUANTITIES, ("kg", "kg m", "kg m²"), strict=True):
        before, after = (_QUANTITIES[quantity](phi) for phi in (nominal, identified))
        axis.barh(place - 0.2, before, 0.38, color=_NOMINAL, label="URDF")
        axis.barh(place + 0.2, after, 0.38, color=_IDENTIFIED, label="identified")
        if unit == "kg":
            axis.errorbar(after, place + 0.2, xerr=error, fmt="none", ecolor="black", elinewidth=0.8)
        axis.set_xlabel(f"{quantity} [{unit}]")
    axes[0].set_yticks(place, [body_names[int(body)] for body in shown], fontsize=7)
    axes[0].set_ylim(len(shown) - 0.4, -0.6)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


_QUANTITIES = {
    "mass": lambda phi: phi[:, parameters.MASS],
    "first moment, length": lambda phi: np.linalg.norm(phi[:, parameters.FIRST_MOMENT], axis=1),
    "inertia about origin, trace": lambda phi: np.trace(parameters.inertia_matrix(phi), axis1=1, axis2=2),
}


@matplotlib.rc_context(STYLE)
def contribution_figure(groups: Mapping[str, Sequence[tuple[str, float]]], most: int = 20) -> Figure:
    """Bits that would be lost without each member of some groups, by name, those with most first."""
    shown = {group: sorted(found, key=lambda pair: -pair[1])[:most] for group, found in groups.items() if found}
    counts = [len(found) for found in shown.values()]
    figure = Figure(figsize=(9.0, 0.24 * sum(counts) + 0.6 * len(shown) + 0.6), layout="constrained")
    axes = figure.subplots(len(shown), 1, squeeze=False, height_ratios=[count + 0.8 for count in counts])[:, 0]
    for axis, (group, found) in zip(axes, shown.items(), strict=True):
        names, bits = zip(*found, strict=True)
        bars = axis.barh(range(len(found)), bits, 0.7, color=_IDENTIFIED)
        axis.bar_label(bars, fmt="%.3g", fontsize=8, padding=2)
        axis.set_yticks(range(len(found)), [fill(name, 60) for name in names], fontsize=7)
        axis.set_ylim(len(found) - 0.4, -0.6)
        axis.grid(visible=False, axis="y")
        hidden = len(groups[group]) - len(found)
        axis.set_title(group + (f", {hidden} more not shown" if hidden else ""), loc="left", fontsize=9)
    axes[-1].set_xlabel("information lost without it [bits]")
    return figure
