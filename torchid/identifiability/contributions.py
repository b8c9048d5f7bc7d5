"""Contributions of each log, contact state and sensor: the information that is lost without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchid.identifiability.information import (
    SAMPLES,
    InformationGain,
    SensorInformation,
    add_information,
    prior_directions,
    sensor_information,
    triangular_factor,
)
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import ProgressCallback, one_thread
from torchid.problem.compression import Part
from torchid.problem.contact_state import state_name
from torchid.problem.elimination import eliminate_columns
from torchid.rounding import RANK_TOLERANCE, numerical_rank


@dataclass(frozen=True)
class Contribution:
    """Bits and combinations, as in `InformationGain`, that are lost without a part of the data."""

    name: str
    bits: float
    determined: float


@dataclass(frozen=True)
class PartContribution(Contribution):
    """Of a log or a contact state: its samples, the rank of its rows alone, and how far that of all falls without."""

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
        logs: bound logs.
        builder: of their rows.
        problem: of all parts; only its scales and what is free matter.
        dof_names: of the robot.
        rank_tolerance: as in `LeastSquares`.
        done: called with the number of samples worked through.
    """
    directions = prior_directions(builder, problem.scale * problem.free)
    nuisance = NuisanceColumns.of(builder, directions)
    data = ScaledParts(parts, directions, nuisance)
    by_log = leave_one_out(data, [part.source for part in parts], rank_tolerance)
    by_state = leave_one_out(data, [state_name(builder.contacts, part.state) for part in parts], rank_tolerance)
    by_state.sort(key=lambda state: -state.samples)
    information = _sensor_information(logs, builder, directions, nuisance, done)
    sensors = _sensors(information.marginal(nuisance.of_all), builder, dof_names)
    return Contributions(InformationGain.of(data.everything**2), by_log, by_state, sensors)


@dataclass(frozen=True)
class NuisanceColumns:
    """Places of the columns of nuisance parameters: offsets, scales and actuator terms.

    Attributes:
        of_log: among scaled columns, those that each log has anew.
        of_all: those that all logs have in common, among the columns without `of_log`.
    """

    of_log: list[int]
    of_all: list[int]

    @classmethod
    def of(cls, builder: RowBuilder, directions: Array) -> NuisanceColumns:
        """Of the columns `directions`, as `prior_directions` has them, the nuisance parameters last."""
        first = directions.shape[1] - len(builder.extras)
        own = [first + number for number, extra in enumerate(builder.extras) if extra.per_log]
        return cls(own, list(range(first, directions.shape[1] - len(own))))


class ScaledParts:
    """Parts of logs, and X of each with `X^T X` its information in scaled columns, correlated noise counted."""

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
        nothing = np.empty((0, self._factors[0].shape[1] - len(self.nuisance.of_log)))
        logs = (triangular_factor(np.concatenate(same)) for same in by_source.values())
        of_sources = (eliminate_columns(X, self.nuisance.of_log) for X in logs)
        return triangular_factor(np.concatenate([nothing, *of_sources]))

    @cached_property
    def everything(self) -> Array:
        """Singular values of all parts together."""
        return self.singular_values(self.together(range(len(self.parts))))

    def singular_values(self, X: Array) -> Array:
        """Of X of several logs with nuisance parameters eliminated, descending."""
        return np.asarray(
            np.linalg.svd(eliminate_columns(triangular_factor(X), self.nuisance.of_all), compute_uv=False)
        )


def leave_one_out(data: ScaledParts, names: Sequence[str], rank_tolerance: float) -> list[PartContribution]:
    """The contribution of the parts of each name: what is lost without them.

    Args:
        data: all parts.
        names: of each.
        rank_tolerance: as in `LeastSquares`.
    """
    groups = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    factors = [data.together(chosen) for chosen in groups.values()]
    everything, out = data.everything, []
    for (name, chosen), factor, others in zip(
        groups.items(), factors, _information_of_others(data, groups, factors), strict=True
    ):
        rest = data.singular_values(others)
        lost = InformationGain.of(everything**2) - InformationGain.of(rest**2)
        rank = _rank(data.singular_values(factor), rank_tolerance)
        rank_lost = _rank(everything, rank_tolerance) - _rank(rest, rank_tolerance)
        samples = sum(data.parts[i].samples for i in chosen)
        out.append(
            PartContribution(
                name=name,
                bits=lost.bits,
                determined=lost.determined,
                samples=samples,
                rank=rank,
                rank_lost=rank_lost,
            )
        )
    return out


def _information_of_others(
    data: ScaledParts, groups: dict[str, list[int]], factors: Sequence[Array]
) -> Iterator[Array]:
    """X of all parts but those of each group."""
    logs = [{data.parts[i].source for i in chosen} for chosen in groups.values()]
    if not data.nuisance.of_log or sum(map(len, logs)) == len(set().union(*logs)):
        yield from _without_each(factors)
        return
    for chosen in groups.values():  # groups share logs, and so their nuisance parameters
        yield data.together([i for i in range(len(data.parts)) if i not in set(chosen)])


def _without_each(factors: Sequence[Array]) -> Iterator[Array]:
    """For every factor, one of all others, from those of the ones before and after it: no pair is merged twice."""
    nothing = factors[0][:0]
    after = [nothing]
    for factor in reversed(factors[1:]):
        after.append(triangular_factor(np.concatenate([factor, after[-1]])))
    before = nothing
    for factor in factors:
        yield np.concatenate([before, after.pop()])
        before = triangular_factor(np.concatenate([before, factor]))


def _rank(values: Array, tolerance: float) -> int:
    """As `LeastSquares` counts it."""
    return numerical_rank(values, tolerance, values.shape)


def _sensor_information(
    logs: Sequence[Samples],
    builder: RowBuilder,
    directions: Array,
    nuisance: NuisanceColumns,
    done: ProgressCallback | None,
) -> SensorInformation:
    """As `sensor_information` has it, in scaled columns, without the nuisance parameters of each log."""

    def scaled(H: Array) -> Array:
        return np.asarray(directions.T @ H @ directions)

    if not nuisance.of_log:
        return sensor_information(logs, builder, done=done).map(scaled)
    sources = {samples.source: [other for other in logs if other.source == samples.source] for samples in logs}
    most = max(SAMPLES // len(sources), 1)
    of_logs = (sensor_information(same, builder, most, done).map(scaled) for same in sources.values())
    return add_information([information.marginal(nuisance.of_log) for information in of_logs])


def _sensors(information: SensorInformation, builder: RowBuilder, dof_names: Sequence[str]) -> list[SensorContribution]:
    everything, out = _gain(information.total), []
    frames = [contact.frame for contact in builder.contacts]
    limbs = [name.rpartition(".")[0] for name in dof_names[builder.tree.n :: 6]]
    for kind, names, lost in (
        ("joint torque", dof_names, information.torques),
        ("wrench in a limb", limbs, information.limbs),
        ("contact wrench", frames, information.wrenches),
    ):
        for index, H in lost.items():
            gone = everything - _gain(information.total - H)
            out.append(SensorContribution(names[index], gone.bits, gone.determined, kind))
    return sorted(out, key=lambda sensor: -sensor.bits)


def _gain(H: Array) -> InformationGain:
    return InformationGain.of(np.asarray(np.linalg.eigvalsh(H)))
