"""Order of a body's parameters and of wrench components, functions of the parameters, and gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PARAMETERS = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz", "fc", "fv")
PARAMETER_UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6, "N m", "N m s/rad")
PER_BODY = len(PARAMETERS)
INERTIAL = slice(0, 10)
MASS = 0
FIRST_MOMENT = slice(1, 4)
INERTIA = slice(4, 10)
FRICTION = slice(10, 12)
COULOMB = 10
VISCOUS = 11

INERTIA_AXES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Row and column of each of the six inertia numbers in the inertia matrix."""

GRAVITY = 9.81  # [m/s^2]

WRENCH_COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Order of the components of a wrench: force [N], then moment [N m]."""


def inertia_matrix(phi: Array) -> Array:
    """Rotational inertia about the link origin, (..., 3, 3) [kg m^2], of parameters (..., >= 10)."""
    inertia = np.empty((*phi.shape[:-1], 3, 3))
    for value, (row, column) in zip(np.moveaxis(phi[..., INERTIA], -1, 0), INERTIA_AXES, strict=True):
        inertia[..., row, column] = inertia[..., column, row] = value
    return inertia


def inertial_vector(mass: float, com: Array, inertia_com: Array) -> Array:
    """Ten inertial parameters about the link origin, from mass, centre of mass and central inertia.

    Args:
        mass: [kg].
        com: centre of mass in the link frame, (3,) [m].
        inertia_com: rotational inertia about the centre of mass, link axes, (3, 3) [kg m^2].
    """
    inertia = inertia_com + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.array([mass, *(mass * com), *(inertia[row, column] for row, column in INERTIA_AXES)])


def mass_com_inertia(phi: Array) -> tuple[float, Array, Array]:
    """Inverse of `inertial_vector`: mass [kg], centre of mass (3,) [m], inertia about it (3, 3) [kg m^2]."""
    mass = float(phi[MASS])
    com = phi[FIRST_MOMENT] / mass
    inertia = inertia_matrix(phi) - mass * (com @ com * np.eye(3) - np.outer(com, com))
    return mass, com, inertia


def pseudo_inertia(phi: Array) -> Array:
    """Pseudo-inertia matrix, (..., 4, 4), positive semidefinite for every body of positive mass density.

    Source: Wensing, Kim, Slotine, "Linear matrix inequalities for physically consistent inertial parameter
    identification", RA-L 2018, eq. (17).
    """
    inertia = inertia_matrix(phi)
    pseudo = np.empty((*phi.shape[:-1], 4, 4))
    trace = np.trace(inertia, axis1=-2, axis2=-1)[..., None, None]
    pseudo[..., :3, :3] = 0.5 * trace * np.eye(3) - inertia
    pseudo[..., :3, 3] = pseudo[..., 3, :3] = phi[..., FIRST_MOMENT]
    pseudo[..., 3, 3] = phi[..., MASS]
    return pseudo


PSEUDO_BASIS = pseudo_inertia(np.eye(INERTIAL.stop))
"""Derivative of the pseudo-inertia with respect to the ten inertial parameters, (10, 4, 4); it is linear in them."""


def from_pseudo_inertia(pseudo: Array) -> Array:
    """Inverse of `pseudo_inertia`: ten inertial parameters, (..., 10)."""
    second_moment = pseudo[..., :3, :3]
    trace = np.trace(second_moment, axis1=-2, axis2=-1)[..., None, None]
    inertia = trace * np.eye(3) - second_moment
    rows, columns = zip(*INERTIA_AXES, strict=True)
    return np.concatenate([pseudo[..., 3, 3:], pseudo[..., :3, 3], inertia[..., rows, columns]], axis=-1)


def change_of_frame(T_new_old: Array) -> Array:
    """Matrix X, (10, 10), with `phi_new = X @ phi_old` for the same body.

    Args:
        T_new_old: pose of the old frame in the new one, (4, 4) [m].
    """
    return from_pseudo_inertia(T_new_old @ PSEUDO_BASIS @ T_new_old.T).T


POSSIBLE_MARGIN = -1e-9
"""Smallest `consistency_margin` of a consistent body: point masses and thin plates are at 0, up to rounding."""


def consistency_margin(phi: Array) -> Array:
    """Smallest eigenvalue of the pseudo-inertia over the largest in size, (...,); negative: physically impossible."""
    eigenvalues = np.linalg.eigvalsh(pseudo_inertia(phi))
    return eigenvalues[..., 0] / np.maximum(np.abs(eigenvalues).max(axis=-1), np.finfo(float).tiny)


def least_eigenvalues(phi: Array, scale: Array) -> Array:
    """Smallest eigenvalue of every body's scaled pseudo-inertia, (L,), NaN for bodies without inertia.

    Args:
        phi: (12 L,).
        scale: (12 L,), sizes that the parameters are measured in.
    """
    scaled = (phi / scale).reshape(-1, PER_BODY)
    eigenvalues = np.array(np.linalg.eigvalsh(pseudo_inertia(scaled))[:, 0])
    eigenvalues[~scaled[:, INERTIAL].any(axis=1)] = np.nan
    return eigenvalues


def perturb_parameters(phi: Array, error: float, rng: np.random.Generator) -> Array:
    """Parameters (L, 12) with relative errors up to `error`, which keep physical consistency.

    Mass, each coordinate of the centre of mass, and the inertia about it are multiplied by factors from 1 - error to
    1 + error, independently and uniformly; friction does not change.
    """
    out = phi.copy()
    for body in np.flatnonzero(phi[:, MASS] > 0.0):
        mass, com, inertia = mass_com_inertia(phi[body])
        factors = 1.0 + error * rng.uniform(-1.0, 1.0, 5)
        out[body, INERTIAL] = inertial_vector(factors[0] * mass, factors[1:4] * com, factors[4] * inertia)
    return out
