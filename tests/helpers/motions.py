"""Logs of motions whose derivatives are known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchid.logs import Log
from torchid.logs.log import FloatArray

RATE = 500.0


def angles(t: NDArray[Any]) -> NDArray[Any]:
    """Yaw, pitch and roll of a base that turns 3.5 times around in 4 s while it rocks."""
    return np.stack([5.5 * t + 0.5 * np.sin(3 * t), 0.8 * np.sin(4 * t + 0.3), 0.6 * np.cos(5 * t) - 0.2], axis=-1)


def slope(path: Any, t: FloatArray) -> FloatArray:
    """Derivative of an analytic function by a complex step: exact to machine precision."""
    return np.asarray(path(t + 1e-30j).imag / 1e-30)


def omega_base(t: NDArray[Any]) -> NDArray[Any]:
    """Angular velocity in the base frame from the rates of the angles; textbook formula for z-y-x angles."""
    _, pitch, roll = np.moveaxis(angles(t), -1, 0)
    yaw_rate = 5.5 + 1.5 * np.cos(3 * t)
    pitch_rate, roll_rate = 3.2 * np.cos(4 * t + 0.3), -3.0 * np.sin(5 * t)
    return np.stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
        ],
        axis=-1,
    )


def position(t: NDArray[Any]) -> NDArray[Any]:
    """A position on a curved path [m]."""
    return np.stack([np.sin(2 * t) + 0.1 * t, 0.3 * np.cos(6 * t + 1), 0.2 * np.sin(5 * t) * np.cos(t)], axis=-1)


def velocity(t: NDArray[Any]) -> NDArray[Any]:
    """Its velocity [m/s]."""
    return np.stack(
        [
            2 * np.cos(2 * t) + 0.1,
            -1.8 * np.sin(6 * t + 1),
            np.cos(5 * t) * np.cos(t) - 0.2 * np.sin(5 * t) * np.sin(t),
        ],
        axis=-1,
    )


def moving_log(time: FloatArray, **fields: Any) -> Log:
    """A free base with one joint on the analytic path, positions only unless `fields` say more."""
    quat = Rotation.from_euler("ZYX", angles(time)).as_quat(canonical=True)  # w >= 0: signs jump
    return Log("moving.npz", time, ("a", "b", "c"), position(time), **{"base_quat_xyzw": quat, **fields})


def uniform(seconds: float = 4.0, rate: float = RATE) -> FloatArray:
    """Uniform stamps [s]."""
    return np.asarray(np.arange(round(seconds * rate)) / rate, dtype=np.float64)


def jittered(seconds: float = 4.0, rate: float = RATE) -> FloatArray:
    """Stamps that are off by up to 30 % of a step [s]."""
    time = uniform(seconds, rate)
    return time + np.random.default_rng(0).uniform(-0.3, 0.3, len(time)) / rate


def value(array: Any) -> Any:
    """The array, which must be there."""
    assert array is not None
    return array


def assert_analytic(log: Log, tolerance: float) -> None:
    """Every derivative of `moving_log` is the analytic one, to `tolerance` times its largest value."""
    t = log.time
    world_base = Rotation.from_euler("ZYX", angles(t))
    expected = {
        "joint_position": position(t),
        "joint_velocity": velocity(t),
        "joint_acceleration": slope(velocity, t),
        "base_linear_velocity_world": velocity(t),
        "base_linear_acceleration_world": slope(velocity, t),
        "base_angular_velocity_base": omega_base(t),
        "base_angular_acceleration_base": slope(omega_base, t),
    }
    for name, truth in expected.items():
        error = np.max(np.abs(value(getattr(log, name)) - truth)) / np.max(np.abs(truth))
        assert error < tolerance, f"{name}: {error:.1e}"
    turned = (Rotation.from_quat(value(log.base_quat_xyzw)).inv() * world_base).magnitude()
    assert np.max(turned) < tolerance
    np.testing.assert_allclose(np.linalg.norm(value(log.base_quat_xyzw), axis=1), 1, rtol=1e-15)


def sine_log(hertz: float, time: FloatArray, **fields: Any) -> Log:
    """One joint that swings at one frequency."""
    return Log("sine.npz", time, ("a",), np.sin(2 * np.pi * hertz * time + 0.7)[:, None], **fields)
