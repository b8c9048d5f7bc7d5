"""Uniform ellipsoids with the inertia of a body, as triangles."""

from __future__ import annotations

import numpy as np

from torchid import parameters
from torchid.parameters import Array

_MERIDIANS, _PARALLELS = 16, 9


def equivalent_ellipsoid(phi: Array) -> tuple[Array, Array] | None:
    """Centre (3,) and semi-axes, columns of (3, 3) [m], of the uniform ellipsoid with a body's mass and inertia.

    Its second moment about the centre of mass is a fifth of the mass times the squared semi-axes.

    Args:
        phi: (>= 10,), in the link frame.

    Returns:
        None where no distribution of positive mass has them, or without mass.
    """
    if phi[parameters.MASS] <= 0.0 or parameters.consistency_margin(phi) < parameters.POSSIBLE_MARGIN:
        return None
    mass, center, inertia = parameters.mass_com_inertia(phi)
    second_moment = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    eigenvalues, axes = np.linalg.eigh(second_moment)
    return center, axes * np.sqrt(5.0 * np.maximum(eigenvalues, 0.0) / mass)


def ellipsoid_points(center: Array, semi_axes: Array, T_base_link: Array) -> Array:
    """Vertices of an ellipsoid in the link frame, (V, 3) [m], in the base's; `TRIANGLES` join them."""
    in_link = center + _SPHERE @ semi_axes.T
    return in_link @ T_base_link[:3, :3].T + T_base_link[:3, 3]


def _sphere() -> tuple[Array, np.ndarray]:
    """Vertices of a unit sphere, (V, 3), and its triangles, (T, 3)."""
    polar = np.pi * np.arange(1, _PARALLELS) / _PARALLELS
    around = 2.0 * np.pi * np.arange(_MERIDIANS) / _MERIDIANS
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    rings = [np.column_stack([np.sin(p) * ring, np.full(_MERIDIANS, np.cos(p))]) for p in polar]
    points = np.concatenate([[[0.0, 0.0, 1.0]], *rings, [[0.0, 0.0, -1.0]]])
    numbers = 1 + np.arange((_PARALLELS - 1) * _MERIDIANS).reshape(-1, _MERIDIANS)
    following, last = np.roll(numbers, -1, axis=1), len(points) - 1
    upper, lower = numbers[:-1].ravel(), numbers[1:].ravel()
    triangles = np.concatenate(
        [
            np.stack([np.zeros(_MERIDIANS, int), numbers[0], following[0]], axis=1),
            np.stack([upper, lower, following[:-1].ravel()], axis=1),
            np.stack([following[:-1].ravel(), lower, following[1:].ravel()], axis=1),
            np.stack([np.full(_MERIDIANS, last), following[-1], numbers[-1]], axis=1),
        ]
    )
    return points, triangles


_SPHERE, TRIANGLES = _sphere()
"""Triangles of every ellipsoid, (T, 3), by the numbers of its vertices."""
