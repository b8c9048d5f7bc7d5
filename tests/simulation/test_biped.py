"""The demo biped: what ships is what its description writes, and its halves mirror each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from mujoco_oracle import INERTIA_ROUNDING
from paper.biped import HALF_LENGTH, HALF_WIDTH, SOLE, SPHERE, biped_urdf, segments
from scipy.spatial.transform import Rotation
from simulated import BIPED, SOLES
from synthetic import Array, load

from torchid import parameters
from torchid.config import FootConfig
from torchid.robot import Robot
from torchid.simulation.plant import Plant, find_feet

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""Swaps left and right; acts on poses and pseudo-inertias alike."""


@pytest.fixture(scope="module")
def biped() -> Robot:
    return load(BIPED)


def pose_of(robot: Robot, frame: str, joints: Array) -> Array:
    """Pose of a link in the base's frame, (4, 4)."""
    return np.asarray(robot.link_poses(torch.from_numpy(joints)[None])[frame][0].numpy())


def across(name: str) -> str:
    """The same thing on the other side."""
    return {"l": "r", "r": "l"}[name[0]] + name[1:] if name[:2] in ("l_", "r_") else name


def mirrored(robot: Robot, joints: Array) -> Array:
    """The joint positions of the robot's mirror image: what turns about x or z turns the other way."""
    axis = {segment.joint: segment.axis for segment in segments()}
    signs = [1.0 if axis[name] == "y" else -1.0 for name in robot.joint_names]
    return np.array(signs) * joints[[robot.joint_names.index(across(name)) for name in robot.joint_names]]


def test_the_urdf_that_ships_is_the_one_the_description_writes() -> None:
    assert BIPED.read_bytes() == biped_urdf()


def test_it_is_the_lower_half_of_a_person_of_17_bodies_and_16_joints(biped: Robot) -> None:
    assert (len(biped.bodies), biped.n) == (17, 16)
    assert biped.base_link == "pelvis"
    assert biped.massless == ()
    assert 55.0 < biped.nominal[:, 0].sum() < 75.0
    for side in "lr":
        assert sum(name.startswith(f"{side}_") for name in biped.joint_names) == 7


def test_every_body_is_made_of_positive_mass(biped: Robot) -> None:
    margins = parameters.consistency_margin(biped.nominal)
    assert margins.min() > 1e-4  # of the largest eigenvalue: no thin plates, so that every parameter can be fitted


def test_no_inertia_is_so_symmetric_that_its_products_vanish(biped: Robot) -> None:
    products = np.abs(biped.nominal[:, [5, 6, 8]]).max(axis=1) / biped.nominal[:, [4, 7, 9]].max(axis=1)
    assert (products > 1e-3).all()


def test_left_and_right_bodies_are_mirror_images(biped: Robot) -> None:
    for name in biped.body_names:
        if name.startswith("l_"):
            left, right = (biped.nominal[biped.body_names.index(x)] for x in (name, across(name)))
            pseudo = parameters.pseudo_inertia(left)
            np.testing.assert_allclose(parameters.pseudo_inertia(right), MIRROR @ pseudo @ MIRROR, rtol=0, atol=1e-15)
            np.testing.assert_array_equal(left[10:], right[10:])


def test_mirrored_joint_angles_put_every_link_in_the_mirrored_place(biped: Robot) -> None:
    rng = np.random.default_rng(0)
    for _ in range(5):
        joints = rng.uniform(-1.0, 1.0, biped.n)
        for link in biped.links:
            T = pose_of(biped, link, joints)
            other = pose_of(biped, across(link), mirrored(biped, joints))
            np.testing.assert_allclose(other, MIRROR @ T @ MIRROR, rtol=0.0, atol=1e-14)


def test_joints_may_turn_as_far_as_their_mirror_images(biped: Robot) -> None:
    plant = Plant(BIPED, (), 1000.0)
    low, high = plant.limits.T
    assert (low < high).all()
    assert plant.joint_names == biped.joint_names
    ends = mirrored(biped, low), mirrored(biped, high)
    np.testing.assert_allclose(low, np.minimum(*ends), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(high, np.maximum(*ends), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("frame", SOLES)
def test_a_sole_is_a_level_rectangle_of_spheres_below_the_ankle(biped: Robot, frame: str) -> None:
    (foot,) = find_feet([FootConfig(frame)], BIPED)
    points, radii = foot.points, foot.radii
    assert set(radii) == {SPHERE}
    expected = {(x, y, SPHERE) for x in (-HALF_LENGTH, HALF_LENGTH) for y in (-HALF_WIDTH, HALF_WIDTH)}
    assert set(points) == expected
    body, T_foot_sole = biped.links[frame]
    assert biped.body_names[body] == frame.replace("sole", "foot")
    np.testing.assert_array_equal(T_foot_sole[:3, :3], np.eye(3))
    np.testing.assert_array_equal(T_foot_sole[:3, 3], SOLE)


@pytest.mark.parametrize("feet", [(), SOLES], ids=["no feet", "feet"])
def test_mujoco_weighs_what_torchid_weighs(biped: Robot, feet: tuple[str, ...]) -> None:
    plant = Plant(BIPED, find_feet([FootConfig(frame) for frame in feet], BIPED), 1000.0)
    assert plant.mass == pytest.approx(biped.nominal[:, 0].sum(), rel=1e-14)
    assert plant.n == biped.n


def test_mujocos_bodies_are_torchids(biped: Robot) -> None:
    """The sum over bodies hides a swap: body by body, from MuJoCo's principal axes."""
    model = Plant(BIPED, (), 1000.0).model
    for body, phi in zip(biped.bodies, biped.nominal, strict=True):
        index = model.body(body.name).id
        R = Rotation.from_quat(model.body_iquat[index], scalar_first=True).as_matrix()
        com = model.body_ipos[index]
        inertia = R @ np.diag(model.body_inertia[index]) @ R.T
        expected = parameters.inertial_vector(float(model.body_mass[index]), com, inertia)
        np.testing.assert_allclose(
            phi[:10], expected, rtol=0.0, atol=(1e-14 + INERTIA_ROUNDING) * np.abs(expected).max()
        )
