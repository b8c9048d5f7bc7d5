"""Figures of what was identified: of every body, beside the URDF's, its inertia; of offsets, scales and actuators."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch

from torchid import parameters
from torchid.estimators import Estimate
from torchid.estimators.least_squares import FIXED, IDENTIFIED
from torchid.identifiability.confounding import ExtraEstimate
from torchid.logs.time_range import log_title
from torchid.parameters import INERTIAL, PARAMETERS, PER_BODY, Array
from torchid.report.figure_style import CATEGORY_COLORS, IDENTIFIED_COLOR, MEASURED_COLOR, NOMINAL_COLOR, STYLE
from torchid.robot import Robot

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
    of: str = "URDF",
) -> Figure:
    """Mass, first moment, inertia and friction of every body with a free parameter.

    Filled points are identified and have their 95 % intervals; hollow ones are known only in sums with others, or
    mostly the URDF's. Negative values, and names of bodies that cannot exist, have a cross.

    Args:
        body_names: of all bodies.
        nominal: (L, 12), the URDF's parameters.
        estimate: the fit.
        kinds: of the robot's joints, which friction has the unit of.
        of: what the nominal parameters are from.
    """
    verdict = estimate.verdict.reshape(-1, PER_BODY)
    shown = np.flatnonzero((verdict != FIXED).any(axis=1))
    before, after, errors = (x.reshape(-1, PER_BODY)[shown] for x in (nominal, estimate.phi, estimate.standard_error))
    known = (verdict[shown] == IDENTIFIED) & np.isfinite(errors)
    single = [name for name in _SINGLE if (verdict[shown][:, PARAMETERS.index(name)] != FIXED).any()]
    titles = [_title("m", kinds), *_DERIVED, *(_title(name, kinds) for name in single if name != "m")]
    figure = Figure(figsize=(1.9 + 2.3 * len(titles), 0.24 * len(shown) + 1.7), layout="constrained")
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
    first.set_yticks(range(len(shown)), names, fontsize=7)
    first.set_ylim(len(shown) - 0.4, -0.6)
    figure.legend(handles=_legend(first, of, bool(impossible.any())), loc="outside upper right", ncols=4)
    return figure


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


def _legend(axis: Axes, of: str, impossible: bool) -> list[matplotlib.artist.Artist]:
    """Handles with labels, drawn outside of what is seen."""
    kinds = [("D", NOMINAL_COLOR, "none", of), ("o", IDENTIFIED_COLOR, IDENTIFIED_COLOR, "identified, 95 %")]
    kinds.append(("o", IDENTIFIED_COLOR, "white", f"known in sums, or the {of}'s"))
    if impossible:
        kinds.append(("X", MEASURED_COLOR, MEASURED_COLOR, "cannot exist"))
    return [
        axis.plot([], [], mark, color=color, markerfacecolor=face, label=label)[0] for mark, color, face, label in kinds
    ]


#: Rows of a panel (`parameters.json` has all), longest error bar that is whole over the largest value, the longest of
#: all over this, its margin beside these as a share of the panel, and vertical offsets for logs in one row.
_MAX_PANEL_ROWS, _MAX_ERROR_RATIO, _ENDLESS, _MARGIN, _LANES = 40, 4, 1e3, 0.05, 5


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
    chosen = [color for color in CATEGORY_COLORS[::-1] if color != NOMINAL_COLOR]
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
    """Values with their intervals; the logs of a row have vertical offsets around its middle.

    Long intervals leave the panel: a bar that ends within it ends where the interval does.
    """
    longest = _MAX_ERROR_RATIO * max(abs(x.value) for x in extras) or 1.0
    bars = [(x.value, INTERVAL * x.standard_error) for x in extras]
    ends = [end for value, error in bars for end in (value - min(error, longest), value + min(error, longest))]
    for number, log in enumerate(logs := [log for log in colors if any(x.log == log for x in extras)]):
        points = [x for x in extras if x.log == log]
        offset = 0.15 * (number % _LANES - (min(len(logs), _LANES) - 1) / 2)
        values, index = [x.value for x in points], [rows.index(x.extra.label) + offset for x in points]
        error = [min(INTERVAL * x.standard_error, _ENDLESS * longest) for x in points]
        axis.errorbar(values, index, xerr=error, fmt="none", ecolor=colors[log], elinewidth=1.0)
        faces = [colors[log] if x.separable else "white" for x in points]
        axis.scatter(values, index, c=faces, edgecolors=colors[log], s=22, zorder=3)
    axis.axvline(0.0, color="0.7", linewidth=0.8, zorder=0)
    axis.set_yticks(range(len(rows)), rows, fontsize=8)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    margin = _MARGIN * (max(*ends, 0.0) - min(*ends, 0.0))
    axis.set_xlim(min(*ends, 0.0) - margin, max(*ends, 0.0) + margin)
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


# ----------------------------------------------------------------------------------------------- ellipsoids of inertia


@matplotlib.rc_context(STYLE)
def inertia_figure(robot: Robot, phi: Array) -> Figure:
    """Uniform ellipsoids with the inertia of the bodies, from the side and from the front of the base.

    At zero joint positions; lines join the origins of the link frames.

    Args:
        robot: with its nominal parameters.
        phi: (L, 12), identified.
    """
    poses = robot.link_poses(torch.zeros(1, robot.n, dtype=torch.float64))
    frames = [poses[name][0].numpy() for name in robot.body_names]
    kinds = ((robot.nominal, NOMINAL_COLOR, robot.format), (phi, IDENTIFIED_COLOR, "identified"))
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    views = ((0, "from the side"), (1, "from the front"))
    for axis, (across, title) in zip(figure.subplots(1, len(views)), views, strict=True):
        plane = [across, 2]
        for bodies, color, _ in kinds:
            for body, frame in zip(bodies, frames, strict=True):
                ellipsoid = equivalent_ellipsoid(body)
                if ellipsoid is not None:
                    axis.add_patch(_outline(*ellipsoid, frame, plane, color))
        for body, link in enumerate(robot.bodies):
            ends = np.array([frames[k][plane, 3] for k in (body, max(link.parent, 0))])
            axis.plot(*ends.T, color=MEASURED_COLOR, linewidth=0.8)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_title(title, loc="left", fontsize=9)
        axis.set_xlabel(f"{'xy'[across]} [m]")
        axis.set_ylabel("z [m]")
    handles = [Patch(facecolor=color, alpha=0.4, edgecolor=color, label=label) for _, color, label in kinds]
    figure.legend(handles=handles, loc="outside upper right", ncols=2)
    bad = [name for name, x in zip(robot.body_names, phi, strict=True) if x.any() and equivalent_ellipsoid(x) is None]
    missing = f"\nnot drawn, as no body has their inertia: {', '.join(bad)}" if bad else ""
    figure.suptitle(f"Ellipsoids of inertia in the frame of {robot.base_link}{missing}", x=0.01, ha="left")
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
