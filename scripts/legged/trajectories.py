"""Parts of prescribed motions, whatever computes forces from them: smooth steps, waves, swings of feet, a base."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from torchid.parameters import Array

_STEP = 1e-5  # s, of central differences


def quintic(x: Array) -> Array:
    """From 0 to 1 on [0, 1] with two continuous derivatives."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x * x)


def waves(rng: np.random.Generator, time: Array, count: int, slow: float, fast: float) -> Array:
    """Sums of two sines, (N, count), of size about 1, between two frequencies [Hz]."""
    hz, phase = rng.uniform(slow, fast, (2, count)), rng.uniform(0.0, 2.0 * np.pi, (2, count))
    return np.sin(2.0 * np.pi * time[:, None, None] * hz + phase).sum(axis=1) / np.sqrt(2.0)


class Swing(NamedTuple):
    """One swing of a foot at stamps (N,): how far it is, 0 to 1, its height [m], and readiness to carry, 0 to 1."""

    progress: Array
    height: Array
    ready: Array

    @classmethod
    def at(cls, time: Array, start: float, seconds: float, lift: float, ramp: float) -> Swing:
        """A swing that starts at a time, `lift` high [m]; before and after it, load goes and comes in `ramp` [s]."""
        x = (time - start) / seconds
        height = lift * np.where((x > 0.0) & (x < 1.0), 64.0 * (x * (1.0 - x)) ** 3, 0.0)
        away, back = quintic((start - time) / ramp), quintic((time - start - seconds) / ramp)
        return cls(quintic(x), height, np.maximum(away, back))


class BaseMotion(NamedTuple):
    """A base at stamps (N,): rotation to the world, velocity and angular velocity, (N, 3), and their derivatives.

    The angular velocity is along base axes.
    """

    rotation: Rotation
    linear: Array
    angular: Array
    linear_rate: Array
    angular_rate: Array

    @classmethod
    def along(cls, path: Any, time: Array, in_base: bool = False) -> BaseMotion:
        """The motion along a spline of positions [m] and z-y-x angles [rad], (6,).

        `in_base`: whether the velocity is along base axes, and its rate the derivative of these components.
        """
        rotation, linear, angular = _twist(path, time, in_base)
        (_, after, spin), (_, before, was) = _twist(path, time + _STEP, in_base), _twist(path, time - _STEP, in_base)
        return cls(rotation, linear, angular, (after - before) / (2.0 * _STEP), (spin - was) / (2.0 * _STEP))


def _twist(path: Any, time: Array, in_base: bool) -> tuple[Rotation, Array, Array]:
    value, rate = path(time), path(time, 1)
    R = Rotation.from_euler("ZYX", value[:, 3:])
    _, pitch, roll = value[:, 3:].T
    yaw_rate, pitch_rate, roll_rate = rate[:, 3:].T
    omega = [
        roll_rate - yaw_rate * np.sin(pitch),
        pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
        -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
    ]
    return R, R.inv().apply(rate[:, :3]) if in_base else rate[:, :3], np.stack(omega, axis=1)
