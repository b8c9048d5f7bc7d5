"""What contact detection works on: torques and motion of a log, filtered, and how its base is tilted."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import preprocess
from torchid.logs.timeline import JITTER
from torchid.problem.base_pose import base_pose_from_feet
from torchid.problem.floor_pose import levelled
from torchid.problem.log_joints import joint_order
from torchid.problem.motion import BaseMotion, base_motion
from torchid.problem.samples import Samples
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.sensing import Contact

_RATE_SHARE = 0.2  # of the sample rate: highest cutoff
_MAX_GAPS = 0.05  # share of a torque's samples that may be missing, and are interpolated
_FEWEST_TORQUES = 3  # above a contact, one for each component of a force


@dataclasses.dataclass(frozen=True)
class DetectionSamples:
    """A log that is filtered for detection.

    Attributes:
        log: preprocessed, without contacts.
        samples: bound from it, one for one, in which all contacts stand.
        rotation: (K, 3, 3) of the base to a world with any heading.
        cutoff_hz: of the filter, or half the sample rate or more where there is none.
    """

    log: Log
    samples: Samples
    rotation: FloatArray
    cutoff_hz: float

    @property
    def base_is_known(self) -> bool:
        """Whether the base's motion was recorded."""
        return bool(self.log.imu_frame) or self.log.base_quat_xyzw is not None

    @property
    def acceleration_is_known(self) -> bool:
        """Whether the base's linear acceleration was recorded, or follows from what was."""
        return bool(self.log.imu_frame) or self.log.base_linear_acceleration_world is not None


def prepare(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float) -> DetectionSamples:
    """A log as recorded, with joint torques, prepared for detection.

    A base of which neither pose nor IMU was recorded counts as still, and tilted as if all feet stood.

    Args:
        log: as recorded; gaps are interpolated.
        robot: the robot, whose base floats.
        contacts: that may stand.
        cutoff_hz: of the filter [Hz]; there is none from half the log's sample rate on.

    Raises:
        InputError: no torques, fewer than three of joints above a contact, joints that are missing, or as `preprocess`.
    """
    if log.joint_torque is None:
        raise LogError(log.source, "joint_torque", "missing", "the field, from which preprocessing.detect_contacts is")
    is_filtered = cutoff_hz < (1.0 - JITTER) * nyquist_hz(log.time)
    with warnings.catch_warnings():  # noise and gaps are warned of where the log is read for its own sake
        warnings.simplefilter("ignore", TorchidWarning)
        known = preprocess(_for_detection(log), cutoff_hz if is_filtered else None)
    order = joint_order(known, robot)
    position, velocity, acceleration, torque = (
        torch.from_numpy(np.ascontiguousarray(getattr(known, f"joint_{name}")[:, order]))
        for name in ("position", "velocity", "acceleration", "torque")
    )
    _require_torques(known, robot, contacts, np.isfinite(torque.numpy()).all(axis=0))
    base, rotation = _base(known, robot, contacts)
    in_limbs = torque.new_full((len(known), robot.n_dofs - robot.n), torch.nan)
    samples = Samples(
        known.source, torch.tensor(known.time), position, velocity, acceleration, base,
        torch.cat([torque, in_limbs], dim=1), None, False, torch.ones(len(known), len(contacts), dtype=torch.bool),
    )  # fmt: skip
    return DetectionSamples(known, samples, rotation, cutoff_hz)


def detection_cutoff_hz(cutoff_hz: float, time: FloatArray) -> float:
    """The cutoff [Hz] of a log with stamps (N,) [s]."""
    return min(cutoff_hz, 2.0 * _RATE_SHARE * nyquist_hz(time))


def nyquist_hz(time: FloatArray) -> float:
    """Half the sample rate [Hz] of a log with stamps (N,) [s]."""
    return 0.5 / float(np.median(np.diff(time))) if len(time) > 1 else 0.5


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


def _for_detection(log: Log) -> Log:
    """The log without contacts and with its gaps interpolated; torques with many are NaN throughout."""
    fields: dict[str, Any] = {name: None for name in vars(log) if name.startswith(("contact_", "ft_"))}
    fields |= {"contact_names": (), "ft_names": ()}
    filled = {
        name: _filled(np.asarray(array, dtype=np.float64))
        for name, array in log.arrays().items()
        if name.startswith(("joint_", "base_", "imu_"))
    }
    broken = np.isnan(np.asarray(log.joint_torque)).mean(axis=0) > _MAX_GAPS
    filled["joint_torque"] = np.where(broken, np.nan, filled["joint_torque"])
    return dataclasses.replace(log, **fields | filled)


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
        quat = base_pose_from_feet(bare, robot, contacts).log.base_quat_xyzw
    except InputError:
        quat = None
    return np.tile(np.eye(3), (len(log), 1, 1)) if quat is None else _rotation(_filled(quat))


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
