"""Force equations of a log, and unknowns estimated in them together with small changes of the URDF."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from torchid import parameters
from torchid.errors import TorchidWarning
from torchid.log_checks.findings import Finding, median_step
from torchid.logs import Log
from torchid.logs.cutoff import usual_cutoff_hz
from torchid.logs.log import BoolArray, FloatArray, SignalNoise
from torchid.logs.preprocess import preprocess
from torchid.logs.signal_noise import rough_noise
from torchid.parallel import one_thread
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log
from torchid.problem.chunks import chunks_by_state
from torchid.problem.linear import parameter_scale
from torchid.problem.metrics import force_series
from torchid.problem.samples import concatenate
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

#: Forces that no parameters explain (flexibility, filters, shape of friction), over the rms of each kind of force.
UNMODELLED_FORCE_SHARE = 0.05
#: Errors of a URDF, in units of `parameter_scale`: 0.1 is a mass, or an inertia, that is 15 to 20 % off.
URDF_ERROR = 0.1
#: Prior of torques that the URDF lacks, over the unmodelled force: friction, by sign and velocity, and a constant.
JOINT_TERM_SCALE = 3.0
#: The same of armature: a geared motor's inertia may be all of the torque in light limbs.
ARMATURE_SCALE = 1.0 / UNMODELLED_FORCE_SHARE
#: Prior of declared terms, over their usual size; of declared scales; of those of torques as large as required.
DECLARED_SIZES = 10.0
DECLARED_SCALE = 10.0
SCALED_TORQUE_STD = 0.3
#: Successive samples that count as one: of 240 out of ten seconds, errors of friction and flexibility are correlated.
CORRELATED_SAMPLES = 10.0
#: Samples of a log whose forces are compared, and blocks of time whose estimates must agree.
COMPARED_SAMPLES = 240
TIME_BLOCKS = 6
#: Share of an estimate that every block of time must show, and its least size in standard deviations: by chance alone
#: one in 2000 is larger, or one in a hundred logs of twenty unknowns.
MIN_BLOCK_SHARE = 0.5
MIN_STANDARD_DEVIATIONS = 3.5
#: Samples that are differentiated: all of a short log, `PIECES` evenly spread runs of a long one.
MAX_DIFFERENTIATED_SAMPLES = 10_000
PIECES = 4
#: Torque below the resolution of any sensor.
MIN_TORQUE_NM = 1e-9
_TINY = 1e-12
#: Unexplained forces without the unknowns over those with them; the same where these leave more than `MAX_LEFT`, as
#: of another robot, or where other joints have forces that no model explains.
MIN_UNEXPLAINED_RATIO = 1.25
MIN_UNEXPLAINED_RATIO_OF_ANOTHER_ROBOT = 1.5
MAX_LEFT = 1.5
#: How far the factor of a reversed torque may be from -1, and that of a unit from it.
FACTOR_TOLERANCE_RATIO = 3.0
#: Corrections of a log by its unknowns, at most, and the step after which it needs none.
_STEPS = 8
_LEAST_STEP = 2e-3


@dataclass(frozen=True, eq=False)
class Declared:
    """Noise, delay and extra terms that an experiment declares; no finding blames a log for them.

    Attributes:
        noise: standard deviations of the readings, NaN if not stated; None: none is stated.
        terms: extra parameters of the fit, such as offsets and scales of sensors.
        delay: delay of the joint torques behind their stamps [s]; `AUTO`: the fit estimates it.
        finds_tilt: whether the fit estimates the tilt of the base.
        goes_on_without_base: whether a fit continues where the base is lost.
    """

    noise: SensorNoise | None = None
    terms: ExtraTerms = dataclasses.field(default_factory=ExtraTerms)
    delay: float | str = 0.0
    finds_tilt: bool = False
    goes_on_without_base: bool = False

    @property
    def known_delay(self) -> float:
        """The delay [s], 0 if the fit estimates it."""
        return 0.0 if isinstance(self.delay, str) else self.delay


@dataclass(frozen=True, eq=False)
class NominalModel:
    """A robot with the parameters of its file, its contacts, and the declared properties of its sensors.

    Attributes:
        robot: the robot.
        contacts: of it.
        declared: declared properties of its sensors.
        reading_noise: of the torques of its joints from sample to sample, (n,) [N m or N].
        scale_std: standard deviation of the prior of declared scales.
        torque_ratio: size of the acting torques over the size of their readings.
        unknown: mask (L, 12) of inertial parameters that the file does not give.
    """

    robot: Robot
    contacts: Sequence[Contact]
    declared: Declared = dataclasses.field(default_factory=Declared)
    reading_noise: FloatArray | float = 0.0
    scale_std: float = DECLARED_SCALE
    torque_ratio: float = 1.0
    unknown: BoolArray | None = None

    @cached_property
    def phi(self) -> FloatArray:
        """Parameters (1, 12 L) without friction: values in files are arbitrary."""
        nominal = self.robot.nominal.copy()
        nominal[:, parameters.FRICTION] = 0.0
        if self.unknown is not None:
            nominal[self.unknown] = 0.0
        return nominal.flatten()[None]

    @property
    def is_bolted_arm(self) -> bool:
        """Whether the robot is a fixed-base arm without contacts and loops."""
        return self.robot.fixed_base and not self.contacts and not self.robot.loops


@dataclass(frozen=True, eq=False)
class FilteredLog:
    """Some filtered samples of a log, with their equations.

    Attributes:
        log: as it was read.
        model: robot, contacts and declared properties.
        cutoff_hz: of the filter.
    """

    log: Log
    model: NominalModel
    cutoff_hz: float

    @cached_property
    def pieces(self) -> list[Log]:
        """Runs of the log, filtered. Raises InputError: it cannot be filtered."""
        return preprocess_pieces(self.log, self.cutoff_hz)

    @cached_property
    def equations(self) -> ForceEquations | None:
        """None where no force was measured. Raises InputError: as `pieces`, or the log does not match the robot."""
        return equations_of(self.pieces, self.model)


def default_cutoff_hz(log: Log) -> float:
    """The default cutoff [Hz]."""
    return usual_cutoff_hz(1.0 / median_step(log))


def preprocess_pieces(log: Log, cutoff_hz: float, max_samples: int = MAX_DIFFERENTIATED_SAMPLES) -> list[Log]:
    """The log with velocities and accelerations; of a log with more than `max_samples`, evenly spread runs.

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
) -> Samples:
    """About `count` evenly spread samples of filtered runs of a log.

    Raises:
        InputError: the log does not match the robot.
    """
    return some_samples([bind_log(log, robot, contacts) for log in logs], count)


def some_samples(logs: Sequence[Samples], count: int = COMPARED_SAMPLES) -> Samples:
    """About `count` evenly spread samples of logs, at least one of each."""
    most = max(1, count // max(1, len(logs)))
    parts = [part[torch.linspace(0, len(part) - 1, min(most, len(part))).long()] for part in logs]
    return concatenate([replace(part, unloaded=None) for part in parts])


def equations_of(
    pieces: Sequence[Log], model: NominalModel, count: int = COMPARED_SAMPLES, builder: RowBuilder | None = None
) -> ForceEquations | None:
    """Equations of filtered runs of a log, None if no force was measured; `builder` as in `ForceEquations.of`.

    Raises:
        InputError: the log does not match the robot.
    """
    return ForceEquations.of(bind_some_samples(pieces, model.robot, model.contacts, count), model, builder)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Unknowns estimated together with small changes of the URDF.

    Attributes:
        value, spread: (k,), of the whole log, and their standard deviations.
        blocks: (TIME_BLOCKS, k), by block of time.
        without, left: unexplained forces of the best URDF near the given one, without and with the unknowns, rms in
            `UNMODELLED_FORCE_SHARE` of the forces.
    """

    value: FloatArray
    spread: FloatArray
    blocks: FloatArray
    without: float
    left: float

    @property
    def certain(self) -> BoolArray:
        """Unknowns (k,) that differ from 0 significantly."""
        return np.asarray(np.abs(self.value) > MIN_STANDARD_DEVIATIONS * self.spread)

    @property
    def steady(self) -> BoolArray:
        """Unknowns (k,) that appear in every block of time."""
        return np.asarray((self.blocks * np.sign(self.value) > MIN_BLOCK_SHARE * np.abs(self.value)).all(axis=0))

    def of(self, which: BoolArray) -> Estimate:
        """The estimate of some of the unknowns (k,)."""
        return replace(self, value=self.value[which], spread=self.spread[which], blocks=self.blocks[:, which])


@dataclass(frozen=True, eq=False)
class ReducedEquations:
    """Products of the nominal residual and the columns of k unknowns, with changes of the URDF eliminated.

    `products`: (1 + TIME_BLOCKS, 1 + k, 1 + k), of all samples and of each block of time. `rows`: number of equations.
    """

    products: FloatArray
    rows: int

    @property
    def left(self) -> float:
        """Unexplained forces without the unknowns."""
        return self._rms(float(self.products[0, 0, 0]))

    def _rms(self, squares: float) -> float:
        return float(np.sqrt(max(squares, 0.0) / max(self.rows, 1)))

    def fit(self, which: Sequence[int] | NDArray[np.intp], prior_std: FloatArray | float) -> Estimate:
        """Estimate some of the unknowns, with the standard deviations of their prior."""
        index = np.append(0, 1 + np.asarray(which, np.intp))
        precision = np.diag(CORRELATED_SAMPLES / np.square(np.broadcast_to(prior_std, len(which))))
        G = self.products[:, index[:, None], index]
        inverse = np.linalg.inv(G[:, 1:, 1:] + precision)
        x = np.einsum("bij,bj->bi", inverse, G[:, 1:, 0])
        squares = G[0, 0, 0] - 2.0 * G[0, 0, 1:] @ x[0] + x[0] @ G[0, 1:, 1:] @ x[0]
        unexplained = self._rms(float(squares))
        spread = np.sqrt(CORRELATED_SAMPLES * max(1.0, unexplained**2) * np.diag(inverse[0]))
        return Estimate(x[0], spread, x[1:], self.left, unexplained)

    def select(self, which: NDArray[np.intp]) -> ReducedEquations:
        """Equations of some of the unknowns."""
        index = np.append(0, 1 + which)
        return replace(self, products=self.products[:, index[:, None], index])

    def reverse_gains(self, gain: FloatArray, applied: FloatArray | float = 1.0) -> FloatArray:
        """Gains (k,) of the reverse regression, with all errors in the columns (Frisch, 1934).

        `applied`: gains already applied to the readings.

        The true gains are between these and those of `fit`; both differ much if unmodelled friction or armature explain
        the readings.
        """
        whole = np.eye(len(gain) + 1)
        whole[1:, 0] = applied  # what the gains make up: unknowns are gains less 1
        G = whole.T @ self.products[0] @ whole
        inverse = np.linalg.inv(G + _TINY * np.trace(G) / len(G) * np.eye(len(G)))
        with np.errstate(divide="ignore"):
            reverse = -np.diag(inverse)[1:] / inverse[0, 1:]
        return np.where(inverse[0, 1:] * gain < 0.0, reverse, np.copysign(np.inf, gain))


@dataclass(frozen=True, eq=False)
class ForceEquations:
    """Whitened equations of some samples: the residual of the URDF, and columns of its possible changes.

    Attributes:
        model, builder, samples: their source.
        W: (N, n_rows, r) bases of the rows.
        K: (N, r, P) columns of parameters, friction and armature, in standard deviations of their prior.
        constants: (N, r, n) the same of constant torques.
        target: (N, r) residual of the nominal parameters.
        rows: number of equations.
    """

    model: NominalModel
    builder: RowBuilder
    samples: Samples
    W: FloatArray
    K: FloatArray
    constants: FloatArray
    target: FloatArray
    rows: int

    @classmethod
    @torch.no_grad()
    def of(cls, samples: Samples, model: NominalModel, builder: RowBuilder | None = None) -> ForceEquations | None:
        """The equations of the forces that were measured in all samples, None without any.

        `builder`: its layouts and noise are used again if the same forces were measured.
        """
        sensors = _measured_sensors(samples, model)
        if not (sensors.torque & ~model.robot.is_passive)[: model.robot.n].any() and not sensors.wrench.any():
            return None
        if builder is None or not _measures_alike(builder.sensors, sensors):
            builder = RowBuilder(model.robot, model.contacts, sensors, model.declared.terms)
        rows = np.zeros((len(samples), builder.tree.n_rows, builder.width + 1))
        W = np.zeros((len(samples), builder.tree.n_rows, builder.tree.n_rows))
        with one_thread():
            for state, index in chunks_by_state(samples):
                numbers = index if isinstance(index, slice) else index.numpy()
                rows[numbers], W[numbers] = (x.numpy() for x in builder.rows_by_sample(samples[index], state))
        used = np.asarray(np.abs(W).any(axis=1))
        kept = used.any(axis=0)
        rows = rows[:, kept]
        W = W[:, :, kept]
        rate = samples.joint_velocity
        torque_rows = W[:, builder.tree.base_rows :][:, : model.robot.n]
        terms = [
            _joint_term(torque_rows, torch.sign(rate), JOINT_TERM_SCALE),
            _joint_term(torque_rows, rate, JOINT_TERM_SCALE),
            _joint_term(torque_rows, samples.joint_acceleration, ARMATURE_SCALE),
        ]
        K = np.concatenate([rows[..., :-1] @ _prior_columns(builder, samples, model), *terms], axis=2)
        target = rows[..., :-1] @ builder.to_columns(model.phi)[0].numpy() - rows[..., -1]
        constants = _joint_term(torque_rows, torch.ones_like(rate), JOINT_TERM_SCALE)
        return cls(model, builder, samples, W, K, constants, target, int(used.sum()))

    @cached_property
    def unexplained(self) -> float:
        """Unexplained forces of the best URDF near the given one, rms in `UNMODELLED_FORCE_SHARE` of the forces."""
        A, b = self._all_that_may_differ
        projected = A.T @ b
        squares = b @ b - projected @ np.linalg.solve(A.T @ A + CORRELATED_SAMPLES * np.eye(A.shape[1]), projected)
        return float(np.sqrt(max(float(squares), 0.0) / max(self.rows, 1)))

    @property
    def _all_that_may_differ(self) -> tuple[FloatArray, FloatArray]:
        """Columns (N r, P + n) of the URDF's possible changes, and the residual of the nominal parameters, (N r,)."""
        K = np.concatenate([self.K, self.constants], axis=2)
        return K.reshape(-1, K.shape[2]), self.target.reshape(-1)

    @property
    def required(self) -> FloatArray:
        """Forces (N, n_rows) that the nominal parameters need."""
        return self.required_of(self.samples)

    def required_of(self, samples: Samples) -> FloatArray:
        """Forces (N, n_rows) that the nominal parameters need in other samples."""
        return np.asarray(force_series(self.builder, samples, self.model.phi)[1][0])

    @cached_property
    def _inverses(self) -> dict[bool, tuple[FloatArray, list[FloatArray]]]:
        return {}

    def _differing(self, constants: bool) -> tuple[FloatArray, list[FloatArray]]:
        """Columns of the URDF's possible changes, and inverse normal matrices of all samples and of each block."""
        if constants not in self._inverses:
            K = np.concatenate([self.K, self.constants], axis=2) if constants else self.K
            parts = [K[block].reshape(-1, K.shape[2]) for block in self._blocks]
            products = [A.T @ A for A in parts]
            regular = CORRELATED_SAMPLES * np.eye(K.shape[2])
            self._inverses[constants] = (
                K,
                [np.asarray(np.linalg.inv(H + regular), np.float64) for H in (sum(products), *products)],
            )
        return self._inverses[constants]

    @property
    def _blocks(self) -> list[NDArray[np.intp]]:
        return np.array_split(np.arange(len(self.target)), TIME_BLOCKS)

    def reduced(self, columns: FloatArray, constants: bool = True) -> ReducedEquations:
        """Equations of unknowns with columns (N, n_rows, k); `constants`: with constant torques as further unknowns."""
        Y = np.concatenate([self.target[..., None], np.einsum("nvr,nvk->nrk", self.W, columns)], axis=2)
        K, inverses = self._differing(constants)
        products = []
        for block in self._blocks:
            A = K[block].reshape(-1, K.shape[2])
            B = Y[block].reshape(-1, Y.shape[2])
            products.append((A.T @ B, B.T @ B))
        whole = tuple(np.sum([product[i] for product in products], axis=0) for i in range(2))
        reduced = [G - C.T @ inverse @ C for (C, G), inverse in zip((whole, *products), inverses, strict=True)]
        return ReducedEquations(np.array(reduced), self.rows)

    def _deviations(self) -> FloatArray:
        """The best fitting changes of the URDF, (P + n,), in standard deviations of their prior."""
        A, b = self._all_that_may_differ
        return np.asarray(np.linalg.solve(A.T @ A + CORRELATED_SAMPLES * np.eye(A.shape[1]), A.T @ b), np.float64)

    def torque_ratio(self) -> float:
        """Size of the torques that the nominal parameters need over the size of the readings, where both are known."""
        n = self.model.robot.n
        base = self.builder.tree.base_rows
        readings = np.nan_to_num(self.builder.recorded_torque(self.samples)[:, :n].numpy())
        read = np.einsum("njr,nj->nr", self.W[:, base : base + n], readings)
        size = float(np.linalg.norm(read))
        return float(np.linalg.norm(self.target + read)) / size if size > 0.0 else 1.0

    def residuals(self) -> FloatArray:
        """Residual of each equation for the best URDF near the given one, (N, r)."""
        A, b = self._all_that_may_differ
        return np.asarray((b - A @ self._deviations()).reshape(self.target.shape))

    def declared_torque_scales(self) -> FloatArray:
        """Factors (n,) that make a fixed-base arm's torques with a declared unknown scale as large as required."""
        n = self.model.robot.n
        readings = np.nan_to_num(self.builder.recorded_torque(self.samples)[:, :n].numpy())
        required = self.required
        factor = np.ones(n)
        for extra in self.builder.extras:
            joints = list(extra.dofs)
            if extra.what == "scale" and joints:
                sizes = np.linalg.norm(required[:, joints]), np.linalg.norm(readings[:, joints])
                factor[joints] = sizes[0] / sizes[1] if min(sizes) > 0.0 else 1.0
        return factor


def _joint_term(torque_rows: FloatArray, value: torch.Tensor, scale: float) -> FloatArray:
    """Columns of joint torques in proportion to values (N, n), scaled by the prior and independent of their size."""
    columns = torque_rows.transpose(0, 2, 1) * value.numpy()[:, None]
    size = np.sqrt(np.square(columns).mean(axis=(0, 1)))
    return np.asarray(scale * columns / np.where(size > 0.0, size, 1.0))


def _prior_columns(builder: RowBuilder, samples: Samples, model: NominalModel) -> FloatArray:
    """Matrix (columns, P) from unknowns in standard deviations of the prior to the builder's columns.

    Friction that a URDF lacks may be as large as the torque of its joint: strain-wave gears have as much.
    """
    robot = model.robot
    scale = URDF_ERROR * parameter_scale(robot.nominal)
    scale[:, parameters.FRICTION] = 0.0
    torque = samples.torque
    if torque is not None:
        rms = model.torque_ratio * np.sqrt(np.nan_to_num(np.square(torque[:, : robot.n].numpy())).mean(axis=0))
        speed = np.sqrt(np.square(samples.joint_velocity.numpy()).mean(axis=0))
        friction = np.stack([rms, rms / np.maximum(speed, 1e-3)], axis=1)
        for number, body in enumerate(robot.bodies):
            if body.joint is not None and body.joint.name in robot.joint_names:
                scale[number, parameters.FRICTION] = friction[robot.joint_names.index(body.joint.name)]
    scale[[body.massless for body in robot.bodies], parameters.INERTIAL] = 0.0
    if model.unknown is not None:
        scale[model.unknown] = np.broadcast_to(_size_of_unknown_body(robot), scale.shape)[model.unknown]
    of_bodies = (builder.columns.parameter_map * scale.flatten())[:, scale.flatten() > 0.0]
    out = np.zeros((builder.width, of_bodies.shape[1] + len(builder.extras)))
    out[: len(of_bodies), : of_bodies.shape[1]] = of_bodies
    for number, extra in enumerate(builder.extras):
        size = model.scale_std if extra.what == "scale" else DECLARED_SIZES * extra.size
        out[len(of_bodies) + number, of_bodies.shape[1] + number] = size
    return out


def _size_of_unknown_body(robot: Robot) -> FloatArray:
    """Typical parameters, (12,), of a body with the usual mass and a fifth of the robot's length."""
    masses = np.abs(robot.nominal[:, parameters.MASS])
    mass = float(np.median(masses[masses > 0.0]))
    length = max(0.2 * reach(robot), 0.01)
    size = np.zeros(parameters.PER_BODY)
    size[parameters.MASS] = mass
    size[parameters.FIRST_MOMENT] = mass * length
    size[parameters.INERTIA] = mass * length**2
    return size


def reach(robot: Robot) -> float:
    """Length of the longest chain of joints [m]."""
    away = np.zeros(len(robot.bodies))
    for number, body in enumerate(robot.bodies):
        if body.joint is not None:
            away[number] = away[body.parent] + np.linalg.norm(body.joint.T_parent_joint[:3, 3])
    return float(away.max())


def _measured_sensors(samples: Samples, model: NominalModel) -> SensorSet:
    """The sensors that were read in all samples; their noise is at least the unmodelled force of each kind.

    For a torque this is the geometric mean of the shares of its own size and of all torques' size; only the latter if
    torques have unknown scales.
    """
    robot = model.robot
    contacts = model.contacts
    torque = np.zeros(robot.n_dofs, bool)
    of_joints = np.zeros(robot.n)
    weight = parameters.GRAVITY * float(robot.nominal[:, parameters.MASS].sum())
    size = 0.1 * weight
    if samples.torque is not None:
        values = model.torque_ratio * samples.torque.numpy()[:, : robot.n]
        torque[: robot.n] = np.isfinite(values).all(axis=0) & (np.abs(values) > MIN_TORQUE_NM).any(axis=0)
        rms = np.sqrt(np.square(np.nan_to_num(values)).mean(axis=0))
        if torque.any():
            size = float(np.sqrt(np.square(rms[torque[: robot.n]]).mean()))
        of_joints = np.full(robot.n, size) if "joint_torque" in model.declared.terms.scales else np.sqrt(rms * size)
    wrench = np.zeros((len(contacts), 6), bool)
    if samples.wrench is not None:
        for k, contact in enumerate(contacts):
            known = samples.wrench[:, k][samples.active[:, k]].numpy()[:, list(contact.components)]
            wrench[k, list(contact.components)] = np.isfinite(known).all()
    stated = model.declared.noise or SensorNoise.of_known({})
    torque_noise = np.hypot(_unmodelled(of_joints), model.torque_ratio * np.asarray(model.reading_noise))
    noise = SensorNoise(
        tuple(np.fmax(torque_noise, np.broadcast_to(stated.joint_torque, robot.n)).tolist()),
        float(np.fmax(_unmodelled(0.5 * weight), stated.contact_force)),
        float(np.fmax(_unmodelled(size), stated.contact_moment)),
    )
    return SensorSet(torque | robot.is_passive, wrench, noise)


def _measures_alike(one: SensorSet, other: SensorSet) -> bool:
    return np.array_equal(one.torque, other.torque) and np.array_equal(one.wrench, other.wrench)


def _unmodelled(size: FloatArray | float) -> FloatArray:
    return np.maximum(UNMODELLED_FORCE_SHARE * np.asarray(size), MIN_TORQUE_NM)


def reading_noise(log: Log, robot: Robot) -> FloatArray:
    """Sample-to-sample standard deviation of each joint's torque readings, (n,), 0 if unknown."""
    noise = np.zeros(robot.n)
    for name, column in zip(log.joint_names, np.asarray(log.joint_torque).T, strict=True):
        known = column[np.isfinite(column)]
        if name in robot.joint_names and len(known) > 20:
            noise[robot.joint_names.index(name)] = rough_noise(known[:, None]).item()
    return noise


# -------------------------------------------------------------------------------------- kinds of mistakes

Findings = Callable[[Sequence[int], Estimate], list[Finding]]
Moved = Callable[[FloatArray], tuple[ForceEquations, FloatArray] | None]


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of mistake with its unknowns: one row of the table.

    Attributes:
        columns: of the unknowns, (N, n_rows, k).
        prior_std: of the unknowns, (k,) or of each.
        is_large: which unknowns (k,) are large enough for a finding.
        findings: of the large unknowns, from their numbers and estimate.
        moved: equations and columns of the log corrected by the unknowns (k,), if the columns hold only for small ones.
        bounded: whether unknowns are gains less 1; both regressions must find them large, and agree.
        single: whether only one unknown is wrong.
        constants: whether constant torques are estimated, too.
        together: size of groups of successive unknowns with one finding.
        steady: whether every block of time must show the unknowns.
        equations: of the columns, None: those of the log.
    """

    columns: FloatArray
    prior_std: FloatArray | float
    is_large: Callable[[FloatArray], BoolArray]
    findings: Findings
    moved: Moved | None = None
    bounded: bool = False
    single: bool = False
    constants: bool = True
    together: int = 1
    steady: bool = True
    equations: ForceEquations | None = None


@dataclass(frozen=True, eq=False)
class Explanation:
    """Findings about a mistake, and the unexplained forces after its correction.

    `value`: (count,), of its `count` unknowns.
    """

    findings: Sequence[Finding]
    left: float
    count: int
    value: FloatArray


def explain(equations: ForceEquations, kind: Kind) -> Explanation | None:
    """The explanation of the forces by significant unknowns of a kind; None without any."""
    equations = kind.equations or equations
    reduced = equations.reduced(kind.columns, kind.constants)
    count = kind.columns.shape[2]
    if kind.single:
        product = reduced.products[0, 0, 1:]
        square = np.maximum(np.diagonal(reduced.products[0])[1:], 1e-300)
        possible = np.flatnonzero(kind.is_large(product / square))
        which = possible[np.argsort(-np.square(product[possible]) / square[possible])][:1]
    else:
        which = np.arange(count)
        for _ in range(2):
            estimate = reduced.fit(which, _prior(kind, which))
            which = which[_possible(kind, which, reduced, estimate)]
    if not len(which):
        return None
    estimate = reduced.fit(which, _prior(kind, which))
    applied = np.zeros(count)
    if kind.moved is not None:
        estimate, reduced = _corrected(kind, which, estimate, reduced, applied)
    clear = estimate.certain & estimate.steady if kind.steady else estimate.certain
    named = _named(kind, which, reduced, estimate, clear, 1.0 + applied[which])
    without = equations.reduced(kind.columns[..., :0], kind.constants).left
    is_another = estimate.left > MAX_LEFT
    least_ratio = MIN_UNEXPLAINED_RATIO_OF_ANOTHER_ROBOT if is_another else MIN_UNEXPLAINED_RATIO
    if not named.any() or not without > least_ratio * estimate.left:
        return None
    findings = kind.findings(which[named].tolist(), estimate.of(named))
    return Explanation(findings, estimate.left, len(which), estimate.value) if findings else None


def _prior(kind: Kind, which: NDArray[np.intp]) -> FloatArray:
    return np.broadcast_to(kind.prior_std, kind.columns.shape[2])[which]


def _possible(kind: Kind, which: NDArray[np.intp], reduced: ReducedEquations, estimate: Estimate) -> BoolArray:
    """Which of some unknowns may be reported; half the size suffices for a lag, as a corrected log makes it clearer."""
    if kind.moved is None or kind.columns.shape[2] > kind.together or kind.bounded:
        return _named(kind, which, reduced, estimate, estimate.certain)
    near = replace(estimate, value=2.0 * estimate.value)
    return _named(kind, which, reduced, near, near.certain)


def _named(
    kind: Kind,
    which: NDArray[np.intp],
    reduced: ReducedEquations,
    estimate: Estimate,
    certain: BoolArray,
    applied: FloatArray | None = None,
) -> BoolArray:
    """Which of some unknowns are `certain` and large, by groups of `kind.together` unknowns.

    `applied`: gains already applied to the readings; None before the last estimate, in which gains must be clear.
    """
    named = certain & kind.is_large(estimate.value)
    if kind.bounded and len(which):
        gain = 1.0 + estimate.value
        reverse = reduced.select(which).reverse_gains(gain, 1.0 if applied is None else applied)
        named &= kind.is_large(reverse - 1.0)
        if applied is not None:
            named &= _are_apart_from_1(gain, reverse)
    if kind.together > 1:
        groups = which // kind.together
        named = np.isin(groups, groups[named])
    return named


def _are_apart_from_1(gain: FloatArray, reverse: FloatArray) -> BoolArray:
    """Which gains differ from 1: the true gain is between the two regressions, which must be close to each other.

    On the same side of 1, the farther gain may be the third power of the nearer one: torques from armature, which
    URDFs rarely state, have 0.13 and 0.75. Negative gains may differ by `FACTOR_TOLERANCE_RATIO` squared.
    """
    logs = np.log(np.maximum(np.abs([gain, reverse]), 1e-12))
    least = np.where(gain < 0.0, np.log(FACTOR_TOLERANCE_RATIO), np.abs(logs).min(axis=0))
    return np.asarray(np.abs(logs[0] - logs[1]) < 2.0 * least)


def _corrected(
    kind: Kind, which: NDArray[np.intp], first: Estimate, reduced: ReducedEquations, total: FloatArray
) -> tuple[Estimate, ReducedEquations]:
    """The estimate after repeated corrections of the log by the estimated unknowns, until these vanish.

    `total`: receives the sum of the corrections, (k,).
    """
    estimate = first
    step = first.value
    for _ in range(_STEPS):
        moved = None if kind.moved is None else kind.moved(total + _scattered(step, which, len(total)))
        if moved is None:
            break
        total[which] += step
        equations, columns = moved
        reduced = equations.reduced(columns, kind.constants)
        fit = reduced.fit(which, _prior(kind, which))
        step = fit.value
        estimate = replace(fit, value=step + total[which], blocks=fit.blocks + total[which], without=first.without)
        if np.abs(step).max() < _LEAST_STEP:
            break
    return estimate, reduced


def _scattered(values: FloatArray, which: NDArray[np.intp], count: int) -> FloatArray:
    """Values of some of `count` unknowns, and 0 for the others."""
    out = np.zeros(count)
    out[which] = values
    return out
