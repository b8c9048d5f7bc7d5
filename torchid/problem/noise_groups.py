"""Groups of readings and base rows whose noise has one standard deviation each: a joint's torque is one of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.sensors import measured_components

BASE_GROUPS = tuple(f"base_{kind}.{axis}" for kind in ("force", "moment") for axis in "xyz")
"""Base rows along the axes of the levelled base."""
_JOINTS = "joint_torque"
_LIMBS = ("ft_force",) * 3 + ("ft_moment",) * 3
_CONTACTS = ("contact_force",) * 3 + ("contact_moment",) * 3


def noise_key(group: str) -> str:
    """The key of `sensors.noise` that states the noise of a group: "joint_torque" of "joint_torque.l_knee"."""
    return group.partition(".")[0]


@dataclass(frozen=True)
class NoiseGroups:
    """The groups of a robot: "joint_torque.l_knee", "base_force.x", "contact_moment".

    `joints`: the units of the independent joints' forces by name, "N m" or "N", in the robot's order.
    """

    joints: Mapping[str, str]

    @classmethod
    def of(cls, robot: Robot) -> NoiseGroups:
        """The groups of a robot."""
        return cls({name: "N" if name in robot.sliding else "N m" for name in robot.joint_names})

    @property
    def names(self) -> tuple[str, ...]:
        """All groups, in the order that results have them in."""
        of_joints = [f"{_JOINTS}.{name}" for name in self.joints]
        return (*of_joints, "contact_force", "contact_moment", *BASE_GROUPS, "ft_force", "ft_moment")

    def unit(self, group: str) -> str:
        """Unit of a group's standard deviation: "N m" or "N"."""
        key, _, name = group.partition(".")
        return self.joints[name] if key == _JOINTS else "N" if "force" in key else "N m"

    def alike(self, groups: Sequence[str]) -> list[np.ndarray]:
        """Indices of groups whose noise may be of one size, (k,) each: joints whose forces have one unit."""
        units = [self.unit(group) if noise_key(group) == _JOINTS else "" for group in groups]
        return [np.flatnonzero(np.array(units) == unit) for unit in ("N m", "N") if unit in units]

    def sources(self, contacts: Sequence[Contact], sensors: SensorSet, base_rows: int) -> list[str]:
        """The group of every source of noise: base rows, what is measured of `dof_names`, components of contacts."""
        dofs = [*self.names[: len(self.joints)], *_LIMBS * ((len(sensors.torque) - len(self.joints)) // 6)]
        measured = [dofs[dof] for dof in np.flatnonzero(sensors.torque)]
        components = np.argwhere(measured_components(contacts, sensors))[:, 1]
        return [*BASE_GROUPS[:base_rows], *measured, *(_CONTACTS[k] for k in components)]

    def settings(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Fields of `SensorNoise` as `sensors.noise` states them, those of joints by their names."""
        return {key: dict(zip(self.joints, x, strict=True)) if key == _JOINTS else x for key, x in fields.items()}

    def values(self, noise: SensorNoise) -> dict[str, float]:
        """Standard deviation of every group [N m, N]."""
        joints = noise.dof_std(len(self.joints), len(self.joints)).tolist()
        sensors = (noise.contact_force, noise.contact_moment)
        return dict(zip(self.names, [*joints, *sensors, *noise.base_std.tolist(), *noise.limb_std], strict=True))

    def noise(self, known: Mapping[str, float], guess: SensorNoise) -> SensorNoise:
        """Sensor noise from standard deviations by group; others are guessed.

        A joint of which nothing is known has the geometric mean of those that are known and have its unit.
        """
        values = {**self.values(guess), **known}
        joints = self.names[: len(self.joints)]
        for index in self.alike(joints):
            own = [known[joints[k]] for k in index if joints[k] in known]
            mean = float(np.exp(np.mean(np.log(own)))) if own else None
            values |= {joints[k]: mean for k in index if mean is not None and joints[k] not in known}
        force, moment = ((values[x], values[y], values[z]) for x, y, z in (BASE_GROUPS[:3], BASE_GROUPS[3:]))
        others = {name: values[name] for name in self.names if "." not in name}
        return SensorNoise(tuple(values[name] for name in joints), **others, base_force=force, base_moment=moment)
