"""How well parameters predict: whole logs, and blocks of the training logs that a fit has not seen."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from torchid.errors import TorchidWarning
from torchid.problem import RowBuilder, Samples
from torchid.problem.measured import read_components
from torchid.problem.streaming import Part, compress_parts
from torchid.problem.threads import one_thread
from torchid.report.metrics import Evaluation, Metrics
from torchid.report.sums import ForceSums
from torchid.run.calibration import Calibration

Progress = Callable[[int], None]
Pair = tuple[Metrics, Metrics]
"""Of nominal and identified parameters."""


@dataclass(frozen=True)
class CrossValidation:
    """Errors on every block of the training logs of what was fitted without it: `folds` fits, blocks pooled.

    `nominal`: of the URDF's parameters on the same blocks.
    """

    folds: int
    nominal: Metrics
    identified: Metrics


@dataclass
class Residual:
    """Sums of squares of whitened rows: of what is left, and of what was measured."""

    error: float = 0.0
    measured: float = 0.0
    rows: int = 0


@dataclass(frozen=True)
class Judge:
    """What errors are worked out with: `evaluation` of forces, `builder` of the rows that a fit sees."""

    evaluation: Evaluation
    builder: RowBuilder

    def errors(self, logs: Sequence[Samples], both: Sequence[Calibration], progress: Progress | None = None) -> Pair:
        """Of nominal and identified parameters on logs as recorded, each with the unknowns that suit them.

        Rows that a fit would see count where a log has all their sensors.
        """
        parts = [part for log in logs for part in compress_parts([complete(log, self.builder)], self.builder)]
        return _pair(self._metrics([self._sums(logs, parts, both, progress)]))

    def training_errors(
        self,
        logs: Sequence[Samples],
        parts: Sequence[Part],
        both: tuple[Calibration, Calibration],
        left_out: Sequence[tuple[Calibration, Calibration]],
        progress: Progress | None = None,
    ) -> tuple[Pair, CrossValidation | None]:
        """Of the fit on the training logs, and of fits without a fold each on that fold, in one pass.

        Args:
            logs: as `in_folds` has cut them.
            parts: compressed, with the weights of a robust fit.
            both: nominal and identified parameters.
            left_out: those of a fit without each fold, by its number; none without cross-validation.
            progress: called with the number of samples done.
        """
        alike = 0 if self.builder.extras else 1  # nominal parameters of all fits, as far as no unknowns come with them
        sums = []
        for fold in sorted({log.fold for log in logs}):
            of_fold = [log for log in logs if log.fold == fold]
            own = [part for part in parts if part.fold == fold]
            sums.append(self._sums(of_fold, own, [*both, *(left_out[fold][alike:] if left_out else ())], progress))
        metrics = self._metrics(sums)
        if not left_out:
            return _pair(metrics), None
        return _pair(metrics), CrossValidation(len(left_out), metrics[0 if alike else 2], metrics[-1])

    def _sums(
        self,
        logs: Sequence[Samples],
        parts: Sequence[Part],
        calibrations: Sequence[Calibration],
        progress: Progress | None,
    ) -> list[tuple[ForceSums, ForceSums]]:
        """Of the measured forces and of the errors, for each calibration."""
        phi = np.stack([one.parameters(self.evaluation) for one in calibrations])
        if not calibrations[0].changes_readings:
            measured, *errors = self.evaluation.sums(logs, phi, progress)
            pairs = [(_copied(measured), error) for error in errors]
        else:
            pairs = []
            for number, one in enumerate(calibrations):
                with warnings.catch_warnings():
                    if number != 1:  # the identified ones say the same
                        warnings.simplefilter("ignore", TorchidWarning)
                    readings = one.logs(logs)
                measured, error = self.evaluation.sums(readings, phi[number : number + 1], progress if number else None)
                pairs.append((measured, error))
        for (measured, error), squares in zip(pairs, residuals(self.builder, logs, parts, calibrations), strict=True):
            for sums, found in ((measured, squares.measured), (error, squares.error)):
                sums.whitened.add_squares(found, squares.rows)
        return pairs

    def _metrics(self, sums: Sequence[Sequence[tuple[ForceSums, ForceSums]]]) -> list[Metrics]:
        """Of each calibration, over all folds."""
        return [
            self.evaluation.summary(*(ForceSums.total(each) for each in zip(*same, strict=True)))
            for same in zip(*sums, strict=True)
        ]


@one_thread()
def residuals(
    builder: RowBuilder, logs: Sequence[Samples], parts: Sequence[Part], calibrations: Sequence[Calibration]
) -> list[Residual]:
    """What compressed rows of some logs leave at the parameters of each calibration."""
    by_source = {log.source: log for log in reversed(logs)}
    out = [Residual() for _ in calibrations]
    for part in parts:
        R = part.factor.triangle()
        for one, found in zip(calibrations, out, strict=True):
            left = R[:, :-1] @ one.columns(builder, by_source[part.source]).cpu() - R[:, -1]
            found.error += float(left @ left)
            found.measured += float(R[:, -1] @ R[:, -1])
            found.rows += part.factor.rows
    return out


def _pair(metrics: Sequence[Metrics]) -> Pair:
    return metrics[0], metrics[1]


def _copied(sums: ForceSums) -> ForceSums:
    return ForceSums.total([sums])


def complete(log: Samples, builder: RowBuilder) -> Samples:
    """The samples of a log that have every reading of the builder's sensors."""
    sensors, known = builder.sensors, torch.ones(len(log), dtype=torch.bool)
    if sensors.torque.any():
        known &= torch.isfinite(builder.torque(log)[:, torch.from_numpy(sensors.torque)]).all(1)
    needed = torch.from_numpy(read_components(builder.contacts, sensors, log.wrench_in_world))
    touched = log.active[..., None] & needed
    lost = touched if log.wrench is None else touched & ~torch.isfinite(log.wrench)
    known &= ~lost.flatten(1).any(1)
    return log if bool(known.all()) else log[known]
