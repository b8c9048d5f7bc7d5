"""Reading a URDF: strict XML, then yourdfpy's float64 parse of what carries kinematics or inertia."""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import yourdfpy
from lxml import etree
from yourdfpy.urdf import Joint, Link

from torchid.errors import UnknownNameError, UrdfError
from torchid.guards import MAX_LETTERS, MAX_LINKS, MAX_NUMBER, MAX_URDF, format_bytes, read_bytes
from torchid.text import excerpt, is_plain

MOVING_TYPES = ("revolute", "continuous", "prismatic")
JOINT_TYPES = (*MOVING_TYPES, "fixed")
_KEPT = {"link": {"inertial"}, "joint": {"origin", "parent", "child", "axis", "mimic", "dynamics"}}
_INERTIA_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SCALARS = ("value", "multiplier", "offset", "damping", "friction", *_INERTIA_ATTRIBUTES)
_NUMBERS = {"xyz": 3, "rpy": 3} | dict.fromkeys(_SCALARS, 1)  # how many an attribute holds
_DECIMAL = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?|nan)", re.ASCII | re.IGNORECASE)


def parse_xml(path: Path) -> etree._ElementTree:
    """The URDF's XML tree; entities stay unresolved and nothing is fetched.

    Raises:
        UrdfError: the file is missing or is not well-formed XML with a `<robot>` root.
    """
    try:  # not by its name: libxml2 would unpack what is compressed, without bounds
        content = read_bytes(path, MAX_URDF)
    except FileNotFoundError as error:
        raise UrdfError(path, "file", "no such file", "a readable URDF file") from error
    except OSError as error:
        raise UrdfError(path, "file", f"cannot be read ({error.strerror})", "a readable URDF file") from error
    except ValueError as error:
        accepted = f"a URDF of at most {format_bytes(MAX_URDF)}"
        raise UrdfError(path, "file", f"cannot be read ({error})", accepted) from error
    try:
        tree = etree.parse(io.BytesIO(content), etree.XMLParser(resolve_entities=False, no_network=True))
    except (etree.XMLSyntaxError, ValueError, LookupError) as error:
        found = excerpt(getattr(error, "msg", None) or str(error), 200)
        raise UrdfError(path, "XML", f"not well-formed: {found}", "a well-formed URDF") from error
    root = tree.getroot()
    if root.tag != "robot":
        raise UrdfError(path, "XML root", f"<{excerpt(str(root.tag))}>", "<robot>")
    return tree


def read_urdf(path: Path) -> tuple[list[Link], list[Joint]]:
    """Links and joints of a URDF, checked so far as one element at a time can be.

    Visual, collision, material and transmission tags are dropped before the parse: they carry no kinematics, and
    meshes need not be there.

    Raises:
        UrdfError: names missing or duplicate, references broken, joint types other than revolute, continuous,
            prismatic and fixed, numbers missing, not finite or beyond `MAX_NUMBER`, mass negative, more than
            `MAX_LINKS` links.
    """
    stripped = _stripped(path)
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
    _check_masses(path, model.links)
    _check_joint_values(path, model.joints)
    return model.links, model.joints


def _stripped(path: Path) -> etree._Element:
    """The URDF's XML, without what is not read."""
    root = parse_xml(path).getroot()
    for tag in ("link", "joint"):
        count = len(root.findall(tag))
        if count > MAX_LINKS:
            raise UrdfError(path, tag, f"{count} of them", f"at most {MAX_LINKS}")
    stripped = etree.Element("robot", name=root.get("name", path.stem))
    for element in root:
        kept = _KEPT.get(str(element.tag))
        if kept is not None:
            copy = etree.SubElement(stripped, str(element.tag), dict(element.attrib))
            copy.extend([child for child in element if child.tag in kept])
    return stripped


def _check_names(path: Path, root: etree._Element) -> None:
    for tag in ("link", "joint"):
        names = [element.get("name") for element in root.findall(tag)]
        if None in names or "" in names:
            position = next(i for i, name in enumerate(names) if not name)
            raise UrdfError(path, f"{tag} number {position + 1}", "no name", "a unique name")
        for position, name in enumerate(names):
            _check_name(path, f"{tag} number {position + 1}", str(name))
        duplicates = [name for name, count in Counter(names).items() if count > 1]
        if duplicates:
            raise UrdfError(path, f"{tag} '{duplicates[0]}'", "defined more than once", "unique names")
    if root.find("link") is None:
        raise UrdfError(path, "link", "none found", "at least one <link>")


def _check_name(path: Path, field: str, name: str) -> None:
    if len(name) > MAX_LETTERS or not is_plain(name) or "$" in name:
        accepted = f"a printable name of at most {MAX_LETTERS} characters, without $ (expand xacro first)"
        raise UrdfError(path, field, f"name '{excerpt(name)}'", accepted)


def _check_numbers(path: Path, owner: etree._Element) -> None:
    """Refuse what is no decimal number, before a parser that would not say where it stands."""
    of = f"{owner.tag!s} '{owner.get('name')}'"
    for part in owner:
        for element in part.iter():
            for name, text in element.attrib.items():
                count, text = _NUMBERS.get(str(name), 0), str(text)
                if not count:
                    continue
                words = text.split()
                if len(words) != count or not all(_DECIMAL.fullmatch(word) for word in words):
                    hint = " (expand xacro first)" if "${" in text else ""
                    accepted = f"{count} decimal number{'s' if count > 1 else ''}{hint}"
                    raise UrdfError(path, f"{of}, <{element.tag!s} {name!s}>", f"'{excerpt(text)}'", accepted)
                _check_size(path, f"{of}, <{part.tag!s}>", [float(word) for word in words])


def _check_size(path: Path, field: str, numbers: list[float]) -> None:
    if not all(map(math.isfinite, numbers)):
        raise UrdfError(path, field, "a number that is not finite", "finite numbers")
    largest = max(map(abs, numbers))
    if largest > MAX_NUMBER:
        raise UrdfError(path, field, f"a number of size {largest:.3g}", f"numbers of at most {MAX_NUMBER:g}")


def _check_joint(path: Path, joint: etree._Element, links: list[str], joints: list[str]) -> None:
    field, kind = f"joint '{joint.get('name')}'", joint.get("type")
    if kind not in JOINT_TYPES:
        found = "no type" if kind is None else f"type '{excerpt(kind)}'"
        raise UrdfError(path, field, found, ", ".join(JOINT_TYPES))
    for end in ("parent", "child"):
        element = joint.find(end)
        name = None if element is None else element.get("link")
        if name is None:
            raise UrdfError(path, field, f"no <{end}> link", "the name of a link")
        if name not in links:
            _check_name(path, f"{field}, <{end}>", name)
            raise UnknownNameError(path, f"{field}, <{end}>", name, links)
    mimic = joint.find("mimic")
    if mimic is not None and mimic.get("joint") is None:
        raise UrdfError(path, f"{field}, <mimic>", "no joint", "the name of a joint")
    if mimic is not None and mimic.get("joint") not in joints:
        _check_name(path, f"{field}, <mimic>", str(mimic.get("joint")))
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


def _check_masses(path: Path, links: list[Link]) -> None:
    for link in links:
        if link.inertial is not None and link.inertial.mass < 0.0:
            field = f"link '{link.name}', <inertial>"
            raise UrdfError(path, field, f"mass {link.inertial.mass:g} kg", "mass > 0, or 0 for a massless link")


def _check_joint_values(path: Path, joints: list[Joint]) -> None:
    for joint in joints:
        field = f"joint '{joint.name}'"
        if joint.dynamics is not None and min(joint.dynamics.damping, joint.dynamics.friction) < 0.0:
            found = f"damping {joint.dynamics.damping:g}, friction {joint.dynamics.friction:g}"
            raise UrdfError(path, f"{field}, <dynamics>", found, "numbers of at least 0")
        if joint.type in MOVING_TYPES and not np.linalg.norm(joint.axis) > 0.0:
            raise UrdfError(path, f"{field}, <axis>", f"'{joint.axis}'", "three numbers, not all zero")
