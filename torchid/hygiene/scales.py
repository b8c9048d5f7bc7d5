"""Scales that forces tell against the URDF: of time, of single torques, and the point that wrenches are about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid.hygiene.channels import median_step
from torchid.hygiene.margins import BLOCKS, Terms, gathered, known_sensors, prior_columns, rows_of
from torchid.hygiene.model import DIFFERENTIATED_TO_TRY, bound, filtered
from torchid.logs import Log
from torchid.logs.fields import FloatArray
from torchid.problem import RowBuilder, Samples
from torchid.problem.predict import force_series
from torchid.robot import Robot
from torchid.sensing import Contact

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
class Stretch:
    """What time should be multiplied by, of all samples and of each block, and what stays unexplained.

    `mended`, `recorded`, `still`: rms of what no URDF near the given one explains, in `UNMODELLED` of the forces, with
    time so multiplied, as it is, and if nothing moved.
    """

    factor: float
    blocks: FloatArray
    mended: float
    recorded: float
    still: float


def stretched(log: Log, factor: float) -> Log:
    """The log with its time multiplied by a factor."""
    return replace(log, time=log.time[0] + factor * (log.time - log.time[0]))


def motion_cutoff(log: Log) -> float | None:
    """A cutoff [Hz] by the log's own motion, whatever its time is worth; None where no joint moves."""
    position = log.joint_position[: 2 * (len(log) // 2)]
    power = np.square(np.abs(np.fft.rfft(position - position.mean(axis=0), axis=0))).sum(axis=1)
    power[0] = 0.0
    if not power.sum() > 0.0:
        return None
    last = int(np.searchsorted(np.cumsum(power), _SHARE * power.sum()))
    step = median_step(log)
    return float(min(max(_ABOVE * last, _PERIODS) / (step * len(position)), _OF_RATE / step))


def stretch(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float) -> Stretch:
    """How time would have to be multiplied for gravity and inertia to make up the forces.

    Derived velocities and accelerations scale with the inverse of time and its square, gravity does not: three
    stretches tell the predicted forces at all.

    Raises:
        InputError: the log cannot be filtered, or does not fit the robot.
    """

    def at(factor: float) -> list[Samples]:
        logs = filtered(stretched(log, factor), cutoff_hz / factor, DIFFERENTIATED_TO_TRY)
        return bound(logs, robot, contacts, SAMPLES)

    now, later, still = at(1.0), at(2.0), at(_STILL)
    builder = RowBuilder(robot, contacts, known_sensors(now, robot, contacts))
    parts = []
    columns = prior_columns(builder, robot, now)
    phi = robot.nominal.flatten()[None]
    for one, two, rest in zip(now, later, still, strict=True):
        rows, W, equations = rows_of(builder, rest)
        first, second, none = (force_series(builder, part, phi)[1][0] for part in (one, two, rest))
        quadratic = 2.0 * (first - none) - 4.0 * (second - none)
        terms = [none, first - none - quadratic, quadratic]
        projected = [rows[..., -1], *(np.einsum("nvr,nv->nr", W, term) for term in terms)]
        rate = one.joint_velocity
        loose = _of_joints(builder, W, torch.sign(rate), rate, one.joint_acceleration, torch.ones_like(rate))
        K = np.concatenate([rows[..., :-1] @ columns, *loose], axis=2)
        parts.append((K, np.stack(projected, axis=2), equations))
    found = gathered(*(np.concatenate(part) for part in zip(*parts, strict=True)))
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


def _best(found: Terms) -> Stretch:
    u = np.stack([np.ones_like(_STRETCHES), -np.ones_like(_STRETCHES), -1 / _STRETCHES, -1 / _STRETCHES**2])

    def cost(block: int | None) -> FloatArray:
        return np.asarray(np.einsum("ks,kl,ls->s", u, found.unexplained(block), u))

    every = cost(None)
    blocks = np.array([_STRETCHES[np.argmin(cost(block))] for block in range(BLOCKS)])
    best, one = int(np.argmin(every)), int(np.argmin(np.abs(np.log(_STRETCHES))))
    left = np.sqrt(np.maximum(every, 0.0) / max(found.rows, 1))
    return Stretch(float(_STRETCHES[best]), blocks, *(float(left[i]) for i in (best, one, -1)))


@dataclass(frozen=True, eq=False)
class Gains:
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


def gains(samples: Sequence[Samples], robot: Robot, contacts: Sequence[Contact]) -> Gains | None:
    """Factors of single torques and the point of wrenches; None where neither was measured."""
    sensors = known_sensors(samples, robot, contacts)
    joints = np.flatnonzero(sensors.torque[: robot.n])
    if not len(joints) and not _whole(sensors.wrench):
        return None
    builder = RowBuilder(robot, contacts, sensors)
    columns = prior_columns(builder, robot, samples)
    nominal = builder.columns.from_parameters() @ robot.nominal.flatten()
    parts = []
    for part in samples:
        rows, W, equations = rows_of(builder, part)
        torque = np.zeros((len(part), builder.tree.base_rows + robot.dofs, len(joints)))
        for place, joint in enumerate(joints):
            torque[:, builder.tree.base_rows + joint, place] = builder.torque(part)[:, joint].numpy()
        moved = np.concatenate([torque, _about(builder, part, sensors.wrench)], axis=2)
        through = np.einsum("nvr,nvk->nrk", W, moved)
        without = rows[..., -1] - through[..., : len(joints)].sum(axis=2)
        target = rows[..., :-1] @ nominal - without
        rate = part.joint_velocity
        loose = _of_joints(builder, W, torch.sign(rate), rate, torch.ones_like(rate))
        K = np.concatenate([rows[..., :-1] @ columns, *loose], axis=2)
        parts.append((K, np.concatenate([target[..., None], through], axis=2), equations))
    return _solved(gathered(*(np.concatenate(part) for part in zip(*parts, strict=True))), joints)


def _about(builder: RowBuilder, samples: Samples, measured: np.ndarray) -> FloatArray:
    """What wrenches about a point one unit off along each axis would add, (N, nv, 3)."""
    nv = builder.tree.base_rows + len(builder.columns.joint_rows)
    out = np.zeros((len(samples), nv, 3))
    if not _whole(measured):
        return out
    with torch.no_grad():
        terms = builder.terms(samples)
        J = builder.contact_jacobian(samples).numpy()
        for k in range(len(measured)):
            force = builder.local_wrench(samples, k, terms)[:, :3].numpy()
            force = np.where(samples.active[:, k, None].numpy(), force, 0.0)
            for axis in range(3):
                out[..., axis] += np.einsum("niv,ni->nv", J[:, k, 3:], np.cross(np.eye(3)[axis], force))
    return out


def _whole(measured: np.ndarray) -> bool:
    """Whether contacts (C, 6) are measured with all their moments."""
    return bool(measured.size and measured.all())


def _solved(found: Terms, joints: np.ndarray) -> Gains:
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
    return Gains(joints, x[:m], x[m:], np.sqrt(10.0 * size * variance), blocks)
