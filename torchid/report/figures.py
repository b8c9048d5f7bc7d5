"""Figures of a run: of its parameters, how its ridge was chosen, its replay, and a robot's tree."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch

from torchid import parameters
from torchid.errors import format_percent
from torchid.estimators import Estimate
from torchid.estimators.least_squares import FIXED, IDENTIFIED, UNOBSERVABLE
from torchid.fitting.fit import Comparison
from torchid.fitting.left_out import RidgeChoice
from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.time_range import log_title
from torchid.parameters import INERTIAL, PARAMETERS, PER_BODY, WRENCH_COMPONENTS, Array
from torchid.problem import Metrics
from torchid.problem.metrics import ERROR_GROUPS, WHITENED, group_name
from torchid.report.figure_style import (
    CATEGORY_COLORS,
    IDENTIFIED_COLOR,
    MEASURED_COLOR,
    NOMINAL_COLOR,
    STYLE,
    WIDTH,
    decade,
    label_decades,
    label_ticks,
)
from torchid.report.tables import MARKS, marks_legend
from torchid.robot import Robot
from torchid.robot.tree import BodyJoint
from torchid.sensing import Contact

INTERVAL = 1.96
"""Standard errors on either side of a 95 % interval."""

_IMPOSSIBLE = "x "  # before the name of a body
_SINGLE = {"m": "mass [kg]", "fc": "Coulomb friction", "fv": "viscous friction"}
_UNITS = {"revolute": {"fc": "N m", "fv": "N m s/rad"}, "prismatic": {"fc": "N", "fv": "N s/m"}}
_DERIVED: dict[str, Callable[[Array], Array]] = {
    "first moment, length [kg m]": lambda phi: np.linalg.norm(phi[:, parameters.FIRST_MOMENT], axis=1),
    "inertia about origin, trace [kg m²]": lambda phi: np.trace(parameters.inertia_matrix(phi), axis1=1, axis2=2),
}


@matplotlib.rc_context(STYLE)
def parameter_figure(
    body_names: Sequence[str],
    nominal: Array,
    estimate: Estimate,
    kinds: Collection[str] = ("revolute", "prismatic"),
    nominal_label: str = "URDF",
) -> Figure:
    """Mass, first moment, inertia and friction of the bodies that the data say something about.

    Filled points are identified and have their 95 % intervals; hollow ones are known only in sums with others, or
    mostly the URDF's. Negative values, and names of bodies that are not physically consistent, have a cross.

    Args:
        body_names: of all bodies.
        nominal: (L, 12), the URDF's parameters.
        estimate: the fit.
        kinds: of the robot's joints, which friction has the unit of.
        nominal_label: what the nominal parameters are from.
    """
    verdict = estimate.verdict.reshape(-1, PER_BODY)
    shown, columns = _determined(verdict)
    before, after, errors = (x.reshape(-1, PER_BODY)[shown] for x in (nominal, estimate.phi, estimate.standard_error))
    known = (verdict[shown] == IDENTIFIED) & np.isfinite(errors)
    single = [name for name in _SINGLE if PARAMETERS.index(name) in columns]
    titles = [_title("m", kinds), *_DERIVED, *(_title(name, kinds) for name in single if name != "m")]
    figure = Figure(figsize=(WIDTH, 0.24 * len(shown) + 1.7), layout="constrained")
    axes = dict(zip(titles, figure.subplots(1, len(titles), sharey=True, squeeze=False)[0], strict=True))
    for name in single:
        k = PARAMETERS.index(name)
        free = verdict[shown][:, k] != FIXED
        bars = np.where(known[:, k], INTERVAL * errors[:, k], np.nan)
        urdf, identified = (np.where(free, x[:, k], np.nan) for x in (before, after))
        _draw(axes[_title(name, kinds)], urdf, identified, known[:, k], bars)
    for title, quantity in _DERIVED.items():
        _draw(axes[title], quantity(before), quantity(after), known[:, INERTIAL].all(axis=1), None)
    for title, axis in axes.items():
        axis.set_xlabel(title)
        axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    impossible = (after[:, parameters.MASS] <= 0.0) & before[:, INERTIAL].any(axis=1)
    impossible |= parameters.consistency_margin(after) < parameters.POSSIBLE_MARGIN
    names = [(_IMPOSSIBLE if bad else "") + body_names[int(k)] for k, bad in zip(shown, impossible, strict=True)]
    first = axes[titles[0]]
    label_ticks(first.yaxis, range(len(shown)), names)
    first.set_ylim(len(shown) - 0.4, -0.6)
    figure.suptitle("Parameters of the bodies", x=0.01, ha="left")
    handles = _legend(first, nominal_label, bool(known.any()), bool(impossible.any()))
    figure.legend(handles=handles, loc="outside upper right", ncols=4)
    return figure


def _determined(verdict: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bodies, and columns of parameters, that the data say something about; all if they say nothing.

    `verdict`: (L, 12).
    """
    seen = ~np.isin(verdict, (FIXED, UNOBSERVABLE))
    if not seen.any():
        seen = verdict != FIXED
    return np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))


def _title(name: str, kinds: Collection[str]) -> str:
    units = [by_name[name] for kind, by_name in _UNITS.items() if kind in kinds and name in by_name]
    return f"{_SINGLE[name]} [{' or '.join(units)}]" if units else _SINGLE[name]


def _draw(axis: Axes, before: Array, after: Array, known: np.ndarray, bars: Array | None) -> None:
    """The URDF's values and the identified, some with error bars, one row for each body."""
    rows = np.arange(len(before))
    axis.plot(before, rows - 0.16, "D", markerfacecolor="none", color=NOMINAL_COLOR, markersize=4.5)
    if bars is not None:
        axis.errorbar(after, rows + 0.16, xerr=bars, fmt="none", ecolor=IDENTIFIED_COLOR, elinewidth=1.1, capsize=2)
    for chosen, face in ((known, IDENTIFIED_COLOR), (~known, "white")):
        real = chosen & (after >= 0.0)
        axis.plot(
            after[real], rows[real] + 0.16, "o", markerfacecolor=face, color=IDENTIFIED_COLOR, markersize=5, zorder=3
        )
    negative = after < 0.0
    axis.plot(after[negative], rows[negative] + 0.16, "X", color=MEASURED_COLOR, markersize=6, zorder=3)


def _legend(axis: Axes, nominal_label: str, known: bool, impossible: bool) -> list[matplotlib.artist.Artist]:
    """Handles with labels, drawn outside of what is seen."""
    kinds = [("D", NOMINAL_COLOR, "none", nominal_label)]
    if known:
        kinds.append(("o", IDENTIFIED_COLOR, IDENTIFIED_COLOR, "identified, 95 % interval"))
    kinds.append(("o", IDENTIFIED_COLOR, "white", f"known only in sums, or mostly the {nominal_label}'s"))
    if impossible:
        kinds.append(("X", MEASURED_COLOR, MEASURED_COLOR, "not physically consistent"))
    return [
        axis.plot([], [], mark, color=color, markerfacecolor=face, label=label)[0] for mark, color, face, label in kinds
    ]


_MAX_PANEL_ROWS = 40  # `parameters.json` has all
_MAX_SIZE_RATIO = 4  # end of the axis, over the median of the ends of the intervals
_ENDLESS = 1e3  # longest error bar of all, over this
_MARGIN = 0.05  # beside the bars, as a share of the panel
_LANES = 5  # vertical offsets of logs in one row


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
    figure = Figure(figsize=(WIDTH, max(height, 2.4)), layout="constrained")
    heights = [len(rows[unit]) + 1 for unit in units]
    axes = figure.subplots(len(units), 1, squeeze=False, gridspec_kw={"height_ratios": heights})
    chosen = [color for color in CATEGORY_COLORS[::-1] if color != NOMINAL_COLOR]
    colors = {log: chosen[number % len(chosen)] for number, log in enumerate(logs)}
    for axis, unit in zip(axes[:, 0], units, strict=True):
        in_panel = [x for x in extras if x.extra.unit == unit and x.extra.label in rows[unit]]
        _draw_panel(axis, in_panel, rows[unit], colors)
        kinds = {x.extra.what for x in in_panel}
        named = f"{kinds.pop().replace('_', ' ')} " if len(kinds) == 1 else ""
        axis.set_xlabel(f"{named}[{unit.replace('^2', '²')}]" if unit != "1" else "scale - 1 [1]")
    title = "Sensors and actuators: 95 % intervals; hollow: confounded with other parameters"
    figure.suptitle(title, x=0.01, ha="left")
    # made by hand: a log need not have a point in every panel, nor a filled one
    keys = [Line2D([], [], marker="o", linestyle="", color=color) for color in colors.values()]
    names = [log_title(log) or "all logs" for log in logs]
    if names != ["all logs"]:
        figure.legend(keys, names, loc="outside upper right", ncols=min(len(logs), 4))
    return figure


def _draw_panel(axis: Axes, extras: Sequence[ExtraEstimate], rows: Sequence[str], colors: Mapping[str, str]) -> None:
    """Values with their intervals; the logs of a row have vertical offsets around its middle.

    The axis is cut off where few long intervals would leave the others no room; a text has each value beyond it.
    """
    sizes = [abs(x.value) + INTERVAL * x.standard_error for x in extras if x.separable]
    sizes = [size for size in sizes if np.isfinite(size)] or [abs(x.value) for x in extras]
    reach = _MAX_SIZE_RATIO * float(np.median(sizes)) or 1.0
    for number, log in enumerate(logs := [log for log in colors if any(x.log == log for x in extras)]):
        points = [x for x in extras if x.log == log]
        offset = 0.15 * (number % _LANES - (min(len(logs), _LANES) - 1) / 2)
        values = [x.value for x in points]
        index = [rows.index(x.extra.label) + offset for x in points]
        error = [min(INTERVAL * x.standard_error, _ENDLESS * reach) for x in points]
        axis.errorbar(values, index, xerr=error, fmt="none", ecolor=colors[log], elinewidth=1.0)
        faces = [colors[log] if x.separable else "white" for x in points]
        axis.scatter(values, index, c=faces, edgecolors=colors[log], s=22, zorder=3)
        for value, place in zip(values, index, strict=True):
            if abs(value) > reach:
                right = value > 0.0
                text = f"{value:.3g} ▸" if right else f"◂ {value:.3g}"
                style: dict[str, Any] = {"transform": axis.get_yaxis_transform(), "va": "bottom", "fontsize": 8}
                axis.text(0.995 if right else 0.005, place, text, ha="right" if right else "left", **style)
    ends = np.array([(x.value - INTERVAL * x.standard_error, x.value + INTERVAL * x.standard_error) for x in extras])
    low = max(float(ends.min(initial=0.0)), -reach)
    high = min(float(ends.max(initial=0.0)), reach)
    margin = _MARGIN * (high - low) or _MARGIN
    axis.set_xlim(low - margin, high + margin)
    axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    label_ticks(axis.yaxis, range(len(rows)), rows)
    axis.set_ylim(len(rows) - 0.5, -0.5)


# ----------------------------------------------------------------------------------------------- ellipsoids of inertia


@matplotlib.rc_context(STYLE)
def inertia_figure(robot: Robot, phi: Array) -> Figure:
    """Uniform ellipsoids with the inertia of the bodies, in the two planes of the base that have the robot's length.

    At zero joint positions; lines join the origins of the link frames.

    Args:
        robot: with its nominal parameters.
        phi: (L, 12), identified.
    """
    poses = robot.link_poses(torch.zeros(1, robot.n, dtype=torch.float64))
    frames = [poses[name][0].numpy() for name in robot.body_names]
    kinds = ((robot.nominal, NOMINAL_COLOR, robot.format), (phi, IDENTIFIED_COLOR, "identified"))
    figure = Figure(figsize=(WIDTH, 5.4), layout="constrained")
    longest = int(np.argmax(np.ptp([frame[:3, 3] for frame in frames], axis=0)))
    others = [k for k in (2, 1, 0) if k != longest]
    for other, axis in zip(others, figure.subplots(1, 2), strict=True):
        plane = [other, longest] if longest else [longest, other]
        for bodies, color, _ in kinds:
            for body, frame in zip(bodies, frames, strict=True):
                ellipsoid = equivalent_ellipsoid(body)
                if ellipsoid is not None:
                    axis.add_patch(_outline(*ellipsoid, frame, plane, color))
        for body, link in enumerate(robot.bodies):
            ends = np.array([frames[k][plane, 3] for k in (body, max(link.parent, 0))])
            axis.plot(*ends.T, color=MEASURED_COLOR, linewidth=0.8)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel(f"{'xyz'[plane[0]]} [m]")
        axis.set_ylabel(f"{'xyz'[plane[1]]} [m]")
    handles = [Patch(facecolor=color, alpha=0.4, edgecolor=color, label=label) for _, color, label in kinds]
    figure.legend(handles=handles, loc="outside upper right", ncols=2)
    bad = [name for name, x in zip(robot.body_names, phi, strict=True) if x.any() and equivalent_ellipsoid(x) is None]
    missing = f"\nnot drawn, as not physically consistent: {', '.join(bad)}" if bad else ""
    title = f"Bodies as ellipsoids of the same mass and inertia, all joints at zero, in the frame of {robot.base_link}"
    figure.suptitle(title + missing, x=0.01, ha="left")
    return figure


def _outline(center: Array, semi_axes: Array, T_base_link: Array, plane: Sequence[int], color: str) -> Ellipse:
    """The projection of an ellipsoid of a link frame to a coordinate plane of the base's."""
    axes = (T_base_link[:3, :3] @ semi_axes)[plane]  # (2, 3)
    squares, directions = np.linalg.eigh(axes @ axes.T)
    width, height = 2.0 * np.sqrt(np.maximum(squares, 0.0))
    middle = (T_base_link[:3, :3] @ center + T_base_link[:3, 3])[plane]
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    face = to_rgba(color, 0.25)
    return Ellipse((middle[0], middle[1]), width, height, angle=angle, facecolor=face, edgecolor=color, linewidth=0.8)


def equivalent_ellipsoid(phi: Array) -> tuple[Array, Array] | None:
    """Centre (3,) and semi-axes, columns of (3, 3) [m], of the uniform ellipsoid with a body's mass and inertia.

    Its second moment about the centre of mass is a fifth of the mass times the squared semi-axes.

    Args:
        phi: (>= 10,), in the link frame.

    Returns:
        None where no distribution of positive mass has them, or without mass.
    """
    if phi[parameters.MASS] <= 0.0 or parameters.consistency_margin(phi) < parameters.POSSIBLE_MARGIN:
        return None
    mass, center, inertia = parameters.mass_com_inertia(phi)
    second_moment = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    eigenvalues, axes = np.linalg.eigh(second_moment)
    return center, axes * np.sqrt(5.0 * np.maximum(eigenvalues, 0.0) / mass)


_FLOOR = "noise of the readings"
_GROUPS = {"nullspace": "projected torque", WHITENED: "whitened residual"}
_MOST_BARS = 20  # of a kind of contributions
_TORQUE = IDENTIFIED_COLOR  # colors of sensors and links in the tree
_WRENCH = "#009e73"
_LIMB = "#cc79a7"
_PLAIN = "0.75"
_LOADED = "0.3"
_COLUMN = 2.4  # inches of a column of the tree
_ROW = 0.3  # likewise of a row
_LEGEND = 8.4  # likewise of its legend

Position = tuple[float, int]
"""Column and row in the figure of a tree."""


# ---------------------------------------------------------------------------------------------------- errors


@matplotlib.rc_context(STYLE)
def error_figure(sets: Mapping[str, Comparison[Metrics]], nominal_label: str = "URDF") -> Figure:
    """Relative error by group of rows, nominal (of `nominal_label`) against identified, one panel per set of logs."""
    figure = Figure(figsize=(max(WIDTH, 4.2 * len(sets) + 0.6), 3.2), layout="constrained")
    axes = figure.subplots(1, len(sets), sharey=True, squeeze=False)[0]
    for axis, (name, (nominal, identified)) in zip(axes, sets.items(), strict=True):
        groups = [group for group in ERROR_GROUPS if nominal.relative.get(group) is not None]
        index = np.arange(len(groups))
        pairs = ((-0.2, nominal, NOMINAL_COLOR, nominal_label), (0.2, identified, IDENTIFIED_COLOR, "identified"))
        for shift, metrics, color, label in pairs:
            heights = [100.0 * (metrics.relative.get(group) or 0.0) for group in groups]
            bars = axis.bar(index + shift, heights, 0.38, color=color, label=label)
            axis.bar_label(bars, fmt=lambda height: format_percent(height / 100.0), fontsize=8, padding=2)
        _draw_noise(axis, identified, groups)
        axis.margins(y=0.1)
        axis.set_xticks(index, [_GROUPS.get(group, group_name(group)).replace(" ", "\n", 1) for group in groups])
        axis.set_title(f"{name} logs", loc="left", fontsize=9)
    axes[0].set_ylabel("rms of error [% of measured rms]")
    figure.suptitle("Errors of predicted forces", x=0.01, ha="left")
    by_label = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    labels = sorted(by_label, key=lambda label: label == _FLOOR)
    figure.legend([by_label[label] for label in labels], labels, loc="outside upper right", ncols=3)
    return figure


def _draw_noise(axis: Axes, metrics: Metrics, groups: Sequence[str]) -> None:
    """A line across both bars of a group, at the error that noise of the readings leaves, where it is known."""
    for place, group in enumerate(groups):
        noise, rms, relative = (x.get(group) for x in (metrics.noise, metrics.rms, metrics.relative))
        if noise and rms and relative:
            axis.hlines(100.0 * noise * relative / rms, place - 0.4, place + 0.4, colors=MEASURED_COLOR, label=_FLOOR)


# ----------------------------------------------------------------------------------------------------- identifiability


@matplotlib.rc_context(STYLE | {"axes.grid": False})
def identifiability_figure(body_names: Sequence[str], estimate: Estimate) -> Figure:
    """A table of the share of the data in every parameter, with the mark of its verdict."""
    verdicts = estimate.verdict.reshape(-1, PER_BODY)
    shown, columns = _determined(verdicts)
    share = 100.0 * estimate.data_share.reshape(-1, PER_BODY)[np.ix_(shown, columns)]
    figure = Figure(figsize=(WIDTH, 0.24 * len(shown) + 1.3), layout="constrained")
    axis = figure.subplots()
    axis.imshow(share, cmap="Blues", vmin=0.0, vmax=100.0, aspect="auto")
    for row, body in enumerate(shown):
        for column, verdict in enumerate(verdicts[body, columns]):
            color = "white" if share[row, column] > 60.0 else "black"
            text = f"{share[row, column]:.0f} {MARKS[verdict]}" if MARKS[verdict] else ""
            axis.text(column, row, text, ha="center", va="center", fontsize=9, color=color, in_layout=False)
    axis.xaxis.tick_top()
    axis.set_xticks(range(len(columns)), [PARAMETERS[int(k)] for k in columns])
    label_ticks(axis.yaxis, range(len(shown)), [body_names[int(body)] for body in shown])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    axis.set_xlabel(
        "m: mass; mc: first moment; I: inertia about the link's origin; fc, fv: Coulomb and viscous friction"
    )
    title = f"How much of each parameter is known from the data, not from the prior [%]: {marks_legend()}"
    figure.suptitle(title, x=0.01, ha="left", fontsize=10)
    return figure


@matplotlib.rc_context(STYLE)
def contribution_figure(groups: Mapping[str, Sequence[tuple[str, float]]]) -> Figure:
    """Bits lost without each log, contact state or sensor, by group: pairs of name and bits, the largest first.

    A bit is a standard error of one combination of parameters that doubles.

    Groups of one are left out if there are others.
    """
    several = {group: pairs for group, pairs in groups.items() if len(pairs) > 1}  # one alone has all that there is
    shown = {
        group: sorted(pairs, key=lambda pair: -pair[1])[:_MOST_BARS]
        for group, pairs in (several or groups).items()
        if pairs
    }
    counts = [len(pairs) for pairs in shown.values()]
    figure = Figure(figsize=(WIDTH, 0.24 * sum(counts) + 0.6 * len(shown) + 0.6), layout="constrained")
    axes = figure.subplots(len(shown), 1, squeeze=False, height_ratios=[count + 0.8 for count in counts])[:, 0]
    for axis, (group, pairs) in zip(axes, shown.items(), strict=True):
        names, bits = zip(*pairs, strict=True)
        bars = axis.barh(range(len(pairs)), bits, 0.7, color=IDENTIFIED_COLOR)
        axis.margins(x=0.08)
        axis.bar_label(bars, fmt="%.3g", padding=2)
        label_ticks(axis.yaxis, range(len(pairs)), [fill(name, 60) for name in names])
        axis.set_ylim(len(pairs) - 0.4, -0.6)
        axis.grid(visible=False, axis="y")
        hidden = len(groups[group]) - len(pairs)
        axis.set_title(
            group + (f", the {len(pairs)} largest of {len(groups[group])}" if hidden else ""), loc="left", fontsize=9
        )
    axes[-1].set_xlabel("information lost without it [bits]")
    title = "What each part adds; 1 bit: without it, the standard error of one parameter combination doubles"
    figure.suptitle(title, x=0.01, ha="left")
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
    positions, contact_positions = _positions(robot, contacts)
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
    figure.legend(handles=_tree_legend(bool(robot.ft_names)), loc="outside lower left", ncols=4, fontsize=8)
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


def _positions(robot: Robot, contacts: Sequence[Contact]) -> tuple[list[Position], dict[str, Position]]:
    """Positions of bodies, and of contacts by frame, one below the other under their body.

    Leaves are side by side, other bodies above their contacts, centred over their children.
    """
    frames: list[list[str]] = [[] for _ in robot.bodies]
    for contact in contacts:
        frames[robot.link(contact.frame)[0]].append(contact.frame)
    children = robot.children
    row = [0] * len(robot.bodies)
    for body, link in enumerate(robot.bodies[1:], start=1):
        row[body] = row[link.parent] + 1 + len(frames[link.parent])
    column = [0.0] * len(robot.bodies)
    free = 0
    for body in reversed(range(len(robot.bodies))):  # children come after their parents
        if children[body]:
            column[body] = 0.5 * (column[children[body][0]] + column[children[body][-1]])
        else:
            column[body] = float(free)
            free = free + 1
    bodies = [(max(column) - x, y) for x, y in zip(column, row, strict=True)]
    below = {name: (x, y + k) for (x, y), at in zip(bodies, frames, strict=True) for k, name in enumerate(at, start=1)}
    return bodies, below


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
    loaded = name in constrained
    measured = bool(weld) or name in readings
    x, y = position
    bend = parent[1] + 0.5
    style: dict[str, Any] = {"color": _LOADED if loaded else _PLAIN, "linewidth": 2.2 if loaded else 1.4, "zorder": 0}
    axes.plot([parent[0], parent[0], x, x], [parent[1], bend, bend, y], **style)
    color = _LIMB if weld else _TORQUE
    part = 0 < len(weld) < len(WRENCH_COMPONENTS)
    face = color if measured else "white"
    style = {"color": color if measured else "0.5", "markerfacecolor": face, "fillstyle": "left" if part else "full"}
    axes.plot(x, y, "h" if joint.kind == "fixed" else "o", markersize=8 if joint.kind == "fixed" else 7, **style)
    label = joint.name if joint.mimic is None else f"{joint.name} (follows)"
    label += f": {', '.join(weld)}" if part else ""
    _label(axes, label, position, measured, fontsize=8, color="black" if measured or loaded else "0.45")


def _label(axes: Axes, text: str, position: Position, bold: bool = False, **style: Any) -> None:
    weight = "bold" if bold else "normal"
    axes.annotate(text, position, (8, 0), textcoords="offset points", va="center", fontweight=weight, **style)


def _draw_contact(axes: Axes, contact: Contact, body: Position, position: Position, measured: Sequence[str]) -> None:
    axes.plot([position[0], position[0]], [body[1], position[1]], color=_LOADED, linewidth=2.2, zorder=0)
    part = bool(measured) and not set(measured) >= set(contact.component_names)
    color, face = (_WRENCH, _WRENCH) if measured else ("0.5", "white")
    axes.plot(*position, "D", color=color, markerfacecolor=face, fillstyle="left" if part else "full", markersize=8)
    components = f": {', '.join(measured)}" if part else ""
    _label(axes, f"{contact.frame} ({contact.kind}){components}", position, bool(measured), fontsize=8)


def _tree_legend(welds: bool) -> list[Line2D]:
    def marker(shape: str, color: str, face: str, label: str) -> Line2D:
        return Line2D([], [], marker=shape, color=color, markerfacecolor=face, linestyle="none", label=label)

    in_limbs = [marker("h", _LIMB, _LIMB, "sensor in a limb"), marker("h", "0.5", "white", "weld without sensor")]
    return [
        marker("o", _TORQUE, _TORQUE, "joint torque measured"),
        marker("o", "0.5", "white", "joint torque not measured"),
        marker("D", _WRENCH, _WRENCH, "contact sensor"),
        marker("D", "0.5", "white", "contact without sensor"),
        Line2D([], [], color=_LOADED, linewidth=2.2, label="constrained by contacts"),
        *(in_limbs if welds else []),
    ]


# ---------------------------------------------------------------------------------------------------- ridge

_WIDE_RATIO = 5.0  # ratio of errors from which on decades tell more than differences


@matplotlib.rc_context(STYLE)
def ridge_figure(choice: RidgeChoice, nominal_label: str = "URDF") -> Figure:
    """Mean square of whitened residuals on held-out folds by ridge, on logarithmic axes.

    The band is a standard error of the difference from the least, fold by fold, on either side; ridges where it reaches
    down to the least are shaded: the data hardly tell them from the chosen one. Ridges of 0 have no place on the axis.
    """
    tried, mean, error = (np.array(x) for x in (choice.tried, choice.mean_square, choice.standard_error))
    least = float(mean.min())
    within = (mean - error <= least) & (tried > 0.0)
    shown = tried > 0.0
    figure = Figure(figsize=(WIDTH, 3.8), layout="constrained")
    axes = figure.subplots()
    axes.set_xscale("log")
    if mean.max() > _WIDE_RATIO * max(least, np.finfo(float).tiny):
        axes.set_yscale("log")
    low = mean - error if axes.get_yscale() == "linear" else np.maximum(mean - error, 0.5 * least)
    band = axes.fill_between(
        tried[shown], low[shown], (mean + error)[shown], color=IDENTIFIED_COLOR, alpha=0.25, linewidth=0
    )
    (curve,) = axes.plot(tried[shown], mean[shown], "o-", color=IDENTIFIED_COLOR, markersize=4)
    line = axes.axhline(least, color="0.3", linewidth=1.0, linestyle="--")
    handles = [curve, band, line]
    labels = ["error", "± its standard error, as difference from the least", f"least: {least:.4g}"]
    if within.any():
        edge = np.sqrt(10.0)
        handles.append(
            axes.axvspan(tried[within].min() / edge, tried[within].max() * edge, color="0.9", zorder=0, linewidth=0)
        )
        labels.append("within a standard error of the least")
    if choice.ridge > 0.0:
        at = float(mean[list(choice.tried).index(choice.ridge)])
        (marker,) = axes.plot(choice.ridge, at, "D", color=NOMINAL_COLOR, markersize=8, markerfacecolor="none")
        handles.append(marker)
        what = "chosen" if choice.rule == "auto" else "chosen, the largest of these"
        labels.append(f"{what}: {choice.ridge:g}, {at:.4g}")
    axes.set_xticks(tried[shown], [decade(ridge) for ridge in tried[shown]])
    axes.minorticks_off()
    if axes.get_yscale() == "log":
        label_decades(axes.yaxis)
    axes.set_xlim(tried[shown].min() / 2.0, tried[shown].max() * 2.0)
    axes.set_xlabel(f"ridge: weight of the {nominal_label} [1]")
    axes.set_ylabel("mean square of whitened residuals\non held-out folds [noise²]")
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    figure.suptitle("Ridge, chosen by cross-validation", x=0.01, ha="left")
    return figure


# ---------------------------------------------------------------------------------------------------- replay


@matplotlib.rc_context(STYLE)
def drift_figure(
    driven: str,
    time: Array,
    quartiles: Mapping[str, Comparison[Array]],
    ranges: Mapping[str, Array],
    by_joint: Mapping[str, Comparison[float]],
    units: Sequence[str],
    nominal_label: str,
) -> Figure:
    """Drift over the time since the beginning of a window, median and quartiles, and at its end by joint.

    On logarithmic axes, as robots that spin and those that hardly drift are compared.

    Args:
        driven: by what, "the torques of walk".
        time: (T,) [s].
        quartiles: (3, T) each, over windows, by what drifts, with its unit.
        ranges: least and largest median of robots that were drawn, (2, T), by what drifts; empty without any.
        by_joint: at the end of the windows.
        units: of the joints, "rad" or "m".
        nominal_label: what the robot's file is.
    """
    tall = max(0.22 * len(by_joint) + 1.4, 1.9 * len(quartiles) + 0.8)
    figure = Figure(figsize=(WIDTH, tall), layout="constrained")
    grid = figure.add_gridspec(len(quartiles), 2, width_ratios=(1.0, 1.1))
    for row, (name, (nominal, identified)) in enumerate(quartiles.items()):
        axis = figure.add_subplot(grid[row, 0])
        for label, color, (low, middle, high) in (
            (nominal_label, NOMINAL_COLOR, nominal),
            ("identified", IDENTIFIED_COLOR, identified),
        ):
            axis.fill_between(time, low, high, color=color, alpha=0.2, linewidth=0.0)
            axis.plot(time, middle, color=color, label=label)
        for edge, label in zip(ranges.get(name, ()), ("samples, least and largest", ""), strict=False):
            axis.plot(time, edge, color=IDENTIFIED_COLOR, linestyle=":", label=label)
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
    for color, values in ((NOMINAL_COLOR, nominal), (IDENTIFIED_COLOR, identified)):
        joints.plot(values, rows, "o", color=color)
    if min(nominal.min(), identified.min()) > 0.0:
        joints.set_xscale("log")
        label_decades(joints.xaxis)
    label_ticks(joints.yaxis, rows, list(by_joint))
    joints.invert_yaxis()
    joints.set_xlabel(f"median drift after {time[-1]:g} s [{', '.join(dict.fromkeys(units))}]")
    figure.suptitle(f"Drift of a robot driven by {driven}: median of windows, and quartiles", x=0.01, ha="left")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
