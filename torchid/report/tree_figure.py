"""A robot's tree with its contacts and a choice of sensors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchid.parameters import WRENCH_COMPONENTS
from torchid.report.figures import STYLE
from torchid.robot import Robot
from torchid.robot.tree import BodyJoint
from torchid.sensing import Contact

_TORQUE, _WRENCH, _LIMB, _PLAIN, _LOADED = "tab:blue", "tab:green", "tab:purple", "0.75", "0.3"
_COLUMN, _ROW, _LEGEND = 2.1, 0.3, 7.4  # inches

Place = tuple[float, int]
"""Column and row."""


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
        measured: those of the robot's `dof_names` that are.
        wrenches: measured components by contact frame.
        constrained: joints between the base and a contact.
    """
    constrained = {*constrained, *_loaded_welds(robot, contacts)}
    places = _places(robot, contacts)
    hanging = _contact_rows(robot, contacts, places)
    right = max(x for x, _ in places)
    deepest = max(y for _, y in [*places, *hanging.values()])
    width = _COLUMN * (right + 1.0)
    figure = Figure(figsize=(max(width, _LEGEND) + 0.2, _ROW * (deepest + 1) + 1.3), layout="constrained")
    axes = figure.subplots()
    for body, link in enumerate(robot.bodies):
        if link.joint is not None:
            _draw_joint(axes, link.joint, places[link.parent], places[body], measured, constrained)
    for contact in contacts:
        body, _ = robot.link(contact.frame)
        _draw_contact(axes, contact, places[body], hanging[contact.frame], wrenches.get(contact.frame, ()))
    axes.plot(*places[0], "s", color="black", markersize=9)
    _label(axes, robot.body_names[0], places[0], fontsize=8)
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


def _places(robot: Robot, contacts: Sequence[Contact]) -> list[Place]:
    """Column and row of every body: leaves side by side, bodies above their contacts and their children's middle."""
    hanging = Counter(robot.link(contact.frame)[0] for contact in contacts)
    children, row = robot.children, [0] * len(robot.bodies)
    for body, link in enumerate(robot.bodies[1:], start=1):
        row[body] = row[link.parent] + 1 + hanging[link.parent]
    column, free = [0.0] * len(robot.bodies), 0
    for body in reversed(range(len(robot.bodies))):  # children come after their parents
        if children[body]:
            column[body] = 0.5 * (column[children[body][0]] + column[children[body][-1]])
        else:
            column[body], free = float(free), free + 1
    return [(max(column) - x, y) for x, y in zip(column, row, strict=True)]


def _contact_rows(robot: Robot, contacts: Sequence[Contact], places: Sequence[Place]) -> dict[str, Place]:
    """Places of contacts, one below the other beneath their body."""
    hanging: dict[str, Place] = {}
    count: Counter[int] = Counter()
    for contact in contacts:
        body, _ = robot.link(contact.frame)
        count[body] += 1
        column, row = places[body]
        hanging[contact.frame] = (column, row + count[body])
    return hanging


def _draw_joint(
    axes: Axes, joint: BodyJoint, parent: Place, place: Place, readings: Collection[str], constrained: Collection[str]
) -> None:
    name = joint.name if joint.mimic is None else joint.mimic.master
    weld = [k for k in WRENCH_COMPONENTS if f"{name}.{k}" in readings] if joint.kind == "fixed" else []
    loaded, measured = name in constrained, bool(weld) or name in readings
    (x, y), turn = place, parent[1] + 0.5
    style: dict[str, Any] = {"color": _LOADED if loaded else _PLAIN, "linewidth": 2.2 if loaded else 1.4, "zorder": 0}
    axes.plot([parent[0], parent[0], x, x], [parent[1], turn, turn, y], **style)
    color, part = _LIMB if weld else _TORQUE, 0 < len(weld) < len(WRENCH_COMPONENTS)
    face = color if measured else "white"
    style = {"color": color if measured else "0.5", "markerfacecolor": face, "fillstyle": "left" if part else "full"}
    axes.plot(x, y, "h" if joint.kind == "fixed" else "o", markersize=8 if joint.kind == "fixed" else 7, **style)
    label = joint.name if joint.mimic is None else f"{joint.name} (follows)"
    label += f": {', '.join(weld)}" if part else ""
    _label(axes, label, place, measured, fontsize=6.5, color="black" if measured or loaded else "0.45")


def _draw_contact(axes: Axes, contact: Contact, body: Place, place: Place, measured: Sequence[str]) -> None:
    axes.plot([place[0], place[0]], [body[1], place[1]], color=_LOADED, linewidth=2.2, zorder=0)
    part = bool(measured) and not set(measured) >= set(contact.component_names)
    color, face = (_WRENCH, _WRENCH) if measured else ("0.5", "white")
    axes.plot(*place, "D", color=color, markerfacecolor=face, fillstyle="left" if part else "full", markersize=8)
    components = f": {', '.join(measured)}" if part else ""
    _label(axes, f"{contact.frame} ({contact.kind}){components}", place, bool(measured), fontsize=7)


def _label(axes: Axes, text: str, place: Place, bold: bool = False, **style: Any) -> None:
    weight = "bold" if bold else "normal"
    axes.annotate(text, place, (8, 0), textcoords="offset points", va="center", fontweight=weight, **style)


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
