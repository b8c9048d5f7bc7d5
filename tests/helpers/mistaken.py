"""Mistakes of sign, frame, unit and order in logs, and a table of those that `check` names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from motions import value
from scipy.spatial.transform import Rotation
from synthetic import Array, Oracle
from walking import Machine, Truth, recorded, robot_of, specific_force, truth

from torchid.log_checks import NOTE, Checked
from torchid.log_checks.check import check
from torchid.logs import Log
from torchid.logs.quaternion import make_sign_continuous

SENSORS = ("full", "contacts", "joints")
CUTOFF = 10.0
NAMED, SEEN, SILENT, ABSENT = "named", "seen", "silent", "-"


@dataclass(frozen=True)
class Case:
    """A log of a machine that walks, with what happened."""

    machine: Machine
    happened: Truth
    log: Log


@dataclass(frozen=True)
class Mistake:
    """A mistake: what makes a log of it, None where the log has nothing to be mistaken, and how `check` may name it.

    `field`: of the finding; `words`: pattern that its name and text must match.
    """

    name: str
    make: Callable[[Case], Log | None]
    field: str
    words: str

    def named(self, checked: Checked) -> bool:
        """Whether a finding that is more than a note names the mistake."""
        return any(
            one.severity != NOTE
            and re.search(self.field, one.field)
            and re.search(self.words, f"{one.name}: {one.found}; {one.advice}")
            for one in checked.findings
        )


def _scaled(field: str, factor: float) -> Callable[[Case], Log | None]:
    def make(case: Case) -> Log | None:
        given = getattr(case.log, field)
        return None if given is None else replace(case.log, **{field: factor * given})

    return make


def _one_torque(factor: float) -> Callable[[Case], Log | None]:
    def make(case: Case) -> Log | None:
        if case.log.joint_torque is None:
            return None
        torque = case.log.joint_torque.copy()
        torque[:, loaded_joint(case.machine)] *= factor
        return replace(case.log, joint_torque=torque)

    return make


def loaded_joint(machine: Machine) -> int:
    """A joint that carries: a knee, or the second joint of an arm."""
    names = robot_of(machine).joint_names
    return next((i for i, name in enumerate(names) if "knee" in name), 1)


def _world_downward(case: Case) -> Log | None:
    """North, east, down: the world half a turn about x."""
    log = case.log
    if log.base_quat_xyzw is None:
        return None
    turn = Rotation.from_euler("x", np.pi)
    fields: dict[str, Any] = {"base_quat_xyzw": (turn * Rotation.from_quat(log.base_quat_xyzw)).as_quat()}
    if log.base_position_world is not None:
        fields["base_position_world"] = turn.apply(log.base_position_world)
    return replace(log, **fields)


def _quaternion(change: Callable[[Array], Array]) -> Callable[[Case], Log | None]:
    def make(case: Case) -> Log | None:
        quat = case.log.base_quat_xyzw
        return None if quat is None else replace(case.log, base_quat_xyzw=make_sign_continuous(change(quat)))

    return make


def _time(factor: float) -> Callable[[Case], Log | None]:
    return lambda case: replace(case.log, time=factor * case.log.time)


def _swapped(names: Sequence[str]) -> list[int]:
    """Places of the other side's names."""
    sides = (("left", "right"), ("l_", "r_"))

    def other(name: str) -> str:
        for left, right in sides:
            for one, two in ((left, right), (right, left)):
                if one in name.split("_")[0] + "_" or f"_{one}_" in name:
                    return name.replace(one, two, 1)
        return name

    return [list(names).index(other(name)) for name in names]


def _flags(case: Case) -> Log | None:
    active = case.log.contact_active
    return None if active is None else replace(case.log, contact_active=active[:, _swapped(case.log.contact_names)])


def _feet(case: Case) -> Log | None:
    log = case.log
    if log.contact_wrench_local is None or log.contact_active is None:
        return None
    order = _swapped(log.contact_names)
    wrench, active = log.contact_wrench_local[:, order], log.contact_active[:, order]
    return replace(log, contact_wrench_local=wrench, contact_active=active)


def _joints(case: Case) -> Log | None:
    """Left for right; of an arm, which has no sides, two neighbours."""
    names = case.log.joint_names
    order = [0, 2, 1, *range(3, len(names))] if case.machine.bolted else _swapped(names)
    return replace(case.log, joint_names=tuple(names[place] for place in order))


def _limbs(case: Case) -> Log | None:
    """Torques of limbs exchanged, of positions that are right: front for rear, or left for right of two legs."""
    torque, names = case.log.joint_torque, list(case.log.joint_names)
    if torque is None or case.machine.bolted:
        return None
    ends = {"front": "rear", "rear": "front"}
    other = [re.sub("^(front|rear)", lambda end: ends[end[0]], name) for name in names]
    order = _swapped(names) if other == names else [names.index(name) for name in other]
    return replace(case.log, joint_torque=torque[:, order])


def _rates(case: Case) -> Log | None:
    velocity = case.happened.v[:, 0 if case.machine.bolted else 6 :]
    noise = 1e-2 * np.random.default_rng(3).normal(size=velocity.shape)
    return replace(case.log, joint_velocity=np.degrees(velocity + noise))


def _axes(case: Case) -> Log | None:
    """Along the feet's axes, called the world's."""
    wrench = case.log.contact_wrench_local
    return None if wrench is None else replace(case.log, contact_wrench_local=None, contact_wrench_world=wrench)


def _in_world(case: Case) -> Log | None:
    """Along the world's axes, called the feet's."""
    if case.log.contact_wrench_local is None:
        return None
    wrench, oracle = case.log.contact_wrench_local.copy(), Oracle.of(robot_of(case.machine))
    for k, foot in enumerate(case.machine.feet):
        R = oracle.pose(case.happened.q, foot)[0]
        wrench[:, k] = (wrench[:, k].reshape(-1, 2, 3) @ R.transpose(0, 2, 1)).reshape(-1, 6)
    return replace(case.log, contact_wrench_local=wrench)


def _base_velocity(case: Case) -> Log | None:
    """The base's linear velocity in its own axes, called the world's, in place of its position."""
    if case.log.base_position_world is None:
        return None
    linear = case.happened.v[:, :3] + 2e-3 * np.random.default_rng(3).normal(size=(len(case.log), 3))
    return replace(case.log, base_linear_velocity_world=linear)


def _gravity(case: Case) -> Log | None:
    """Of the base's acceleration, what an accelerometer reads, turned to the world."""
    if case.log.base_position_world is None:
        return None
    turned = Rotation.from_quat(value(case.log.base_quat_xyzw)).apply(specific_force(case.happened))
    noise = 0.02 * np.random.default_rng(3).normal(size=turned.shape)
    return replace(case.log, base_linear_acceleration_world=turned + noise)


def _imu(case: Case) -> Log | None:
    """Gravity minus acceleration, in place of acceleration minus gravity."""
    force = case.log.imu_specific_force
    return None if force is None else replace(case.log, imu_specific_force=-force)


def _with_gravity(share: float) -> Callable[[Case], Log | None]:
    """An accelerometer to whose reading a driver has added a share of gravity, by the orientation that it knows."""

    def make(case: Case) -> Log | None:
        force = case.log.imu_specific_force
        if force is None:
            return None
        up = Rotation.from_quat(value(case.log.base_quat_xyzw)).inv().apply([0.0, 0.0, 9.81])
        return replace(case.log, imu_specific_force=force + share * up)

    return make


def _imu_in_world(case: Case) -> Log | None:
    """What an accelerometer reads, turned to the world's axes."""
    force = case.log.imu_specific_force
    turned = None if force is None else Rotation.from_quat(value(case.log.base_quat_xyzw)).apply(force)
    return None if turned is None else replace(case.log, imu_specific_force=turned)


def _moments(case: Case) -> Log | None:
    """Moments that the robot exerts on the ground beside forces that the ground exerts."""
    wrench = case.log.contact_wrench_local
    if wrench is None or case.machine.kind == "point":
        return None
    return replace(case.log, contact_wrench_local=wrench * [1.0, 1.0, 1.0, -1.0, -1.0, -1.0])


def _elsewhere(case: Case) -> Log | None:
    """Moments about a point 0.1 m above the contact frame's origin, as a sensor in the ankle gives them."""
    wrench = case.log.contact_wrench_local
    if wrench is None or case.machine.kind == "point":
        return None
    moved = wrench.copy()
    moved[..., 3:] -= np.cross([0.0, 0.0, 0.1], wrench[..., :3])
    return replace(case.log, contact_wrench_local=moved)


def _moment_first(case: Case) -> Log | None:
    wrench = case.log.contact_wrench_local
    if wrench is None or case.machine.kind == "point":
        return None
    return replace(case.log, contact_wrench_local=np.roll(wrench, 3, axis=2))


MISTAKES = (
    Mistake("torques reversed", _scaled("joint_torque", -1.0), "joint_torque", "reversed"),
    Mistake("one torque reversed", _one_torque(-1.0), "joint_torque", "reversed"),
    Mistake("one torque x 1.3", _one_torque(1.3), "joint_torque", "scale"),
    Mistake("torques of limbs exchanged", _limbs, "joint_torque", "exchanged"),
    Mistake("torques in N mm", _scaled("joint_torque", 1e3), "joint_torque", "mNm"),
    Mistake("wrenches reversed", _scaled("contact_wrench_local", -1.0), "contact_wrench", "revers"),
    Mistake("wrenches in kg", _scaled("contact_wrench_local", 1.0 / 9.81), "contact_wrench", "kg"),
    Mistake("wrenches local for world", _axes, "contact_wrench", "axes"),
    Mistake("wrenches world for local", _in_world, "contact_wrench", "axes"),
    Mistake("wrenches about another point", _elsewhere, "contact_wrench", "point"),
    Mistake("wrenches moment first", _moment_first, "contact_wrench", "moment.* first"),
    Mistake("moments reversed", _moments, "contact_wrench", "moments reversed"),
    Mistake("contact flags left for right", _flags, "contact_", "exchanged|force without contact"),
    Mistake("feet left for right", _feet, "contact_", "exchanged"),
    Mistake("joints swapped", _joints, "joint_names", "exchanged"),
    Mistake("positions in degrees", _scaled("joint_position", 180.0 / np.pi), "joint_position", "degrees"),
    Mistake("velocities in deg/s", _rates, "joint_velocity", "in deg/s"),
    Mistake("world downward", _world_downward, "base_quat", "down"),
    Mistake("quaternion w first for last", _quaternion(lambda q: np.roll(q, 1, axis=1)), "base_quat", "w first"),
    Mistake("quaternion w last for first", _quaternion(lambda q: np.roll(q, -1, axis=1)), "base_quat", "w first"),
    Mistake("quaternion inverse", _quaternion(lambda q: q * [-1, -1, -1, 1]), "base_quat", "world to base"),
    Mistake("time x 2", _time(2.0), "time", "unit"),
    Mistake("time in minutes", _time(1.0 / 60.0), "time|velocity", "in min"),
    Mistake("base velocity base for world", _base_velocity, "base_linear_velocity", "frame"),
    Mistake("acceleration with gravity", _gravity, "base_linear_acceleration", "gravity"),
    Mistake("accelerometer reversed", _imu, "imu_specific_force", "revers"),
    Mistake("accelerometer with gravity twice", _with_gravity(1.0), "imu_specific_force", "twice gravity"),
    Mistake("accelerometer without gravity", _with_gravity(-1.0), "imu_specific_force", "gravity was removed"),
    Mistake("accelerometer along the world's axes", _imu_in_world, "imu_specific_force", "along the world's axes"),
)


def case_of(machine: Machine, sensors: str, seed: int = 0, heading: float | None = None) -> Case:
    """A clean log; of an arm, the sensor sets are with its velocities, without, and with three of its torques."""
    happened = truth(machine, seed, heading)
    log = recorded(machine, happened, sensors, seed)
    if machine.bolted and sensors == "full":
        log = replace(log, joint_velocity=happened.v + 1e-2 * np.random.default_rng(4).normal(size=happened.v.shape))
    if machine.bolted and sensors == "joints":
        torque = value(log.joint_torque).copy()
        torque[:, [0, 2, *range(4, torque.shape[1])]] = np.nan
        log = replace(log, joint_torque=torque)
    return Case(machine, happened, log)


def checked(case: Case, log: Log) -> Checked:
    """What `check` says."""
    return check(log, robot_of(case.machine), case.machine.contacts, CUTOFF)


def judged(mistake: Mistake, found: Checked, clean: Checked) -> str:
    """Whether a mistake was named, something that the clean log is free of was found, or nothing was."""
    if mistake.named(found):
        return NAMED
    known = {(one.name, one.field) for one in clean.findings}
    new = [one for one in found.findings if one.severity != NOTE and (one.name, one.field) not in known]
    return SEEN if new else SILENT


@dataclass(frozen=True)
class Cell:
    """One mistake in one log."""

    mistake: str
    machine: str
    sensors: str
    check: str


def cells(machines: Iterable[Machine]) -> Iterator[Cell]:
    """All cells of the table."""
    for machine in machines:
        for which in SENSORS:
            case = case_of(machine, which)
            clean = checked(case, case.log)
            for mistake in MISTAKES:
                log = mistake.make(case)
                said = ABSENT if log is None else judged(mistake, checked(case, log), clean)
                yield Cell(mistake.name, machine.name, which, said)


__all__ = ["MISTAKES", "Case", "Cell", "Mistake", "cells"]
