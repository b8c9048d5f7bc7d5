"""The usual mistakes in a log, each as the log that it would be without."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.hygiene.angles import TWO_TURNS
from torchid.hygiene.weight import GRAVITY
from torchid.logs import Log
from torchid.logs.fields import WRENCHES
from torchid.logs.quaternion import inverse, sign_continuous
from torchid.text import listed

#: What follows from positions and orientation, whoever gives it.
_JOINT_RATES = ("joint_velocity", "joint_acceleration")
_BASE_RATES = ("base_angular_velocity_base", "base_angular_acceleration_base")
_MOMENTS_IN_MILLI = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])


@dataclass(frozen=True)
class Mistake:
    """A usual mistake: the field, what is wrong with it, what to do, and what takes it back."""

    field: str
    found: str
    advice: str
    mended: Callable[[Log], Log]


def mistakes(log: Log) -> Iterator[Mistake]:
    """The mistakes that this log could hold."""
    for rates in (_JOINT_RATES, _BASE_RATES):
        given = [field for field in rates if getattr(log, field) is not None]
        if given:
            text, advice = f"{' and '.join(given)} not what positions say", "leave them out: they are derived then"
            yield Mistake(given[-1], text, advice, _without(given))
    yield Mistake("joint_position", "in degrees", "convert to radians", lambda log: _in_degrees(log, slice(None)))
    far = np.flatnonzero(np.abs(log.joint_position).max(axis=0, initial=0.0) > TWO_TURNS)
    if 0 < len(far) < len(log.joint_names):
        some = f"{listed([log.joint_names[joint] for joint in far])} in degrees"
        yield Mistake("joint_position", some, "convert to radians", lambda log: _in_degrees(log, far))
    if log.base_quat_xyzw is not None:
        order, rename = "w first against w last is mixed up", "rename base_quat_wxyz and base_quat_xyzw"
        yield Mistake("base_quat_xyzw", order, rename, _quaternions(lambda quat: np.roll(quat, -1, axis=1)))
        yield Mistake("base_quat_xyzw", order, rename, _quaternions(lambda quat: np.roll(quat, 1, axis=1)))
        yield Mistake("base_quat_xyzw", "rotates world to base", "give the inverse", _quaternions(inverse))
    if log.joint_torque is not None:
        reverse = "reverse them; a base that hangs upside down looks the same (give base_quat)"
        yield Mistake("joint_torque", "all reversed", reverse, _scaled("joint_torque", -1.0))
        yield Mistake("joint_torque", "in mN m", "divide by 1000", _scaled("joint_torque", 1e-3))
        yield Mistake("joint_torque", "in kN m", "multiply by 1000", _scaled("joint_torque", 1e3))
    for field, other in (WRENCHES, WRENCHES[::-1]):
        if getattr(log, field) is not None:
            yield from _of_wrenches(field, other)


def _of_wrenches(field: str, other: str) -> Iterator[Mistake]:
    reverse = "reverse it: wrenches are what the ground exerts on the robot"
    yield Mistake(field, "all reversed", reverse, _scaled(field, -1.0))
    for unit, factor in (("kN and kN m", 1e3), ("kg", GRAVITY), ("mN and mN m", 1e-3)):
        yield Mistake(field, f"in {unit}", f"multiply by {factor:g}", _scaled(field, factor))
    moments = _change(lambda log: {field: getattr(log, field) * _MOMENTS_IN_MILLI})
    yield Mistake(field, "moments in N mm", "multiply moments by 0.001", moments)
    axes = "along the world's axes" if other == WRENCHES[1] else "along the contact frames' axes"
    moved = _change(lambda log: {other: getattr(log, field), field: None})
    yield Mistake(field, axes, f"call it {other}", moved)


def _change(fields: Callable[[Log], dict[str, Any]]) -> Callable[[Log], Log]:
    return lambda log: dataclasses.replace(log, **fields(log))


def _without(fields: Sequence[str]) -> Callable[[Log], Log]:
    return _change(lambda _: dict.fromkeys(fields))


def _scaled(field: str, factor: float) -> Callable[[Log], Log]:
    return _change(lambda log: {field: factor * getattr(log, field)})


def _in_degrees(log: Log, joints: slice | NDArray[np.intp]) -> Log:
    """The log with joints in radians; velocities and accelerations, which may be right, are derived anew."""
    position = log.joint_position.copy()
    position[:, joints] = np.radians(position[:, joints])
    return dataclasses.replace(_without(_JOINT_RATES)(log), joint_position=position)


def _quaternions(change: Callable[[Any], Any]) -> Callable[[Log], Log]:
    rates = dict.fromkeys(_BASE_RATES)
    return _change(lambda log: {"base_quat_xyzw": sign_continuous(change(log.base_quat_xyzw)), **rates})
