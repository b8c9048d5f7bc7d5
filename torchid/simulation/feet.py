"""The feet of a simulation file: where a robot touches the floor, and whether that can hold it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchid.config import FootConfig
from torchid.errors import ConfigError, UnknownNameError, UrdfError
from torchid.parameters import Array
from torchid.robot.urdf import parse_xml

_RADIUS = 1e-4  # m, of contact points that the file gives: where they touch the floor is where they are
_NARROWEST = 1e-3  # m, of a support polygon


@dataclass(frozen=True)
class Foot:
    """A link that touches the floor with spheres about points, (k, 3) [m] in its frame, of radii (k,) [m]."""

    frame: str
    points: tuple[tuple[float, float, float], ...]
    radii: tuple[float, ...]

    @property
    def middle(self) -> Array:
        """Mean of the points (3,) [m], in the foot's frame."""
        return np.mean(self.points, axis=0)

    @property
    def arms(self) -> Array:
        """The points from their middle, (k, 3) [m]."""
        return np.array(self.points) - self.middle

    @property
    def held(self) -> int:
        """How many of its six velocities the floor can hold: the linear three, and the rest if it stands flat."""
        return 6 if can_hold(np.array(self.points)) else 3


def find_feet(settings: list[FootConfig], urdf: Path, source: object) -> tuple[Foot, ...]:
    """The feet with their contact points, from the file or from the URDF's collision spheres.

    Args:
        settings: of the simulation file.
        urdf: the robot.
        source: named in errors.

    Raises:
        UnknownNameError: the URDF has no such link.
        ConfigError: a foot is named twice, or has no contact points.
        UrdfError: a collision sphere is not described by numbers.
    """
    root = parse_xml(urdf).getroot()
    links = {link.get("name", ""): link for link in root.findall("link")}
    frames = [foot.frame for foot in settings]
    feet = []
    for foot in settings:
        if foot.frame not in links:
            raise UnknownNameError(source, "feet", foot.frame, links)
        if frames.count(foot.frame) > 1:
            raise ConfigError(source, "feet", f"'{foot.frame}' named twice", "every foot once")
        if foot.points:
            points = tuple((x, y, z) for x, y, z in foot.points)
            feet.append(Foot(foot.frame, points, (_RADIUS,) * len(points)))
            continue
        spheres = [_sphere(urdf, foot.frame, shape) for shape in links[foot.frame].findall("collision")]
        found = [sphere for sphere in spheres if sphere is not None]
        if not found:
            missing = f"no points, and {urdf.name} has no collision spheres at {foot.frame}"
            raise ConfigError(source, "feet", missing, "points: [[x, y, z], ...] in the frame of the foot")
        feet.append(Foot(foot.frame, tuple(point for point, _ in found), tuple(radius for _, radius in found)))
    return tuple(feet)


def can_hold(points: Array) -> bool:
    """Whether contact points, (k, 3) [m], do not all lie on a line."""
    return len(points) > 2 and float(np.linalg.svd(points - points.mean(axis=0))[1][1]) > _NARROWEST


def _sphere(urdf: Path, frame: str, shape: object) -> tuple[tuple[float, float, float], float] | None:
    """Centre and radius [m] of a collision shape in its link's frame, None unless it is a sphere."""
    sphere, origin = shape.find("geometry/sphere"), shape.find("origin")  # type: ignore[attr-defined]
    if sphere is None:
        return None
    try:
        radius = float(sphere.get("radius", ""))
        x, y, z = map(float, ("0 0 0" if origin is None else origin.get("xyz", "0 0 0")).split())
    except ValueError as error:
        raise UrdfError(urdf, f"link '{frame}', <sphere>", f"{error}", "numbers for radius and origin") from error
    if not (np.isfinite([x, y, z, radius]).all() and radius > 0.0):
        raise UrdfError(urdf, f"link '{frame}', <sphere>", f"radius {radius:g}", "finite numbers, radius > 0")
    return (x, y, z), radius
