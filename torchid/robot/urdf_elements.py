"""Links and joints of a URDF, from elements whose numbers have been checked."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import numpy as np
from lxml import etree

from torchid.parameters import Array
from torchid.robot.xml_files import OWN


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass [kg], inertia about the centre of mass, (3, 3) [kg m^2], and the pose in the link that it is stated in."""

    mass: float
    inertia: Array
    origin: Array


@dataclass(frozen=True, eq=False)
class Link:
    """A link, with its inertia if it has one."""

    name: str
    inertial: Inertial | None

    @classmethod
    def of(cls, element: etree._Element) -> Link:
        """The link of an element."""
        inertial = element.find("inertial")
        return cls(element.attrib["name"], None if inertial is None else _inertial(inertial))


@dataclass(frozen=True)
class JointMimic:
    """Position = multiplier * (position of `joint`) + offset [rad or m]."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class TreeJoint:
    """A joint of a URDF, with what a URDF cannot say of it.

    Attributes:
        name, type: of the joint.
        parent, child: names of the links.
        origin: pose of the joint's frame in the parent link's, (4, 4) [m].
        axis: (3,), of any length.
        mimic: which joint it follows, None for none.
        damping, friction: [N m s/rad or N s/m, N m or N].
        child_offset: origin of the child link's frame in the moved joint frame, (3,) [m].
        armature: reflected rotor inertia [kg m^2 or kg].
        stiffness, rest: of a spring [N m/rad or N/m], and the position at which it exerts no force [rad or m].
        passive: whether no motor drives it.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: Array
    axis: Array
    mimic: JointMimic | None
    damping: float
    friction: float
    child_offset: tuple[float, ...]
    armature: float
    stiffness: float
    rest: float
    passive: bool

    @classmethod
    def of(cls, element: etree._Element) -> TreeJoint:
        """The joint of an element."""
        (parent, child), mimic = (element.find(end) for end in ("parent", "child")), element.find("mimic")
        dynamics = _attributes(element.find("dynamics"))
        return cls(
            name=element.attrib["name"],
            type=element.attrib["type"],
            parent=_attributes(parent)["link"],
            child=_attributes(child)["link"],
            origin=_pose(element.find("origin")),
            axis=np.array(_numbers(element.find("axis"), "xyz", "1 0 0")),
            mimic=None if mimic is None else _mimic(mimic),
            damping=float(dynamics.get("damping", 0.0)),
            friction=float(dynamics.get("friction", 0.0)),
            child_offset=_numbers(child, f"{OWN}xyz", "0 0 0"),
            armature=float(dynamics.get(f"{OWN}armature", 0.0)),
            stiffness=float(dynamics.get(f"{OWN}stiffness", 0.0)),
            rest=float(dynamics.get(f"{OWN}rest", 0.0)),
            passive=f"{OWN}passive" in dynamics,
        )


def _attributes(element: etree._Element | None) -> dict[str, str]:
    return {} if element is None else {str(name): str(text) for name, text in element.attrib.items()}


def _numbers(element: etree._Element | None, name: str, default: str) -> tuple[float, ...]:
    return tuple(map(float, _attributes(element).get(name, default).split()))


def _mimic(element: etree._Element) -> JointMimic:
    of = _attributes(element)
    return JointMimic(of["joint"], float(of.get("multiplier", 1.0)), float(of.get("offset", 0.0)))


def _inertial(element: etree._Element) -> Inertial:
    of = _attributes(element.find("inertia"))
    xx, xy, xz, yy, yz, zz = (float(of[name]) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Inertial(float(_attributes(element.find("mass"))["value"]), inertia, _pose(element.find("origin")))


def _pose(element: etree._Element | None) -> Array:
    """Pose of an `<origin>`, (4, 4) [m]: rolled about x, then pitched about y, then yawed about z, fixed axes."""
    T = np.eye(4)
    if element is not None:
        T[:3, 3] = _numbers(element, "xyz", "0 0 0")
        (si, sj, sk), (ci, cj, ck) = ([f(angle) for angle in _numbers(element, "rpy", "0 0 0")] for f in (sin, cos))
        T[:3, :3] = [
            [cj * ck, sj * (si * ck) - ci * sk, sj * (ci * ck) + si * sk],
            [cj * sk, sj * (si * sk) + ci * ck, sj * (ci * sk) - si * ck],
            [-sj, cj * si, cj * ci],
        ]
    return T
