"""Torques that drift, as with temperature: steady parts of each joint's torque in blocks of time that follow a line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from scipy.special import stdtr

from torchid.errors import InputError
from torchid.log_checks.deviation import COMPARED_SAMPLES, DeviationRows, FilteredLog
from torchid.log_checks.findings import SUSPICIOUS, Finding
from torchid.log_checks.model import bind_some_samples
from torchid.log_checks.scales import CORRELATED_SAMPLES
from torchid.logs.log import FloatArray

#: Blocks of time, of how many samples together: as many times those of other checks, as few are left in each block.
_BLOCKS, _MORE_SAMPLES = 8, 4
#: Share of logs without a drift in which one is found.
_LEVEL = 0.01
#: Drift over the log, over the rms of all torques, that is reported: as of offsets.
_MIN_SHARE = 0.1
_TINY = 1e-9


def check_torque_drift(filtered: FilteredLog) -> Iterator[Finding]:
    """Findings about joints whose torque drifts over the log, for logs that nothing else is wrong with.

    Each joint has an unknown constant torque in each block of time, beside all URDFs near the given one. A drift is
    told by Student's test of their slope, whose noise is how they scatter about the line: whatever the URDF, friction
    and noise do in blocks that are alike is in it. The level is divided by the number of joints (Bonferroni).

    Args:
        filtered: the log.
    """
    log, robot = filtered.log, filtered.model.robot
    if log.joint_torque is None or not np.isfinite(log.joint_torque).any():
        return
    with suppress(InputError):  # reported by `check_forces_against_urdf`
        least = _MIN_SHARE * float(np.sqrt(np.nanmean(np.square(log.joint_torque))))
        slope, deviation = _slopes(filtered)
        known = deviation > 0.0
        chance = 2.0 * stdtr(_BLOCKS - 2, -np.abs(slope[known]) / deviation[known])
        for joint in np.flatnonzero(known)[chance * robot.n < _LEVEL].tolist():
            if abs(slope[joint]) > least:
                name, unit = robot.joint_names[joint], "N" if robot.joint_names[joint] in robot.sliding else "N m"
                text = f"{name}: torques drift by {slope[joint]:+.2g} +- {deviation[joint]:.1g} {unit} over the log"
                advice = "let motors warm up, or cut the log into parts with sensors.offsets: {joint_torque: log}"
                yield Finding("drift", SUSPICIOUS, "joint_torque", text, advice, (name,))


def _slopes(filtered: FilteredLog) -> tuple[FloatArray, FloatArray]:
    """By how much constant torques change over the log, with standard deviations, (n,) each; 0 where unknown."""
    robot, contacts = filtered.model.robot, filtered.model.contacts
    samples = bind_some_samples(filtered.pieces, robot, contacts, _MORE_SAMPLES * COMPARED_SAMPLES)
    rows, n = DeviationRows.of(samples, filtered.model), robot.n
    if rows is None:
        return np.zeros(n), np.zeros(n)
    W, _, K, target = (np.concatenate([part[k] for part in rows.parts]) for k in range(4))
    time = np.concatenate([part.time.numpy() for part in samples])
    base, blocks = rows.builder.tree.base_rows, np.array_split(np.argsort(time, kind="stable"), _BLOCKS)
    steady = W[:, base : base + n].transpose(0, 2, 1)  # (N, r, n)
    K = K[..., : K.shape[2] - n]  # without constants of the whole log
    count, H, g = K.shape[2], [], []
    for number, block in enumerate(blocks):
        own = np.zeros((len(block), K.shape[1], count + _BLOCKS * n))
        own[..., :count] = K[block]
        own[..., count + number * n :][..., :n] = steady[block]
        A = own.reshape(-1, own.shape[2])
        H.append(A.T @ A)
        g.append(A.T @ target[block].reshape(-1))
    prior = np.full(count + _BLOCKS * n, _TINY * np.trace(sum(H)) / len(H[0]))
    prior[:count] = _MORE_SAMPLES * CORRELATED_SAMPLES
    constant = np.linalg.solve(sum(H) + np.diag(prior), -sum(g))[count:].reshape(_BLOCKS, n)
    middle = np.array([time[block].mean() for block in blocks])
    at = (middle - middle.mean()) / max(float(np.ptp(time)), _TINY)
    slope = at @ constant / (at @ at)
    left = constant - constant.mean(axis=0) - np.outer(at, slope)
    seen = np.array([np.square(steady[block]).sum(axis=(0, 1)) for block in blocks]).min(axis=0) > 0.0
    deviation = np.sqrt(np.square(left).sum(axis=0) / ((_BLOCKS - 2) * (at @ at)))
    return seen * slope, seen * deviation
