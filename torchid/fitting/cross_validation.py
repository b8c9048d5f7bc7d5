"""How well parameters predict unseen blocks and whole logs, and the ridge that does so best."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid.errors import ConfigError, TorchidWarning
from torchid.fitting.calibration import Calibration
from torchid.fitting.experiment import Scene
from torchid.fitting.fit import posed, solved, stand_in, stated_conditions
from torchid.parameters import Array
from torchid.problem import Evaluation, Metrics, RowBuilder, Samples, compress_parts
from torchid.problem.chunks import ProgressCallback, one_thread
from torchid.problem.compression import Part, merge_states
from torchid.problem.extras import recorded_components
from torchid.problem.metrics import ForceSums
from torchid.sensing import SensorSet

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

    def errors(
        self, logs: Sequence[Samples], both: Sequence[Calibration], progress: ProgressCallback | None = None
    ) -> Pair:
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
        progress: ProgressCallback | None = None,
    ) -> tuple[Pair, CrossValidation | None]:
        """Of the fit on the training logs, and of fits without a fold each on that fold, in one pass.

        Args:
            logs: as `split_into_folds` has cut them.
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
        progress: ProgressCallback | None,
    ) -> list[tuple[ForceSums, ForceSums]]:
        """Of the measured forces and of the errors, for each calibration."""
        phi = np.stack([one.parameters(self.evaluation) for one in calibrations])
        if not calibrations[0].changes_readings:
            measured, *errors = self.evaluation.force_sums(logs, phi, progress)
            pairs = [(_copied(measured), error) for error in errors]
        else:
            pairs = []
            for number, one in enumerate(calibrations):
                with warnings.catch_warnings():
                    if number != 1:  # the identified ones say the same
                        warnings.simplefilter("ignore", TorchidWarning)
                    readings = one.logs(logs)
                measured, error = self.evaluation.force_sums(
                    readings, phi[number : number + 1], progress if number else None
                )
                pairs.append((measured, error))
        for (measured, error), squares in zip(pairs, residuals(self.builder, logs, parts, calibrations), strict=True):
            for sums, found in ((measured, squares.measured), (error, squares.error)):
                sums.whitened.add_squares(found, squares.rows)
        return pairs

    def _metrics(self, sums: Sequence[Sequence[tuple[ForceSums, ForceSums]]]) -> list[Metrics]:
        """Of each calibration, over all folds."""
        return [
            self.evaluation.summarize(*(ForceSums.total(each) for each in zip(*same, strict=True)))
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
        known &= torch.isfinite(builder.recorded_torque(log)[:, torch.from_numpy(sensors.torque)]).all(1)
    needed = torch.from_numpy(recorded_components(builder.contacts, sensors, log.wrench_in_world))
    touched = log.active[..., None] & needed
    lost = touched if log.wrench is None else touched & ~torch.isfinite(log.wrench)
    known &= ~lost.flatten(1).any(1)
    return log if bool(known.all()) else log[known]


GRID = tuple(float(f"1e{power}") for power in range(-7, 2))
"""Ridges that are tried, in decades: finer steps change predictions by less than their spread over the folds."""


@dataclass(frozen=True)
class RidgeChoice:
    """A ridge, and the mean square of whitened residuals on left-out folds by ridge tried, with standard errors.

    The errors are those of the difference from the best.
    """

    ridge: float
    tried: tuple[float, ...]
    mean_square: tuple[float, ...]
    standard_error: tuple[float, ...]


def chosen_ridge(
    parts: Sequence[Part],
    blocks: Sequence[Samples],
    scene: Scene,
    sensors: SensorSet,
    builder: RowBuilder,
    source: object = "experiment",
    done: ProgressCallback | None = None,
) -> RidgeChoice:
    """The largest ridge whose error on left-out folds is within a standard error of the least.

    Source: the one-standard-error rule, Hastie, Tibshirani, Friedman, "The Elements of Statistical Learning", 7.10; the
    error is that of the difference between two ridges, fold by fold, which says whether they differ.

    Args:
        parts: of the blocks, compressed.
        blocks: training logs, as `split_into_folds` cuts them.
        scene: robot, contacts and settings.
        sensors: of the fit.
        builder: of the rows.
        source: named in errors.
        done: called with the number of fits done.

    Raises:
        ConfigError: too few samples to leave some out.
    """
    folds = sorted({part.fold for part in parts})
    if len(folds) < 2:
        found = "auto, but the training samples are too few to leave blocks of them out"
        raise ConfigError(source, "estimator.ridge", found, "a number, or longer logs")
    together = merge_states(parts, builder)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # the fit says the same
        squares = np.array([_left_out(fold, together, blocks, scene, sensors, builder, source, done) for fold in folds])
    means = squares.mean(axis=0)
    apart = squares - squares[:, [int(means.argmin())]]
    error = apart.std(axis=0, ddof=1) / np.sqrt(len(folds))
    within = np.flatnonzero(apart.mean(axis=0) <= error)
    return RidgeChoice(float(GRID[within[-1]]), GRID, tuple(means.tolist()), tuple(error.tolist()))


def _left_out(
    fold: int,
    parts: Sequence[Part],
    blocks: Sequence[Samples],
    scene: Scene,
    sensors: SensorSet,
    builder: RowBuilder,
    source: object,
    done: ProgressCallback | None,
) -> Array:
    """Mean squares on a fold of what is fitted without it, one for each ridge tried."""
    settings, robot = scene.config.estimator, scene.robot
    rest = [part for part in parts if part.fold != fold]
    rest, assembly = posed(rest, scene, builder, source)
    conditions = stated_conditions(settings, robot, source)
    logs, own = [x for x in blocks if x.fold == fold], [x for x in parts if x.fold == fold]
    out = []
    for ridge in GRID:
        fit = solved(rest, assembly, scene, stand_in(replace(settings, ridge=ridge), conditions).solve)
        _, identified = Calibration.both(scene, sensors, fit.estimate.phi, fit.extras)
        (left,) = residuals(builder, logs, own, [identified])
        out.append(left.error / max(left.rows, 1))
        if done is not None:
            done(1)
    return np.array(out)
