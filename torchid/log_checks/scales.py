"""Scales that forces determine for any URDF near the given one: of time, of torques, and the point of wrenches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid import parameters
from torchid.log_checks.findings import median_step
from torchid.log_checks.model import DIFFERENTIATED_TO_TRY, NOTHING, bind_some_samples, preprocess_pieces
from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import chunks_by_state, one_thread
from torchid.problem.linear import parameter_scale
from torchid.problem.predict import force_series
from torchid.regressor.kinematics import GRAVITY_WORLD
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

# ---------------------------------------------------------------------------------- equations of a URDF and any near it

#: What a URDF may be off by, in units of `parameter_scale`: 0.1 is a mass, and an inertia, 15 to 20 % off.
URDF_ERROR = 0.1
#: Friction that a URDF lacks, in the joint's rms torque.
FRICTION = 0.2
#: What no parameters explain (flexibility, filters, shape of friction), as a share of the rms of each kind of force.
UNMODELLED = 0.05
#: Successive samples that count as one: of 240 out of ten seconds, errors of friction and flexibility are correlated.
CORRELATED_SAMPLES = 10.0
#: Blocks of time that must agree.
BLOCKS = 6
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """Whitened equations of some samples, by blocks of time.

    Attributes:
        inside: (BLOCKS, P, P), products of the columns K, each times what its parameter may be off by.
        across: (BLOCKS, P, k), of these with the terms.
        terms: (BLOCKS, k, k), of the terms.
        rows: equations.
    """

    inside: FloatArray
    across: FloatArray
    terms: FloatArray
    rows: int

    def unexplained(self, block: int | None = None) -> FloatArray:
        """Products (k, k) of what is left of the terms, over all blocks or in one."""
        chosen = slice(None) if block is None else slice(block, block + 1)
        H, C, G = (part[chosen].sum(axis=0) for part in (self.inside, self.across, self.terms))
        H = H + CORRELATED_SAMPLES * np.eye(len(H))
        return np.asarray(G - C.T @ np.linalg.solve(H, C))


def _measured_sensors(samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]) -> SensorSet:
    """The forces that are known throughout, with what no parameters explain of each kind as their noise."""
    torque = np.zeros(robot.n_dofs, bool)
    wrench = np.zeros((len(contacts), 6), bool)
    size = 0.0
    if all(part.torque is not None for part in samples):
        values = np.concatenate([part.torque.numpy() for part in samples if part.torque is not None])[:, : robot.n]
        torque[: robot.n] = np.isfinite(values).all(axis=0) & (np.abs(values) > NOTHING).any(axis=0)
        size = float(np.sqrt(np.square(values[:, torque[: robot.n]]).mean())) if torque.any() else 0.0
    if contacts and all(part.wrench is not None for part in samples):
        for k, contact in enumerate(contacts):
            known = [
                part.wrench[:, k][part.active[:, k]].numpy()[:, list(contact.components)]
                for part in samples
                if part.wrench is not None
            ]
            wrench[k, list(contact.components)] = np.isfinite(np.concatenate(known)).all()
    weight = -GRAVITY_WORLD[2] * float(robot.nominal[:, parameters.MASS].sum())
    moment = size or 0.1 * weight
    noise = SensorNoise(*(max(UNMODELLED * x, _TINY) for x in (moment, 0.5 * weight, moment)))
    return SensorSet(torque, wrench, noise)


def _missing_friction_scale(samples: Sequence[Samples], robot: Robot) -> FloatArray:
    """Coulomb [N m] and viscous [N m s/rad] friction that joints without a word in the URDF have, (n, 2)."""
    out = np.full((robot.n, 2), _TINY)
    if all(part.torque is not None for part in samples):
        torque = np.concatenate([part.torque[:, : robot.n].numpy() for part in samples if part.torque is not None])
        velocity = np.concatenate([part.joint_velocity.numpy() for part in samples])
        size = FRICTION * np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
        speed = np.sqrt(np.square(velocity).mean(axis=0))
        out = np.stack([size, size / np.maximum(speed, 1e-3)], axis=1)
    return np.maximum(out, _TINY)


def _prior_columns(builder: RowBuilder, robot: Robot, samples: Sequence[Samples]) -> FloatArray:
    """Matrix (columns, P) from deviations of size 1 to the builder's columns."""
    scale = URDF_ERROR * parameter_scale(robot.nominal)
    scale[:, parameters.FRICTION] = 0.0
    friction = _missing_friction_scale(samples, robot)
    for body, found in enumerate(robot.bodies):
        if found.joint is not None and found.joint.name in robot.joint_names:
            scale[body, parameters.FRICTION] = friction[robot.joint_names.index(found.joint.name)]
    massless = [body.massless for body in robot.bodies]
    scale[massless, parameters.INERTIAL] = 0.0
    kept = scale.flatten() > 0.0
    return np.asarray((builder.columns.parameter_map() * scale.flatten())[:, kept])


@torch.no_grad()
def _whitened_rows(builder: RowBuilder, samples: Samples) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Whitened rows (N, n_rows, columns + 1), their bases W (N, n_rows, n_rows), and which rows are equations."""
    n_rows = builder.tree.n_rows
    rows, W = np.zeros((len(samples), n_rows, builder.width + 1)), np.zeros((len(samples), n_rows, n_rows))
    with one_thread():
        for state, index in chunks_by_state(samples):
            where = index if isinstance(index, slice) else index.numpy()
            found = builder.rows_by_sample(samples[index], state)
            rows[where], W[where] = (x.numpy() for x in found)
    return rows, W, np.asarray(np.abs(W).any(axis=1))


def _accumulate_blocks(K: FloatArray, terms: FloatArray, equations: BoolArray) -> _NormalEquations:
    """Products by blocks of samples (N, n_rows, P) and (N, n_rows, k)."""
    inside, across, own = [], [], []
    for part in np.array_split(np.arange(len(K)), BLOCKS):
        A, Y = K[part].reshape(-1, K.shape[2]), terms[part].reshape(-1, terms.shape[2])
        inside.append(A.T @ A)
        across.append(A.T @ Y)
        own.append(Y.T @ Y)
    return _NormalEquations(np.array(inside), np.array(across), np.array(own), int(equations.sum()))


# -------------------------------------------------------------------------------------------------------- scale of time

#: Samples compared.
SAMPLES = 240
#: A stretch of time after which nothing moves.
_STILL = 1e4
#: Share of the power of positions within the band of the motion, the cutoff in that band, the least one in periods over
#: the log, of which the filter spoils two at each end, and the largest one in the sample rate.
_SHARE, _ABOVE, _PERIODS, _OF_RATE = 0.99, 6.0, 20.0, 0.2
#: Stretches that are tried, evenly spread by their logarithm.
_STRETCHES = np.geomspace(1e-4, 1e4, 1601)
#: Size of what each joint's torque may hold in a way of its own, in what no parameters explain.
_LOOSE = 3.0
#: How far a factor of a torque may be from 1, and a wrench from its point [m], before the torques or wrenches are read.
_GAIN, _POINT = 0.5, 0.3


@dataclass(frozen=True)
class TimeScale:
    """What time should be multiplied by, of all samples and of each block, and what stays unexplained.

    `corrected`, `recorded`, `still`: rms of what no URDF near the given one explains, in `UNMODELLED` of the forces:
    with time so multiplied, as it is, and if nothing moved.
    """

    factor: float
    blocks: FloatArray
    corrected: float
    recorded: float
    still: float


def _scale_time(log: Log, factor: float) -> Log:
    """The log with its time multiplied by a factor."""
    return replace(log, time=log.time[0] + factor * (log.time - log.time[0]))


def motion_cutoff_hz(log: Log) -> float | None:
    """A cutoff [Hz] by the log's own motion, whatever its time is worth; None where no joint moves."""
    position = log.joint_position[: 2 * (len(log) // 2)]
    power = np.square(np.abs(np.fft.rfft(position - position.mean(axis=0), axis=0))).sum(axis=1)
    power[0] = 0.0
    if not power.sum() > 0.0:
        return None
    last = int(np.searchsorted(np.cumsum(power), _SHARE * power.sum()))
    step = median_step(log)
    return float(min(max(_ABOVE * last, _PERIODS) / (step * len(position)), _OF_RATE / step))


def fit_time_scale(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float) -> TimeScale:
    """How time would have to be multiplied for gravity and inertia to make up the forces.

    Derived velocities and accelerations scale with the inverse of time and its square, gravity does not: three
    scales determine the predicted forces at all others.

    Raises:
        InputError: the log cannot be filtered, or does not fit the robot.
    """

    def at(factor: float) -> list[Samples]:
        logs = preprocess_pieces(_scale_time(log, factor), cutoff_hz / factor, DIFFERENTIATED_TO_TRY)
        return bind_some_samples(logs, robot, contacts, SAMPLES)

    now, later, still = at(1.0), at(2.0), at(_STILL)
    builder = RowBuilder(robot, contacts, _measured_sensors(now, robot, contacts))
    parts = []
    columns = _prior_columns(builder, robot, now)
    phi = robot.nominal.flatten()[None]
    for one, two, rest in zip(now, later, still, strict=True):
        rows, W, equations = _whitened_rows(builder, rest)
        first, second, none = (force_series(builder, part, phi)[1][0] for part in (one, two, rest))
        quadratic = 2.0 * (first - none) - 4.0 * (second - none)
        terms = [none, first - none - quadratic, quadratic]
        projected = [rows[..., -1], *(np.einsum("nvr,nv->nr", W, term) for term in terms)]
        rate = one.joint_velocity
        loose = _of_joints(builder, W, torch.sign(rate), rate, one.joint_acceleration, torch.ones_like(rate))
        K = np.concatenate([rows[..., :-1] @ columns, *loose], axis=2)
        parts.append((K, np.stack(projected, axis=2), equations))
    found = _accumulate_blocks(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return _best(found)


def _of_joints(builder: RowBuilder, W: FloatArray, *values: torch.Tensor) -> list[FloatArray]:
    """Columns of what each joint's torque may hold beside the URDF's in proportion to values (N, n), of any size."""
    base = builder.tree.base_rows
    out = []
    for value in values:
        columns = W[:, base : base + value.shape[1]].transpose(0, 2, 1) * value.numpy()[:, None]
        size = np.sqrt(np.square(columns).mean(axis=(0, 1)))
        out.append(_LOOSE * columns / np.where(size > 0.0, size, 1.0))
    return out


def _best(found: _NormalEquations) -> TimeScale:
    u = np.stack([np.ones_like(_STRETCHES), -np.ones_like(_STRETCHES), -1 / _STRETCHES, -1 / _STRETCHES**2])

    def cost(block: int | None) -> FloatArray:
        return np.asarray(np.einsum("ks,kl,ls->s", u, found.unexplained(block), u))

    every = cost(None)
    blocks = np.array([_STRETCHES[np.argmin(cost(block))] for block in range(BLOCKS)])
    best, one = int(np.argmin(every)), int(np.argmin(np.abs(np.log(_STRETCHES))))
    left = np.sqrt(np.maximum(every, 0.0) / max(found.rows, 1))
    return TimeScale(float(_STRETCHES[best]), blocks, *(float(left[i]) for i in (best, one, -1)))


# -------------------------------------------------------------------------- gains of torques, and the point of wrenches


@dataclass(frozen=True, eq=False)
class TorqueGains:
    """Factors of torques, and the point that wrenches are about, that a URDF near the given one needs.

    Attributes:
        joints: numbers of the m joints whose torque was measured.
        gain: (m,) factors, `point` (3,) [m] in the contact frames.
        spread: (m + 3,) standard deviations of both.
        blocks: (BLOCKS, m + 3), of blocks of time.
    """

    joints: np.ndarray
    gain: FloatArray
    point: FloatArray
    spread: FloatArray
    blocks: FloatArray


def fit_torque_gains(samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]) -> TorqueGains | None:
    """Factors of single torques and the point of wrenches; None where neither was measured."""
    sensors = _measured_sensors(samples, robot, contacts)
    joints = np.flatnonzero(sensors.torque[: robot.n])
    if not len(joints) and not _whole(sensors.wrench):
        return None
    builder = RowBuilder(robot, contacts, sensors)
    columns = _prior_columns(builder, robot, samples)
    nominal = builder.columns.parameter_map() @ robot.nominal.flatten()
    parts = []
    for part in samples:
        rows, W, equations = _whitened_rows(builder, part)
        torque = np.zeros((len(part), builder.tree.base_rows + robot.n_dofs, len(joints)))
        for index, joint in enumerate(joints):
            torque[:, builder.tree.base_rows + joint, index] = builder.recorded_torque(part)[:, joint].numpy()
        moved = np.concatenate([torque, _about(builder, part, sensors.wrench)], axis=2)
        through = np.einsum("nvr,nvk->nrk", W, moved)
        without = rows[..., -1] - through[..., : len(joints)].sum(axis=2)
        target = rows[..., :-1] @ nominal - without
        rate = part.joint_velocity
        loose = _of_joints(builder, W, torch.sign(rate), rate, torch.ones_like(rate))
        K = np.concatenate([rows[..., :-1] @ columns, *loose], axis=2)
        parts.append((K, np.concatenate([target[..., None], through], axis=2), equations))
    return _solved(_accumulate_blocks(*(np.concatenate(part) for part in zip(*parts, strict=True))), joints)


def _about(builder: RowBuilder, samples: Samples, measured: np.ndarray) -> FloatArray:
    """What wrenches about a point one unit off along each axis would add, (N, n_rows, 3)."""
    n_rows = builder.tree.n_rows
    out = np.zeros((len(samples), n_rows, 3))
    if not _whole(measured):
        return out
    with torch.no_grad():
        terms = builder.dynamics(samples)
        J = builder.contact_jacobian(samples).numpy()
        for k in range(len(measured)):
            force = builder.recorded_wrench(samples, k, terms)[:, :3].numpy()
            force = np.where(samples.active[:, k, None].numpy(), force, 0.0)
            for axis in range(3):
                out[..., axis] += np.einsum("niv,ni->nv", J[:, k, 3:], np.cross(np.eye(3)[axis], force))
    return out


def _whole(measured: np.ndarray) -> bool:
    """Whether contacts (C, 6) are measured with all their moments."""
    return bool(measured.size and measured.all())


def _solved(found: _NormalEquations, joints: np.ndarray) -> TorqueGains:
    m = len(joints)
    start = np.append(np.ones(m), np.zeros(3))
    prior = np.append(np.full(m, _GAIN), np.full(3, _POINT)) ** -2.0

    def solve(block: int | None) -> tuple[FloatArray, FloatArray, float]:
        G = found.unexplained(block)
        H = G[1:, 1:] + np.diag(10.0 * prior)
        x = np.linalg.solve(H, G[1:, 0] + 10.0 * prior * start)
        left = G[0, 0] - 2.0 * G[0, 1:] @ x + x @ G[1:, 1:] @ x
        return np.asarray(x), np.asarray(np.diag(np.linalg.inv(H))), float(left)

    x, variance, left = solve(None)
    size = max(1.0, left / max(found.rows, 1))
    blocks = np.array([solve(block)[0] for block in range(BLOCKS)])
    return TorqueGains(joints, x[:m], x[m:], np.sqrt(10.0 * size * variance), blocks)
