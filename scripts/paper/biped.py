"""The description of the biped in `configs/`: the lower half of a Sarcos-size humanoid, 16 joints, 66 kg.

`scripts/make_biped.py` writes the URDF of the package from it; MuJoCo's model is made from that URDF.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lxml import etree

Triple = tuple[float, float, float]

NAME = "biped"
SPHERE = 0.01  # m, radius of a contact point
SOLE = (0.03, 0.0, -0.075)  # m, the sole's centre from the ankle
HALF_LENGTH, HALF_WIDTH = 0.11, 0.05  # m, from the sole's centre to its contact points


@dataclass(frozen=True)
class Segment:
    """A joint and the body it moves: a solid box.

    Attributes:
        body: name of the link.
        joint: name of the joint that moves it, None for the base.
        parent: name of the parent link.
        origin: of the joint in the parent's frame [m].
        axis: of the joint.
        limits: of the joint [rad].
        mass: [kg].
        com: centre of mass in the link's frame [m].
        box: edge lengths [m].
        tilt: roll, pitch, yaw of the box in the link's frame [rad].
    """

    body: str
    joint: str | None
    parent: str
    origin: Triple
    axis: str
    limits: tuple[float, float]
    mass: float
    com: Triple
    box: Triple
    tilt: Triple = (0.0, 0.0, 0.0)


# body, joint, parent, origin, axis, limits, / mass, centre of mass, box, tilt
_TRUNK = (
    Segment("pelvis", None, "", (0, 0, 0), "", (0, 0),
            11.0, (-0.01, 0.004, 0.06), (0.16, 0.28, 0.16), (0.05, 0.1, 0.0)),
    Segment("waist", "torso_roll", "pelvis", (0, 0, 0.14), "x", (-0.6, 0.6),
            2.5, (0.01, 0, 0.03), (0.12, 0.16, 0.08)),
    Segment("torso", "torso_pitch", "waist", (0, 0, 0.06), "y", (-0.6, 1.2),
            20.0, (0.015, -0.006, 0.2), (0.2, 0.34, 0.42), (0.08, -0.1, 0.06)),
)  # fmt: skip
# The left leg from the hip down; the right one is its mirror image.
_LEG = (
    Segment("hip", "hip_flexion", "pelvis", (0, 0.1, 0), "y", (-2.0, 0.7),
            2.0, (0.005, 0.02, -0.01), (0.1, 0.09, 0.1)),
    Segment("hip_fork", "hip_abduction", "hip", (0, 0, 0), "x", (-0.7, 0.9),
            1.5, (-0.02, 0.01, -0.05), (0.08, 0.1, 0.12)),
    Segment("thigh", "hip_rotation", "hip_fork", (0, 0, -0.08), "z", (-0.9, 0.9),
            6.5, (0.01, 0.008, -0.13), (0.14, 0.12, 0.3), (0.05, 0.08, 0.1)),
    Segment("knee", "knee_flexion", "thigh", (0, 0, -0.31), "y", (0.0, 2.3),
            2.5, (0.012, 0.006, -0.08), (0.1, 0.1, 0.2), (0.04, -0.06, 0.05)),
    Segment("shank", "shank_rotation", "knee", (0, 0, -0.2), "z", (-0.8, 0.8),
            1.8, (-0.01, 0.005, -0.07), (0.09, 0.08, 0.18), (0.03, 0.05, 0.1)),
    Segment("ankle", "ankle_flexion", "shank", (0, 0, -0.18), "y", (-1.3, 0.9),
            0.6, (0.004, 0.005, 0.002), (0.06, 0.06, 0.06)),
    Segment("foot", "ankle_abduction", "ankle", (0, 0, 0), "x", (-0.6, 0.6),
            1.3, (0.035, 0.004, -0.045), (0.24, 0.1, 0.05), (0.03, 0.06, 0.05)),
)  # fmt: skip


def segments() -> tuple[Segment, ...]:
    """The 17 bodies, parents before children."""
    return (*_TRUNK, *(_on_side(segment, side) for side in ("l", "r") for segment in _LEG))


def biped_urdf() -> bytes:
    """The URDF: the bodies, and a sole under each foot that carries four contact points."""
    robot = etree.Element("robot", name=NAME)
    for segment in segments():
        _add_segment(robot, segment)
    for side in ("l", "r"):
        _add_sole(robot, side)
    etree.indent(robot)
    return etree.tostring(robot, xml_declaration=True, encoding="utf-8") + b"\n"


def _on_side(segment: Segment, side: str) -> Segment:
    """The left leg's segment, or its mirror image in the x-z plane."""
    sign = 1.0 if side == "l" else -1.0
    reversed_axis = segment.axis in "xz" and side == "r"  # a mirrored rotation about x or z turns the other way
    low, high = segment.limits

    def mirrored(v: Triple) -> Triple:
        return (v[0], sign * v[1], v[2])

    return Segment(
        f"{side}_{segment.body}",
        f"{side}_{segment.joint}",
        segment.parent if segment.parent == "pelvis" else f"{side}_{segment.parent}",
        mirrored(segment.origin),
        segment.axis,
        (-high, -low) if reversed_axis else (low, high),
        segment.mass,
        mirrored(segment.com),
        segment.box,
        (sign * segment.tilt[0], segment.tilt[1], sign * segment.tilt[2]),
    )


def _add_segment(robot: etree._Element, segment: Segment) -> None:
    link = etree.SubElement(robot, "link", name=segment.body)
    inertial = etree.SubElement(link, "inertial")
    pose = {"xyz": _text(segment.com), "rpy": _text(segment.tilt)}
    etree.SubElement(inertial, "origin", pose)
    etree.SubElement(inertial, "mass", value=_text([segment.mass]))
    x, y, z = np.square(segment.box) * segment.mass / 12.0
    principal = {"ixx": y + z, "ixy": 0.0, "ixz": 0.0, "iyy": x + z, "iyz": 0.0, "izz": x + y}
    etree.SubElement(inertial, "inertia", {name: _text([value]) for name, value in principal.items()})
    visual = etree.SubElement(link, "visual")
    etree.SubElement(visual, "origin", pose)
    etree.SubElement(etree.SubElement(visual, "geometry"), "box", size=_text(segment.box))
    if segment.joint is None:
        return
    joint = etree.SubElement(robot, "joint", name=segment.joint, type="revolute")
    etree.SubElement(joint, "parent", link=segment.parent)
    etree.SubElement(joint, "child", link=segment.body)
    etree.SubElement(joint, "origin", xyz=_text(segment.origin))
    etree.SubElement(joint, "axis", xyz=_text(float(axis == segment.axis) for axis in "xyz"))
    low, high = segment.limits
    etree.SubElement(joint, "limit", lower=_text([low]), upper=_text([high]), effort="500", velocity="20")


def _add_sole(robot: etree._Element, side: str) -> None:
    sole = etree.SubElement(robot, "link", name=f"{side}_sole")
    for x in (HALF_LENGTH, -HALF_LENGTH):
        for y in (HALF_WIDTH, -HALF_WIDTH):
            point = etree.SubElement(sole, "collision")
            etree.SubElement(point, "origin", xyz=_text((x, y, SPHERE)))
            etree.SubElement(etree.SubElement(point, "geometry"), "sphere", radius=_text([SPHERE]))
    weld = etree.SubElement(robot, "joint", name=f"{side}_sole_weld", type="fixed")
    etree.SubElement(weld, "parent", link=f"{side}_foot")
    etree.SubElement(weld, "child", link=f"{side}_sole")
    etree.SubElement(weld, "origin", xyz=_text(SOLE))


def _text(numbers: object) -> str:
    return " ".join(f"{float(x):.12g}" for x in numbers)  # type: ignore[attr-defined]
