"""Logs as calibrated sensors would have recorded them, and what actuators add to predictions."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchid.analysis.calibration import ExtraEstimate
from torchid.errors import ConfoundedWarning, LogError, TorchidWarning
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.calibrate import calibrated
from torchid.problem.elimination import assemble
from torchid.problem.extras import Extra
from torchid.problem.samples import check_forces
from torchid.problem.streaming import compress_parts
from torchid.report.metrics import Evaluation
from torchid.run.experiment import Experiment

_NAMED = 6  # sensors or bodies that a warning names


@dataclass(frozen=True)
class Calibration:
    """Values of the unknowns beside the bodies' parameters, by `Extra.label`.

    `phi`: (12 L,), that the unknowns of a new log are fitted with. `shared`: of all logs; `by_log`: by source.
    """

    experiment: Experiment
    phi: Array
    shared: Mapping[str, float]
    by_log: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, experiment: Experiment, phi: Array, found: Iterable[ExtraEstimate]) -> Calibration:
        """From a fit."""
        by_log: dict[str, dict[str, float]] = {}
        for x in found:
            by_log.setdefault(x.log, {})[x.extra.label] = x.value
        return cls(experiment, phi, by_log.pop("", {}), by_log)

    def logs(self, logs: Sequence[Samples]) -> list[Samples]:
        """The logs with calibrated readings; what is constant over a log is fitted on one that is new.

        Warns:
            TorchidWarning: a new log lacks sensors, so that its readings are taken as they are.
        """
        config = self.experiment.config.sensors
        if not (config.offsets or config.scales):
            return list(logs)
        builder = self._builder()
        return [calibrated(log, builder.extras, self._values(builder, log), builder.tree) for log in logs]

    def parameters(self, evaluation: Evaluation) -> Array:
        """Parameters as `Evaluation.metrics` takes them, (12 L + E,)."""
        return np.append(self.phi, _values_of(evaluation.builder.extras, self.shared))

    def _builder(self) -> RowBuilder:
        experiment = self.experiment
        return RowBuilder(experiment.robot, experiment.contacts, experiment.sensors, experiment.terms)

    def _values(self, builder: RowBuilder, log: Samples) -> Array:
        values = _values_of(builder.extras, self.shared)
        if any(extra.per_log for extra in builder.extras):
            own = self.by_log[log.source] if log.source in self.by_log else self._fitted(builder, log, values)
            values += _values_of(builder.extras, own)
        return values

    def _fitted(self, builder: RowBuilder, log: Samples, shared: Array) -> dict[str, float]:
        """Unknowns of a log, with everything else known."""
        try:
            check_forces(log, self.experiment.robot, self.experiment.contacts, self.experiment.sensors)
        except LogError as error:
            message = f"{error.source}: {error.field}: {error.found}; offsets and scales of this log stay unknown"
            warnings.warn(message, TorchidWarning, stacklevel=2)
            return {}
        elimination = assemble(compress_parts([log], builder), builder, self.experiment.robot).eliminations[0]
        of_all = [value for extra, value in zip(builder.extras, shared, strict=True) if not extra.per_log]
        values = elimination.inverse @ (elimination.z - elimination.C @ np.append(self.phi, of_all))
        return dict(zip((extra.label for extra in elimination.extras), values.tolist(), strict=True))


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
            warnings.warn(f"{message}; {advice}", ConfoundedWarning, stacklevel=3)


def _grouped(labels: Iterable[str]) -> str:
    """Labels by their beginnings, the most frequent first: "pelvis m mcx, torso m"."""
    groups: dict[str, dict[str, None]] = {}
    for label in labels:
        first, _, last = label.rpartition(" ")
        groups.setdefault(first, {})[last] = None
    order = sorted(groups, key=lambda first: -len(groups[first]))
    more = f" and {len(order) - _NAMED} more" if len(order) > _NAMED else ""
    return ", ".join(" ".join([first, *groups[first]]) for first in order[:_NAMED]) + more


def _values_of(extras: Sequence[Extra], named: Mapping[str, float]) -> Array:
    """Values by label in the order of some unknowns, 0 where none is given."""
    return np.array([named.get(extra.label, 0.0) for extra in extras])
