"""Where the matter of a body can be: the box and the ellipsoid around its shapes (the only module with trimesh)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from lxml import etree
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from yourdfpy.urdf import Inertial

from torchid.errors import TorchidWarning, UrdfError
from torchid.parameters import Array
from torchid.robot.robot import Robot
from torchid.robot.urdf import parse_xml, read_urdf

ShapeKind = Literal["collision", "visual"]
SHAPE_TAGS = ("box", "sphere", "cylinder", "capsule", "mesh")
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_THINNEST = 1e-3  # of the longest edge: a plate or a flat mesh keeps an interior


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
class _Shape:
    """Convex hull of `points`, (N, 3), widened by `spread @ u`, (3, 3), for all |u| <= 1 [m]; and its own axes."""

    points: Array
    spread: Array
    axes: Array

    def moved(self, T: Array) -> _Shape:
        """Seen from another frame, `T` the pose of this one in it."""
        R = T[:3, :3]
        return _Shape(self.points @ R.T + T[:3, 3], R @ self.spread, R @ self.axes)


class _MeshError(Exception):
    """A mesh file that is missing or that trimesh cannot read."""


def body_extents(robot: Robot, prefer: ShapeKind = "visual", bodies: Iterable[int] | None = None) -> dict[int, Extent]:
    """Extents of bodies, by index, each around all shapes of all links that the body is made of.

    A link without shapes of the preferred kind counts with those of the other kind. A link that has mass and neither
    counts as the uniform box of its inertia, provided that another link of the body has shapes. The box has the axes,
    of the body's link and of every shape, in which its volume is least. The ellipsoid's semi-axes are the box's half
    edges times the least factor that encloses all: sqrt(3) around a box (the smallest ellipsoid there is), sqrt(2)
    around a cylinder, 1 around a sphere.

    Args:
        robot: any; meshes are looked for as yourdfpy does, relative to the URDF and to the folders above it.
        prefer: "collision" or "visual".
        bodies: indices; all that have mass if None.

    Raises:
        UrdfError: a shape is not described by numbers, or of no known kind.

    Warns:
        TorchidWarning: bodies that get no extent, because they have no shapes, or because a mesh cannot be read: the
            box around the rest would be too small.
    """
    elements = {link.get("name"): link for link in parse_xml(robot.path).getroot().findall("link")}
    inertials = {link.name: link.inertial for link in read_urdf(robot.path)[0]}
    chosen = [i for i, body in enumerate(robot.bodies) if not body.massless] if bodies is None else bodies
    found: dict[int, Extent] = {}
    shapeless, unreadable, reasons = [], [], []
    for index in chosen:
        body, shapes, unseen = robot.bodies[index], [], []
        try:
            for name in body.links:
                T_body_link = robot.links[name][1]
                of_link = _link_shapes(robot.path, elements[name], prefer)
                shapes += [shape.moved(T_body_link) for shape in of_link]
                if not of_link and inertials[name] is not None and inertials[name].mass > 0.0:
                    unseen.append(_inertia_box(inertials[name]).moved(T_body_link))
        except _MeshError as error:
            unreadable.append(body.name)
            reasons.append(str(error))
            continue
        extent = _extent(shapes + unseen) if shapes else None
        if extent is None:
            shapeless.append(body.name)
        else:
            found[index] = extent
    _warn(robot.path, "no shapes", shapeless, [])
    _warn(robot.path, "a mesh that cannot be read", unreadable, reasons)
    return found


def _warn(path: Path, what: str, bodies: list[str], reasons: list[str]) -> None:
    if bodies:
        reason = f" ({reasons[0]}{', ...' if len(reasons) > 1 else ''})" if reasons else ""
        message = f"{path}: {what} at {', '.join(bodies)}{reason}: where their matter lies is not known"
        warnings.warn(message, TorchidWarning, stacklevel=3)


def _link_shapes(path: Path, link: etree._Element, prefer: ShapeKind) -> list[_Shape]:
    other = "visual" if prefer == "collision" else "collision"
    for tag in (prefer, other):
        elements = link.findall(tag)
        if elements:
            field = f"link '{link.get('name')}', <{tag}>"
            return [_shape(path, field, element) for element in elements]
    return []


def _shape(path: Path, field: str, element: etree._Element) -> _Shape:
    """A shape in its link's frame."""
    geometry = element.find("geometry")
    tags = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]  # and no comments
    if len(tags) != 1 or tags[0].tag not in SHAPE_TAGS:
        found = ", ".join(f"<{child.tag!s}>" for child in tags) or "no shape"
        raise UrdfError(path, f"{field} <geometry>", found, f"one of {', '.join(SHAPE_TAGS)}")
    points, spread = _of_kind(path, f"{field} <{tags[0].tag!s}", tags[0])
    origin, T = element.find("origin"), np.eye(4)
    if origin is not None:
        rpy, xyz = (_numbers(path, f"{field} <origin", origin, name, 3, "0 0 0") for name in ("rpy", "xyz"))
        T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return _Shape(points, spread, np.eye(3)).moved(T)


def _of_kind(path: Path, field: str, shape: etree._Element) -> tuple[Array, Array]:
    """Points (N, 3) and spread (3, 3) of a shape in its own frame."""
    if shape.tag == "box":
        return _CORNERS * _numbers(path, field, shape, "size", 3) / 2.0, np.zeros((3, 3))
    if shape.tag == "mesh":
        scale = _numbers(path, field, shape, "scale", 3, "1 1 1")
        return _vertices(path, shape.get("filename", "")) * scale, np.zeros((3, 3))
    (radius,) = _numbers(path, field, shape, "radius", 1)
    if shape.tag == "sphere":
        return np.zeros((1, 3)), radius * np.eye(3)
    (length,) = _numbers(path, field, shape, "length", 1)  # a capsule's is that of its straight part
    ends = np.array([[0.0, 0.0, length / 2.0], [0.0, 0.0, -length / 2.0]])
    return ends, np.diag([radius, radius, radius if shape.tag == "capsule" else 0.0])


def _numbers(path: Path, field: str, element: etree._Element, name: str, count: int, default: str = "") -> Array:
    text = str(element.get(name, default))
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if name == "scale" and values.shape == (1,):
        values = np.repeat(values, 3)
    signed = name in ("xyz", "rpy", "scale")
    if values.shape != (count,) or not np.isfinite(values).all() or not (signed or (values >= 0.0).all()):
        found = f"'{text}'" if text else "none"
        accepted = f"{count} decimal number{'s' if count > 1 else ''}{'' if signed else ' of at least 0'}"
        raise UrdfError(path, f"{field} {name}>", found, accepted)
    return values


def _vertices(urdf: Path, filename: str) -> Array:
    """Vertices (N, 3) [m] of a mesh, in the unit that the file states, if it does."""
    path = _mesh_file(urdf, filename)
    if path is None:
        raise _MeshError(f"{filename}: no such file")
    try:
        mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
    except Exception as error:  # noqa: B902 - readers of a dozen formats raise what they like
        raise _MeshError(f"{filename}: {type(error).__name__}: {error}") from error
    points = np.asarray(getattr(mesh, "vertices", ()), dtype=np.float64)
    if not len(points) or not np.isfinite(points).all():
        raise _MeshError(f"{filename}: no vertices")
    return points * (trimesh.units.unit_conversion(mesh.units, "meters") if mesh.units else 1.0)


def _mesh_file(urdf: Path, filename: str) -> Path | None:
    """The file that a URDF's author meant, looked for from the URDF's folder upwards, with and without the package."""
    name = filename.split("://", 1)[-1]
    names = [name.split("/", 1)[-1], name] if filename.startswith("package://") else [name]
    for folder in urdf.absolute().parents:
        for candidate in names:
            if (folder / candidate).is_file():
                return folder / candidate
    return None


def _inertia_box(inertial: Inertial) -> _Shape:
    """The uniform box that has a link's inertia."""
    inertia, T = np.asarray(inertial.inertia), np.eye(4) if inertial.origin is None else inertial.origin
    spread = (0.5 * np.trace(inertia) * np.eye(3) - inertia) / inertial.mass
    values, axes = np.linalg.eigh(spread)
    corners = _CORNERS * np.sqrt(3.0 * np.maximum(values, 0.0))
    return _Shape(corners @ axes.T, np.zeros((3, 3)), axes).moved(T)


def _extent(shapes: list[_Shape]) -> Extent | None:
    """Of one body's shapes, None if they are a point."""
    boxes = [_box(shapes, axes) for axes in (np.eye(3), *(shape.axes for shape in shapes))]
    volumes = [float(np.prod(half)) for _, _, half in boxes]
    best = next(i for i, volume in enumerate(volumes) if volume <= min(volumes) * (1.0 + 1e-9))  # the link's if as good
    centre, axes, half = boxes[best]
    if not half.any():
        return None
    half = np.maximum(half, _THINNEST * half.max())
    to_unit = (axes / half).T  # (3, 3), takes the box to a cube of half edge 1
    factor = max(_reach((shape.points - centre) @ to_unit.T, to_unit @ shape.spread) for shape in shapes)
    return Extent(centre, axes, half, min(factor, np.sqrt(3.0)) * half)


def _box(shapes: list[_Shape], axes: Array) -> tuple[Array, Array, Array]:
    """Centre (3,) and half edges (3,) of the box along given axes, which come back between them."""
    wide = [np.linalg.norm(shape.spread.T @ axes, axis=0) for shape in shapes]
    top = np.max([(shape.points @ axes).max(axis=0) + w for shape, w in zip(shapes, wide, strict=True)], axis=0)
    bottom = np.min([(shape.points @ axes).min(axis=0) - w for shape, w in zip(shapes, wide, strict=True)], axis=0)
    return axes @ (top + bottom) / 2.0, axes, (top - bottom) / 2.0


def _reach(points: Array, spread: Array) -> float:
    """Greatest |p + spread @ u| over points p, (N, 3), and |u| <= 1.

    With p turned into the singular directions of spread, values s, its square is the least over t > max s^2 of
    |p|^2 + t + sum s^2 p^2 / (t - s^2), the Lagrange dual, which has no gap for a quadratic over a ball; no t gives too
    little.
    """
    if not spread.any():
        return float(np.linalg.norm(points, axis=1).max())
    U, s, _ = np.linalg.svd(spread)
    reach = 0.0
    for p in (points @ U) ** 2:
        below, far = s[0] ** 2 - s**2, float(np.sqrt(s**2 @ p))  # the best t is at most `far` beyond max s^2

        def dual(beyond: float, p: Array = p, below: Array = below) -> float:
            return float(p.sum() + s[0] ** 2 + beyond + (s**2 * p / (beyond + below)).sum())

        least = (s[0] + np.sqrt(p.sum())) ** 2
        if far > 0.0:
            least = minimize_scalar(dual, bounds=(0.0, far), method="bounded", options={"xatol": 1e-9 * far}).fun
        reach = max(reach, float(np.sqrt(least)))
    return reach
