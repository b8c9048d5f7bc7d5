"""Figures of a run and of a robot's tree; style of all figures."""

from __future__ import annotations

import io
import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from torchid.errors import during, escape
from torchid.estimators import Estimate
from torchid.estimators.least_squares import FIXED
from torchid.fitting.calibration import Comparison
from torchid.parameters import PARAMETERS, PER_BODY, WRENCH_COMPONENTS
from torchid.problem import Metrics
from torchid.problem.metrics import ERROR_GROUPS, group_name
from torchid.report import palette
from torchid.report.tables import MARKS, marks_legend
from torchid.robot import Robot
from torchid.robot.tree import BodyJoint
from torchid.sensing import Contact

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "text.parse_math": False,  # names may hold dollar signs
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.alpha": 0.3,
    "axes.titley": 1.0,  # looked for above the ticks, it takes an eighth of the time
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "pdf.fonttype": 42,  # letters that editors keep and journals accept
    "svg.hashsalt": "torchid",  # the same figure is the same file
}
#: Up to which power of ten axes have plain numbers, and how far off a power rounding is.
_PLAIN_DECADES, _ROUNDING = 3.0, 1e-9
_FEW_DECADES = 1e3  # span of an axis on which 2 and 5 are labelled, too
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_FLOOR = "noise of the readings alone"
_MOST_BARS = 20  # of a kind of contributions
#: 5 % larger than with the usual 6, in two thirds of the time.
_COMPRESSION = 3
#: Dates in files, without which the same run writes the same files.
_DATES = {"pdf": "CreationDate", "svg": "Date"}
#: Colors of sensors and links in the tree, and its column width, row height and legend width [inches].
_TORQUE, _WRENCH, _LIMB, _PLAIN, _LOADED = palette.IDENTIFIED, "#009e73", "#cc79a7", "0.75", "0.3"
_COLUMN, _ROW, _LEGEND = 2.1, 0.3, 7.4

Position = tuple[float, int]
"""Column and row in the figure of a tree."""


def save_figure(figure: Figure, path: Path, kind: str | None = None) -> None:
    """Write a figure to a file, see `figure_bytes`."""
    with during("drawing", path):
        path.write_bytes(figure_bytes(figure, (kind or path.suffix[1:]).lower()))


def figure_bytes(figure: Figure, form: str) -> bytes:
    """A figure as the content of a file of type "png", "pdf" or "svg", with control characters in its texts escaped.

    The style is that of the figure: matplotlib creates tick labels only now, and they may contain dollar signs.
    """
    content = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        for text in figure.findobj(Text):
            text.set_text(escape(text.get_text(), "\n"))
        figure.set_dpi(130)
        if form == "png":
            canvas = FigureCanvasAgg(figure)  # `savefig` draws all of it twice, once for the layout
            canvas.print_png(content, pil_kwargs={"compress_level": _COMPRESSION})
        else:
            figure.savefig(content, format=form, metadata={_DATES[form]: None})
    return content.getvalue()


def save_figures(figures: Mapping[str, Figure], folder: Path, form: str) -> None:
    """Write figures by name, in the format of that extension."""
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.{form}")


@dataclass(frozen=True)
class Drawn:
    """A figure as the content of its file, and as PNG."""

    file: bytes
    png: bytes


def draw_for(path: Path, make: Callable[[], Figure]) -> Drawn:
    """A figure that a function makes, for a file of a type by its extension."""
    with during("drawing", path):
        figure, form = make(), path.suffix[1:]
        file = figure_bytes(figure, form)
        return Drawn(file, file if form == "png" else figure_bytes(figure, "png"))


def decade(value: float) -> str:
    """A power of ten as axes show it; what matplotlib writes is a formula, which names forbid (`STYLE`)."""
    exponent = math.log10(value)
    if abs(exponent) <= _PLAIN_DECADES or abs(exponent - round(exponent)) > _ROUNDING:
        return f"{value:g}"
    return "10" + str(round(exponent)).translate(_SUPERSCRIPTS)


def _decade_formatter() -> FuncFormatter:
    """Of the ticks of a logarithmic axis."""
    return FuncFormatter(lambda value, _: decade(value))


def label_decades(axis: Axis) -> None:
    """Label 1, 2 and 5 of each power of ten of a logarithmic axis, however little of one it spans."""
    low, high = sorted(axis.get_view_interval())
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _FEW_DECADES * low else (1.0,)))
    axis.set_major_formatter(_decade_formatter())
    axis.set_minor_formatter(NullFormatter())


# ---------------------------------------------------------------------------------------------------- errors


@matplotlib.rc_context(STYLE)
def error_figure(sets: Mapping[str, Comparison[Metrics]], of: str = "URDF") -> Figure:
    """Relative error by group of rows, nominal (`of` what) against identified, one panel per set of logs."""
    figure = Figure(figsize=(4.2 * len(sets) + 0.6, 3.2), layout="constrained")
    axes = figure.subplots(1, len(sets), sharey=True, squeeze=False)[0]
    for axis, (name, (nominal, identified)) in zip(axes, sets.items(), strict=True):
        groups = [group for group in ERROR_GROUPS if nominal.relative.get(group) is not None]
        index = np.arange(len(groups))
        pairs = ((-0.2, nominal, palette.NOMINAL, of), (0.2, identified, palette.IDENTIFIED, "identified"))
        for shift, metrics, color, label in pairs:
            heights = [100.0 * (metrics.relative.get(group) or 0.0) for group in groups]
            bars = axis.bar(index + shift, heights, 0.38, color=color, label=label)
            axis.bar_label(bars, fmt=_percent, fontsize=8)
        _draw_noise(axis, identified, groups)
        axis.margins(y=0.1)
        axis.set_xticks(index, [group_name(group).replace(" ", "\n") for group in groups])
        axis.set_title(name, loc="left")
    axes[0].set_ylabel("rms of error / rms of measured [%]")
    by_label = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    labels = sorted(by_label, key=lambda label: label == _FLOOR)
    figure.legend([by_label[label] for label in labels], labels, loc="outside upper right", ncols=3)
    return figure


def _percent(value: float) -> str:
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def _draw_noise(axis: Axes, metrics: Metrics, groups: Sequence[str]) -> None:
    """A line across both bars of a group, at the error that noise of the readings leaves, where it is known."""
    for place, group in enumerate(groups):
        noise, rms, relative = (x.get(group) for x in (metrics.noise, metrics.rms, metrics.relative))
        if noise and rms and relative:
            axis.hlines(100.0 * noise * relative / rms, place - 0.4, place + 0.4, colors=palette.MEASURED, label=_FLOOR)


# ----------------------------------------------------------------------------------------------------- identifiability


@matplotlib.rc_context(STYLE | {"axes.grid": False})
def identifiability_figure(body_names: Sequence[str], estimate: Estimate) -> Figure:
    """Share of the data in every parameter, with the mark of its verdict, and the singular values of the problem."""
    verdicts = estimate.verdict.reshape(-1, PER_BODY)
    shown = np.flatnonzero((verdicts != FIXED).any(axis=1))
    free = np.flatnonzero((verdicts != FIXED).any(axis=0))
    share = estimate.data_share.reshape(-1, PER_BODY)[np.ix_(shown, free)]
    figure = Figure(figsize=(11.0, 0.24 * len(shown) + 1.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.9, 1.0])
    image = left.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for row, body in enumerate(shown):
        for column, verdict in enumerate(verdicts[body, free]):
            color = "white" if share[row, column] > 0.6 else "black"
            left.text(column, row, MARKS[verdict], ha="center", va="center", fontsize=8, color=color, in_layout=False)
    left.set_xticks(range(len(free)), [PARAMETERS[int(k)] for k in free], fontsize=7)
    left.set_yticks(range(len(shown)), [body_names[int(body)] for body in shown], fontsize=7)
    left.set_title(marks_legend(), loc="left", fontsize=8)
    figure.colorbar(image, ax=left, label="share of the data", pad=0.01)
    values = estimate.singular_values
    right.semilogy(np.arange(1, len(values) + 1), values, ".", color=palette.IDENTIFIED, markersize=4)
    right.yaxis.set_major_formatter(_decade_formatter())
    right.axvline(estimate.rank + 0.5, color="0.5", linewidth=0.8)
    right.set_title(f"singular values, rank {estimate.rank}", loc="left", fontsize=8)
    right.set_xlabel("number")
    right.set_ylabel("singular value [standard deviations per scale]", labelpad=12)
    right.grid(visible=True)
    return figure


@matplotlib.rc_context(STYLE)
def contribution_figure(groups: Mapping[str, Sequence[tuple[str, float]]]) -> Figure:
    """Bits lost without each log, contact state or sensor, by group: pairs of name and bits, the largest first.

    Groups of one are left out if there are others.
    """
    several = {group: pairs for group, pairs in groups.items() if len(pairs) > 1}  # one alone has all that there is
    shown = {
        group: sorted(pairs, key=lambda pair: -pair[1])[:_MOST_BARS]
        for group, pairs in (several or groups).items()
        if pairs
    }
    counts = [len(pairs) for pairs in shown.values()]
    figure = Figure(figsize=(9.0, 0.24 * sum(counts) + 0.6 * len(shown) + 0.6), layout="constrained")
    axes = figure.subplots(len(shown), 1, squeeze=False, height_ratios=[count + 0.8 for count in counts])[:, 0]
    for axis, (group, pairs) in zip(axes, shown.items(), strict=True):
        names, bits = zip(*pairs, strict=True)
        bars = axis.barh(range(len(pairs)), bits, 0.7, color=palette.IDENTIFIED)
        axis.bar_label(bars, fmt="%.3g", fontsize=8, padding=2)
        axis.set_yticks(range(len(pairs)), [fill(name, 60) for name in names], fontsize=7)
        axis.set_ylim(len(pairs) - 0.4, -0.6)
        axis.grid(visible=False, axis="y")
        hidden = len(groups[group]) - len(pairs)
        axis.set_title(group + (f", {hidden} more not shown" if hidden else ""), loc="left", fontsize=9)
    axes[-1].set_xlabel("information lost without it [bits]")
    return figure


# ------------------------------------------------------------------------------------- tree of a robot with its sensors


@matplotlib.rc_context(STYLE | {"axes.grid": False})
def tree_figure(
    title: str,
    robot: Robot,
    contacts: Sequence[Contact],
    measured: Collection[str],
    wrenches: Mapping[str, Sequence[str]],
    constrained: Collection[str],
) -> Figure:
    """The tree from the base downward, one column per limb.

    Args:
        title: of the figure.
        robot: the robot.
        contacts: those of the scenario.
        measured: names of measured readings, of the robot's `dof_names`.
        wrenches: measured components by contact frame.
        constrained: joints between the base and a contact.
    """
    constrained = {*constrained, *_loaded_welds(robot, contacts)}
    positions = _body_positions(robot, contacts)
    contact_positions = _contact_positions(robot, contacts, positions)
    right = max(x for x, _ in positions)
    deepest = max(y for _, y in [*positions, *contact_positions.values()])
    size = max(_COLUMN * (right + 1.0), _LEGEND) + 0.2, _ROW * (deepest + 1) + 1.3
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    for body, link in enumerate(robot.bodies):
        if link.joint is not None:
            _draw_joint(axes, link.joint, positions[link.parent], positions[body], measured, constrained)
    for contact in contacts:
        body, _ = robot.link(contact.frame)
        position = contact_positions[contact.frame]
        _draw_contact(axes, contact, positions[body], position, wrenches.get(contact.frame, ()))
    axes.plot(*positions[0], "s", color="black", markersize=9)
    _label(axes, robot.body_names[0], positions[0], fontsize=8)
    axes.set(xlim=(-0.15, right + 0.95), ylim=(deepest + 0.6, -0.6))
    axes.axis("off")
    figure.suptitle(title, x=0.01, ha="left")
    figure.legend(handles=_legend(bool(robot.ft_names)), loc="outside lower left", ncols=5, fontsize=7.5)
    return figure


def _loaded_welds(robot: Robot, contacts: Sequence[Contact]) -> set[str]:
    """Fixed joints that can carry a sensor, between the base and a contact."""
    welds = set()
    for contact in contacts:
        body, _ = robot.link(contact.frame)
        while (joint := robot.bodies[body].joint) is not None:
            welds |= {joint.name} & set(robot.ft_names)
            body = joint.parent
    return welds


def _body_positions(robot: Robot, contacts: Sequence[Contact]) -> list[Position]:
    """Position of every body: leaves side by side, other bodies above their contacts, centred over their children."""
    contact_count = Counter(robot.link(contact.frame)[0] for contact in contacts)
    children, row = robot.children, [0] * len(robot.bodies)
    for body, link in enumerate(robot.bodies[1:], start=1):
        row[body] = row[link.parent] + 1 + contact_count[link.parent]
    column, free = [0.0] * len(robot.bodies), 0
    for body in reversed(range(len(robot.bodies))):  # children come after their parents
        if children[body]:
            column[body] = 0.5 * (column[children[body][0]] + column[children[body][-1]])
        else:
            column[body], free = float(free), free + 1
    return [(max(column) - x, y) for x, y in zip(column, row, strict=True)]


def _contact_positions(robot: Robot, contacts: Sequence[Contact], bodies: Sequence[Position]) -> dict[str, Position]:
    """Positions of contacts, one below the other under their body."""
    positions: dict[str, Position] = {}
    count: Counter[int] = Counter()
    for contact in contacts:
        body, _ = robot.link(contact.frame)
        count[body] += 1
        column, row = bodies[body]
        positions[contact.frame] = (column, row + count[body])
    return positions


def _draw_joint(
    axes: Axes,
    joint: BodyJoint,
    parent: Position,
    position: Position,
    readings: Collection[str],
    constrained: Collection[str],
) -> None:
    name = joint.name if joint.mimic is None else joint.mimic.master
    weld = [k for k in WRENCH_COMPONENTS if f"{name}.{k}" in readings] if joint.kind == "fixed" else []
    loaded, measured = name in constrained, bool(weld) or name in readings
    (x, y), bend = position, parent[1] + 0.5
    style: dict[str, Any] = {"color": _LOADED if loaded else _PLAIN, "linewidth": 2.2 if loaded else 1.4, "zorder": 0}
    axes.plot([parent[0], parent[0], x, x], [parent[1], bend, bend, y], **style)
    color, part = _LIMB if weld else _TORQUE, 0 < len(weld) < len(WRENCH_COMPONENTS)
    face = color if measured else "white"
    style = {"color": color if measured else "0.5", "markerfacecolor": face, "fillstyle": "left" if part else "full"}
    axes.plot(x, y, "h" if joint.kind == "fixed" else "o", markersize=8 if joint.kind == "fixed" else 7, **style)
    label = joint.name if joint.mimic is None else f"{joint.name} (follows)"
    label += f": {', '.join(weld)}" if part else ""
    _label(axes, label, position, measured, fontsize=6.5, color="black" if measured or loaded else "0.45")


def _label(axes: Axes, text: str, position: Position, bold: bool = False, **style: Any) -> None:
    weight = "bold" if bold else "normal"
    axes.annotate(text, position, (8, 0), textcoords="offset points", va="center", fontweight=weight, **style)


def _draw_contact(axes: Axes, contact: Contact, body: Position, position: Position, measured: Sequence[str]) -> None:
    axes.plot([position[0], position[0]], [body[1], position[1]], color=_LOADED, linewidth=2.2, zorder=0)
    part = bool(measured) and not set(measured) >= set(contact.component_names)
    color, face = (_WRENCH, _WRENCH) if measured else ("0.5", "white")
    axes.plot(*position, "D", color=color, markerfacecolor=face, fillstyle="left" if part else "full", markersize=8)
    components = f": {', '.join(measured)}" if part else ""
    _label(axes, f"{contact.frame} ({contact.kind}){components}", position, bool(measured), fontsize=7)


def _legend(welds: bool) -> list[Line2D]:
    def marker(shape: str, color: str, face: str, label: str) -> Line2D:
        return Line2D([], [], marker=shape, color=color, markerfacecolor=face, linestyle="none", label=label)

    in_limbs = [marker("h", _LIMB, _LIMB, "sensor in a limb"), marker("h", "0.5", "white", "weld without")]
    return [
        marker("o", _TORQUE, _TORQUE, "joint torque measured"),
        marker("o", "0.5", "white", "not measured"),
        marker("D", _WRENCH, _WRENCH, "contact sensor"),
        marker("D", "0.5", "white", "contact without"),
        Line2D([], [], color=_LOADED, linewidth=2.2, label="constrained by contacts"),
        *(in_limbs if welds else []),
    ]
