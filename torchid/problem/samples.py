"""A log bound to a robot and its contacts: tensors in the robot's order, checked for completeness."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.errors import LogError, about_file, format_count
from torchid.logs import Log
from torchid.logs.log import FORCE_NORMAL, FloatArray, normalize_normals
from torchid.logs.preprocess import unloaded_readings
from torchid.logs.spill import MappedPages
from torchid.parameters import GRAVITY, WRENCH_COMPONENTS, Array
from torchid.problem import log_joints
from torchid.problem.log_joints import columns_in_order, joint_order, recorded_torques
from torchid.problem.motion import (
    FROM_PREPROCESS,
    MIN_MOTION,
    MIN_TURN_DEG,
    BaseMotion,
    MotionNoise,
    base_motion,
    bind_motion_noise,
    imu_pose,
    position_for_moments,
    random_sides,
)
from torchid.regressor import Motion
from torchid.regressor.kinematics import GRAVITY_WORLD, rotation_matrix
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.sensors import NORMAL_FORCE, NORMAL_INDEX, recorded_components

_AS_MEASURED = "a number in every sample, or sensors without this one"
ACTIVE = "(N, C) bool, true while a contact touches the ground"
"""Accepted for `contact_active`, in messages."""

_FAR_APART = 8  # samples per selected sample, above which a page has few selected ones
_JOINT_FIELDS = ("joint_position", "joint_velocity", "joint_acceleration")


@dataclass(frozen=True)
class Samples:
    """N samples of one log, in the joint order of the robot and the contact order of the experiment.

    Attributes:
        source: the log's file, for messages and tables.
        time: (N,) [s].
        joint_position, joint_velocity, joint_acceleration: (N, n) [rad or m, /s, /s^2].
        base: motion of the base and, if known, its orientation; empty for a fixed base.
        torque: (N, n + 6 F) [N m, N, N m], in the order of the robot's `dof_names`: joint torques, then limb sensor
            wrenches; NaN where not measured, or None.
        wrench: (N, C, 6) [N, N m], NaN where not measured, or None; along world axes if `wrench_in_world`, else along
            the contact frames. Moments are about the frames' origins, or about the world's origin if `base.position` is
            known. A scalar sensor has the force along the ground's normal as fz, and nothing else.
        active: (N, C) bool, true while a contact touches the ground.
        oversampling: samples per independent sample of the sensor noise, above 1 in a filtered log: half the sample
            rate over the noise bandwidth of the filter.
        noise_share: fraction of the noise variance that the filter keeps; None for 1 / `oversampling`.
        contact_normal: (N, C, 3), unit vectors in the world away from the ground; None for the contacts' own.
        share: (N, C), fraction of a constant contact reading that the filter keeps, see `Log.contact_share`; None for
            `active`.
        unloaded: (N, C, 6), readings of contact sensors in the air, NaN elsewhere, see `Log.contact_unloaded`, on the
            CPU; or None.
        direction, stribeck: (N, n), factors of Coulomb and Stribeck friction, see `Log`; None to compute them from the
            velocity.
        folder: where the tensors of a log larger than memory are stored; None for a log in memory.
        fold: number of the cross-validation fold, see `split_into_folds`.
        blocks: (N, 2), fold and block of each sample; None for `fold` and block 0.
        has_force_normal: whether the log has forces along the ground's normal.
        motion_noise: noise of the motion, or None.
        pages: pages of the files that the tensors are mapped to; None for tensors in memory.
        payload: (12 L,), parameters of a payload, see `payload_parameters`; or None.
        resting: (N, n) bool, joints at rest, whose torque counts as unmeasured (`Log.joint_rests`); or None.
        slope: (N, n), change of the joint torques per unit of the unknown of a search; or None.
    """

    source: str
    time: Tensor
    joint_position: Tensor
    joint_velocity: Tensor
    joint_acceleration: Tensor
    base: BaseMotion
    torque: Tensor | None
    wrench: Tensor | None
    wrench_in_world: bool
    active: Tensor
    oversampling: float = 1.0
    contact_normal: Tensor | None = None
    share: Tensor | None = None
    unloaded: Tensor | None = None
    direction: Tensor | None = None
    folder: Path | None = None
    fold: int = 0
    has_force_normal: bool = False
    motion_noise: MotionNoise | None = None
    payload: Array | None = None
    pages: MappedPages | None = field(default=None, repr=False, compare=False)
    slope: Tensor | None = None
    noise_share: float | None = None
    stribeck: Tensor | None = None
    blocks: Tensor | None = None
    resting: Tensor | None = None

    __repr__ = short_repr

    def _headline(self) -> str:
        return f"{self.source}, {len(self)} samples in the robot's order, in SI units"

    def __len__(self) -> int:
        return len(self.time)

    @property
    def nbytes(self) -> int:
        """Bytes of all tensors."""
        parts = (*vars(self).values(), *vars(self.base).values())
        return sum(x.nbytes for x in parts if isinstance(x, Tensor))

    def _each(self, change: Callable[[Tensor], Tensor]) -> Samples:
        """The samples with every tensor changed."""
        changed: dict[str, Any] = {name: change(x) for name, x in vars(self).items() if isinstance(x, Tensor)}
        return replace(self, base=self.base.map(change), **changed)

    def __getitem__(self, index: slice | Tensor) -> Samples:
        """Select samples. For memory-mapped samples far apart, only the pages of one tensor at a time are in memory."""
        pages = self.pages
        if pages is None or not _is_far_apart(index):
            return self._each(lambda x: x[index])

        def chosen(x: Tensor) -> Tensor:
            rows = x[index].clone() if isinstance(index, slice) else x[index]
            pages.release()
            return rows

        return replace(self._each(chosen), pages=None)

    @property
    def noise_left(self) -> float:
        """Fraction of the variance of the recorded noise that is in the samples."""
        return 1.0 / self.oversampling if self.noise_share is None else min(self.noise_share, 1.0)

    def pieces(self) -> list[Samples]:
        """Cut the samples into pieces that fit in memory."""
        return [self[start : start + 2**16] for start in range(0, len(self), 2**16)]

    def every(self, step: int) -> Samples:
        """Every `step`-th sample, beginning with the first; a step of 1 makes no copy."""
        return self if step == 1 else self[::step]

    def to(self, device: torch.device | str, non_blocking: bool = False) -> Samples:
        """Move the samples to another device, except `blocks` and readings in the air, which become a few means."""
        return self._each_that_moves(lambda x: x.to(device, non_blocking=non_blocking))

    def pin_memory(self) -> Samples:
        """Copy to page-locked memory what `to` moves, so that a GPU can read it asynchronously."""
        return self._each_that_moves(torch.Tensor.pin_memory)

    def keep_for(self, stream: torch.Stream) -> None:
        """Keep the memory that `to` moved until a stream of the device has finished its queued work."""

        def kept(x: Tensor) -> Tensor:
            x.record_stream(stream)
            return x

        self._each_that_moves(kept)

    def _each_that_moves(self, change: Callable[[Tensor], Tensor]) -> Samples:
        moved = replace(self, unloaded=None, blocks=None)._each(change)
        return replace(moved, unloaded=self.unloaded, blocks=self.blocks)

    def motion(self) -> Motion:
        """The motion of these samples, for the regressor."""
        base = self.base
        zero = self.time.new_zeros(len(self), 3)
        force = base.specific_force
        if force is None:  # of a fixed base
            force = torch.stack([zero[:, 0] - g for g in GRAVITY_WORLD], dim=1)
            if (rotation := base.rotation) is not None:
                force = (rotation.mT @ force[..., None])[..., 0]
        omega, alpha = (zero if x is None else x for x in (base.angular_velocity, base.angular_acceleration))
        joints = self.joint_position, self.joint_velocity, self.joint_acceleration
        return Motion(*joints, omega, alpha, force, self.direction)

    def perturbed(self, noise: MotionNoise, size: Tensor) -> Samples:
        """Add motion noise of the same size again, times `size`, (B, 1), see `MotionNoise.drawn`."""
        (q, v, a), of_base = noise.drawn(self.time, size)
        return replace(
            self,
            joint_position=self.joint_position + q,
            joint_velocity=self.joint_velocity + v,
            joint_acceleration=self.joint_acceleration + a,
            base=noise.added_to(self.base, of_base),
        )

    def with_noise_alone(self, noise: SensorNoise) -> Samples:
        """Replace the readings by pure force noise, drawn like the motion noise."""
        torque = self.torque
        wrench = self.wrench
        if torque is not None:
            std = torque.new_tensor(noise.dof_std(self.joint_position.shape[1], torque.shape[1]))
            torque = 0.0 * torque + std * random_sides(self.time, len(std))
        if wrench is not None:
            sides = random_sides(self.time, wrench.shape[1] * 6).unflatten(1, (-1, 6))
            wrench = 0.0 * wrench + wrench.new_tensor(noise.wrench_std) * sides
        return replace(self, torque=torque, wrench=wrench)

    def coordinates(self) -> tuple[Tensor, Tensor, Tensor]:
        """Generalized coordinates q (N, n + 7), v and a (N, nv), as `Regressor` takes them.

        Base position and base linear velocity are 0, because the dynamics do not depend on them. A missing orientation
        is the identity, because the specific force is given. A fixed base has joints only.
        """
        q = self.joint_position
        v = self.joint_velocity
        a = self.joint_acceleration
        base = self.base
        zero = self.time.new_zeros(len(self), 3)
        if base.specific_force is None or base.angular_velocity is None or base.angular_acceleration is None:
            return q, v, a
        quat = zero.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(self), 4) if base.quat_xyzw is None else base.quat_xyzw
        g_base = (rotation_matrix(quat).mT @ zero.new_tensor(GRAVITY_WORLD)[:, None])[..., 0]
        return (
            torch.cat([zero, quat, q], dim=1),
            torch.cat([zero, base.angular_velocity, v], dim=1),
            torch.cat([base.specific_force + g_base, base.angular_acceleration, a], dim=1),
        )


def _is_far_apart(index: slice | Tensor) -> bool:
    """Whether chosen samples, by their increasing numbers, are few of those between the first and the last."""
    if isinstance(index, slice):
        return (index.step or 1) >= _FAR_APART
    if index.dtype == torch.bool or not len(index):
        return False
    return int(index[-1] - index[0]) >= _FAR_APART * len(index)


def concatenate(pieces: Sequence[Samples]) -> Samples:
    """Pieces of one log as one, with whatever else of the first."""
    if len(pieces) == 1:
        return pieces[0]

    def joined(parts: Sequence[Any]) -> dict[str, Any]:
        tensors = [name for name, x in vars(parts[0]).items() if isinstance(x, Tensor)]
        return {name: torch.cat([getattr(part, name) for part in parts]) for name in tensors}

    return replace(pieces[0], base=BaseMotion(**joined([piece.base for piece in pieces])), **joined(pieces))


def bind_log(log: Log, robot: Robot, contacts: Sequence[Contact], required: SensorSet | None = None) -> Samples:
    """Order a preprocessed log by the robot's joints and the contacts, and check it.

    Args:
        log: with velocities and accelerations (see `torchid.preprocess`).
        robot: the robot.
        contacts: the contacts in use.
        required: sensors that must have a value in every sample; None to allow gaps.

    Raises:
        UnknownNameError: the robot has no such joint or contact frame.
        LogError: a joint, contact, motion or force is missing.
    """
    log = _with_writable_arrays(log)
    order = joint_order(log, robot)
    position, velocity, acceleration = (_joints(log, name, order) for name in _JOINT_FIELDS)
    log_joints.require_closed_loops(log.source, position, robot)
    base = replace(base_motion(log, robot), position=position_for_moments(log, robot, contacts))
    chosen, active = _contacts(log, robot, contacts)
    if log.contact_wrench_world is not None and contacts and base.quat_xyzw is None and not robot.fixed_base:
        accepted = "base_quat_wxyz or base_quat_xyzw beside the IMU, or contact_wrench_local"
        raise LogError(log.source, "contact_wrench_world", "needs the base's orientation, which is missing", accepted)
    normals = _contact_normals(log, robot, contacts, base, chosen, active)
    wrench = _wrenches(log, contacts, chosen)
    if wrench is not None and base.position is not None:  # where a force is unknown, the moment is too
        lost = np.isnan(wrench[..., :3]).any(axis=2, keepdims=True) & (np.arange(6) >= 3)
        wrench = np.where(lost, np.nan, wrench) if lost.any() else wrench
    unloaded = unloaded_readings(log) if contacts else None
    imu = imu_pose(log, robot) if log.imu_frame and not robot.fixed_base else None
    samples = Samples(
        log.source,
        torch.from_numpy(log.time),
        position,
        velocity,
        acceleration,
        base,
        recorded_torques(log, robot, order),
        None if wrench is None else torch.from_numpy(wrench),
        log.contact_wrench_world is not None,
        torch.from_numpy(active),
        oversampling(log.time, log.noise_bandwidth_hz),
        normals,
        None if log.contact_share is None else torch.from_numpy(columns_in_order(log.contact_share, chosen)),
        None if unloaded is None else torch.from_numpy(_unloaded(columns_in_order(unloaded, chosen), contacts)),
        None if log.joint_direction is None else torch.from_numpy(columns_in_order(log.joint_direction, order)),
        has_force_normal=log.contact_force_normal is not None,
        stribeck=None if log.joint_stribeck is None else torch.from_numpy(columns_in_order(log.joint_stribeck, order)),
        motion_noise=bind_motion_noise(log, order, robot.fixed_base, imu),
        noise_share=log.noise_share,
        resting=None if log.joint_rests is None else torch.from_numpy(columns_in_order(log.joint_rests, order)),
    )
    if required is not None:
        log_joints.require_limb_sensors(log, robot, required)
        require_forces(samples, robot, contacts, required)
    return samples


def _with_writable_arrays(log: Log) -> Log:
    """The log with copies of arrays that are read-only, as columns of a table may be: tensors cannot share these."""
    fixed = {name: x.copy() for name, x in log.arrays().items() if not x.flags.writeable}
    return replace(log, **fixed) if fixed else log  # type: ignore[arg-type]


def _contact_normals(
    log: Log, robot: Robot, contacts: Sequence[Contact], base: BaseMotion, order: list[int], active: np.ndarray
) -> Tensor | None:
    """Normals of the ground under the contacts as recorded, (N, C, 3); None without, or if nothing depends on them."""
    grounded = [contact for contact in contacts if contact.radius or contact.along_normal]
    if not grounded:
        return None
    if base.quat_xyzw is None and not robot.fixed_base:
        first = grounded[0]
        needs = f"radius {first.radius:g} m" if first.radius else f"sensor {NORMAL_FORCE}"
        reason = f"missing, but {first.frame} ({needs}) needs the ground's normal in the base frame"
        otherwise = "radius: 0 for this contact" if first.radius else f"sensors without {NORMAL_FORCE}"
        accepted = f"base_quat_wxyz or base_quat_xyzw beside the IMU, or {otherwise}"
        raise LogError(log.source, "base_quat_xyzw", reason, accepted)
    if log.contact_normal_world is None:
        return None
    with about_file(log.source):
        labels = tuple(contact.frame for contact in contacts)
        return torch.from_numpy(normalize_normals(columns_in_order(log.contact_normal_world, order), active, labels))


def _wrenches(log: Log, contacts: Sequence[Contact], order: list[int]) -> FloatArray | None:
    """Wrenches of the contacts (N, C, 6), the force along the normal of those that are read along it; None without."""
    wrench = log.contact_wrench
    scalar = log.contact_force_normal
    along = [contact.along_normal for contact in contacts]
    if not any(along) or wrench is None and scalar is None:
        return None if wrench is None else columns_in_order(wrench, order)
    out = np.full((len(log), len(contacts), 6), np.nan) if wrench is None else wrench[:, order]
    out[:, along] = np.nan
    if scalar is not None:
        out[:, along, NORMAL_INDEX] = scalar[:, order][:, along]
    return out


def _unloaded(readings: FloatArray, contacts: Sequence[Contact]) -> FloatArray:
    """Readings in the air (N, C, 6 or 7) of the contacts, (N, C, 6), by the components that they are read along."""
    along = [contact.along_normal for contact in contacts]
    if not any(along) and readings.shape[2] == len(WRENCH_COMPONENTS):
        return readings
    out = readings[..., : len(WRENCH_COMPONENTS)].copy()
    out[:, along] = np.nan
    if readings.shape[2] > len(WRENCH_COMPONENTS):
        out[:, along, NORMAL_INDEX] = readings[:, along, -1]
    return out


def oversampling(time: FloatArray, noise_bandwidth_hz: float | None) -> float:
    """Half the sample rate of stamps (N,) [s] over the bandwidth of filtered noise, at least 1."""
    if noise_bandwidth_hz is None or len(time) < 2:
        return 1.0
    rate = 1.0 / float(np.median(np.diff(time)))
    return max(1.0, 0.5 * rate / noise_bandwidth_hz)


def _joints(log: Log, name: str, order: list[int]) -> Tensor:
    values = getattr(log, name)
    if values is None:
        raise LogError(log.source, name, "missing", FROM_PREPROCESS)
    return torch.from_numpy(columns_in_order(values, order))


def require_contacts(source: str, names: Sequence[str], contacts: Sequence[Contact]) -> None:
    """Raise LogError if a contact is missing in a log; the message names the first one."""
    missing = next((contact.frame for contact in contacts if contact.frame not in names), None)
    if missing is not None:
        raise LogError(source, "contact_names", f"contact '{missing}' missing", "all contacts of the experiment")


def _contacts(log: Log, robot: Robot, contacts: Sequence[Contact]) -> tuple[list[int], np.ndarray]:
    """Columns of the log's contacts in the experiment's order, and their activity (N, C)."""
    frames = [contact.frame for contact in contacts]
    for column, name in enumerate(log.contact_names):
        with about_file(log.source):
            robot.link(name, "contact_names")
        if name not in frames and log.contact_active is not None and log.contact_active[:, column].any():
            raise LogError(log.source, f"contact_names '{name}'", "active, but not a contact of the experiment",
                           f"{{frame: {name}, type: ...}} in contacts")  # fmt: skip
    require_contacts(log.source, log.contact_names, contacts)
    order = [log.contact_names.index(frame) for frame in frames]
    if frames and log.contact_active is None:
        raise LogError(log.source, "contact_active", "missing", ACTIVE)
    if log.contact_active is None:
        return order, np.zeros((len(log), 0), dtype=bool)
    return order, columns_in_order(log.contact_active, order)


def require_forces(samples: Samples, robot: Robot, contacts: Sequence[Contact], required: SensorSet) -> None:
    """Refuse samples in which a value of the required sensors was not recorded.

    Raises:
        LogError: names the sensor and the sample.
    """
    if required.torque.any():
        torques = required.torque[: robot.n].any()
        if samples.torque is None:
            field = "joint_torque" if torques else "ft_wrench"
            raise LogError(samples.source, field, "missing", f"the field, or sensors without {field.replace('_', ' ')}")
        bad = ~torch.isfinite(samples.torque) & torch.from_numpy(required.torque)
        if bad.any():
            sample, dof = torch.nonzero(bad)[0].tolist()
            reason = f"not a finite number at sample {sample} (in {format_count(int(bad[:, dof].sum()), 'sample')})"
            reason = "NaN in all samples of the fit" if bad[:, dof].all() else reason
            field = "ft_wrench" if dof >= robot.n else "joint_torque"
            raise LogError(samples.source, f"{field} '{robot.dof_names[dof]}'", reason, _AS_MEASURED)
    needed = recorded_components(contacts, required, samples.wrench_in_world)
    if needed.any() and samples.active.any():
        if samples.wrench is None:
            accepted = "contact_wrench_local or contact_wrench_world"
            if samples.has_force_normal:
                accepted += f", or sensors.contact_wrenches: {{FRAME: [{NORMAL_FORCE}]}} to use {FORCE_NORMAL}"
            raise LogError(samples.source, "contact_wrench", "missing", accepted)
        bad = ~torch.isfinite(samples.wrench) & torch.from_numpy(needed) & samples.active[..., None]
        if bad.any():
            sample, contact, k = torch.nonzero(bad)[0].tolist()
            if contacts[contact].along_normal:
                raise _scalar_error(samples, contacts[contact].frame, sample, k)
            reason = f"{WRENCH_COMPONENTS[k]} is not a finite number at sample {sample}, during contact"
            field = f"contact_wrench '{contacts[contact].frame}'"
            raise LogError(samples.source, field, reason, _AS_MEASURED)


def _scalar_error(samples: Samples, frame: str, sample: int, k: int) -> LogError:
    """What is missing of a contact that is read along the ground's normal."""
    field = f"{FORCE_NORMAL} '{frame}'"
    if k != NORMAL_INDEX:
        reason = f"{WRENCH_COMPONENTS[k]} is not measured, only the force along the ground's normal"
        return LogError(samples.source, field, reason, f"sensors.contact_wrenches: {{{frame}: [{NORMAL_FORCE}]}}")
    if not samples.has_force_normal:
        return LogError(samples.source, field, "missing", f"the field, or sensors without {NORMAL_FORCE}")
    reason = f"not a finite number at sample {sample}, during contact"
    return LogError(samples.source, field, reason, _AS_MEASURED)


_MIN_ACCELERATION = 0.1 * GRAVITY  # [m/s^2] rms, of a moving base
_MOST_SAMPLES = 5_000  # evenly spaced


def is_at_rest(logs: Sequence[Samples]) -> bool:
    """Whether in none of some logs a joint or the base moves; not so without any log.

    Forces at rest tell what balances gravity, no inertia and no friction.
    """
    return bool(logs) and not any(_moves(log) for log in logs)


def _moves(log: Samples) -> bool:
    """Whether a joint of a filtered log travels, or its base turns or is shaken."""
    thin = log.every(max(1, len(log) // _MOST_SAMPLES))
    position = thin.joint_position
    base = thin.base
    if position.shape[1] and float((position.amax(dim=0) - position.amin(dim=0)).max()) > MIN_MOTION:
        return True
    if base.quat_xyzw is not None:
        cosine = (base.quat_xyzw @ base.quat_xyzw[0]).abs().clamp(max=1.0)
        if float(2.0 * torch.arccos(cosine).max()) > math.radians(MIN_TURN_DEG):
            return True
    force = base.specific_force
    if force is None:
        return False
    return float((force - force.mean(dim=0)).square().sum(dim=1).mean().sqrt()) > _MIN_ACCELERATION
