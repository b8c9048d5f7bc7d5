"""What left-out blocks of the training logs say: terms, data and ridge that predict them best, and errors on them.

A term of the model is columns of the rows, a band or a set of samples is a reading of the same logs. Both are judged by
one score: squares of whitened residuals on left-out blocks, compared block by block.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.special import stdtrit  # scipy.stats takes 0.2 s to import

from torchid import distributed
from torchid.errors import LogError, TorchidWarning
from torchid.estimators.least_squares import Minimizer
from torchid.fitting.fit import (
    BatchEstimator,
    Calibration,
    Comparison,
    Fit,
    LogFitter,
    LogProblem,
    calibration_at,
    calibrations_at,
)
from torchid.parallel import one_thread, share_between_processes, thread_count
from torchid.parameters import Array
from torchid.problem import Evaluation, ExtraTerms, Metrics, RowBuilder, Samples
from torchid.problem.chunks import ProgressCallback
from torchid.problem.compression import BY_FOLD, Block, Part, compress_parts, in_blocks, merge, split_into_folds
from torchid.problem.elimination import Assembly, column_prior
from torchid.problem.extras import SLOPE, Extra, in_words
from torchid.problem.linear import PRIOR_DEVIATION, parameter_scale
from torchid.problem.metrics import ForceSums
from torchid.reprs import short_repr
from torchid.sensing import SensorSet
from torchid.sensing.sensors import recorded_components
from torchid.settings import RidgeRule

TERMS = ("armature", "torque_offset", "delay", "stiffness", "asymmetric_coulomb")
"""Actuator terms that logs choose from; of two that explain the same, the first is kept."""

RIDGE = 0.1
"""Weight of the prior in the mean squared residual: model errors do not average out in a longer log.

Of 1e-3, 1e-2, 0.1 and 1 the one that predicts strangers' logs best, or within 3 % of the best (`docs/estimators.md`).
"""

SAMPLES = 6000
"""Number of evenly spaced samples of all logs for choices."""

_BLOCKS = 20
_FOLDS = 5
_LEAST_PER_BLOCK = 10  # independent samples
_CHANCE = 0.005  # probability that a difference between blocks is only chance
_GAIN = 0.1  # least decrease of the squared error: gain errors of 2 % let absent springs and offsets reach 0.05
_OF_TERMS = 0.01  # weight of the prior for the choice of terms: with more, terms would replace body parameters
_WORSE = 0.1  # accepted increase of the product of squared errors for the wider reading
_EXACT = 1e-14  # fraction of the squared forces; smaller residuals are rounding
_WEAK = 1e-3  # weight of the prior of extra parameters, relative to that of bodies
_BODIES = 0.2  # deviation of bodies that costs as much as one standard deviation of a gain


@dataclass(frozen=True)
class Reading:
    """Training logs, read in one way, as Gram matrices of their rows by block.

    Attributes:
        grams: (G, width + 1, width + 1), right-hand side last.
        rows: (G,), their number.
        oversampling: of these, on average, as in `Samples`.
        nominal: (width,), parameters in the columns, 0 for extra ones.
        spread: (width, P), deviations in the columns per unit of the prior.
        extras: of the last columns.
        gain: standard deviation of the gains of the torque sensors, about their mean, which a fit with "scale" among
            its terms allows for; 0: scales are as free about their mean as other extra parameters.
    """

    grams: Array
    rows: Array
    oversampling: float
    nominal: Array
    spread: Array
    extras: tuple[Extra, ...]
    gain: float = 0.0

    __repr__ = short_repr

    @cached_property
    def noise_variance(self) -> float:
        """Mean squared residual of the best fit with all terms, whatever rows are weighted with."""
        terms = [k for k, extra in enumerate(self.extras) if not (self.gain and is_torque_gain(extra))]
        x = self._solve(self.grams.sum(0), 1e-9 * self.rows.sum(), terms)
        return max(float(x @ self.grams.sum(0) @ x), 0.0) / max(float(self.rows.sum()), 1.0)

    def _normal(self, gram: Array, weight: float, fitted: Collection[int]) -> tuple[Array, Array]:
        """What is fitted in the columns, (width, D), and the normal matrix with the weighted prior."""
        count = len(self.nominal) - len(self.extras)
        gains = np.array([is_torque_gain(self.extras[number]) for number in fitted], dtype=bool)
        unit = np.zeros((len(self.nominal), len(fitted)))
        for k, number in enumerate(fitted):
            unit[count + number, k] = self.gain / _BODIES if self.gain and gains[k] else self.extras[number].size
        if gains.any():  # a common one means another mass of the robot, and small forces have small errors
            unit[:, gains] -= unit[:, gains].mean(axis=1, keepdims=True)
        prior = weight * np.append(np.ones(self.spread.shape[1]), np.where(gains & bool(self.gain), 1.0, _WEAK))
        columns = np.hstack([self.spread, unit])
        normal = columns.T @ gram[:-1, :-1] @ columns
        normal[np.diag_indices_from(normal)] += prior + (np.finfo(float).eps * np.trace(normal) or 1.0)
        return columns, normal

    def _solve(self, gram: Array, weight: float, fitted: Collection[int]) -> Array:
        """Parameters in the columns and -1, (width + 1,), that minimize squares plus the weighted prior."""
        columns, normal = self._normal(gram, weight, fitted)
        right = columns.T @ (gram[:-1, -1] - gram[:-1, :-1] @ self.nominal)
        return np.append(self.nominal + columns @ np.linalg.solve(normal, right), -1.0)

    def by_scales(self, ridge: float) -> Array:
        """Change of the bodies' parameters per unit of each gain of a torque sensor, (J, P), in units of the prior."""
        scales = [k for k, extra in enumerate(self.extras) if is_torque_gain(extra)]
        others = [k for k in range(len(self.extras)) if k not in scales]
        gram = self.grams.sum(0)
        count = len(self.nominal) - len(self.extras)
        columns, normal = self._normal(gram, ridge * float(self.rows.sum()), others)
        at = [count + k for k in scales]
        return np.asarray(-np.linalg.solve(normal, columns.T @ gram[:-1, at])[: self.spread.shape[1]].T)

    @one_thread()
    def left_out(self, terms: Collection[str], judged: Reading | None = None, ridge: float = RIDGE) -> Array:
        """Squared residuals of each block of `judged`, (G,), at parameters fitted to the other blocks of this reading.

        Args:
            terms: kinds of the extra parameters that are fitted; others are 0.
            judged: another reading of the same blocks, of the same columns; None for this one.
            ridge: weight of the prior in the mean squared residual.
        """
        judged = judged or self
        fitted = [number for number, extra in enumerate(self.extras) if kind_of(extra) in terms]
        squares = np.empty(len(judged.rows))
        at_floor = _EXACT * judged.grams[:, -1, -1].sum() / len(judged.rows)
        for fold in range(_FOLDS):
            kept = np.arange(len(self.rows)) % _FOLDS != fold
            weight = ridge * self.noise_variance * self.rows[kept].sum()
            x = self._solve(self.grams[kept].sum(0), weight, fitted)
            for block in range(fold, len(judged.rows), _FOLDS):
                squares[block] = max(float(x @ judged.grams[block] @ x), at_floor)
        return squares

    def in_columns_of(self, other: Reading) -> Reading:
        """The same rows in the columns of a reading that has all extra parameters of this one, and more."""
        count = len(other.nominal) - len(other.extras)
        labels = [extra.label for extra in other.extras]
        columns = (count + labels.index(extra.label) for extra in self.extras)
        at = np.array([*range(count), *columns, len(other.nominal)])
        grams = np.zeros((len(self.rows), *other.grams.shape[1:]))
        grams[:, at[:, None], at] = self.grams
        return replace(other, grams=grams, rows=self.rows)


@one_thread()
def gain_deviations(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms, gain: float) -> Array:
    """Deviations of the parameters by a standard error of the gain of each joint torque sensor, (J, 12 L).

    None, (0, 12 L), where no torque is measured, or scales of torques are fitted.

    Args:
        logs: training logs.
        fitter: of their rows.
        terms: extra parameters of these.
        gain: standard deviation of the gains, 0.02 for 2 %.
    """
    robot = fitter.robot
    count = fitter.robot.nominal.size
    if not (gain and len(logs) and fitter.builder.sensors.torque[: robot.n].any()) or "joint_torque" in terms.scales:
        return np.zeros((0, count))
    wide = with_terms(fitter, replace(terms, scales={**terms.scales, "joint_torque": "all"}))
    thin = thinned(logs)
    reading = compress_reading(thin, {log.source: log.time.numpy()[[0, -1]] for log in thin}, wide)
    free = np.ones(count, dtype=bool) if fitter.frozen is None else ~fitter.frozen
    out = np.zeros((len(wide.builder.extras) - len(fitter.builder.extras), count))
    out[:, free] = gain * reading.by_scales(fitter.estimator.ridge) * parameter_scale(robot.nominal).flatten()[free]
    return out


def kind_of(extra: Extra) -> str:
    """The kind of an extra parameter, one of `TERMS` if logs may choose it."""
    return "delay" if extra.what == SLOPE else extra.what


def is_torque_gain(extra: Extra) -> bool:
    """Whether an extra parameter is the gain of joint torque sensors."""
    return extra.what == "scale" and not extra.component


@one_thread()
def compress_reading(
    logs: Sequence[Samples], edges: Mapping[str, Array], fitter: LogFitter, gain: float = 0.0
) -> Reading:
    """The Gram matrices of logs in blocks.

    Args:
        logs: thinned (`thinned`).
        edges: times between which the blocks of each log lie [s], by its source (`block_edges`).
        fitter: of their rows.
        gain: as in `Reading`.
    """
    builder = fitter.builder
    robot = fitter.robot
    spans = [list(zip(*_ends(log, edges[log.source]), strict=True)) for log in logs]
    first = dict(zip(edges, np.cumsum([0, *(len(x) - 1 for x in edges.values())]).tolist(), strict=False))
    count = sum(len(x) - 1 for x in edges.values())
    grams = np.zeros((count, builder.width + 1, builder.width + 1))
    rows = np.zeros(count)
    for part in compress_parts(in_blocks(logs, spans), builder):
        block = first[part.source] + part.block
        rows[block] += part.factor.rows
        for support, x in part.factor.blocks.items():
            at = [*support, builder.width]
            triangle = x.cpu().double().numpy()
            grams[block][np.ix_(at, at)] += triangle.T @ triangle
    prior = column_prior(builder, robot, fitter.friction)
    free = np.ones(prior.spread.shape[1], dtype=bool) if fitter.frozen is None else ~fitter.frozen
    nominal = np.zeros(builder.width)
    spread = np.zeros((builder.width, int(free.sum())))
    nominal[: builder.columns.count] = prior.nominal
    in_file = {"armature": robot.armature, "stiffness": robot.stiffness}  # of an MJCF robot
    for number, extra in enumerate(builder.extras, builder.columns.count):
        nominal[number] = in_file[extra.what][extra.dof] if extra.what in in_file else 0.0
    spread[: builder.columns.count] = prior.spread[:, free] / PRIOR_DEVIATION
    oversampling = sum(map(len, logs)) / sum(len(log) / log.oversampling for log in logs)
    extras = dict(enumerate(builder.extras, builder.columns.count))
    of_logs = [k for k, extra in extras.items() if extra.per_log and extra.what != "scale"]
    shared_columns = [k for k in range(builder.width) if k not in of_logs]
    grams = np.array([_eliminated(gram, of_logs, [*shared_columns, builder.width]) for gram in grams])
    shared = tuple(extra for k, extra in extras.items() if k not in of_logs)
    return Reading(grams, rows, oversampling, nominal[shared_columns], spread[shared_columns], shared, gain)


def _eliminated(gram: Array, unknown: Sequence[int], kept: Sequence[int]) -> Array:
    """A Gram matrix without the unknowns of its log, at their best values."""
    across = gram[np.ix_(unknown, kept)]
    return np.asarray(gram[np.ix_(kept, kept)] - across.T @ np.linalg.pinv(gram[np.ix_(unknown, unknown)]) @ across)


def thinned(logs: Sequence[Samples], count: int = SAMPLES) -> list[Samples]:
    """About this many evenly spaced samples of all logs; `slope` is the rate of the torques (column of a delay)."""
    step = max(1, sum(map(len, logs)) // count)
    out = []
    for log in logs:
        changes: dict[str, object] = {"folder": None, "motion_noise": None, "unloaded": None}
        if log.torque is not None and len(log) > 1:
            rate = np.gradient(log.torque.numpy(), log.time.numpy(), axis=0)[:, : log.joint_velocity.shape[1]]
            changes["slope"] = torch.from_numpy(rate)
        thin = replace(log, **changes).every(step)  # type: ignore[arg-type]
        out.append(replace(thin, oversampling=max(1.0, log.oversampling / step)))
    return out


def block_edges(logs: Sequence[Samples]) -> dict[str, Array]:
    """Times between which the blocks of each log lie [s], by its source: some `_BLOCKS` in all, fewer of short logs."""
    total = max(sum(map(len, logs)), 1)
    independent = sum(len(log) / log.oversampling for log in logs)
    blocks = min(_BLOCKS, int(independent / _LEAST_PER_BLOCK))
    counts = (max(1, round(blocks * len(log) / total)) for log in logs)
    ends = (
        np.linspace(0, len(log) - 1, count + 1).round().astype(int) for log, count in zip(logs, counts, strict=True)
    )
    return {log.source: log.time.numpy()[at] for log, at in zip(logs, ends, strict=True)}


def _ends(log: Samples, edges: Array) -> tuple[list[int], list[int]]:
    """First sample of each block of a log, and where it ends."""
    inner = np.searchsorted(log.time.numpy(), edges[1:-1]).tolist()
    return [0, *inner], [*inner, len(log)]


def with_terms(fitter: LogFitter, terms: ExtraTerms) -> LogFitter:
    """A fitter of rows with other extra parameters."""
    builder = fitter.builder
    return replace(
        fitter, builder=RowBuilder(fitter.robot, builder.contacts, builder.sensors, terms).to(builder.device)
    )


@dataclass(frozen=True)
class Evidence:
    """By how much one way of fitting predicts left-out blocks better than another.

    Attributes:
        gain: mean decrease of the logarithm of the squared error, over blocks.
        significance: the same over its standard error.
        blocks: their number.
    """

    gain: float
    significance: float
    blocks: int

    @classmethod
    def of(cls, without: Array, better: Array) -> Evidence:
        """From squares by block, (G,) each; blocks without rows do not count."""
        there = (without > 0.0) & (better > 0.0)
        gains = np.log(without[there] / better[there])
        if len(gains) < 3 or not gains.any():
            return cls(0.0, 0.0, len(gains))
        error = float(gains.std(ddof=1)) / math.sqrt(len(gains))
        return cls(float(gains.mean()), float(gains.mean()) / max(error, 1e-300), len(gains))

    @property
    def certain(self) -> bool:
        """Whether chance shows as much in fewer than `_CHANCE` of all cases."""
        return self.blocks > 2 and self.significance > float(stdtrit(self.blocks - 1, 1.0 - _CHANCE))

    @property
    def adopted(self) -> bool:
        """Whether the gain is certain, and no trifle."""
        return self.certain and self.gain > _GAIN

    def __str__(self) -> str:
        return f"{100.0 * math.expm1(-0.5 * self.gain):+.2g} %"  # of the error itself


@one_thread()
def leave_sensors_out(
    logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms, sets: Mapping[str, SensorSet]
) -> dict[str, Evidence]:
    """Gain in the prediction of the remaining rows when sensors are left out of the fit.

    Both fits are judged on the same rows: those of the smaller sensor set. A gain means that the left-out sensor
    contradicts the others.

    Args:
        logs: bound training logs.
        fitter: of the rows of all sensors.
        terms: extra parameters of all sensors.
        sets: smaller sensor sets, by name.

    Source: sensors that make predictions worse, Mistry, Schaal, Yamane 2009, IV-E; the score is that of `choose_terms`.
    """
    thin = thinned(logs)
    all_rows = fitter.builder
    out = dict[str, Evidence]()
    edges = block_edges(thin)
    whole = compress_reading(thin, edges, fitter)
    kinds = {kind_of(extra) for extra in whole.extras}
    for name, sensors in sets.items():
        builder = RowBuilder(fitter.robot, all_rows.contacts, sensors, terms).to(all_rows.device)
        fewer = compress_reading(thin, edges, replace(fitter, builder=builder)).in_columns_of(whole)
        out[name] = Evidence.of(whole.left_out(kinds, fewer), fewer.left_out(kinds))
    return out


@dataclass(frozen=True)
class TermsChoice:
    """Actuator terms that reduce the error on left-out blocks, with the evidence for each.

    `adopted`: by name, the gain over a fit without the term. `rejected`: the gain of a fit with the term in addition.
    """

    adopted: Mapping[str, Evidence]
    rejected: Mapping[str, Evidence]

    def __str__(self) -> str:
        near = {name: x for name, x in self.rejected.items() if x.certain and x.gain > 0.0}
        named, misses = (
            ", ".join(f"{in_words(name)} {evidence}" for name, evidence in x.items()) for x in (self.adopted, near)
        )
        suffix = " (error on left-out blocks)" * bool(named or misses)
        return (named or "none") + (f"; almost adopted: {misses}" if misses else "") + suffix


def choose_terms(reading: Reading, candidates: Sequence[str], fixed: Collection[str] = ()) -> TermsChoice:
    """The terms without which left-out blocks are predicted worse; the least useful one is dropped after another.

    Elimination from all terms, not addition to none: one that is missing hides another (a delay hides rotor inertia).
    What a term is worth is judged where errors of the sensors' gains are fitted as well: these look like a spring at
    joints that move little, and hide rotor inertia. Whether that is chance is judged with these errors and without.

    Args:
        reading: with the columns of all terms.
        candidates: among `TERMS`.
        fixed: kinds of extra parameters that are fitted in any case.
    """
    squares: dict[frozenset[str], Array] = {}

    def left(terms: Collection[str]) -> Array:
        key = frozenset(terms)
        if key not in squares:
            squares[key] = reading.left_out({*terms, *fixed}, None, _OF_TERMS)
        return squares[key]

    def is_needed(name: str) -> Evidence:
        alone, with_gains = (Evidence.of(left({*x} - {name}), left(x)) for x in (chosen, [*chosen, "scale"]))
        return replace(with_gains, significance=max(alone.significance, with_gains.significance))

    chosen = [name for name in TERMS if name in candidates]
    adopted: dict[str, Evidence] = {}
    while chosen:
        adopted = {name: is_needed(name) for name in chosen}
        needless = [name for name in chosen if not adopted[name].adopted]
        if not needless:
            break
        chosen.remove(min(reversed(needless), key=lambda name: round(adopted[name].gain, 3)))
        adopted = {}
    others = [name for name in candidates if name not in chosen]
    rejected = {name: Evidence.of(left(chosen), left([*chosen, name])) for name in others}
    return TermsChoice(adopted, rejected)


def widest(readings: Sequence[Reading], terms: Collection[str]) -> int:
    """Of readings, each a subset of the one before, the first one that no later one predicts better than.

    A reading is better if its fit predicts left-out blocks of both readings clearly better, by the product of their
    squared errors. Disturbances in a wider band, or beside touch-downs, also spoil the fit for clean data.

    Args:
        readings: of the same blocks, the widest first.
        terms: kinds of the fitted extra parameters.
    """
    # a filter that halves the noise also halves the independent samples: the weight of the prior does not change
    ridges = [RIDGE * reading.oversampling / readings[0].oversampling for reading in readings]
    squares = [reading.left_out(terms, None, ridge) for reading, ridge in zip(readings, ridges, strict=True)]
    for number, reading in enumerate(readings[:-1]):
        for other in range(number + 1, len(readings)):
            here = reading.left_out(terms, readings[other], ridges[number])
            there = readings[other]
            of_both = Evidence.of(
                squares[number] * here, squares[other] * there.left_out(terms, reading, ridges[other])
            )
            if of_both.certain and of_both.gain > _WORSE:
                break
        else:
            return number
    return len(readings) - 1


# ---------------------------------------------------------------------------------------------------- cross-validation


def with_all_readings(log: Samples, builder: RowBuilder) -> Samples:
    """The samples of a log that have every reading of the builder's sensors."""
    sensors = builder.sensors
    known = torch.ones(len(log), dtype=torch.bool)
    if sensors.torque.any():
        known &= torch.isfinite(builder.recorded_torque(log)[:, torch.from_numpy(sensors.torque)]).all(1)
    needed = torch.from_numpy(recorded_components(builder.contacts, sensors, log.wrench_in_world))
    touched = log.active[..., None] & needed
    lost = touched if log.wrench is None else touched & ~torch.isfinite(log.wrench)
    known &= ~lost.flatten(1).any(1)
    return log if bool(known.all()) else log[known]


@dataclass(frozen=True)
class ResidualSquares:
    """Sums of squares of whitened rows: residuals, measurements, and the noise that the filter keeps."""

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
        R = part.factor.triangle()
        log = by_source[part.source]
        measured = float(R[:, -1] @ R[:, -1])
        rows = part.factor.rows
        for number, calibration in enumerate(calibrations):
            residual = R[:, :-1] @ calibration.columns(builder, log).cpu() - R[:, -1]
            sums[number] += float(residual @ residual), measured, rows * log.noise_left, rows
    return [ResidualSquares(error, measured, noise, int(rows)) for error, measured, noise, rows in sums.tolist()]


RIDGES = tuple(float(f"1e{power}") for power in range(-7, 2))
"""Ridges that are tried, in decades: finer steps change predictions by less than their spread over the folds."""

STRONGER = (1.0, 10.0, 100.0)
"""Multiples of the ridge (from the size of the residuals) to try."""

MOST_SCORED = 100_000
ENOUGH_SCORED = 10_000
"""Samples of training logs, evenly spread, that errors of forces are computed of at most, and that are enough of them.
Of a filtered log one in `oversampling` has the whole band of the errors' squares, and so their mean: one in 6 of
60,000, 8700 of them independent, gives errors within 0.1 % of those of all, which chance alone changes by 0.8 %.
"""


@dataclass(frozen=True)
class CrossValidation:
    """Errors on every block of the training logs, predicted by fits without this block (`folds` fits, blocks pooled).

    `nominal`: the errors of the URDF's parameters on the same blocks.
    """

    folds: int
    nominal: Metrics
    identified: Metrics


@dataclass(frozen=True)
class RidgeChoice:
    """The chosen ridge, with mean squared whitened residuals on held-out folds for each ridge.

    `standard_error`: of the differences from the best ridge. `rule`: "auto" takes the smallest ridge within one
    standard error of the best, "one_standard_error" the largest.
    """

    ridge: float
    tried: tuple[float, ...]
    mean_square: tuple[float, ...]
    standard_error: tuple[float, ...]
    rule: RidgeRule = "auto"

    def __str__(self) -> str:
        if self.rule == "one_standard_error":
            return f"{self.ridge:g}, the largest within one standard error of the best on left-out blocks"
        stronger = "" if self.ridge == self.tried[0] else ", raised by cross-validation"
        return f"{self.ridge:g}, from the size of the residuals{stronger}"


@one_thread()
def cross_validate(logs: Sequence[Samples], fitter: LogFitter, terms: ExtraTerms | None = None) -> CrossValidation:
    """Errors of predicted forces on blocks of logs; each block is predicted by the fit of all others.

    Blocks are contiguous in time, see `split_into_folds`, because successive errors are correlated::

        errors = torchid.cross_validate(logs, fitter)
        errors.identified.rms["joint_torque"], errors.nominal.rms["joint_torque"]  # [N m]

    Args:
        logs: bound logs.
        fitter: of the rows.
        terms: extra terms of the fitter's builder.

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
    scores = scorer.score(blocks, dict(enumerate(compared)), merge(problem.parts, builder, *BY_FOLD))
    return CrossValidation(len(compared), *scores)


@one_thread()
def calibrations_without_folds(fit: Fit | LogProblem, fitter: LogFitter) -> list[Comparison[Calibration]]:
    """For every fold of a fit, in order: nominal parameters, and those of a fit without the fold.

    Empty for a single fold.

    Args:
        fit: its blocks keep their weights and noise of readings.
        fitter: of the fit.
    """
    folds = sorted({part.fold for part in fit.parts})
    if len(folds) < 2:
        return []
    blocks = merge(fit.parts, fitter.builder, *BY_FOLD)

    def without(fold: int) -> tuple[Assembly, Minimizer]:
        others = [block for block in blocks if block.fold != fold]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # the fit of all of them says the same
            assembly = fitter.assemble(others, fit.assembly.reading_noise)
            return assembly, fitter.estimator.minimize(assembly.problem)

    solved = share_between_processes(folds, without, thread_count())
    return [calibrations_at(assembly, minimizer, fitter.robot, fitter.builder) for assembly, minimizer in solved]


@one_thread()
def choose_ridge(
    parts: Sequence[Part],
    blocks: Sequence[Block],
    fitter: LogFitter,
    estimators: Sequence[BatchEstimator],
    done: Callable[[int], None] | None = None,
    rule: RidgeRule = "auto",
) -> RidgeChoice:
    """Choose the smallest (or largest) ridge whose error on held-out folds is within one standard error of the least.

    The standard error is that of the difference, fold by fold. For example::

        blocks = torchid.split_into_folds(logs, builder)
        parts = torchid.compress_parts(blocks, builder)
        estimators = [torchid.LeastSquares(ridge) for ridge in torchid.RIDGES]
        torchid.choose_ridge(parts, blocks, fitter, estimators).ridge

    Source: Hastie, Tibshirani, Friedman, "The Elements of Statistical Learning", 7.10.

    Args:
        parts: of the blocks, compressed.
        blocks: training logs from `split_into_folds` or `fold_compressed`.
        fitter: of the rows.
        estimators: one for each ridge to try, ascending.
        done: called with the number of fits done.
        rule: "auto" for the smallest, "one_standard_error" for the largest.

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
        for (fold, first), squares_of_fold in zip(
            shares, share_between_processes(shares, held_out, thread_count()), strict=True
        ):
            squares[folds.index(fold), first::count] = squares_of_fold
    means = squares.mean(axis=0)
    best = int(means.argmin())
    ridges = tuple(float(estimator.ridge) for estimator in estimators)
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
    logs = [x for x in blocks if x.fold == fold]
    held_out = [x for x in parts if x.fold == fold]
    fitted = []
    for estimator in estimators:
        minimizer = estimator.minimize(assembly.problem)
        fitted.append(calibration_at(assembly, minimizer, fitter.robot, fitter.builder))
        if done is not None:
            done(1)
    return np.array(
        [squares.error / max(squares.rows, 1) for squares in sum_residuals(fitter.builder, logs, held_out, fitted)]
    )


def _too_few(logs: Sequence[Block]) -> LogError:
    reason = "too few training samples to leave blocks out"
    return LogError(logs[0].source if logs else "logs", "samples", reason, "longer logs")


@dataclass(frozen=True)
class Scorer:
    """Computes errors of parameters on logs: `evaluation` predicts forces, `builder` makes the rows of a fit.

    `most`: largest number of training samples for force errors; `ENOUGH_SCORED` suffice for filtered logs.
    """

    evaluation: Evaluation
    builder: RowBuilder
    most: int = MOST_SCORED

    def scored(self, logs: Sequence[Block]) -> tuple[int, int]:
        """Of training logs: k so that every k-th sample of each is scored, and the number of these."""
        whole = [log for log in logs if isinstance(log, Samples)]
        lengths = [len(log) for log in whole]
        alike = min((log.oversampling for log in whole), default=1.0)
        step = max(1, -(-sum(lengths) // self.most), min(int(alike), sum(lengths) // ENOUGH_SCORED))
        while step < max(lengths, default=1) and sum(-(-length // step) for length in lengths) > self.most:
            step += 1  # each log has a first sample
        return step, sum(-(-length // step) for length in lengths)

    def score(
        self,
        logs: Sequence[Block],
        compared: Mapping[int, Sequence[Calibration]],
        parts: Sequence[Part] | None = None,
        progress: ProgressCallback | None = None,
    ) -> list[Metrics]:
        """Errors of parameters on logs, each with its best extra parameters.

        Args:
            logs: bound; compressed ones give only the whitened projected residual.
            compared: parameters for the logs of each fold.
            parts: training logs, compressed with the weights of the fit; every k-th sample is evaluated. None for other
                logs, whose rows count if a log has all readings of the fit's sensors.
            progress: called with the number of samples done.
        """
        whole = [log for log in logs if isinstance(log, Samples)]
        pairs = self._force_sums(whole, compared, progress, 1 if parts is None else self.scored(logs)[0])
        if parts is None:
            whole = [with_all_readings(replace(log, motion_noise=None), self.builder) for log in whole]
            parts = compress_parts(whole, self.builder)
        for fold, calibrations in compared.items():
            logs_of_fold = [log for log in logs if log.fold == fold]
            parts_of_fold = [part for part in parts if part.fold == fold]
            squares = sum_residuals(self.builder, logs_of_fold, parts_of_fold, calibrations)
            for (measured, error), sums in zip(pairs, squares, strict=True):
                measured.forces.add_squares(sums.measured, sums.rows)
                error.forces.add_squares(sums.error, sums.rows)
                measured.noise.add_squares(sums.noise, sums.rows)
        return [self.evaluation.summarize(*pair) for pair in pairs]

    def score_training(
        self,
        logs: Sequence[Block],
        parts: Sequence[Part],
        compared: Comparison[Calibration],
        without_folds: Sequence[Comparison[Calibration]],
        progress: ProgressCallback | None = None,
    ) -> tuple[Comparison[Metrics], CrossValidation | None]:
        """Errors on the training logs of the fit, and of fits without a fold on this fold, in one pass.

        Args:
            logs: from `split_into_folds` or `fold_compressed`.
            parts: as in `score`.
            compared: parameters of the fit.
            without_folds: parameters of a fit without each fold, by its number; empty without cross-validation.
            progress: called with the number of `scored` samples done.
        """
        first = 0 if self.builder.extras else 1  # nominal parameters differ between fits by extra parameters alone
        by_fold: dict[int, Sequence[Calibration]] = {
            fold: [*compared, *(without_folds[fold][first:] if without_folds else ())]
            for fold in sorted({log.fold for log in logs})
        }
        metrics = self.score(logs, by_fold, parts, progress)
        count = len(without_folds)
        held_out = CrossValidation(count, metrics[0 if first else 2], metrics[-1]) if count else None
        return Comparison(*metrics[:2]), held_out

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
        rows = self.evaluation.robot.n_rows
        (first, *_) = compared.values()
        if not logs:
            return [(ForceSums(rows), ForceSums(rows)) for _ in first]
        phi = {
            fold: np.stack([x.parameters(self.evaluation) for x in calibrations_of_fold])
            for fold, calibrations_of_fold in compared.items()
        }
        if not first[0].changes_readings:
            measured, *errors = self.evaluation.force_sums([log.every(step) for log in logs], phi, progress)
            return [(ForceSums.total([measured]), error) for error in errors]
        pairs = []
        for number in range(len(first)):
            identified = number == 1  # of all fits, which would say the same
            with warnings.catch_warnings():
                if not identified:
                    warnings.simplefilter("ignore", TorchidWarning)
                readings = [reading for log in logs for reading in compared[log.fold][number].calibrate([log], step)]
            of_one = {fold: calibrations_of_fold[number : number + 1] for fold, calibrations_of_fold in phi.items()}
            measured, error = self.evaluation.force_sums(readings, of_one, progress if identified else None)
            pairs.append((measured, error))
        return pairs
