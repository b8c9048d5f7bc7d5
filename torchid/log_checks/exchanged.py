"""Torques of two joints in each other's place, of all pairs, for every URDF near the given one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from torchid.errors import InputError
from torchid.log_checks.deviation import MAX_LEFT, MIN_UNEXPLAINED_RATIO, DeviationRows, FilteredLog
from torchid.log_checks.findings import REJECTED, Finding
from torchid.log_checks.model import UNMODELLED_FORCE_SHARE
from torchid.log_checks.scales import TIME_BLOCKS, NormalEquations, accumulate_blocks
from torchid.logs.log import FloatArray
from torchid.logs.signal_noise import rough_noise
from torchid.problem import Samples
from torchid.robot import Robot

#: Share of the exchange that corrected torques still ask for: a scale or an offset of one of the two asks for others.
_MAX_SHARE_LEFT = 0.25
#: Readings of a torque whose noise is looked at.
_MIN_READINGS = 20
#: Third singular value of two joints' motions over the first, of more than one rate.
_MIN_THIRD = 0.1
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class _Exchanges:
    """What all pairs of joints (P, 2) explain if their torques are exchanged.

    Attributes:
        pairs: numbers of the joints.
        share: (P,) of the exchange that fits best: 1 where it is a mistake, 0 where it is none.
        without: unexplained forces without any exchange, rms in deviations of the torques.
        left: (P,) the same with it.
        equations: of what the nominal parameters leave, and of the pairs.
    """

    pairs: NDArray[np.intp]
    share: FloatArray
    without: float
    left: FloatArray
    equations: NormalEquations

    def gains(self, pair: int) -> FloatArray:
        """By how much less is unexplained with one exchange, squared, by block of time, (TIME_BLOCKS,)."""
        one, both = self.equations, [0, 1 + pair]
        alone = replace(one, KtY=one.KtY[..., both], YtY=one.YtY[:, both][..., both])
        by_block = (alone.unexplained(block) for block in range(TIME_BLOCKS))
        return np.array([2.0 * G[0, 1] - G[1, 1] for G in by_block])


def check_exchanged_torques(filtered: FilteredLog) -> Finding | None:
    """A finding about two joints whose torques fit the model in each other's place, and only there.

    Torques are compared by the model's in the null space of contacts without a sensor, beside all parameters near the
    URDF's and friction, and relative to each joint's own, so that wrists count as much as shoulders. The exchanged log
    decides, by its own deviations: it must leave little, and the log as recorded more. Before, those of two joints of
    other sizes are wrong, which candidates by a deviation of all torques alike make up for.

    Args:
        filtered: the log.
    """
    if filtered.log.joint_torque is None or not np.isfinite(filtered.log.joint_torque).any():
        return None
    with suppress(InputError):  # reported by `check_forces_against_urdf`
        robot, noise = filtered.model.robot, _noise_of_readings(filtered)
        alike, own = filtered.rows, _rows(filtered, filtered.samples, noise)
        tried = list[tuple[int, ...]]()
        for rows in (alike, own):
            found = None if rows is None else _fit_exchanges(rows, robot)
            best = 0 if found is None else int(np.argmin(found.left))
            if found is None or tuple(found.pairs[best]) in tried or not (found.gains(best) > 0.0).all():
                continue
            pair, order = found.pairs[best], np.arange(robot.n_dofs)
            tried.append(tuple(pair))
            if not _is_told(filtered.samples, pair):
                continue
            order[pair] = pair[::-1]
            corrected = [replace(x, torque=None if x.torque is None else x.torque[:, order]) for x in filtered.samples]
            again = _rows(filtered, corrected, noise[order[: robot.n]])
            after = None if again is None else _fit_exchanges(again, robot)
            if after is not None and _is_right(after, best):
                return _finding(filtered, pair, after.left[best] / max(after.without, _TINY))
    return None


def _is_told(samples: Sequence[Samples], pair: NDArray[np.intp]) -> bool:
    """Whether two joints move at more than one rate: of a sine, either one's torques fit both."""
    parts = [torch.cat([x.joint_position, x.joint_velocity, x.joint_acceleration], 1) for x in samples]
    motion = torch.cat([x.unflatten(1, (3, -1))[..., pair.tolist()].flatten(1) for x in parts])
    motion = motion - motion.mean(0)
    size = torch.linalg.svdvals(motion / torch.linalg.vector_norm(motion, dim=0).clamp(min=_TINY))
    return bool(size[2] > _MIN_THIRD * size[0])


def _is_right(after: _Exchanges, pair: int) -> bool:
    """Whether torques fit as they are, and not if those of a pair are exchanged."""
    worse = after.left[pair] > MIN_UNEXPLAINED_RATIO * after.without and (after.gains(pair) < 0.0).all()
    return bool(worse and after.without < MAX_LEFT and abs(after.share[pair]) < _MAX_SHARE_LEFT)


def _finding(filtered: FilteredLog, pair: NDArray[np.intp], ratio: float) -> Finding:
    first, second = (filtered.model.robot.joint_names[joint] for joint in sorted(pair))
    text = f"{first} and {second} exchanged: {ratio:.2g} times as much of the torques is unexplained as once corrected"
    advice = "give torques in the order of joint_names, as positions"
    return Finding("unit, sign or frame", REJECTED, "joint_torque", text, advice, (first, second))


def _noise_of_readings(filtered: FilteredLog) -> FloatArray:
    """Standard deviation of each joint's torque readings from sample to sample (n,), in the robot's order."""
    log, names = filtered.log, filtered.model.robot.joint_names
    noise, torque = np.zeros(len(names)), np.asarray(log.joint_torque)
    for name, column in zip(log.joint_names, torque.T, strict=True):
        known = column[np.isfinite(column)]
        if name in names and len(known) >= _MIN_READINGS:
            noise[names.index(name)] = rough_noise(known[:, None]).item()
    return noise


def _rows(filtered: FilteredLog, samples: Sequence[Samples], noise: FloatArray) -> DeviationRows | None:
    """Rows of torques relative to each joint's own and to the `noise` of its readings (n,)."""
    torque = np.concatenate([x.torque[:, : len(noise)].numpy() for x in samples if x.torque is not None])
    size = np.sqrt(np.square(np.nan_to_num(torque)).mean(axis=0))
    return DeviationRows.of(samples, filtered.model, np.hypot(UNMODELLED_FORCE_SHARE * size, noise))


def _fit_exchanges(rows: DeviationRows, robot: Robot) -> _Exchanges | None:
    """All exchanges of the torques of two joints, None where fewer than two were measured."""
    builder, n, base = rows.builder, robot.n, robot.base_rows
    measured = (builder.sensors.torque & ~robot.is_passive)[:n]
    pairs = np.array(list(itertools.combinations(np.flatnonzero(measured).tolist(), 2)))
    if not len(pairs):
        return None
    parts = []
    for part, (W, equations, K, target) in zip(rows.samples, rows.parts, strict=True):
        read = builder.recorded_torque(part)[:, :n].numpy()
        first, second = pairs.T
        of_joints = W[:, base : base + n]
        change = (of_joints[:, first] - of_joints[:, second]) * (read[:, second] - read[:, first])[..., None]
        Y = np.concatenate([target[..., None], change.transpose(0, 2, 1)], axis=2)
        parts.append((K[..., : K.shape[2] - n], Y, equations))  # without offsets, which a load at rest may be
    normal = accumulate_blocks(parts)
    G = normal.unexplained()
    product, square = G[0, 1:], np.diag(G)[1:]
    count = max(normal.rows, 1)
    left = np.sqrt(np.maximum(G[0, 0] - 2.0 * product + square, 0.0) / count)
    share = product / np.where(square > 0.0, square, np.inf)
    return _Exchanges(pairs, share, float(np.sqrt(max(G[0, 0], 0.0) / count)), left, normal)
