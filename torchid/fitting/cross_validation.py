"""Cross-validation on blocks of the training logs: errors on held-out data, and the ridge that predicts it best."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from torchid import distributed
from torchid.errors import LogError, TorchidWarning
from torchid.estimators.least_squares import Minimizer
from torchid.fitting.calibration import Calibration, Comparison, calibration_at, calibrations_at
from torchid.fitting.fit import BatchEstimator, Fit, LogFitter, LogProblem
from torchid.parallel import one_thread, share_between_processes, thread_count
from torchid.parameters import Array
from torchid.problem import Evaluation, ExtraTerms, Metrics, RowBuilder, Samples
from torchid.problem.chunks import ProgressCallback
from torchid.problem.compression import BY_FOLD, Block, Part, compress_parts, merge, split_into_folds
from torchid.problem.elimination import Assembly
from torchid.problem.metrics import ForceSums
from torchid.sensing.sensors import recorded_components
from torchid.settings import RidgeRule


def with_all_readings(log: Samples, builder: RowBuilder) -> Samples:
    """The samples of a log that have every reading of the builder's sensors."""
    sensors, known = builder.sensors, torch.ones(len(log), dtype=torch.bool)
    if sensors.torque.any():
        known &= torch.isfinite(builder.recorded_torque(log)[:, torch.from_numpy(sensors.torque)]).all(1)
    needed = torch.from_numpy(recorded_components(builder.contacts, sensors, log.wrench_in_world))
    touched = log.active[..., None] & needed
    lost = touched if log.wrench is None else touched & ~torch.isfinite(log.wrench)
    known &= ~lost.flatten(1).any(1)
    return log if bool(known.all()) else log[known]


@dataclass(frozen=True)
class ResidualSquares:
    """Sums of squares of whitened rows: of their residuals, of what was measured, and of the noise a filter leaves."""

    error: float
    measured: float
    noise: float
    rows: int


@one_thread()
def sum_residuals(
    builder: RowBuilder, logs: Sequence[Block], parts: Sequence[Part], calibrations: Sequence[Calibration]
) -> list[ResidualSquares]:
    """Squares of the residuals of bound logs' rows, compressed to `parts`, at the parameters of each calibration."""
    by_source = {log.source: log for log in reversed(logs)}
    sums = np.zeros((len(calibrations), 4))
    for part in parts:
        R, log = part.factor.triangle(), by_source[part.source]
        measured, rows = float(R[:, -1] @ R[:, -1]), part.factor.rows
        for number, one in enumerate(calibrations):
            residual = R[:, :-1] @ one.columns(builder, log).cpu() - R[:, -1]
            sums[number] += float(residual @ residual), measured, rows * log.noise_left, rows
    return [ResidualSquares(*squares, rows=int(rows)) for *squares, rows in sums.tolist()]


RIDGES = tuple(float(f"1e{power}") for power in range(-7, 2))
"""Ridges that are tried, in decades: finer steps change predictions by less than their spread over the folds."""

STRONGER = (1.0, 10.0, 100.0)
"""Multiples of the ridge by the size of the residuals that are tried."""

MOST_SCORED, ENOUGH_SCORED = 100_000, 10_000
"""Samples of training logs, evenly spread, that errors of forces are computed of at most, and that are enough of them.
Of a filtered log one in `oversampling` has the whole band of the errors' squares, and so their mean: one in 6 of
60,000, 8700 of them independent, gives errors within 0.1 % of those of all, which chance alone changes by 0.8 %.
"""


@dataclass(frozen=True)
class CrossValidation:
    """Errors on every block of the training logs of what was fitted without it: `folds` fits, blocks pooled.

    `nominal`: of the URDF's parameters on the same blocks.
    """

    folds: int
    nominal: Metrics
    identified: Metrics


@dataclass(frozen=True)
class RidgeChoice:
    """A ridge, and mean squares of whitened residuals on held-out folds by ridge; errors of differences from the best.

    `rule`: which of those within one standard error of the least mean square was taken, the smallest or the largest.
    """

    ridge: float
    tried: tuple[float, ...]
    mean_square: tuple[float, ...]
    standard_error: tuple[float, ...]
    rule: RidgeRule = "auto"

    def __str__(self) -> str:
        if self.rule == "one_standard_error":
            return f"{self.ridge:g}, the largest within one standard error of the best on left-out blocks"
        stronger = "" if self.ridge == self.tried[0] else "; left-out blocks ask for more than usual"
        return f"{self.ridge:g}, by the size of the residuals{stronger}"


@one_thread()
def cross_validate(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms | None = None) -> CrossValidation:
    """Errors of predicted forces on blocks of some logs, each block predicted by the fit of all others.

    Blocks are contiguous in time, see `split_into_folds`: errors of successive samples are alike::

        errors = torchid.cross_validate(logs, fitter)
        errors.identified.rms["joint_torque"], errors.nominal.rms["joint_torque"]  # [N m]

    Args:
        logs: bound logs.
        fitter: of their rows.
        terms: the extra terms of the fitter's builder.

    Raises:
        LogError: too few samples to leave some out.
    """
    builder = fitter.builder
    blocks = split_into_folds(logs, builder)
    problem = fitter.build_problem(compress_parts(blocks, builder))
    compared = calibrations_without_folds(problem, fitter)
    if not compared:
        raise _too_few(logs)
    scorer = Scorer(Evaluation(fitter.robot, builder.contacts, str(builder.device), terms), builder)
    scores = scorer.score_by_fold(blocks, merge(problem.parts, builder, *BY_FOLD), dict(enumerate(compared)))
    return CrossValidation(len(compared), *scores)


@one_thread()
def calibrations_without_folds(fit: Fit | LogProblem, fitter: LogFitter) -> list[Comparison[Calibration]]:
    """For every fold of a fit, in order, nominal parameters and those of all others; none where there is only one.

    Args:
        fit: whose blocks keep the weights and the noise of readings that they have.
        fitter: that it comes from.
    """
    folds = sorted({part.fold for part in fit.parts})
    if len(folds) < 2:
        return []
    blocks = merge(fit.parts, fitter.builder, *BY_FOLD)

    def without(fold: int) -> tuple[Assembly, Minimizer]:
        rest = [block for block in blocks if block.fold != fold]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # the fit of all of them says the same
            assembly = fitter.assemble(rest, fit.assembly.reading_noise)
            return assembly, fitter.estimator.minimize(assembly.problem)

    solved = share_between_processes(folds, without, thread_count())
    return [calibrations_at(assembly, found, fitter.robot, fitter.builder) for assembly, found in solved]


@one_thread()
def choose_ridge(
    parts: Sequence[Part],
    blocks: Sequence[Block],
    fitter: LogFitter,
    estimators: Sequence[BatchEstimator],
    done: Callable[[int], None] | None = None,
    rule: RidgeRule = "auto",
) -> RidgeChoice:
    """The smallest ridge, or the largest, within one standard error of the least error on held-out folds.

    Source: Hastie, Tibshirani, Friedman, "The Elements of Statistical Learning", 7.10; here with the standard error of
    the difference, fold by fold::

        blocks = torchid.split_into_folds(logs, builder)
        parts = torchid.compress_parts(blocks, builder)
        estimators = [torchid.LeastSquares(ridge) for ridge in torchid.RIDGES]
        torchid.choose_ridge(parts, blocks, fitter, estimators).ridge

    Args:
        parts: of the blocks, compressed.
        blocks: training logs, as `split_into_folds` or `fold_compressed` cuts them.
        fitter: of their rows.
        estimators: one for each ridge to try, ascending.
        done: called with the number of fits done.
        rule: which of them is taken.

    Raises:
        LogError: too few samples to leave some out.
    """
    folds = sorted({part.fold for part in parts})
    if len(folds) < 2:
        raise _too_few(blocks)
    together = merge(parts, fitter.builder, *BY_FOLD)
    count = min(max(thread_count(), distributed.world_size()), len(estimators))
    squares = np.empty((len(folds), len(estimators)))
    shares = [(fold, first) for first in range(count) for fold in folds]  # five folds are no two equal halves

    def held_out(share: tuple[int, int]) -> Array:
        return _held_out_squares(share[0], together, blocks, fitter, estimators[share[1] :: count], done)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)  # the fit says the same
        for (fold, first), found in zip(shares, share_between_processes(shares, held_out, thread_count()), strict=True):
            squares[folds.index(fold), first::count] = found
    means = squares.mean(axis=0)
    best, ridges = int(means.argmin()), tuple(float(estimator.ridge) for estimator in estimators)
    error = (squares - squares[:, [best]]).std(axis=0, ddof=1) / np.sqrt(len(folds))
    near = np.flatnonzero(means - means.min() <= error)
    taken = int(near[-1] if rule == "one_standard_error" else near[0])
    return RidgeChoice(ridges[taken], ridges, tuple(means.tolist()), tuple(error.tolist()), rule)


def _held_out_squares(
    fold: int,
    parts: Sequence[Part],
    blocks: Sequence[Block],
    fitter: LogFitter,
    estimators: Sequence[BatchEstimator],
    done: Callable[[int], None] | None,
) -> Array:
    """Mean squares on a fold of what each estimator fits without it."""
    assembly = fitter.build_problem([part for part in parts if part.fold != fold]).assembly
    logs, own = [x for x in blocks if x.fold == fold], [x for x in parts if x.fold == fold]
    fitted = []
    for estimator in estimators:
        found = estimator.minimize(assembly.problem)
        fitted.append(calibration_at(assembly, found, fitter.robot, fitter.builder))
        if done is not None:
            done(1)
    return np.array([left.error / max(left.rows, 1) for left in sum_residuals(fitter.builder, logs, own, fitted)])


def _too_few(logs: Sequence[Block]) -> LogError:
    found = "the training samples are too few to leave blocks of them out"
    return LogError(logs[0].source if logs else "logs", "samples", found, "longer logs")


@dataclass(frozen=True)
class TrainingScore:
    """Errors of a fit on its training logs, and of cross-validation, None where there is only one fold.

    `samples`: number of those whose forces were predicted; the whitened projected residual is that of all samples.
    """

    metrics: Comparison[Metrics]
    cross_validation: CrossValidation | None
    samples: int


@dataclass(frozen=True)
class Scorer:
    """Errors of parameters on logs: `evaluation` predicts forces, `builder` makes the rows of a fit.

    `most`: samples of training logs whose forces are predicted at most; of filtered ones `ENOUGH_SCORED` are enough.
    """

    evaluation: Evaluation
    builder: RowBuilder
    most: int = MOST_SCORED

    def scored(self, logs: Sequence[Block]) -> tuple[int, int]:
        """Of training logs: k so that every k-th sample of each is scored, and the number of these."""
        whole = [log for log in logs if isinstance(log, Samples)]
        lengths, alike = [len(log) for log in whole], min((log.oversampling for log in whole), default=1.0)
        step = max(1, -(-sum(lengths) // self.most), min(int(alike), sum(lengths) // ENOUGH_SCORED))
        while step < max(lengths, default=1) and sum(-(-length // step) for length in lengths) > self.most:
            step += 1  # each log has a first sample
        return step, sum(-(-length // step) for length in lengths)

    def score_logs(
        self, logs: Sequence[Samples], compared: Comparison[Calibration], progress: ProgressCallback | None = None
    ) -> Comparison[Metrics]:
        """Errors on logs as recorded, each with the extra parameters that fit the bodies' parameters best.

        Rows of the fit's sensors count where a log has all their readings.
        """
        pairs = self._force_sums(logs, {log.fold: compared for log in logs} or {0: compared}, progress, 1)
        whole = [with_all_readings(replace(log, motion_noise=None), self.builder) for log in logs]
        _add_squares(pairs, sum_residuals(self.builder, whole, compress_parts(whole, self.builder), compared))
        return Comparison(*(self.evaluation.summarize(*pair) for pair in pairs))

    def score_training(
        self,
        logs: Sequence[Block],
        parts: Sequence[Part],
        compared: Comparison[Calibration],
        without_folds: Sequence[Comparison[Calibration]],
        progress: ProgressCallback | None = None,
    ) -> TrainingScore:
        """Errors of the fit on the training logs, and of fits without a fold each on that fold, in one pass.

        Of many samples every k-th is evaluated; the whitened projected residual comes from all.

        Args:
            logs: as `split_into_folds` or `fold_compressed` has cut them; compressed ones give only the whitened
                projected residual.
            parts: compressed, with the weights of a robust fit.
            compared: parameters of the fit.
            without_folds: those of a fit without each fold, by its number; none without cross-validation.
            progress: called with the number of samples done, of those that are `scored`.
        """
        first = 0 if self.builder.extras else 1  # nominal parameters differ between fits by extra parameters alone
        by_fold: dict[int, Sequence[Calibration]] = {
            fold: [*compared, *(without_folds[fold][first:] if without_folds else ())]
            for fold in sorted({log.fold for log in logs})
        }
        metrics = self.score_by_fold(logs, parts, by_fold, progress)
        count = len(without_folds)
        held_out = CrossValidation(count, metrics[0 if first else 2], metrics[-1]) if count else None
        return TrainingScore(Comparison(*metrics[:2]), held_out, self.scored(logs)[1])

    def score_by_fold(
        self,
        logs: Sequence[Block],
        parts: Sequence[Part],
        compared: Mapping[int, Sequence[Calibration]],
        progress: ProgressCallback | None = None,
    ) -> list[Metrics]:
        """Errors of some parameters each on one fold of the training logs; arguments as `score_training`."""
        whole, step = [log for log in logs if isinstance(log, Samples)], self.scored(logs)[0]
        pairs = self._force_sums(whole, compared, progress, step)
        for fold, of_fold in compared.items():
            own = [log for log in logs if log.fold == fold], [part for part in parts if part.fold == fold]
            _add_squares(pairs, sum_residuals(self.builder, *own, of_fold))
        return [self.evaluation.summarize(*pair) for pair in pairs]

    def _force_sums(
        self,
        logs: Sequence[Samples],
        compared: Mapping[int, Sequence[Calibration]],
        progress: ProgressCallback | None,
        step: int,
    ) -> list[tuple[ForceSums, ForceSums]]:
        """Of the measured forces and of the errors of every `step`-th sample, for each calibration of its log's fold.

        Empty without samples.
        """
        rows, (some, *_) = self.evaluation.robot.n_rows, compared.values()
        if not logs:
            return [(ForceSums(rows), ForceSums(rows)) for _ in some]
        phi = {fold: np.stack([x.parameters(self.evaluation) for x in own]) for fold, own in compared.items()}
        if not some[0].changes_readings:
            measured, *errors = self.evaluation.force_sums([log.every(step) for log in logs], phi, progress)
            return [(ForceSums.total([measured]), error) for error in errors]
        pairs = []
        for number in range(len(some)):
            identified = number == 1  # of all fits, which would say the same
            with warnings.catch_warnings():
                if not identified:
                    warnings.simplefilter("ignore", TorchidWarning)
                readings = [one for log in logs for one in compared[log.fold][number].calibrate([log], step)]
            of_one = {fold: own[number : number + 1] for fold, own in phi.items()}
            measured, error = self.evaluation.force_sums(readings, of_one, progress if identified else None)
            pairs.append((measured, error))
        return pairs


def _add_squares(pairs: Sequence[tuple[ForceSums, ForceSums]], squares: Sequence[ResidualSquares]) -> None:
    """Add the rows of a fit to the sums of measured forces and of errors, for each calibration."""
    for (measured, error), own in zip(pairs, squares, strict=True):
        for sums, square in ((measured, own.measured), (error, own.error)):
            sums.whitened.add_squares(square, own.rows)
        measured.whitened_noise.add_squares(own.noise, own.rows)
