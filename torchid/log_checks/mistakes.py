"""Usual mistakes in logs, each with the function that corrects it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchid.errors import join_names
from torchid.log_checks.motion import TWO_TURNS
from torchid.log_checks.weight import GRAVITY
from torchid.logs import Log
from torchid.logs.log import WRENCHES
from torchid.logs.quaternion import inverse_rotation, make_sign_continuous

#: Parts of names that distinguish the sides, and the ends, of a robot.
_SIDES = ("left right", "Left Right", "LEFT RIGHT", "l r", "L R", "FL FR", "RL RR", "HL HR", "LF RF", "LH RH")
_ENDS = ("front rear", "front hind", "front back", "fore hind", "Front Rear", "FL RL", "FR RR", "LF LH", "RF RH")
_PARTS = re.compile(r"([A-Za-z0-9]+)")
#: Joints of a chain up to which single neighbours are tried.
_SHORT = 12


def exchanged_names(names: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Other names that the columns may truly have, with what was mixed up: sides, ends, or the alphabet."""
    seen = {tuple(names)}
    for what, pairs in (("left and right", _SIDES), ("front and rear", _ENDS)):
        other = _exchanged(names, pairs)
        if other is not None and other not in seen:
            seen.add(other)
            yield what, other
    for what, other in (("alphabetical order and this", tuple(sorted(names))), ("the order", tuple(names[::-1]))):
        if other not in seen and len(names) > 1:
            seen.add(other)
            yield what, other


def _exchanged_neighbours(names: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Names with two that follow each other in a short chain exchanged."""
    for i in range(len(names) - 1 if len(names) <= _SHORT else 0):
        yield f"{names[i]} and {names[i + 1]}", (*names[:i], names[i + 1], names[i], *names[i + 2 :])


def _exchanged(names: Sequence[str], pairs: Sequence[str]) -> tuple[str, ...] | None:
    """Every name with its part exchanged for the other; None unless these are the same names again."""
    for some in (pairs, *([pair] for pair in pairs)):  # all together, or where two share a part, each alone
        other = {one: two for pair in some for one, two in (pair.split(), pair.split()[::-1])}
        found = tuple("".join(other.get(part, part) for part in _PARTS.split(name)) for name in names)
        if sorted(found) == sorted(names) and found != tuple(names):
            return found
    return _by_first_letter(names) if pairs is _SIDES else None


def _by_first_letter(names: Sequence[str]) -> tuple[str, ...] | None:
    """As in LAnkle and RAnkle, or lfoot and rfoot."""
    swap = {"L": "R", "R": "L", "l": "r", "r": "l"}
    found = tuple(
        other if name[:1] in swap and (other := swap[name[0]] + name[1:]) in names else name for name in names
    )
    return found if found != tuple(names) else None


#: Fields that follow from positions and orientation.
_JOINT_RATES = ("joint_velocity", "joint_acceleration")
_BASE_RATES = ("base_angular_velocity_base", "base_angular_acceleration_base")
#: What is given along the world's axes, and what half a turn about x makes of such a vector.
_WORLD = (
    "base_position_world",
    "base_linear_velocity_world",
    "base_linear_acceleration_world",
    "contact_wrench_world",
)
_HALF_TURN = np.array([1.0, -1.0, -1.0])
#: Its product with a quaternion xyzw is (w, -z, y, -x): the components in reverse order, with these signs.
_HALF_TURN_QUAT = np.array([1.0, -1.0, 1.0, -1.0])
_MOMENTS_IN_MILLI = np.array([1.0, 1.0, 1.0, 1e-3, 1e-3, 1e-3])


@dataclass(frozen=True)
class Mistake:
    """A usual mistake: the field, what is wrong with it, what to do, and the function that corrects a log."""

    field: str
    found: str
    advice: str
    corrected: Callable[[Log], Log]


def possible_mistakes(log: Log) -> Iterator[Mistake]:
    """The mistakes that this log could hold."""
    for rates in (_JOINT_RATES, _BASE_RATES):
        given = [field for field in rates if getattr(log, field) is not None]
        if given:
            text, advice = f"{' and '.join(given)} not what positions say", "leave them out: they are derived then"
            yield Mistake(given[-1], text, advice, _without(given))
    yield Mistake("joint_position", "in degrees", "convert to radians", lambda log: _in_degrees(log, slice(None)))
    far = np.flatnonzero(np.abs(log.joint_position).max(axis=0, initial=0.0) > TWO_TURNS)
    if 0 < len(far) < len(log.joint_names):
        some = f"{join_names([log.joint_names[joint] for joint in far])} in degrees"
        yield Mistake("joint_position", some, "convert to radians", lambda log: _in_degrees(log, far))
    yield from _of_orders(log)
    if log.base_quat_xyzw is not None:
        down, up = "in a world whose z axis points down", "turn positions, orientations and vectors so that z points up"
        yield Mistake("base_quat_xyzw", down, up, _flip_world)
        order, rename = "w first against w last is mixed up", "rename base_quat_wxyz and base_quat_xyzw"
        yield Mistake("base_quat_xyzw", order, rename, _quaternions(lambda quat: np.roll(quat, -1, axis=1)))
        yield Mistake("base_quat_xyzw", order, rename, _quaternions(lambda quat: np.roll(quat, 1, axis=1)))
        yield Mistake("base_quat_xyzw", "rotates world to base", "give the inverse", _quaternions(inverse_rotation))
    if log.imu_specific_force is not None:
        reading = "reversed: gravity minus acceleration"
        yield Mistake(
            "imu_specific_force", reading, "reverse it: it points up at rest", _scaled("imu_specific_force", -1.0)
        )
    if log.joint_torque is not None:
        reverse = "reverse them; a base that hangs upside down looks the same (give base_quat)"
        yield Mistake("joint_torque", "all reversed", reverse, _scaled("joint_torque", -1.0))
        yield Mistake("joint_torque", "in mN m", "divide by 1000", _scaled("joint_torque", 1e-3))
        yield Mistake("joint_torque", "in kN m", "multiply by 1000", _scaled("joint_torque", 1e3))
    for field, other in (WRENCHES, WRENCHES[::-1]):
        if getattr(log, field) is not None:
            yield from _of_wrenches(field, other)


def _of_orders(log: Log) -> Iterator[Mistake]:
    """Names of joints and contacts exchanged, flags that belong to other contacts."""
    for what, other in (*exchanged_names(log.joint_names), *_exchanged_neighbours(log.joint_names)):
        text, advice = f"{what} exchanged", "give joint_names in the order of the columns"
        yield Mistake("joint_names", text, advice, _renamed("joint_names", other))
    for what, other in exchanged_names(log.contact_names):
        order = [log.contact_names.index(name) for name in other]
        text = f"{what} exchanged"
        advice = "give contact_names in the order of the columns"
        yield Mistake("contact_names", text, advice, _renamed("contact_names", other))
        flags = _reordered(("contact_active",), order)
        yield Mistake("contact_active", text, "give the flags in the order of contact_names", flags)


def _renamed(field: str, names: tuple[str, ...]) -> Callable[[Log], Log]:
    return _change(lambda _: {field: names})


def _reordered(fields: Sequence[str], order: list[int]) -> Callable[[Log], Log]:
    return _change(lambda log: {field: getattr(log, field)[:, order] for field in fields})


def _flip_world(log: Log) -> Log:
    """The log in a world half a turn about x from the one that it has."""
    fields: dict[str, Any] = {}
    if log.base_quat_xyzw is not None:
        fields["base_quat_xyzw"] = log.base_quat_xyzw[:, ::-1] * _HALF_TURN_QUAT
    for name in _WORLD:
        if (given := getattr(log, name)) is not None:
            fields[name] = given * (_HALF_TURN if given.shape[-1] == 3 else np.tile(_HALF_TURN, 2))
    return dataclasses.replace(log, **fields)


def _of_wrenches(field: str, other: str) -> Iterator[Mistake]:
    reverse = "reverse it: wrenches are what the ground exerts on the robot"
    yield Mistake(field, "all reversed", reverse, _scaled(field, -1.0))
    for unit, factor in (("kN and kN m", 1e3), ("kg", GRAVITY), ("mN and mN m", 1e-3)):
        yield Mistake(field, f"in {unit}", f"multiply by {factor:g}", _scaled(field, factor))
    moments = _change(lambda log: {field: getattr(log, field) * _MOMENTS_IN_MILLI})
    yield Mistake(field, "moments in N mm", "multiply moments by 0.001", moments)
    first = _change(lambda log: {field: np.roll(getattr(log, field), 3, axis=2)})
    yield Mistake(field, "with the moment first", "give the force first, then the moment", first)
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
    return _change(lambda log: {"base_quat_xyzw": make_sign_continuous(change(log.base_quat_xyzw)), **rates})
