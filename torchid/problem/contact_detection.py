"""Detection of standing contacts from joint torques and the robot's dynamics.

A log is filtered (`prepare`). Ground forces follow from its torques and dynamics (`ForcesAlongNormals`). Thresholds on
these decide which contacts stand (`detect_contacts`). Parameters fitted to the log then refine both.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass
from scipy.spatial.transform import Rotation

from torchid import distributed
from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import Log
from torchid.logs.flags import beside_changes, hysteresis, samples_of, without_short
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import find_unloaded, preprocess
from torchid.logs.timeline import JITTER
from torchid.parameters import FRICTION, GRAVITY, PER_BODY
from torchid.problem.base_pose import base_pose_from_feet, levelled
from torchid.problem.compression import compress_parts
from torchid.problem.contact_slip import base_velocity, contact_velocities, keep_still
from torchid.problem.elimination import assemble
from torchid.problem.extras import ExtraTerms
from torchid.problem.linear import PRIOR_DEVIATION, LinearProblem
from torchid.problem.log_joints import joint_order
from torchid.problem.metrics import force_series
from torchid.problem.motion import BaseMotion, base_motion
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples, require_contacts
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.rounding import STD_PER_MAD
from torchid.sensing import Contact, named_sensors
from torchid.settings import STRICT, NotNegative, Positive

_SUPPORTED = 0.25  # fraction of the weight that contact forces may not balance in samples for the fit
_LEAST_FITTED = 100  # samples
_DEVIATIONS = 3.0  # of the apparent load of feet in the air: lower limit of the thresholds
_LOWEST = 0.01  # of the stated thresholds
_FITS = 3  # of parameters, at most
_LESS = 0.9  # a further fit must reduce the apparent load of feet in the air to this fraction
_DAMPING = 1e-3  # of actuator terms, relative to their information in the samples
_LARGEST = 1.0, 100.0, 100.0  # bounds of undetermined armature [kg m^2] and friction [N m, N m s/rad]
_SIGN_WIDTH = 0.001  # rad/s, default width of friction's sign, so that joints at rest have no friction
_FITTED = 4000  # samples (at least half of them) for the fit of actuator terms
_TOGETHER = 2048  # samples per solve
_JOINT_SHARE = 0.1  # errors of the URDF and of friction, as a fraction of the largest torque's rms
_BASE_SHARE = 1.0  # the same, as a fraction of the weight
_LEVER_M = 0.3  # lever arm of the errors of the base moment
_FREE = 10.0  # standard deviation of an undetermined contact force, in weights
_RATE_SHARE = 0.2  # of the sample rate: highest cutoff
_MAX_GAPS = 0.05  # fraction of missing torque samples that are interpolated
_FEWEST_TORQUES = 3  # above a contact, one for each component of a force


@dataclass(config=STRICT, frozen=True)
class DetectionConfig:
    """Settings of contact detection.

    A contact stands when its normal force exceeds `touch`, until it falls below `lift` (fractions of the URDF's
    weight). With a measured base motion, it also stands while it carries more than `light` and does not move, for at
    least twice `shortest_s`. Torques are low-pass filtered (`cutoff_hz`, zero phase). Stances and swings shorter than
    `shortest_s` [s] do not count. Samples within `margin_s` [s] of a change are dropped, and those within
    `preprocessing.contact_margin_s`. In all other samples, a contact that is not certainly in the air counts as
    standing: a zero force costs a few equations, an ignored force biases a fit.

    With `refit` and a known base acceleration, parameters are fitted to each log with these contacts, and detection is
    repeated. The thresholds go down in the same ratio, to three standard deviations of the apparent load of feet in the
    air. The filter gets wider, up to none, as long as its noise permits `touch`. Touches that are too short for a
    stance are dropped with their neighbouring samples. The fit is repeated as long as it reduces the apparent load in
    the air. A contact that stands in either detection counts as standing.
    """

    touch: Positive = 0.02
    lift: NotNegative = 0.015
    light: NotNegative = 0.005
    cutoff_hz: Positive = 20.0
    shortest_s: NotNegative = 0.04
    margin_s: NotNegative = 0.02
    refit: bool = True


def with_detected_contacts(
    log: Log,
    robot: Robot,
    contacts: Sequence[Contact],
    settings: DetectionConfig | None = None,
    possible: bool = False,
    sign_width: float | None = None,
) -> tuple[Log, BoolArray]:
    """Replace the flags of all contacts by those of `detect_contacts`, and mark the samples where they are certain.

    Args:
        log: as recorded.
        robot: the robot.
        contacts: that may stand.
        settings: thresholds.
        possible: as in `Detection.flags`.
        sign_width: as in `detect_contacts`.

    Raises:
        LogError: as `detect_contacts`; or wrenches without the name of a contact.
    """
    active, certain = detect_contacts(log, robot, contacts, settings or DetectionConfig(), sign_width).flags(possible)
    names = frames = tuple(contact.frame for contact in contacts)
    readings = (log.contact_wrench, log.contact_force_normal, log.contact_normal_world)
    if log.contact_names and any(x is not None for x in readings):
        require_contacts(log.source, log.contact_names, contacts)
        names = log.contact_names
        flags = active
        active = np.zeros((len(log), len(names)), dtype=bool)
        active[:, [names.index(frame) for frame in frames]] = flags
    return dataclasses.replace(log, contact_names=names, contact_active=active), certain


class Detection(NamedTuple):
    """Detected contacts.

    Attributes:
        active: (N, C), standing contacts.
        certain: samples (N,) with a reliable `active`: not at the ends of a log (filter), not near changes, not in
            stances that were too short to count.
        possible: (N, C), `active`, and contacts that may still carry a load.
        clear: samples (N,) without ends and changes (by the stated thresholds) in which no other contact carries a
            load.
    """

    active: BoolArray
    certain: BoolArray
    possible: BoolArray
    clear: BoolArray

    def flags(self, possible: bool) -> tuple[BoolArray, BoolArray]:
        """Flags (N, C) of standing or of possible contacts, and samples (N,) in which a fit may use them.

        A possible contact must not determine the base pose. But it may count as an unknown force: if the force is zero,
        only a few equations are lost.
        """
        return (self.possible, self.clear) if possible else (self.active, self.certain)


def detect_contacts(
    log: Log, robot: Robot, contacts: Sequence[Contact], settings: DetectionConfig, sign_width: float | None = None
) -> Detection:
    """Detect standing contacts.

    Args:
        log: as recorded, with the torques of all joints above the contacts.
        robot: with a floating base.
        contacts: that may stand.
        settings: thresholds.
        sign_width: over which the sign of friction changes, as in `KinematicTree` [rad/s or m/s]; narrow by default.

    Raises:
        LogError: the log has no torques, fewer than three measured joints above a contact, or lacks joints.
        InputError: the cutoff does not suit the log.
    """
    if not contacts:
        none = np.zeros((len(log), 0), dtype=bool)
        every = np.ones(len(log), dtype=bool)
        return Detection(none, every, none, every)

    filtered = partial(prepare, log, robot, contacts)
    known = filtered(min(settings.cutoff_hz, 2.0 * _RATE_SHARE * nyquist_hz(log.time)))
    forces = ForcesAlongNormals.of(known, robot, contacts, sign_width)
    seen = _Seen.of(known, forces, settings)
    detection = seen.judged()
    time = seen.time
    if settings.refit and seen.accelerates:
        detection, time = _detect_again(filtered, forces, seen, detection)
    inside = (log.time >= time[0]) & (log.time <= time[-1])
    nearest = _nearest(time, log.time)
    active, certain, possible, clear = (part[nearest] for part in detection)
    return Detection(active, inside & certain, possible, inside & clear)


def _nearest(time: FloatArray, stamps: FloatArray) -> NDArray[np.intp]:
    """Which of times (K,) in order is the nearest to each stamp (N,)."""
    return np.searchsorted(0.5 * (time[1:] + time[:-1]), stamps)


@dataclasses.dataclass(frozen=True)
class _Seen:
    """Contact information from filtered signals.

    Attributes:
        known: the signals.
        share: fraction of the weight on each contact, (K, C).
        velocity: (K, C, 3) [m/s], in the world or relative; None where unknown.
        in_world: whether it is in the world.
        settings: thresholds.
    """

    known: DetectionSamples
    share: FloatArray
    velocity: FloatArray | None
    in_world: bool
    settings: DetectionConfig

    @classmethod
    def of(cls, known: DetectionSamples, forces: ForcesAlongNormals, settings: DetectionConfig) -> _Seen:
        """What the signals say with these forces."""
        base = base_velocity(known.log, known.samples)
        velocity = None
        if known.base_is_known:
            velocity = contact_velocities(known.samples, forces.robot, forces.contacts, base)
        return cls(known, forces.of_samples(known) / forces.weight, velocity, base is not None, settings)

    @property
    def accelerates(self) -> bool:
        """Whether the acceleration of the base is known."""
        return self.known.base_is_known and self.known.acceleration_is_known

    @property
    def time(self) -> FloatArray:
        """Stamps (K,) [s]."""
        return self.known.log.time

    @property
    def smear_s(self) -> float:
        """How far [s] from a change of contact its filtered force is seen."""
        return 1.0 / self.known.cutoff_hz

    def judged(self, bounces: bool = False) -> Detection:
        """Which contacts stand; with bounces, no stance is too short to have impacts."""
        settings = self.settings
        shortest = samples_of(self.settings.shortest_s, self.time)
        loaded = np.stack([hysteresis(share, settings.touch, settings.lift) for share in self.share.T], axis=1)
        if self.velocity is not None:
            loaded |= keep_still(self.velocity, self.in_world, loaded, self.share > settings.light, 2 * shortest)
        flags = np.stack([without_short(share, shortest) for share in loaded.T], axis=1)
        pulls = np.stack([hysteresis(-share, settings.touch, settings.lift) for share in self.share.T], axis=1)
        clear = ~beside_changes(loaded if bounces else flags)
        possible = flags | loaded | pulls
        return Detection(flags, clear & ~(possible & ~flags).any(axis=1), possible, clear)

    def noise(self, in_the_air: BoolArray) -> float:
        """Standard deviation of the share that contacts seem to carry in the air (K, C); infinite of few samples."""
        if in_the_air.sum() < _LEAST_FITTED:
            return np.inf
        return STD_PER_MAD * float(np.median(np.abs(self.share[in_the_air])))

    def finer(self, in_the_air: BoolArray, is_sharp: bool) -> Detection:
        """As `judged`, with thresholds as low as the shares of contacts in the air (K, C) allow.

        Certain is what the settings' own thresholds say too: they differ from before a foot touches until it carries
        something, with an impact between. Of sharp signals feet that scuff the floor are not certain either, and have
        impacts where they carry enough; elsewhere noise would pass for them. In the air is what stands by neither,
        twice as far away as the filter lets a scuff be seen: once around, a touch that is too light to be seen at its
        beginning is left in the air.
        """
        detection = self.judged(bounces=is_sharp)
        factor = float(np.clip(_DEVIATIONS * self.noise(in_the_air) / self.settings.touch, _LOWEST, 1.0))
        lower = {name: factor * getattr(self.settings, name) for name in ("touch", "lift", "light")}
        finer = dataclasses.replace(self, settings=dataclasses.replace(self.settings, **lower)).judged()
        certain = detection.certain & finer.clear & (finer.active == detection.active).all(axis=1)
        possible = detection.possible | finer.active
        if is_sharp:
            certain &= finer.certain
            possible = ~find_unloaded(self.time, possible | finer.possible, 2.0 * self.smear_s)
        return Detection(finer.active, certain, possible, detection.clear)


def _detect_again(
    filtered: Callable[[float], DetectionSamples], forces: ForcesAlongNormals, seen: _Seen, detection: Detection
) -> tuple[Detection, FloatArray]:
    """Contacts from parameters that fit the log, and the stamps (K,) [s] of samples in which they are known.

    If a wider filter is possible, the parameters are fitted again to its signals, as long as this reduces the apparent
    load of feet in the air.

    Args:
        filtered: the log at a cutoff.
        forces: by the URDF.
        seen: with these, at the cutoff of the settings.
        detection: contacts by these.
    """
    time = seen.time
    sharp = seen.known
    lowest: float | None = None
    air, ground = (find_unloaded(time, active, seen.smear_s) for active in (detection.active, ~detection.active))
    again = _fitted(forces, detection.active, detection.certain & (air | ground).all(axis=1))
    for more in reversed(range(_FITS)):
        if again is None:
            break
        best = _sharpest(filtered, sharp, again, seen, air)
        in_the_air = air[_nearest(seen.time, best.time)]
        noise = best.noise(in_the_air)
        if lowest is not None and noise > _LESS * lowest:
            break
        time = best.time
        sharp = best.known
        lowest = noise
        is_sharp = sharp.cutoff_hz > seen.known.cutoff_hz
        detection = best.finer(in_the_air, is_sharp)
        if not is_sharp or not more:
            break
        by_urdf = ForcesAlongNormals.of(sharp, forces.robot, forces.contacts, forces.builder.tree.sign_width)
        away = find_unloaded(time, ~detection.clear[:, None], 2.0 * best.smear_s)[:, 0]
        again = _fitted(by_urdf, detection.possible, away)
    return detection, time


def _sharpest(
    filtered: Callable[[float], DetectionSamples],
    known: DetectionSamples,
    forces: ForcesAlongNormals,
    seen: _Seen,
    in_the_air: BoolArray,
) -> _Seen:
    """Signals of the widest filter (or none) whose noise permits the thresholds.

    A 20 Hz filter shows an impact 25 ms early, and does not show a foot that scuffs the floor for 5 ms.

    Args:
        filtered: the log at a cutoff.
        known: at the lowest cutoff.
        forces: with parameters that fit the log.
        seen: settings, and stamps of those in the air.
        in_the_air: contacts (K, C) that are certainly in the air.
    """
    best = _Seen.of(known, forces, seen.settings)
    highest = nyquist_hz(known.log.time)
    while best.known.cutoff_hz < highest:
        wider = _Seen.of(filtered(min(2.0 * best.known.cutoff_hz, highest)), forces, seen.settings)
        if _DEVIATIONS * wider.noise(in_the_air[_nearest(seen.time, wider.time)]) > seen.settings.touch:
            break
        best = wider
    return best


def _fitted(forces: ForcesAlongNormals, active: BoolArray, sure: BoolArray) -> ForcesAlongNormals | None:
    """Forces of the robot with parameters that fit its torques; None without enough samples.

    Only samples in which contacts carry the robot count; a belly or a rope could carry a part of its weight.

    Args:
        forces: by the URDF.
        active: contacts (K, C) that stand or may stand.
        sure: samples (K,) in which no other contact does.
    """
    kept = np.flatnonzero(sure[forces.chosen] & (forces.unexplained < _SUPPORTED * forces.weight))
    if len(kept) < _LEAST_FITTED:
        return None
    flags = torch.from_numpy(active[forces.chosen[kept]])
    samples = dataclasses.replace(forces.samples[torch.from_numpy(kept)], active=flags)
    return forces.with_parameters(*fitted_parameters(samples, forces.builder, forces.robot))


# ------------------------------------------------------------------------------------------------ filtered signals


@dataclasses.dataclass(frozen=True)
class DetectionSamples:
    """A log filtered for detection.

    Attributes:
        log: preprocessed, without contacts.
        samples: bound from it, one for one, in which all contacts stand.
        rotation: (K, 3, 3) of the base to a world with any heading.
        cutoff_hz: of the filter; half the sample rate or more means no filter.
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
    """Prepare a recorded log with joint torques for detection.

    Without a pose and an IMU, the base counts as still, with the tilt at which all feet stand.

    Args:
        log: as recorded; gaps are interpolated.
        robot: with a floating base.
        contacts: that may stand.
        cutoff_hz: of the filter [Hz]; no filter from half the log's sample rate on.

    Raises:
        InputError: the log has no torques, fewer than three measured joints above a contact, or lacks joints; also as
            `preprocess`.
    """
    if log.joint_torque is None:
        raise LogError(log.source, "joint_torque", "missing", "the field; preprocessing.detect_contacts needs it")
    is_filtered = cutoff_hz < (1.0 - JITTER) * nyquist_hz(log.time)
    with warnings.catch_warnings():  # the reader of the log already warns about noise and gaps
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


def nyquist_hz(time: FloatArray) -> float:
    """Half the sample rate [Hz] of a log with stamps (N,) [s]."""
    return 0.5 / float(np.median(np.diff(time))) if len(time) > 1 else 0.5


def _require_torques(log: Log, robot: Robot, contacts: Sequence[Contact], measured: BoolArray) -> None:
    """Raise LogError if fewer than three joints above a contact have a torque; `measured`: (n,)."""
    for contact in contacts:
        above = set[str]()
        body = robot.links[contact.frame][0]
        while (joint := robot.bodies[body].joint) is not None:
            above.add(joint.name if joint.mimic is None else joint.mimic.master)
            body = joint.parent
        of_contact = [name for name, known in zip(robot.joint_names, measured, strict=True) if known and name in above]
        if len(of_contact) < _FEWEST_TORQUES:
            reason = f"above {contact.frame}, measured only at {', '.join(of_contact) or 'no joint'}"
            accepted = f"torques of at least {_FEWEST_TORQUES} joints above each contact, for detect_contacts"
            raise LogError(log.source, "joint_torque", reason, accepted)


def _for_detection(log: Log) -> Log:
    """The log without contacts and with gaps interpolated; torque channels with many gaps become NaN."""
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
    """Approximate rotations (N, 3, 3) of the base as if all feet stood; otherwise its z axis points up."""
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
    out = values.copy()
    index = np.arange(len(values))
    for column in out.T:
        good = np.isfinite(column)
        if good.any():
            column[~good] = np.interp(index[~good], index[good], column[good])
    return out


# ---------------------------------------------------------------------------------------------- forces of the ground


@dataclasses.dataclass(frozen=True)
class ForcesAlongNormals:
    """Ground forces along the normal from the URDF's dynamics, with armature and friction (m, 3) of a log's joints.

    The wrenches of all contacts are those that balance measured joint torques, gravity and inertia best (weighted least
    squares over joint and base rows), as if every contact could stand. Without a pose and an IMU, the base counts as
    still, with the tilt at which all feet stand.

    Attributes:
        robot: with the parameters used.
        contacts: read along the axes of their frames.
        builder: of rows of the measured joints.
        rows: of the base and the joints with measured torques, (6 + n,).
        error: standard deviations of these rows [N, N m].
        weight: of the robot [N].
        actuators: armature, Coulomb and viscous friction.
        chosen: numbers (M,) of evenly spaced samples.
        samples: these samples, in which all contacts stand.
        unexplained: (M,) [N], norm of the base force that contact forces do not balance.
    """

    robot: Robot
    contacts: Sequence[Contact]
    builder: RowBuilder
    rows: BoolArray
    error: FloatArray
    weight: float
    actuators: FloatArray
    chosen: NDArray[np.intp]
    samples: Samples
    unexplained: FloatArray

    @classmethod
    def of(
        cls, known: DetectionSamples, robot: Robot, contacts: Sequence[Contact], sign_width: float | None = None
    ) -> ForcesAlongNormals:
        """From a log; `sign_width` of friction [rad/s or m/s]."""
        torque = known.samples.torque
        rms = np.full(robot.n, np.nan)
        if torque is not None:
            rms = np.sqrt(np.square(torque[:, : robot.n].numpy()).mean(axis=0))
        measured = np.isfinite(rms)
        weight = GRAVITY * float(robot.nominal[:, 0].sum())
        of_joints = _JOINT_SHARE * float(rms[measured].max(initial=0.0)) + 1e-6 * weight
        of_base = _BASE_SHARE * weight * np.array([1.0, 1.0, 1.0, _LEVER_M, _LEVER_M, _LEVER_M])
        plain = [dataclasses.replace(contact, along_normal=False) for contact in contacts]
        sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
        sensors = dataclasses.replace(sensors, torque=np.append(measured, sensors.torque[robot.n :]))
        width = _SIGN_WIDTH if sign_width is None else sign_width
        chosen = np.arange(0, len(known.log), -(-len(known.log) // _FITTED))
        forces = cls(
            robot=robot,
            contacts=plain,
            builder=RowBuilder(robot, plain, sensors, ExtraTerms(armature=True, sign_width=width)),
            rows=np.concatenate([np.ones(6, dtype=bool), measured]),
            error=np.concatenate([of_base, np.full(int(measured.sum()), of_joints)]),
            weight=weight,
            actuators=np.zeros((int(measured.sum()), 3)),
            chosen=chosen,
            samples=known.samples[torch.from_numpy(chosen)],
            unexplained=np.zeros(len(chosen)),
        )
        balance = forces._equations(forces.samples, known.rotation[chosen])
        actuators = _fit_actuators(balance)
        missing = balance.missing_with(actuators)[..., None]
        unbalanced = (missing - balance.maps @ (balance.solver @ missing))[:, :3, 0] * forces.error[:3]
        return dataclasses.replace(forces, actuators=actuators, unexplained=np.linalg.norm(unbalanced, axis=1))

    def with_parameters(self, nominal: FloatArray, armature: FloatArray) -> ForcesAlongNormals:
        """The same with other parameters (L, 12), and armatures (m,) of joints with a measured torque."""
        robot = dataclasses.replace(self.robot, nominal=nominal)
        return dataclasses.replace(self, robot=robot, actuators=np.outer(armature, [1.0, 0.0, 0.0]))

    def of_samples(self, known: DetectionSamples) -> FloatArray:
        """Forces (K, C) [N] of all samples of a log."""
        ends = np.cumsum([len(contact.components) for contact in self.contacts])[:-1]
        out = np.empty((len(known.log), len(self.contacts)))
        for start in range(0, len(out), _TOGETHER):
            part = slice(start, start + _TOGETHER)
            balance = self._equations(known.samples[part], known.rotation[part])
            wrenches = (balance.solver @ balance.missing_with(self.actuators)[..., None])[..., 0]
            by_contact = np.split(wrenches, ends, axis=1)
            for contact, (wrench, normal) in enumerate(zip(by_contact, balance.normals, strict=True)):
                out[part, contact] = (wrench[:, :3] * normal).sum(axis=1)
        return out

    def _equations(self, samples: Samples, rotation: FloatArray) -> _Balance:
        """Of some samples, with rotations (M, 3, 3) of the base to the world."""
        n = 6 + self.robot.n
        _, predicted = force_series(self.builder, samples, self.robot.nominal.flatten()[None])
        missing = predicted[0, :, :n].copy()
        missing[:, 6:] -= np.zeros(1) if samples.torque is None else samples.torque[:, : self.robot.n].numpy()
        J_C = self.builder.contact_jacobian(samples).numpy()
        maps = []
        normals = []
        for number, contact in enumerate(self.contacts):
            J = J_C[:, number]
            maps.append(J[:, list(contact.components), :n][:, :, self.rows])
            in_base = rotation.swapaxes(1, 2) @ np.array(contact.normal)
            normals.append((J[:, :3, :3] @ in_base[..., None])[..., 0])  # which turns the base's axes into the frame's
        A = np.asarray(np.concatenate(maps, axis=1).swapaxes(1, 2) / self.error[:, None], dtype=np.float64)
        free = np.concatenate([_free(contact) for contact in self.contacts]) / (_FREE * self.weight)
        solver = np.linalg.solve(A.swapaxes(1, 2) @ A + np.diag(free**2), A.swapaxes(1, 2))
        velocity = samples.joint_velocity
        acceleration = samples.joint_acceleration
        of_joints = [acceleration, self.builder.tree.coulomb_sign(velocity), velocity]
        terms = torch.stack(of_joints, dim=2).numpy()[:, self.rows[6:]]
        return _Balance(
            A,
            missing[:, self.rows] / self.error,
            np.asarray(solver, dtype=np.float64),
            terms / self.error[6:, None],
            normals,
        )


@dataclasses.dataclass(frozen=True)
class _Balance:
    """Whitened force balances of M samples.

    Attributes:
        maps: from the k components of contact forces to rows, (M, rows, k).
        missing: forces that contacts have to balance, (M, rows).
        solver: from these to the components, (M, k, rows).
        terms: acceleration, smoothed sign of the velocity and velocity of joints with a measured torque, (M, m, 3).
        normals: of the ground in the frame of each contact, (M, 3).
    """

    maps: FloatArray
    missing: FloatArray
    solver: FloatArray
    terms: FloatArray
    normals: list[FloatArray]

    def missing_with(self, actuators: FloatArray) -> FloatArray:
        """Forces that contacts have to balance, (M, rows), with armature and friction (m, 3)."""
        out = self.missing.copy()
        out[:, 6:] += (self.terms * actuators).sum(axis=2)
        return out


def _fit_actuators(balance: _Balance) -> FloatArray:
    """Armature, Coulomb and viscous friction (m, 3) by joint, from the part that contact forces cannot balance."""
    joints = balance.terms.shape[1]
    inside = balance.maps @ balance.solver
    projector = (np.eye(inside.shape[1]) - inside)[:, 6:]
    matrix = np.einsum("njk,nja,nkb->jakb", projector[:, :, 6:], balance.terms, balance.terms, optimize=True)
    vector = -np.einsum("nj,nja->ja", (projector @ balance.missing[..., None])[..., 0], balance.terms)
    flat = matrix.reshape(3 * joints, 3 * joints) + np.diag(np.tile(np.square(_LARGEST), joints) ** -1.0)
    size = np.sqrt(np.diag(flat))
    damped = flat / size / size[:, None] + _DAMPING * np.eye(len(flat))
    fitted: FloatArray = (np.linalg.solve(damped, vector.reshape(-1) / size) / size).reshape(joints, 3)
    return np.maximum(fitted, 0.0)


def _free(contact: Contact) -> FloatArray:
    """Units of a contact's components over those of a force [1, 1/m]."""
    return np.array([1.0 if k < 3 else 1.0 / _LEVER_M for k in contact.components])


_PASSES = 3  # over the variance of what the parameters leave, which settles at once


def fitted_parameters(samples: Samples, builder: RowBuilder, robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Fit parameters (L, 12) of a robot and armatures (m,) of its joints; friction and armatures are at least 0.

    Args:
        samples: with joint torques and the standing contacts.
        builder: of rows, with armatures as extra parameters.
        robot: for the prior.
    """
    with distributed.apart():  # each process has logs of its own
        assembly = assemble(compress_parts([samples], builder), builder, robot)
    phi = most_probable(assembly.problem)
    armature = np.maximum(np.concatenate(assembly.extras_at(phi)), 0.0)
    phi = phi.reshape(-1, PER_BODY)
    phi[:, FRICTION] = np.maximum(phi[:, FRICTION], 0.0)
    return phi, armature


def most_probable(problem: LinearProblem) -> FloatArray:
    """Most probable parameters (P,) given data and nominal values, with the noise estimated from the data.

    The prior is that of `PRIOR_DEVIATION`; MacKay, Bayesian Interpolation, 1992, with known width of the prior.
    """
    unit = problem.scale[problem.free] * PRIOR_DEVIATION
    A = problem.A[:, problem.free] * unit
    b = problem.b - problem.A @ problem.nominal
    information = A.T @ A
    x = np.zeros(len(unit))
    for _ in range(_PASSES):
        misfit = A @ x - b
        variance = problem.oversampling * (misfit @ misfit + problem.residual) / max(problem.rows, 1)
        x = np.linalg.lstsq(information + variance * np.eye(len(unit)), A.T @ b, rcond=None)[0]
    out = problem.nominal.copy()
    out[problem.free] += unit * x
    return out
