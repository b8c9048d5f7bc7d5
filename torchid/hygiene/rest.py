"""Samples at which a robot stands still."""

from __future__ import annotations

import numpy as np

from torchid.hygiene.channels import median_step
from torchid.hygiene.neighbours import near
from torchid.logs import Log
from torchid.logs.fields import BoolArray, FloatArray

#: Time [s] over which nothing may have moved by more than `MOVED` [rad, m, or of a quaternion's component].
WINDOW = 0.5
#: 0.01 within half a second, and within either half of it: accelerations well below 0.2 m/s^2, 2 % of gravity.
MOVED = 0.01


def at_rest(log: Log) -> BoolArray:
    """Which samples (N,) are inside a window in which neither base nor joints move."""
    still = np.zeros(len(log), bool)
    if len(log) < 3:
        return still
    half = max(1, round(0.5 * WINDOW / median_step(log)))
    if len(log) <= 2 * half:
        return still
    middle = np.ones(len(log) - 2 * half, bool)
    for values in _poses(log):
        start, centre, end = values[: -2 * half], values[half:-half], values[2 * half :]
        for one, other in ((start, centre), (centre, end), (start, end)):
            middle &= (np.abs(one - other) < MOVED).all(axis=1)
    if log.imu_angular_velocity is not None:
        turned = np.linalg.norm(log.imu_angular_velocity, axis=1)[half:-half] * WINDOW
        middle &= turned < 10.0 * MOVED  # a gyroscope has a bias
    still[half:-half] = middle
    return near(still, half)


def _poses(log: Log) -> list[FloatArray]:
    found = (log.joint_position, log.base_quat_xyzw, log.base_position_world)
    return [values for values in found if values is not None and values.shape[1]]
