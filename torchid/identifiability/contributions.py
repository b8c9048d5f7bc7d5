"""Contributions of each log, contact state and sensor: the information lost without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchid.identifiability.information import (
    INFORMATION_SAMPLES,
    InformationGain,
    SensorInformation,
    add_information,
    prior_directions,
    sensor_information,
    triangular_factor,
)
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import ProgressCallback
from torchid.problem.compression import Part
from torchid.problem.contact_state import state_name
from torchid.problem.elimination import eliminate_columns
from torchid.rounding import RANK_TOLERANCE, numerical_rank


@dataclass(frozen=True)
class Contribution:
    """Bits and determined combinations, as in `InformationGain`, that are lost without a part of the data."""

    name: str
    bits: float
    determined: float


@dataclass(frozen=True)
class PartContribution(Contribution):
    """Of a log or a contact state: its samples, the rank of its rows, and the rank that all lose without it."""

    samples: int
    rank: int
    rank_lost: int


@dataclass(frozen=True)
class SensorContribution(Contribution):
    """Of a sensor: `kind` is "joint torque", "wrench in a limb" or "contact wrench", with all measured components."""

    kind: str


@dataclass(frozen=True)
class Contributions:
    """Of all data together, and of each log, contact state (most frequent first) and sensor (largest first)."""

    total: InformationGain
    logs: list[PartContribution]
    states: list[PartContribution]
    sensors: list[SensorContribution]


@one_thread()
def contributions(
    parts: Sequence[Part],
    logs: Sequence[Samples],
    builder: RowBuilder,
    problem: LinearProblem,
    dof_names: Sequence[str],
    rank_tolerance: float = RANK_TOLERANCE,
    done: ProgressCallback | None = None,
) -> Contributions:
    """Leave every log, contact state and sensor out in turn.

    Contributions are to the bodies' parameters: offsets, scales and actuator terms are nuisance parameters. Logs and
    contact states are exact, sensors as in `sensor_information`.

    Args:
        parts: of the logs.
        logs: bound logs; none: sensors are not left out, which takes samples.
        builder: of their rows.
        problem: of all parts, for its scales and free parameters.
        dof_names: of the robot.
        rank_tolerance: as in `LeastSquares`.
        done: called with the number of samples processed.
    """
    directions = prior_directions(builder, problem.scale * problem.free)
    first = directions.shape[1] - len(builder.extras)  # nuisance parameters are last
    of_log = [first + number for number, extra in enumerate(builder.extras) if extra.per_log]
    nuisance = NuisanceColumns(of_log, list(range(first, directions.shape[1] - len(of_log))))
    data = ScaledParts(parts, directions, nuisance)
    by_log = leave_one_out(data, [part.source for part in parts], rank_tolerance)
    by_state = leave_one_out(data, [state_name(builder.contacts, part.state) for part in parts], rank_tolerance)
    by_state.sort(key=lambda state: -state.samples)
    sensors: list[SensorContribution] = []
    if logs:
        information = _sensor_information(logs, builder, directions, nuisance, done)
        sensors = _sensors(information.marginal(nuisance.of_all), builder, dof_names)
    return Contributions(InformationGain.of(data.everything**2), by_log, by_state, sensors)


@dataclass(frozen=True)
class NuisanceColumns:
    """Columns of nuisance parameters: offsets, scales and actuator terms.

    `of_log`: indices of those that differ between logs; `of_all`: of the common ones, after `of_log` are removed.
    """

    of_log: list[int]
    of_all: list[int]


class ScaledParts:
    """Parts of logs with factors X: `X^T X` is a part's information in scaled columns, for correlated noise."""

    def __init__(self, parts: Sequence[Part], directions: Array, nuisance: NuisanceColumns) -> None:
        self.parts, self.nuisance = parts, nuisance
        self._factors = [
            part.factor.triangle().numpy()[:-1, :-1] @ directions / np.sqrt(part.factor.oversampling) for part in parts
        ]

    def together(self, chosen: Sequence[int]) -> Array:
        """X of some parts, with the nuisance parameters of each log eliminated."""
        by_source: dict[str, list[Array]] = {}
        for i in chosen:
            by_source.setdefault(self.parts[i].source if self.nuisance.of_log else "", []).append(self._factors[i])
        empty = np.empty((0, self._factors[0].shape[1] - len(self.nuisance.of_log)))
        logs = (triangular_factor(np.concatenate(same)) for same in by_source.values())
        of_sources = (eliminate_columns(X, self.nuisance.of_log) for X in logs)
        return triangular_factor(np.concatenate([empty, *of_sources]))

    @cached_property
    def everything(self) -> Array:
        """Singular values of all parts together."""
        return self.singular_values(self.together(range(len(self.parts))))

    def singular_values(self, X: Array) -> Array:
        """Of X of several logs with nuisance parameters eliminated, descending."""
        reduced = eliminate_columns(triangular_factor(X), self.nuisance.of_all)
        return np.asarray(np.linalg.svd(reduced, compute_uv=False))


def leave_one_out(data: ScaledParts, names: Sequence[str], rank_tolerance: float) -> list[PartContribution]:
    """Contribution of the parts of each name, by the `names` of all parts; `rank_tolerance` as in `LeastSquares`."""

    def rank(values: Array) -> int:
        return numerical_rank(values, rank_tolerance, values.shape)

    groups = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    factors = [data.together(chosen) for chosen in groups.values()]
    everything, out = data.everything, []
    for name, factor, others in zip(groups, factors, _factors_of_others(data, groups, factors), strict=True):
        without = data.singular_values(others)
        lost = InformationGain.of(everything**2) - InformationGain.of(without**2)
        samples, own_rank = sum(data.parts[i].samples for i in groups[name]), rank(data.singular_values(factor))
        rank_lost = rank(everything) - rank(without)
        out.append(PartContribution(name, lost.bits, lost.determined, samples, own_rank, rank_lost))
    return out


def _factors_of_others(data: ScaledParts, groups: dict[str, list[int]], factors: Sequence[Array]) -> Iterator[Array]:
    """X of all parts except those of each group."""
    logs = [{data.parts[i].source for i in chosen} for chosen in groups.values()]
    if not data.nuisance.of_log or sum(map(len, logs)) == len(set().union(*logs)):
        yield from _without_each(factors)
        return
    for chosen in groups.values():  # groups share logs and their nuisance parameters
        yield data.together([i for i in range(len(data.parts)) if i not in set(chosen)])


def _without_each(factors: Sequence[Array]) -> Iterator[Array]:
    """For each factor one of all others, merged from those before and those after it."""
    empty = factors[0][:0]
    after = [empty]
    for factor in reversed(factors[1:]):
        after.append(triangular_factor(np.concatenate([factor, after[-1]])))
    before = empty
    for factor in factors:
        yield np.concatenate([before, after.pop()])
        before = triangular_factor(np.concatenate([before, factor]))


def _sensor_information(
    logs: Sequence[Samples],
    builder: RowBuilder,
    directions: Array,
    nuisance: NuisanceColumns,
    done: ProgressCallback | None,
) -> SensorInformation:
    """`sensor_information` in scaled columns, without the nuisance parameters of each log."""

    def scaled(H: Array) -> Array:
        return np.asarray(directions.T @ H @ directions)

    if not nuisance.of_log:
        return sensor_information(logs, builder, done=done).map(scaled)
    sources = {samples.source: [other for other in logs if other.source == samples.source] for samples in logs}
    most = max(INFORMATION_SAMPLES // len(sources), 1)
    of_logs = (sensor_information(same, builder, most, done).map(scaled) for same in sources.values())
    return add_information([information.marginal(nuisance.of_log) for information in of_logs])


def _sensors(information: SensorInformation, builder: RowBuilder, dof_names: Sequence[str]) -> list[SensorContribution]:
    """Contributions of all sensors, largest first."""

    def gain(H: Array) -> InformationGain:
        return InformationGain.of(np.asarray(np.linalg.eigvalsh(H)))

    everything, out = gain(information.total), []
    limbs = [name.rpartition(".")[0] for name in dof_names[builder.tree.n :: 6]]
    for kind, names, lost in (
        ("joint torque", dof_names, information.torques),
        ("wrench in a limb", limbs, information.limbs),
        ("contact wrench", [contact.frame for contact in builder.contacts], information.wrenches),
    ):
        for index, H in lost.items():
            difference = everything - gain(information.total - H)
            out.append(SensorContribution(names[index], difference.bits, difference.determined, kind))
    return sorted(out, key=lambda sensor: -sensor.bits)
