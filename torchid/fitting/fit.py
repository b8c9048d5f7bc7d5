"""A fit of compressed logs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import Tensor

from torchid.errors import UnknownNameError
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
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem, RowBuilder, assemble
from torchid.problem.compression import Part, merge
from torchid.problem.elimination import Assembly
from torchid.problem.noise_gram import scale_columns
from torchid.reprs import short_repr
from torchid.robot import Robot
from torchid.rounding import RANK_TOLERANCE

_TURNS = 10  # of fit and noise of readings; they settle in three or four
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

    Without a command line, from logs that `bind_log` has tied to a robot::

        builder = torchid.RowBuilder(robot, contacts, sensors)
        fitter = torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares(ridge=1e-3))
        fit = fitter.fit(torchid.compress_in_blocks(logs, builder))
        fit.estimate.phi  # (12 L,)

    Attributes:
        robot: with the nominal parameters.
        builder: of the rows; it knows contacts, sensors with their noise, and extra parameters.
        estimator: finds the parameters, unless a method is given another `solve`.
        friction: whether friction is fitted.
        frozen: (12 L,) bool, parameters that keep their nominal values, from `frozen_parameters`; None for none.
        masses: that are known.
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
        """Least squares with the estimator's ridge and rank tolerance, for what needs no conditions."""
        return LeastSquares(self.estimator.ridge, rank_tolerance=self.estimator.rank_tolerance)

    @one_thread()
    def fit(self, parts: Sequence[Part], solve: Solve | None = None) -> Fit:
        """Build the problem of compressed logs and solve it.

        Args:
            parts: from `compress_in_blocks`, of this builder, or from `compress_parts`, whose only blocks are
                folds: with fewer than three, standard errors rest on the assumption that residuals are noise.
            solve: instead of the estimator's.
        """
        fit = self.solve_problem(
            self.build_problem(merge(parts, self.builder, "source", "state", "fold", "unloaded")), solve
        )
        estimator = self.estimator
        jackknife = jackknife_blocks(parts, self.builder, fit.assembly, estimator.ridge, estimator.rank_tolerance)
        return fit if jackknife is None else with_block_errors(fit, jackknife)

    def assemble(self, parts: Sequence[Part], reading_noise: Mapping[int, float] | None = None) -> Assembly:
        """The problem of compressed logs as they are, with extra parameters eliminated and frozen ones not free.

        Masses that are known are further rows of it. Where scales make up all of the forces and no mass is known, the
        nominal total mass stands in for one: the best fit were no forces at all. `reading_noise`: as `Assembly` has it.
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
        """The problem of compressed logs, readings of contact sensors in the air weighted by their own noise.

        A first least-squares fit shows by how much all other rows miss the stated noise, and so how large the noise of
        readings with unknown scales is: fit and noise take turns.
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
            found = self._reading_noise(problem)
            if all(abs(found[at] - noise.get(at, 0.0)) <= _SETTLED * found[at] for at in found):
                break
            noise = {at: float(np.sqrt(x * noise.get(at, x))) for at, x in found.items()}  # x alone overshoots
            problem = LogProblem(problem.parts, self.assemble(problem.parts, noise))
        return problem

    def _reading_noise(self, problem: LogProblem) -> dict[int, float]:
        """What `Assembly` has under this name: the mean square residual but for noise of the motion, per squared scale.

        Rows are weighted with the noise of forces, which is that of readings times their scales.
        """
        fit = self.solve_problem(problem, self.least_squares.solve)
        left = 0.0
        no_readings = dict.fromkeys(scale_columns(self.builder), 0.0)
        for log in {part.source: None for part in problem.parts}:
            at = np.append(fit.columns(self.builder, log).cpu().double().numpy(), -1.0)
            for part in problem.parts:
                if part.source == log:
                    left += float(at @ part.factor.whole_noise_gram(no_readings).numpy() @ at)
        left = max(fit.estimate.residual_std**2 - left / max(fit.assembly.problem.rows, 1), 0.0)
        values = {x.extra.label: 1.0 + x.value for x in fit.extras}
        of_column = zip(no_readings, (x.label for x in self.builder.extras if x.what == "scale"), strict=True)
        found = ((column, abs(values.get(label, 1.0))) for column, label in of_column)  # 1 where no row depends on it
        return {column: left / max(scale, _LEAST_SCALE) ** 2 for column, scale in found}

    def solve_problem(self, problem: LogProblem, solve: Solve | None = None) -> Fit:
        """Solve what `build_problem` has built; `solve` instead of the estimator's."""
        assembly = problem.assembly
        estimate = (solve or self.estimator.solve)(assembly.problem)
        extras = estimate_extras(assembly, estimate, self.robot.body_names, self.estimator.rank_tolerance)
        return Fit(problem.parts, assembly, estimate, extras)


def _is_homogeneous(problem: LinearProblem, forces: float) -> bool:
    """Whether nothing is left of the measured forces, of this squared norm, once unknown scales are eliminated."""
    fixed = ~problem.free
    left = problem.b - problem.A[:, fixed] @ problem.nominal[fixed]
    return float(left @ left) + problem.residual <= RANK_TOLERANCE**2 * forces


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
    """Parameters of some bodies, (12 L,) bool, that are to keep their nominal values.

    Args:
        robot: the robot.
        bodies: names of the bodies.
        field: that names them, for the error.

    Raises:
        UnknownNameError: a body that the robot does not have.
    """
    frozen = np.zeros((len(robot.bodies), PER_BODY), dtype=bool)
    for name in bodies:
        if name not in robot.body_names:
            raise UnknownNameError.at_field(field, name, robot.body_names)
        frozen[robot.body_names.index(name)] = True
    return frozen.flatten()


def _with_own_noise(part: Part, residual_std: float) -> Part:
    """A part whose readings in the air keep the noise that they show, where all others have more than is stated.

    What accelerations and models get wrong on the ground says nothing of a sensor that nothing touches.
    """
    if not part.unloaded or residual_std <= 1.0:
        return part
    return replace(part, factor=part.factor.scaled(residual_std))
