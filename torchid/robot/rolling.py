"""What a frame rolls on: spheres, cylinders and wheels among the URDF's collision shapes."""

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
_MAX_ANGLE = 0.02  # rad, between a cylinder and the axis of its contact or joint


@dataclass(frozen=True)
class RollingShape:
    """A collision shape about a frame's origin: a "sphere", "cylinder" or "wheel", its radius [m], and its link."""

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

        Of several, one of the frame's own link, then the largest, which touches the ground first. Where a point has no
        sphere, a wheel: a cylinder that turns about its own axis without end. While upright it touches the ground
        where a sphere of its radius does.

        Args:
            frame: a link of the robot.
            axis: x, y or z of the frame, along which a cylinder must be; None for a sphere or a wheel.

        Raises:
            UnknownNameError: no such link.
            UrdfError: a shape that is not described by numbers.
        """
        body, T_body_frame = self.robot.link(frame)
        if axis is not None:
            return self._largest("cylinder", frame, np.eye(3)["xyz".index(axis)])
        sphere, joint = self._largest("sphere", frame), self.robot.bodies[body].joint
        if sphere is not None or joint is None or not joint.continuous:
            return sphere
        return self._largest("wheel", frame, (joint.T_joint_link[:3, :3] @ T_body_frame[:3, :3]).T @ joint.axis)

    def _largest(self, kind: str, frame: str, axis: Array | None = None) -> RollingShape | None:
        """The largest shape of a kind about a frame's origin, along a unit vector (3,) in the frame."""
        body, T_body_frame = self.robot.link(frame)
        T_frame_body = np.linalg.inv(T_body_frame)
        found: list[RollingShape] = []
        for name in sorted(self.robot.bodies[body].links, key=lambda name: name != frame):
            T_frame_link = T_frame_body @ self.robot.links[name][1]
            for element in self._links[name].findall("collision"):
                radius = self._radius_about(kind, name, element, T_frame_link, axis)
                if radius > 0.0:
                    found.append(RollingShape(kind, radius, name))
            if found and name == frame:
                break
        return max(found, key=lambda shape: shape.radius, default=None)

    def _radius_about(
        self, kind: str, link: str, element: etree._Element, T_frame_link: Array, axis: Array | None
    ) -> float:
        """Radius of a shape if it is of a kind, about the frame's origin and along an axis, else 0."""
        shape = element.find(f"geometry/{'sphere' if kind == 'sphere' else 'cylinder'}")
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
            if np.linalg.norm(np.cross(along, axis)) > _MAX_ANGLE:
                return 0.0
            if kind == "cylinder":  # a line is as long as its contact; a wheel, narrow, stands on its middle
                centre = centre - along * (along @ centre)
        is_about = np.linalg.norm(centre) <= max(_MAX_OFFSET_M, _MAX_OFFSET_SHARE * radius)
        return float(radius) if is_about else 0.0
