"""What each log, contact state and sensor adds: what would be lost without it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from torchid.analysis.information import Knowledge, prior_directions, triangle
from torchid.analysis.sensor_information import SensorInformation, sensor_information
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.plan import state_name
from torchid.problem.streaming import Part
from torchid.problem.threads import one_thread


@dataclass(frozen=True)
class Contribution:
    """Bits and combinations, as in `Knowledge`, that are lost without a part of the data."""

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
    """What all data tell, and what each log, contact state (most frequent first) and sensor adds (most first)."""

    known: Knowledge
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
    rank_tolerance: float = 1e-10,
    done: Callable[[int], None] | None = None,
) -> Contributions:
    """Leave every log, contact state and sensor out in turn.

    Logs and contact states are exact, sensors as in `sensor_information`.

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
    factors = [_information_factor(part, directions) for part in parts]
    states = _groups(parts, factors, [state_name(builder.contacts, part.state) for part in parts])
    states.sort(key=lambda group: -group.samples)
    everything = _singular_values(np.concatenate([group.factor for group in states]))
    by_log, by_contact_state = (
        _left_out(groups, everything, rank_tolerance)
        for groups in (_groups(parts, factors, [part.source for part in parts]), states)
    )
    information = sensor_information(logs, builder, done=done)
    sensors = _sensors(information, directions, builder, dof_names)
    return Contributions(Knowledge.of(everything**2), by_log, by_contact_state, sensors)


def _information_factor(part: Part, directions: Array) -> Array:
    """X with `X^T X` the information of a part, correlated noise taken into account."""
    R = part.factor.triangle().numpy()[:-1, :-1]
    return np.asarray(R @ directions / np.sqrt(part.factor.oversampling))


@dataclass(frozen=True)
class _Group:
    """Parts that are left out together, and X with `X^T X` their information."""

    name: str
    samples: int
    factor: Array


def _groups(parts: Sequence[Part], factors: Sequence[Array], names: Sequence[str]) -> list[_Group]:
    """Parts of one name together."""
    members = {name: [i for i, other in enumerate(names) if other == name] for name in dict.fromkeys(names)}
    return [
        _Group(name, sum(parts[i].samples for i in chosen), triangle(np.concatenate([factors[i] for i in chosen])))
        for name, chosen in members.items()
    ]


def _left_out(groups: Sequence[_Group], everything: Array, rank_tolerance: float) -> list[PartContribution]:
    """What is lost without each group, with the singular values of all together."""
    out = []
    for group, others in zip(groups, _without_each([group.factor for group in groups]), strict=True):
        rest = _singular_values(others)
        lost = Knowledge.of(everything**2) - Knowledge.of(rest**2)
        rank = _rank(_singular_values(group.factor), rank_tolerance)
        rank_lost = _rank(everything, rank_tolerance) - _rank(rest, rank_tolerance)
        out.append(PartContribution(group.name, lost.bits, lost.determined, group.samples, rank, rank_lost))
    return out


def _without_each(factors: Sequence[Array]) -> Iterator[Array]:
    """For every factor, one of all others, from those of the ones before and after it: no pair is merged twice."""
    nothing = factors[0][:0]
    after = [nothing]
    for factor in reversed(factors[1:]):
        after.append(triangle(np.concatenate([factor, after[-1]])))
    before = nothing
    for factor in factors:
        yield np.concatenate([before, after.pop()])
        before = triangle(np.concatenate([before, factor]))


def _singular_values(X: Array) -> Array:
    """Of a matrix, descending."""
    return np.asarray(np.linalg.svd(X, compute_uv=False))


def _rank(values: Array, tolerance: float) -> int:
    """As `LeastSquares` counts it."""
    least = max(tolerance, np.finfo(float).eps * len(values)) * values.max(initial=0.0)
    return int((values > least).sum())


def _sensors(
    information: SensorInformation, directions: Array, builder: RowBuilder, dof_names: Sequence[str]
) -> list[SensorContribution]:
    def known(H: Array) -> Knowledge:
        return Knowledge.of(np.asarray(np.linalg.eigvalsh(directions.T @ H @ directions)))

    everything, out = known(information.total), []
    frames = [contact.frame for contact in builder.contacts]
    limbs = [name.rpartition(".")[0] for name in dof_names[builder.tree.n :: 6]]
    for kind, names, lost in (
        ("joint torque", dof_names, information.torques),
        ("wrench in a limb", limbs, information.limbs),
        ("contact wrench", frames, information.wrenches),
    ):
        for place, H in lost.items():
            gone = everything - known(information.total - H)
            out.append(SensorContribution(names[place], gone.bits, gone.determined, kind))
    return sorted(out, key=lambda found: -found.bits)
