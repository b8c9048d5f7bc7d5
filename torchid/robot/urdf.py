"""Strict reading of a URDF, with limits on its size."""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yourdfpy
from lxml import etree
from yourdfpy.urdf import Joint, Link

from torchid.errors import UnknownNameError, UrdfError, excerpt, is_plain
from torchid.guards import MAX_LETTERS, MAX_LINKS, MAX_NUMBER
from torchid.robot.xml_files import MJCF_WORLD, OWN, drop_prefixed, is_mjcf, read_xml

MOVING_TYPES = ("revolute", "continuous", "prismatic")
JOINT_TYPES = (*MOVING_TYPES, "fixed")
_KEPT = {"link": {"inertial"}, "joint": {"origin", "parent", "child", "axis", "mimic", "dynamics"}}
_INERTIA_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_SCALARS = ("value", "multiplier", "offset", "damping", "friction", *_INERTIA_ATTRIBUTES)
_OF_MJCF = (f"{OWN}armature", f"{OWN}stiffness", f"{OWN}rest")
_NUMBERS = {"xyz": 3, "rpy": 3} | dict.fromkeys((*_SCALARS, *_OF_MJCF), 1)  # count of numbers in an attribute
_DECIMAL = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|inf(inity)?|nan)", re.ASCII | re.IGNORECASE)


def parse_xml(path: Path, with_world: bool = False) -> etree._ElementTree:
    """The XML tree of a URDF, or the one that says the same as an MJCF file, see `torchid.robot.mjcf`.

    Args:
        path: the file.
        with_world: whether a URDF keeps a link without mass whose only joint is a floating one to its child, and that
            joint: they are the world, not the robot.

    Raises:
        UrdfError: the file is missing, or is neither; or an MJCF robot is refused.
        InputError: an MJCF file, and MuJoCo is not installed.
    """
    tree = read_xml(path)
    if tree.getroot().tag != "mujoco":
        if not with_world:
            _drop_world(tree.getroot())
        return tree
    from torchid.robot.mjcf import urdf_document  # needs an extra

    return urdf_document(path)


def _drop_world(root: etree._Element) -> None:
    """Drop a link without mass whose only joint is a floating one to its child, and that joint."""
    ends = Counter(end.get("link") for end in root.iterfind("joint/*") if end.tag in ("parent", "child"))
    for joint in root.findall("joint[@type='floating']"):
        parent = joint.find("parent")
        name = None if parent is None else parent.get("link")
        link = next((link for link in root.findall("link") if link.get("name") == name), None)
        if link is None or ends[name] > 1:
            continue
        if not any(mass.get("value", "").strip("+-.0 ") for mass in link.iterfind("inertial/mass")):
            root.remove(link)
            root.remove(joint)


def has_fixed_base(path: Path) -> bool:
    """Whether a robot's file says that its base does not move: MJCF without a free joint; a URDF never says."""
    if not is_mjcf(path):
        return False
    return parse_xml(path).getroot().find(f"link[@name='{MJCF_WORLD}']") is not None


def drop_repeated_origins(root: etree._Element) -> None:
    """Keep the first `<origin>` of every element, the one that counts; simulators refuse several."""
    for element in root.iter(etree.Element):
        for again in element.findall("origin")[1:]:
            element.remove(again)


@dataclass(eq=False)
class TreeJoint(Joint):  # type: ignore[misc]
    """A joint with what a URDF cannot say of it.

    Attributes:
        child_offset: origin of the child link's frame in the moved joint frame, (3,) [m].
        armature: reflected rotor inertia [kg m^2 or kg].
        stiffness, rest: of a spring [N m/rad or N/m], and the position at which it exerts no force [rad or m].
        passive: whether no motor drives it.
    """

    child_offset: tuple[float, ...] = (0.0, 0.0, 0.0)
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    passive: bool = False


def _tree_joint(joint: Joint, element: etree._Element) -> TreeJoint:
    """A joint with the attributes of its element that yourdfpy does not read."""
    if joint.dynamics is not None:  # left as text by yourdfpy
        joint.dynamics.damping = float(joint.dynamics.damping or 0.0)
        joint.dynamics.friction = float(joint.dynamics.friction or 0.0)
    child = element.find("child")
    dynamics = element.find("dynamics")
    offset = "0 0 0" if child is None else child.get(f"{OWN}xyz", "0 0 0")
    attributes = getattr(dynamics, "attrib", {})
    beyond_urdf: dict[str, Any] = {
        name: float(attributes.get(OWN + name, 0.0)) for name in ("armature", "stiffness", "rest")
    }
    beyond_urdf |= {"child_offset": tuple(map(float, offset.split())), "passive": OWN + "passive" in attributes}
    return TreeJoint(**vars(joint), **beyond_urdf)


def read_urdf(path: Path) -> tuple[list[Link], list[TreeJoint]]:
    """Links and joints of a URDF, each element checked on its own; `build_tree` checks the tree.

    Visual, collision, material and transmission tags are dropped before the parse: they carry no kinematics, and
    meshes need not be there.

    Raises:
        UrdfError: names missing or duplicate, references broken, joint types other than revolute, continuous,
            prismatic and fixed, numbers missing, not finite or beyond `MAX_NUMBER`, mass negative, more than
            `MAX_LINKS` links, xacro that is not expanded.
    """
    root = _read_elements(path)
    _check_names(path, root)
    links, joints = ([element.get("name", "") for element in root.findall(tag)] for tag in ("link", "joint"))
    for element in root:
        _check_numbers(path, element)
    for element in root.findall("joint"):
        _check_joint(path, element, links, joints)
    for element in root.findall("link"):
        _check_link(path, element)
    try:
        model = yourdfpy.URDF.load(io.BytesIO(etree.tostring(root)), build_scene_graph=False, load_meshes=False).robot
        model.joints = [_tree_joint(*pair) for pair in zip(model.joints, root.findall("joint"), strict=True)]
    except ValueError as error:
        raise UrdfError(path, "XML", f"a number cannot be read: {error}", "decimal numbers") from error
    _check_values(path, model.links, model.joints)
    return model.links, model.joints


def _read_elements(path: Path) -> etree._Element:
    """The URDF's XML, reduced to the elements in `_KEPT`."""
    _refuse_xacro(path, root := parse_xml(path).getroot())
    drop_prefixed(root)
    for tag in ("link", "joint"):
        count = len(root.findall(tag))
        if count > MAX_LINKS:
            raise UrdfError(path, tag, f"{count} {tag}s", f"at most {MAX_LINKS}")
    stripped = etree.Element("robot", name=root.get("name", path.stem))
    for element in root:
        kept = _KEPT.get(str(element.tag))
        if kept is not None:
            copy = etree.SubElement(stripped, str(element.tag), dict(element.attrib))
            copy.extend([child for child in element if child.tag in kept])
    return stripped


def _refuse_xacro(path: Path, root: etree._Element) -> None:
    """Refuse elements of xacro, in whose place links and joints would stand."""
    for element in root.iter(etree.Element):
        name = f"{element.prefix}:{etree.QName(element).localname}" if element.prefix else str(element.tag)
        if name.startswith("xacro:"):
            reason = f"xacro is not expanded (line {element.sourceline})"
            raise UrdfError(path, f"<{excerpt(name)}>", reason, "the output of `xacro FILE.urdf.xacro`")


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
    """Refuse attributes that are not decimal numbers; yourdfpy's error would not name the element."""
    label = f"{owner.tag!s} '{owner.get('name')}'"
    for part in owner:
        for element in part.iter():
            for name, text in element.attrib.items():
                count = _NUMBERS.get(str(name), 0)
                text = str(text)
                if not count:
                    continue
                words = text.split()
                if len(words) != count or not all(_DECIMAL.fullmatch(word) for word in words):
                    hint = " (expand xacro first)" if "${" in text else ""
                    accepted = f"{count} decimal number{'s' if count > 1 else ''}{hint}"
                    raise UrdfError(path, f"{label}, <{element.tag!s} {name!s}>", f"'{excerpt(text)}'", accepted)
                _check_size(path, f"{label}, <{part.tag!s}>", [float(word) for word in words])


def _check_size(path: Path, field: str, numbers: list[float]) -> None:
    if not all(map(math.isfinite, numbers)):
        raise UrdfError(path, field, "a number is not finite", "finite numbers")
    largest = max(map(abs, numbers))
    if largest > MAX_NUMBER:
        raise UrdfError(path, field, f"a number of size {largest:.3g}", f"numbers of at most {MAX_NUMBER:g}")


def _check_joint(path: Path, joint: etree._Element, links: list[str], joints: list[str]) -> None:
    field = f"joint '{joint.get('name')}'"
    kind = joint.get("type")
    if kind not in JOINT_TYPES:
        reason = "no type" if kind is None else f"type '{excerpt(kind)}'"
        raise UrdfError(path, field, reason, ", ".join(JOINT_TYPES))
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
    mass = inertial.find("mass")
    inertia = inertial.find("inertia")
    if mass is None or mass.get("value") is None:
        raise UrdfError(path, field, "no <mass value=...>", "a mass [kg], or no <inertial>")
    missing = _INERTIA_ATTRIBUTES if inertia is None else [a for a in _INERTIA_ATTRIBUTES if inertia.get(a) is None]
    if missing:
        raise UrdfError(path, field, f"no {', '.join(missing)}", "all six numbers of <inertia> [kg m^2]")


def fixed_joints(path: Path) -> dict[str, str]:
    """Children of the fixed joints of a URDF that has been read, by joint."""
    return {
        joint.get("name", ""): child.get("link", "")
        for joint in parse_xml(path).getroot().findall("joint")
        if joint.get("type") == "fixed" and (child := joint.find("child")) is not None
    }


def position_limits(path: Path) -> dict[str, tuple[float, float]]:
    """Lowest and highest position [rad or m] of the joints that have limits, by name.

    Raises:
        UrdfError: a limit is no decimal number.
    """
    limits = {}
    for joint in parse_xml(path).getroot().findall("joint"):
        limit = joint.find("limit")
        if limit is None or joint.get("type") not in ("revolute", "prismatic"):
            continue
        low, high = (str(limit.get(name, "0")).strip() for name in ("lower", "upper"))
        if not (_DECIMAL.fullmatch(low) and _DECIMAL.fullmatch(high)):
            reason = f"'{excerpt(low)}' to '{excerpt(high)}'"
            raise UrdfError(path, f"joint '{joint.get('name')}', <limit>", reason, "decimal numbers")
        if float(low) < float(high):
            limits[str(joint.get("name"))] = (float(low), float(high))
    return limits


def _check_values(path: Path, links: list[Link], joints: list[Joint]) -> None:
    """Refuse negative masses and friction, and axes that are zero."""
    for link in links:
        if link.inertial is not None and link.inertial.mass < 0.0:
            field = f"link '{link.name}', <inertial>"
            raise UrdfError(path, field, f"mass {link.inertial.mass:g} kg", "mass > 0, or 0 for a massless link")
    for joint in joints:
        field = f"joint '{joint.name}'"
        if joint.dynamics is not None and min(joint.dynamics.damping, joint.dynamics.friction) < 0.0:
            reason = f"damping {joint.dynamics.damping:g}, friction {joint.dynamics.friction:g}"
            raise UrdfError(path, f"{field}, <dynamics>", reason, "numbers of at least 0")
        if joint.type in MOVING_TYPES and not np.linalg.norm(joint.axis) > 0.0:
            raise UrdfError(path, f"{field}, <axis>", f"'{joint.axis}'", "three numbers, not all zero")
