"""The linear problem in the parameters of all bodies that triangular factors pose, extra parameters eliminated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from torchid import parameters
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem.compression import Part, merge_factors
from torchid.problem.extras import Extra
from torchid.problem.linear import (
    PRIOR_DEVIATION,
    EliminatedTerms,
    LinearProblem,
    SignCondition,
    TriangularFactor,
    parameter_scale,
)
from torchid.problem.noise_gram import ColumnPrior, NoiseShares, corrected_triangle, scale_columns
from torchid.problem.rows import RowBuilder
from torchid.robot import Robot
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE, column_scale, is_significant

_DIRECTIONS = {"forwards": 1.0, "backwards": -1.0}


@dataclass(frozen=True)
class Elimination:
    """Eliminated unknowns psi of one log, or of all logs, from the remaining ones x: `psi = inverse @ (z - C @ x)`.

    Attributes:
        log: source of the log, "" for all logs.
        extras: M unknowns.
        inverse: (M, r), of least norm. The r rows have white noise of unit variance that is in no other row.
        C: (r, 12 L + S), columns of the bodies' parameters; for one log also of the S unknowns of all logs.
        D: (r, M), columns of the unknowns.
        z: (r,).
        std_if_known: (M,), standard deviation of each unknown if all else were known; infinite if no row depends on it.
        unobservable: (M, M), projector to combinations that no row depends on.
    """

    log: str
    extras: tuple[Extra, ...]
    inverse: Array
    C: Array
    D: Array
    z: Array
    std_if_known: Array
    unobservable: Array

    @property
    def determined(self) -> np.ndarray:
        """Unknowns that the rows determine if the bodies' parameters are known, (M,) bool."""
        return np.asarray(
            np.isfinite(self.std_if_known) & (np.linalg.norm(self.unobservable, axis=1) < UNOBSERVABLE_SHARE)
        )


@dataclass(frozen=True)
class Assembly:
    """The problem in the bodies' parameters, and the eliminations: log by log, then of the unknowns of all logs.

    Attributes:
        if_known: the problem with all eliminated unknowns fixed at 0.
        noise: subtracted motion noise.
        forces: squared norm of all measured forces, weighted.
        stated: number of last rows that are stated values, such as known masses; `data`: the problem without them.
        homogeneous: whether unknown scales multiply all measured forces, so that their size is unknown.
        scaled_by: total mass [kg] used in place of a known one in this case; None if a mass is known.
        reading_noise: variance of the noise of readings with unknown scales, by column, relative to the variance that
            weighted the rows.
    """

    problem: LinearProblem
    eliminations: tuple[Elimination, ...]
    if_known: LinearProblem
    noise: NoiseShares = field(default_factory=NoiseShares)
    forces: float = 0.0
    stated: int = 0
    data: LinearProblem | None = None
    scaled_by: float | None = None
    homogeneous: bool = False
    reading_noise: Mapping[int, float] = field(default_factory=dict)

    def extras_at(self, phi: Array, psi: Array | None = None) -> list[Array]:
        """Best values of the eliminated unknowns, for each elimination, at parameters (12 L,).

        `psi`: (M,), those of all logs, if an estimate has bounds on them.
        """
        shared = [x.inverse @ (x.z - x.C @ phi) if psi is None else psi for x in self.eliminations if not x.log]
        remaining = np.concatenate([phi, *shared])
        return [x.inverse @ (x.z - x.C @ remaining) if x.log else shared[0] for x in self.eliminations]

    def extras_sensitivity(self) -> list[Array]:
        """Change of the eliminated unknowns per unit of phi, (M, 12 L) for each elimination."""
        count = len(self.problem.nominal)
        of_all = [-x.inverse @ x.C for x in self.eliminations if not x.log]
        through = np.concatenate([np.eye(count), *of_all])
        return [-x.inverse @ x.C @ (through if x.log else np.eye(count)) for x in self.eliminations]


@one_thread()
def linear_problem(factor: TriangularFactor, builder: RowBuilder, robot: Robot, friction: bool = True) -> LinearProblem:
    """Build the linear problem in all 12 L parameters of the bodies from a factor made by `compress`.

    Raises:
        ValueError: the builder has extra parameters; `assemble` eliminates them.
    """
    if builder.extras:
        raise ValueError("builder: found one with extra parameters; accepted: a builder without, or torchid.assemble")
    corrected = corrected_triangle(factor, column_prior(builder, robot, friction))
    return problem_from_triangle(
        corrected.R, factor.rows, factor.oversampling, builder, robot, friction, corrected.shrinkage
    )


@one_thread()
def assemble(
    parts: Sequence[Part],
    builder: RowBuilder,
    robot: Robot,
    friction: bool = True,
    reading_noise: Mapping[int, float] | None = None,
) -> Assembly:
    """Build the linear problem in the bodies' parameters (12 L,), with all extra parameters eliminated.

    Orthogonal projection eliminates first the unknowns of each log, then those of all logs. It changes neither the
    least-squares solution nor the noise of the rows.

    Args:
        parts: factors of logs, from `compress_parts` or `compress_in_blocks`.
        builder: that made the rows, with its extra parameters.
        robot: with the nominal parameters.
        friction: whether friction is free.
        reading_noise: as in `Assembly`; None to leave this noise in the rows.
    """
    everything = merge_factors((part.factor for part in parts), builder)
    reading_noise = reading_noise or dict.fromkeys(scale_columns(builder), 0.0)
    prior = replace(column_prior(builder, robot, friction), reading_noise=reading_noise)
    corrected = corrected_triangle(everything, prior)
    of_all_logs = corrected.R
    noise = corrected.noise
    shrinkage = corrected.shrinkage
    forces = float(np.square(of_all_logs[:, -1]).sum())
    oversampling = everything.oversampling
    if not builder.extras:
        problem = problem_from_triangle(of_all_logs, everything.rows, oversampling, builder, robot, friction, shrinkage)
        return Assembly(problem, (), problem, noise, forces)
    count = builder.columns.count
    per_log = [number for number, extra in enumerate(builder.extras) if extra.per_log]
    of_all = [number for number, extra in enumerate(builder.extras) if not extra.per_log]
    eliminations = list[Elimination]()
    rows = of_all_logs
    if per_log:
        eliminations, rows, shrinkage = _eliminate_per_log(parts, builder, prior, per_log)
    if of_all:
        extras = tuple(builder.extras[number] for number in of_all)
        sizes = np.linalg.norm(of_all_logs[:, [count + number for number in of_all]], axis=0)
        others = np.delete(rows, np.s_[count:-1], axis=1)
        elimination, rows = _eliminate("", extras, rows[:, count:-1], others, builder, sizes)
        eliminations.append(elimination)
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    spent = oversampling * sum(elimination.inverse.shape[1] for elimination in eliminations)
    rows_left = max(everything.rows - round(spent), 1)
    shrinkage = None if shrinkage is None else shrinkage[:count]
    problem = problem_from_triangle(rows, rows_left, oversampling, builder, robot, friction, shrinkage)
    if of_all:
        problem = replace(problem, terms=_bounded_terms(eliminations[-1], robot))
    known = np.asarray(np.linalg.qr(np.delete(of_all_logs, np.s_[count:-1], axis=1), mode="r"))
    if_known = problem_from_triangle(known, everything.rows, oversampling, builder, robot, friction, None)
    return Assembly(problem, tuple(eliminations), if_known, noise, forces, reading_noise=reading_noise)


def _eliminate_per_log(
    parts: Sequence[Part], builder: RowBuilder, prior: ColumnPrior, numbers: Sequence[int]
) -> tuple[list[Elimination], Array, Array | None]:
    """Eliminate the extra parameters that each log has of its own, log by log.

    Returns:
        The eliminations; the remaining triangle of all logs, (R, remaining columns + 1); its shrinkage.
    """
    extras = tuple(builder.extras[number] for number in numbers)
    at = [builder.columns.count + n for n in numbers]
    eliminations = []
    remaining = []
    lacking = []
    for source in dict.fromkeys(part.source for part in parts):
        corrected = corrected_triangle(merge_factors((p.factor for p in parts if p.source == source), builder), prior)
        columns = corrected.R[:, at]
        others = np.delete(corrected.R, at, axis=1)
        elimination, others = _eliminate(source, extras, columns, others, builder, np.linalg.norm(columns, axis=0))
        eliminations.append(elimination)
        remaining.append(others)
        lacking.append((others, None if corrected.shrinkage is None else np.delete(corrected.shrinkage, at, 0)))
    rows = np.asarray(np.linalg.qr(np.concatenate(remaining), mode="r"))
    return eliminations, rows, _joined_shrinkage(lacking)


def column_prior(builder: RowBuilder, robot: Robot, friction: bool = True) -> ColumnPrior:
    """The nominal parameters in the builder's columns, and deviations within their scale of those that are free."""
    columns = builder.columns.parameter_map
    nominal = robot.nominal.flatten()
    scale = np.where(free_parameters(robot, friction), parameter_scale(robot.nominal).flatten(), 0.0)
    return ColumnPrior(columns @ nominal, columns * (PRIOR_DEVIATION * scale))


def problem_from_triangle(
    R: Array, rows: int, oversampling: float, builder: RowBuilder, robot: Robot, friction: bool, shrinkage: Array | None
) -> LinearProblem:
    """The problem in all 12 L parameters from a triangle in the regrouped columns, right-hand side last.

    Args:
        R: (M, columns + 1).
        rows: number of rows in it.
        oversampling: of the rows.
        builder: of the rows.
        robot: the robot.
        friction: whether friction is free.
        shrinkage: (columns, Q), as in `CorrectedTriangle`.
    """
    count = builder.columns.count
    return LinearProblem(
        A=R[:count, :-1] @ builder.columns.parameter_map,
        b=R[:count, -1],
        residual=float(np.square(R[count:, -1]).sum()),
        rows=rows,
        nominal=robot.nominal.flatten(),
        scale=parameter_scale(robot.nominal).flatten(),
        free=free_parameters(robot, friction),
        oversampling=oversampling,
        shrinkage=None if shrinkage is None else R[:count, :-1] @ shrinkage,
    )


def free_parameters(robot: Robot, friction: bool = True) -> np.ndarray:
    """Parameters that can be fitted, (12 L,) bool.

    All but inertial parameters of massless bodies, friction of welds, and any friction if not `friction`.
    """
    free = np.ones(robot.nominal.shape, dtype=bool)
    free[[body.massless for body in robot.bodies], parameters.INERTIAL] = False
    still = [body.joint is None or body.joint.kind == "fixed" for body in robot.bodies]
    free[still if friction else slice(None), parameters.FRICTION] = False
    return free.flatten()


def _bounded_terms(of_all: Elimination, robot: Robot) -> EliminatedTerms | None:
    """Unknowns of all logs with physical bounds (`nonnegative` terms, dry friction by direction); None without any."""
    conditions: list[SignCondition] = []
    extras = of_all.extras
    for number, extra in enumerate(extras):
        unit = np.eye(len(extras))[number]
        if extra.nonnegative:
            conditions.append(SignCondition(extra.label, unit, np.zeros(robot.nominal.size), extra.size, extra.unit))
        if extra.what == "asymmetric_coulomb" and extra.dof is not None:
            friction = _dry_friction(robot, extra.dof)
            conditions += [
                SignCondition(f"Coulomb friction of {extra.name} {way}", sign * unit, friction, extra.size, extra.unit)
                for way, sign in _DIRECTIONS.items()
            ]
    if not conditions:
        return None
    size = np.array([extra.size for extra in extras])
    labels = tuple(extra.label for extra in extras)
    return EliminatedTerms(of_all.C, of_all.D, of_all.z, size, labels, tuple(conditions))


def _dry_friction(robot: Robot, dof: int) -> Array:
    """Coulomb friction at an independent joint, with its mimic joints, as a row on all parameters, (12 L,)."""
    row = np.zeros((len(robot.bodies), PER_BODY))
    row[1:, parameters.COULOMB] = np.abs(robot.joint_map[0][:, dof])
    return row.flatten()


def _joined_shrinkage(logs: Sequence[tuple[Array, Array | None]]) -> Array | None:
    """What the parameters that fit the rows of all logs best lack, (columns, Q), by rows and `shrinkage` of each."""
    width = max((shrinkage.shape[1] for _, shrinkage in logs if shrinkage is not None), default=0)
    if not width:
        return None
    rows = np.concatenate([others[:, :-1] for others, _ in logs])
    lacking = [
        np.zeros((len(others), width)) if shrinkage is None else others[:, :-1] @ shrinkage
        for others, shrinkage in logs
    ]
    scale = column_scale(rows)
    return np.asarray(scale[:, None] * (np.linalg.pinv(rows * scale, rcond=RANK_TOLERANCE) @ np.concatenate(lacking)))


def _eliminate(
    log: str, extras: tuple[Extra, ...], columns: Array, others: Array, builder: RowBuilder, sizes: Array
) -> tuple[Elimination, Array]:
    """Eliminate the unknowns of some columns, (R, M), from the rows of the others, (R, ...), right-hand side last.

    `sizes`: (M,), norms of the columns before anything was eliminated.
    """
    present = is_significant(sizes)
    scale = np.where(present, sizes, 1.0)
    U, values, V, remaining = _project_off(np.where(present, columns / scale, 0.0), others)
    top = U.T @ others
    count = builder.columns.count
    C = np.hstack([top[:, :count] @ builder.columns.parameter_map, top[:, count:-1]])
    std_if_known = np.where(present, 1.0 / scale, np.inf)
    unobservable = np.eye(len(extras)) - V @ V.T
    inverse = (V / values) / scale[:, None]
    D = values[:, None] * V.T * scale
    elimination = Elimination(log, extras, inverse, C, D, top[:, -1], std_if_known, unobservable)
    return elimination, remaining


def eliminate_columns(X: Array, unknown: Sequence[int]) -> Array:
    """Rows of X, (R, N), in its other columns, after the unknowns of some columns have been eliminated."""
    if not unknown:
        return X
    columns = X[:, list(unknown)]
    return _project_off(columns * column_scale(columns), np.delete(X, unknown, axis=1))[-1]


def _project_off(columns: Array, others: Array) -> tuple[Array, Array, Array, Array]:
    """U, singular values and V of columns of norm 1 or 0, and the other columns projected off their span."""
    U, values, Vt = np.linalg.svd(columns, full_matrices=True)
    rank = int((values > RANK_TOLERANCE).sum())
    projected = U[:, rank:].T @ others
    projected[:, np.linalg.norm(projected, axis=0) < RANK_TOLERANCE * np.linalg.norm(others, axis=0)] = 0.0  # rounding
    return U[:, :rank], values[:rank], Vt[:rank].T, projected
