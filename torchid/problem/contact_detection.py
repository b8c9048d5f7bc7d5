"""Which contacts stand when, from joint torques and the robot's own dynamics."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from torchid.errors import LogError
from torchid.logs import Log
from torchid.logs.flags import hysteresis, samples_of, without_short
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.spill import growing_array
from torchid.problem.contact_slip import base_velocity, contact_velocities
from torchid.problem.detection_motion import Prepared, prepare
from torchid.problem.predict import force_series
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, concatenate
from torchid.problem.still_contacts import keep_still
from torchid.regressor import FrameJacobian
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors
from torchid.settings import NotNegative, Positive

GRAVITY = -GRAVITY_WORLD[2]
_DAMPING = 1e-3  # of actuators' terms, against the share that samples have of them
_LARGEST = 1.0, 100.0, 100.0  # armature [kg m^2] and friction [N m, N m s/rad] that nothing determines
_SIGN_WIDTH = 0.001  # rad/s, below which friction is not sure of its sign
_FITTED = 4000  # samples, at least half of them, from which actuators' terms are worked out
_TOGETHER = 2048  # samples whose forces are solved for at once
_JOINT_SHARE, _BASE_SHARE = 0.1, 1.0  # errors of the URDF and of friction, of the largest torque's rms and the weight
_LEVER_M = 0.3  # arm of the base's moments for a force of the size of its errors
_FREE = 10.0  # standard deviation of a contact force that nothing determines, in weights


@dataclass(config=ConfigDict(extra="forbid"), frozen=True)
class DetectionConfig:
    """How contacts are detected.

    A contact stands from where its normal force exceeds `touch` until it is below `lift`, shares of the robot's
    weight by the URDF. Where the base's motion was measured, it stands also while it carries more than `light` and
    keeps still, for twice `shortest_s` at least. Torques are low-pass filtered before (`cutoff_hz`, zero phase);
    stances and swings shorter than `shortest_s` [s] are none. Samples within `margin_s` [s] of a change are dropped, as
    are those within `preprocessing.contact_margin_s`.
    """

    touch: Positive = 0.02
    lift: NotNegative = 0.015
    light: NotNegative = 0.005
    cutoff_hz: Positive = 20.0
    shortest_s: NotNegative = 0.04
    margin_s: NotNegative = 0.02


def with_detected_contacts(
    log: Log, robot: Robot, contacts: Sequence[Contact], settings: DetectionConfig | None = None
) -> tuple[Log, BoolArray]:
    """The log with flags of all contacts by `detect_contacts` in the place of what it has, and where they are certain.

    Raises:
        LogError: as `detect_contacts`; wrenches without the name of a contact.
    """
    active, certain = detect_contacts(log, robot, contacts, settings or DetectionConfig())
    bare = log.contact_wrench is None and log.contact_force_normal is None and log.contact_normal_world is None
    names, flags = name_flags(log.source, () if bare else log.contact_names, contacts, active)
    return dataclasses.replace(log, contact_names=names, contact_active=flags), certain


def name_flags(
    source: str, names: tuple[str, ...], contacts: Sequence[Contact], active: BoolArray
) -> tuple[tuple[str, ...], BoolArray]:
    """Names of the contacts of a log and their flags (N, C'), of flags (N, C) of the experiment's contacts.

    Args:
        source: name of the log.
        names: of contacts of which it has readings, () without any.
        contacts: of the experiment.
        active: their flags.

    Raises:
        LogError: readings without the name of a contact.
    """
    frames = tuple(contact.frame for contact in contacts)
    if not names:
        return frames, active
    if missing := [frame for frame in frames if frame not in names]:
        raise LogError(source, "contact_names", f"contact '{missing[0]}' missing", "every contact of the experiment")
    flags = np.zeros((len(active), len(names)), dtype=bool)
    flags[:, [names.index(frame) for frame in frames]] = active
    return names, flags


class Detection(NamedTuple):
    """Which contacts stand.

    Attributes:
        active: (N, C).
        certain: samples (N,) that a fit may trust: neither those at both ends of a log, which the filter spoils, nor
            stances that were too short to count.
    """

    active: BoolArray
    certain: BoolArray


def detect_contacts(log: Log, robot: Robot, contacts: Sequence[Contact], settings: DetectionConfig) -> Detection:
    """Which contacts stand when.

    Args:
        log: as recorded, with the torques of all joints above the contacts.
        robot: the robot, whose base floats.
        contacts: that may stand.
        settings: thresholds.

    Raises:
        LogError: no torques, fewer than three of joints above a contact, or joints that are missing.
        InputError: a cutoff that does not suit the log.
    """
    if not contacts:
        return Detection(np.zeros((len(log), 0), dtype=bool), np.ones(len(log), dtype=bool))
    whole = prepare(log, robot, contacts, settings.cutoff_hz)
    return detect_in_parts(lambda: [whole], whole.log.time, log.time, robot, contacts, settings)


def detect_in_parts(
    parts: Callable[[], Iterable[Prepared]],
    time: FloatArray,
    stamps: FloatArray,
    robot: Robot,
    contacts: Sequence[Contact],
    settings: DetectionConfig,
    folder: Path | None = None,
) -> Detection:
    """As `detect_contacts`, of a log that is prepared in successive parts.

    Args:
        parts: called for each of two passes.
        time: (K,) [s] of all samples of the parts.
        stamps: (N,) [s] of the log as recorded.
        robot: the robot.
        contacts: one or more.
        settings: thresholds.
        folder: with room for forces and velocities; None: in memory.
    """
    weight = GRAVITY * float(robot.nominal[:, 0].sum())
    shares, velocities = (growing_array("contacts", folder, len(time)) for _ in range(2))
    forces = _Forces.of(parts(), len(time), robot, contacts)
    in_world = moves = False
    for part in parts():
        shares.append(forces.along_normal(part) / weight)
        in_world, moves = (base := base_velocity(part.log, part.samples)) is not None, part.base_is_known
        if moves:
            velocities.append(contact_velocities(part.samples, robot, contacts, base))
    share = shares.array()
    shortest = samples_of(settings.shortest_s, time)
    loaded = np.stack([hysteresis(one, settings.touch, settings.lift) for one in share.T], axis=1)
    if moves:
        light = share > settings.light
        loaded |= keep_still(velocities.array(), in_world, loaded, light, 2 * shortest)
    flags = np.stack([without_short(one, shortest) for one in loaded.T], axis=1)
    nearest = np.searchsorted(0.5 * (time[1:] + time[:-1]), stamps)
    inside = (stamps >= time[0]) & (stamps <= time[-1])
    doubtful = np.asarray((loaded & ~flags).any(axis=1))
    return Detection(flags[nearest], inside & ~doubtful[nearest])


@dataclasses.dataclass(frozen=True)
class NormalForces:
    """Forces (K, C) [N] along the ground's normal at stamps (K,) [s]."""

    time: FloatArray
    force: FloatArray


def normal_forces(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float) -> NormalForces:
    """Forces of the ground along its normal by the URDF's dynamics.

    Of all wrenches of all contacts, as if each could carry, those that balance measured joint torques, gravity and
    inertia best, weighed least squares over the joints' and the base's rows. A base of which neither pose nor IMU was
    recorded counts as still, and tilted as if all feet stood.

    Args:
        log: as recorded, with joint torques.
        robot: the robot, whose base floats.
        contacts: that may stand.
        cutoff_hz: of the filter [Hz], lower where the log is slow.

    Raises:
        InputError: no torques, fewer than three of joints above a contact, joints that are missing, or as `preprocess`.
    """
    whole = prepare(log, robot, contacts, cutoff_hz)
    forces = _Forces.of([whole], len(whole.log), robot, contacts)
    return NormalForces(whole.log.time, forces.along_normal(whole))


@dataclasses.dataclass(frozen=True)
class _Forces:
    """Forces along the ground's normal, with the armature and friction (m, 3) of the log's joints."""

    balance: _Balance
    actuators: FloatArray

    @classmethod
    def of(cls, parts: Iterable[Prepared], count: int, robot: Robot, contacts: Sequence[Contact]) -> _Forces:
        """Of the parts of a log of so many samples."""
        every, start, power, chosen = -(-count // _FITTED), 0, np.zeros(robot.n), list[tuple[Samples, FloatArray]]()
        for part in parts:
            measured = np.full((len(part.log), robot.n), np.nan)
            if part.samples.torque is not None:
                measured = part.samples.torque[:, : robot.n].numpy()
            power = power + np.square(measured).sum(axis=0)
            some = slice(-start % every, None, every)
            chosen.append((part.samples[some], part.rotation[some]))
            start += len(part.log)
        balance = _Balance.of(robot, contacts, np.sqrt(power / count))
        samples = concatenate([samples for samples, _ in chosen])
        rotation = np.concatenate([rotation for _, rotation in chosen])
        return cls(balance, _fit_actuators([balance.equations(samples, rotation)]))

    def along_normal(self, part: Prepared) -> FloatArray:
        """Forces (K, C) [N] of some samples."""
        chosen = [slice(start, start + _TOGETHER) for start in range(0, len(part.log), _TOGETHER)]
        equations = (self.balance.equations(part.samples[x], part.rotation[x]) for x in chosen)
        return np.concatenate([self.balance.normal_forces(found, self.actuators) for found in equations])


@dataclasses.dataclass(frozen=True)
class _Balance:
    """Of which rows, with which standard deviations (rows,) [N, N m], contact forces are worked out."""

    robot: Robot
    contacts: Sequence[Contact]
    builder: RowBuilder
    rows: BoolArray
    error: FloatArray
    weight: float

    @classmethod
    def of(cls, robot: Robot, contacts: Sequence[Contact], torque_rms: FloatArray) -> _Balance:
        """Of the base, and the joints whose torques were measured throughout: those with an rms (n,) [N m]."""
        measured = np.isfinite(torque_rms)
        rows = np.concatenate([np.ones(6, dtype=bool), measured])
        weight = GRAVITY * float(robot.nominal[:, 0].sum())
        of_joints = _JOINT_SHARE * float(torque_rms[measured].max(initial=0.0)) + 1e-6 * weight
        of_base = _BASE_SHARE * weight * np.array([1.0, 1.0, 1.0, _LEVER_M, _LEVER_M, _LEVER_M])
        error = np.concatenate([of_base, np.full(int(rows[6:].sum()), of_joints)])
        plain = [dataclasses.replace(contact, along_normal=False) for contact in contacts]
        builder = RowBuilder(robot, plain, named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names)))
        return cls(robot, plain, builder, rows, error, weight)

    def equations(self, samples: Samples, rotation: FloatArray) -> _Equations:
        """Of some samples, with rotations (M, 3, 3) of the base to the world."""
        n = 6 + self.robot.n
        _, predicted = force_series(self.builder, samples, self.robot.nominal.flatten()[None])
        q, _, _ = samples.coordinates()
        poses = self.robot.link_poses(samples.joint_position)
        missing = predicted[0, :, :n].copy()
        missing[:, 6:] -= np.zeros(1) if samples.torque is None else samples.torque[:, : self.robot.n].numpy()
        maps, normals = [], []
        for contact in self.contacts:
            normal = torch.tensor(contact.normal, dtype=torch.float64)
            J = FrameJacobian(self.robot, contact.frame, contact.radius, contact.rolling_axis)(q, normal).numpy()
            maps.append(J[:, list(contact.components), :n][:, :, self.rows])
            to_frame = (rotation @ poses[contact.frame][:, :3, :3].numpy()).swapaxes(1, 2)
            normals.append(to_frame @ np.array(contact.normal))
        A = np.asarray(np.concatenate(maps, axis=1).swapaxes(1, 2) / self.error[:, None], dtype=np.float64)
        free = np.concatenate([_free(contact) for contact in self.contacts]) / (_FREE * self.weight)
        solver = np.linalg.solve(A.swapaxes(1, 2) @ A + np.diag(free**2), A.swapaxes(1, 2))
        velocity, acceleration = samples.joint_velocity.numpy(), samples.joint_acceleration.numpy()
        terms = np.stack([acceleration, np.tanh(velocity / _SIGN_WIDTH), velocity], axis=2)[:, self.rows[6:]]
        return _Equations(
            A,
            missing[:, self.rows] / self.error,
            np.asarray(solver, dtype=np.float64),
            terms / self.error[6:, None],
            normals,
        )

    def normal_forces(self, found: _Equations, actuators: FloatArray) -> FloatArray:
        """Normal forces (M, C) [N], with armature and friction (m, 3) of the joints whose torque was measured."""
        missing = found.missing.copy()
        missing[:, 6:] += (found.terms * actuators).sum(axis=2)
        solved = (found.solver @ missing[..., None])[..., 0]
        ends = np.cumsum([len(contact.components) for contact in self.contacts])[:-1]
        forces = [part[:, :3] for part in np.split(solved, ends, axis=1)]
        return np.stack([(f * u).sum(axis=1) for f, u in zip(forces, found.normals, strict=True)], axis=1)


@dataclasses.dataclass(frozen=True)
class _Equations:
    """Whitened balances of M samples.

    Attributes:
        maps: of the k components of contact forces to rows, (M, rows, k).
        missing: what contact forces have to make up, (M, rows).
        solver: of that to the components, (M, k, rows).
        terms: acceleration, smoothed sign of the velocity and velocity by joint whose torque was measured, (M, m, 3).
        normals: of the ground in the frame of each contact, (M, 3).
    """

    maps: FloatArray
    missing: FloatArray
    solver: FloatArray
    terms: FloatArray
    normals: list[FloatArray]


def _fit_actuators(parts: Sequence[_Equations]) -> FloatArray:
    """Armature, Coulomb and viscous friction (m, 3) by joint, from what no contact force can make up."""
    joints = parts[0].terms.shape[1]
    matrix, vector = np.zeros((joints, 3, joints, 3)), np.zeros((joints, 3))
    for part in parts:
        inside = part.maps @ part.solver
        projector = (np.eye(inside.shape[1]) - inside)[:, 6:]
        matrix += np.einsum("njk,nja,nkb->jakb", projector[:, :, 6:], part.terms, part.terms, optimize=True)
        vector -= np.einsum("nj,nja->ja", (projector @ part.missing[..., None])[..., 0], part.terms)
    flat = matrix.reshape(3 * joints, 3 * joints) + np.diag(np.tile(np.square(_LARGEST), joints) ** -1.0)
    size = np.sqrt(np.diag(flat))
    damped = flat / size / size[:, None] + _DAMPING * np.eye(len(flat))
    found: FloatArray = (np.linalg.solve(damped, vector.reshape(-1) / size) / size).reshape(joints, 3)
    return np.maximum(found, 0.0)


def _free(contact: Contact) -> FloatArray:
    """Units of a contact's components over those of a force [1, 1/m]."""
    return np.array([1.0 if k < 3 else 1.0 / _LEVER_M for k in contact.components])
