"""Measured forces compared with those of the URDF's parameters, and factors of torques with which these fit best."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import nnls

from torchid import parameters
from torchid.errors import TorchidWarning, join_names
from torchid.log_checks.findings import REJECTED, SUSPICIOUS, Finding, Skipped, median_step
from torchid.logs import Log
from torchid.logs.cutoff import usual_cutoff_hz
from torchid.logs.log import BoolArray, FloatArray, SignalNoise
from torchid.logs.preprocess import preprocess
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.extras import list_extras
from torchid.problem.metrics import force_series, null_space_part
from torchid.problem.motion import MIN_MOTION
from torchid.problem.samples import concatenate
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, named_sensors

#: Independent part of a torque in the projected forces, over the residual, from which on its gain is determined.
MIN_SIGNAL_RATIO = 1.0
#: The same in a joint's row, where contact wrenches are known or there are none: a correlation of 0.9.
MIN_ROW_SIGNAL_RATIO = 2.0
#: Gain that no model error explains: missing friction makes up a factor of several, a gear ratio 50 to 160.
MAX_GAIN_RATIO = 10.0
#: What dry friction may carry of the largest load where a joint stands still.
MAX_FRICTION_SHARE = 0.2
#: Factors of single torques in another unit, and the tolerance of such a factor (see `MAX_GAIN_RATIO`).
TORQUE_UNIT_FACTORS = {1e-3: "in mN m", 1e3: "in kN m"}
_UNIT_TOLERANCE_RATIO = 3.0
#: How far the factor of a reversed torque may be from -1: others are no mistake of sign.
_SIGN_TOLERANCE_RATIO = 3.0
#: Smaller singular values, over the largest, are raised to this share: the data do not determine such combinations.
_MIN_SINGULAR_VALUE_SHARE, _TINY = 1e-12, 1e-100


def _implausible_gains(gain: FloatArray, determined: BoolArray) -> BoolArray:
    """Which determined gains (m,) no model error explains."""
    return determined & ((gain < 0.0) | (np.abs(np.log(np.maximum(np.abs(gain), _TINY))) > np.log(MAX_GAIN_RATIO)))


@dataclass(frozen=True, eq=False)
class TorqueFit:
    """Factors of joint torques that fit the URDF best.

    Attributes:
        joints: numbers of the m joints whose torque was measured.
        gain: (m,) factor that each measured torque should be multiplied by.
        determined: (m,) bool, whether the data determine the gain.
        by_friction: (m,) bool, whether friction alone does, and only the gain's sign: it always resists the motion.
        scale: (m,) factor of torques that have an unknown one by the experiment; all else here is of torques with it.
        size: norm of the model's torques, in the null space of the contacts.
        misfit: norm of the difference between measured and model torques, over that.
        misfit_corrected: as `misfit`, with torques multiplied by their gain where that is determined and implausible.
    """

    joints: np.ndarray
    gain: FloatArray
    determined: BoolArray
    by_friction: BoolArray
    scale: FloatArray
    size: float
    misfit: float
    misfit_corrected: float

    @property
    def implausible(self) -> BoolArray:
        """Joints (m,) whose torque is reversed or off by more than `MAX_GAIN_RATIO`."""
        return _implausible_gains(self.gain, self.determined)

    @property
    def driving(self) -> BoolArray:
        """Joints (m,) whose friction would drive them."""
        return self.implausible & self.by_friction


def held_by_friction(samples: Sequence[Samples], torque: FloatArray) -> BoolArray:
    """Which joints (n,) stand still under a load that dry friction may carry: their torque (N, n) may be anything."""
    position = np.concatenate([part.joint_position.numpy() for part in samples])
    load = np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
    return np.asarray((np.ptp(position, axis=0) < MIN_MOTION) & (load < MAX_FRICTION_SHARE * load.max(initial=0.0)))


def fit_projected(
    builder: RowBuilder,
    samples: Sequence[Samples],
    required: FloatArray,
    torque: FloatArray,
    joints: np.ndarray,
    alike: Sequence[Sequence[int]],
) -> TorqueFit:
    """Gains by least squares in the null space of the contacts, where contact forces vanish.

    `alike`: joints that share an unknown scale.
    """
    base = builder.tree.base_rows
    passive = [row for row in builder.motors.passive if row not in joints]
    rows = [*range(base), *(base + joints), *(base + row for row in passive)]
    vectors = np.zeros((1 + len(joints), *required.shape))
    vectors[0] = required
    for index, joint in enumerate(joints):
        vectors[1 + index, :, base + joint] = torque[:, joint]
    ends = np.cumsum([len(part) for part in samples])[:-1]
    parts = np.split(vectors, ends, axis=1)
    projected = np.concatenate([null_space_part(builder, s, v) for s, v in zip(samples, parts, strict=True)], axis=1)
    projected = projected[..., rows].reshape(1 + len(joints), -1)
    y, A = projected[0], projected[1:].T
    scale = _fit_scales(y, A, [np.isin(joints, group) for group in alike])
    A = A * scale
    norms = np.linalg.norm(A, axis=0)
    norms[norms == 0.0] = 1.0
    U, values, Vh = np.linalg.svd(A / norms, full_matrices=False)
    inverse = Vh.T / np.maximum(values, max(_MIN_SINGULAR_VALUE_SHARE * values.max(initial=0.0), _TINY))
    gain = inverse @ (U.T @ y) / norms
    independent = norms / np.sqrt(np.square(inverse).sum(axis=1))  # norm of each column orthogonal to all others
    determined = independent * np.abs(gain) > MIN_SIGNAL_RATIO * np.linalg.norm(y - A @ gain)
    corrected = np.where(_implausible_gains(gain, determined), gain, 1.0)
    size = max(float(np.linalg.norm(y)), _TINY)
    misfits = (float(np.linalg.norm(y - A @ factor)) / size for factor in (np.ones(len(joints)), corrected))
    return TorqueFit(joints, gain, determined, np.zeros(len(joints), bool), scale, size, *misfits)


def _fit_scales(y: FloatArray, A: FloatArray, groups: Sequence[BoolArray]) -> FloatArray:
    """Factors (m,) of the columns of A (M, m) whose sum is nearest to y, positive, one for each group (m,), else 1."""
    scale = np.ones(A.shape[1])
    if groups:
        free = np.array(groups, float)
        best, _ = nnls(A @ free.T, y - A[:, ~np.any(groups, axis=0)].sum(axis=1))
        scale[np.any(groups, axis=0)] = (best @ free)[np.any(groups, axis=0)]
    return np.where(scale > 0.0, scale, 1.0)


def fit_single_rows(fit: TorqueFit, required: FloatArray, torque: FloatArray, velocity: FloatArray) -> TorqueFit:
    """The fit, with undetermined gains taken from the row of each joint, less the contribution of the contacts.

    Where that says nothing either, as bodies beyond are light, friction may be most of the torque and tell its sign.
    """
    gain, determined, by_friction = fit.gain.copy(), fit.determined.copy(), fit.by_friction.copy()
    for index in np.flatnonzero(~determined):
        y, x = required[:, fit.joints[index]], torque[:, fit.joints[index]]
        gain[index] = y @ x / (x @ x)
        residual = np.linalg.norm(y - gain[index] * x)
        determined[index] = abs(gain[index]) * np.linalg.norm(x) > MIN_ROW_SIGNAL_RATIO * residual
        if not determined[index] and (sign := _sign_of_friction(y, x, velocity[:, fit.joints[index]])):
            gain[index], determined[index], by_friction[index] = sign, True, True
    return replace(fit, gain=gain, determined=determined, by_friction=by_friction)


def _sign_of_friction(required: FloatArray, torque: FloatArray, velocity: FloatArray) -> float:
    """1.0 where friction is most of a torque (N,), -1.0 where that would give energy, 0.0 where it is not most of it.

    Beside it stand what the bodies require (N,), times any factor, and an offset.
    """
    terms = np.stack([np.sign(velocity), velocity, required, np.ones_like(torque)], axis=1)
    size = np.linalg.norm(terms, axis=0)
    x, *_ = np.linalg.lstsq(terms / np.where(size > 0.0, size, 1.0), torque, rcond=None)
    parts = terms / np.where(size > 0.0, size, 1.0) * x
    friction, left = parts[:, :2].sum(axis=1), torque - parts.sum(axis=1)
    others = np.linalg.norm(parts[:, 2:].sum(axis=1)) + np.linalg.norm(left)
    clear = np.linalg.norm(friction) > MIN_ROW_SIGNAL_RATIO * others
    return float(np.sign(friction @ velocity)) if clear else 0.0


def torque_findings(robot: Robot, fit: TorqueFit) -> Iterator[Finding | Skipped]:
    """Findings about single torques: sign, unit and scale."""

    def finding(name: str, severity: str, where: BoolArray, problem: str, advice: str) -> Finding:
        joints = tuple(robot.joint_names[joint] for joint in fit.joints[where])
        gains = join_names([f"{gain:.3g}" for gain in fit.gain[where]])
        text = f"{join_names(joints)}: {problem}factors that fit the {robot.format} best: {gains}"
        return Finding(name, severity, "joint_torque", text, advice, joints)

    is_reversed = fit.implausible & (fit.gain < -1.0 / _SIGN_TOLERANCE_RATIO) & (fit.gain > -_SIGN_TOLERANCE_RATIO)
    by_bodies = is_reversed & ~fit.driving
    if by_bodies.any():
        hangs = "; or robot.base_tilt, if the base is not upright" if robot.fixed_base else ""
        yield finding("sign", REJECTED, by_bodies, "reversed; ", f"reverse these torques{hangs}")
    if fit.driving.any():
        joints = tuple(robot.joint_names[joint] for joint in fit.joints[fit.driving])
        text = f"{join_names(joints)}: reversed: most of it is friction, which would drive the joint"
        advice = "reverse these torques; or positions and velocities, if these are"
        yield Finding("sign", REJECTED, "joint_torque", text, advice, joints)
    scaled = fit.implausible & ~is_reversed
    for factor, unit in TORQUE_UNIT_FACTORS.items():
        low, high = factor / _UNIT_TOLERANCE_RATIO, factor * _UNIT_TOLERANCE_RATIO
        in_unit = fit.implausible & (fit.gain > low) & (fit.gain < high)
        if in_unit.any():
            yield finding("unit", REJECTED, in_unit, f"{unit}; ", f"multiply by {factor:g}")
            scaled = scaled & ~in_unit
    if scaled.any():
        yield finding("scale", SUSPICIOUS, scaled, "", "check gear ratios, torque constants and units")
    if not fit.determined.all():
        names = join_names([robot.joint_names[joint] for joint in fit.joints[~fit.determined]])
        yield Skipped("sign of torques", f"too little in this motion but friction and noise: {names}")


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
