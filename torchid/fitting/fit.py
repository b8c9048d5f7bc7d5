"""A fit of compressed logs, and the estimator and conditions that an experiment file names."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from torch import Tensor

from torchid import parameters
from torchid.config.estimator import EstimatorConfig
from torchid.errors import ConfigError, TorchidWarning, UnknownNameError, warn
from torchid.estimators import Conditions, Consistent, Enclosure, Estimate, LeastSquares, Mirror
from torchid.identifiability.confounding import ExtraEstimate, estimate_extras
from torchid.parameters import PARAMETERS, PER_BODY, Array
from torchid.problem import LinearProblem, RowBuilder, assemble
from torchid.problem.compression import Part, merge_states
from torchid.problem.elimination import Assembly
from torchid.robot import Robot, body_extents, mirror_pairs

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


@dataclass(frozen=True)
class LogProblem:
    """Compressed logs, with the weights that they have, and the problem that they pose together."""

    parts: list[Part]
    assembly: Assembly


@dataclass(frozen=True)
class Fit:
    """A solved `LogProblem`: parameters of the bodies, and the extra parameters of sensors and actuators."""

    parts: list[Part]
    assembly: Assembly
    estimate: Estimate
    extras: list[ExtraEstimate]

    def columns(self, builder: RowBuilder, log: str) -> Tensor:
        """Parameters in the builder's columns for the rows of a log, (width,)."""
        values = {x.extra.label: x.value for x in self.extras if x.log in ("", log)}
        extras = [values.get(extra.label, 0.0) for extra in builder.extras]
        return builder.to_columns(np.append(self.estimate.phi, extras)[None])[0]


@dataclass(frozen=True, kw_only=True)
class LogFitter:
    """Fits compressed logs of one robot.

    Without a command line, from logs that `bind` has tied to a robot::

        builder = torchid.RowBuilder(robot, contacts, sensors)
        fitter = torchid.LogFitter(robot=robot, builder=builder, estimator=torchid.LeastSquares(ridge=1e-3))
        fit = fitter.fit(torchid.compress_parts(logs, builder))
        fit.estimate.phi  # (12 L,)

    Attributes:
        robot: with the nominal parameters.
        builder: of the rows; it knows contacts, sensors with their noise, and extra parameters.
        estimator: finds the parameters, unless a method is given another `solve`.
        friction: whether friction is fitted.
        frozen: (12 L,) bool, parameters that keep their nominal values, from `frozen_parameters`; None for none.
    """

    robot: Robot
    builder: RowBuilder
    estimator: BatchEstimator
    friction: bool = True
    frozen: np.ndarray | None = None

    def fit(self, parts: Sequence[Part], solve: Solve | None = None) -> Fit:
        """Build the problem of compressed logs and solve it.

        Args:
            parts: from `compress_parts`, of this builder.
            solve: instead of the estimator's.
        """
        return self.solve_problem(self.build_problem(parts), solve)

    def assemble(self, parts: Sequence[Part]) -> Assembly:
        """The problem of compressed logs as they are, with extra parameters eliminated and frozen ones not free."""
        assembly = assemble(parts, self.builder, self.robot, self.friction)
        if self.frozen is None:
            return assembly
        problem, known = (replace(x, free=x.free & ~self.frozen) for x in (assembly.problem, assembly.if_known))
        return replace(assembly, problem=problem, if_known=known)

    def build_problem(self, parts: Sequence[Part]) -> LogProblem:
        """The problem of compressed logs, readings of contact sensors in the air weighed by their own noise.

        A first least-squares fit shows by how much all other rows miss the stated noise.
        """
        assembly = self.assemble(parts)
        if not any(part.unloaded for part in parts):
            return LogProblem(list(parts), assembly)
        first = LeastSquares(self.estimator.ridge, rank_tolerance=self.estimator.rank_tolerance).solve(assembly.problem)
        weighed = [_with_own_noise(part, first.residual_std) for part in parts]
        return LogProblem(weighed, self.assemble(weighed))

    def solve_problem(self, problem: LogProblem, solve: Solve | None = None) -> Fit:
        """Solve what `build_problem` has built; `solve` instead of the estimator's."""
        assembly = problem.assembly
        estimate = (solve or self.estimator.solve)(assembly.problem)
        extras = estimate_extras(assembly, estimate, self.robot.body_names, self.estimator.rank_tolerance)
        return Fit(problem.parts, assembly, estimate, extras)

    def fit_without_folds(self, parts: Sequence[Part]) -> list[Fit]:
        """For every fold, in order, the fit of all others; none where there is only one fold.

        Args:
            parts: of a `Fit`, with the weights that they have in it.
        """
        folds = sorted({part.fold for part in parts})
        if len(folds) < 2:
            return []
        blocks = merge_states(parts, self.builder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # the fit of all of them says the same
            rests = ([block for block in blocks if block.fold != fold] for fold in folds)
            return [self.solve_problem(LogProblem(rest, self.assemble(rest))) for rest in rests]


def frozen_parameters(
    robot: Robot, bodies: Collection[str], source: object = "arguments", field: str = "frozen"
) -> np.ndarray:
    """Parameters of some bodies, (12 L,) bool, that are to keep their nominal values.

    Args:
        robot: the robot.
        bodies: names of the bodies.
        source: where they are named, for the error.
        field: there.

    Raises:
        UnknownNameError: a body that the robot does not have.
    """
    frozen = np.zeros((len(robot.bodies), PER_BODY), dtype=bool)
    for name in bodies:
        if name not in robot.body_names:
            raise UnknownNameError(source, field, name, robot.body_names)
        frozen[robot.body_names.index(name)] = True
    return frozen.flatten()


def _with_own_noise(part: Part, residual_std: float) -> Part:
    """A part whose readings in the air keep the noise that they show, where all others have more than is stated.

    What accelerations and models get wrong on the ground says nothing of a sensor that nothing touches.
    """
    if not part.unloaded or residual_std <= 1.0:
        return part
    return replace(part, factor=part.factor.scaled(residual_std))


_FRICTION = PARAMETERS[parameters.FRICTION]
_POSITIVE = ("m", "Ixx", "Iyy", "Izz")


def batch_estimator(settings: EstimatorConfig, conditions: Conditions) -> LeastSquares | Consistent:
    """What solves a compressed problem in one go; for a descent, what it approaches with the same ridge.

    Penalties of a descent are not part of it.

    Args:
        settings: of the estimator.
        conditions: from `conditions_from`.

    Raises:
        InputError: the certified method without Clarabel.
    """
    if settings.name == "least_squares":
        return settings.least_squares
    if settings.name == "sgd" and (settings.consistency == "penalties" or not settings.numeric_ridge):
        return settings.least_squares
    return settings.consistent(conditions)


def conditions_from(settings: EstimatorConfig, robot: Robot, source: object = "experiment") -> Conditions:
    """Conditions on the parameters (L, 12) of a robot's bodies, as an experiment file says.

    Least squares may break them; those of a descent are a margin alone. `com_inside` leaves out bodies that are frozen,
    have no mass, or whose shapes are not known. Two frozen bodies need not be mirror images.

    Args:
        settings: of the estimator.
        robot: for its bodies, shapes and symmetry.
        source: named in errors.

    Raises:
        ConfigError: a bound that nothing can meet or that has nothing to bound; shapes nowhere; bodies that are not
            mirrored (see `mirror_pairs`).
        UnknownNameError: a body or parameter that there is not.
        UrdfError: a shape that is not described by numbers.

    Warns:
        TorchidWarning: bodies without known shapes, or whose centre of mass in the URDF is outside theirs.
    """
    if settings.name != "consistent":
        return Conditions(margin=settings.margin if settings.name == "sgd" else 0.0, names=robot.body_names)
    lower, upper = _bounds(settings, robot, source)
    return Conditions(
        margin=settings.margin,
        total_mass=settings.total_mass,
        enclosures=_enclosures(settings, robot, source),
        mirrors=_mirrors(settings, robot, source),
        lower=lower,
        upper=upper,
        names=robot.body_names,
    )


def _enclosures(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Enclosure, ...]:
    if settings.com_inside is None:
        if settings.com_shapes != EstimatorConfig.com_shapes:
            found = f"{settings.com_shapes}, without com_inside"
            raise ConfigError(source, "estimator.com_shapes", found, "com_inside: box or ellipsoid as well")
        return ()
    bodies = [i for i, body in enumerate(robot.bodies) if not body.massless and body.name not in settings.frozen]
    extents = body_extents(robot, settings.com_shapes, bodies)
    if not extents:
        found = f"{settings.com_inside}, but {robot.path.name} says of no body that is fitted what shape it has"
        raise ConfigError(source, "estimator.com_inside", found, "null, or a URDF with shapes")
    out, outside = [], []
    for body, extent in extents.items():
        half = extent.half if settings.com_inside == "box" else extent.semi_axes
        out.append(Enclosure(body, settings.com_inside, extent.centre, extent.axes, half))
        _, com, _ = parameters.mass_com_inertia(robot.nominal[body])
        local = np.abs(extent.axes.T @ (com - extent.centre)) / half
        if (local.max() if settings.com_inside == "box" else np.linalg.norm(local)) > 1.0:
            outside.append(robot.body_names[body])
    if outside:
        message = f"the URDF's own centre of mass is outside the {settings.com_inside} at {', '.join(outside)}"
        advice = "are the shapes where the matter is? (estimator.com_shapes)"
        warn(f"{source}: estimator.com_inside: {message}; {advice}")
    return tuple(out)


def _mirrors(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Mirror, ...]:
    symmetry = settings.symmetry
    if symmetry is None:
        return ()
    pairs = mirror_pairs(
        robot, symmetry.left, symmetry.right, symmetry.normal, source, "estimator.symmetry", settings.frozen
    )
    return tuple(
        Mirror(pair.body, pair.image, pair.reflection) for pair in pairs if not robot.bodies[pair.body].massless
    )


def _bounds(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Array | None, Array | None]:
    """Lower and upper bounds, (L, 12), None if the file has none."""
    if not settings.bounds:
        return None, None
    lower, upper = np.full(robot.nominal.shape, -np.inf), np.full(robot.nominal.shape, np.inf)
    for name, intervals in settings.bounds.items():
        if name not in robot.body_names:
            raise UnknownNameError(source, "estimator.bounds", name, robot.body_names)
        body = robot.body_names.index(name)
        for parameter, (low, high) in intervals.items():
            field = f"estimator.bounds.{name}"
            if parameter not in PARAMETERS:
                raise UnknownNameError(source, field, parameter, PARAMETERS)
            number, field = PARAMETERS.index(parameter), f"{field}.{parameter}"
            _check_fitted(settings, robot, body, parameter, source, field)
            _check_interval(parameter, low, high, source, field)
            lower[body, number] = -np.inf if low is None else low
            upper[body, number] = np.inf if high is None else high
    return lower, upper


def _check_fitted(
    settings: EstimatorConfig, robot: Robot, body: int, parameter: str, source: object, field: str
) -> None:
    """Refuse a bound on what stays as it is in the URDF."""
    name, friction = robot.body_names[body], parameter in _FRICTION
    if name in settings.frozen:
        raise ConfigError(source, field, "a bound on a body that is frozen", "one of the two")
    if friction and robot.bodies[body].joint is None:
        raise ConfigError(source, field, f"a bound on friction, but {name} is the base", "a body that a joint moves")
    if friction and not settings.friction:
        raise ConfigError(source, field, "a bound on friction, which is not fitted", "friction: true")
    if not friction and robot.bodies[body].massless:
        raise ConfigError(source, field, f"a bound, but {name} has no mass in the URDF", "a body that has")


def _check_interval(parameter: str, low: float | None, high: float | None, source: object, field: str) -> None:
    """Refuse what no number, or no body, is within."""
    if low is not None and high is not None and low > high:
        raise ConfigError(source, field, f"{low:g} above {high:g}", "[lower, upper], null for an open side")
    negative = min(x for x in (low, high, 0.0) if x is not None) < 0.0
    if parameter in _FRICTION and negative:
        raise ConfigError(source, field, f"[{low}, {high}]", "bounds of at least 0: friction resists")
    if parameter in _POSITIVE and high is not None and high <= 0.0:
        raise ConfigError(source, field, f"at most {high:g}", "an upper bound above 0")
