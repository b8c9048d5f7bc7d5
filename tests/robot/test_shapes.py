"""Boxes and ellipsoids around bodies hold every point of their shapes, touch them, and say what they could not read."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic import G1, PANDA, ROBOTS, SOLO12, TALOS, Array, load
from urdfs import INERTIAL, ball, joint, link, table, words, write

from torchid.errors import TorchidWarning, UrdfError
from torchid.parameters import mass_com_inertia
from torchid.robot import Extent, body_extents, load_robot
from torchid.robot.shapes import ShapeKind

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 300.0]])
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON) + "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


@dataclass(frozen=True)
class Placed:
    """A shape's XML, and points all over its surface, (N, 3), in its link's frame."""

    geometry: str
    xyz: Array
    rpy: Array
    surface: Array

    def xml(self, tag: str = "visual") -> str:
        """The element of a link."""
        origin = f'<origin xyz="{words(self.xyz)}" rpy="{words(self.rpy)}"/>'
        return f"<{tag}>{origin}<geometry>{self.geometry}</geometry></{tag}>"

    @property
    def points(self) -> Array:
        """The surface in the link's frame."""
        return pose(self.xyz, self.rpy).apply(self.surface) + self.xyz


def pose(xyz: Array, rpy: Array) -> Rotation:
    """Roll about x, then pitch about the old y, then yaw about the old z: three matrices, written out."""
    (a, b, c), matrices = rpy, []
    for angle, (i, j) in ((a, (1, 2)), (b, (2, 0)), (c, (0, 1))):
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[j, i] = np.sin(angle)
        R[i, j] = -R[j, i]
        matrices.append(R)
    return Rotation.from_matrix(matrices[2] @ matrices[1] @ matrices[0])


def sphere(count: int) -> Array:
    """Evenly spread unit vectors."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], axis=1)


def circle(count: int) -> Array:
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


def placed(kind: str, rng: np.random.Generator, folder: Path | None = None) -> Placed:
    """A shape of random size somewhere."""
    a, b, c = rng.uniform(0.02, 0.4, 3)
    if kind == "box":
        geometry, surface = f'<box size="{a} {b} {c}"/>', CORNERS * [a, b, c] / 2.0
    elif kind == "sphere":
        geometry, surface = f'<sphere radius="{a}"/>', a * sphere(4000)
    elif kind == "cylinder":
        ends = [a * circle(800) + [0, 0, z] for z in (-b / 2, b / 2)]
        geometry, surface = f'<cylinder radius="{a}" length="{b}"/>', np.concatenate(ends)
    elif kind == "capsule":
        ends = [a * sphere(4000) + [0, 0, z] for z in (-b / 2, b / 2)]
        geometry, surface = f'<capsule radius="{a}" length="{b}"/>', np.concatenate(ends)
    else:
        assert folder is not None
        (folder / "mesh.obj").write_text(OBJ)
        scale = np.array([a, -b, c]) / 300.0
        geometry, surface = f'<mesh filename="mesh.obj" scale="{words(scale)}"/>', TETRAHEDRON * scale
    return Placed(geometry, rng.normal(0.0, 0.2, 3), rng.uniform(-3.0, 3.0, 3), surface)


def extents(path: Path, prefer: ShapeKind = "visual") -> dict[str, Extent]:
    """By name of the body."""
    robot = load(path)
    return {robot.body_names[i]: extent for i, extent in body_extents(robot, prefer).items()}


def one(folder: Path, *content: str, prefer: ShapeKind = "visual") -> Extent:
    """Of a robot that is one link."""
    return extents(write(folder, link("base", INERTIAL + "".join(content))), prefer)["base"]


def reach(extent: Extent, points: Array) -> tuple[Array, float]:
    """How far points come, in half edges by axis and direction, (2, 3), and in semi-axes."""
    local = (points - extent.centre) @ extent.axes
    in_ellipsoid = float(np.linalg.norm(local / extent.semi_axes, axis=1).max())
    return np.stack([local.max(axis=0), -local.min(axis=0)]) / extent.half, in_ellipsoid


def assert_encloses(extent: Extent, points: Array, slack: float = 1e-9, gap: float = 0.01) -> None:
    """Every point is inside both, and each face of the box, and the ellipsoid, is touched."""
    box, ellipsoid = reach(extent, points)
    assert box.max() <= 1.0 + slack
    assert box.min() >= 1.0 - gap
    assert 1.0 - gap <= ellipsoid <= 1.0 + slack
    np.testing.assert_allclose(extent.axes.T @ extent.axes, np.eye(3), rtol=0.0, atol=1e-12)


# -------------------------------------------------------------------------------------------------------- one shape


@pytest.mark.parametrize("kind", ["box", "sphere", "cylinder", "capsule", "mesh"])
@pytest.mark.parametrize("seed", range(3))
def test_a_turned_shape_is_enclosed_along_its_own_axes(kind: str, seed: int, tmp_path: Path) -> None:
    shape = placed(kind, np.random.default_rng(seed), tmp_path)
    extent = one(tmp_path, shape.xml())
    assert_encloses(extent, shape.points)
    local = shape.surface
    half = (local.max(axis=0) - local.min(axis=0)) / 2.0
    assert np.prod(extent.half) == pytest.approx(np.prod(half), rel=5e-3)  # of the points, a little inside


def test_a_plate_keeps_an_interior_and_a_point_is_no_shape(tmp_path: Path) -> None:
    extent = one(tmp_path, '<visual><geometry><box size="0.4 0.2 0"/></geometry></visual>')
    np.testing.assert_allclose(extent.half, [0.2, 0.1, 0.0002])
    with pytest.warns(TorchidWarning, match="no shapes at base: their extent is unknown"):
        body_extents(load(write(tmp_path, link("base", INERTIAL + ball(0.0)))))


# ------------------------------------------------------------------------------------------------------ many shapes


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kinds=st.lists(st.sampled_from(["box", "sphere", "cylinder", "capsule", "mesh"]), min_size=2, max_size=5),
    seed=st.integers(0, 2**32 - 1),
)
def test_all_shapes_of_all_welded_links_are_enclosed(kinds: list[str], seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    shapes = [placed(kind, rng, tmp_path) for kind in kinds]
    here, there = shapes[::2], shapes[1::2]
    xyz, rpy = rng.normal(size=3), rng.uniform(-3.0, 3.0, 3)
    weld = joint("weld", "base", "tip", "fixed", f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/>')
    elements = [link("base", INERTIAL + "".join(s.xml() for s in here)), link("tip", "".join(s.xml() for s in there))]
    path = write(tmp_path, *elements, weld)
    points = [s.points for s in here] + [pose(xyz, rpy).apply(s.points) + xyz for s in there]
    found = extents(path)["base"]
    assert_encloses(found, np.concatenate(points), gap=0.03)
    own = [np.eye(3), *(pose(s.xyz, s.rpy).as_matrix() for s in here)]
    for axes in own:
        local = np.concatenate(points) @ axes
        assert np.prod(2.0 * found.half) <= np.prod(local.max(axis=0) - local.min(axis=0)) * 1.02


# ----------------------------------------------------------------------------------------------------------- meshes


@pytest.mark.parametrize(
    ("stored", "named"),
    [
        ("machine/meshes/a.obj", "package://machine/meshes/a.obj"),
        ("machine/meshes/a.obj", "../meshes/a.obj"),
        ("machine/robots/a.obj", "a.obj"),
        ("machine/robots/a.obj", "file://a.obj"),
        ("other/meshes/a.obj", "package://other/meshes/a.obj"),
        ("machine/meshes/a.obj", "{folder}/machine/meshes/a.obj"),
        ("machine/meshes/a.obj", "file://{folder}/machine/meshes/a.obj"),
    ],
)
def test_meshes_are_found_where_a_urdf_may_say_they_are(stored: str, named: str, tmp_path: Path) -> None:
    for folder in ("machine/robots", "machine/meshes", "other/meshes"):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / stored).write_text(OBJ)
    mesh = f'<mesh filename="{named.format(folder=tmp_path)}" scale="0.001 0.001 0.001"/>'
    extent = one(tmp_path / "machine/robots", f"<visual><geometry>{mesh}</geometry></visual>")
    np.testing.assert_allclose(extent.half, [0.05, 0.1, 0.15])
    np.testing.assert_allclose(extent.centre, [0.05, 0.1, 0.15])


@table({
    "missing": (None, "no such file"),
    "not a mesh": ("hello", "no vertices"),
    "no format": ("x.unheard", "x.unheard: "),
})  # fmt: skip
def test_a_body_with_a_mesh_that_cannot_be_read_is_left_out_in_one_line(case: tuple, tmp_path: Path) -> None:
    """And not enclosed in the rest of its shapes, which would be too small."""
    content, found = case
    name = "x.unheard" if content == "x.unheard" else "x.obj"
    if content is not None:
        (tmp_path / name).write_text(content)
    mesh = f'<visual><geometry><mesh filename="package://a/{name}"/></geometry></visual>'
    arm = link("arm", INERTIAL + ball(0.1) + mesh)
    path = write(tmp_path, link("base", INERTIAL + ball(0.2)), arm, joint("elbow", "base", "arm"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert list(extents(path)) == ["base"]
    (message,) = (str(warning.message) for warning in caught)
    assert message.startswith(f"{path}: a mesh that cannot be read at arm (package://a/{name}: ")
    assert found in message
    assert "\n" not in message


def test_the_unit_of_a_collada_file_counts(tmp_path: Path) -> None:
    numbers = words(TETRAHEDRON.ravel())
    axes = "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    places = f'<float_array id="a" count="12">{numbers}</float_array>'
    accessor = f'<technique_common><accessor source="#a" count="4" stride="3">{axes}</accessor></technique_common>'
    mesh = (
        f'<mesh><source id="p">{places}{accessor}</source>'
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>'
        '<triangles count="2"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 0 1 3</p></triangles></mesh>'
    )
    scene = '<visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node></visual_scene>'
    (tmp_path / "a.dae").write_text(
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">'
        '<asset><unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis></asset>'
        f'<library_geometries><geometry id="g">{mesh}</geometry></library_geometries>'
        f"<library_visual_scenes>{scene}</library_visual_scenes>"
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )
    extent = one(tmp_path, '<visual><geometry><mesh filename="a.dae"/></geometry></visual>')
    np.testing.assert_allclose(extent.half, [0.5, 1.0, 1.5])


# --------------------------------------------------------------------------------------------------------- refusals


@table({
    "two numbers": ('<box size="1 2"/>', "<box size>: '1 2'; accepted: 3 decimal numbers of at least 0"),
    "words": ('<sphere radius="big"/>', "<sphere radius>: 'big'; accepted: 1 decimal number of at least 0"),
    "nothing": ("<cylinder/>", "<cylinder radius>: none; accepted: 1 decimal number"),
    "negative": ('<cylinder radius="1" length="-1"/>', "<cylinder length>: '-1'; accepted: 1 decimal number"),
    "not finite": ('<box size="1 2 inf"/>', "<box size>: '1 2 inf'"),
    "scale": ('<mesh filename="a.obj" scale="1 2"/>', "<mesh scale>: '1 2'; accepted: 3 decimal numbers"),
    "unknown": ("<torus/>", "<geometry>: <torus>; accepted: one of box, sphere, cylinder, capsule, mesh"),
    "two": ('<sphere radius="1"/><sphere radius="1"/>', "<geometry>: <sphere>, <sphere>; accepted: one of"),
    "none": ("<!-- nothing -->", "<geometry>: no shape; accepted: one of"),
})  # fmt: skip
def test_a_shape_that_is_none_is_refused_by_its_link_in_one_line(case: tuple, tmp_path: Path) -> None:
    geometry, found = case
    (tmp_path / "a.obj").write_text(OBJ)
    path = write(tmp_path, link("base", f"{INERTIAL}<visual><geometry>{geometry}</geometry></visual>"))
    robot = load_robot(path)  # which has no eyes for shapes
    with pytest.raises(UrdfError) as caught:
        body_extents(robot)
    assert str(caught.value).startswith(f"{path}: link 'base', <visual> {found}")
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------------------------------ real robots


def support(shape: object, direction: Array) -> float:
    """How far a shape of Pinocchio's goes along a direction of its own frame."""
    if isinstance(shape, coal.BVHModelBase):
        return float((np.array(shape.vertices()) @ direction).max())
    if isinstance(shape, coal.Box):
        return float(np.abs(direction) @ shape.halfSide)
    if isinstance(shape, coal.Sphere):
        return float(shape.radius * np.linalg.norm(direction))
    assert isinstance(shape, coal.Cylinder)
    return float(shape.halfLength * abs(direction[2]) + shape.radius * np.hypot(*direction[:2]))


@pytest.mark.parametrize(
    ("urdf", "prefer"),
    [
        (G1, "collision"),
        (SOLO12, "visual"),
        pytest.param(TALOS, "collision", marks=pytest.mark.slow),
        (PANDA, "collision"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.stem,
)
def test_boxes_of_real_robots_touch_the_shapes_that_pinocchio_reads(urdf: Path, prefer: ShapeKind) -> None:
    robot = load(urdf)
    folders = [str(ROBOTS.parents[1]), str(ROBOTS.parent), str(ROBOTS)]
    model = pin.buildModelFromUrdf(str(urdf), pin.JointModelFreeFlyer())
    by_link: dict[str, dict[str, list]] = {"visual": {}, "collision": {}}
    for kind in by_link:
        geometry = pin.buildGeomFromUrdf(
            model, str(urdf), getattr(pin.GeometryType, kind.upper()), package_dirs=folders
        )
        for shape in geometry.geometryObjects:
            by_link[kind].setdefault(model.frames[shape.parentFrame].name, []).append(shape)
    other = "visual" if prefer == "collision" else "collision"
    found, checked = body_extents(robot, prefer), 0
    assert len(found) == len(robot.bodies) - len(robot.massless)
    for index, extent in found.items():
        reaches = np.full((6,), -np.inf)
        for name in robot.bodies[index].links:
            shapes = by_link[prefer].get(name) or by_link[other].get(name) or []
            for shape in shapes:
                in_link = model.frames[shape.parentFrame].placement.inverse() * shape.placement
                T = robot.links[name][1] @ in_link.homogeneous
                for number, direction in enumerate([*extent.axes.T, *-extent.axes.T]):
                    reached = support(shape.geometry, T[:3, :3].T @ direction) + direction @ (T[:3, 3] - extent.centre)
                    reaches[number] = max(reaches[number], reached)
        np.testing.assert_array_less(reaches, np.tile(extent.half, 2) + 1e-7)
        if np.isfinite(reaches).all() and np.allclose(reaches, np.tile(extent.half, 2), rtol=0.0, atol=1e-7):
            checked += 1
    assert checked >= 0.8 * len(found)  # the others have matter outside their shapes, or are flat


@pytest.mark.parametrize("urdf", [G1, SOLO12], ids=lambda path: path.stem)
def test_what_a_robot_looks_like_holds_the_centres_of_mass_that_its_maker_states(urdf: Path) -> None:
    """Collision shapes do not: the feet of G1 are four balls under the sole."""
    robot = load(urdf)
    outside = {"visual": 0, "collision": 0}
    for prefer in outside:
        for index, extent in body_extents(robot, prefer).items():  # type: ignore[arg-type]
            _, com, _ = mass_com_inertia(robot.nominal[index])
            outside[prefer] += reach(extent, com[None])[1] > 1.0
    assert outside == {"visual": 0, "collision": 2 if urdf == G1 else 0}
