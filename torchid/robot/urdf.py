"""Reading a URDF: strict XML, then yourdfpy's float64 parse of what carries kinematics or inertia."""

from __future__ import annotations

import io
from collections import Counter
from pathlib import Path

import numpy as np
import yourdfpy
from lxml import etree
from yourdfpy.urdf import Joint, Link

from torchid.errors import UnknownNameError, UrdfError

MOVING_TYPES = ("revolute", "continuous", "prismatic")
JOINT_TYPES = (*MOVING_TYPES, "fixed")
_KEPT = {"link": {"inertial"}, "joint": {"origin", "parent", "child", "axis", "mimic", "dynamics"}}
_INERTIA_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SCALARS = ("value", "multiplier", "offset", "damping", "friction", *_INERTIA_ATTRIBUTES)
_NUMBERS = {"xyz": 3, "rpy": 3} | dict.fromkeys(_SCALARS, 1)  # how many an attribute holds


def parse_xml(path: Path) -> etree._ElementTree:
    """The URDF's XML tree; entities stay unresolved and nothing is fetched.

    Raises:
        UrdfError: the file is missing or is not well-formed XML with a `<robot>` root.
    """
    try:
        tree = etree.parse(str(path), etree.XMLParser(resolve_entities=False, no_network=True))
    except OSError as error:
        found = "a folder" if path.is_dir() else "cannot be read" if path.exists() else "no such file"
        raise UrdfError(path, "file", found, "a readable URDF file") from error
    except etree.XMLSyntaxError as error:
        raise UrdfError(path, "XML", f"not well-formed: {error.msg}", "a well-formed URDF") from error
    root = tree.getroot()
    if root.tag != "robot":
        raise UrdfError(path, "XML root", f"<{root.tag!s}>", "<robot>")
    return tree


def read_urdf(path: Path) -> tuple[list[Link], list[Joint]]:
    """Links and joints of a URDF, checked so far as one element at a time can be.

    Visual, collision, material and transmission tags are dropped before the parse: they carry no kinematics, and
    meshes need not be there.

    Raises:
        UrdfError: names missing or duplicate, references broken, joint types other than revolute, continuous,
            prismatic and fixed, numbers missing or not finite, mass negative.
    """
    root = parse_xml(path).getroot()
    stripped = etree.Element("robot", name=root.get("name", path.stem))
    for element in root:
        kept = _KEPT.get(str(element.tag))
        if kept is not None:
            copy = etree.SubElement(stripped, str(element.tag), dict(element.attrib))
            copy.extend([child for child in element if child.tag in kept])
    _check_names(path, stripped)
    links, joints = ([element.get("name", "") for element in stripped.findall(tag)] for tag in ("link", "joint"))
    for element in stripped:
        _check_numbers(path, element)
    for element in stripped.findall("joint"):
        _check_joint(path, element, links, joints)
    for element in stripped.findall("link"):
        _check_link(path, element)
    try:
        model = yourdfpy.URDF.load(
            io.BytesIO(etree.tostring(stripped)), build_scene_graph=False, load_meshes=False
        ).robot
        for joint in model.joints:
            if joint.dynamics is not None:  # left as text by yourdfpy
                joint.dynamics.damping = float(joint.dynamics.damping or 0.0)
                joint.dynamics.friction = float(joint.dynamics.friction or 0.0)
    except ValueError as error:
        raise UrdfError(path, "XML", f"a number cannot be read: {error}", "decimal numbers") from error
    _check_inertials(path, model.links)
    _check_joint_values(path, model.joints)
    return model.links, model.joints


def _check_names(path: Path, root: etree._Element) -> None:
    for tag in ("link", "joint"):
        names = [element.get("name") for element in root.findall(tag)]
        if None in names or "" in names:
            position = next(i for i, name in enumerate(names) if not name)
            raise UrdfError(path, f"{tag} number {position + 1}", "no name", "a unique name")
        duplicates = [name for name, count in Counter(names).items() if count > 1]
        if duplicates:
            raise UrdfError(path, f"{tag} '{duplicates[0]}'", "defined more than once", "unique names")
    if root.find("link") is None:
        raise UrdfError(path, "link", "none found", "at least one <link>")


def _check_numbers(path: Path, owner: etree._Element) -> None:
    """Refuse what is no decimal number, before a parser that would not say where it stands."""
    for element in owner.iter():
        for name, text in element.attrib.items():
            count = _NUMBERS.get(str(name), 0)
            if not count:
                continue
            words = str(text).split()
            try:
                readable = len([float(word) for word in words]) == count
            except ValueError:
                readable = False
            if not readable:
                hint = " (expand xacro first)" if "${" in str(text) else ""
                field = f"{owner.tag!s} '{owner.get('name')}', <{element.tag!s} {name!s}>"
                accepted = f"{count} decimal number{'s' if count > 1 else ''}{hint}"
                raise UrdfError(path, field, f"'{text!s}'", accepted)


def _check_joint(path: Path, joint: etree._Element, links: list[str], joints: list[str]) -> None:
    field, kind = f"joint '{joint.get('name')}'", joint.get("type")
    if kind not in JOINT_TYPES:
        found = "no type" if kind is None else f"type '{kind}'"
        raise UrdfError(path, field, found, ", ".join(JOINT_TYPES))
    for end in ("parent", "child"):
        element = joint.find(end)
        name = None if element is None else element.get("link")
        if name is None:
            raise UrdfError(path, field, f"no <{end}> link", "the name of a link")
        if name not in links:
            raise UnknownNameError(path, f"{field}, <{end}>", name, links)
    mimic = joint.find("mimic")
    if mimic is not None and mimic.get("joint") is None:
        raise UrdfError(path, f"{field}, <mimic>", "no joint", "the name of a joint")
    if mimic is not None and mimic.get("joint") not in joints:
        raise UnknownNameError(path, f"{field}, <mimic>", str(mimic.get("joint")), joints)


def _check_link(path: Path, link: etree._Element) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        return
    field = f"link '{link.get('name')}', <inertial>"
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or mass.get("value") is None:
        raise UrdfError(path, field, "no <mass value=...>", "a mass [kg], or no <inertial> at all")
    missing = _INERTIA_ATTRIBUTES if inertia is None else [a for a in _INERTIA_ATTRIBUTES if inertia.get(a) is None]
    if missing:
        raise UrdfError(path, field, f"no {', '.join(missing)}", "all six numbers of <inertia> [kg m^2]")


def _check_inertials(path: Path, links: list[Link]) -> None:
    for link in links:
        if link.inertial is None:
            continue
        field = f"link '{link.name}', <inertial>"
        values = [link.inertial.mass, *link.inertial.inertia.flat]
        if link.inertial.origin is not None:
            values += [*link.inertial.origin.flat]
        if not np.isfinite(values).all():
            raise UrdfError(path, field, "a number that is not finite", "finite numbers")
        if link.inertial.mass < 0.0:
            raise UrdfError(path, field, f"mass {link.inertial.mass:g} kg", "mass > 0, or 0 for a massless link")


def _check_joint_values(path: Path, joints: list[Joint]) -> None:
    for joint in joints:
        field = f"joint '{joint.name}'"
        if joint.mimic is not None and not np.isfinite([joint.mimic.multiplier, joint.mimic.offset]).all():
            raise UrdfError(path, f"{field}, <mimic>", "a number that is not finite", "finite numbers")
        if joint.dynamics is not None:
            friction = np.array([joint.dynamics.damping, joint.dynamics.friction])
            if not (np.isfinite(friction).all() and (friction >= 0.0).all()):
                found = "damping {:g}, friction {:g}".format(*friction)
                raise UrdfError(path, f"{field}, <dynamics>", found, "finite numbers of at least 0")
        if joint.origin is not None and not np.isfinite(joint.origin).all():
            raise UrdfError(path, f"{field}, <origin>", "a number that is not finite", "finite numbers")
        if joint.type in MOVING_TYPES:
            norm = np.linalg.norm(joint.axis) if joint.axis.shape == (3,) else np.nan
            if not (np.isfinite(norm) and norm > 0.0):
                raise UrdfError(path, f"{field}, <axis>", f"'{joint.axis}'", "three numbers, not all zero")
