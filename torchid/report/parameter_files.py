"""The files of identified parameters: `parameters.json`, and the URDF with all else as it was."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from lxml import etree

from torchid import parameters
from torchid.errors import InputError, during, warn
from torchid.estimators import Estimate
from torchid.guards import MAX_JSON, read_bytes
from torchid.identifiability.confounding import ExtraEstimate
from torchid.parameters import PARAMETERS, PER_BODY, UNITS, Array
from torchid.robot import Robot
from torchid.robot.urdf import parse_xml

_LARGEST = 1e100
_ACCEPTED = "a number between -1e100 and 1e100"


def parameters_document(
    robot: Robot, estimate: Estimate, by_state: Mapping[str, Estimate], extras: Sequence[ExtraEstimate] = ()
) -> dict[str, Any]:
    """What `parameters.json` holds; a standard error or a share that the data do not give is null.

    Args:
        robot: the robot.
        estimate: of all data.
        by_state: of the data of each contact state alone.
        extras: offsets, scales and actuator terms.
    """
    nominal = [{"nominal": _named(phi)} for phi in robot.nominal]
    identified = _bodies(robot, {"identified": estimate.phi} | _judged(estimate))
    return {
        "units": dict(zip(PARAMETERS, UNITS, strict=True)),
        "frame": "each body's link frame, inertia about its origin",
        "massless": list(robot.massless),
        "verdicts": estimate.verdict_counts(),
        "bodies": [{"name": body["name"]} | before | body for body, before in zip(identified, nominal, strict=True)],
        "extras": [_extra(x) for x in extras],
        "contact_states": [
            {
                "name": name,
                "rank": alone.rank,
                "condition_number": _plain(alone.condition_number),
                "singular_values": alone.singular_values.tolist(),
                "verdicts": alone.verdict_counts(),
                "bodies": _bodies(robot, _judged(alone)),
            }
            for name, alone in by_state.items()
        ],
    }


def _judged(estimate: Estimate) -> dict[str, np.ndarray]:
    """How far each parameter can be trusted, (12 L,) each."""
    names = ("standard_error", "identifiable", "data_share", "verdict")
    return {name: getattr(estimate, name) for name in names}


def _bodies(robot: Robot, columns: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Columns (12 L,) by body and parameter."""
    per_body = {name: x.reshape(-1, PER_BODY) for name, x in columns.items()}
    return [
        {"name": name} | {column: _named(values[body]) for column, values in per_body.items()}
        for body, name in enumerate(robot.body_names)
    ]


def _extra(estimate: ExtraEstimate) -> dict[str, Any]:
    """An offset, scale or actuator term; `log` is null for one of all logs."""
    extra = estimate.extra
    return {
        "what": extra.what,
        "name": extra.name,
        "component": extra.component or None,
        "log": estimate.log or None,
        "unit": extra.unit,
        "value": estimate.value,
        "nominal_value": estimate.nominal_value,
        "standard_error": _plain(estimate.standard_error),
        "inflation": _plain(estimate.inflation),
        "told_apart": estimate.separable,
        "mixed_with": list(estimate.confounded_with),
        "label": extra.label,
    }


def read_shared_extras(path: Path, column: str = "value") -> dict[str, float]:
    """Extra parameters of all logs, by `Extra.label`, of a run's file.

    Args:
        path: `parameters.json`.
        column: "value" or "nominal_value".

    Raises:
        InputError: an entry that is none.
    """
    entries = _document(path).get("extras", [])
    out = {}
    for entry in entries if isinstance(entries, list) else [None]:
        if not (isinstance(entry, dict) and isinstance(entry.get("label"), str)):
            raise InputError(path, "extras", "an entry without a label", "what torchid identify wrote")
        value = entry.get(column)
        if not _is_usable(value):
            raise InputError(path, f"extras, {entry['label']}, {column}", f"{value!r}", _ACCEPTED)
        if entry.get("log") is None:
            out[entry["label"]] = float(value)
    return out


def _named(values: np.ndarray) -> dict[str, Any]:
    return {name: _plain(x) for name, x in zip(PARAMETERS, values, strict=True)}


def read_parameters(path: Path, robot: Robot) -> Array:
    """Identified parameters, (L, 12), of a `parameters.json` that belongs to the robot.

    Raises:
        InputError: the file cannot be read or holds other bodies.
    """
    bodies = _document(path).get("bodies")
    bodies = bodies if isinstance(bodies, list) else []
    names = [body.get("name") if isinstance(body, dict) else None for body in bodies]
    if names != list(robot.body_names):
        raise InputError(path, "bodies", f"not the bodies of {robot.path}", ", ".join(robot.body_names))
    return np.array([[_number(path, body, name) for name in PARAMETERS] for body in bodies])


def _document(path: Path) -> dict[str, Any]:
    try:
        with during("reading", path):
            document = json.loads(read_bytes(path, MAX_JSON).decode())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path, "file", f"not readable as JSON ({error})", "a run's parameters.json") from error
    return document if isinstance(document, dict) else {}


def _number(path: Path, body: dict[str, Any], name: str) -> float:
    identified = body.get("identified")
    value = identified.get(name) if isinstance(identified, dict) else None
    if not _is_usable(value):
        raise InputError(path, f"body '{body['name']}', identified.{name}", f"{value!r}", _ACCEPTED)
    return float(value)


def _is_usable(value: object) -> TypeGuard[float]:
    """Whether it is a number whose products and squares a float64 can hold."""
    return not isinstance(value, bool) and isinstance(value, (int, float)) and abs(value) <= _LARGEST


def _plain(x: Any) -> float | bool | str | None:
    if isinstance(x, str):
        return str(x)
    if isinstance(x, np.bool_):
        return bool(x)
    return float(x) if np.isfinite(x) else None


def identified_urdf(robot: Robot, phi: Array) -> bytes:
    """The URDF with parameters `phi`, (L, 12).

    A body's whole inertia goes to the link that names it; links welded to it say that they have none. Relative mesh
    paths stay as they were written.

    Warns:
        TorchidWarning: bodies that no distribution of positive mass can have, or negative friction, which simulators
            (and `load_robot`) refuse.
    """
    tree = parse_xml(robot.path)
    links = {link.get("name"): link for link in tree.getroot().findall("link")}
    joints = {joint.get("name"): joint for joint in tree.getroot().findall("joint")}
    _warn(robot, phi)
    for body, values in zip(robot.bodies, phi, strict=True):
        if body.joint is not None and body.joint.kind != "fixed":
            _set_friction(joints[body.joint.name], values)
        if not body.massless or values[parameters.INERTIAL].any():
            for name in body.links:
                _set_inertial(links[name], values if name == body.name and values[parameters.MASS] else None)
    etree.indent(tree)
    return etree.tostring(tree, xml_declaration=True, encoding="utf-8")


def _warn(robot: Robot, phi: Array) -> None:
    impossible, driving = [], []
    for body, values in zip(robot.bodies, phi, strict=True):
        margin = parameters.consistency_margin(values)
        if values.any() and (values[parameters.MASS] < 0.0 or margin < parameters.POSSIBLE_MARGIN):
            impossible.append(body.name)
        if body.joint is not None and (values[parameters.FRICTION] < 0.0).any():
            driving.append(body.joint.name)
    if impossible:
        message = f"identified.urdf: no distribution of positive mass has the parameters of {', '.join(impossible)}"
        warn(f"{message}; simulators will refuse or misread them")
    if driving:
        message = f"identified.urdf: negative friction at {', '.join(driving)}; simulators and torchid refuse it"
        warn(message)


def _set_inertial(link: etree._Element, values: Array | None) -> None:
    """Parameters (12,) of a link, or None for a link whose matter is counted elsewhere.

    That one says 0 kg instead of nothing: of a link that collides and has no `<inertial>` MuJoCo makes up one of the
    density of water, Bullet one of 1 kg.
    """
    before = link.findall("inertial")
    for inertial in before:
        link.remove(inertial)
    if values is not None:
        link.insert(0, _inertial(*parameters.mass_com_inertia(values)))
    elif before or link.find("collision") is not None:
        link.insert(0, _inertial(0.0, np.zeros(3), np.zeros((3, 3))))


def _inertial(mass: float, com: Array, inertia: Array) -> etree._Element:
    element = etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=" ".join(repr(float(x)) for x in com), rpy="0 0 0")
    etree.SubElement(element, "mass", value=repr(mass))
    numbers = {
        "i" + "xyz"[row] + "xyz"[column]: repr(float(inertia[row, column])) for row, column in parameters.INERTIA_AXES
    }
    etree.SubElement(element, "inertia", numbers)
    return element


def _set_friction(joint: etree._Element, values: Array) -> None:
    coulomb, viscous = values[parameters.FRICTION]
    dynamics = joint.find("dynamics")
    if dynamics is None:
        if not np.any(values[parameters.FRICTION]):
            return
        dynamics = etree.SubElement(joint, "dynamics")
    dynamics.set("friction", repr(float(coulomb)))
    dynamics.set("damping", repr(float(viscous)))
