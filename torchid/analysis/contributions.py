"""What each log, contact state and sensor adds: what would be lost without it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from torchid.analysis.information import Knowledge, prior_directions
from torchid.analysis.left_out import Contribution, PartContribution, ScaledParts, Unknowns, left_out
from torchid.analysis.sensor_information import SAMPLES, SensorInformation, sensor_information, sum_of
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.plan import state_name
from torchid.problem.streaming import Part
from torchid.problem.threads import one_thread


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

    Only the bodies' parameters are asked for: offsets and the like count as unknown, those of a log in every log anew.
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
    unknowns = Unknowns.of(builder, directions)
    data = ScaledParts(parts, directions, unknowns)
    by_log = left_out(data, [part.source for part in parts], rank_tolerance)
    by_state = left_out(data, [state_name(builder.contacts, part.state) for part in parts], rank_tolerance)
    by_state.sort(key=lambda state: -state.samples)
    information = _sensor_information(logs, builder, directions, unknowns, done)
    sensors = _sensors(information.without(unknowns.of_all), builder, dof_names)
    return Contributions(Knowledge.of(data.everything**2), by_log, by_state, sensors)


def _sensor_information(
    logs: Sequence[Samples],
    builder: RowBuilder,
    directions: Array,
    unknowns: Unknowns,
    done: Callable[[int], None] | None,
) -> SensorInformation:
    """As `sensor_information` has it, in scaled columns, without what is unknown in each log."""

    def scaled(H: Array) -> Array:
        return np.asarray(directions.T @ H @ directions)

    if not unknowns.of_log:
        return sensor_information(logs, builder, done=done).changed(scaled)
    sources = {samples.source: [other for other in logs if other.source == samples.source] for samples in logs}
    most = max(SAMPLES // len(sources), 1)
    found = (sensor_information(same, builder, most, done).changed(scaled) for same in sources.values())
    return sum_of([information.without(unknowns.of_log) for information in found])


def _sensors(information: SensorInformation, builder: RowBuilder, dof_names: Sequence[str]) -> list[SensorContribution]:
    everything, out = _known(information.total), []
    frames = [contact.frame for contact in builder.contacts]
    limbs = [name.rpartition(".")[0] for name in dof_names[builder.tree.n :: 6]]
    for kind, names, lost in (
        ("joint torque", dof_names, information.torques),
        ("wrench in a limb", limbs, information.limbs),
        ("contact wrench", frames, information.wrenches),
    ):
        for place, H in lost.items():
            gone = everything - _known(information.total - H)
            out.append(SensorContribution(names[place], gone.bits, gone.determined, kind))
    return sorted(out, key=lambda found: -found.bits)


def _known(H: Array) -> Knowledge:
    return Knowledge.of(np.asarray(np.linalg.eigvalsh(H)))
