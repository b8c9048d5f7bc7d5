"""Boxes and ellipsoids around bodies hold every point of their shapes, touch them, and say what they could not read."""

from __future__ import annotations

import warnings
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from synthetic import G1, PANDA, ROBOTS, SOLO12, TALOS, Array, load
from urdfs import INERTIAL, ball, joint, link, table, words, write

from torchid.errors import TorchidWarning, UrdfError
from torchid.robot import Extent, body_extents, load_robot
from torchid.robot.shapes import ShapeKind

TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 200.0, 0.0], [0.0, 0.0, 300.0]])
OBJ = "".join(f"v {x} {y} {z}\n" for x, y, z in TETRAHEDRON) + "f 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


def sphere(count: int) -> Array:
    """Evenly spread unit vectors."""
    k = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z], axis=1)


def extents(path: Path, prefer: ShapeKind = "visual") -> dict[str, Extent]:
    """By name of the body."""
    robot = load(path)
    return {robot.body_names[i]: extent for i, extent in body_extents(robot, prefer).items()}


def one(folder: Path, *content: str, prefer: ShapeKind = "visual") -> Extent:
    """Of a robot that is one link."""
    return extents(write(folder, link("base", INERTIAL + "".join(content))), prefer)["base"]


# -------------------------------------------------------------------------------------------------------- one shape


def test_a_plate_keeps_an_interior_and_a_point_is_no_shape(tmp_path: Path) -> None:
    extent = one(tmp_path, '<visual><geometry><box size="0.4 0.2 0"/></geometry></visual>')
    np.testing.assert_allclose(extent.half, [0.2, 0.1, 0.0002])
    with pytest.warns(TorchidWarning, match="no shapes at base: their extent is unknown"):
        body_extents(load(write(tmp_path, link("base", INERTIAL + ball(0.0)))))


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
    assert message.startswith(f"{path}: unreadable mesh at arm (package://a/{name}: ")
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
        pytest.param(TALOS, "collision", marks=pytest.mark.study),
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
