"""Problems with unknowns beside the bodies' parameters: these are eliminated, so that estimators never see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchid.parameters import Array
from torchid.problem.chunks import one_thread
from torchid.problem.compression import Part, linear_problem, merge_factors, problem_from_triangle
from torchid.problem.extras import Extra
from torchid.problem.linear import LinearProblem
from torchid.problem.rows import RowBuilder
from torchid.robot import Robot
from torchid.rounding import RANK_TOLERANCE, UNOBSERVABLE_SHARE, is_significant


@dataclass(frozen=True)
class Elimination:
    """Unknowns psi of one log, or of all, in terms of what is left: `psi = inverse @ (z - C @ left)`.

    Attributes:
        log: their source, "" for those of all logs.
        extras: M unknowns.
        inverse: (M, r), of least norm; the noise of the r rows is white, of unit variance, and in no other row.
        C: (r, 12 L + S), columns of the bodies' parameters and, for those of one log, of the S unknowns of all logs.
        z: (r,).
        alone: (M,), standard deviation of each unknown if all else were known, infinite where no row has it.
        hidden: (M, M) projector to combinations that no row has.
    """

    log: str
    extras: tuple[Extra, ...]
    inverse: Array
    C: Array
    z: Array
    alone: Array
    hidden: Array

    @property
    def determined(self) -> np.ndarray:
        """Unknowns that the rows give if the bodies' parameters are known, (M,) bool."""
        return np.asarray(np.isfinite(self.alone) & (np.linalg.norm(self.hidden, axis=1) < UNOBSERVABLE_SHARE))


@dataclass(frozen=True)
class Assembly:
    """What estimators see, and what has been eliminated from it: log by log, the unknowns of all logs last.

    `if_known`: the problem there would be if all that has been eliminated were known to be 0.
    """

    problem: LinearProblem
    eliminations: tuple[Elimination, ...]
    if_known: LinearProblem

    def extras_at(self, phi: Array) -> list[Array]:
        """What fits the rows best at parameters (12 L,), for each elimination."""
        of_all = [found.inverse @ (found.z - found.C @ phi) for found in self.eliminations if not found.log]
        left = np.concatenate([phi, *of_all])
        return [found.inverse @ (found.z - found.C @ (left if found.log else phi)) for found in self.eliminations]


@one_thread()
def assemble(parts: Sequence[Part], builder: RowBuilder, robot: Robot, friction: bool = True) -> Assembly:
    """The problem that parts of logs pose together in the bodies' parameters.

    Unknowns of a log, then those of all logs, are eliminated by orthogonal projection, which leaves the least-squares
    solution, and the noise of the rows, as they are.
    """
    factors = {source: [part.factor for part in parts if part.source == source] for source in _sources(parts)}
    everything = merge_factors((part.factor for part in parts), builder)
    if not builder.extras:
        problem = linear_problem(everything, builder, robot, friction)
        return Assembly(problem, (), problem)
    count = builder.columns.count
    per_log, of_all = ([n for n, extra in enumerate(builder.extras) if extra.per_log is own] for own in (True, False))
    found, left = [], []
    for source, own in factors.items():
        R = merge_factors(own, builder).triangle().numpy()
        rest = np.delete(R, [count + number for number in per_log], axis=1)
        if per_log:
            extras = tuple(builder.extras[number] for number in per_log)
            columns = R[:, [count + number for number in per_log]]
            elimination, rest = _eliminate(source, extras, columns, rest, builder, np.linalg.norm(columns, axis=0))
            found.append(elimination)
        left.append(rest)
    rows: Array = np.asarray(np.linalg.qr(np.concatenate(left), mode="r"))
    if of_all:
        extras = tuple(builder.extras[number] for number in of_all)
        sizes = np.linalg.norm(everything.triangle().numpy()[:, [count + number for number in of_all]], axis=0)
        rest = np.delete(rows, np.s_[count:-1], axis=1)
        elimination, rows = _eliminate("", extras, rows[:, count:-1], rest, builder, sizes)
        found.append(elimination)
        rows = np.asarray(np.linalg.qr(rows, mode="r"))
    spent = everything.oversampling * sum(elimination.inverse.shape[1] for elimination in found)
    rows_left = max(everything.rows - round(spent), 1)
    problem = problem_from_triangle(rows, rows_left, everything.oversampling, builder, robot, friction)
    known = np.delete(everything.triangle().numpy(), np.s_[count:-1], axis=1)
    known = np.asarray(np.linalg.qr(known, mode="r"))
    if_known = problem_from_triangle(known, everything.rows, everything.oversampling, builder, robot, friction)
    return Assembly(problem, tuple(found), if_known)


def _sources(parts: Sequence[Part]) -> list[str]:
    return list(dict.fromkeys(part.source for part in parts))


def _eliminate(
    log: str, extras: tuple[Extra, ...], columns: Array, rest: Array, builder: RowBuilder, sizes: Array
) -> tuple[Elimination, Array]:
    """The unknowns of some columns, (R, M), and the rows of the rest, (R, ...), right-hand side last, without them.

    `sizes`: (M,), norms of the columns before anything was eliminated.
    """
    seen = is_significant(sizes)
    scale = np.where(seen, sizes, 1.0)
    U, values, V, left = _split(np.where(seen, columns / scale, 0.0), rest)
    top, count = U.T @ rest, builder.columns.count
    C = np.hstack([top[:, :count] @ builder.columns.parameter_map(), top[:, count:-1]])
    alone = np.where(seen, 1.0 / scale, np.inf)
    hidden = np.eye(len(extras)) - V @ V.T
    found = Elimination(log, extras, (V / values) / scale[:, None], C, top[:, -1], alone, hidden)
    return found, left


def eliminate_columns(X: Array, unknown: Sequence[int]) -> Array:
    """Rows of the other columns that say the same of them as X, (R, N), does where some columns are unknown."""
    if not unknown:
        return X
    columns = X[:, list(unknown)]
    size = np.linalg.norm(columns, axis=0)
    return _split(columns / np.where(size > 0.0, size, 1.0), np.delete(X, unknown, axis=1))[-1]


def _split(columns: Array, rest: Array) -> tuple[Array, Array, Array, Array]:
    """U, singular values and V of what columns of norm 1 or 0 span, and the rows of the rest that they do not reach."""
    U, values, Vt = np.linalg.svd(columns, full_matrices=True)
    rank = int((values > RANK_TOLERANCE).sum())
    left = U[:, rank:].T @ rest
    left[:, np.linalg.norm(left, axis=0) < RANK_TOLERANCE * np.linalg.norm(rest, axis=0)] = 0.0  # nothing but rounding
    return U[:, :rank], values[:rank], Vt[:rank].T, left
