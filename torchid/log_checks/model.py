"""Measured forces compared with those of the URDF's parameters, on some samples of a log."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.log_checks.findings import median_step
from torchid.log_checks.torque_fit import TorqueFit, fit_projected, fit_single_rows, held_by_friction
from torchid.logs import Log
from torchid.logs.cutoff import usual_cutoff_hz
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import preprocess
from torchid.logs.signal_noise import SignalNoise
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.extras import list_extras
from torchid.problem.predict import force_series
from torchid.problem.samples import concatenate
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, named_sensors

#: Samples that are differentiated: all of a short log, `PIECES` evenly spread runs of a long one.
MAX_DIFFERENTIATED_SAMPLES, PIECES = 40000, 4
#: The same where a corrected log is tried.
MAX_TRIAL_DIFFERENTIATED_SAMPLES = 10000
#: Evenly spread samples that are compared with the model; fewer where many corrected logs are tried.
COMPARED_SAMPLES, TRIAL_SAMPLES = 800, 150
#: Misfit of the base force above which contact wrenches do not decide on the sign of a torque.
_MAX_WRENCH_MISFIT = 0.3
#: Torque below the resolution of any sensor.
MIN_TORQUE_NM = 1e-9
#: Forces that no parameters explain (flexibility, filters, shape of friction), over the rms of each kind of force.
UNMODELLED_FORCE_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Declared:
    """What an experiment says of its sensors and actuators, for which no log is to blame.

    Attributes:
        noise: standard deviations of the readings, NaN where none is stated; None: nowhere.
        terms: extra parameters that are fitted, as offsets and scales of sensors.
        delay: how much later than recorded joint torques act [s]; `AUTO`: to be found.
        finds_tilt: whether the tilt of the base is to be found.
        goes_on_without_base: whether a fit goes on where the base is lost.
    """

    noise: SensorNoise | None = None
    terms: ExtraTerms = dataclasses.field(default_factory=ExtraTerms)
    delay: float | str = 0.0
    finds_tilt: bool = False
    goes_on_without_base: bool = False

    @property
    def known_delay(self) -> float:
        """The delay [s], 0 where it is to be found."""
        return 0.0 if isinstance(self.delay, str) else self.delay


@dataclass(frozen=True, eq=False)
class ModelFit:
    """How well measured forces agree with the URDF: joint torques, and contact wrenches by their effect on the base.

    `base_force`, `base_moment`: norm of the difference over the norm of the model's; None if not measured.
    """

    torque: TorqueFit | None
    base_force: float | None
    base_moment: float | None

    @property
    def torque_misfit(self) -> float | None:
        """Misfit of the torques; implausible ones are corrected first, unless all of them are implausible."""
        fit = self.torque
        if fit is None:
            return None
        return fit.misfit if fit.implausible.sum() >= fit.determined.sum() else fit.misfit_corrected

    @property
    def implausible(self) -> int:
        """Number of torques that no model error explains."""
        return 0 if self.torque is None else int(self.torque.implausible.sum())

    @property
    def mostly_implausible(self) -> bool:
        """Whether no model error explains more than half of the torques."""
        return self.torque is not None and 2 * self.implausible > int(self.torque.determined.sum())

    @property
    def reversed(self) -> int:
        """Number of torques that are."""
        return 0 if self.torque is None else int((self.torque.implausible & (self.torque.gain < 0.0)).sum())

    @property
    def wrench_misfit(self) -> float | None:
        """The larger misfit of base force and base moment."""
        return max((part for part in (self.base_force, self.base_moment) if part is not None), default=None)

    @property
    def compared(self) -> tuple[bool, ...]:
        """Which of torques, base force and base moment were compared."""
        return tuple(part is not None for part in (self.torque, self.base_force, self.base_moment))

    @property
    def misfit(self) -> float:
        """Rms of all misfits."""
        parts = [x for x in (self.torque_misfit, self.base_force, self.base_moment) if x is not None]
        return float(np.sqrt(np.mean(np.square(parts)))) if parts else 0.0

    @property
    def largest_misfit(self) -> float:
        """That of all forces, or of the torques alone: forces that fit do not make up for torques that do not."""
        return max(self.misfit, self.torque_misfit or 0.0)


def default_cutoff_hz(log: Log) -> float:
    """The cutoff [Hz] where the user gives none."""
    return usual_cutoff_hz(1.0 / median_step(log))


def preprocess_pieces(log: Log, cutoff_hz: float, max_samples: int = MAX_DIFFERENTIATED_SAMPLES) -> list[Log]:
    """The log with velocities and accelerations; of one longer than `max_samples`, evenly spread runs of samples.

    The noise of the motion, of which no finding speaks, is not estimated.

    Raises:
        InputError: the log cannot be filtered.
    """
    count = 1 if len(log) <= max_samples else PIECES
    length = min(len(log), max_samples) // count
    starts = np.linspace(0, len(log) - length, count).astype(int)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # other findings report these
        pieces = [replace(log.select(slice(start, start + length)), motion_noise=SignalNoise({})) for start in starts]
        return [preprocess(piece, cutoff_hz) for piece in pieces]


def bind_some_samples(
    logs: Sequence[Log], robot: Robot, contacts: Sequence[Contact], count: int = COMPARED_SAMPLES
) -> list[Samples]:
    """About `count` evenly spread samples of filtered runs of a log, in one piece, whose rows are made at once.

    Raises:
        InputError: the log does not match the robot.
    """
    pieces = some_samples([bind_log(log, robot, contacts) for log in logs], count)
    return [concatenate([replace(piece, unloaded=None) for piece in pieces])]


def some_samples(logs: Sequence[Samples], count: int) -> list[Samples]:
    """About `count` evenly spread samples of logs, at least one of each."""
    most = max(1, count // max(1, len(logs)))
    return [part[torch.linspace(0, len(part) - 1, min(most, len(part))).long()] for part in logs]


LinkPoses = dict[str, torch.Tensor]
"""Poses (N, 4, 4) in the base of the robot's links, by name."""


def recorded_link_poses(log: Log, robot: Robot) -> LinkPoses:
    """Poses of the links at the samples of a log of all the robot's joints."""
    order = [log.joint_names.index(name) for name in robot.joint_names]
    return robot.link_poses(torch.from_numpy(log.joint_position[:, order]))


def same_poses(log: Log, other: Log, robot: Robot, links: Sequence[str]) -> bool:
    """Whether some links have the same poses in the base in two logs: joints beside or beyond them do not count."""
    if log.joint_position is other.joint_position and log.joint_names == other.joint_names:
        return True
    moved = {body - 1 for link in links if link in robot.links for body in robot.bodies_to(robot.links[link][0])}
    joints = np.unique(np.nonzero(robot.joint_map[0][sorted(moved)])[1])  # those that others follow among them
    names = [robot.joint_names[joint] for joint in joints]
    if not set(names) <= set(log.joint_names) & set(other.joint_names):
        return False
    own, theirs = (x.joint_position[:, [x.joint_names.index(name) for name in names]] for x in (log, other))
    return np.array_equal(own, theirs)


def without_friction(robot: Robot) -> Robot | None:
    """The robot without the friction that its file states; None if it states none."""
    nominal = robot.nominal.copy()
    nominal[:, parameters.FRICTION] = 0.0
    return replace(robot, nominal=nominal) if robot.nominal[:, parameters.FRICTION].any() else None


@dataclass(frozen=True)
class NominalModel:
    """A robot as its file has it, whose rows are laid out once for all samples in which the same torques are known.

    `declared`: what is known of the sensors; forces are compared with the unknown scales that fit best.
    """

    robot: Robot
    contacts: Sequence[Contact]
    declared: Declared = dataclasses.field(default_factory=Declared)
    _builders: dict[bytes, RowBuilder] = dataclasses.field(default_factory=dict, init=False, repr=False)

    def compare(self, samples: Sequence[Samples], least: float = np.inf) -> ModelFit:
        """Compare the forces of some samples with those of the robot's file.

        Torques are left out where the misfit is more than the `least`, whatever they say.
        """
        robot, base = self.robot, self.robot.base_rows
        measured = np.zeros(robot.n, dtype=bool)
        if all(part.torque is not None for part in samples):
            torque = np.concatenate([part.torque[:, : robot.n].numpy() for part in samples if part.torque is not None])
            measured = np.isfinite(torque).all(axis=0) & (np.abs(torque) > MIN_TORQUE_NM).any(axis=0)
        builder = self._builder(measured)
        forces = [force_series(builder, part, robot.nominal.flatten()[None]) for part in samples]
        acting, required = np.concatenate([f[0] for f in forces]), np.concatenate([f[1][0] for f in forces])
        parts = (slice(0, min(3, base)), slice(3, base))
        scales = self.declared.terms.scales
        free = "contact_force" in scales, "contact_moment" in scales
        force, moment = (_misfit(acting[:, at], required[:, at], x) for at, x in zip(parts, free, strict=True))
        fit = None
        known = [x for x in (force, moment) if x is not None]
        if measured.any() and np.square(known).sum() <= least**2 * (1 + len(known)):
            extras = list_extras(robot, self.contacts, builder.sensors, ExtraTerms(scales=scales))
            alike = [extra.dofs for extra in extras if extra.dofs and max(extra.dofs) < robot.n]
            fit = fit_projected(builder, samples, required, torque, np.flatnonzero(measured), alike)
            contact_part = acting[:, base : base + robot.n] - torque
            torque[:, fit.joints] *= fit.scale
            consistent = force is not None and force < _MAX_WRENCH_MISFIT and np.isfinite(contact_part).all()
            if (consistent or not self.contacts) and not fit.determined.all() and not robot.loops:
                velocity = np.concatenate([part.joint_velocity.numpy() for part in samples])
                fit = fit_single_rows(fit, required[:, base : base + robot.n] - contact_part, torque, velocity)
            fit = replace(fit, determined=fit.determined & ~held_by_friction(samples, torque)[fit.joints])
        return ModelFit(fit, force, moment)

    def _builder(self, measured: BoolArray) -> RowBuilder:
        """Of the rows that do not need the torques that were not measured, (n,) bool."""
        key = measured.tobytes()
        if key not in self._builders:
            robot, contacts = self.robot, self.contacts
            sensors = named_sensors("joints", robot.n, len(contacts), ft=len(robot.ft_names))
            known = np.append(measured, sensors.torque[robot.n :]) | robot.is_passive
            self._builders[key] = RowBuilder(robot, contacts, replace(sensors, torque=known))
        return self._builders[key]


def _misfit(measured: FloatArray, model: FloatArray, scaled: bool) -> float | None:
    """Norm of the difference over that of the model, over samples (N, k) that were measured; None without any.

    `scaled`: of what was measured times the factor that fits best, unless that is negative.
    """
    known = np.isfinite(measured).all(axis=1)
    size = np.linalg.norm(model[known])
    if not measured.shape[1] or not known.any() or not size > 0.0 or not measured[known].any():
        return None
    factor = float((measured[known] * model[known]).sum() / np.square(measured[known]).sum()) if scaled else 1.0
    return float(np.linalg.norm((factor if factor > 0.0 else 1.0) * measured[known] - model[known]) / size)


def deviation_builder(
    samples: Sequence[Samples], model: NominalModel, torque_noise: FloatArray | None = None
) -> RowBuilder | None:
    """Rows of the forces that are measured in all samples, with declared terms; None without any force.

    `torque_noise`: unmodelled torque of each joint (n,) [N m or N]; None for a share of all torques alike.
    """
    sensors = _measured_sensors(samples, model.robot, model.contacts, model.declared.noise, torque_noise)
    motors = (sensors.torque & ~model.robot.is_passive)[: model.robot.n]
    if not motors.any() and not sensors.wrench.any():
        return None
    return RowBuilder(model.robot, model.contacts, sensors, model.declared.terms)


def _measured_sensors(
    samples: Sequence[Samples],
    robot: Robot,
    contacts: Sequence[Contact],
    stated: SensorNoise | None,
    torque_noise: FloatArray | None,
) -> SensorSet:
    """The sensors that are read in all samples; their noise is the unmodelled force of each kind, or more if stated."""
    torque = np.zeros(robot.n_dofs, bool)
    wrench = np.zeros((len(contacts), 6), bool)
    size = 0.0
    if all(part.torque is not None for part in samples):
        values = np.concatenate([part.torque.numpy() for part in samples if part.torque is not None])[:, : robot.n]
        torque[: robot.n] = np.isfinite(values).all(axis=0) & (np.abs(values) > MIN_TORQUE_NM).any(axis=0)
        size = float(np.sqrt(np.square(values[:, torque[: robot.n]]).mean())) if torque.any() else 0.0
    if contacts and all(part.wrench is not None for part in samples):
        for k, contact in enumerate(contacts):
            known = [
                part.wrench[:, k][part.active[:, k]].numpy()[:, list(contact.components)]
                for part in samples
                if part.wrench is not None
            ]
            wrench[k, list(contact.components)] = np.isfinite(np.concatenate(known)).all()
    weight = parameters.GRAVITY * float(robot.nominal[:, parameters.MASS].sum())
    size = size or 0.1 * weight
    stated = stated or SensorNoise.of_known({})
    alike, force, moment = (max(UNMODELLED_FORCE_SHARE * x, MIN_TORQUE_NM) for x in (size, 0.5 * weight, size))
    of_joints = np.full(robot.n, alike) if torque_noise is None else np.maximum(torque_noise, MIN_TORQUE_NM)
    noise = SensorNoise(
        tuple(np.fmax(of_joints, np.broadcast_to(stated.joint_torque, robot.n)).tolist()),
        float(np.fmax(force, stated.contact_force)),
        float(np.fmax(moment, stated.contact_moment)),
    )
    return SensorSet(torque | robot.is_passive, wrench, noise)
