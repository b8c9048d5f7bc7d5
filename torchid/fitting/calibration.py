"""Logs as calibrated sensors would have recorded them, and what actuators add to predictions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from torch import Tensor

from torchid.errors import ConfoundedWarning, LogError, warn
from torchid.estimators import LeastSquares
from torchid.fitting.experiment import Scene
from torchid.fitting.fit import Fit, assembled
from torchid.fitting.robust import loss_of, robust_unknowns
from torchid.identifiability.confounding import ExtraEstimate, disagreements, estimate_extras
from torchid.parameters import Array
from torchid.problem import Evaluation, RowBuilder, Samples, assemble, compress_parts
from torchid.problem.compression import Part
from torchid.problem.extras import Extra
from torchid.problem.predict import calibrated
from torchid.problem.samples import check_forces
from torchid.sensing import SensorSet
from torchid.text import join_names

_NAMED = 6  # sensors or bodies that a warning names

Values = Mapping[tuple[str, str], float]
"""Unknowns beside the bodies' parameters, by log, "" for those of all, and `Extra.label`."""


@dataclass(frozen=True)
class Calibration:
    """Parameters of the bodies, and the unknowns beside them that suit these.

    Attributes:
        scene: robot, contacts and settings.
        sensors: whose unknowns are meant.
        phi: (12 L,), that the unknowns of a new log are fitted with.
        values: what is known.
    """

    scene: Scene
    sensors: SensorSet
    phi: Array
    values: Values
    _of_new_logs: dict[str, Array | float] = field(default_factory=dict, init=False)

    @classmethod
    def both(
        cls, scene: Scene, sensors: SensorSet, phi: Array, found: Iterable[ExtraEstimate]
    ) -> tuple[Calibration, Calibration]:
        """Of nominal and identified parameters, from a fit."""
        known = {(x.log, x.extra.label): (x.nominal_value, x.value) for x in found}
        nominal, identified = ({key: pair[n] for key, pair in known.items()} for n in (0, 1))
        return (
            cls(scene, sensors, scene.robot.nominal.flatten(), nominal),
            cls(scene, sensors, phi, identified),
        )

    @property
    def changes_readings(self) -> bool:
        """Whether readings have offsets or scales."""
        return bool(self.scene.config.sensors.offsets or self.scene.config.sensors.scales)

    def logs(self, logs: Sequence[Samples]) -> list[Samples]:
        """The logs with calibrated readings; what is constant over a log is fitted on one that is new.

        Warns:
            TorchidWarning: a new log lacks sensors, so that its readings are taken as they are.
        """
        if not self.changes_readings:
            return list(logs)
        extras, tree = self._builder.extras, self._builder.tree
        return [calibrated(log, extras, self._values_for(log), tree) for log in logs]

    def parameters(self, evaluation: Evaluation) -> Array:
        """Parameters as `Evaluation.metrics` takes them, (12 L + E,)."""
        return np.append(self.phi, self._known(evaluation.builder.extras, ""))

    def columns(self, builder: RowBuilder, log: Samples) -> Tensor:
        """Parameters in the columns of the rows of a log's sensors, (width,)."""
        return builder.columns_of(np.append(self.phi, self._values_for(log))[None])[0]

    @cached_property
    def _builder(self) -> RowBuilder:
        scene = self.scene
        return RowBuilder(scene.robot, scene.contacts, self.sensors, scene.terms)

    def _known(self, extras: Sequence[Extra], log: str) -> Array:
        """Values of some unknowns, those of a log and of all, 0 where none is known."""
        return np.array([self.values.get((log if x.per_log else "", x.label), 0.0) for x in extras])

    def _values_for(self, log: Samples) -> Array:
        extras = self._builder.extras
        values, own = self._known(extras, log.source), np.array([x.per_log for x in extras])
        if own.any() and not any(source == log.source for source, _ in self.values):
            if log.source not in self._of_new_logs:
                self._of_new_logs[log.source] = self._fitted(log, values[~own])
            values[own] = self._of_new_logs[log.source]
        return values

    def _fitted(self, log: Samples, shared: Array) -> Array | float:
        """Unknowns of a log, with everything else known."""
        scene = self.scene
        try:
            check_forces(log, scene.robot, scene.contacts, self.sensors)
        except LogError as error:
            message = f"{error.source}: {error.field}: {error.found}; offsets and scales of this log stay unknown"
            warn(message)
            return 0.0
        builder, own = self._builder, np.array([x.per_log for x in self._builder.extras])

        def solve(parts: list[Part]) -> Array:
            elimination = assemble(parts, builder, scene.robot).eliminations[0]
            return elimination.inverse @ (elimination.z - elimination.C @ np.append(self.phi, shared))

        def columns(values: Array) -> Tensor:
            extras = np.empty(len(own))
            extras[own], extras[~own] = values, shared
            return builder.columns_of(np.append(self.phi, extras)[None])[0]

        robust = scene.config.estimator.robust
        if robust is None:
            return solve(compress_parts([log], builder))
        return robust_unknowns(log, builder, solve, columns, loss_of(robust.loss, robust.tuning), robust.passes)


def warn_of_confounded(found: Sequence[ExtraEstimate], source: object) -> None:
    """Name the sensors whose offset or scale the data cannot tell from other parameters, and these.

    Warns:
        ConfoundedWarning: one for each log that has some.
    """
    for log in dict.fromkeys(x.log for x in found):
        mixed = [x for x in found if x.log == log and not x.told_apart]
        if mixed:
            named = _grouped(x.extra.label for x in mixed)
            others = _grouped(name for x in mixed for name in x.mixed_with if " of " not in name)
            message = f"{log or source}: {named} cannot be told from {others or 'each other'}; do not trust either"
            advice = "add motion that unloads the sensor, state what is known, or zero the sensor before the log"
            warn(f"{message}; {advice}", ConfoundedWarning)


def warn_of_disagreement(fit: Fit, scene: Scene, builder: RowBuilder, source: object) -> None:
    """Name contact sensors whose readings in the air say nothing of their offsets, or contradict the rest of the data.

    Warns:
        TorchidWarning: one for each log that has some of the one or the other.
    """
    on_ground = [part for part in fit.parts if not part.unloaded]
    if len(on_ground) == len(fit.parts):
        return
    for log in dict.fromkeys(part.source for part in fit.parts):
        gated = {number for part in fit.parts if part.source == log for number in part.gated}
        if gated:
            channels = (builder.extras[number] for number in sorted(gated))
            named = _grouped(f"{x.name} {x.component}" for x in channels)
            message = f"{log}: {named} read exactly 0 in the air, as if masked or clamped"
            warn(f"{message}, which says nothing of their offsets")
    settings = scene.config.estimator
    assembly = assembled(on_ground, builder, scene.robot, settings, source)
    estimate = LeastSquares(settings.pull, settings.rank_tolerance).solve(assembly.problem)
    extras = estimate_extras(assembly, estimate, scene.robot.body_names, settings.rank_tolerance)
    noise = float(np.sqrt(fit.assembly.problem.oversampling) * fit.estimate.residual_std)
    found = disagreements(fit.parts, builder, extras, noise)
    for log in dict.fromkeys(x.log for x in found):
        own = [x for x in found if x.log == log]
        named = "; ".join(
            f"{x.extra.name} {x.extra.component} reads {x.in_the_air:.4g} {x.extra.unit} in the air, where "
            f"{x.in_contact:.4g} +- {x.standard_error:.2g} suits the rest of the data"
            for x in own[:_NAMED]
        )
        more = f"; and {len(own) - _NAMED} more" if len(own) > _NAMED else ""
        advice = "look for drift, a gain, cross talk, wrong contact_active, or noise in the base's motion"
        warn(f"{log}: {named}{more}; {advice}")


def _grouped(labels: Iterable[str]) -> str:
    """Labels by sensor or body, the most frequent first: "scale of l_hip, r_hip; m, mcx of pelvis"."""
    groups: dict[str, dict[str, None]] = {}
    for label in labels:
        first, _, last = label.rpartition(" ")
        groups.setdefault(first, {})[last] = None
    order = sorted(groups, key=lambda first: -len(groups[first]))
    more = f"; and {len(order) - _NAMED} more" if len(order) > _NAMED else ""
    named = ((first, join_names(list(groups[first]), _NAMED)) for first in order[:_NAMED])
    return "; ".join(f"{first} {names}" if " of" in first else f"{names} of {first}" for first, names in named) + more
