"""A fit of compressed logs, and logs as the sensors that it has calibrated would have recorded them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from torchid.errors import (
    ConfoundedWarning,
    LogError,
    UnknownNameError,
    about_file,
    current_file,
    join_names,
    warn,
    warn_about_file,
)
from torchid.estimators import Estimate, LeastSquares
from torchid.estimators.least_squares import Minimizer
from torchid.fitting.prior_knowledge import TOTAL, KnownMass, with_known_masses
from torchid.identifiability.confounding import (
    ExtraEstimate,
    Jackknife,
    estimate_extras,
    jackknife_blocks,
    mass_weights,
)
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import Evaluation, LinearProblem, RowBuilder, Samples, assemble, compress_parts
from torchid.problem.compression import Block, CompressedBlock, Part, merge
from torchid.problem.elimination import Assembly
from torchid.problem.extras import ACTUATORS, Extra
from torchid.problem.metrics import calibrate_readings
from torchid.problem.noise_gram import scale_columns
from torchid.problem.samples import require_forces
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.rounding import RANK_TOLERANCE

_TURNS = 10  # of fit and noise of readings; three or four suffice
_SETTLED = 0.02
_LEAST_SCALE = 0.1

Solve = Callable[[LinearProblem], Estimate]
"""An estimator's `solve`."""


class BatchEstimator(Protocol):
    """What solves a compressed problem in one go: `LeastSquares`, `Consistent`, or anything of the same shape."""

    @property
    def ridge(self) -> float:
        """Weight of the regularization towards the nominal parameters."""

    @property
    def rank_tolerance(self) -> float:
        """Share of the largest singular value below which one counts as zero."""

    def solve(self, problem: LinearProblem) -> Estimate:
        """Fit the free parameters."""

    def minimize(self, problem: LinearProblem) -> Minimizer:
        """The parameters of `solve` alone, without statistics."""


@dataclass(frozen=True)
class LogProblem:
    """Compressed logs, with the weights that they have, and the problem that they pose together."""

    parts: list[Part]
    assembly: Assembly

    __repr__ = short_repr


@dataclass(frozen=True)
class Fit:
    """A solved `LogProblem`: parameters of the bodies, and the extra parameters of sensors and actuators.

    `jackknife`: of both over blocks of the logs, None where there are too few.
    """

    parts: list[Part]
    assembly: Assembly
    estimate: Estimate
    extras: list[ExtraEstimate]
    jackknife: Jackknife | None = None

    __repr__ = short_repr

    def columns(self, builder: RowBuilder, log: str) -> Tensor:
        """Parameters in the builder's columns for the rows of a log, (width,)."""
        values = {x.extra.label: x.value for x in self.extras if x.log in ("", log)}
        extras = [values.get(extra.label, 0.0) for extra in builder.extras]
        return builder.to_columns(np.append(self.estimate.phi, extras)[None])[0]


@dataclass(frozen=True, kw_only=True)
class LogFitter:
    """Fits compressed logs of one robot.

    For example, with logs from `bind_log`::

        builder = torchid.RowBuilder(robot, contacts, sensors)
        fitter = torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares(ridge=1e-3))
        fit = fitter.fit(torchid.compress_in_blocks(logs, builder))
        fit.estimate.phi  # (12 L,)

    Attributes:
        robot: with the nominal parameters.
        builder: of the rows, with contacts, sensors, their noise, and extra parameters.
        estimator: finds the parameters, unless a method gets another `solve`.
        friction: whether friction is fitted.
        frozen: (12 L,) bool, parameters that keep their nominal values, from `frozen_parameters`; or None.
        masses: known masses.
    """

    robot: Robot
    builder: RowBuilder
    estimator: BatchEstimator
    friction: bool = True
    frozen: np.ndarray | None = None
    masses: tuple[KnownMass, ...] = ()

    __repr__ = short_repr

    @property
    def least_squares(self) -> LeastSquares:
        """Least squares with the estimator's ridge and rank tolerance, without conditions."""
        return LeastSquares(self.estimator.ridge, rank_tolerance=self.estimator.rank_tolerance)

    @one_thread()
    def fit(self, parts: Sequence[Part], solve: Solve | None = None) -> Fit:
        """Build the problem of compressed logs and solve it.

        Args:
            parts: from `compress_in_blocks` or `compress_parts` of this builder. The latter has folds as blocks; with
                fewer than three, standard errors assume white residuals.
            solve: replaces the estimator's.
        """
        fit = self.solve_problem(
            self.build_problem(merge(parts, self.builder, "source", "state", "fold", "unloaded")), solve
        )
        estimator = self.estimator
        jackknife = jackknife_blocks(parts, self.builder, fit.assembly, estimator.ridge, estimator.rank_tolerance)
        return fit if jackknife is None else with_block_errors(fit, jackknife)

    def assemble(self, parts: Sequence[Part], reading_noise: Mapping[int, float] | None = None) -> Assembly:
        """Build the problem of compressed logs, with extra parameters eliminated and frozen ones fixed.

        Known masses are further rows. If unknown scales multiply all measured forces and no mass is known, the nominal
        total mass counts as known; otherwise zero forces would be the best fit. `reading_noise`: as in `Assembly`.
        """
        assembly = assemble(parts, self.builder, self.robot, self.friction, reading_noise)
        problem = assembly.problem
        known = assembly.if_known
        data = None
        if self.frozen is not None:
            problem, known = (replace(x, free=x.free & ~self.frozen) for x in (problem, known))
        masses = self.masses
        homogeneous = bool(self.builder.extras) and _is_homogeneous(problem, assembly.forces)
        scaled_by = None
        if homogeneous and not masses:
            weights = mass_weights(len(self.robot.bodies))
            scaled_by = float(weights @ problem.nominal)
            masses = (KnownMass(TOTAL, weights, scaled_by),)
        if masses:
            data = problem
            noise = np.sqrt(problem.oversampling) * self.least_squares.solve(problem).residual_std
            problem, known = (with_known_masses(x, masses, noise, homogeneous) for x in (problem, known))
        known_of = {"stated": len(masses), "data": data, "scaled_by": scaled_by, "homogeneous": homogeneous}
        return replace(assembly, problem=problem, if_known=known, **known_of)  # type: ignore[arg-type]

    def build_problem(self, parts: Sequence[Part]) -> LogProblem:
        """Build the problem of compressed logs; contact readings in the air are weighted by their own noise.

        A first least-squares fit shows by how much the rows differ from the stated noise. Fit and noise estimate
        alternate, because the noise of readings with unknown scales depends on the fit.
        """
        problem = LogProblem(list(parts), self.assemble(parts))
        if any(part.unloaded for part in parts):
            first = self.least_squares.solve(problem.assembly.problem)
            weighted = [_with_own_noise(part, first.residual_std) for part in parts]
            problem = LogProblem(weighted, self.assemble(weighted))
        if not scale_columns(self.builder) or problem.assembly.homogeneous:
            return problem
        noise: Mapping[int, float] = {}
        for _ in range(_TURNS):
            noise_found = self._reading_noise(problem)
            if all(abs(noise_found[at] - noise.get(at, 0.0)) <= _SETTLED * noise_found[at] for at in noise_found):
                break
            noise = {at: float(np.sqrt(x * noise.get(at, x))) for at, x in noise_found.items()}  # x alone overshoots
            problem = LogProblem(problem.parts, self.assemble(problem.parts, noise))
        return problem

    def _reading_noise(self, problem: LogProblem) -> dict[int, float]:
        """Value of `Assembly.reading_noise`: mean square residual without motion noise, per squared scale.

        Rows are weighted with the noise of forces, which is that of readings times their scales.
        """
        fit = self.solve_problem(problem, self.least_squares.solve)
        of_motion = 0.0
        no_readings = dict.fromkeys(scale_columns(self.builder), 0.0)
        for log in {part.source: None for part in problem.parts}:
            at = np.append(fit.columns(self.builder, log).cpu().double().numpy(), -1.0)
            for part in problem.parts:
                if part.source == log:
                    of_motion += float(at @ part.factor.whole_noise_gram(no_readings).numpy() @ at)
        variance = max(fit.estimate.residual_std**2 - of_motion / max(fit.assembly.problem.rows, 1), 0.0)
        values = {x.extra.label: 1.0 + x.value for x in fit.extras}
        of_column = zip(no_readings, (x.label for x in self.builder.extras if x.what == "scale"), strict=True)
        scales = ((column, abs(values.get(label, 1.0))) for column, label in of_column)  # 1 where no row depends on it
        return {column: variance / max(scale, _LEAST_SCALE) ** 2 for column, scale in scales}

    def solve_problem(self, problem: LogProblem, solve: Solve | None = None) -> Fit:
        """Solve a problem from `build_problem`; `solve` replaces the estimator's."""
        assembly = problem.assembly
        estimate = (solve or self.estimator.solve)(assembly.problem)
        extras = estimate_extras(assembly, estimate, self.robot.body_names, self.estimator.rank_tolerance)
        return Fit(problem.parts, assembly, estimate, extras)


def _is_homogeneous(problem: LinearProblem, forces: float) -> bool:
    """Whether nothing is left of the measured forces, of this squared norm, once unknown scales are eliminated."""
    fixed = ~problem.free
    forces_left = problem.b - problem.A[:, fixed] @ problem.nominal[fixed]
    return float(forces_left @ forces_left) + problem.residual <= RANK_TOLERANCE**2 * forces


def with_block_errors(fit: Fit, jackknife: Jackknife, factor: float = 1.0) -> Fit:
    """The fit with standard errors by the jackknife, times a factor."""
    estimate = replace(fit.estimate, block_error=factor * jackknife.error)
    errors = {
        (elimination.log, extra.label): factor * float(error)
        for elimination, deviations in zip(fit.assembly.eliminations, jackknife.extras, strict=True)
        for extra, error in zip(elimination.extras, np.linalg.norm(deviations, axis=0), strict=True)
    }
    extras = [replace(x, block_error=errors[x.log, x.extra.label]) for x in fit.extras]
    return replace(fit, estimate=estimate, extras=extras, jackknife=jackknife)


def frozen_parameters(robot: Robot, bodies: Collection[str], field: str = "frozen") -> np.ndarray:
    """Mask of the parameters of bodies, (12 L,) bool, that keep their nominal values.

    Args:
        robot: the robot.
        bodies: names of the bodies.
        field: names the setting in an error.

    Raises:
        UnknownNameError: the robot has no such body.
    """
    frozen = np.zeros((len(robot.bodies), PER_BODY), dtype=bool)
    for name in bodies:
        if name not in robot.body_names:
            raise UnknownNameError.at_field(field, name, robot.body_names)
        frozen[robot.body_names.index(name)] = True
    return frozen.flatten()


def _with_own_noise(part: Part, residual_std: float) -> Part:
    """A part whose readings in the air keep their own noise, although all other rows exceed the stated noise.

    Errors of accelerations and of the model on the ground do not affect a sensor in the air.
    """
    if not part.unloaded or residual_std <= 1.0:
        return part
    return replace(part, factor=part.factor.scaled(residual_std))


# -------------------------------------------------------------------------------------------------------- calibrations

T = TypeVar("T")


class Comparison(NamedTuple, Generic[T]):
    """The same thing of nominal and of identified parameters."""

    nominal: T
    identified: T


ExtraValues = Mapping[tuple[str, str], float]
"""Values of extra parameters, by log ("" for those of all logs) and `Extra.label`."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Parameters of the bodies with extra parameters of sensors and actuators, known or fitted for each new log.

    It corrects the readings of other logs of the same robot to those of calibrated sensors::

        calibration = torchid.calibrations(fit, robot, builder).identified
        corrected = calibration.calibrate(new_logs)  # offsets are fitted for each log, scales of all logs are known

    Attributes:
        robot: the robot.
        builder: of the rows; it has the extra parameters.
        phi: (12 L,), parameters of the bodies.
        values: the known extra parameters.
    """

    robot: Robot
    builder: RowBuilder
    phi: Array
    values: ExtraValues
    _of_new_logs: dict[str, Array | float] = field(default_factory=dict, init=False)

    __repr__ = short_repr

    @property
    def changes_readings(self) -> bool:
        """Whether readings have offsets or scales."""
        return any(extra.what in ("offset", "scale") for extra in self.builder.extras)

    @property
    def of_joints(self) -> list[tuple[Extra, float]]:
        """Extra parameters of joints that some row depends on, with their values."""
        extras = (x for x in self.builder.extras if x.what in ACTUATORS)
        return [(x, self.values["", x.label]) for x in extras if ("", x.label) in self.values]

    def calibrate(self, logs: Sequence[Samples], step: int = 1) -> list[Samples]:
        """Correct the readings of logs. Extra parameters of a new log are fitted first, to all its samples.

        Args:
            logs: as recorded.
            step: return every `step`-th sample.

        Warns:
            TorchidWarning: a new log lacks sensors, so its readings are not corrected.
        """
        if not self.changes_readings:
            return [log.every(step) for log in logs]
        tree = self._on_cpu.tree
        return [calibrate_readings(log.every(step), self.builder.extras, self._values_for(log), tree) for log in logs]

    def parameters(self, evaluation: Evaluation) -> Array:
        """Parameters as `Evaluation.metrics` takes them, (12 L + E,)."""
        return np.append(self.phi, self._known(evaluation.builder.extras, ""))

    def columns(self, builder: RowBuilder, log: Block) -> Tensor:
        """Parameters in a builder's columns for the rows of a log, (width,)."""
        return builder.to_columns(np.append(self.phi, self._values_for(log))[None])[0]

    @cached_property
    def _on_cpu(self) -> RowBuilder:
        """The builder where readings are."""
        builder = self.builder
        return builder if builder.device.type == "cpu" else copy.deepcopy(builder).to(torch.device("cpu"))

    def _known(self, extras: Sequence[Extra], log: str) -> Array:
        """Known extra parameters of a log and of all logs, 0 for unknown ones."""
        return np.array([self.values.get((log if x.per_log else "", x.label), 0.0) for x in extras])

    def _values_for(self, log: Block) -> Array:
        extras = self.builder.extras
        values = self._known(extras, log.source)
        per_log = np.array([x.per_log for x in extras])
        if per_log.any() and not any(source == log.source for source, _ in self.values):
            if log.source not in self._of_new_logs:
                self._of_new_logs[log.source] = self._fitted(log, values[~per_log])
            values[per_log] = self._of_new_logs[log.source]
        return values

    def _fitted(self, log: Block, shared: Array) -> Array | float:
        """Extra parameters of a log, with everything else known."""
        builder = self._on_cpu

        def solve(parts: list[Part]) -> Array:
            elimination = assemble(parts, builder, self.robot).eliminations[0]
            return elimination.inverse @ (elimination.z - elimination.C @ np.append(self.phi, shared))

        if isinstance(log, CompressedBlock):
            return solve(log.parts)
        try:
            require_forces(log, self.robot, builder.contacts, builder.sensors)
        except LogError as error:
            message = f"{error.source}: {error.field}: {error.found}; offsets and scales of this log stay unknown"
            warn(message)
            return 0.0
        return solve(compress_parts([log], builder))


def calibrations(fit: Fit, robot: Robot, builder: RowBuilder) -> Comparison[Calibration]:
    """Nominal and identified parameters, each with the best extra parameters for the logs of a fit.

    Args:
        fit: of compressed logs.
        robot: the robot.
        builder: of the rows.
    """
    return calibrations_at(fit.assembly, Minimizer(fit.estimate.phi, fit.estimate.psi), robot, builder)


def calibrations_at(
    assembly: Assembly, minimizer: Minimizer, robot: Robot, builder: RowBuilder
) -> Comparison[Calibration]:
    """As `calibrations`, of what an estimator has found; arguments as of `calibration_at`."""
    pair = Minimizer(assembly.problem.nominal), minimizer
    return Comparison(*(calibration_at(assembly, point, robot, builder) for point in pair))


def calibration_at(assembly: Assembly, minimizer: Minimizer, robot: Robot, builder: RowBuilder) -> Calibration:
    """Parameters that an estimator has found, with the extra parameters that fit them best.

    Args:
        assembly: of compressed logs.
        minimizer: for its problem.
        robot: the robot.
        builder: of the rows.
    """
    extras = zip(assembly.eliminations, assembly.extras_at(*minimizer), strict=True)
    values = {
        (elimination.log, extra.label): float(value)
        for elimination, numbers in extras
        for extra, value, std in zip(elimination.extras, numbers, elimination.std_if_known, strict=True)
        if np.isfinite(std)
    }
    return Calibration(robot=robot, builder=builder, phi=minimizer.phi, values=values)


# number of sensors or bodies in a warning, and in the answer of a run
_NAMED = 6
_NAMED_IN_SHORT = 2


def warn_of_confounded(extras: Sequence[ExtraEstimate]) -> None:
    """Warn about offsets and scales that are confounded with other parameters.

    Warns:
        ConfoundedWarning: one for each log that has some.
    """
    for confusion in list_confounded(extras):
        with about_file(confusion.log or current_file()):
            warn_about_file(str(confusion), ConfoundedWarning)


@dataclass(frozen=True)
class Confounded:
    """Extra parameters that the data do not separate from others.

    Attributes:
        log: name of the log, "" for all logs.
        extras: labels.
        confounded_with: "total mass" if stating it would separate them, else parameters of bodies.
        advice: what would separate them.
    """

    log: str
    extras: tuple[str, ...]
    confounded_with: tuple[str, ...]
    advice: str

    def __str__(self) -> str:
        others = "the total mass" if self.confounded_with == (_TOTAL_MASS,) else _grouped(self.confounded_with)
        return f"{_grouped(self.extras)}: confounded with {others or 'each other'}; do not trust either; {self.advice}"

    @property
    def in_short(self) -> str:
        """The advice first, then the parameters not to trust."""
        return f"{self.advice}; until then do not trust {_grouped(self.extras, _NAMED_IN_SHORT)}"


_TOTAL_MASS = "total mass"


def list_confounded(extras: Sequence[ExtraEstimate]) -> list[Confounded]:
    """Extra parameters of a fit that are confounded, by log, those with the total mass apart from others."""
    out = []
    for log in dict.fromkeys(x.log for x in extras):
        for by_mass in (True, False):
            group = [x for x in extras if x.log == log and not x.separable and x.mass_separates is by_mass]
            if not group:
                continue
            others = dict.fromkeys(name for x in group for name in x.confounded_with if " of " not in name)
            with_what = (_TOTAL_MASS,) if by_mass else tuple(others)
            out.append(Confounded(log, tuple(x.extra.label for x in group), with_what, _advice(group, by_mass)))
    return out


def _advice(extras: Sequence[ExtraEstimate], by_mass: bool) -> str:
    """Advice that separates extra parameters from other parameters."""
    kinds = {x.extra.what for x in extras}
    if by_mass:
        return "state estimator.total_mass" + (", or remove a sensor from scales" if kinds == {"scale"} else "")
    if kinds == {"scale"}:
        return "add motion, state a known mass (estimator.total_mass, estimator.masses), or remove a sensor from scales"
    terms = [f"actuators.{kind}" for kind in ACTUATORS if kind in kinds]
    if terms:
        return f"add motion, or remove {' and '.join(terms)}"
    return "add motion that unloads the sensor, state known masses, or zero the sensor before recording"


def warn_of_masked(parts: Sequence[Part], builder: RowBuilder) -> None:
    """Warn about contact sensors whose readings in the air do not determine their offsets.

    Warns:
        TorchidWarning: one for each log that has some.
    """
    for log in dict.fromkeys(part.source for part in parts):
        masked = {number for part in parts if part.source == log for number in part.masked}
        if masked:
            channels = (builder.extras[number] for number in sorted(masked))
            named = _grouped(f"{x.name} {x.component}" for x in channels)
            warn(f"{log}: {named} read exactly 0 in the air (masked or clamped) and show no offsets there")


def _grouped(labels: Iterable[str], most: int = _NAMED) -> str:
    """Up to `most` labels by sensor or body, the most frequent first: "scale of l_hip, r_hip; m, mcx of pelvis"."""
    groups: dict[str, dict[str, None]] = {}
    for label in labels:
        first, _, last = label.rpartition(" ")
        groups.setdefault(first, {})[last] = None
    order = sorted(groups, key=lambda first: -len(groups[first]))
    more = f"; and {len(order) - most} more" if len(order) > most else ""
    named = ((first, join_names(list(groups[first]), most)) for first in order[:most])
    return "; ".join(f"{first} {names}" if " of" in first else f"{names} of {first}" for first, names in named) + more
