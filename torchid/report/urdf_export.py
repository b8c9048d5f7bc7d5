"""`identified.urdf`: the robot's URDF with the identified inertia and friction, everything else as it was."""

from __future__ import annotations

import warnings

import numpy as np
from lxml import etree

from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.parameters import Array
from torchid.robot import Robot
from torchid.robot.urdf import parse_xml


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
        warnings.warn(f"{message}; simulators will refuse or misread them", TorchidWarning, stacklevel=3)
    if driving:
        message = f"identified.urdf: negative friction at {', '.join(driving)}; simulators and torchid refuse it"
        warnings.warn(message, TorchidWarning, stacklevel=3)


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
