"""Ellipsoids with the inertia of a body."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchid import parameters
from torchid.parameters import Array
from torchid.report.figures import _outline, equivalent_ellipsoid

MASS, CENTER, SEMI_AXES = 3.0, np.array([0.1, -0.2, 0.4]), np.array([0.05, 0.12, 0.3])
AXES = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()


def solid() -> Array:
    """Parameters of a uniform solid ellipsoid, from its textbook moments m (b^2 + c^2) / 5."""
    a, b, c = np.square(SEMI_AXES)
    central = AXES @ np.diag([b + c, a + c, a + b]) @ AXES.T * MASS / 5.0
    return np.append(parameters.inertial_vector(MASS, CENTER, central), [0.0, 0.0])


def test_a_uniform_ellipsoid_is_its_own() -> None:
    found = equivalent_ellipsoid(solid())
    assert found is not None
    center, semi_axes = found
    np.testing.assert_allclose(center, CENTER, atol=1e-12)
    np.testing.assert_allclose(semi_axes @ semi_axes.T, AXES @ np.diag(SEMI_AXES**2) @ AXES.T, atol=1e-12)


@pytest.mark.parametrize("plane", [[0, 2], [1, 2]])
def test_its_outline_is_what_one_sees_from_a_side(plane: list[int]) -> None:
    """In each direction of the plane it reaches as far as the ellipsoid, turned and moved to the base's frame."""
    found = equivalent_ellipsoid(solid())
    assert found is not None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("zyx", [1.0, 0.2, -0.4]).as_matrix(), [1.0, 2.0, 3.0]
    outline = _outline(*found, pose, plane, "#000000")
    np.testing.assert_allclose(outline.center, (pose[:3, :3] @ CENTER + pose[:3, 3])[plane], atol=1e-12)
    axes = (pose[:3, :3] @ AXES @ np.diag(SEMI_AXES))[plane]
    for angle in np.linspace(0.0, np.pi, 7):
        direction = np.array([np.cos(angle), np.sin(angle)])
        turned = angle - np.radians(outline.angle)
        reach = 0.5 * np.hypot(outline.width * np.cos(turned), outline.height * np.sin(turned))
        assert reach == pytest.approx(np.linalg.norm(direction @ axes), rel=1e-12)


@pytest.mark.parametrize("change", [(parameters.MASS, -1.0), (4, 10.0)], ids=["mass below 0", "Ixx > Iyy + Izz"])
def test_an_impossible_body_has_none(change: tuple[int, float]) -> None:
    phi = solid()
    phi[change[0]] = change[1]
    assert equivalent_ellipsoid(phi) is None
    assert equivalent_ellipsoid(np.zeros(12)) is None
