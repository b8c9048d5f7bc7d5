"""Shapes of the URDF: around a body, and what a frame rolls on."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from lxml import etree
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from yourdfpy.urdf import Inertial

from torchid.errors import UrdfError, excerpt, warn
from torchid.guards import MAX_AXES, MAX_NUMBER, MAX_SHAPES
from torchid.parameters import Array
from torchid.robot.meshes import MeshError, Meshes
from torchid.robot.robot import Robot
from torchid.robot.urdf import parse_xml, read_urdf

ShapeKind = Literal["collision", "visual"]
SHAPE_TAGS = ("box", "sphere", "cylinder", "capsule", "mesh")
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_PART = 2**16  # points that are rotated at a time
_THINNEST = 1e-3  # least edge over the longest one: a plate or a flat mesh keeps an interior


@dataclass(frozen=True)
class Extent:
    """The box around a body's shapes, and an ellipsoid of the same centre, axes and proportions around them.

    All in the body's link frame. `centre`, (3,) [m]; `axes`, (3, 3), columns; `half`, (3,) [m], half edges of the box;
    `semi_axes`, (3,) [m], of the ellipsoid.
    """

    centre: Array
    axes: Array
    half: Array
    semi_axes: Array


@dataclass(frozen=True)
class Shape:
    """Convex hull of `points`, (N, 3), widened by `spread @ u`, (3, 3), for all |u| <= 1 [m]; and its own axes."""

    points: Array
    spread: Array
    axes: Array

    def moved(self, T: Array) -> Shape:
        """Expressed in another frame; `T`, (4, 4) [m], is the pose of this one in it."""
        R = T[:3, :3]
        return Shape(self.points @ R.T + T[:3, 3], R @ self.spread, R @ self.axes)


def body_extents(robot: Robot, prefer: ShapeKind = "visual", bodies: Iterable[int] | None = None) -> dict[int, Extent]:
    """Extents of bodies, by index, each around all shapes of all links that the body is made of.

    A link without shapes of the preferred kind counts with those of the other kind. A link that has mass and neither
    counts as the uniform box of its inertia, provided that another link of the body has shapes. The axes of the box are
    those of the body's link or of one of its shapes, whichever give the least volume; for shapes of very many points
    only the first few are tried. The ellipsoid's semi-axes are the box's half edges times the least factor that
    encloses all shapes: sqrt(3) around a box (the smallest ellipsoid there is), sqrt(2) around a cylinder, 1 around a
    sphere.

    Args:
        robot: any; meshes are looked for in its URDF's package and, by `package://`, in those beside it.
        prefer: "collision" or "visual".
        bodies: indices; all that have mass if None.

    Raises:
        UrdfError: a shape of an unknown kind, or one whose numbers cannot be read.

    Warns:
        TorchidWarning: bodies without an extent, because they have no shapes or a mesh cannot be read (the box around
            their other shapes would be too small).
    """
    elements = {link.get("name"): link for link in parse_xml(robot.path).getroot().findall("link")}
    inertials = {link.name: link.inertial for link in read_urdf(robot.path)[0]}
    chosen = [i for i, body in enumerate(robot.bodies) if not body.massless] if bodies is None else bodies
    extents: dict[int, Extent] = {}
    shapeless = []
    unreadable = []
    reasons = []
    meshes = Meshes(robot.path)
    for index in chosen:
        body = robot.bodies[index]
        shapes = []
        inertia_boxes = []
        try:
            for name in body.links:
                T_body_link = robot.links[name][1]
                link_shapes = _link_shapes(meshes, elements[name], prefer)
                shapes += [shape.moved(T_body_link) for shape in link_shapes]
                if not link_shapes and inertials[name] is not None and inertials[name].mass > 0.0:
                    inertia_boxes.append(_inertia_box(inertials[name]).moved(T_body_link))
        except MeshError as error:
            unreadable.append(body.name)
            reasons.append(str(error))
            continue
        extent = _extent(shapes + inertia_boxes) if shapes else None
        if extent is None:
            shapeless.append(body.name)
        else:
            extents[index] = extent
    _warn_without_extent(robot.path, "no shapes", shapeless, [])
    _warn_without_extent(robot.path, "unreadable mesh", unreadable, reasons)
    return extents


def _warn_without_extent(path: Path, what: str, bodies: list[str], reasons: list[str]) -> None:
    if bodies:
        reason = f" ({reasons[0]}{', ...' if len(reasons) > 1 else ''})" if reasons else ""
        message = f"{path}: {what} at {', '.join(bodies)}{reason}: their extent is unknown"
        warn(message)


def _link_shapes(meshes: Meshes, link: etree._Element, prefer: ShapeKind) -> list[Shape]:
    other = "visual" if prefer == "collision" else "collision"
    for tag in (prefer, other):
        elements = link.findall(tag)
        if elements:
            field = f"link '{link.get('name')}', <{tag}>"
            if len(elements) > MAX_SHAPES:
                raise UrdfError(meshes.urdf, field, f"{len(elements)} shapes", f"at most {MAX_SHAPES}")
            return [read_shape(meshes, field, element) for element in elements]
    return []


def read_shape(meshes: Meshes, field: str, element: etree._Element) -> Shape:
    """A shape in its link's frame; `field` names it in messages. Raises MeshError, or UrdfError as `body_extents`."""
    path = meshes.urdf
    geometry = element.find("geometry")
    tags = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]  # and no comments
    if len(tags) != 1 or tags[0].tag not in SHAPE_TAGS:
        reason = ", ".join(f"<{child.tag!s}>" for child in tags) or "no shape"
        raise UrdfError(path, f"{field} <geometry>", reason, f"one of {', '.join(SHAPE_TAGS)}")
    points, spread = _points_and_spread(meshes, f"{field} <{tags[0].tag!s}", tags[0])
    origin = element.find("origin")
    T = np.eye(4)
    if origin is not None:
        rpy, xyz = (read_numbers(path, f"{field} <origin", origin, name, 3, "0 0 0") for name in ("rpy", "xyz"))
        T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        T[:3, 3] = xyz
    return Shape(points, spread, np.eye(3)).moved(T)


def _points_and_spread(meshes: Meshes, field: str, shape: etree._Element) -> tuple[Array, Array]:
    """Points (N, 3) and spread (3, 3) of a shape in its own frame."""
    path = meshes.urdf
    if shape.tag == "box":
        return _CORNERS * read_numbers(path, field, shape, "size", 3) / 2.0, np.zeros((3, 3))
    if shape.tag == "mesh":
        scale = read_numbers(path, field, shape, "scale", 3, "1 1 1")
        return meshes.vertices(str(shape.get("filename", ""))) * scale, np.zeros((3, 3))
    (radius,) = read_numbers(path, field, shape, "radius", 1)
    if shape.tag == "sphere":
        return np.zeros((1, 3)), radius * np.eye(3)
    (length,) = read_numbers(path, field, shape, "length", 1)  # a capsule's is that of its straight part
    ends = np.array([[0.0, 0.0, length / 2.0], [0.0, 0.0, -length / 2.0]])
    return ends, np.diag([radius, radius, radius if shape.tag == "capsule" else 0.0])


def read_numbers(path: Path, field: str, element: etree._Element, name: str, count: int, default: str = "") -> Array:
    """Numbers (count,) of an attribute; UrdfError unless they are as many, finite and, of a size, not negative."""
    text = str(element.get(name, default))
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if name == "scale" and values.shape == (1,):
        values = np.repeat(values, 3)
    signed = name in ("xyz", "rpy", "scale")
    fits = values.shape == (count,) and np.isfinite(values).all() and np.abs(values).max() <= MAX_NUMBER
    if not fits or not (signed or (values >= 0.0).all()):
        reason = f"'{excerpt(text)}'" if text else "none"
        accepted = f"{count} decimal number{'s' if count > 1 else ''}{'' if signed else ' of at least 0'}"
        raise UrdfError(path, f"{field} {name}>", reason, accepted)
    return values


def _inertia_box(inertial: Inertial) -> Shape:
    """The uniform box that has a link's inertia."""
    inertia = np.asarray(inertial.inertia)
    T = np.eye(4) if inertial.origin is None else inertial.origin
    spread = (0.5 * np.trace(inertia) * np.eye(3) - inertia) / inertial.mass
    values, axes = np.linalg.eigh(spread)
    corners = _CORNERS * np.sqrt(3.0 * np.maximum(values, 0.0))
    return Shape(corners @ axes.T, np.zeros((3, 3)), axes).moved(T)


def _extent(shapes: list[Shape]) -> Extent | None:
    """Extent of one body's shapes; None if they are a single point."""
    points = np.concatenate([shape.points for shape in shapes])
    spreads = np.stack([shape.spread for shape in shapes])
    of_point = np.repeat(np.arange(len(shapes)), [len(shape.points) for shape in shapes])
    tried = 1 + min(len(shapes), max(1, MAX_AXES // len(points)))
    candidates = (np.eye(3), *(shape.axes for shape in shapes))[:tried]
    boxes = [_box(points, spreads, of_point, axes) for axes in candidates]
    volumes = [float(np.prod(half)) for _, half in boxes]
    best = next(
        i for i, volume in enumerate(volumes) if volume <= min(volumes) * (1.0 + 1e-9)
    )  # the link's own axes if as good
    (centre, half), axes = boxes[best], candidates[best]
    if not half.any():
        return None
    half = np.maximum(half, _THINNEST * half.max())
    to_unit = (axes / half).T  # (3, 3), takes the box to a cube of half edge 1
    factor = max(_largest_norm((shape.points - centre) @ to_unit.T, to_unit @ shape.spread) for shape in shapes)
    return Extent(centre, axes, half, min(factor, np.sqrt(3.0)) * half)


def _box(points: Array, spreads: Array, of_point: np.ndarray, axes: Array) -> tuple[Array, Array]:
    """Centre (3,) and half edges (3,) of the box along given axes.

    Args:
        points: (N, 3), of all shapes.
        spreads: (S, 3, 3), of each shape.
        of_point: (N,), the shape of each point.
        axes: (3, 3), columns.
    """
    spread_along = np.linalg.norm(np.swapaxes(spreads, 1, 2) @ axes, axis=1)
    top = np.full(3, -np.inf)
    bottom = np.full(3, np.inf)
    for part in (slice(k, k + _PART) for k in range(0, len(points), _PART)):
        position = points[part] @ axes
        margin = spread_along[of_point[part]]
        top = np.maximum(top, (position + margin).max(axis=0))
        bottom = np.minimum(bottom, (position - margin).min(axis=0))
    return axes @ (top + bottom) / 2.0, (top - bottom) / 2.0


def _largest_norm(points: Array, spread: Array) -> float:
    """Greatest |p + spread @ u| over points p, (N, 3), and |u| <= 1.

    With p in the singular directions of spread, singular values s, its square is the minimum over t > max s^2 of
    |p|^2 + t + sum s^2 p^2 / (t - s^2), the Lagrange dual. It has no gap for a quadratic over a ball, and every t gives
    an upper bound.
    """
    if not spread.any():
        return float(np.linalg.norm(points, axis=1).max())
    U, s, _ = np.linalg.svd(spread)
    reach = 0.0
    for p in (points @ U) ** 2:
        below, limit = s[0] ** 2 - s**2, float(np.sqrt(s**2 @ p))  # bound on the best t - max s^2

        def dual(excess: float, p: Array = p, below: Array = below) -> float:
            return float(p.sum() + s[0] ** 2 + excess + (s**2 * p / (excess + below)).sum())

        least = (s[0] + np.sqrt(p.sum())) ** 2
        if limit > 0.0:
            least = minimize_scalar(dual, bounds=(0.0, limit), method="bounded", options={"xatol": 1e-9 * limit}).fun
        reach = max(reach, float(np.sqrt(least)))
    return reach


_MAX_OFFSET_M = 1e-3
_MAX_OFFSET_SHARE = 0.1
"""Distance of a cylinder's axis or a wheel's centre from the frame's origin up to which it is about it: either."""
_MAX_ANGLE = 0.02  # rad, between a cylinder and the axis of its contact or joint
_END_SHARES = (0.5, 0.3, 0.2, 0.1)  # of a mesh's length, the end that may be a ball; the first that is one counts
_MAX_MISFIT_SHARE = 0.05  # of the radius, rms and at the lowest point; the end of Go2's foot misses a ball by 0.036
_MIN_DEPTH_SHARE = 0.15  # of the radius: less of a ball is a sole, and a foot that turns by 30 degrees leaves it
# diameter over the mesh's longest edge; corners of the end
_MAX_BREADTH_SHARE = 1.1
_FEWEST_CORNERS = 8


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
        self.robot = robot
        self._meshes = Meshes(robot.path)
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
        T_frame_body = np.linalg.inv(T_body_frame)
        joint = self.robot.bodies[body].joint
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
        shapes = []
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
                        shapes.append(RollingShape(kind, measured[1], link, (x, y, z), file))
        return shapes


def _choose(shapes: list[RollingShape], frame: str) -> RollingShape | None:
    """Of shapes that the frame's origin lies in the largest, of its own link first; else its own link's only one."""
    on_link = [shape for shape in shapes if shape.link == frame]
    for group in (on_link, shapes):
        if around := [shape for shape in group if np.linalg.norm(shape.centre) <= shape.radius]:
            return max(around, key=lambda shape: shape.radius)
    return on_link[0] if len(on_link) == 1 else None


def _cylinder(shape: Shape, along: Array, slides: bool) -> tuple[Array, float] | None:
    """Origin and radius of a cylinder about the origin along a unit vector (3,), anywhere along it if it `slides`."""
    axis = shape.axes[:, 2]
    centre = shape.points.mean(axis=0)
    radius = float(np.linalg.norm(shape.spread, 2))
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
    depth = points @ away
    longest = np.ptp(points, axis=0).max()
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
