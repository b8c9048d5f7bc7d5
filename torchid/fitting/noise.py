"""The noise that rows are weighed with: as stated, and estimated from the residuals of a fit where it is not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.sensors import NoiseConfig
from torchid.estimators import LeastSquares
from torchid.fitting.experiment import Experiment, Scene
from torchid.fitting.fit import fitted
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.noise import (
    BASE_GROUPS,
    GroupVariances,
    SampledRows,
    VarianceComponentEstimator,
    noise_of_groups,
    std_by_group,
)
from torchid.sensing import SensorNoise, SensorSet

_SETTLED = 0.05  # change of the deviation along any group's directions: weights 10 % off cost 0.2 % of efficiency
_PASSES = 6
_DIGITS = 3
_APART = 2.0  # where a standard deviation is half of what it should be, 95 % intervals hold the truth in 67 %

C = TypeVar("C", bound=ExperimentConfig | AnalyzeConfig)


@dataclass(frozen=True)
class GroupNoise:
    """Noise of a group of readings, or of base rows along an axis of the levelled base.

    `origin`: "stated", "estimated", "at most" (drowned in other noise: an upper bound), "confounded" (residuals show
    little but its sum with other noise) or "assumed" (too few readings). `used`: standard deviation that rows were
    weighed with; `residual`: that of the residuals, None if they cannot tell.
    """

    group: str
    unit: str
    origin: str
    used: float
    residual: float | None


@dataclass(frozen=True)
class NoiseSummary:
    """What rows were weighed with.

    `groups`: those that the sensors have. `suggested`: keys of `sensors.noise` with what residuals show instead of
    what is stated, empty where they do not contradict it. `passes`: fits of a sample of the logs that it took.
    """

    noise: SensorNoise
    groups: list[GroupNoise]
    suggested: dict[str, float | tuple[float, float, float]]
    passes: int


def estimated_noise(
    scene: Scene, sensors: SensorSet, logs: Sequence[Samples], source: object = "experiment"
) -> NoiseSummary:
    """The noise of some sensors, by fits of a sample of the logs that are weighed anew until the noise settles.

    Where some noise is stated and some not, the stated one counts as right but for a common factor: a filter leaves
    less of it than was recorded. What is estimated is given in the same proportion.

    Args:
        scene: robot and settings; noise that these state is kept.
        sensors: whose noise is meant.
        logs: bound training logs.
        source: named in errors.
    """
    stated = {name for name in std_by_group(scene.noise) if _stated(scene, name)}
    builder = RowBuilder(scene.robot, scene.contacts, replace(sensors, noise=scene.noise), scene.terms)
    rows = SampledRows(logs, builder.to(scene.config.device))
    if not (rows.groups and rows.chunks):
        return NoiseSummary(scene.noise, [], {}, 0)
    tied = [name for name in rows.groups if name in stated]
    variance, columns, passes = np.ones(len(rows.groups)), None, 0
    estimator = VarianceComponentEstimator(rows, tied)
    while True:
        columns, problem = _fitted(rows, variance, columns, scene, source)
        passes += 1
        if len(tied) == len(rows.groups):
            break
        found = estimator.estimate(variance, columns, problem)
        variance = found.variance
        if found.change < _SETTLED or passes == _PASSES:
            break
    free = VarianceComponentEstimator(rows).estimate(variance, columns, problem) if tied else found
    common = variance[rows.groups.index(tied[0])] if tied else 1.0
    used = np.where(
        np.isin(rows.groups, tied), rows.reference_std, _rounded(rows.reference_std * np.sqrt(variance / common))
    )
    return _summary(scene.noise, rows, tied, used, free, passes)


def weighed(
    experiment: Experiment, logs: Sequence[Samples], source: object = "experiment"
) -> tuple[Experiment, NoiseSummary]:
    """The experiment with the noise that its training logs show, and what that is."""
    found = estimated_noise(experiment, experiment.sensors, logs, source)
    sensors = replace(experiment.sensors, noise=found.noise)
    return replace(experiment, config=stating(experiment.config, found), sensors=sensors), found


def recorded_sensors(scene: Scene, logs: Sequence[Samples]) -> SensorSet:
    """All sensors whose every value is in every log."""
    torque = np.ones(scene.robot.n_dofs, dtype=bool)
    wrench = np.ones((len(scene.contacts), 6), dtype=bool)
    for log in logs:
        torque &= log.torque is not None and log.torque.isfinite().all(0).numpy()
        if log.wrench is None:
            wrench[:] = False
        else:
            wrench &= (log.wrench.isfinite() | ~log.active[..., None]).all(0).numpy()
            if log.wrench_in_world:  # components along a frame's axes take whole vectors
                wrench = np.repeat(wrench.reshape(-1, 2, 3).all(axis=2), 3, axis=1)
    return SensorSet(torque, wrench, scene.noise)


def stating(config: C, found: NoiseSummary) -> C:
    """Settings that state the noise which was estimated, so that whatever reads them weighs alike."""
    stated = {name: x for name, x in vars(config.sensors.noise).items() if x is not None}
    keys = {one.group.partition(".")[0] for one in found.groups}
    noise = NoiseConfig(**{name: x for name, x in vars(found.noise).items() if name in keys} | stated)
    return replace(config, sensors=replace(config.sensors, noise=noise))


def _stated(scene: Scene, group: str) -> bool:
    return getattr(scene.config.sensors.noise, group.partition(".")[0]) is not None


def _fitted(
    rows: SampledRows, variance: Array, before: Mapping[str, Tensor] | None, scene: Scene, source: object
) -> tuple[Mapping[str, Tensor], LinearProblem]:
    """Parameters by log in the builder's columns, and the problem, by least squares without regularization."""
    estimator = LeastSquares(rank_tolerance=scene.config.estimator.rank_tolerance)
    fit = fitted(rows.compress(variance, before), scene, rows.builder, estimator.solve, source)
    columns = {chunk.log: fit.columns(rows.builder, chunk.log) for chunk in rows.chunks}
    return {log: x.to("cpu", torch.float64) for log, x in columns.items()}, fit.assembly.problem


def _rounded(values: Array) -> Array:
    """To three digits, so that what is printed is what was used."""
    return np.array([float(f"{x:.{_DIGITS}g}") for x in values])


def _summary(
    guess: SensorNoise, rows: SampledRows, tied: Sequence[str], used: Array, free: GroupVariances, passes: int
) -> NoiseSummary:
    deviation = _rounded(rows.reference_std * np.sqrt(free.variance))
    groups = []
    for place, name in enumerate(rows.groups):
        told = bool(free.estimated[place])
        origin = "stated" if name in tied else _origin(free, place)
        unit = "N" if "force" in name else "N m"
        groups.append(GroupNoise(name, unit, origin, float(used[place]), float(deviation[place]) if told else None))
    noise = noise_of_groups(std_by_group(guess) | {one.group: one.used for one in groups})
    known = {
        name: float(x)
        for name, x, yes in zip(
            rows.groups, deviation, free.estimated & ~free.upper_bound & ~free.confounded, strict=True
        )
        if yes
    }
    return NoiseSummary(noise, groups, _suggested(guess, tied, known), passes)


def _origin(found: GroupVariances, place: int) -> str:
    if not found.estimated[place]:
        return "assumed"
    return "at most" if found.upper_bound[place] else "confounded" if found.confounded[place] else "estimated"


def _suggested(
    stated: SensorNoise, tied: Sequence[str], known: Mapping[str, float]
) -> dict[str, float | tuple[float, float, float]]:
    """What residuals show of stated noise, if no common factor of at most 1 explains it to within a factor of two."""
    before = std_by_group(stated)
    ratios = [known[name] / before[name] for name in tied if name in known]
    if not ratios or (max(ratios) <= _APART and max(ratios) <= _APART**2 * min(ratios)):
        return {}
    out: dict[str, float | tuple[float, float, float]] = {}
    for name in tied:
        key = name.partition(".")[0]
        axes = [axis for axis in BASE_GROUPS if axis.partition(".")[0] == key]
        if axes and all(axis in known for axis in axes):
            out[key] = (known[axes[0]], known[axes[1]], known[axes[2]])
        elif not axes and name in known:
            out[key] = known[name]
    return out
