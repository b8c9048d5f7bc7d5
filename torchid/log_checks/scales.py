"""Scales, and other unknowns that a URDF does not have, estimated for all URDFs near the given one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.linalg import block_diag

from torchid import parameters
from torchid.errors import join_names
from torchid.log_checks.findings import NOTE, SUSPICIOUS, Finding, median_step
from torchid.log_checks.model import (
    MAX_TRIAL_DIFFERENTIATED_SAMPLES,
    UNMODELLED_FORCE_SHARE,
    NominalModel,
    bind_some_samples,
    deviation_builder,
    preprocess_pieces,
)
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.parallel import one_thread
from torchid.parameters import MASS, mass_com_inertia
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.linear import parameter_scale
from torchid.problem.metrics import force_series
from torchid.robot import Robot

# ---------------------------------------------------------------------- equations with a prior on the URDF's parameters

#: Errors of a URDF, in units of `parameter_scale`: 0.1 is a mass, or an inertia, that is 15 to 20 % off.
URDF_ERROR = 0.1
#: Friction missing in a URDF, over the rms torque of the joint: strain-wave gears and ball screws have as much.
FRICTION_TORQUE_SHARE = 1.0
#: Successive samples that count as one: of 240 out of ten seconds, errors of friction and flexibility are correlated.
CORRELATED_SAMPLES = 10.0
#: Blocks of time whose estimates are compared.
TIME_BLOCKS = 6
#: Share of a deviation that every block of time must show.
MIN_BLOCK_SHARE = 0.5
#: Size of a certain deviation in standard deviations, which include the errors of the URDF.
MIN_STANDARD_DEVIATIONS = 4.0
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of whitened rows [K, Y], K scaled by the prior's standard deviations, by blocks of time.

    Attributes:
        KtK: (TIME_BLOCKS, P, P).
        KtY: (TIME_BLOCKS, P, k).
        YtY: (TIME_BLOCKS, k, k).
        rows: number of rows.
    """

    KtK: FloatArray
    KtY: FloatArray
    YtY: FloatArray
    rows: int

    def unexplained(self, block: int | None = None) -> FloatArray:
        """Products (k, k) of the residuals of Y after the fit of the parameters, over all blocks or in one."""
        blocks = slice(None) if block is None else slice(block, block + 1)
        H, C, G = (part[blocks].sum(axis=0) for part in (self.KtK, self.KtY, self.YtY))
        H = H + CORRELATED_SAMPLES * np.eye(len(H))
        return np.asarray(G - C.T @ np.linalg.solve(H, C))


def _missing_friction_scale(samples: Sequence[Samples], robot: Robot) -> FloatArray:
    """Coulomb [N m] and viscous [N m s/rad] friction of joints without friction in the URDF, (n, 2)."""
    out = np.full((robot.n, 2), _TINY)
    if all(part.torque is not None for part in samples):
        torque = np.concatenate([part.torque[:, : robot.n].numpy() for part in samples if part.torque is not None])
        velocity = np.concatenate([part.joint_velocity.numpy() for part in samples])
        size = FRICTION_TORQUE_SHARE * np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
        speed = np.sqrt(np.square(velocity).mean(axis=0))
        out = np.stack([size, size / np.maximum(speed, 1e-3)], axis=1)
    return np.maximum(out, _TINY)


def prior_columns(builder: RowBuilder, robot: Robot, samples: Sequence[Samples]) -> FloatArray:
    """Matrix (columns, P) from unknowns in standard deviations of the prior to the builder's columns.

    Declared terms are free: a scale has that of a gain, others 10 times their usual size.
    """
    scale = URDF_ERROR * parameter_scale(robot.nominal)
    scale[:, parameters.FRICTION] = 0.0
    friction = _missing_friction_scale(samples, robot)
    for number, body in enumerate(robot.bodies):
        if body.joint is not None and body.joint.name in robot.joint_names:
            scale[number, parameters.FRICTION] = friction[robot.joint_names.index(body.joint.name)]
    massless = [body.massless for body in robot.bodies]
    scale[massless, parameters.INERTIAL] = 0.0
    kept = scale.flatten() > 0.0
    extras = [_GAIN_PRIOR_STD if extra.what == "scale" else 10.0 * extra.size for extra in builder.extras]
    return block_diag((builder.columns.parameter_map * scale.flatten())[:, kept], np.diag(extras))


@torch.no_grad()
def rows_with_bases(builder: RowBuilder, samples: Samples) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened rows (N, r, columns + 1) that some sample has, their bases W (N, n_rows, r), and which are not zero."""
    n_rows = builder.tree.n_rows
    rows, W = np.zeros((len(samples), n_rows, builder.width + 1)), np.zeros((len(samples), n_rows, n_rows))
    with one_thread():
        for state, index in chunks_by_state(samples):
            numbers = index if isinstance(index, slice) else index.numpy()
            rows[numbers], W[numbers] = (x.numpy() for x in builder.rows_by_sample(samples[index], state))
    equations = np.asarray(np.abs(W).any(axis=1))
    kept = equations.any(axis=0)
    return rows[:, kept], W[:, :, kept], equations[:, kept]


def accumulate_blocks(parts: Sequence[tuple[FloatArray, FloatArray, BoolArray]]) -> NormalEquations:
    """Normal equations of parts of a log: K (N, r, P), Y (N, r, k) and which rows are not zero."""
    K, Y, equations = (np.concatenate(part) for part in zip(*parts, strict=True))
    products = []
    for block in np.array_split(np.arange(len(K)), TIME_BLOCKS):
        A, B = K[block].reshape(-1, K.shape[2]), Y[block].reshape(-1, Y.shape[2])
        products.append((A.T @ A, A.T @ B, B.T @ B))
    KtK, KtY, YtY = (np.array(product) for product in zip(*products, strict=True))
    return NormalEquations(KtK, KtY, YtY, int(equations.sum()))


# -------------------------------------------------------------------------------------------------------- scale of time

#: Samples that are compared.
TIME_SCALE_SAMPLES = 240
#: Factor of time at which accelerations vanish.
_REST_FACTOR = 1e4
#: Share of the power of positions within the bandwidth of the motion, the cutoff over that bandwidth, its minimum in
#: periods per log (the filter spoils two at each end), and its maximum over the sample rate.
_MOTION_POWER_SHARE, _CUTOFF_BANDWIDTHS, _MIN_CUTOFF_PERIODS, _MAX_CUTOFF_RATE_SHARE = 0.99, 6.0, 20.0, 0.2
#: Factors of time that are tried.
_TIME_FACTORS = np.geomspace(1e-4, 1e4, 1601)
#: Prior of torque terms that the URDF lacks, over the unmodelled force; of armatures beside factors of torques, which
#: would else be what a geared motor's inertia is: all of the torque in light limbs.
_JOINT_TERM_SCALE, ARMATURE_SCALE = 3.0, FRICTION_TORQUE_SHARE / UNMODELLED_FORCE_SHARE
#: Prior standard deviations of a torque's factor about 1, and of the point of wrenches about the contact frame.
_GAIN_PRIOR_STD, _POINT_PRIOR_STD_M = 1.0, 0.3


@dataclass(frozen=True)
class TimeScale:
    """Factor that time should be multiplied by, of all samples and of each block, and unexplained forces.

    `corrected`, `recorded`, `at_rest`: rms residual of the best URDF near the given one, in `UNMODELLED_FORCE_SHARE` of
    the forces, with the corrected time, with the recorded time, and for a robot at rest.
    """

    factor: float
    blocks: FloatArray
    corrected: float
    recorded: float
    at_rest: float


def motion_cutoff_hz(log: Log) -> float | None:
    """A cutoff [Hz] from the spectrum of the joint positions, for any unit of time; None where no joint moves."""
    position = log.joint_position[: 2 * (len(log) // 2)]
    window = np.hanning(len(position))[:, None]  # a log that ends elsewhere than it began has no jump between
    power = np.square(np.abs(np.fft.rfft(window * (position - position.mean(axis=0)), axis=0))).sum(axis=1)
    power[0] = 0.0
    if not power.sum() > 0.0:
        return None
    last = int(np.searchsorted(np.cumsum(power), _MOTION_POWER_SHARE * power.sum()))
    step = median_step(log)
    return float(
        min(max(_CUTOFF_BANDWIDTHS * last, _MIN_CUTOFF_PERIODS) / (step * len(position)), _MAX_CUTOFF_RATE_SHARE / step)
    )


def fit_time_scale(log: Log, model: NominalModel, cutoff_hz: float) -> TimeScale | None:
    """The factor of time at which gravity and inertia explain the forces best; None where no force was measured.

    Velocities and accelerations scale with the inverse of time and its square, gravity is constant: three factors
    determine the predicted forces at all others.

    Raises:
        InputError: the log cannot be filtered, or does not match the robot.
    """

    def samples_at(factor: float) -> list[Samples]:
        scaled = replace(log, time=log.time[0] + factor * (log.time - log.time[0]))
        logs = preprocess_pieces(scaled, cutoff_hz / factor, MAX_TRIAL_DIFFERENTIATED_SAMPLES)
        return bind_some_samples(logs, model.robot, model.contacts, TIME_SCALE_SAMPLES)

    recorded, doubled, at_rest = samples_at(1.0), samples_at(2.0), samples_at(_REST_FACTOR)
    builder = deviation_builder(recorded, model)
    if builder is None:
        return None  # any factor explains none
    parts = []
    columns = prior_columns(builder, model.robot, recorded)
    phi = model.robot.nominal.flatten()[None]
    for one, two, rest in zip(recorded, doubled, at_rest, strict=True):
        rows, W, equations = rows_with_bases(builder, rest)
        total, slower, gravity = (force_series(builder, part, phi)[1][0] for part in (one, two, rest))
        quadratic = 2.0 * (total - gravity) - 4.0 * (slower - gravity)
        terms = [gravity, total - gravity - quadratic, quadratic]
        projected = [rows[..., -1], *(np.einsum("nvr,nv->nr", W, term) for term in terms)]
        K = deviation_columns(builder, rows, W, one, columns)
        parts.append((K, np.stack(projected, axis=2), equations))
    return _best_factor(accumulate_blocks(parts))


def deviation_columns(
    builder: RowBuilder,
    rows: FloatArray,
    W: FloatArray,
    samples: Samples,
    prior: FloatArray,
    armature: float = _JOINT_TERM_SCALE,
) -> FloatArray:
    """Columns (N, r, P) of what may differ from the URDF: parameters, friction, armature, last offsets of torques.

    Args:
        builder: of the rows.
        rows: from `rows_with_bases`.
        W: their bases.
        samples: whose motion friction and armature follow.
        prior: from `prior_columns`.
        armature: its prior, over the unmodelled force.
    """
    rate = samples.joint_velocity
    terms = [(torch.sign(rate), _JOINT_TERM_SCALE), (rate, _JOINT_TERM_SCALE), (samples.joint_acceleration, armature)]
    terms.append((torch.ones_like(rate), _JOINT_TERM_SCALE))
    of_joints = (_joint_term(builder, W, value, scale) for value, scale in terms)
    return np.concatenate([rows[..., :-1] @ prior, *of_joints], axis=2)


def _joint_term(builder: RowBuilder, W: FloatArray, value: torch.Tensor, scale: float) -> FloatArray:
    """Columns of joint torques in proportion to values (N, n), scaled by the prior whatever the size of the values."""
    base = builder.tree.base_rows
    columns = W[:, base : base + value.shape[1]].transpose(0, 2, 1) * value.numpy()[:, None]
    size = np.sqrt(np.square(columns).mean(axis=(0, 1)))
    return np.asarray(scale * columns / np.where(size > 0.0, size, 1.0))


def _best_factor(equations: NormalEquations) -> TimeScale:
    u = np.stack([np.ones_like(_TIME_FACTORS), -np.ones_like(_TIME_FACTORS), -1 / _TIME_FACTORS, -1 / _TIME_FACTORS**2])

    def cost(block: int | None) -> FloatArray:
        return np.asarray(np.einsum("ks,kl,ls->s", u, equations.unexplained(block), u))

    total = cost(None)
    blocks = np.array([_TIME_FACTORS[np.argmin(cost(block))] for block in range(TIME_BLOCKS)])
    best, unity = int(np.argmin(total)), int(np.argmin(np.abs(np.log(_TIME_FACTORS))))
    residual = np.sqrt(np.maximum(total, 0.0) / max(equations.rows, 1))
    return TimeScale(float(_TIME_FACTORS[best]), blocks, *(float(residual[i]) for i in (best, unity, -1)))


# -------------------------------------------------------------------------- gains of torques, and the point of wrenches


@dataclass(frozen=True, eq=False)
class CommonGain:
    """A factor of all torques alike, by either regression, its standard deviation, and by block, (TIME_BLOCKS,).

    `is_weighed`: whether all contact forces were measured, which say what a floating base's bodies weigh.
    """

    gain: float
    reverse: float
    spread: float
    blocks: FloatArray
    is_weighed: bool = False


@dataclass(frozen=True, eq=False)
class TorqueGains:
    """Factors of torques and the reference point of wrenches, by the best URDF near the given one.

    Attributes:
        joints: numbers of the m joints whose torque was measured.
        gain: (m,) factors, if what no parameters explain were no error of this torque's readings.
        reverse: (m,) the same if all of it were: the truth is between both (Frisch, "Statistical confluence
            analysis", 1934). Far apart where friction, armature or inertias that the URDF lacks explain the readings.
        point: (3,) [m] in the contact frames.
        spread: (m + 3,) standard deviations of gain and point.
        blocks: (TIME_BLOCKS, m + 3), both by block of time.
        common: of all torques alike; None without torques.
    """

    joints: np.ndarray
    gain: FloatArray
    reverse: FloatArray
    point: FloatArray
    spread: FloatArray
    blocks: FloatArray
    common: CommonGain | None


def fit_torque_gains(samples: Sequence[Samples], model: NominalModel) -> TorqueGains | None:
    """Factors of single torques and the point of wrenches; None where neither was measured."""
    robot, builder = model.robot, deviation_builder(samples, model)
    if builder is None:
        return None
    sensors = builder.sensors
    joints = np.flatnonzero((sensors.torque & ~robot.is_passive)[: robot.n])
    if not len(joints) and not _has_moments(sensors.wrench):
        return None
    columns = prior_columns(builder, robot, samples)
    nominal = builder.to_columns(robot.nominal.flatten()[None])[0].numpy()
    parts = []
    for part in samples:
        rows, W, equations = rows_with_bases(builder, part)
        torque = np.zeros((len(part), builder.tree.base_rows + robot.n_dofs, len(joints)))
        for index, joint in enumerate(joints):
            torque[:, builder.tree.base_rows + joint, index] = builder.recorded_torque(part)[:, joint].numpy()
        terms = np.concatenate([torque, _point_shift_forces(builder, part, sensors.wrench)], axis=2)
        projected = np.einsum("nvr,nvk->nrk", W, terms)
        contact_part = rows[..., -1] - projected[..., : len(joints)].sum(axis=2)
        target = rows[..., :-1] @ nominal - contact_part
        K = deviation_columns(builder, rows, W, part, columns, ARMATURE_SCALE)
        parts.append((K, np.concatenate([target[..., None], projected], axis=2), equations))
    forces = sensors.wrench[:, :3]
    return _solve_gains(accumulate_blocks(parts), joints, bool(forces.size and forces.all()) and not robot.fixed_base)


def _point_shift_forces(builder: RowBuilder, samples: Samples, measured: np.ndarray) -> FloatArray:
    """Change of the generalized forces with a shift of the wrenches' point along each axis, (N, n_rows, 3) [N/m]."""
    out = np.zeros((len(samples), builder.tree.n_rows, 3))
    if not _has_moments(measured):
        return out
    with torch.no_grad():
        kinematics = builder.kinematics(samples)
        J = builder.contact_jacobian(samples).numpy()
        for k in range(len(measured)):
            force = builder.recorded_wrench(kinematics, k)[:, :3].numpy()
            force = np.where(samples.active[:, k, None].numpy(), force, 0.0)
            for axis in range(3):
                out[..., axis] += np.einsum("niv,ni->nv", J[:, k, 3:], np.cross(np.eye(3)[axis], force))
    return out


def _has_moments(measured: np.ndarray) -> bool:
    """Whether all forces and moments of the contacts (C, 6) are measured."""
    return bool(measured.size and measured.all())


def _solve_gains(equations: NormalEquations, joints: np.ndarray, is_weighed: bool) -> TorqueGains:
    m = len(joints)
    each, alike = np.eye(m + 3), np.column_stack([np.repeat([1.0, 0.0], [m, 3]), np.eye(m + 3)[:, m:]])
    x, reverse, spread, blocks = _fit_gains(equations, each, m)
    common = None
    if m:
        factor, bound, certainty, by_block = _fit_gains(equations, alike, m)
        common = CommonGain(float(factor[0]), float(bound[0]), float(certainty[0]), by_block[:, 0], is_weighed)
    return TorqueGains(joints, x[:m], reverse[:m], x[m:], spread, blocks, common)


def _fit_gains(
    equations: NormalEquations, unknowns: FloatArray, m: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Unknowns (k,) by either regression (see `TorqueGains`), standard deviations, and by block, (TIME_BLOCKS, k).

    `unknowns`, (m + 3, k): which of m gains and of the point's shifts each of them is.
    """
    precision = CORRELATED_SAMPLES * np.repeat([_GAIN_PRIOR_STD, _POINT_PRIOR_STD_M], [m, 3]) ** -2.0
    to_prior = np.column_stack([np.repeat([1.0, 0.0], [m, 3]), unknowns])
    prior = (to_prior.T * precision) @ to_prior
    map_ = np.zeros((len(unknowns) + 1, unknowns.shape[1] + 1))
    map_[0, 0], map_[1:, 1:] = 1.0, unknowns

    def solve(block: int | None) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        G = map_.T @ equations.unexplained(block) @ map_
        H = G + prior
        x, variance = np.linalg.solve(H[1:, 1:], H[1:, 0]), np.diag(np.linalg.inv(H[1:, 1:]))
        inverse = np.linalg.inv(G + _TINY * prior)  # which is for what no reading says
        with np.errstate(divide="ignore"):
            reverse = np.where(inverse[0, 1:] * x < 0.0, -np.diag(inverse)[1:] / inverse[0, 1:], np.copysign(np.inf, x))
        fit = np.append(1.0, -x)
        return np.asarray(x), reverse, np.asarray(variance), float(fit @ G @ fit)

    x, reverse, variance, residual = solve(None)
    spread = np.sqrt(CORRELATED_SAMPLES * max(1.0, residual / max(equations.rows, 1)) * variance)
    return x, reverse, spread, np.array([solve(block)[0] for block in range(TIME_BLOCKS)])


COMPARED_SAMPLES = 240
"""Samples of a log whose forces are compared."""

#: Unexplained forces without the deviation over those with it (1.2 at most in logs without a mistake), and what it may
#: leave: more, and the forces are another robot's.
MIN_UNEXPLAINED_RATIO, MAX_LEFT = 1.25, 1.5

UnknownColumns = Callable[[RowBuilder, Samples, int], FloatArray]
"""Change of the generalized forces that are required (N, n_rows, k) by a unit of each unknown, of samples by number."""


@dataclass(frozen=True, eq=False)
class FilteredLog:
    """Some filtered samples of a log, with their rows, for all that may be wrong with it.

    Attributes:
        log: the log.
        model: robot, contacts, and what is declared.
        cutoff_hz: of the filter.
    """

    log: Log
    model: NominalModel
    cutoff_hz: float

    @cached_property
    def pieces(self) -> list[Log]:
        """Runs of the log, filtered. Raises InputError: it cannot be filtered."""
        return preprocess_pieces(self.log, self.cutoff_hz, MAX_TRIAL_DIFFERENTIATED_SAMPLES)

    @cached_property
    def samples(self) -> list[Samples]:
        """Samples of them. Raises InputError: as `pieces`, or the log does not match the robot."""
        return bind_some_samples(self.pieces, self.model.robot, self.model.contacts, COMPARED_SAMPLES)

    @cached_property
    def rows(self) -> DeviationRows | None:
        """Rows of the samples, None where no force was measured. Raises InputError: as `samples`."""
        return DeviationRows.of(self.samples, self.model)


@dataclass(frozen=True, eq=False)
class DeviationRows:
    """Whitened rows of some samples, and columns of what may differ from the URDF in them.

    Attributes:
        builder: of the rows.
        samples: that they are of.
        parts: of each of the samples, bases W (N, n_rows, r), which of the r rows are not zero, columns (N, r, P),
            those of offsets of torques last, and what the nominal parameters leave (N, r).
    """

    builder: RowBuilder
    samples: Sequence[Samples]
    parts: list[tuple[FloatArray, BoolArray, FloatArray, FloatArray]]

    @classmethod
    def of(
        cls, samples: Sequence[Samples], model: NominalModel, torque_noise: FloatArray | None = None
    ) -> DeviationRows | None:
        """The rows of the forces that are measured, None without any; `torque_noise` as of `deviation_builder`."""
        builder = deviation_builder(samples, model, torque_noise)
        if builder is None:
            return None
        prior, parts = prior_columns(builder, model.robot, samples), []
        nominal = builder.to_columns(model.robot.nominal.flatten()[None])[0].numpy()
        for part in samples:
            rows, W, equations = rows_with_bases(builder, part)
            columns = deviation_columns(builder, rows, W, part, prior)
            parts.append((W, equations, columns, rows[..., :-1] @ nominal - rows[..., -1]))
        return cls(builder, samples, parts)

    @cached_property
    def unexplained(self) -> float:
        """What the best URDF near the given one leaves of the forces, as `Deviation.without`."""
        normal = accumulate_blocks([(K, target[..., None], equations) for _, equations, K, target in self.parts])
        return float(np.sqrt(max(float(normal.unexplained()[0, 0]), 0.0) / max(normal.rows, 1)))


@dataclass(frozen=True, eq=False)
class Deviation:
    """Unknowns beside the parameters, estimated with these.

    Attributes:
        value, spread: (k,), of the whole log, and their standard deviations.
        blocks: (TIME_BLOCKS, k), by block of time.
        without, left: forces that the best URDF near the given one leaves unexplained without the unknowns and with
            them, rms in `UNMODELLED_FORCE_SHARE` of the forces.
    """

    value: FloatArray
    spread: FloatArray
    blocks: FloatArray
    without: float
    left: float

    @property
    def clear(self) -> BoolArray:
        """Unknowns (k,) that are certain and that every block agrees on, where all explain the forces much better."""
        return np.asarray(self.steady & self.certain & self.improves)

    @property
    def steady(self) -> BoolArray:
        """Unknowns (k,) that every block of time agrees on."""
        return np.asarray((self.blocks * np.sign(self.value) > MIN_BLOCK_SHARE * np.abs(self.value)).all(axis=0))

    @property
    def certain(self) -> BoolArray:
        """Unknowns (k,) that are not 0 by their standard deviations."""
        return np.asarray(np.abs(self.value) > MIN_STANDARD_DEVIATIONS * self.spread)

    @property
    def improves(self) -> bool:
        """Whether all unknowns together explain the forces much better."""
        return self.without > MIN_UNEXPLAINED_RATIO * self.left and self.left < MAX_LEFT

    @property
    def explained(self) -> float:
        """By how much less all unknowns together leave, squared."""
        return self.without**2 - self.left**2

    @property
    def is_clear(self) -> bool:
        """Whether the largest unknown is."""
        return bool(self.clear[np.argmax(np.abs(self.value))])

    @property
    def gain(self) -> str:
        """How much better forces are explained with it."""
        return f"{self.without / max(self.left, 1e-9):.2g} times as much is unexplained otherwise"


@dataclass(frozen=True, eq=False)
class UnknownEquations:
    """Equations of unknowns by their columns, beside all that may differ from the URDF.

    `normal`: of what the nominal parameters leave, and of the k unknowns, in this order.
    """

    normal: NormalEquations

    @classmethod
    def of(cls, rows: DeviationRows, columns: UnknownColumns, offsets: int = 0) -> UnknownEquations:
        """Of all samples of the rows; see `fit_deviation`."""
        parts = []
        for number, (part, (W, equations, K, target)) in enumerate(zip(rows.samples, rows.parts, strict=True)):
            projected = np.einsum("nvr,nvk->nrk", W, columns(rows.builder, part, number))
            Y = np.concatenate([target[..., None], projected], axis=2)
            parts.append((K[..., : K.shape[2] - offsets], Y, equations))
        return cls(accumulate_blocks(parts))

    @cached_property
    def _products(self) -> dict[int | None, FloatArray]:
        """Of what the parameters leave (1 + k, 1 + k), of the whole log and by block of time."""
        return {block: self.normal.unexplained(block) for block in (None, *range(TIME_BLOCKS))}

    @property
    def unexplained_without(self) -> float:
        """As `Deviation.without`."""
        return self._rms(float(self._products[None][0, 0]))

    def _rms(self, squares: float) -> float:
        return float(np.sqrt(max(squares, 0.0) / max(self.normal.rows, 1)))

    def with_unmodelled(self, ratio: float) -> UnknownEquations:
        """The equations where forces that no parameters explain are `ratio` times what was presumed."""
        one = self.normal
        return UnknownEquations(replace(one, KtK=one.KtK / ratio**2, KtY=one.KtY / ratio**2, YtY=one.YtY / ratio**2))

    def fit(self, prior_std: float, combined: FloatArray | None = None) -> Deviation:
        """The unknowns, or those whose columns are `combined` (k, m) of them, with their prior standard deviation."""
        map_ = np.eye(self.normal.YtY.shape[1]) if combined is None else block_diag(1.0, combined)

        def solve(block: int | None) -> tuple[FloatArray, FloatArray, float]:
            G = map_.T @ self._products[block] @ map_
            H = G[1:, 1:] + CORRELATED_SAMPLES / prior_std**2 * np.eye(len(G) - 1)
            x = np.linalg.solve(H, G[1:, 0])
            left = G[0, 0] - 2.0 * G[0, 1:] @ x + x @ G[1:, 1:] @ x
            return np.asarray(x), np.asarray(np.diag(np.linalg.inv(H))), float(left)

        value, variance, squares = solve(None)
        left = self._rms(squares)
        spread = np.sqrt(CORRELATED_SAMPLES * max(1.0, left**2) * variance)
        blocks = np.array([solve(block)[0] for block in range(TIME_BLOCKS)])
        return Deviation(value, spread, blocks, self.unexplained_without, left)


def fit_deviation(
    rows: DeviationRows | None, columns: UnknownColumns, prior_std: float, offsets: int = 0
) -> Deviation | None:
    """Unknowns by their columns, beside parameters, friction, armature and all but so many `offsets` of torques."""
    return None if rows is None else UnknownEquations.of(rows, columns, offsets).fit(prior_std)


#: Gain of a torque relative to the other joints, and shift of a wrench's point, that are reported: errors of gears and
#: calibrations are smaller.
MIN_GAIN_RATIO, MIN_POINT_SHIFT_M = 1.15, 0.03
#: The same of all torques alike where contact forces do not say what the robot weighs: masses may be off by a fifth.
MIN_COMMON_GAIN_RATIO = 1.3
#: Share of a factor of all torques that every block of time must show: alone it has hardly more than the prior at 1.
MIN_COMMON_BLOCK_SHARE = 0.3
#: Gains with a smaller standard deviation are the reference for all others, if there are enough of them.
_MAX_REFERENCE_SPREAD, _MIN_REFERENCE_JOINTS = 0.1, 3
#: Of a factor of all torques that is noted: its size in standard deviations, how far the factor of a joint may be from
#: it in its own, and how many joints must have it.
_MIN_NOTED_DEVIATIONS, _MAX_DEVIATIONS_FROM_COMMON, _MIN_NOTED_JOINTS = 3.0, 2.0, 2
#: Share of what factors of all joints together explain that the common one explains; their prior standard deviation.
_MIN_EXPLAINED_SHARE, _FACTOR_PRIOR_STD = 0.5, 1.0


def gain_and_point_findings(log: Log, fit: TorqueGains | None, robot: Robot) -> Iterator[Finding]:
    """Findings about torques with another gain and wrenches about another point."""
    if fit is None:
        return
    m = len(fit.joints)
    spread, blocks = fit.spread[:m], fit.blocks[:, :m]
    yield from common_gain_findings(fit, robot)
    of = _reference_joints(fit)
    reference, of_reverse = (float(np.median(x[of])) if of.any() else 1.0 for x in (fit.gain, fit.reverse))
    relative = fit.gain / reference
    off = np.abs(fit.gain) > MIN_STANDARD_DEVIATIONS * spread  # readings of nothing have no factor
    off &= _is_beyond(relative, fit.reverse / of_reverse, MIN_GAIN_RATIO)
    references = np.median(blocks[:, of], axis=1, keepdims=True) if of.any() else 1.0
    off &= _is_certain(relative - 1.0, spread / reference, blocks / references - 1.0)
    if off.any() and m > 1:
        names = [robot.joint_names[joint] for joint in fit.joints[off]]
        gains = join_names([f"{gain:.3g} +- {std:.2g}" for gain, std in zip(relative[off], spread[off], strict=True)])
        text = f"{join_names(names)}: factors that fit the {robot.format} best, relative to the other joints: {gains}"
        advice = f"check gear ratios, torque constants and units, and the {robot.format}'s friction and inertias there"
        advice += f", or set sensors.scales: {{joint_torque: [[{', '.join(names)}]]}}"
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice, tuple(names))
    shifted = _is_certain(fit.point, fit.spread[m:], fit.blocks[:, m:]) & (np.abs(fit.point) > MIN_POINT_SHIFT_M)
    if shifted.any():
        point = ", ".join(f"{1e3 * x:.0f}" for x in fit.point)
        text = f"forces and moments fit the {robot.format} about a point {point} mm from the contact frames' origins"
        advice = "give moments about the contact frame's origin, or name the sensor's own frame as the contact"
        if log.moments_about_world_origin:
            advice = "check the points of the moments, where the plates lie, and the base's position in the same world"
        severity = SUSPICIOUS
        if _is_centre_of_base(log, robot, float(np.linalg.norm(fit.point))):
            severity, advice = NOTE, f"none if its base's centre of mass may be as far off; else {advice}"
        yield Finding("point", severity, log.contact_wrench_field, text, advice)


def _is_centre_of_base(log: Log, robot: Robot, shift: float) -> bool:
    """Whether the base's centre of mass explains another point of wrenches on the base alone, as of a drone's rotors.

    Weight and inertia act alike on both; a centre of mass is off by less than the body's radius of gyration.
    """
    mass, _, inertia = mass_com_inertia(robot.nominal[0])
    if mass <= 0.0 or any(robot.link(frame)[0] for frame in log.contact_names):
        return False
    gyration = np.sqrt(0.5 * np.trace(inertia) / mass)
    return bool(shift * robot.nominal[:, MASS].sum() / mass < gyration)


def _reference_joints(fit: TorqueGains) -> BoolArray:
    """Joints (m,) whose factors are the reference for all others, none if too few are known.

    Those that the URDF's masses agree with, if there are any, however many have another factor: motors of one type are
    wrong alike. Else all of them, as the URDF may weigh too much or too little.
    """
    known, right = _known_and_right_joints(fit)
    return right if right.any() else known & (known.sum() >= _MIN_REFERENCE_JOINTS)


def _known_and_right_joints(fit: TorqueGains) -> tuple[BoolArray, BoolArray]:
    """Joints (m,) whose factors are known, and those of them whose factors are 1 within what a URDF is off by."""
    known = fit.spread[: len(fit.gain)] < _MAX_REFERENCE_SPREAD * np.maximum(np.abs(fit.gain), 1.0)
    known &= _agree(fit.gain, fit.reverse)
    least = _least_common_ratio(fit)
    is_off = _is_beyond(fit.gain, fit.gain, least) | _is_beyond(fit.reverse, fit.reverse, least)
    return known, known & ~is_off


def _least_common_ratio(fit: TorqueGains) -> float:
    """Factor of all torques alike that is no error of the URDF's masses."""
    return MIN_GAIN_RATIO if fit.common is not None and fit.common.is_weighed else MIN_COMMON_GAIN_RATIO


def common_gain_findings(of_joints: TorqueGains, robot: Robot) -> Iterator[Finding]:
    """A finding about all torques times a common factor."""
    fit = of_joints.common
    if fit is None or _known_and_right_joints(of_joints)[1].any() or not _agree(fit.gain, fit.reverse):
        return
    if not _is_beyond(fit.gain, fit.reverse, _least_common_ratio(of_joints)):
        return
    value, agreeing = np.array([fit.gain - 1.0]), fit.blocks[:, None] - 1.0
    if _is_certain(value, np.array([fit.spread]), agreeing, MIN_COMMON_BLOCK_SHARE).all():
        text = f"all torques: the factor that fits the {robot.format} best is {fit.gain:.3g} +- {fit.spread:.2g}"
        advice = (
            f"check units, gear ratios and torque constants, whether the {robot.format}'s masses and contact forces "
            "are right, or set sensors.scales: {joint_torque: all}"
        )
        yield Finding("scale", SUSPICIOUS, "joint_torque", text, advice)


def common_factor_notes(filtered: FilteredLog) -> Iterator[Finding]:
    """A note about a bolted arm's torques that are all the URDF's times one factor, which its masses may make up.

    Not by how torques fit the URDF, but by how the URDF fits them, beside all URDFs near it: what no parameters explain
    is in the torques, and makes the former too small.

    Args:
        filtered: a log that nothing else is wrong with.
    """
    rows, robot = filtered.rows, filtered.model.robot
    if rows is None or filtered.log.joint_torque is None:
        return
    nominal = robot.nominal.flatten()[None]

    def columns(builder: RowBuilder, part: Samples, number: int) -> FloatArray:
        required = np.asarray(force_series(builder, part, nominal)[1][0])
        return -required[..., None] * np.eye(robot.n)

    equations = UnknownEquations.of(rows, columns)
    common, each = equations.fit(_FACTOR_PRIOR_STD, np.ones((robot.n, 1))), equations.fit(_FACTOR_PRIOR_STD)
    factor, spread = 1.0 + float(common.value[0]), float(common.spread[0])
    known = each.spread < _MAX_REFERENCE_SPREAD
    apart = np.abs(each.value - common.value) > _MAX_DEVIATIONS_FROM_COMMON * each.spread
    agree = known.sum() >= _MIN_NOTED_JOINTS and not (known & apart).any()
    most = common.explained > _MIN_EXPLAINED_SHARE * each.explained
    certain = abs(factor - 1.0) > _MIN_NOTED_DEVIATIONS * spread and bool(common.steady[0])
    if agree and most and certain and _is_beyond(factor, factor, MIN_GAIN_RATIO):
        text = f"all torques are {factor:.3g} +- {spread:.1g} times what the {robot.format} needs: a wrong torque"
        text += f" constant, gear ratio, or masses of the {robot.format}, which no log tells apart"
        advice = f"none if the {robot.format}'s masses may have this error; else check torque constants and gear ratios"
        yield Finding("scale", NOTE, "joint_torque", text, advice)


def _agree(one: FloatArray | float, other: FloatArray | float) -> BoolArray:
    """Whether factors by either regression are the same, within what is reported of a factor."""
    return np.asarray(np.abs(other) < MIN_COMMON_GAIN_RATIO * np.abs(one))


def _is_beyond(one: FloatArray | float, other: FloatArray | float, ratio: float) -> BoolArray:
    """Whether factors by either regression are both larger than a ratio, or both smaller than its inverse."""
    low, high = np.minimum(one, other), np.maximum(one, other)
    return np.asarray((low > ratio) | (high < 1.0 / ratio))


def _is_certain(
    value: FloatArray,
    spread: FloatArray,
    blocks: FloatArray,
    share: float = MIN_BLOCK_SHARE,
) -> BoolArray:
    """Which values (k,) are not 0, by their standard deviations (k,) and their estimates by block (BLOCKS, k)."""
    agree = (blocks * np.sign(value) > share * np.abs(value)).all(axis=0)
    return np.asarray((np.abs(value) > MIN_STANDARD_DEVIATIONS * spread) & agree)
