"""Which contacts stand when, from joint torques and the robot's own dynamics."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import Log, preprocess
from torchid.logs.flags import hysteresis, samples_of, without_short
from torchid.logs.log import BoolArray, FloatArray
from torchid.problem.base_motion import BaseMotion, base_motion
from torchid.problem.floor_pose import levelled
from torchid.problem.predict import force_series
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, joint_order
from torchid.problem.standing import stand_on_feet
from torchid.problem.still_contacts import keep_still
from torchid.regressor import FrameJacobian
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors
from torchid.settings import NotNegative, Positive

GRAVITY = -GRAVITY_WORLD[2]
_RATE_SHARE = 0.2  # of the sample rate: highest cutoff
_MAX_GAPS = 0.05  # share of a torque's samples that may be missing, and are interpolated
_FEWEST_TORQUES = 3  # above a contact, one for each component of a force
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
    frames = tuple(contact.frame for contact in contacts)
    if log.contact_wrench is None and log.contact_force_normal is None and log.contact_normal_world is None:
        return dataclasses.replace(log, contact_names=frames, contact_active=active), certain
    if missing := [frame for frame in frames if frame not in log.contact_names]:
        raise LogError(
            log.source, "contact_names", f"contact '{missing[0]}' missing", "every contact of the experiment"
        )
    flags = np.zeros((len(log), len(log.contact_names)), dtype=bool)
    flags[:, [log.contact_names.index(frame) for frame in frames]] = active
    return dataclasses.replace(log, contact_active=flags), certain


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
    weight = GRAVITY * float(robot.nominal[:, 0].sum())
    known, samples, rotation = _prepared(log, robot, contacts, settings.cutoff_hz)
    share = _normal_forces(samples, rotation, robot, contacts) / weight
    shortest = samples_of(settings.shortest_s, known.time)
    loaded = np.stack([hysteresis(one, settings.touch, settings.lift) for one in share.T], axis=1)
    if known.imu_frame or known.base_quat_xyzw is not None:
        light = share > settings.light
        loaded |= keep_still(known, samples, robot, contacts, loaded, light, 2 * shortest)
    flags = np.stack([without_short(one, shortest) for one in loaded.T], axis=1)
    nearest = np.searchsorted(0.5 * (known.time[1:] + known.time[:-1]), log.time)
    inside = (log.time >= known.time[0]) & (log.time <= known.time[-1])
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
    known, samples, rotation = _prepared(log, robot, contacts, cutoff_hz)
    return NormalForces(known.time, _normal_forces(samples, rotation, robot, contacts))


def _prepared(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float) -> tuple[Log, Samples, FloatArray]:
    """The preprocessed log, its samples, in which all contacts stand, and rotations (K, 3, 3) of the base."""
    if log.joint_torque is None:
        raise LogError(log.source, "joint_torque", "missing", "the field, from which preprocessing.detect_contacts is")
    known = _preprocessed(log, cutoff_hz)
    order = joint_order(known, robot)
    position, velocity, acceleration, torque = (
        torch.from_numpy(np.ascontiguousarray(getattr(known, f"joint_{name}")[:, order]))
        for name in ("position", "velocity", "acceleration", "torque")
    )
    _require_torques(log, robot, contacts, np.isfinite(torque.numpy()).all(axis=0))
    base, rotation = _base(known, robot, contacts)
    in_limbs = torque.new_full((len(known), robot.n_dofs - robot.n), torch.nan)
    samples = Samples(
        log.source, torch.from_numpy(known.time), position, velocity, acceleration, base,
        torch.cat([torque, in_limbs], dim=1), None, False, torch.ones(len(known), len(contacts), dtype=torch.bool),
    )  # fmt: skip
    return known, samples, rotation


def _normal_forces(samples: Samples, rotation: FloatArray, robot: Robot, contacts: Sequence[Contact]) -> FloatArray:
    """Forces (K, C) [N] along the ground's normal."""
    measured = np.zeros((0, 0)) if samples.torque is None else samples.torque[:, : robot.n].numpy()
    balance = _Balance.of(robot, contacts, measured)
    chosen = [slice(start, start + _TOGETHER) for start in range(0, len(samples), _TOGETHER)]
    every = slice(None, None, -(-len(samples) // _FITTED))
    actuators = _fit_actuators([balance.equations(samples[every], rotation[every])])
    parts = [balance.normal_forces(balance.equations(samples[x], rotation[x]), actuators) for x in chosen]
    return np.concatenate(parts)


def _require_torques(log: Log, robot: Robot, contacts: Sequence[Contact], measured: BoolArray) -> None:
    """Refuse a log in which fewer than three joints above a contact have a torque, of which measured are (n,)."""
    for contact in contacts:
        above, body = set[str](), robot.links[contact.frame][0]
        while (joint := robot.bodies[body].joint) is not None:
            above.add(joint.name if joint.mimic is None else joint.mimic.master)
            body = joint.parent
        of_contact = [name for name, known in zip(robot.joint_names, measured, strict=True) if known and name in above]
        if len(of_contact) < _FEWEST_TORQUES:
            found = f"measured at {', '.join(of_contact) or 'no joint'} alone above {contact.frame}"
            accepted = f"torques of {_FEWEST_TORQUES} joints or more above each contact, for detect_contacts"
            raise LogError(log.source, "joint_torque", found, accepted)


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
    def of(cls, robot: Robot, contacts: Sequence[Contact], torque: FloatArray) -> _Balance:
        """Of the joints whose torques (N, n) [N m] were measured throughout, and the base."""
        measured = np.isfinite(torque).all(axis=0)
        rows, torque = np.concatenate([np.ones(6, dtype=bool), measured]), torque[:, measured]
        weight = GRAVITY * float(robot.nominal[:, 0].sum())
        of_joints = _JOINT_SHARE * float(np.sqrt(np.square(torque).mean(axis=0)).max(initial=0.0)) + 1e-6 * weight
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


# ------------------------------------------------------------------------------------------------- motion of the base


def _preprocessed(log: Log, cutoff_hz: float) -> Log:
    """The log without contacts, filtered and differentiated; gaps are interpolated."""
    fields: dict[str, Any] = {name: None for name in vars(log) if name.startswith(("contact_", "ft_"))}
    fields |= {"contact_names": (), "ft_names": ()}
    filled = {
        name: _filled(np.asarray(array, dtype=np.float64))
        for name, array in log.arrays().items()
        if name.startswith(("joint_", "base_", "imu_"))
    }
    torque = filled["joint_torque"]
    broken = np.isnan(np.asarray(log.joint_torque)).mean(axis=0) > _MAX_GAPS
    filled["joint_torque"] = np.where(broken, np.nan, torque)
    rate = 1.0 / float(np.median(np.diff(log.time))) if len(log) > 1 else 1.0
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", TorchidWarning
        )  # of noise and gaps, said where the log is read for its own sake
        return preprocess(dataclasses.replace(log, **fields | filled), min(cutoff_hz, _RATE_SHARE * rate))


def _base(log: Log, robot: Robot, contacts: Sequence[Contact]) -> tuple[BaseMotion, FloatArray]:
    """Motion of the base, and its rotation (N, 3, 3) to a world with any heading."""
    zero = np.zeros((len(log), 3))
    if log.imu_frame:
        motion = base_motion(log, robot)
        if log.base_quat_xyzw is not None or motion.specific_force is None:
            return motion, _rotation(np.asarray(log.base_quat_xyzw))
        up = motion.specific_force.numpy()
        rotation = levelled(up / np.maximum(np.linalg.norm(up, axis=1, keepdims=True), np.finfo(float).tiny))
        quat = torch.from_numpy(Rotation.from_matrix(rotation).as_quat())
        return dataclasses.replace(motion, quat_xyzw=quat), rotation
    rates = log.base_angular_velocity_base, log.base_angular_acceleration_base
    rotation = _if_all_stand(log, robot, contacts) if log.base_quat_xyzw is None else _rotation(log.base_quat_xyzw)
    moved = log.base_linear_acceleration_world
    force = np.einsum("nji,nj->ni", rotation, (zero if moved is None else moved) - np.array(GRAVITY_WORLD))
    quat = Rotation.from_matrix(rotation).as_quat()
    omega, alpha = (zero if rate is None else rate for rate in rates)
    return BaseMotion(*map(torch.from_numpy, (quat, force, omega, alpha))), rotation


def _rotation(quat: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_quat(quat).as_matrix())


def _if_all_stand(log: Log, robot: Robot, contacts: Sequence[Contact]) -> FloatArray:
    """Rotations (N, 3, 3) of the base as if all feet stood, near enough for their load; else its z axis points up."""
    frames = tuple(contact.frame for contact in contacts)
    flags = np.ones((len(log), len(contacts)), dtype=bool)
    bare = Log(log.source, log.time, log.joint_names, log.joint_position, contact_names=frames, contact_active=flags)
    try:
        quat = stand_on_feet(bare, robot, contacts).log.base_quat_xyzw
    except InputError:
        quat = None
    return np.tile(np.eye(3), (len(log), 1, 1)) if quat is None else _rotation(_filled(quat))


# ------------------------------------------------------------------------------------------------------------- signals


def _filled(values: FloatArray) -> FloatArray:
    """Channels (N, k) with NaN interpolated; one that is NaN throughout stays so."""
    if not np.isnan(values).any():
        return values
    out, index = values.copy(), np.arange(len(values))
    for column in out.T:
        good = np.isfinite(column)
        if good.any():
            column[~good] = np.interp(index[~good], index[good], column[good])
    return out
