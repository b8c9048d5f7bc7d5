"""Quaternions in the order xyzw that rotate the base frame to the world frame, and the angular rates of their paths."""

from __future__ import annotations

import numpy as np

from torchid.errors import LogError
from torchid.logs.log import NORM_TOLERANCE, FloatArray


def make_sign_continuous(quat: FloatArray) -> FloatArray:
    """The same rotations without sign flips between samples, (N, 4) in any order; `quat` itself where it has none.

    q and -q are the same rotation, but components that change sign cannot be interpolated or filtered. Rows of NaN are
    skipped.
    """
    known = ~np.isnan(quat).any(axis=1)
    if not known.all():
        out = quat.copy()
        out[known] = make_sign_continuous(quat[known])
        return out
    flips = np.einsum("ni,ni->n", quat[1:], quat[:-1]) < 0.0
    if not flips.any():
        return quat
    sign = np.ones((len(quat), 1))
    sign[1:, 0] = np.where(np.cumsum(flips) % 2, -1.0, 1.0)
    return quat * sign


def require_unit(topic: str, quat: FloatArray, key: str) -> FloatArray:
    """The orientations (N, 4) of an IMU's messages.

    Args:
        topic: of the messages.
        quat: in any order.
        key: of the settings of the topic, whose `orientation` is true.

    Raises:
        LogError: one is no unit quaternion.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        norm = np.linalg.norm(quat, axis=1)
        bad = ~(np.abs(norm - 1.0) <= NORM_TOLERANCE)
    if bad.any():
        reason = f"an IMU quaternion has norm {norm[bad][0]:.4g}"
        raise LogError.at_field(topic, reason, f"unit quaternions, or {key}.orientation: false")
    return quat


def quaternion_of_rpy(rpy: FloatArray, order: str) -> FloatArray:
    """Quaternions (N, 4) of angles (N, 3) [rad] about the world's x, then y, then z; NaN where an angle is.

    Args:
        rpy: roll, pitch and yaw, as in a URDF.
        order: of the components, xyzw or wxyz.
    """
    known = np.isfinite(rpy).all(axis=1)
    quat = np.full((len(rpy), 4), np.nan)
    from scipy.spatial.transform import Rotation

    quat[known] = Rotation.from_euler("xyz", rpy[known]).as_quat()
    return quat if order == "xyzw" else np.roll(quat, 1, axis=1)


def rotate_to_world(quat_xyzw: FloatArray, vector_base: FloatArray) -> FloatArray:
    """Components (N, 3) in the world of vectors (N, 3) given in the base frame, for unit quaternions (N, 4)."""
    axis = quat_xyzw[:, :3]
    w = quat_xyzw[:, 3:]
    turn = 2.0 * np.cross(axis, vector_base)
    return vector_base + w * turn + np.cross(axis, turn)


def inverse_rotation(quat_xyzw: FloatArray) -> FloatArray:
    """Inverse rotations, (N, 4), of unit quaternions (N, 4)."""
    return quat_xyzw * np.array([-1.0, -1.0, -1.0, 1.0])


def rotate_to_base(quat_xyzw: FloatArray, vector_world: FloatArray) -> FloatArray:
    """Components (N, 3) in the base frame of vectors (N, 3) given in the world, for unit quaternions (N, 4)."""
    return rotate_to_world(inverse_rotation(quat_xyzw), vector_world)


def _divide(quat: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Vector (N, 3) and scalar (N, 1) part of quat^-1 other."""
    v = quat[:, :3]
    w = quat[:, 3:]
    v2 = other[:, :3]
    w2 = other[:, 3:]
    square = np.sum(quat * quat, axis=1, keepdims=True)
    return (w * v2 - w2 * v - np.cross(v, v2)) / square, (w * w2 + np.sum(v * v2, axis=1, keepdims=True)) / square


def angular_velocity_base(quat: FloatArray, rate: FloatArray) -> FloatArray:
    """Angular velocity (N, 3) [rad/s] in the base frame, 2 vec(q^-1 q'), of a path q(t) in the order xyzw.

    q need not be a unit quaternion: its norm and the norm's rate only enter the scalar part of q^-1 q'.
    """
    return 2.0 * _divide(quat, rate)[0]


def angular_acceleration_base(quat: FloatArray, rate: FloatArray, second: FloatArray) -> FloatArray:
    """Angular acceleration (N, 3) [rad/s^2] in the base frame, 2 vec(q^-1 q'' - (q^-1 q')^2), of a path q(t).

    It is the time derivative of `angular_velocity_base`, exact where q is no unit quaternion.
    """
    vector, scalar = _divide(quat, rate)
    return 2.0 * (_divide(quat, second)[0] - 2.0 * scalar * vector)
