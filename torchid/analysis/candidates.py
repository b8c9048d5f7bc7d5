"""Candidate sensors: what could be mounted, how many numbers it reads and what it costs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchid.errors import SensorError, UnknownNameError
from torchid.problem.measured import measured_components
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.sensors import SensorNoise, SensorSet

KINDS = ("joint_torque", "contact")
PER = ("device", "axis", "none")


@dataclass(frozen=True)
class Candidate:
    """A sensor that may be chosen.

    `kind`: one of `KINDS`. `joint`: place among the robot's independent joints, of a torque sensor. `contact`: place
    among the contacts, and `components`: places in `COMPONENTS`, of a force/torque sensor. `name`: the joint; the
    contact's frame for a whole device, "l_sole.fx" for one axis of it.
    """

    name: str
    kind: str
    cost: float
    joint: int | None = None
    contact: int | None = None
    components: tuple[int, ...] = ()

    @property
    def channels(self) -> int:
        """Numbers it reads."""
        return len(self.components) or 1


def total_cost(chosen: Iterable[Candidate]) -> float:
    """Of some candidates together."""
    return sum(candidate.cost for candidate in chosen)


def candidates(
    robot: Robot,
    contacts: Sequence[Contact],
    joint_torques: Sequence[str] | None = None,
    per: str = "device",
    costs: Mapping[str, float] | None = None,
) -> tuple[Candidate, ...]:
    """All candidate sensors: joint torques in the robot's order, then the contacts'.

    Args:
        robot: the robot.
        contacts: where the environment can push; a sensor reads components that its contact can exert.
        joint_torques: joints that can carry a torque sensor; None for all.
        per: "device", one force/torque sensor per contact, "axis", one candidate per component, or "none" at contacts.
        costs: by name of a candidate, or by kind and then per channel; 1 per channel by default.

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
    found = [
        Candidate(name, "joint_torque", 1.0, joint=j) for j, name in enumerate(robot.joint_names) if name in chosen
    ]
    for place, contact in enumerate(contacts):
        if per == "device":
            found.append(Candidate(contact.frame, "contact", 1.0, contact=place, components=tuple(contact.components)))
        elif per == "axis":
            names = zip(contact.component_names, contact.components, strict=True)
            found += [
                Candidate(f"{contact.frame}.{name}", "contact", 1.0, contact=place, components=(k,))
                for name, k in names
            ]
    return _priced(found, costs or {})


def _priced(found: Sequence[Candidate], costs: Mapping[str, float]) -> tuple[Candidate, ...]:
    known = [*KINDS, *(candidate.name for candidate in found)]
    for name, cost in costs.items():
        if name not in known:
            raise UnknownNameError("sensors", "costs", name, known)
        if not (math.isfinite(cost) and cost > 0.0):
            raise SensorError("sensors", f"costs.{name}", str(cost), "a positive number")
    prices = [costs.get(c.name, c.channels * costs.get(c.kind, 1.0)) for c in found]
    return tuple(replace(c, cost=float(price)) for c, price in zip(found, prices, strict=True))


def sensor_set(
    robot: Robot, contacts: Sequence[Contact], chosen: Iterable[Candidate], noise: SensorNoise | None = None
) -> SensorSet:
    """The sensor set that measures what some candidates read, and nothing else."""
    torque, wrench = np.zeros(robot.n, dtype=bool), np.zeros((len(contacts), 6), dtype=bool)
    for candidate in chosen:
        if candidate.joint is not None:
            torque[candidate.joint] = True
        if candidate.contact is not None:
            wrench[candidate.contact, list(candidate.components)] = True
    return SensorSet(torque, wrench, noise or SensorNoise())


def chosen_from(
    contacts: Sequence[Contact], sensors: SensorSet, candidates: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """The candidates that a sensor set contains: those all of whose readings are measured."""
    wrench = measured_components(contacts, sensors)
    return tuple(
        c
        for c in candidates
        if (c.joint is None or sensors.torque[c.joint])
        and (c.contact is None or wrench[c.contact, list(c.components)].all())
    )
