"""Contacts with the environment, and sensor sets: masks over joint torques and contact-wrench components."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchid.errors import SensorError, UnknownNameError, join_names
from torchid.parameters import WRENCH_COMPONENTS, Array
from torchid.reprs import short_repr
from torchid.robot import Robot

_FORCES = (0, 1, 2)
_MOMENTS = (3, 4, 5)
CONTACT_TYPES = ("point", "line", "flat")
NORMAL_FORCE = "fn"
"""Name of the component that a scalar sensor of a contact reads."""
NORMAL_INDEX = 2
"""Index of that component."""


UP = (0.0, 0.0, 1.0)


def join_numbers(numbers: Iterable[float]) -> str:
    """Numbers as a list of a settings file."""
    return f"[{', '.join(f'{x:g}' for x in numbers)}]"


@dataclass(frozen=True)
class Contact:
    """A contact at a link frame.

    Attributes:
        frame: name of a link.
        kind: "point" transmits three force components, "flat" all six wrench components, "line" all except the moment
            about the line.
        line_axis: axis of the frame along the line: "x", "y" or "z".
        radius: [m]. A point with a radius is a sphere about c that rolls on the ground; a line is a cylinder about
            `line_axis`. The ground acts at c - radius n (for a cylinder with n perpendicular to the axis). Readings are
            wrenches at c. On a cylinder, the force along the axis counts as acting at c.
        normal: n, (3,), unit vector in the world that points away from the ground.
        along_normal: whether the contact has a scalar sensor "fn" that measures the force along `normal` only. The
            force components then refer to the ground: fz along the normal, fx and fy across it.
        centre: c, (3,) [m], in the frame, for a sphere whose centre is not the frame's origin.
    """

    frame: str
    kind: str
    line_axis: str = "y"
    radius: float = 0.0
    normal: tuple[float, float, float] = UP
    along_normal: bool = False
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the values and normalize the normal.

        Raises:
            SensorError: `kind` or `line_axis` is unknown, `radius` is negative or set for a flat contact, `centre` is
                set for a line or flat contact, or `normal` has length 0.
        """
        if self.kind not in CONTACT_TYPES:
            raise SensorError(f"contact '{self.frame}'", "type", f"'{self.kind}'", ", ".join(CONTACT_TYPES))
        if self.line_axis not in ("x", "y", "z"):
            raise SensorError(f"contact '{self.frame}'", "line_axis", f"'{self.line_axis}'", "x, y, z")
        if not 0.0 <= self.radius < np.inf:
            raise SensorError(f"contact '{self.frame}'", "radius", f"{self.radius:g}", "a number of at least 0 [m]")
        if self.radius and self.kind == "flat":
            accepted = "type point (a sphere) or line (a cylinder), or radius 0"
            raise SensorError(f"contact '{self.frame}'", "radius", f"{self.radius:g} for a flat contact", accepted)
        if len(self.centre) != 3 or not np.isfinite(self.centre).all() or self.kind != "point" and any(self.centre):
            accepted = "three numbers [m] in the contact's frame, for a point contact"
            raise SensorError(f"contact '{self.frame}'", "centre", join_numbers(self.centre), accepted)
        length = float(np.linalg.norm(self.normal))
        if len(self.normal) != 3 or not 0.0 < length < np.inf:
            accepted = "three numbers in the world, not all 0"
            raise SensorError(f"contact '{self.frame}'", "normal", join_numbers(self.normal), accepted)
        if length != 1.0:
            x, y, z = (float(component) / length for component in self.normal)
            object.__setattr__(self, "normal", (x, y, z))

    @property
    def components(self) -> tuple[int, ...]:
        """Indices in `WRENCH_COMPONENTS` of the components that the contact can transmit."""
        if self.kind == "point":
            return _FORCES
        if self.kind == "flat":
            return _FORCES + _MOMENTS
        return _FORCES + tuple(m for m in _MOMENTS if m != _MOMENTS["xyz".index(self.line_axis)])

    @property
    def rolling_axis(self) -> str | None:
        """Axis of the frame about which a line contact rolls; None for a point contact."""
        return self.line_axis if self.kind == "line" else None

    def pose(self, frame_pose: Array) -> Array:
        """Poses (..., 4, 4) of the frame with its origin at the contact's centre."""
        moved = frame_pose.copy()
        moved[..., :3, 3] += moved[..., :3, :3] @ np.array(self.centre)
        return moved

    def component_name(self, k: int) -> str:
        """Name of the measured component k, an index in `WRENCH_COMPONENTS`."""
        return NORMAL_FORCE if self.along_normal and k == NORMAL_INDEX else WRENCH_COMPONENTS[k]

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of `components`."""
        return tuple(WRENCH_COMPONENTS[k] for k in self.components)


def validate_contacts(robot: Robot, contacts: Sequence[Contact]) -> tuple[Contact, ...]:
    """Check contacts against a robot, and return them.

    Raises:
        UnknownNameError: the robot has no such frame.
        SensorError: a frame is named twice.
    """
    seen: set[str] = set()
    for index, contact in enumerate(contacts):
        field = f"contacts[{index}]"
        robot.link(contact.frame, f"{field}.frame")
        if contact.frame in seen:
            raise SensorError.at_field(f"{field}.frame", f"'{contact.frame}' named twice", "each frame once")
        seen.add(contact.frame)
    return tuple(contacts)


NAMED_SETS = ("full", "contacts", "joints")


PerAxis = float | tuple[float, float, float]
"""One number for three axes, or one for each."""

PerJoint = float | tuple[float, ...]
"""One number for all joints, or one for each in the robot's order."""


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of the sensor noise [N, N m]. The defaults are rough guesses.

    Attributes:
        joint_torque: one number for all joints, or one per joint [N m; N for a prismatic joint].
        contact_force, contact_moment: of contact sensors [N, N m].
        base_force, base_moment: of the base rows, for errors that no force sensor makes (differentiated motion, soft
            contacts). Without them, base rows in flight would count as exact. One number, or three for the x, y, z axes
            of the levelled base (`torchid.problem.motion.levelled_base_axes`). None for the noise of a contact sensor.
        ft_force, ft_moment: of limb force/torque sensors [N, N m]; None for the noise of a contact sensor.
    """

    joint_torque: PerJoint = 0.5
    contact_force: float = 2.0
    contact_moment: float = 0.2
    base_force: PerAxis | None = None
    base_moment: PerAxis | None = None
    ft_force: float | None = None
    ft_moment: float | None = None

    @classmethod
    def of_known(cls, known: Mapping[str, Any]) -> SensorNoise:
        """Sensor noise from known values by field; unknown values are NaN."""
        return cls(**dict.fromkeys(("joint_torque", "contact_force", "contact_moment"), np.nan) | dict(known))

    @property
    def base_std(self) -> Array:
        """Standard deviations of the six base rows along the levelled base's axes, (6,) [N, N m]."""
        force = self.contact_force if self.base_force is None else self.base_force
        moment = self.contact_moment if self.base_moment is None else self.base_moment
        return np.concatenate([np.broadcast_to(np.asarray(x, dtype=float), 3) for x in (force, moment)])

    @property
    def base_axes_differ(self) -> bool:
        """Whether the standard deviations of the base rows differ between axes."""
        return bool(np.ptp(self.base_std.reshape(2, 3), axis=1).any())

    @property
    def limb_std(self) -> tuple[float, float]:
        """Standard deviations of force and moment of a limb force/torque sensor [N, N m]."""
        force = self.contact_force if self.ft_force is None else self.ft_force
        moment = self.contact_moment if self.ft_moment is None else self.ft_moment
        return force, moment

    def dof_std(self, n: int, count: int) -> Array:
        """Standard deviations, (count,) [N m, N, N m], in the order of `Robot.dof_names`: joint torques, limb wrenches.

        Raises:
            SensorError: `joint_torque` has neither one number nor n numbers.
        """
        joints = np.asarray(self.joint_torque, dtype=float)
        if joints.shape not in ((), (n,)):
            raise SensorError("noise", "joint_torque", f"{joints.size} numbers", f"1 number for all joints, or {n}")
        return np.append(np.broadcast_to(joints, n), np.tile(np.repeat(self.limb_std, 3), (count - n) // 6))

    def scaled(self, factor: float) -> SensorNoise:
        """Multiply all standard deviations by a factor."""
        scaled: dict[str, Any] = {
            name: tuple(factor * number for number in x) if isinstance(x, tuple) else factor * x
            for name, x in vars(self).items()
            if x is not None
        }
        return SensorNoise(**scaled)

    @property
    def wrench_std(self) -> Array:
        """Standard deviations of the six components of a contact wrench, (6,) [N, N m]."""
        return np.array([self.contact_force] * 3 + [self.contact_moment] * 3)


@dataclass(frozen=True)
class SensorSet:
    """A sensor set: which forces are measured, and their noise.

    Attributes:
        torque: (n + 6 F,) bool, in the order of the robot's `dof_names`: joint torques, then limb sensor wrenches.
        wrench: (C, 6) bool, by contact and `WRENCH_COMPONENTS`.
        noise: standard deviations.
        task_weights: (n_rows,) > 0, additional weights of the errors of the generalized forces (base rows first, along
            the axes of the base); None for equal weights.
    """

    torque: np.ndarray
    wrench: np.ndarray
    noise: SensorNoise = field(default_factory=SensorNoise)
    task_weights: Array | None = None

    __repr__ = short_repr

    def _headline(self) -> str:
        wrenches = f"{int(self.wrench.sum())} contact components"
        return f"{int(self.torque.sum())} joint torques and limb sensor components, {wrenches}"


def named_sensors(name: str, n: int, contacts: int, noise: SensorNoise | None = None, ft: int = 0) -> SensorSet:
    """Return a named sensor set: "full", "contacts" or "joints".

    Args:
        name: "full" measures all joint torques and contact wrenches, "contacts" or "joints" only one of the two.
        n: number of independent joints.
        contacts: number of contacts.
        noise: of the sensors.
        ft: number of the robot's limb force/torque sensors; none of them is in the set.

    Raises:
        SensorError: the name is another one.
    """
    if name not in NAMED_SETS:
        raise SensorError("sensors", "name", f"'{name}'", f"{', '.join(NAMED_SETS)}, or a mapping of sensors")
    torque = name in ("full", "joints")
    wrench = name in ("full", "contacts")
    torques = np.append(np.full(n, torque), np.zeros(6 * ft, dtype=bool))
    return SensorSet(torques, np.full((contacts, 6), wrench), noise or SensorNoise())


def with_ft_sensors(sensors: SensorSet, robot: Robot, names: Iterable[str]) -> SensorSet:
    """Add limb force/torque sensors to a sensor set, by the names of their fixed joints.

    Raises:
        UnknownNameError: the robot was not loaded with this sensor.
    """
    torque = sensors.torque.copy()
    for name in names:
        if name not in robot.ft_names:
            raise UnknownNameError.at_field("sensors.ft_sensors", name, robot.ft_names)
        first = robot.n + 6 * robot.ft_names.index(name)
        torque[first : first + 6] = True
    return replace(sensors, torque=torque)


def chosen_sensors(
    joint_names: Sequence[str],
    contacts: Sequence[Contact],
    joint_torques: Iterable[str],
    contact_wrenches: Mapping[str, Iterable[str]],
    noise: SensorNoise | None = None,
    ft: int = 0,
) -> SensorSet:
    """Make a sensor set from names of joints and components of contact wrenches.

    Args:
        joint_names: the robot's independent joints.
        contacts: the contacts.
        joint_torques: joints with a measured torque.
        contact_wrenches: measured components ("fx" ... "mz") by contact frame; "fn" for a contact with `along_normal`.
        noise: of the sensors.
        ft: number of the robot's limb force/torque sensors; none of them is in the set.

    Raises:
        UnknownNameError: a joint, contact or component does not exist.
        SensorError: the contact cannot transmit a component.
    """
    torque = np.zeros(len(joint_names) + 6 * ft, dtype=bool)
    for name in joint_torques:
        if name not in joint_names:
            raise UnknownNameError.at_field("sensors.joint_torques", name, joint_names)
        torque[list(joint_names).index(name)] = True
    frames = [contact.frame for contact in contacts]
    wrench = np.zeros((len(frames), 6), dtype=bool)
    for frame, names in contact_wrenches.items():
        if frame not in frames:
            raise UnknownNameError.at_field("sensors.contact_wrenches", frame, frames)
        contact = contacts[frames.index(frame)]
        field_name = f"sensors.contact_wrenches.{frame}"
        chosen = tuple(names)
        if NORMAL_FORCE in chosen or contact.along_normal and chosen:
            _check_scalar(field_name, contact, chosen)
            wrench[frames.index(frame), NORMAL_INDEX] = True
            continue
        for name in chosen:
            if name not in WRENCH_COMPONENTS:
                raise UnknownNameError.at_field(field_name, name, contact.component_names)
            if name not in contact.component_names:
                reason = f"'{name}' does not exist at a {contact.kind} contact"
                raise SensorError.at_field(field_name, reason, ", ".join(contact.component_names))
            wrench[frames.index(frame), WRENCH_COMPONENTS.index(name)] = True
    return SensorSet(torque, wrench, noise or SensorNoise())


def _check_scalar(field_name: str, contact: Contact, names: Sequence[str]) -> None:
    """Raise SensorError if "fn" is mixed with other components, or the contact has no scalar sensor."""
    others = [name for name in names if name != NORMAL_FORCE]
    if others:
        reason = f"'{others[0]}', but this sensor measures only '{NORMAL_FORCE}'"
        accepted = f"[{NORMAL_FORCE}], or wrench components without {NORMAL_FORCE}"
        raise SensorError.at_field(field_name, reason, accepted)
    if not contact.along_normal:
        reason = f"'{NORMAL_FORCE}', but this contact has a wrench sensor"
        accepted = f"{', '.join(contact.component_names)}; for {NORMAL_FORCE} set it in the experiment's sensors too "
        accepted += "(in Python: Contact(..., along_normal=True))"
        raise SensorError.at_field(field_name, reason, accepted)


def measured_components(contacts: Sequence[Contact], sensors: SensorSet) -> np.ndarray:
    """Measured components (C, 6) that the contacts can exert, along the frames' axes."""
    possible = np.zeros((len(contacts), 6), dtype=bool)
    for index, contact in enumerate(contacts):
        possible[index, list(contact.components)] = True
    return possible & sensors.wrench


def recorded_components(contacts: Sequence[Contact], sensors: SensorSet, in_world: bool) -> np.ndarray:
    """Recorded components (C, 6) that the measured ones are computed from.

    Along world axes these are all components of a vector; a scalar sensor has its own component only.
    """
    measured = measured_components(contacts, sensors)
    if not in_world:
        return measured
    whole = measured.reshape(-1, 2, 3).any(axis=2)
    turned = np.array([not contact.along_normal for contact in contacts], dtype=bool)[:, None]
    return np.where(turned, np.repeat(whole, 3, axis=1), measured)


def minimized_errors(robot: Robot, contacts: Sequence[Contact], sensors: SensorSet) -> str:
    """Which errors a fit with these sensors minimizes, and of which unmeasured forces they are independent."""
    torque = sensors.torque[: robot.n]
    measured = measured_components(contacts, sensors)
    rows = ["joint torques"] * bool(torque.any()) + ["base forces"] * (not robot.fixed_base)
    rows += ["wrenches in limbs"] * bool(sensors.torque[robot.n :].any())
    makers = ["force in a closed loop"] * bool(robot.loops)
    if not torque.all():
        lacking = [name for name, known in zip(robot.joint_names, torque, strict=True) if not known]
        makers.append(f"torque of {join_names(lacking)}" if torque.any() else "joint torque")
    if frames := [
        x.frame for x, components in zip(contacts, measured, strict=True) if components.sum() < len(x.components)
    ]:
        makers.append(f"unmeasured force at {join_names(frames)}" if measured.any() else "contact force")
    return f"errors of {' and '.join(rows)}" + f", independent of {' and '.join(makers)}" * bool(makers)
