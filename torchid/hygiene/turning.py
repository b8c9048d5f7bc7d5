"""Angular velocity against orientation, and a gyroscope against both: unit, frame, order of the quaternion."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchid.hygiene.derivatives import BETTER, WRONG, judged
from torchid.hygiene.finding import CONDEMNED, Finding, Skipped
from torchid.hygiene.rates import compare, integral
from torchid.logs import Log
from torchid.logs.fields import FloatArray
from torchid.logs.quaternion import angular_velocity_base, rotate, rotate_back, sign_continuous
from torchid.robot import Robot

_NAME = "angular velocity against orientation"


def turning(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about angular velocities and the orientation."""
    quat = log.base_quat_xyzw
    if quat is None or len(log) < 3:
        yield Skipped(_NAME, "no orientation of the base" if quat is None else "the log is too short")
        return
    given = dict(_measured(log, robot))
    if not given:
        nowhere = "an IMU, and no robot that says where it is"
        yield Skipped(_NAME, nowhere if log.imu_frame else "no angular velocity of the base")
    for field, omega in given.items():
        found = compare(log.time, integral(log.time, _omega(log.time, quat)), omega)
        if found is None:
            yield Skipped(_NAME, f"{field}: the log is too short")
            continue
        mistaken = next(_mistakes(log.time, quat, omega, found.misfit), None) if found.misfit > WRONG else None
        if mistaken is None:
            yield from judged(found, field, "base_quat", ("x", "y", "z"))
        else:
            what, advice, field = mistaken[0], mistaken[1], mistaken[2] or field
            yield Finding("frame or order", CONDEMNED, field, what, advice)


def _measured(log: Log, robot: Robot | None) -> Iterator[tuple[str, FloatArray]]:
    """Angular velocities of the base in its own frame, by field."""
    if log.base_angular_velocity_base is not None:
        yield "base_angular_velocity_base", log.base_angular_velocity_base
    if log.imu_angular_velocity is not None and robot is not None and log.imu_frame in robot.links:
        body, T_base_imu = robot.links[log.imu_frame]
        if body == 0:
            yield "imu_angular_velocity", log.imu_angular_velocity @ T_base_imu[:3, :3].T


def _omega(time: FloatArray, quat: FloatArray) -> FloatArray:
    """Angular velocity (N, 3) [rad/s] in the base frame of orientations (N, 4), by central differences."""
    return angular_velocity_base(quat, np.gradient(quat, time, axis=0))


def _mistakes(time: FloatArray, quat: FloatArray, omega: FloatArray, misfit: float) -> Iterator[tuple[str, str, str]]:
    """Usual mistakes that explain what does not fit: what was found, what to do, and the field to blame if another."""
    swapped = sign_continuous(np.roll(quat, 1, axis=1))  # if x, y, z, w are really w, x, y, z the other way round
    reread = sign_continuous(np.roll(quat, -1, axis=1))
    inverse = quat * np.array([-1.0, -1.0, -1.0, 1.0])
    order = "the components' order is the other one: w first against w last"
    trials = [
        (quat, rotate_back(quat, omega), "fits in the world frame, not in the base frame", "call it ..._world", ""),
        (quat, rotate(quat, omega), "fits in the base frame, not in the world frame", "call it ..._base", ""),
        *(
            (other, value, order, "rename base_quat_wxyz and base_quat_xyzw", "base_quat_xyzw")
            for other in (swapped, reread)
            for value in (omega, rotate_back(other, rotate(quat, omega)))
        ),
        (inverse, omega, "rotates world to base, not base to world", "give the inverse", "base_quat_xyzw"),
    ]
    for other, value, what, advice, field in trials:
        found = compare(time, integral(time, _omega(time, other)), value)
        if found is not None and found.misfit < BETTER * misfit:
            yield what, advice, field
