"""A log bound to a robot and its contacts: tensors in the robot's order, checked for what the run needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchid.errors import LogError, UnknownNameError
from torchid.logs import Log
from torchid.regressor.motion import GRAVITY_WORLD, Motion, rotation_matrix
from torchid.robot import Robot
from torchid.sensing.contacts import COMPONENTS, Contact
from torchid.sensing.sensors import SensorSet

_JOINT_FIELDS = ("joint_position", "joint_velocity", "joint_acceleration")
_MOTION_FIELDS = (
    "base_quat_xyzw",
    "base_angular_velocity_base",
    "base_angular_acceleration_base",
    "base_linear_acceleration_world",
)

_ACCEPTED = {
    "base_quat_xyzw": "base_quat_wxyz or base_quat_xyzw",
    "base_linear_acceleration_world": "base_position_world, base_linear_velocity_{world,base} or "
    "base_linear_acceleration_{world,base}",
}


@dataclass(frozen=True)
class Samples:
    """N samples of one log, in the robot's joint order and the experiment's contact order.

    Attributes:
        source: the log's file, for messages and tables.
        time: (N,) [s].
        joint_position, joint_velocity, joint_acceleration: (N, n).
        base: `base_quat_xyzw` (N, 4) and the base's twist derivatives (N, 3); empty for a bolted base without them.
        torque: (N, n) [N m], NaN where not measured, or None.
        wrench: (N, C, 6), NaN where not measured, or None; along world axes if `wrench_in_world`, else the frames'.
        active: (N, C) bool.
        oversampling: samples per independent sample of the sensors' noise, above 1 in a filtered log: half the sample
            rate over the noise bandwidth of the filter.
    """

    source: str
    time: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    joint_acceleration: Tensor
    base: dict[str, Tensor]
    torque: Tensor | None
    wrench: Tensor | None
    wrench_in_world: bool
    active: Tensor
    oversampling: float = 1.0

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, index: slice | Tensor) -> Samples:
        """Some of the samples."""
        return Samples(
            self.source,
            self.time[index],
            self.joint_position[index],
            self.joint_velocity[index],
            self.joint_acceleration[index],
            {name: x[index] for name, x in self.base.items()},
            None if self.torque is None else self.torque[index],
            None if self.wrench is None else self.wrench[index],
            self.wrench_in_world,
            self.active[index],
            self.oversampling,
        )

    def to(self, device: torch.device | str) -> Samples:
        """The samples on another device."""

        def move(x: Tensor | None) -> Tensor | None:
            return None if x is None else x.to(device)

        moved = {name: x.to(device) for name, x in self.base.items()}
        position, velocity = self.joint_position.to(device), self.joint_velocity.to(device)
        return Samples(
            self.source,
            self.time.to(device),
            position,
            velocity,
            self.joint_acceleration.to(device),
            moved,
            move(self.torque),
            move(self.wrench),
            self.wrench_in_world,
            self.active.to(device),
            self.oversampling,
        )

    @property
    def rotation_world_base(self) -> Tensor | None:
        """(N, 3, 3), or None for a bolted base without a recorded orientation."""
        quat = self.base.get("base_quat_xyzw")
        return None if quat is None else rotation_matrix(quat)

    def motion(self) -> Motion:
        """What the regressor needs of these samples."""
        rotation = self.rotation_world_base
        gravity = self.time.new_tensor(GRAVITY_WORLD)
        still = self.time.new_zeros(len(self), 3)
        acceleration = self.base.get("base_linear_acceleration_world", still)
        force = acceleration - gravity
        if rotation is not None:
            force = (rotation.mT @ force[..., None])[..., 0]
        omega = self.base.get("base_angular_velocity_base", still)
        alpha = self.base.get("base_angular_acceleration_base", still)
        return Motion(self.joint_position, self.joint_velocity, self.joint_acceleration, omega, alpha, force)

    def coordinates(self) -> tuple[Tensor, Tensor, Tensor]:
        """Generalized coordinates q, v, a as `Regressor` takes them.

        Base position and base linear velocity are 0: the dynamics do not depend on them, and logs need not hold them.
        A bolted base has joints only.
        """
        joints = (self.joint_position, self.joint_velocity, self.joint_acceleration)
        rotation, still = self.rotation_world_base, self.time.new_zeros(len(self), 3)
        if rotation is None or "base_linear_acceleration_world" not in self.base:
            return joints
        linear = (rotation.mT @ self.base["base_linear_acceleration_world"][..., None])[..., 0]
        base = (
            torch.cat([still, self.base["base_quat_xyzw"]], dim=1),
            torch.cat([still, self.base["base_angular_velocity_base"]], dim=1),
            torch.cat([linear, self.base["base_angular_acceleration_base"]], dim=1),
        )
        q, v, a = (torch.cat(pair, dim=1) for pair in zip(base, joints, strict=True))
        return q, v, a


def bind(log: Log, robot: Robot, contacts: Sequence[Contact], required: SensorSet | None = None) -> Samples:
    """Order a preprocessed log by the robot's joints and the contacts, and check it.

    Args:
        log: with velocities and accelerations filled in (see `torchid.logs.preprocess`).
        robot: the robot.
        contacts: the contacts in use.
        required: sensors whose every value must be there; None if gaps are allowed.

    Raises:
        UnknownNameError: a joint or contact that the robot does not have.
        LogError: a joint, contact, motion or force that is missing.
    """
    order = _joint_order(log, robot)
    position, velocity, acceleration = (_joints(log, name, order) for name in _JOINT_FIELDS)
    base = {name: torch.from_numpy(x) for name in _MOTION_FIELDS if (x := getattr(log, name)) is not None}
    if not robot.fixed_base and len(base) < len(_MOTION_FIELDS):
        missing = next(name for name in _MOTION_FIELDS if name not in base)
        accepted = _ACCEPTED.get(missing, f"{missing}, or a log passed through preprocess()")
        raise LogError(log.source, missing, "missing, though the base floats", accepted)
    if robot.fixed_base:
        base = {name: x for name, x in base.items() if name == "base_quat_xyzw"}  # how the base is mounted
    chosen, active = _contacts(log, robot, contacts)
    wrench = log.contact_wrench_local if log.contact_wrench_world is None else log.contact_wrench_world
    samples = Samples(
        log.source,
        torch.from_numpy(log.time),
        position,
        velocity,
        acceleration,
        base,
        None if log.joint_torque is None else torch.from_numpy(_columns(log.joint_torque, order)),
        None if wrench is None else torch.from_numpy(_columns(wrench, chosen)),
        log.contact_wrench_world is not None,
        torch.from_numpy(active),
        _oversampling(log),
    )
    if required is not None:
        check_forces(samples, robot, contacts, required)
    return samples


def _oversampling(log: Log) -> float:
    """Half the sample rate over the bandwidth that a filter has left of the noise, at least 1."""
    if log.noise_bandwidth_hz is None or len(log) < 2:
        return 1.0
    rate = 1.0 / float(np.median(np.diff(log.time)))
    return max(1.0, 0.5 * rate / log.noise_bandwidth_hz)


def _joints(log: Log, name: str, order: list[int]) -> Tensor:
    values = getattr(log, name)
    if values is None:
        raise LogError(log.source, name, "missing", "the field, or a log passed through preprocess()")
    return torch.from_numpy(_columns(values, order))


def _columns(x: np.ndarray, order: list[int]) -> np.ndarray:
    return x if order == list(range(x.shape[1])) else x[:, order]


def _joint_order(log: Log, robot: Robot) -> list[int]:
    known = {body.joint.name for body in robot.bodies if body.joint is not None}
    for name in log.joint_names:
        if name not in known:
            raise UnknownNameError(log.source, "joint_names", name, robot.joint_names)
    for name in robot.joint_names:
        if name not in log.joint_names:
            raise LogError(
                log.source, "joint_names", f"joint '{name}' of {robot.path.name} missing", "every moving joint"
            )
    return [log.joint_names.index(name) for name in robot.joint_names]


def _contacts(log: Log, robot: Robot, contacts: Sequence[Contact]) -> tuple[list[int], np.ndarray]:
    """Columns of the log's contacts in the experiment's order, and their activity (N, C)."""
    frames = [contact.frame for contact in contacts]
    for column, name in enumerate(log.contact_names):
        robot.link(name, "contact_names", log.source)
        if name not in frames and log.contact_active is not None and log.contact_active[:, column].any():
            raise LogError(log.source, f"contact_names '{name}'", "active, but not among the experiment's contacts",
                           f"contacts: [{{frame: {name}, type: ...}}, ...]")  # fmt: skip
    for frame in frames:
        if frame not in log.contact_names:
            raise LogError(log.source, "contact_names", f"contact '{frame}' missing", "every contact of the experiment")
    order = [log.contact_names.index(frame) for frame in frames]
    if frames and log.contact_active is None:
        raise LogError(log.source, "contact_active", "missing", "(N, C) bool: which contact touches the ground when")
    active = np.zeros((len(log), 0), dtype=bool) if log.contact_active is None else _columns(log.contact_active, order)
    return order, active


def check_forces(samples: Samples, robot: Robot, contacts: Sequence[Contact], required: SensorSet) -> None:
    """Make sure that every value of some sensors was recorded.

    Raises:
        LogError: one that is missing.
    """
    if required.torque.any():
        if samples.torque is None:
            raise LogError(samples.source, "joint_torque", "missing", "the field, or sensors without joint torques")
        bad = ~torch.isfinite(samples.torque) & torch.from_numpy(required.torque)
        if bad.any():
            sample, joint = torch.nonzero(bad)[0].tolist()
            found = f"not a finite number at sample {sample} ({int(bad[:, joint].sum())} in all)"
            raise LogError(
                samples.source, f"joint_torque '{robot.joint_names[joint]}'", found, "a value: it is a sensor"
            )
    needed = read_components(contacts, required, samples.wrench_in_world)
    if needed.any() and samples.active.any():
        if samples.wrench is None:
            raise LogError(samples.source, "contact_wrench", "missing", "contact_wrench_local or contact_wrench_world")
        bad = ~torch.isfinite(samples.wrench) & torch.from_numpy(needed) & samples.active[..., None]
        if bad.any():
            sample, contact, k = torch.nonzero(bad)[0].tolist()
            found = f"{COMPONENTS[k]} is not a finite number at sample {sample}, while in contact"
            raise LogError(
                samples.source, f"contact_wrench '{contacts[contact].frame}'", found, "a value: it is a sensor"
            )


def read_components(contacts: Sequence[Contact], sensors: SensorSet, in_world: bool) -> np.ndarray:
    """Recorded components (C, 6) that the measured ones are computed from: along world axes, whole vectors."""
    measured = measured_components(contacts, sensors)
    if not in_world:
        return measured
    whole = measured.reshape(-1, 2, 3).any(axis=2)
    return np.repeat(whole, 3, axis=1)


def measured_components(contacts: Sequence[Contact], sensors: SensorSet) -> np.ndarray:
    """Measured components (C, 6) that the contacts can exert, along the frames' axes."""
    possible = np.zeros((len(contacts), 6), dtype=bool)
    for index, contact in enumerate(contacts):
        possible[index, list(contact.components)] = True
    return possible & sensors.wrench
