"""Extra parameters of sensors and actuators, their columns, and groups of sensors with equal noise."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchid.logs.columns import fits
from torchid.problem.samples import Samples
from torchid.regressor.tree import KinematicTree
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.sensors import measured_components, recorded_components

CHANNELS = ("joint_torque", "contact_force", "contact_moment", "ft_force", "ft_moment")
"""Kinds of sensor channels, as `SensorNoise` has them."""

SLOPE = "slope"
"""Kind of the unknown of a search: the error of a setting, such as a delay, to first order."""

ScaleGroups = Sequence[Sequence[str]]
"""Groups of sensors with a common scale for all logs: patterns of joint or frame names, see `fits`."""

_UNITS = dict(zip(CHANNELS, ("N m", "N", "N m", "N", "N m"), strict=True))
_SIZES = dict(zip(CHANNELS, (5.0, 50.0, 5.0, 50.0, 5.0), strict=True))
_SCALE_SIZE = 0.1


@dataclass(frozen=True)
class ExtraTerms:
    """Extra parameters that a fit estimates besides the bodies' parameters; none by default.

    Attributes:
        offsets: channels of `CHANNELS` with an unknown offset o: "log" for one value per log, "all" for one value. A
            reading y means the force s y - o.
        scales: the same for unknown scales s. Instead of "log" or "all", groups of sensors: each group has one scale
            for all logs, other sensors have scale 1.
        armature: whether to fit the reflected rotor inertia of every joint with a measured torque.
        torque_offset: whether to fit a constant torque of these joints.
        asymmetric_coulomb: whether to fit half the difference between forward and backward Coulomb friction.
        stribeck: Stribeck velocity v_s [rad/s or m/s]. Fits the static friction beyond Coulomb friction, which acts as
            sign(v) exp(-(v / v_s)^2). Source: Armstrong-Hélouvry, Dupont, Canudas de Wit, "A survey of models, analysis
            tools and compensation methods for the control of machines with friction", 1994, with exponent 2.
        stiffness: whether to fit a joint spring (also cables and hoses). Its rest position follows from
            `torque_offset`.
        sign_width: replaces the sign of a velocity v in dry friction by tanh(v / sign_width) [rad/s or m/s].
        slope: adds the unknown of a search, see `torchid.fitting.profile`; its column is `Samples.slope`.
    """

    offsets: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, str | ScaleGroups] = field(default_factory=dict)
    armature: bool = False
    torque_offset: bool = False
    asymmetric_coulomb: bool = False
    stribeck: float | None = None
    stiffness: bool = False
    sign_width: float | None = None
    slope: bool = False

    __repr__ = short_repr


@dataclass(frozen=True)
class ActuatorTerm:
    """An extra parameter of every joint with a measured torque: it adds value times column to the torque.

    Attributes:
        unit: of the parameter of a revolute joint.
        size: a plausible value.
        words: name in labels.
        column: (B,), of samples at a joint index.
        nonnegative: whether it is physically non-negative.
        needs_motor: whether joints without a motor do not have it.
    """

    unit: str
    size: float
    words: str
    column: Callable[[Samples, KinematicTree, int], Tensor]
    nonnegative: bool = False
    needs_motor: bool = False


def _asymmetry_column(samples: Samples, tree: KinematicTree, dof: int) -> Tensor:
    return tree.coulomb_sign(samples.joint_velocity[:, dof]).abs()


def _stribeck_column(samples: Samples, tree: KinematicTree, dof: int) -> Tensor:
    filtered = samples.stribeck
    return tree.stribeck_share(samples.joint_velocity[:, dof]) if filtered is None else filtered[:, dof]


ACTUATORS = {
    "armature": ActuatorTerm(
        "kg m^2", 0.1, "armature", lambda x, _, dof: x.joint_acceleration[:, dof], nonnegative=True
    ),
    "torque_offset": ActuatorTerm("N m", 5.0, "torque offset", lambda x, *_: torch.ones_like(x.time), needs_motor=True),
    "asymmetric_coulomb": ActuatorTerm("N m", 1.0, "asymmetric Coulomb friction", _asymmetry_column),
    "stribeck": ActuatorTerm("N m", 1.0, "Stribeck friction", _stribeck_column, nonnegative=True),
    "stiffness": ActuatorTerm(
        "N m/rad", 1.0, "stiffness", lambda x, _, dof: x.joint_position[:, dof], nonnegative=True
    ),
}
"""Terms of actuators, each with a field of its name in `ExtraTerms` and in the settings `actuators`.

`torchid.commands.replay` and `torchid.report.robot_files` state which of them they support.
"""


@dataclass(frozen=True)
class Extra:
    """One extra parameter.

    Attributes:
        what: "offset", "scale" (minus 1), one of `ACTUATORS`, or `SLOPE`.
        name: of the joint or sensor frame, or the patterns of a group.
        component: of the wrench, "" for a joint torque, "force" or "moment" for a group of sensors.
        unit: of the parameter.
        size: a plausible value.
        per_log: whether every log has its own value.
        dofs: indices in the robot's `dof_names`; several for a group.
        contacts: or contact index and component, along the axes of the log's wrench.
    """

    what: str
    name: str
    component: str
    unit: str
    size: float
    per_log: bool
    dofs: tuple[int, ...] = ()
    contacts: tuple[tuple[int, int], ...] = ()

    @property
    def dof(self) -> int | None:
        """The first of `dofs` (groups have several), or None."""
        return self.dofs[0] if self.dofs else None

    @property
    def contact(self) -> tuple[int, int] | None:
        """The first of `contacts` (groups have several), or None."""
        return self.contacts[0] if self.contacts else None

    @property
    def nonnegative(self) -> bool:
        """Whether it is physically non-negative."""
        return self.what in ACTUATORS and ACTUATORS[self.what].nonnegative

    @property
    def label(self) -> str:
        """Unique name, such as "offset of l_sole fz", "offset of limb sensor l_ankle fz" or "scale of *_hip,*_knee"."""
        limb = "limb sensor " if self.component and self.dofs else ""  # a link may have its joint's name
        channel = f"{limb}{self.name} {self.component}".strip()
        return f"{in_words(self.what)} of {channel}"


def in_words(what: str) -> str:
    """Plain name of a kind of extra parameter, such as "asymmetric Coulomb friction"."""
    return ACTUATORS[what].words if what in ACTUATORS else what


def list_extras(robot: Robot, contacts: Sequence[Contact], sensors: SensorSet, terms: ExtraTerms) -> tuple[Extra, ...]:
    """All extra parameters of a robot with its sensors; those of sensors come first.

    With wrenches along world axes, offsets are constant along these. All three axes then have an offset if one
    component of the vector is measured.
    """
    extras: list[Extra] = []
    channels = list(_channels(robot, contacts, sensors))
    for what, scopes in (("offset", terms.offsets), ("scale", terms.scales)):
        for channel, name, component, dofs, of_contacts in channels:
            scope = scopes.get(channel)
            if isinstance(scope, str):
                unit, size = (_UNITS[channel], _SIZES[channel]) if what == "offset" else ("1", _SCALE_SIZE)
                extras.append(Extra(what, name, component, unit, size, scope == "log", dofs, of_contacts))
    for kind, groups in terms.scales.items():
        if not isinstance(groups, str):
            extras += _group_scales(kind, groups, [channel for channel in channels if channel.kind == kind])
    for what, term in ACTUATORS.items():
        if getattr(terms, what):
            without = robot.is_passive if term.needs_motor else np.zeros_like(robot.is_passive)
            measured = np.flatnonzero((sensors.torque & ~without)[: robot.n]).tolist()
            extras += [Extra(what, robot.joint_names[dof], "", term.unit, term.size, False, (dof,)) for dof in measured]
    if terms.slope:
        motors = tuple(np.flatnonzero((sensors.torque & ~robot.is_passive)[: robot.n]).tolist())
        extras.append(Extra(SLOPE, "joint torques", "", "1", 1.0, False, motors))
    return tuple(extras)


def _group_scales(kind: str, groups: ScaleGroups, channels: Sequence[Channel]) -> Iterator[Extra]:
    """A scale for each group of channels of one kind that has a measured member."""
    for patterns in groups:
        members = [channel for channel in channels if any(fits(channel.name, pattern) for pattern in patterns)]
        dofs = tuple(dof for channel in members for dof in channel.dofs)
        contacts = tuple(at for channel in members for at in channel.contacts)
        component = "" if kind == "joint_torque" else kind.rpartition("_")[-1]
        if members:
            yield Extra("scale", ",".join(patterns), component, "1", _SCALE_SIZE, False, dofs, contacts)


def measured_channels(robot: Robot, contacts: Sequence[Contact], sensors: SensorSet) -> dict[str, tuple[str, ...]]:
    """Measured kinds of `CHANNELS`, with the names of their joints or frames."""
    channels = list(_channels(robot, contacts, sensors))
    names = {kind: tuple(dict.fromkeys(x.name for x in channels if x.kind == kind)) for kind in CHANNELS}
    return {kind: named for kind, named in names.items() if named}


class Channel(NamedTuple):
    """A measured channel: one of `CHANNELS`, name of joint or frame, component, and its index as in `Extra`."""

    kind: str
    name: str
    component: str
    dofs: tuple[int, ...]
    contacts: tuple[tuple[int, int], ...]


def _channels(robot: Robot, contacts: Sequence[Contact], sensors: SensorSet) -> Iterator[Channel]:
    """Every measured channel."""
    for dof in np.flatnonzero(sensors.torque & ~robot.is_passive).tolist():
        name, _, component = (
            robot.dof_names[dof].rpartition(".") if dof >= robot.n else (robot.joint_names[dof], "", "")
        )
        kind = "joint_torque" if dof < robot.n else "ft_force" if component.startswith("f") else "ft_moment"
        yield Channel(kind, name, component, (dof,), ())
    for index, k in np.argwhere(recorded_components(contacts, sensors, in_world=True)).tolist():
        kind = "contact_force" if k < 3 else "contact_moment"
        yield Channel(kind, contacts[index].frame, contacts[index].component_name(k), (), ((index, k),))


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
        """All groups, in the order of results."""
        of_joints = [f"{_JOINTS}.{name}" for name in self.joints]
        return (*of_joints, "contact_force", "contact_moment", *BASE_GROUPS, "ft_force", "ft_moment")

    def unit(self, group: str) -> str:
        """Unit of a group's standard deviation: "N m" or "N"."""
        key, _, name = group.partition(".")
        return self.joints[name] if key == _JOINTS else "N" if "force" in key else "N m"

    def alike(self, groups: Sequence[str]) -> list[np.ndarray]:
        """Indices of groups whose noise may have the same size, (k,) each: joints with the same unit."""
        units = [self.unit(group) if noise_key(group) == _JOINTS else "" for group in groups]
        return [np.flatnonzero(np.array(units) == unit) for unit in ("N m", "N") if unit in units]

    def sources(self, contacts: Sequence[Contact], sensors: SensorSet, base_rows: int) -> list[str]:
        """Group of every noise source: base rows, measured `dof_names`, contact components."""
        dofs = [*self.names[: len(self.joints)], *_LIMBS * ((len(sensors.torque) - len(self.joints)) // 6)]
        measured = [dofs[dof] for dof in np.flatnonzero(sensors.torque)]
        components = np.argwhere(measured_components(contacts, sensors))[:, 1]
        return [*BASE_GROUPS[:base_rows], *measured, *(_CONTACTS[k] for k in components)]

    def settings(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Values by field of `SensorNoise`, as `sensors.noise` states them; joints by name."""
        return {key: dict(zip(self.joints, x, strict=True)) if key == _JOINTS else x for key, x in fields.items()}

    def values(self, noise: SensorNoise) -> dict[str, float]:
        """Standard deviation of every group [N m, N]."""
        joints = noise.dof_std(len(self.joints), len(self.joints)).tolist()
        sensors = (noise.contact_force, noise.contact_moment)
        return dict(zip(self.names, [*joints, *sensors, *noise.base_std.tolist(), *noise.limb_std], strict=True))

    def noise(self, known: Mapping[str, float], guess: SensorNoise) -> SensorNoise:
        """Sensor noise from standard deviations by group; missing groups are guessed.

        An unknown joint gets the geometric mean of the known joints with the same unit.
        """
        values = {**self.values(guess), **known}
        joints = self.names[: len(self.joints)]
        for index in self.alike(joints):
            known_alike = [known[joints[k]] for k in index if joints[k] in known]
            mean = float(np.exp(np.mean(np.log(known_alike)))) if known_alike else None
            values |= {joints[k]: mean for k in index if mean is not None and joints[k] not in known}
        force, moment = ((values[x], values[y], values[z]) for x, y, z in (BASE_GROUPS[:3], BASE_GROUPS[3:]))
        others = {name: values[name] for name in self.names if "." not in name}
        return SensorNoise(tuple(values[name] for name in joints), **others, base_force=force, base_moment=moment)


# -------------------------------------------------------------------------------------------------- columns in the rows


def dof_extra_column(extra: Extra, dof: int, samples: Samples, tree: KinematicTree) -> Tensor:
    """Column of an extra parameter in the row of one of its degrees of freedom, (B,)."""
    if extra.what == "scale":
        reading = samples.torque
        return samples.time.new_full((len(samples),), torch.nan) if reading is None else -reading[:, dof]
    if extra.what == SLOPE and samples.slope is not None:
        return samples.slope[:, dof]
    if extra.what in ("offset", SLOPE):
        return torch.ones_like(samples.time)
    return ACTUATORS[extra.what].column(samples, tree, dof)


def contact_extra_column(extra: Extra, samples: Samples, contact: int, axis: int) -> Tensor:
    """Column of a contact sensor's extra parameter, subtracted from its reading along a recorded axis, (B,)."""
    if extra.what == "offset":
        return samples.active[:, contact].to(samples.time) if samples.share is None else samples.share[:, contact]
    reading = samples.wrench
    return samples.time.new_full((len(samples),), torch.nan) if reading is None else -reading[:, contact, axis]


class KnownTorques:
    """Torques of known armatures and springs: `armature * acceleration + stiffness * position + constant`.

    They are those of an MJCF file. An armature or stiffness that is an extra parameter replaces the file's value.
    """

    def __init__(self, robot: Robot, extras: Sequence[Extra]) -> None:
        """Known values of a robot, without `extras`."""
        fitted = {what: [dof for x in extras if x.what == what for dof in x.dofs] for what in ("armature", "stiffness")}
        self._armature = robot.armature.copy()
        self._stiffness = robot.stiffness.copy()
        self._armature[fitted["armature"]] = self._stiffness[fitted["stiffness"]] = 0.0
        self._constant = robot.spring_torque
        self._others = robot.n_dofs - robot.n
        self.none = not np.any([self._armature, self._stiffness, self._constant])

    def of(self, samples: Samples) -> Tensor:
        """Torques of samples, (B, n + 6 F) [N m or N], 0 at force/torque sensors."""
        armature, stiffness, constant = (
            samples.time.new_tensor(x) for x in (self._armature, self._stiffness, self._constant)
        )
        known = armature * samples.joint_acceleration + stiffness * samples.joint_position + constant
        return known if not self._others else pad(known, (0, self._others))
