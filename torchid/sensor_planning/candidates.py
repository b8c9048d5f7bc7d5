"""Candidate sensors: what could be mounted, how many numbers it reads and what it costs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.errors import SensorError, UnknownNameError
from torchid.problem.extras import measured_components
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

KINDS = ("joint_torque", "contact", "ft_sensor")
PER = ("device", "axis", "none")


@dataclass(frozen=True)
class Candidate:
    """A sensor that may be chosen.

    `kind`: one of `KINDS`. `dofs`: places among the robot's `dof_names` that a torque sensor, or a force/torque sensor
    in a limb, reads. `contact`: index among the contacts, and `components`, in `WRENCH_COMPONENTS`, of a force/torque
    sensor there. `name`: the joint; the contact's frame for a whole device, "l_sole.fx" for one axis of it.
    """

    name: str
    kind: str
    cost: float
    dofs: tuple[int, ...] = ()
    contact: int | None = None
    components: tuple[int, ...] = ()

    @property
    def channels(self) -> int:
        """Numbers it reads."""
        return len(self.components) + len(self.dofs)


def total_cost(chosen: Iterable[Candidate]) -> float:
    """Of some candidates together."""
    return sum(candidate.cost for candidate in chosen)


def candidates(
    robot: Robot,
    contacts: Sequence[Contact],
    joint_torques: Sequence[str] | None = None,
    per: str = "device",
    costs: Mapping[str, float] | None = None,
    ft_sensors: Sequence[str] = (),
) -> tuple[Candidate, ...]:
    """All candidate sensors: joint torques in the robot's order, then the contacts', then those in limbs.

    Args:
        robot: the robot.
        contacts: where the environment can push; a sensor reads components that its contact can exert.
        joint_torques: joints that can carry a torque sensor; None for all.
        per: "device", one force/torque sensor per contact, "axis", one candidate per component, or "none" at contacts.
            In limbs, too, a candidate per component with "axis".
        costs: by name of a candidate, or by kind and then per channel; 1 per channel by default.
        ft_sensors: fixed joints that can carry a force/torque sensor, among those that the robot was loaded with.

    Raises:
        UnknownNameError: a joint, or a name in `costs`, that does not exist.
        SensorError: `per` is another word, or a cost is not a positive number.
    """
    if per not in PER:
        raise SensorError("sensors", "candidates.per", f"'{per}'", ", ".join(PER))
    chosen = robot.joint_names if joint_torques is None else joint_torques
    for name in chosen:
        if name not in robot.joint_names:
            raise UnknownNameError("sensors", "candidates.joint_torques", name, robot.joint_names)
    offered = [
        Candidate(name, "joint_torque", 1.0, dofs=(j,)) for j, name in enumerate(robot.joint_names) if name in chosen
    ]
    for place, contact in enumerate(contacts):
        if per == "device":
            components = tuple(contact.components)
            offered.append(Candidate(contact.frame, "contact", 1.0, contact=place, components=components))
        elif per == "axis":
            names = zip(contact.component_names, contact.components, strict=True)
            offered += [
                Candidate(f"{contact.frame}.{name}", "contact", 1.0, contact=place, components=(k,))
                for name, k in names
            ]
    return _priced([*offered, *_in_limbs(robot, ft_sensors, per == "axis")], costs or {})


def _in_limbs(robot: Robot, names: Sequence[str], by_axis: bool) -> list[Candidate]:
    """Force/torque sensors at fixed joints, as devices or axis by axis."""
    offered = []
    for name in names:
        if name not in robot.ft_names:
            raise UnknownNameError("sensors", "candidates.ft_sensors", name, robot.ft_names)
        first = robot.n + 6 * robot.ft_names.index(name)
        if by_axis:
            offered += [Candidate(robot.dof_names[k], "ft_sensor", 1.0, dofs=(k,)) for k in range(first, first + 6)]
        else:
            offered.append(Candidate(name, "ft_sensor", 1.0, dofs=tuple(range(first, first + 6))))
    return offered


def _priced(offered: Sequence[Candidate], costs: Mapping[str, float]) -> tuple[Candidate, ...]:
    known = [*KINDS, *(candidate.name for candidate in offered)]
    for name, cost in costs.items():
        if name not in known:
            raise UnknownNameError("sensors", "costs", name, known)
        if not (math.isfinite(cost) and cost > 0.0):
            raise SensorError("sensors", f"costs.{name}", str(cost), "a positive number")
    prices = [costs.get(c.name, c.channels * costs.get(c.kind, 1.0)) for c in offered]
    return tuple(replace(c, cost=float(price)) for c, price in zip(offered, prices, strict=True))


def sensor_set(
    robot: Robot, contacts: Sequence[Contact], chosen: Iterable[Candidate], noise: SensorNoise | None = None
) -> SensorSet:
    """The sensor set that measures what some candidates read, and nothing else."""
    torque, wrench = np.zeros(robot.n_dofs, dtype=bool), np.zeros((len(contacts), 6), dtype=bool)
    for candidate in chosen:
        torque[list(candidate.dofs)] = True
        if candidate.contact is not None:
            wrench[candidate.contact, list(candidate.components)] = True
    return SensorSet(torque, wrench, noise or SensorNoise())


def contained_candidates(
    contacts: Sequence[Contact], sensors: SensorSet, candidates: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """The candidates that a sensor set contains: those all of whose readings are measured."""
    wrench = measured_components(contacts, sensors)
    return tuple(
        c
        for c in candidates
        if sensors.torque[list(c.dofs)].all() and (c.contact is None or wrench[c.contact, list(c.components)].all())
    )
