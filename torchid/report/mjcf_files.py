"""MJCF with identified parameters: the robot's own file, or one made of its URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from lxml import etree

from torchid import parameters
from torchid.errors import InputError, join_names, warn
from torchid.parameters import Array
from torchid.report.urdf_files import warn_if_inconsistent, without_links_beyond_welds
from torchid.robot import Robot
from torchid.robot.mjcf_model import MjcfModel, body_elements, complaint, parse_model

NAME = "identified.xml"
_RULES = ("settotalmass", "boundmass", "boundinertia", "balanceinertia")
"""Attributes of `<compiler>` by which MuJoCo changes inertias that a file states."""


def identified_mjcf(
    robot: Robot,
    phi: Array,
    armature: Mapping[str, float],
    springs: Mapping[str, tuple[float, float]] | None = None,
) -> bytes:
    """The MJCF file of a robot with parameters `phi`, (L, 12), and what joints have; all else is as it was.

    Included files stand in it, and paths of meshes do not change. The inertia of a body is that of the body whose joint
    moves it; those welded to it have none. Where MuJoCo multiplies elements (`<replicate>`, `<attach>`), the file is
    its own of all that is left of them, with six digits of whatever was not identified.

    Args:
        robot: of an MJCF file.
        phi: identified parameters.
        armature: by joint [kg m^2 or kg], of those whose armature was fitted.
        springs: likewise, stiffness [N m/rad or N/m] and position at rest [rad or m].

    Warns:
        TorchidWarning: bodies or joints that MuJoCo will refuse.
    """
    model = MjcfModel(robot.path)
    root = parse_model(model.spec.to_xml()) if model.text.multiplies else model.text.root
    elements = body_elements(root)
    number = {name: i for i, name in enumerate(model.bodies)}
    explicit = _state_inertias(root, model)
    rest = without_links_beyond_welds(robot, phi)
    moving = np.array([[body.name != model.bodies[0]] for body in robot.bodies])  # the world has no inertia there
    warn_if_inconsistent(robot, moving * rest, NAME)
    written = set[int]()
    for body, values, own, before in zip(robot.bodies, rest, phi, robot.nominal, strict=True):
        if np.array_equal(own[parameters.INERTIAL], before[parameters.INERTIAL]) or body.name == model.bodies[0]:
            continue
        for name in (link for link in body.links if link in number and link not in robot.links_beyond_welds):
            _set_inertial(elements[number[name]][0], values if name == body.name else np.zeros(parameters.PER_BODY))
            written.add(number[name])
    for i in range(1, model.model.nbody) if explicit else ():
        if i not in written:
            _set_inertial(elements[i][0], model.inertial(i))
    _set_joints(robot, model, elements, rest, armature)
    in_degrees = not model.text.multiplies and bool(model.spec.compiler.degree)
    for name, (stiffness, at_rest) in (springs or {}).items():
        joint = model.joints.index(name)
        turns = in_degrees and not model.slides(joint)
        element = _joint_element(model, elements, joint)
        element.set("stiffness", repr(stiffness))
        element.set("springref", repr(float(np.degrees(at_rest)) if turns else at_rest))
    etree.indent(root)
    return etree.tostring(root, encoding="utf-8", xml_declaration=True)


def _state_inertias(root: etree._Element, model: MjcfModel) -> bool:
    """Let MuJoCo take inertias as they are stated; whether all of them must then be, as they were computed."""
    computed = model.computes_inertias
    for compiler in root.findall("compiler") if computed else ():
        for name in _RULES:
            compiler.attrib.pop(name, None)
        if compiler.get("inertiafromgeom") == "true":
            compiler.set("inertiafromgeom", "auto")
    return computed


def _set_inertial(body: etree._Element, values: Array) -> None:
    """Write the parameters (10,) of a body, 0 kg of one whose inertia belongs to another one."""
    for inertial in body.findall("inertial"):
        body.remove(inertial)
    body.insert(0, inertial_element(values))


def inertial_element(values: Array) -> etree._Element:
    """Inertial parameters (10,) as MJCF states them."""
    if not values[parameters.MASS]:
        return etree.Element("inertial", pos="0 0 0", mass="0", diaginertia="0 0 0")
    mass, com, inertia = parameters.mass_com_inertia(values)
    numbers = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    return etree.Element("inertial", pos=numbers_text(com), mass=repr(float(mass)), fullinertia=numbers_text(numbers))


def numbers_text(numbers: Sequence[float] | Array) -> str:
    """Numbers to the last digit."""
    return " ".join(repr(float(x)) for x in numbers)


def _set_joints(
    robot: Robot,
    model: MjcfModel,
    elements: Sequence[tuple[etree._Element, Sequence[etree._Element]]],
    phi: Array,
    armature: Mapping[str, float],
) -> None:
    """Write friction and armatures that are not what they were."""
    follow = _armature_of_mimics(robot)
    for body, values, before in zip(robot.bodies, phi, robot.nominal, strict=True):
        joint = body.joint
        if joint is None or joint.kind == "fixed":
            continue
        number = model.joints.index(joint.name)
        element = _joint_element(model, elements, number)
        for name, index in (("frictionloss", parameters.COULOMB), ("damping", parameters.VISCOUS)):
            if values[index] != before[index] or (name == "damping" and model.has_spring_damper(number)):
                element.set(name, repr(float(values[index])))
        if model.has_spring_damper(number):  # which MuJoCo would compute from the inertia
            element.set("springdamper", "0 0")
            element.set("stiffness", repr(joint.stiffness))
        if joint.name in armature:
            element.set("armature", repr(armature[joint.name] - follow.get(joint.name, 0.0)))
    negative = [name for name, value in armature.items() if value < follow.get(name, 0.0)]
    if negative:
        warn(f"{NAME}: negative armature at {join_names(negative)}; MuJoCo refuses it")


def _joint_element(
    model: MjcfModel, elements: Sequence[tuple[etree._Element, Sequence[etree._Element]]], number: int
) -> etree._Element:
    """The element of a joint, by its number."""
    of = int(model.model.jnt_bodyid[number])
    return elements[of][1][number - int(model.model.body_jntadr[of])]


def _armature_of_mimics(robot: Robot) -> dict[str, float]:
    """What joints that mimic others add to the armature of these, by the others' names."""
    out: dict[str, float] = {}
    for body in robot.bodies:
        joint = body.joint
        if joint is not None and joint.mimic is not None:
            added = joint.mimic.multiplier**2 * joint.armature
            out[joint.mimic.master] = out.get(joint.mimic.master, 0.0) + added
    return out


def require_loadable(text: bytes, source: Path) -> None:
    """Make sure that MuJoCo takes a model.

    Raises:
        InputError: it does not.
    """
    if found := complaint(text):
        raise InputError(source, "MJCF", f"MuJoCo refuses it: {found}", "a robot that MuJoCo can simulate")
