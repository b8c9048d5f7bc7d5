"""The sphere or cylinder about a frame's origin on which it rolls, from the collision shapes of the URDF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from torchid.parameters import Array
from torchid.robot.robot import Robot
from torchid.robot.shapes import read_numbers
from torchid.robot.urdf import parse_xml

_MAX_OFFSET_M, _MAX_OFFSET_SHARE = 1e-3, 0.1
"""Distance of a shape's centre or axis from the frame's origin up to which it is about the origin: either of both."""
_MAX_ANGLE = 0.02  # rad, between a cylinder and the axis of its contact


def rolled_distance(rotation: Array, radius: float, normal: Array, axis: str | None = None) -> Array:
    """How far the origin of a frame goes that rolls without slipping, (N, 3) [m], from the first sample on.

    Args:
        rotation: of the frame to the world, (N, 3, 3).
        radius: of the sphere or cylinder about its origin [m].
        normal: of the ground, (3,) or (N, 3).
        axis: x, y or z of the frame, along which a cylinder is; None for a sphere.
    """
    normals = np.broadcast_to(normal, (len(rotation), 3))
    if axis is not None:
        along = rotation[:, :, "xyz".index(axis)]
        across = normals - along * (along * normals).sum(axis=1, keepdims=True)
        normals = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    turned = Rotation.from_matrix(rotation[1:] @ rotation[:-1].transpose(0, 2, 1)).as_rotvec()
    steps = radius * np.cross(turned, 0.5 * (normals[1:] + normals[:-1]))
    out: Array = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return out


@dataclass(frozen=True)
class RollingShape:
    """A collision shape about a frame's origin: a "sphere" or "cylinder", its radius [m], and the link that has it."""

    kind: str
    radius: float
    link: str


class CollisionShapes:
    """The collision spheres and cylinders of a robot's links."""

    def __init__(self, robot: Robot) -> None:
        """Read the URDF, whose other shapes do not matter here."""
        self.robot = robot
        self._links = {link.get("name"): link for link in parse_xml(robot.path).getroot().findall("link")}

    def about(self, frame: str, axis: str | None = None) -> RollingShape | None:
        """The shape about a frame's origin, of its own link or of one that is welded to it; None if there is none.

        Of several, one of the frame's own link, then the largest, which touches the ground first.

        Args:
            frame: a link of the robot.
            axis: x, y or z of the frame, along which a cylinder must be; None for a sphere.

        Raises:
            UnknownNameError: no such link.
            UrdfError: a shape that is not described by numbers.
        """
        body, T_body_frame = self.robot.link(frame)
        T_frame_body = np.linalg.inv(T_body_frame)
        found: list[RollingShape] = []
        for name in sorted(self.robot.bodies[body].links, key=lambda name: name != frame):
            T_frame_link = T_frame_body @ self.robot.links[name][1]
            for element in self._links[name].findall("collision"):
                radius = self._radius_about(name, element, T_frame_link, axis)
                if radius > 0.0:
                    found.append(RollingShape("sphere" if axis is None else "cylinder", radius, name))
            if found and name == frame:
                break
        return max(found, key=lambda shape: shape.radius, default=None)

    def _radius_about(self, link: str, element: etree._Element, T_frame_link: Array, axis: str | None) -> float:
        """Radius of a shape if it is a sphere or, with an axis, a cylinder about the frame's origin, else 0."""
        shape = element.find(f"geometry/{'sphere' if axis is None else 'cylinder'}")
        if shape is None:
            return 0.0
        path, field = self.robot.path, f"link '{link}', <collision>"
        (radius,) = read_numbers(path, f"{field} <{shape.tag!s}", shape, "radius", 1)
        origin, xyz, rpy = element.find("origin"), np.zeros(3), np.zeros(3)
        if origin is not None:
            xyz, rpy = (read_numbers(path, f"{field} <origin", origin, name, 3, "0 0 0") for name in ("xyz", "rpy"))
        centre = T_frame_link[:3, :3] @ xyz + T_frame_link[:3, 3]
        if axis is not None:
            along = T_frame_link[:3, :3] @ Rotation.from_euler("xyz", rpy).as_matrix()[:, 2]
            if np.linalg.norm(np.cross(along, np.eye(3)["xyz".index(axis)])) > _MAX_ANGLE:
                return 0.0
            centre = centre - along * (along @ centre)
        is_about = np.linalg.norm(centre) <= max(_MAX_OFFSET_M, _MAX_OFFSET_SHARE * radius)
        return float(radius) if is_about else 0.0
