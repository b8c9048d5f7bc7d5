"""Angular velocity against orientation, and a gyroscope against both: unit, frame, order of the quaternion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from torchid.hygiene.derivatives import BETTER, WRONG, judged
from torchid.hygiene.finding import CONDEMNED, Finding, Skipped
from torchid.hygiene.rates import compare, integral
from torchid.logs import Log
from torchid.logs.fields import FloatArray
from torchid.logs.quaternion import angular_velocity_base, inverse, rotate, rotate_back, sign_continuous
from torchid.robot import Robot

_NAME = "angular velocity against orientation"


def turning(log: Log, robot: Robot | None) -> Iterator[Finding | Skipped]:
    """Findings about angular velocities and the orientation."""
    quat = log.base_quat_xyzw
    if quat is None and robot is not None and robot.fixed_base:
        return  # it does not turn
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
        mistaken = _explaining(log.time, quat, omega, found.misfit) if found.misfit > WRONG else None
        if mistaken is None:
            yield from judged(found, field, "base_quat", ("x", "y", "z"))
        else:
            yield Finding("frame or order", CONDEMNED, mistaken.field or field, mistaken.found, mistaken.advice)


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


@dataclass(frozen=True, eq=False)
class _Mistake:
    """A usual mistake: what was found, what to do, the field to blame ("": omega), and what was meant."""

    found: str
    advice: str
    field: str
    quat: FloatArray
    omega: FloatArray


def _mistakes(quat: FloatArray, omega: FloatArray) -> Iterator[_Mistake]:
    """Usual mistakes with an orientation (N, 4) and an angular velocity (N, 3)."""
    frame = "fits in the {} frame, not in the {} frame"
    yield _Mistake(frame.format("world", "base"), "call it ..._world", "", quat, rotate_back(quat, omega))
    yield _Mistake(frame.format("base", "world"), "call it ..._base", "", quat, rotate(quat, omega))
    order = "the components' order is the other one: w first against w last"
    for shift in (1, -1):
        other = sign_continuous(np.roll(quat, shift, axis=1))
        for value in (omega, rotate_back(other, rotate(quat, omega))):  # as it is, or as it was given in the world
            yield _Mistake(order, "rename base_quat_wxyz and base_quat_xyzw", "base_quat_xyzw", other, value)
    yield _Mistake("the sign is reversed", "reverse it", "", quat, -omega)
    name = "rotates world to base, not base to world"
    yield _Mistake(name, "give the inverse", "base_quat_xyzw", inverse(quat), omega)


def _explaining(time: FloatArray, quat: FloatArray, omega: FloatArray, misfit: float) -> _Mistake | None:
    """The mistake that leaves the least of a misfit once it is taken back, if that is little.

    The least, for a base that turns little is as well off with the inverse as with the reverse.
    """
    best, least = None, BETTER * misfit
    for mistake in _mistakes(quat, omega):
        found = compare(time, integral(time, _omega(time, mistake.quat)), mistake.omega)
        if found is not None and found.misfit < least:
            best, least = mistake, found.misfit
    return best
