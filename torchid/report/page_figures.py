"""Figures of a run's page, as Plotly's JSON: what they show comes from the files of the run."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from textwrap import wrap
from typing import Any

import numpy as np

from torchid import parameters
from torchid.errors import escape
from torchid.estimators.least_squares import FIXED, IDENTIFIED
from torchid.logs.time_range import log_title
from torchid.parameters import INERTIAL, PARAMETERS, Array
from torchid.report.figure_style import CATEGORY_COLORS, IDENTIFIED_COLOR, MEASURED_COLOR, NOISE_COLOR, NOMINAL_COLOR
from torchid.report.forces import packed
from torchid.report.parameter_figures import INTERVAL

Figure = dict[str, Any]

_COMMONEST = "#ffffff"
_GRID, _TEXT = "#e5e5e5", "#222222"
_MEASURED, _NOMINAL, _IDENTIFIED = (MEASURED_COLOR, 1.6), (NOMINAL_COLOR, 1.1), (IDENTIFIED_COLOR, 1.1)
#: Pixels of panels, of what is above and below all of them, between two rows and within one; of a bar, and its text.
_FORCE, _ERROR, _SPECTRUM, _TOP, _BOTTOM, _BETWEEN, _WITHIN = 150, 90, 150, 40, 45, 40, 22
_BAR, _LINE = 24, 15
_SHOWN = 1.6  # errors are shown up to so many times the largest of the identified ones, or of the noise
_VIEW = np.array([1.3, -1.3, 0.6])  # where the eye is, for a scene as long as wide and high
_MOST_BARS, _LONGEST_LABEL, _MOST_LABEL_LINES = 20, 24, 4


def force_panels(forces: Mapping[str, Any], kind: str, of: str) -> Figure:
    """Measured and predicted forces over the log, each with its errors below, and contact states behind all.

    Args:
        forces: from `traces_document`.
        kind: "recorded" or "projected".
        of: what the nominal parameters are from, "URDF" or "MJCF".
    """
    panels = forces[kind]
    heights = [x for _ in panels for x in (_FORCE, _ERROR)]
    layout, axes = _stacked(heights, [_WITHIN if k % 2 else _BETWEEN for k in range(len(heights))])
    data: list[Figure] = []
    for number, panel in enumerate(panels):
        upper, lower = axes[2 * number], axes[2 * number + 1]
        _title(layout, upper, f"{panel['name']} [{panel['unit']}]")
        for line, (label, color, width) in _lines(of).items():
            data.append(_line(forces["time"], panel["lines"][line], upper, label, color, width, number == 0))
        for line, (label, color, _) in _lines(of).items():
            if line != "measured":
                values = panel["lines"][f"{line}_error"]
                data.append(_line(forces["time"], values, lower, label, color, 0.9, False))
        _title(layout, lower, _rms_text(panel, of), 10)
        layout[_key(lower)] |= _error_range(panel)
        if noise := panel["rms"].get("noise"):
            layout["shapes"].append(_band(lower, noise))
    layout["shapes"] += _state_bands(forces["states"])
    layout["xaxis"] |= {"title": {"text": "time [s]"}, "range": [0.0, forces["seconds"]]}
    return {"data": data, "layout": layout}


def spectrum_panels(panels: Sequence[Mapping[str, Any]], of: str) -> Figure | None:
    """Amplitude densities of the errors, with that of the noise; None where no row has a spectrum."""
    shown = [panel for panel in panels if panel["spectrum"] is not None]
    if not shown:
        return None
    layout, axes = _stacked([_SPECTRUM] * len(shown), [_BETWEEN] * len(shown))
    data: list[Figure] = []
    for number, (panel, axis) in enumerate(zip(shown, axes, strict=True)):
        spectrum = panel["spectrum"]
        _title(layout, axis, f"{panel['name']} [{panel['unit']}/√Hz]")
        for line, (label, color, width) in _lines(of).items():
            if line != "measured":
                values = spectrum[line]
                data.append(_line(spectrum["frequency"], values, axis, label, color, width + 0.3, number == 0))
        if spectrum["noise"]:
            floor = _line(
                spectrum["band"], [spectrum["noise"]] * 2, axis, "noise of the readings", NOISE_COLOR, 2, False
            )
            data.append(floor | {"line": {"color": NOISE_COLOR, "width": 2, "dash": "dash"}, "showlegend": number == 0})
        layout[_key(axis)] |= {"type": "log", "dtick": 1, "exponentformat": "power"}
    layout["xaxis"] |= {"type": "log", "title": {"text": "frequency [Hz]"}}
    return {"data": data, "layout": layout}


def parameter_bars(bodies: Sequence[Mapping[str, Any]], parameter: str, unit: str, of: str) -> Figure | None:
    """One parameter of all bodies, nominal and identified with its 95 % interval; None where none is fitted."""
    shown = [body for body in bodies if body["verdict"][parameter] != FIXED]
    if not shown:
        return None
    hover, bars = [], []
    for body in shown:
        value, error, verdict = (body[key][parameter] for key in ("identified", "standard_error", "verdict"))
        hover.append(f"{_text(body['name'])}: {value:.5g} {unit}, {verdict}")
        bars.append(INTERVAL * error if verdict == IDENTIFIED and error is not None else None)
    nominal, identified = ([body[kind][parameter] for body in shown] for kind in ("nominal", "identified"))
    data = [_markers(nominal, of, NOMINAL_COLOR, "diamond-open")]
    kinds = ((True, "identified, 95 %", "circle"), (False, f"known in sums, or mostly the {of}'s", "circle-open"))
    for known, name, symbol in kinds:  # apart: Plotly draws the caps of intervals that there are none of
        values = [x if (bar is not None) is known else None for x, bar in zip(identified, bars, strict=True)]
        if any(x is not None for x in values):
            points = _markers(values, name, IDENTIFIED_COLOR, symbol) | {"hovertext": hover, "hoverinfo": "text"}
            interval = {"array": bars, "color": IDENTIFIED_COLOR, "thickness": 1.5, "width": 3}
            data.append(points | ({"error_x": interval} if known else {}))
    return {"data": data, "layout": _list_layout([_label(body["name"]) for body in shown], f"[{unit}]")}


def _markers(values: Sequence[float | None], name: str, color: str, symbol: str) -> Figure:
    """A mark for each line of a list."""
    marker = {"symbol": symbol, "size": 9, "color": color, "line": {"width": 2}}
    rows = list(range(len(values)))
    return {"type": "scatter", "mode": "markers", "x": list(values), "y": rows, "name": name, "marker": marker}


def contribution_bars(parts: Sequence[Mapping[str, Any]], of_logs: bool = False) -> Figure | None:
    """Bits that are lost without each part of the data, the largest of them first; None without any."""
    shown = sorted(parts, key=lambda part: -float(part["bits"]))[:_MOST_BARS]
    if not shown:
        return None
    names = [log_title(part["name"]) if of_logs else part["name"] for part in shown]
    bar: Figure = {
        "type": "bar",
        "orientation": "h",
        "x": [part["bits"] for part in shown],
        "y": list(range(len(shown))),
        "width": 0.7,
        "marker": {"color": IDENTIFIED_COLOR},
        "texttemplate": "%{x:.3g}",
        "hovertext": [_text(name) for name in names],
        "hoverinfo": "text+x",
        "showlegend": False,
    }
    labels = [_label(name) for name in names]
    left = len(parts) - len(shown)
    more = f"; {left} more that add less are in the table" if left else ""
    return {"data": [bar], "layout": _list_layout(labels, f"information lost without it [bits]{more}")}


def ellipsoid_scene(
    bodies: Sequence[Mapping[str, Any]],
    poses: Sequence[Sequence[Sequence[float]]],
    parents: Sequence[int],
    of: str,
) -> tuple[Figure | None, list[str]]:
    """Ellipsoids of the URDF's and of the identified inertia, with lines from each body's frame to its parent's.

    Args:
        bodies: of `parameters.json`.
        poses: of the link frames in the base's, (4, 4) each [m].
        parents: number of each body's parent; the base's is its own.
        of: what the nominal parameters are from.

    Returns:
        The figure, None where nothing can be drawn, and the identified bodies with mass whose inertia is impossible.
    """
    frames = [np.array(pose, dtype=np.float64) for pose in poses]
    kinds = {"nominal": (of, MEASURED_COLOR, 0.25), "identified": ("identified", IDENTIFIED_COLOR, 0.4)}
    data, impossible, drawn = [], [], [frame[None, :3, 3] for frame in frames]
    for kind, (label, color, opacity) in kinds.items():
        points, names = [], []
        for body, frame in zip(bodies, frames, strict=True):
            phi = np.array([body[kind][parameter] for parameter in PARAMETERS])
            ellipsoid = equivalent_ellipsoid(phi)
            if ellipsoid is not None:
                points.append(ellipsoid_points(*ellipsoid, frame))
                names.append(f"{_text(body['name'])}, {label}: {phi[0]:.4g} kg")
            elif kind == "identified" and phi[INERTIAL].any():
                impossible.append(str(body["name"]))
        drawn += points
        if points:
            data.append(_mesh(points, names) | {"name": label, "color": color, "opacity": opacity})
    if not data:
        return None, impossible
    ends = [(frames[k][:3, 3], frames[parent][:3, 3]) for k, parent in enumerate(parents) if k != parent]
    x, y, z = ([None if at is None else float(at[k]) for a, b in ends for at in (a, b, None)] for k in range(3))
    tree: Figure = {"type": "scatter3d", "mode": "lines", "x": x, "y": y, "z": z, "name": "joints", "hoverinfo": "skip"}
    data.append(tree | {"line": {"color": _TEXT, "width": 2}})
    axes = {f"{axis}axis": {"title": {"text": f"{axis} [m]"}, "gridcolor": _GRID} for axis in "xyz"}
    layout = _layout(560) | {"margin": {"l": 0, "r": 0, "t": _TOP, "b": 0}}
    extents = np.ptp(np.concatenate(drawn), axis=0).clip(1e-9)
    away = _VIEW * max(1.0, float(extents.max() / np.cbrt(extents.prod())))  # Plotly scales to a volume of 1
    view = {"eye": dict(zip("xyz", away.tolist(), strict=True))}
    return {"data": data, "layout": layout | {"scene": axes | {"aspectmode": "data", "camera": view}}}, impossible


def _mesh(points: Sequence[np.ndarray], names: Sequence[str]) -> Figure:
    """Ellipsoids as one mesh, each vertex with the name of its own."""
    x, y, z = np.concatenate(points).T
    each = len(points[0])
    i, j, k = np.concatenate([TRIANGLES + number * each for number in range(len(points))]).T.tolist()
    mesh = {"type": "mesh3d", "x": packed(x), "y": packed(y), "z": packed(z), "i": i, "j": j, "k": k}
    text = [name for name in names for _ in range(each)]
    return mesh | {"hovertext": text, "hoverinfo": "text", "showlegend": True, "flatshading": False}


# ------------------------------------------------------------------------------------------------------------- layouts


def _layout(height: int) -> Figure:
    """What all figures share."""
    return {
        "height": height,
        "autosize": True,
        "font": {"size": 12, "color": _TEXT, "family": "system-ui, sans-serif"},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "hovermode": "closest",
        "legend": {"orientation": "h", "x": 0, "xanchor": "left", "y": 1, "yref": "container", "yanchor": "top"},
        "shapes": [],
        "annotations": [],
    }


def _stacked(heights: Sequence[int], spaces: Sequence[int]) -> tuple[Figure, list[str]]:
    """The layout of panels above each other, of these heights with these spaces above, on one axis of x; their axes."""
    inside = sum(heights) + sum(spaces)
    layout = _layout(inside + _TOP + _BOTTOM) | {"margin": {"l": 62, "r": 8, "t": _TOP, "b": _BOTTOM}}
    top, names = float(inside), []
    for number, (height, space) in enumerate(zip(heights, spaces, strict=True), start=1):
        top -= space
        names.append("y" if number == 1 else f"y{number}")
        domain = [max(0.0, (top - height) / inside), top / inside]
        layout[_key(names[-1])] = {"domain": domain, "gridcolor": _GRID, "zeroline": False, "nticks": 5}
        top -= height
    layout["xaxis"] = {"anchor": names[-1] if names else "y", "gridcolor": _GRID, "zeroline": False}
    return layout, names


def _list_layout(names: Sequence[str], title: str) -> Figure:
    """The layout of a list of names from top to bottom."""
    rows = list(range(len(names)))
    each = max(_BAR, _LINE * max(name.count("<br>") + 1 for name in names) + 4)
    layout = _layout(each * len(names) + _TOP + _BOTTOM + 20) | {"margin": {"l": 10, "r": 12, "t": _TOP, "b": _BOTTOM}}
    ticks = {"tickmode": "array", "tickvals": rows, "ticktext": list(names), "automargin": True}
    layout["yaxis"] = {"range": [len(names) - 0.4, -0.6], "gridcolor": _GRID, "zeroline": False} | ticks
    layout["xaxis"] = {"title": {"text": title}, "gridcolor": _GRID, "zerolinecolor": "#bbbbbb"}
    return layout


def _key(axis: str) -> str:
    """Name of an axis in a layout: yaxis2 for y2."""
    return f"yaxis{axis[1:]}"


def _title(layout: Figure, axis: str, text: str, size: int = 12) -> None:
    """Put a title above a panel, at its left."""
    place = {"xref": "paper", "x": 0, "xanchor": "left", "yref": "paper", "y": layout[_key(axis)]["domain"][1]}
    look = {"yanchor": "bottom", "showarrow": False, "font": {"size": size}, "align": "left"}
    layout["annotations"].append({"text": _text(text)} | place | look)


def _lines(of: str) -> dict[str, tuple[str, str, float]]:
    """Label, color and width of lines."""
    kinds = {"measured": ("measured", _MEASURED), "nominal": (of, _NOMINAL), "identified": ("identified", _IDENTIFIED)}
    return {kind: (label, *look) for kind, (label, look) in kinds.items()}


def _line(x: Any, y: Any, axis: str, name: str, color: str, width: float, shown: bool) -> Figure:
    """A line; those of one name go and come with the one that is in the legend."""
    line = {"type": "scatter", "mode": "lines", "x": x, "y": y, "yaxis": axis, "name": name, "legendgroup": name}
    return line | {"line": {"color": color, "width": width}, "showlegend": shown, "hoverinfo": "x+y+name"}


def _rms_text(panel: Mapping[str, Any], of: str) -> str:
    """The rms of both errors and of the noise."""
    named = {"nominal_error": of, "identified_error": "identified", "noise": "noise"}
    known = [f"{label} {panel['rms'][key]:.3g}" for key, label in named.items() if panel["rms"].get(key) is not None]
    return f"error, rms: {', '.join(known)}" if known else "error"


def _error_range(panel: Mapping[str, Any]) -> Figure:
    """A range of errors that shows the identified ones, however large the others are."""
    sizes = [panel["rms"].get("identified_error") or 0.0, panel["rms"].get("noise") or 0.0]
    largest = 4.0 * _SHOWN * max(sizes)
    return {"range": [-largest, largest]} if math.isfinite(largest) and largest > 0.0 else {}


def _band(axis: str, noise: float) -> Figure:
    """Two standard deviations of the noise on either side of 0."""
    place: Figure = {
        "type": "rect",
        "xref": "paper",
        "x0": 0,
        "x1": 1,
        "yref": axis,
        "y0": -2.0 * noise,
        "y1": 2.0 * noise,
    }
    return place | {"fillcolor": NOISE_COLOR, "opacity": 0.35, "line": {"width": 0}, "layer": "below"}


def _state_bands(states: Mapping[str, Any]) -> list[Figure]:
    """Contact states behind all panels; one alone needs no colour."""
    if len(states["names"]) < 2:
        return []
    look = {"type": "rect", "xref": "x", "yref": "paper", "y0": 0, "y1": 1, "line": {"width": 0}, "layer": "below"}
    return [
        look | {"x0": start, "x1": end, "fillcolor": state_color(states, number), "opacity": 0.25}
        for start, end, number in states["spans"]
        if state_color(states, number) != _COMMONEST
    ]


def state_color(states: Mapping[str, Any], number: int) -> str:
    """Colour of a contact state: white for that which lasts longest."""
    spans = states["spans"]
    lasted = [sum(end - start for start, end, other in spans if other == k) for k in range(len(states["names"]))]
    longest = lasted.index(max(lasted))
    return _COMMONEST if number == longest else CATEGORY_COLORS[(number - (number > longest)) % len(CATEGORY_COLORS)]


def _label(name: str) -> str:
    """A name beside an axis, in lines that a phone has room for."""
    lines = wrap(name, _LONGEST_LABEL, break_long_words=False) or [""]
    more = "" if len(lines) <= _MOST_LABEL_LINES else " …"
    return "<br>".join(map(_text, lines[:_MOST_LABEL_LINES])) + more


def _text(text: str) -> str:
    """A foreign text for Plotly, which takes some tags as HTML does."""
    return html.escape(escape(text), quote=False)


_MERIDIANS, _PARALLELS = 16, 9


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


def ellipsoid_points(center: Array, semi_axes: Array, T_base_link: Array) -> Array:
    """Vertices of an ellipsoid in the link frame, (V, 3) [m], in the base's; `TRIANGLES` join them."""
    in_link = center + _SPHERE @ semi_axes.T
    return in_link @ T_base_link[:3, :3].T + T_base_link[:3, 3]


def _sphere() -> tuple[Array, np.ndarray]:
    """Vertices of a unit sphere, (V, 3), and its triangles, (T, 3)."""
    polar = np.pi * np.arange(1, _PARALLELS) / _PARALLELS
    around = 2.0 * np.pi * np.arange(_MERIDIANS) / _MERIDIANS
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    rings = [np.column_stack([np.sin(p) * ring, np.full(_MERIDIANS, np.cos(p))]) for p in polar]
    points = np.concatenate([[[0.0, 0.0, 1.0]], *rings, [[0.0, 0.0, -1.0]]])
    numbers = 1 + np.arange((_PARALLELS - 1) * _MERIDIANS).reshape(-1, _MERIDIANS)
    following, last = np.roll(numbers, -1, axis=1), len(points) - 1
    upper, lower = numbers[:-1].ravel(), numbers[1:].ravel()
    triangles = np.concatenate(
        [
            np.stack([np.zeros(_MERIDIANS, int), numbers[0], following[0]], axis=1),
            np.stack([upper, lower, following[:-1].ravel()], axis=1),
            np.stack([following[:-1].ravel(), lower, following[1:].ravel()], axis=1),
            np.stack([np.full(_MERIDIANS, last), following[-1], numbers[-1]], axis=1),
        ]
    )
    return points, triangles


_SPHERE, TRIANGLES = _sphere()
"""Triangles of every ellipsoid, (T, 3), by the numbers of its vertices."""
