"""Fits with unknowns beside the bodies' parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from true_robots import hide

from torchid.estimators import Consistent, Estimate, LeastSquares
from torchid.identifiability.confounding import ExtraEstimate, estimate_extras
from torchid.problem import ExtraTerms, RowBuilder, Samples, assemble, compress_parts
from torchid.problem.elimination import Assembly
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet
from torchid.sensing.sensors import recorded_components


@dataclass(frozen=True)
class Fit:
    """A fit with its unknowns by log and label."""

    robot: Robot
    builder: RowBuilder
    assembly: Assembly
    estimate: Estimate
    extras: list[ExtraEstimate]

    @property
    def values(self) -> dict[tuple[str, str], float]:
        """By log and label."""
        return {(x.log, x.extra.label): x.value for x in self.extras}


def fit(
    robot: Robot,
    contacts: Sequence[Contact],
    sensors: SensorSet,
    terms: ExtraTerms,
    logs: Sequence[Samples],
    estimator: LeastSquares | Consistent | None = None,
) -> Fit:
    """Least squares, unless said otherwise, on logs whose unread forces are not even numbers."""
    builder = RowBuilder(robot, contacts, sensors, terms)
    read = [replace(sensors, wrench=recorded_components(contacts, sensors, log.wrench_in_world)) for log in logs]
    seen = [hide(*pair) if contacts else pair[0] for pair in zip(logs, read, strict=True)]
    assembly = assemble(compress_parts(seen, builder, threads=1), builder, robot)
    estimate = (estimator or LeastSquares()).solve(assembly.problem)
    return Fit(robot, builder, assembly, estimate, estimate_extras(assembly, estimate, robot.body_names))
