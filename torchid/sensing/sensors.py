"""Contacts, where the environment can push, and sensor sets, masks over joint torques and contact-wrench components."""

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
"""Its place among the components of a contact whose force is along the axes of the ground."""


UP = (0.0, 0.0, 1.0)


def join_numbers(numbers: Iterable[float]) -> str:
    """Numbers as a list of a settings file."""
    return f"[{', '.join(f'{x:g}' for x in numbers)}]"


@dataclass(frozen=True)
class Contact:
    """A contact at a URDF frame.

    `kind`: "point" exerts three force components; "flat" all six; "line" all but the moment about the line, which runs
    along the frame's `line_axis`.

    With a `radius` [m] a point is a sphere about the frame's origin c that rolls on the ground, a line a cylinder about
    `line_axis`: the ground acts at c - radius n, n being `normal`, (3,), a unit vector in the world that points away
    from the ground (of a cylinder its part across the axis). Readings are wrenches at c all the same; of a line's
    force, the part along the axis then counts as acting at c, since moments across the axis are free.
    `centre`, (3,) [m]: c of a point in the frame, where a ball's centre lies beside the frame's origin.

    `along_normal`: the contact has a scalar sensor, which reads the force along `normal` alone, "fn". The axes of its
    force are then the ground's, fz that along the normal and fx and fy across it, instead of the frame's.
    """

    frame: str
    kind: str
    line_axis: str = "y"
    radius: float = 0.0
    normal: tuple[float, float, float] = UP
    along_normal: bool = False
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Validate all, and give the normal unit length.

        Raises:
            SensorError: an unknown kind or line axis, a radius that is negative or a flat contact's, a centre of
                another contact than a point, a normal of no length.
        """
        if self.kind not in CONTACT_TYPES:
            raise SensorError(f"contact '{self.frame}'", "type", f"'{self.kind}'", ", ".join(CONTACT_TYPES))
        if self.line_axis not in ("x", "y", "z"):
            raise SensorError(f"contact '{self.frame}'", "line_axis", f"'{self.line_axis}'", "x, y, z")
        if not 0.0 <= self.radius < np.inf:
            raise SensorError(f"contact '{self.frame}'", "radius", f"{self.radius:g}", "a number of at least 0 [m]")
        if self.radius and self.kind == "flat":
            accepted = "type point (a sphere) or line (a cylinder), or radius 0"
            raise SensorError(f"contact '{self.frame}'", "radius", f"{self.radius:g} of a flat contact", accepted)
        if len(self.centre) != 3 or not np.isfinite(self.centre).all() or self.kind != "point" and any(self.centre):
            accepted = "three numbers [m] in the frame of a point"
            raise SensorError(f"contact '{self.frame}'", "centre", join_numbers(self.centre), accepted)
        length = float(np.linalg.norm(self.normal))
        if len(self.normal) != 3 or not 0.0 < length < np.inf:
            raise SensorError(
                f"contact '{self.frame}'", "normal", join_numbers(self.normal), "three numbers, not all 0, in the world"
            )
        if length != 1.0:
            x, y, z = (float(component) / length for component in self.normal)
            object.__setattr__(self, "normal", (x, y, z))

    @property
    def components(self) -> tuple[int, ...]:
        """Indices in `WRENCH_COMPONENTS` of the components that can differ from zero."""
        if self.kind == "point":
            return _FORCES
        if self.kind == "flat":
            return _FORCES + _MOMENTS
        return _FORCES + tuple(m for m in _MOMENTS if m != _MOMENTS["xyz".index(self.line_axis)])

    @property
    def rolling_axis(self) -> str | None:
        """Axis of the frame about which a line rolls; None for a point, whose sphere has none."""
        return self.line_axis if self.kind == "line" else None

    def pose(self, frame_pose: Array) -> Array:
        """Poses (..., 4, 4) of the frame, its origin moved to the contact's centre."""
        moved = frame_pose.copy()
        moved[..., :3, 3] += moved[..., :3, :3] @ np.array(self.centre)
        return moved

    def component_name(self, k: int) -> str:
        """Name of a component that its sensors measure, by index in `WRENCH_COMPONENTS`."""
        return NORMAL_FORCE if self.along_normal and k == NORMAL_INDEX else WRENCH_COMPONENTS[k]

    @property
    def component_names(self) -> tuple[str, ...]:
        """Names of `components`."""
        return tuple(WRENCH_COMPONENTS[k] for k in self.components)


def validate_contacts(robot: Robot, contacts: Sequence[Contact]) -> tuple[Contact, ...]:
    """The contacts, after making sure that the robot has their frames.

    Raises:
        UnknownNameError: a frame that the URDF does not have.
        SensorError: a frame named twice.
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
    """Standard deviations of the sensors, and those of the base rows beside the sensors' [N, N m].

    `base_force` and `base_moment` are the errors of the base rows that are no force sensor's (differentiated motion,
    soft contacts): without them a base row in flight, where no sensor contributes noise, would count as exact. By
    default they are one contact sensor's noise, and so are those of force/torque sensors in limbs. Three numbers are
    for the axes x, y, z of the levelled base, see `torchid.problem.motion.levelled_base_axes`. `joint_torque`, in
    N of a joint that slides, may have a number for each joint, as estimates do. The defaults are
    rough, for library users and as the start of the estimation in `torchid.problem.noise`.
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
        """The noise of readings with what is known of it by field, and NaN for all else."""
        return cls(**dict.fromkeys(("joint_torque", "contact_force", "contact_moment"), np.nan) | dict(known))

    @property
    def base_std(self) -> Array:
        """Standard deviations of the six base rows along the levelled base's axes, (6,) [N, N m]."""
        force = self.contact_force if self.base_force is None else self.base_force
        moment = self.contact_moment if self.base_moment is None else self.base_moment
        return np.concatenate([np.broadcast_to(np.asarray(x, dtype=float), 3) for x in (force, moment)])

    @property
    def base_axes_differ(self) -> bool:
        """Whether the standard deviations of the base rows differ from axis to axis."""
        return bool(np.ptp(self.base_std.reshape(2, 3), axis=1).any())

    @property
    def limb_std(self) -> tuple[float, float]:
        """Standard deviations of a force and of a moment that a force/torque sensor in a limb reads [N, N m]."""
        force = self.contact_force if self.ft_force is None else self.ft_force
        moment = self.contact_moment if self.ft_moment is None else self.ft_moment
        return force, moment

    def dof_std(self, n: int, count: int) -> Array:
        """Standard deviations by `Robot.dof_names`: n joint torques, then wrenches in limbs, (count,) [N m, N, N m].

        Raises:
            SensorError: `joint_torque` has neither one number nor n.
        """
        joints = np.asarray(self.joint_torque, dtype=float)
        if joints.shape not in ((), (n,)):
            raise SensorError("noise", "joint_torque", f"{joints.size} numbers", f"one for all joints, or {n}")
        return np.append(np.broadcast_to(joints, n), np.tile(np.repeat(self.limb_std, 3), (count - n) // 6))

    def scaled(self, factor: float) -> SensorNoise:
        """All standard deviations times a factor."""
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
    """Which forces are measured.

    `torque`, (n + 6 F,) bool, by the robot's `dof_names`: joint torques, then wrenches of sensors in limbs; `wrench`,
    (C, 6) bool, by contacts and `WRENCH_COMPONENTS`.

    `task_weights`, (n_rows,) > 0: how much errors of the generalized forces, those of a floating base along its own
    axes first, count in a fit, beside their noise; None for all alike.
    """

    torque: np.ndarray
    wrench: np.ndarray
    noise: SensorNoise = field(default_factory=SensorNoise)
    task_weights: Array | None = None

    __repr__ = short_repr

    def _headline(self) -> str:
        of_contacts = f"{int(self.wrench.sum())} components at contacts"
        return f"{int(self.torque.sum())} joint torques and readings in limbs, {of_contacts}"


def named_sensors(name: str, n: int, contacts: int, noise: SensorNoise | None = None, ft: int = 0) -> SensorSet:
    """One of the three sets that have a name: "full", "contacts" or "joints", without the `ft` sensors in limbs.

    Raises:
        SensorError: another name.
    """
    if name not in NAMED_SETS:
        raise SensorError("sensors", "name", f"'{name}'", f"{', '.join(NAMED_SETS)}, or a mapping of sensors")
    torque = name in ("full", "joints")
    wrench = name in ("full", "contacts")
    torques = np.append(np.full(n, torque), np.zeros(6 * ft, dtype=bool))
    return SensorSet(torques, np.full((contacts, 6), wrench), noise or SensorNoise())


def with_ft_sensors(sensors: SensorSet, robot: Robot, names: Iterable[str]) -> SensorSet:
    """The set with force/torque sensors in limbs, by the names of their fixed joints, beside what it has.

    Raises:
        UnknownNameError: one that the robot was not loaded with.
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
    """A sensor set, chosen by the names of joints and of components of contact wrenches.

    Args:
        joint_names: the robot's independent joints.
        contacts: the contacts in use.
        joint_torques: joints whose torque is measured.
        contact_wrenches: measured components ("fx" ... "mz") by contact frame, or "fn" alone of one that is read
            `along_normal`.
        noise: of the sensors.
        ft: force/torque sensors in limbs that the robot has; none of them is in the set.

    Raises:
        UnknownNameError: a joint, contact or component that does not exist.
        SensorError: a component that its contact cannot exert.
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
                reason = f"'{name}', which a {contact.kind} contact cannot exert"
                raise SensorError.at_field(field_name, reason, ", ".join(contact.component_names))
            wrench[frames.index(frame), WRENCH_COMPONENTS.index(name)] = True
    return SensorSet(torque, wrench, noise or SensorNoise())


def _check_scalar(field_name: str, contact: Contact, names: Sequence[str]) -> None:
    """Refuse components beside that of a scalar sensor, and a contact that is read along other axes."""
    others = [name for name in names if name != NORMAL_FORCE]
    if others:
        reason = f"'{others[0]}' of a contact whose force is read along the ground's normal, '{NORMAL_FORCE}'"
        accepted = f"[{NORMAL_FORCE}] alone, or components of the wrench without it"
        raise SensorError.at_field(field_name, reason, accepted)
    if not contact.along_normal:
        reason = f"'{NORMAL_FORCE}' of a contact whose wrench is read"
        accepted = f"{', '.join(contact.component_names)}; {NORMAL_FORCE} if the experiment's own sensors have it too "
        accepted += "(in Python: a Contact with along_normal=True)"
        raise SensorError.at_field(field_name, reason, accepted)


def measured_components(contacts: Sequence[Contact], sensors: SensorSet) -> np.ndarray:
    """Measured components (C, 6) that the contacts can exert, along the frames' axes."""
    possible = np.zeros((len(contacts), 6), dtype=bool)
    for index, contact in enumerate(contacts):
        possible[index, list(contact.components)] = True
    return possible & sensors.wrench


def recorded_components(contacts: Sequence[Contact], sensors: SensorSet, in_world: bool) -> np.ndarray:
    """Recorded components (C, 6) from which the measured ones are computed: whole vectors if along world axes.

    Of a contact that is read along the ground's normal they are those that are measured.
    """
    measured = measured_components(contacts, sensors)
    if not in_world:
        return measured
    whole = measured.reshape(-1, 2, 3).any(axis=2)
    turned = np.array([not contact.along_normal for contact in contacts], dtype=bool)[:, None]
    return np.where(turned, np.repeat(whole, 3, axis=1), measured)


def minimized_errors(robot: Robot, contacts: Sequence[Contact], sensors: SensorSet) -> str:
    """What a fit with some sensors minimizes, in words: errors of which forces, and what they are free of."""
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
    return f"errors of {' and '.join(rows)}" + f" that no {' or '.join(makers)} can make" * bool(makers)
