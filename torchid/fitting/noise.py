"""The noise that rows are weighted with: as stated, and estimated from the residuals of a fit where it is not."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.extras import noise_key
from torchid.problem.noise import (
    GroupVariances,
    LogOfOtherProcess,
    SampledRows,
    VarianceComponentEstimator,
    fitted_directions,
    noise_of_sensors,
)
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet

_SETTLED = 0.05  # change of the deviation along any group's directions: weights 10 % off cost 0.2 % of efficiency
_PASSES = 6
_DIGITS = 3
_APART = 2.0  # where a standard deviation is half of what it should be, 95 % intervals hold the truth in 67 %


@dataclass(frozen=True)
class GroupNoise:
    """Noise of a joint's torque, of other readings, or of base rows along an axis of the levelled base.

    `origin`: "stated", "estimated", "pooled" (residuals do not tell it from that of the other joints, and all are taken
    together), "at most" (drowned in other noise: an upper bound), "confounded" (residuals show little but its sum with
    other noise) or "assumed" (too few readings). `used`: standard deviation that rows were weighted with; `residual`:
    that of the residuals, None if they do not determine it, or nobody has looked.
    """

    group: str
    unit: str
    origin: str
    used: float
    residual: float | None


@dataclass(frozen=True)
class NoiseSummary:
    """What rows were weighted with.

    `groups`: those that the sensors have. `suggested`: keys of `sensors.noise` with what residuals show instead of
    what is stated, empty where they do not contradict it. `passes`: fits of a sample of the logs that it took.
    """

    noise: SensorNoise
    groups: list[GroupNoise]
    suggested: dict[str, Any]
    passes: int

    __repr__ = short_repr

    @property
    def any_stated(self) -> bool:
        """Whether a user has stated any of it."""
        return any(one.origin == "stated" for one in self.groups)

    @property
    def known(self) -> dict[str, Any]:
        """Fields of `noise` that the sensors have a group of, with their values."""
        keys = dict.fromkeys(noise_key(one.group) for one in self.groups)
        return {key: getattr(self.noise, key) for key in keys}


def estimate_noise(
    logs: Sequence[Samples | LogOfOtherProcess],
    fitter: LogFitter,
    stated: Collection[str] = (),
    suggest: bool = True,
) -> NoiseSummary:
    """The noise of sensors, by fits of a sample of the logs that are weighted again until the noise settles.

    Where scales make up all of the forces, residuals say nothing, and the guess is kept.
    Where some noise is stated and some not, the stated one counts as right but for a common factor: a filter leaves
    less of it than was recorded. What is estimated is given in the same proportion::

        summary = torchid.estimate_noise(logs, fitter, stated=["joint_torque"])
        summary.noise  # a SensorNoise, [N m] and [N]

    Source: variance components by iterated minimum norm estimation, see `torchid.problem.noise`.

    Args:
        logs: bound training logs; of processes that share the work each may have some of them.
        fitter: of their rows; its sensors have the stated noise, and a guess where none is stated.
        stated: fields of `SensorNoise` that are stated.
        suggest: whether to find what residuals show of what is stated; without it, nothing is fitted if all is.
    """
    builder, guess = fitter.builder, fitter.builder.sensors.noise
    stds = noise_of_sensors(builder)
    if not suggest and all(noise_key(name) in stated for name in stds):
        groups = [GroupNoise(name, builder.noise_groups.unit(name), "stated", std, None) for name, std in stds.items()]
        return NoiseSummary(builder.noise_groups.noise(stds, guess), groups, {}, 0)
    rows = SampledRows(logs, builder)
    if not (rows.groups and rows.chunks):
        return NoiseSummary(guess, [], {}, 0)
    tied = [name for name in rows.groups if noise_key(name) in stated]
    variance, columns, passes = np.ones(len(rows.groups)), None, 0
    components, homogeneous = GroupVariances.unknown(len(rows.groups)), False
    estimator = VarianceComponentEstimator(rows, tied)
    while True:
        columns, directions, homogeneous = _fit_rows(rows, variance, columns, fitter)
        passes += 1
        if homogeneous:  # the less force, the smaller the residuals
            break
        if len(tied) == len(rows.groups):
            break
        components = estimator.estimate(variance, columns, directions)
        variance = components.variance
        if components.change < _SETTLED or passes == _PASSES:
            break
    free = components
    if tied and suggest and not homogeneous:
        free = VarianceComponentEstimator(rows).estimate(variance, columns, directions)
    common = variance[rows.groups.index(tied[0])] if tied else 1.0
    used = np.where(
        np.isin(rows.groups, tied), rows.reference_std, _rounded(rows.reference_std * np.sqrt(variance / common))
    )
    kept = {name: x for name, x in builder.noise_groups.values(guess).items() if noise_key(name) in stated}
    groups = _listed(rows, tied, used, free)
    noise = builder.noise_groups.noise(kept | {one.group: one.used for one in groups}, guess)
    return NoiseSummary(noise, groups, _suggested(rows, tied, free), passes)


def mean_noise_square(logs: Sequence[Samples], builder: RowBuilder) -> float:
    """Mean square that the builder's noise leaves rows of a sample of the logs: 1 but for task weights."""
    noise = [chunk.sources.square().sum(1) for chunk in SampledRows(logs, builder).chunks]
    return float(sum(x.sum() for x in noise) / max(sum(x.count_nonzero() for x in noise), 1))


def recorded_sensors(
    robot: Robot, contacts: Sequence[Contact], logs: Sequence[Samples], noise: SensorNoise | None = None
) -> SensorSet:
    """All sensors whose every value is in every log; `contacts`: the contacts in use."""
    torque = np.ones(robot.n_dofs, dtype=bool)
    wrench = np.ones((len(contacts), 6), dtype=bool)
    for log in logs:
        torque &= log.torque is not None and log.torque.isfinite().all(0).numpy()
        if log.wrench is None:
            wrench[:] = False
        else:
            wrench &= (log.wrench.isfinite() | ~log.active[..., None]).all(0).numpy()
            if log.wrench_in_world:  # components along a frame's axes take whole vectors
                whole = np.repeat(wrench.reshape(-1, 2, 3).all(axis=2), 3, axis=1)
                scalar = np.array([contact.along_normal for contact in contacts], dtype=bool)[:, None]
                wrench = np.where(scalar, wrench, whole)
    return SensorSet(torque, wrench, noise or SensorNoise())


def _fit_rows(
    rows: SampledRows, variance: Array, before: Mapping[str, Tensor] | None, fitter: LogFitter
) -> tuple[Mapping[str, Tensor], Mapping[str, Tensor], bool]:
    """Parameters by log in the builder's columns, where they were free, and whether no forces at all fit best.

    By least squares without regularization.
    """
    estimator = LeastSquares(rank_tolerance=fitter.estimator.rank_tolerance)
    fit = fitter.fit(rows.compress(variance, before), estimator.solve)
    logs = dict.fromkeys(chunk.log for chunk in rows.chunks)
    columns = {log: fit.columns(rows.builder, log).to("cpu", torch.float64) for log in logs}
    directions = {log: fitted_directions(fit.assembly, rows.builder, log) for log in logs}
    return columns, directions, fit.assembly.homogeneous


def _rounded(values: Array) -> Array:
    """To three digits, so that what is printed is what was used."""
    return np.array([float(f"{x:.{_DIGITS}g}") for x in values])


def _listed(rows: SampledRows, tied: Sequence[str], used: Array, free: GroupVariances) -> list[GroupNoise]:
    shown = _rounded(rows.reference_std * np.sqrt(free.variance)).tolist()
    return [
        GroupNoise(
            group=name,
            unit=rows.builder.noise_groups.unit(name),
            origin="stated" if name in tied else _origin(free, index),
            used=float(used[index]),
            residual=shown[index] if free.estimated[index] else None,
        )
        for index, name in enumerate(rows.groups)
    ]


def _origin(components: GroupVariances, index: int) -> str:
    if not components.estimated[index]:
        return "assumed"
    if components.upper_bound[index]:
        return "at most"
    if components.confounded[index]:
        return "confounded"
    return "pooled" if components.pooled[index] else "estimated"


def _suggested(rows: SampledRows, tied: Sequence[str], free: GroupVariances) -> dict[str, Any]:
    """Noise to state instead, if no common factor of at most 1 brings the stated one within a factor of two.

    Values are by the names of joints, or for the three axes, as `sensors.noise` has them.
    """
    found = _rounded(rows.reference_std * np.sqrt(free.variance))
    clear = free.estimated & ~free.upper_bound & ~free.confounded
    known = {name: float(x) for name, x, yes in zip(rows.groups, found, clear, strict=True) if yes}
    stated = dict(zip(rows.groups, rows.reference_std, strict=True))
    ratios = [known[name] / stated[name] for name in tied if name in known]
    if not ratios or (max(ratios) <= _APART and max(ratios) <= _APART**2 * min(ratios)):
        return {}
    groups = rows.builder.noise_groups
    shown = groups.noise(known, rows.builder.sensors.noise)
    keys = dict.fromkeys(map(noise_key, tied))
    whole = [key for key in keys if all(name in known for name in tied if noise_key(name) == key)]
    return groups.settings({key: getattr(shown, key) for key in whole})
