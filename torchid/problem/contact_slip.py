"""Slip: contacts that move on the ground although their flags are set, and contacts that do not move."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_opening
from torch import Tensor

from torchid.errors import warn
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import near_contact_changes
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.regressor.kinematics import rotation_matrix
from torchid.regressor.regressor import generalized_forces
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors

LEAST_LIMIT = 0.02
"""Smallest chosen limit [m/s], because soft ground creeps and a filter spreads impacts."""

_NOISES = 6.0  # standard deviations of a stance's velocity, per axis, that count as noise
_MEDIAN_SPEED = 1.538  # of a velocity whose three components have unit variance (Maxwell distribution)
_STENCIL = 3.0  # steps that a derivative looks to each side
_TOGETHER = 2048  # samples per computation of velocities
_STILL = 0.01  # m/s; below, a contact does not move (soft ground, filter)
_STILL_MEDIANS = 2.0  # times the median speed of certain contacts, which is noise


@dataclass(frozen=True)
class Slip:
    """Speed of the contacts on the ground.

    Attributes:
        speed: (N, C) [m/s], of the material point that touches the ground; NaN where unknown, in the air, or near a
            change.
        limits: (C,) [m/s]; a contact slips above.
        relative: whether speeds are relative to the other standing contacts, because the base's velocity is unknown.
        frames: of the contacts.
    """

    speed: FloatArray
    limits: FloatArray
    relative: bool
    frames: tuple[str, ...]

    @property
    def slips(self) -> BoolArray:
        """Which contacts slip, (N, C)."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.speed > self.limits)

    @property
    def checked(self) -> bool:
        """Whether any speed is known."""
        return bool(np.isfinite(self.speed).any())

    def __str__(self) -> str:
        """Number of samples in which contacts slip, by contact; "" for none."""
        named = [
            f"{frame} in {slipping.sum()} samples (up to {speed[slipping].max():.2g} m/s, limit {limit:.2g} m/s)"
            for frame, slipping, speed, limit in zip(self.frames, self.slips.T, self.speed.T, self.limits, strict=True)
            if slipping.any()
        ]
        return ", ".join(named)


def measure_slip(
    log: Log,
    samples: Samples,
    recorded: Log,
    robot: Robot,
    contacts: Sequence[Contact],
    limit: float | None = None,
    cutoff_hz: float | None = None,
    base_is_derived: bool = False,
) -> Slip:
    """Measure the speed of standing contacts on the ground.

    For a rolling contact it is the speed of the material point at the ground. With a recorded base velocity it is the
    speed in the world. Otherwise it is relative to the median of all standing contacts (the base's velocity cancels),
    from two contacts on; if two move apart, both count as moving.

    Args:
        log: preprocessed.
        samples: bound from it, one for one.
        recorded: the log with its recorded flags; samples near a change of a contact's flag do not count.
        robot: the robot.
        contacts: of the samples.
        limit: [m/s] above which a contact slips; None for six (robust) standard deviations of its velocity while it
            stands, at least `LEAST_LIMIT`.
        cutoff_hz: of the filter, which spreads a change over 1 / cutoff_hz; None for no filter.
        base_is_derived: whether the base's motion was computed from the contacts.
    """
    base = None if base_is_derived else base_velocity(log, samples)
    is_relative = base is None and not robot.fixed_base
    away = _away_from_own_changes(recorded, samples.time.cpu().numpy(), contacts, cutoff_hz)
    velocity = contact_velocities(samples, robot, contacts, base)
    velocity[~(samples.active.cpu().numpy() & away)] = np.nan
    speed = np.linalg.norm(_against_others(velocity) if is_relative else velocity, axis=2)
    if limit is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # of contacts without a known speed
            noise = np.nanmedian(speed, axis=0) / _MEDIAN_SPEED
        limits = np.where(np.isnan(noise), np.inf, np.maximum(_NOISES * noise, LEAST_LIMIT))
    else:
        limits = np.full(len(contacts), limit)
    return Slip(speed, limits, is_relative, tuple(contact.frame for contact in contacts))


def base_velocity(log: Log, samples: Samples) -> Tensor | None:
    """Velocity of the base's origin along its axes, (N, 3) [m/s]; None where it was not recorded."""
    velocity = log.base_linear_velocity_world
    quat = samples.base.quat_xyzw
    if velocity is None or quat is None:
        return None
    return (rotation_matrix(quat).mT @ torch.as_tensor(velocity).to(quat)[..., None])[..., 0]


def contact_velocities(samples: Samples, robot: Robot, contacts: Sequence[Contact], base: Tensor | None) -> FloatArray:
    """Velocities of the contacts' material points along the base's axes, (N, C, 3) [m/s].

    Args:
        samples: N of them.
        robot: the robot.
        contacts: of the samples.
        base: velocity of the base's origin along its axes, (N, 3) [m/s]; None for one at rest.
    """
    plain = [dataclasses.replace(contact, along_normal=False) for contact in contacts]  # by the axes of their frames
    builder = RowBuilder(robot, plain, named_sensors("full", robot.n, len(contacts), ft=len(robot.ft_names)))
    tree = builder.tree
    out = np.empty((len(samples), len(builder.contacts), 3))
    for start in range(0, len(samples), _TOGETHER):
        part = samples[start : start + _TOGETHER]
        kinematics = builder.kinematics(part)
        v = torch.nn.functional.pad(part.joint_velocity, (0, tree.n_dofs - tree.n))  # sensors in limbs do not move
        if tree.base_rows:
            linear = torch.zeros_like(v[:, :1].expand(-1, 3)) if base is None else base[start : start + _TOGETHER]
            angular = part.base.angular_velocity
            v = torch.cat([linear, torch.zeros_like(linear) if angular is None else angular, v], dim=1)
        for contact, (body, _) in enumerate(builder.frames):
            units = builder.unit_wrenches(kinematics, contact, [0, 1, 2])
            joints = builder.columns.joints_above(body)
            rows = builder.columns.rows_above(body)
            forces = generalized_forces(tree, kinematics.screw_axes, body, units, joints)  # (3, rows, B)
            along_frame = (forces * v.T[rows]).sum(1)
            velocity = (units[:3] * along_frame).sum(1)  # of a unit force the first three are the frame's axis
            out[start : start + len(part), contact] = velocity.T.cpu().numpy()
    return out


def _away_from_own_changes(
    recorded: Log, time: FloatArray, contacts: Sequence[Contact], cutoff_hz: float | None
) -> BoolArray:
    """Which contacts are away from changes of their own recorded flag, at stamps (N,) [s], (N, C)."""
    away = np.ones((len(time), len(contacts)), dtype=bool)
    margin = _STENCIL * float(np.median(np.diff(recorded.time))) + (0.0 if cutoff_hz is None else 1.0 / cutoff_hz)
    if recorded.contact_active is None:
        return away
    for index, contact in enumerate(contacts):
        if contact.frame in recorded.contact_names:
            flags = recorded.contact_active[:, [recorded.contact_names.index(contact.frame)]]
            alone = dataclasses.replace(recorded, contact_active=np.repeat(flags, len(recorded.contact_names), axis=1))
            away[:, index] = ~near_contact_changes(alone, time, margin)
    return away


def warn_of_slip(slip: Slip, source: str) -> None:
    """Warn about dropped samples in which contacts slip, or that slip cannot be checked."""
    slipping = slip.slips.any(axis=1)
    if not slip.checked:
        needed = "The check needs the base's linear velocity, or two contacts that stand at the same time"
        warn(f"{source}: contact slip is not checked. {needed}")
    elif slipping.any():
        count = f"{int(slipping.sum())} of {len(slip.speed)} samples dropped because contacts slip"
        warn(f"{source}: {count}: {slip}. To keep these samples, set preprocessing.max_slip: null")


def _against_others(velocity: FloatArray) -> FloatArray:
    """Velocities (N, C, 3) relative to the other standing contacts; NaN in the air and for a single one."""
    count = np.isfinite(velocity[:, :, 0]).sum(axis=1)
    out = np.full_like(velocity, np.nan)
    two = count == 2
    more = count > 2
    if more.any():
        out[more] = velocity[more] - np.nanmedian(velocity[more], axis=1, keepdims=True)
    if two.any():
        out[two] = 2.0 * (velocity[two] - np.nanmean(velocity[two], axis=1, keepdims=True))
    return out


def keep_still(
    velocity: FloatArray, in_world: bool, standing: BoolArray, possible: BoolArray, shortest: int
) -> BoolArray:
    """Which possible contacts move no faster than certain ones for at least `shortest` samples, (N, C).

    Args:
        velocity: of the contacts (N, C, 3) [m/s], from `contact_velocities`.
        in_world: whether this is the velocity in the world (recorded base velocity); otherwise speeds are relative to
            the median of the other certain contacts.
        standing: certain contacts, (N, C).
        possible: possible contacts, (N, C).
        shortest: number of successive samples.
    """
    speed = np.linalg.norm(velocity if in_world else _against_standing(velocity, standing), axis=2)
    noise = speed[standing & np.isfinite(speed)]
    limit = max(_STILL, _STILL_MEDIANS * float(np.median(noise))) if len(noise) else _STILL
    with np.errstate(invalid="ignore"):
        still = (speed < limit) & possible
    return np.asarray(binary_opening(still, np.ones((max(shortest, 1), 1), dtype=bool)))


def _against_standing(velocity: FloatArray, standing: BoolArray) -> FloatArray:
    """Velocities (N, C, 3) relative to the median of the other standing contacts; NaN without any."""
    out = np.full_like(velocity, np.nan)
    for contact in range(velocity.shape[1]):
        others = np.where(standing[:, :, None], velocity, np.nan)
        others[:, contact] = np.nan
        known = np.isfinite(others[:, :, 0]).any(axis=1)
        out[known, contact] = velocity[known, contact] - np.nanmedian(others[known], axis=1)
    return out
