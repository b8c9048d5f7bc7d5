"""What a frame rolls on: spheres, cylinders, wheels and ends of meshes among the URDF's collision shapes."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from torchid.parameters import Array
from torchid.robot.robot import Robot
from torchid.robot.shapes import Meshes, Shape, read_shape
from torchid.robot.urdf import MeshError, parse_xml

_MAX_OFFSET_M, _MAX_OFFSET_SHARE = 1e-3, 0.1
"""Distance of a cylinder's axis or a wheel's centre from the frame's origin up to which it is about it: either."""
_MAX_ANGLE = 0.02  # rad, between a cylinder and the axis of its contact or joint
_END_SHARES = (0.5, 0.3, 0.2, 0.1)  # of a mesh's length, the end that may be a ball; the first that is one counts
_MAX_MISFIT_SHARE = 0.05  # of the radius, rms and at the lowest point; the end of Go2's foot misses a ball by 0.036
_MIN_DEPTH_SHARE = 0.15  # of the radius: less of a ball is a sole, and a foot that turns by 30 degrees leaves it
_MAX_BREADTH_SHARE, _FEWEST_CORNERS = 1.1, 8  # diameter over the mesh's longest edge; corners of the end


@dataclass(frozen=True)
class RollingShape:
    """A "sphere", "cylinder", "wheel" or "mesh" that rolls: its radius [m], link, and centre (3,) [m] in the frame.

    `file`: of a mesh, its name.
    """

    kind: str
    radius: float
    link: str
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    file: str = ""


class CollisionShapes:
    """The collision spheres, cylinders and meshes of a robot's links."""

    def __init__(self, robot: Robot) -> None:
        """Read the URDF, whose other shapes do not matter here."""
        self.robot, self._meshes = robot, Meshes(robot.path)
        self._links = {link.get("name"): link for link in parse_xml(robot.path).getroot().findall("link")}

    def about(self, frame: str, axis: str | None = None, meshes: bool = True) -> RollingShape | None:
        """What a frame rolls on, of its own link or of one that is welded to it; None if there is nothing.

        Of several spheres that the frame's origin lies in one of the frame's own link, then the largest, which touches
        the ground first; else the only sphere of the frame's own link. Where a point has no sphere, a wheel: a cylinder
        that turns about its own axis without end. While upright it touches the ground where a sphere of its radius
        does. Where it has neither, a ball that is the end of a mesh, see `fit_end`, chosen as spheres are.

        Args:
            frame: a link of the robot.
            axis: x, y or z of the frame, along which a cylinder must be; None for a sphere, a wheel or a mesh.
            meshes: whether to look at meshes.

        Raises:
            UnknownNameError: no such link.
            UrdfError: a shape that is not described by numbers.
        """
        body, T_body_frame = self.robot.link(frame)
        T_frame_body, joint = np.linalg.inv(T_body_frame), self.robot.bodies[body].joint
        if axis is not None:
            along = np.eye(3)["xyz".index(axis)]
            return _choose(self._all(frame, "cylinder", lambda shape: _cylinder(shape, along, slides=True)), frame)
        ball = _choose(
            self._all(frame, "sphere", lambda shape: (shape.points[0], float(np.linalg.norm(shape.spread, 2)))), frame
        )
        if ball is None and joint is not None and joint.continuous:
            along = T_frame_body[:3, :3] @ joint.T_joint_link[:3, :3].T @ joint.axis
            wheel = _choose(self._all(frame, "cylinder", lambda shape: _cylinder(shape, along, slides=False)), frame)
            ball = None if wheel is None else replace(wheel, kind="wheel")
        if ball is None and meshes:
            T_link_joint = np.eye(4) if joint is None else np.linalg.inv(joint.T_joint_link)
            hinge = np.asarray(T_frame_body @ T_link_joint, dtype=np.float64)[:3, 3]
            ball = _choose(self._all(frame, "mesh", lambda shape: fit_end(shape.points, hinge)), frame)
        return ball

    def _all(self, frame: str, kind: str, measure: Callable[[Shape], tuple[Array, float] | None]) -> list[RollingShape]:
        """What rolls among shapes of a kind; `measure`: centre (3,) and radius [m] of one in the frame, or None."""
        body, T_body_frame = self.robot.link(frame)
        found = []
        for link in sorted(self.robot.bodies[body].links, key=lambda name: name != frame):
            T_frame_link = np.linalg.inv(T_body_frame) @ self.robot.links[link][1]
            for element in self._links[link].findall("collision"):
                if (tag := element.find(f"geometry/{kind}")) is None:
                    continue
                with suppress(MeshError):
                    shape = read_shape(self._meshes, f"link '{link}', <collision>", element).moved(T_frame_link)
                    if (measured := measure(shape)) is not None and measured[1] > 0.0:
                        x, y, z = measured[0].tolist()
                        file = PurePosixPath(str(tag.get("filename", ""))).name
                        found.append(RollingShape(kind, measured[1], link, (x, y, z), file))
        return found


def _choose(found: list[RollingShape], frame: str) -> RollingShape | None:
    """Of shapes that the frame's origin lies in the largest, of its own link first; else its own link's only one."""
    own = [shape for shape in found if shape.link == frame]
    for some in (own, found):
        if around := [shape for shape in some if np.linalg.norm(shape.centre) <= shape.radius]:
            return max(around, key=lambda shape: shape.radius)
    return own[0] if len(own) == 1 else None


def _cylinder(shape: Shape, along: Array, slides: bool) -> tuple[Array, float] | None:
    """Origin and radius of a cylinder about the origin along a unit vector (3,), anywhere along it if it `slides`."""
    axis, centre, radius = shape.axes[:, 2], shape.points.mean(axis=0), float(np.linalg.norm(shape.spread, 2))
    if slides:  # a line is as long as its contact; a wheel, narrow, stands on its middle
        centre = centre - axis * (axis @ centre)
    is_about = np.linalg.norm(centre) <= max(_MAX_OFFSET_M, _MAX_OFFSET_SHARE * radius)
    return (np.zeros(3), radius) if is_about and np.linalg.norm(np.cross(axis, along)) <= _MAX_ANGLE else None


def fit_end(points: Array, hinge: Array) -> tuple[Array, float] | None:
    """Centre (3,) and radius [m] of the ball that fits the end of a mesh by least squares, None if none does.

    Args:
        points: corners of the mesh, (N, 3) [m].
        hinge: where its limb begins, (3,) [m]; the end is the part that is farthest from it.
    """
    away = points.mean(axis=0) - hinge
    away /= max(float(np.linalg.norm(away)), np.finfo(float).tiny)
    depth, longest = points @ away, np.ptp(points, axis=0).max()
    for share in _END_SHARES:
        end = np.unique(points[depth >= depth.max() - share * np.ptp(depth)], axis=0)
        if len(end) < _FEWEST_CORNERS:
            break
        solved, *_ = np.linalg.lstsq(np.column_stack([2.0 * end, np.ones(len(end))]), (end**2).sum(axis=1))
        centre = solved[:3]
        radius = float(np.sqrt(max(solved[3] + centre @ centre, 0.0)))
        rms = np.sqrt(np.mean((np.linalg.norm(end - centre, axis=1) - radius) ** 2))
        is_ball = max(rms, abs(depth.max() - centre @ away - radius)) <= _MAX_MISFIT_SHARE * radius
        is_deep = share * np.ptp(depth) >= _MIN_DEPTH_SHARE * radius
        if is_ball and is_deep and 2.0 * radius <= _MAX_BREADTH_SHARE * longest:
            return centre, radius
    return None
