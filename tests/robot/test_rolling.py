"""Radii that the URDF's collision shapes give to contacts, and how far what rolls on them goes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import ROBOTS, load
from urdfs import joint, link, write

from torchid.config.robot import ContactConfig
from torchid.errors import ConfigError, UrdfError
from torchid.fitting.experiment import resolve_contacts


def shape(geometry: str, origin: str = "") -> str:
    return f"<collision>{origin}<geometry>{geometry}</geometry></collision>"


def foot_on(folder: Path, *shapes: str, welded: str = "") -> Any:
    """A robot whose foot has these collision shapes, and a toe welded to it askew that has others."""
    with_shapes = link("foot").replace("</link>", "".join(shapes) + "</link>")
    toe = link("toe").replace("</link>", welded + "</link>")
    weld = joint("weld", "foot", "toe", "fixed", '<origin xyz="0.1 0 0" rpy="0 0 1.5707963267948966"/>')
    return load(write(folder, link("base"), with_shapes, toe, joint("ankle", "base", "foot"), weld))


@pytest.mark.parametrize(("frame", "radius"), [("FR_foot", 0.02), ("RL_foot", 0.02)])
def test_the_feet_of_a_real_quadruped_roll_on_their_spheres(frame: str, radius: float) -> None:
    urdf = next(path for path in ROBOTS.rglob("go1.urdf"))
    contacts, text = resolve_contacts([ContactConfig(frame, "point")], load(urdf))
    assert contacts[0].radius == radius
    assert text == f"{frame}: ball of radius 20 mm, from the collision sphere"


@pytest.mark.parametrize(
    ("urdf", "frame", "radius", "centre", "text"),
    [
        ("anymal.urdf", "LF_FOOT", 0.031, (0.0, 0.0, 0.02325), "31 mm, centre [0, 0, 23] mm, from the collision"),
        ("anymal-kinova.urdf", "RH_FOOT", 0.031, (0.0, 0.0, 0.02325), "31 mm, centre [0, 0, 23] mm, from"),
        ("go2.urdf", "FL_foot", 0.022, (-0.002, 0.0, 0.0), "centre [-2.1, 0.1, -0.24] mm, from the mesh foot_convex"),
        ("solo12.urdf", "FL_FOOT", 0.016, (0.0, 0.0, 0.0), "from the mesh solo_foot.stl"),
    ],
)  # fmt: skip
def test_balls_beside_the_frame_and_ends_of_meshes_are_taken(
    urdf: str, frame: str, radius: float, centre: tuple[float, ...], text: str
) -> None:
    """Go2's own description has a sphere of 22 mm 2 mm behind the frame beside this mesh."""
    robot = load(next(path for path in sorted(ROBOTS.rglob(urdf)) if "anymal_b" in str(path) or "anymal" not in urdf))
    contacts, found = resolve_contacts([ContactConfig(frame, "point")], robot)
    assert abs(contacts[0].radius - radius) < 1.2e-3
    np.testing.assert_allclose(contacts[0].centre, centre, atol=1e-3)
    assert text in found


@pytest.mark.parametrize(
    ("kind", "origin", "found"),
    [
        ("continuous", '<origin rpy="1.5707963267948966 0 0"/>', 0.08),  # about the axle, y
        ("continuous", '<origin rpy="1.5707963267948966 0 0" xyz="0 0.007 0"/>', 0.08),
        ("continuous", '<origin rpy="1.5707963267948966 0 0" xyz="0 0.03 0"/>', 0.0),  # stands beside the frame
        ("continuous", "", 0.0),  # a rotor's hub or a steered post: across the axle
        ("revolute", '<origin rpy="1.5707963267948966 0 0"/>', 0.0),  # an ankle's housing
    ],
)
def test_a_point_on_a_wheel_rolls_on_the_wheel(tmp_path: Path, kind: str, origin: str, found: float) -> None:
    """A wheel is a cylinder that turns about its own axis without end; the frame at its centre is welded askew."""
    tyre = link("tyre").replace("</link>", shape('<cylinder radius="0.08" length="0.03"/>', origin) + "</link>")
    axle = joint("axle", "base", "tyre", kind, '<axis xyz="0 1 0"/>')
    turned = joint("weld", "tyre", "hub", "fixed", '<origin xyz="0 0 0" rpy="0.4 1 1.5707963267948966"/>')
    robot = load(write(tmp_path, link("base"), tyre, link("hub"), axle, turned))
    for frame, source in (("tyre", "the collision wheel"), ("hub", "the collision wheel of tyre")):
        contacts, text = resolve_contacts([ContactConfig(frame, "point")], robot)
        assert contacts[0].radius == found
        assert text.startswith(
            f"{frame}: ball of radius 80 mm, from {source}" if found else f"{frame}: radius 0: no sph"
        )


def test_what_the_file_states_counts_more_than_the_urdf(tmp_path: Path) -> None:
    robot = foot_on(tmp_path, shape('<sphere radius="0.04"/>'))
    contacts, text = resolve_contacts([ContactConfig("foot", "point", radius=0)], robot)
    assert (contacts[0].radius, text) == (0.0, "")
    contacts, text = resolve_contacts([ContactConfig("foot", "point", radius=0.05, normal=[0.0, 3.0, 4.0])], robot)
    assert contacts[0].normal == (0.0, 0.6, 0.8)
    assert text == "foot: ball of radius 50 mm, normal [0, 0.6, 0.8], as stated"
    contacts, text = resolve_contacts([ContactConfig("foot", "point", centre=[0.01, 0.0, 0.0])], robot)
    assert (contacts[0].radius, contacts[0].centre) == (0.04, (0.01, 0.0, 0.0))


def test_what_no_contact_can_have_is_refused_in_one_line(tmp_path: Path) -> None:
    robot = foot_on(tmp_path, shape('<sphere radius="0.04"/>'))
    with pytest.raises(
        ConfigError, match=r"contacts\[0\].radius: 0.1 for a flat contact; accepted: type point \(a sph"
    ):
        resolve_contacts([ContactConfig("foot", "flat", radius=0.1)], robot)
    with pytest.raises(ConfigError, match=r"contacts\[0\].centre: \[0, 0, 0.1\]; accepted: three numbers \[m\] in"):
        resolve_contacts([ContactConfig("foot", "flat", centre=[0.0, 0.0, 0.1])], robot)
    for radius in ("no number", "-0.1"):
        robot = foot_on(tmp_path, shape(f'<sphere radius="{radius}"/>'))
        with pytest.raises(UrdfError, match=f"<sphere radius>: '{radius}'; accepted: 1 decimal number of at least 0"):
            resolve_contacts([ContactConfig("foot", "point")], robot)


BALL = '<sphere radius="0.03"/>'
BESIDE = '<origin xyz="0.07 0 0"/>'
WHEEL = '<cylinder radius="0.2" length="0.1"/>'


@pytest.mark.parametrize(
    ("shapes", "kind", "radius"),
    [
        ([shape(BALL)], "point", 0.03),
        ([shape(BALL, BESIDE)] * 2, "point", 0.0),
        ([shape('<sphere radius="0.02"/>'), shape(BALL)], "point", 0.03),
        ([shape('<box size="1 1 1"/>')], "point", 0.0),
        ([shape(BALL)], "line", 0.0),
        ([shape(WHEEL, '<origin rpy="1.5707963 0 0" xyz="0 1 0.01"/>')], "line", 0.2),
        ([shape(WHEEL, '<origin rpy="1.5 0 0"/>')], "line", 0.0),
        ([shape(BALL)], "flat", 0.0),
    ],
)
def test_a_shape_about_the_origin_is_taken_and_no_other(
    tmp_path: Path, shapes: list[str], kind: Any, radius: float
) -> None:
    contacts, text = resolve_contacts([ContactConfig("foot", kind)], foot_on(tmp_path, *shapes))
    assert contacts[0].radius == radius
    assert ("radius 0:" in text, text == "") == (kind != "flat" and not radius, kind == "flat")
