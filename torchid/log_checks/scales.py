"""Scales of time and torques, and the reference point of wrenches, estimated for all URDFs near the given one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.linalg import block_diag

from torchid import parameters
from torchid.log_checks.findings import median_step
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
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state
from torchid.problem.linear import parameter_scale
from torchid.problem.predict import force_series
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


def _scale_time(log: Log, factor: float) -> Log:
    """The log with its time multiplied by a factor."""
    return replace(log, time=log.time[0] + factor * (log.time - log.time[0]))


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
        logs = preprocess_pieces(_scale_time(log, factor), cutoff_hz / factor, MAX_TRIAL_DIFFERENTIATED_SAMPLES)
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
            force = builder.recorded_wrench(samples, k, kinematics)[:, :3].numpy()
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
