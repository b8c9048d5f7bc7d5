"""What of a simulated robot touches the floor: spheres at its feet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchid.config import FootConfig
from torchid.errors import ConfigError, UnknownNameError, UrdfError
from torchid.parameters import Array
from torchid.robot.urdf import parse_xml
from torchid.sensing.sensors import NORMAL_FORCE

_RADIUS = 1e-4  # m, of contact points that the file gives: where they touch the floor is where they are
_NARROWEST = 1e-3  # m, of a support polygon


@dataclass(frozen=True)
class Foot:
    """A link that touches the floor with spheres about points, (k, 3) [m] in its frame, of radii (k,) [m].

    `along_normal`: its sensor reads the force along the floor's normal alone.
    """

    frame: str
    points: tuple[tuple[float, float, float], ...]
    radii: tuple[float, ...]
    along_normal: bool = False

    @property
    def middle(self) -> Array:
        """Mean of the points (3,) [m], in the foot's frame."""
        return np.mean(self.points, axis=0)

    @property
    def arms(self) -> Array:
        """The points from their middle, (k, 3) [m]."""
        return np.array(self.points) - self.middle

    @property
    def rolling_radius(self) -> float:
        """Radius of a foot that is one sphere of the URDF [m], 0 of others: they stand on points."""
        return self.radii[0] if len(self.radii) == 1 and self.radii[0] > _RADIUS else 0.0

    @property
    def constrained(self) -> int:
        """Number of its six velocities that the floor constrains: three, or all six if it stands flat."""
        return 6 if form_polygon(np.array(self.points)) else 3


def point_foot(frame: str, radius: float = 0.0) -> Foot:
    """A foot that is one sphere about the origin of its frame, of a radius [m], or a point."""
    return Foot(frame, ((0.0, 0.0, 0.0),), (max(radius, _RADIUS),))


def find_feet(settings: list[FootConfig], urdf: Path) -> tuple[Foot, ...]:
    """The feet with their contact points, from the file or from the URDF's collision spheres.

    Args:
        settings: of the simulation file.
        urdf: the robot.

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
            raise UnknownNameError.at_field("feet", foot.frame, links)
        if frames.count(foot.frame) > 1:
            raise ConfigError.at_field("feet", f"'{foot.frame}' named twice", "every foot once")
        along_normal = foot.sensor == NORMAL_FORCE
        if foot.points:
            points = tuple((x, y, z) for x, y, z in foot.points)
            feet.append(Foot(foot.frame, points, (_RADIUS,) * len(points), along_normal))
            continue
        shapes = links[foot.frame].findall("collision")
        spheres = [sphere for shape in shapes if (sphere := _sphere(urdf, foot.frame, shape)) is not None]
        if not spheres:
            missing = f"no points, and {urdf.name} has no collision spheres at {foot.frame}"
            raise ConfigError.at_field("feet", missing, "points: [[x, y, z], ...] in the frame of the foot")
        points, radii = zip(*spheres, strict=True)
        feet.append(Foot(foot.frame, points, radii, along_normal))
    return tuple(feet)


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


def form_polygon(points: Array) -> bool:
    """Whether contact points, (k, 3) [m], form a polygon: do not all lie on a line."""
    return len(points) > 2 and float(np.linalg.svd(points - points.mean(axis=0))[1][1]) > _NARROWEST
