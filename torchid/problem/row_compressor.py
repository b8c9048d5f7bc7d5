"""Rows into triangular factors by Gram matrices of combined columns, where these are as accurate as Householder QR."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid import kernels
from torchid.parameters import Array
from torchid.problem.linear import TriangularFactor, triangularize
from torchid.problem.samples import Samples

_UNIT = float(np.finfo(float).eps) / 2.0
_SAME_LEVEL = 0.03
"""Pivots of columns of unit length that are as large as this share of their level's first are in the same level."""

_BELOW_ROUNDING = 1e-13  # a pivot of a column of unit length: what is left of it is rounding
_FLOOR = 16.0 * _UNIT
"""Of its length, what is left of a column at least: below what Householder QR changes it by (its bound is n units)."""

_LEAST_EIGENVALUE = 1e-4
"""Of a Gram matrix of unit columns that may be used.

Rounding changes such a matrix by some 50 units at most (2-norm; 2 to 48 measured on random motion, a quadruped, a
person and an arm). With this eigenvalue that is a relative change of any sum of squares of at most 6e-11.
"""

_CERTIFIED = (16.0 * _LEAST_EIGENVALUE, 4.0 * _LEAST_EIGENVALUE, _LEAST_EIGENVALUE)
"""What the least eigenvalue is shown to be: the larger, the later it is looked at again."""

_MOST_GROWTH = 10.0
"""Length of a combined column over that before, up to which no more than a digit of the column is lost."""

_ROWS_PER_COLUMN = 3  # of the sample of a chunk that its columns are combined by
_MOST_COMBINED = 0.5  # of the columns: where more are combined, QR is as fast, and the Gram matrix mostly fails
_LEAST_ROWS = 2000  # of a chunk that columns are combined for: of fewer, that takes longer than Householder QR of them


def write_gram(
    columns: Array, first: int, lower: np.ndarray, combination: Array, squares: Array, gram: Array, /
) -> None:
    """Replace some columns by combinations of all, and write the Gram matrix of the columns then.

    Args:
        columns: (n, first + M), contiguous, the rows by column; those before the first are left alone.
        first: number of these.
        lower: (k,), columns that are replaced.
        combination: (k, n), by what.
        squares: (k,), written: sums of squares of these columns before.
        gram: (n, n), written.
    """
    if kernels.compiled() is not None:
        n, stop = columns.shape
        kernels.call("write_gram", columns, n, first, stop - first, len(lower), lower, combination, squares, gram)
        return
    X = columns[:, first:]
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite stays so
        if len(lower):
            squares[:] = np.einsum("km,km->k", X[lower], X[lower])
            X[lower] = combination @ X
        np.matmul(X, X.T, out=gram)  # half of the products


@dataclass(frozen=True)
class ColumnLevels:
    """A change of columns, X to X T, that makes rows similar to a given sample well conditioned.

    Pivoted QR sorts columns into levels, each with pivots of one order of magnitude. The first level does not change.
    From each other column its best combination of the levels above is subtracted. This includes a right-hand side that
    other columns explain exactly, and dependent columns.

    Attributes:
        T_unit: (n, n), T of columns divided by their lengths.
        size: (n,), these lengths, 1 for columns of zeros.
        lower: (k,), columns that T changes.
    """

    T_unit: Array
    size: Array
    lower: np.ndarray

    @cached_property
    def to_lower(self) -> Array:
        """What the lower columns become of all, (k, n), to be multiplied by columns."""
        return np.ascontiguousarray((self.T_unit[:, self.lower] * self.size[self.lower] / self.size[:, None]).T)

    @classmethod
    def of(cls, R: Array) -> ColumnLevels:
        """Levels of the columns of rows (M, n), all finite."""
        n = R.shape[1]
        size = np.linalg.norm(R, axis=0)
        size[size == 0.0] = 1.0
        pivoted, order = scipy.linalg.qr(R / size, mode="r", pivoting=True)
        pivots = np.zeros(n)
        pivots[: len(pivoted)] = np.abs(np.diag(pivoted))
        T = np.eye(n)
        bounds = [*_level_starts(pivots), n]
        for start, end in zip(bounds[1:-1], bounds[2:], strict=True):
            combination = scipy.linalg.solve_triangular(pivoted[:start, :start], pivoted[:start, start:end])
            T[np.ix_(order[:start], order[start:end])] = -combination
        return cls(T, size, np.sort(order[bounds[1] :]).astype(int))

    @cached_property
    def from_all(self) -> Array:
        """What the lower columns were of all as they are now, (n, k)."""
        inverse = np.linalg.solve(self.T_unit, np.eye(len(self.size))[:, self.lower])
        return np.asarray(inverse * self.size[self.lower] / self.size[:, None])

    def apply(self, columns: Array, first: int) -> Array | None:
        """Change columns in place; return their Gram matrix, (n, n), or None if they were not changed.

        They are not changed if one would become much longer. The rows then differ from those of the levels, and a
        combination would cost other columns their digits.

        Args:
            columns: (n, first + M), rows by column, contiguous.
            first: number of rows to skip.
        """
        gram = np.empty_like(self.T_unit)
        squares = np.empty(len(self.lower))
        before = columns[self.lower, first:]
        write_gram(columns, first, self.lower, self.to_lower, squares, gram)
        if self.are_of(gram, squares):
            return gram
        columns[self.lower, first:] = before
        return None

    def are_of(self, gram: Array, squares: Array) -> bool:
        """Whether rows are similar to those of these levels: no changed column became much longer.

        Args:
            gram: (n, n), of changed columns.
            squares: (k,), sums of squares of the lower columns before.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite stays so
            return not np.less(_MOST_GROWTH**2 * squares, gram[self.lower, self.lower]).any()

    def squares_before(self, gram: Array) -> Array:
        """Squares of the lengths that the lower columns had, (k,), from the Gram matrix of changed ones."""
        with np.errstate(invalid="ignore"):  # what is not finite stays so
            return np.asarray((self.from_all * (gram @ self.from_all)).sum(0))

    def undo(self, R: Array) -> Array:
        """R T^-1, (n, n), of which only the lower columns differ from R's."""
        if not len(self.lower):
            return R
        upper = np.delete(np.arange(len(self.size)), self.lower)
        unit = R / self.size
        within = self.T_unit[np.ix_(self.lower, self.lower)]
        above = self.T_unit[np.ix_(upper, self.lower)]
        with np.errstate(invalid="ignore"):  # what is not finite stays so
            unit[:, self.lower] = np.linalg.solve(within.T, (unit[:, self.lower] - unit[:, upper] @ above).T).T
        return np.asarray(unit * self.size)


def _level_starts(pivots: Array) -> Iterator[int]:
    """First pivots of each level, the last of which has all that are rounding."""
    first = np.inf
    for number, pivot in enumerate(pivots):
        rounding = pivot <= _BELOW_ROUNDING
        if number == 0 or (first > _BELOW_ROUNDING if rounding else pivot < _SAME_LEVEL * first):
            first = pivot
            yield number


@dataclass
class _Sum:
    """The Gram matrix of rows in combined columns, and of how many rows it is.

    `checked` is the diagonal that it had when its least eigenvalue, with unit columns, was `least`.
    """

    levels: ColumnLevels
    gram: Array
    least: float = 0.0
    checked: Array | None = None

    @classmethod
    def zeros(cls, levels: ColumnLevels) -> _Sum:
        return cls(levels, np.zeros_like(levels.T_unit))

    def add(self, gram: Array) -> bool:
        """Add the Gram matrix of rows in combined columns, if the sum may be used; returns whether it was."""
        total = self.gram + gram
        lower = self.levels.lower
        total[lower, lower] += _FLOOR**2 * self.levels.squares_before(gram)
        if not self._is_certain(total):
            return False
        self.gram = total
        return True

    def _is_certain(self, total: Array) -> bool:
        diagonal = np.diag(total)
        if not np.isfinite(total).all():
            return False
        if self.checked is not None:  # adding rows makes no sum of squares less
            seen = diagonal > 0.0
            if self.least * (self.checked[seen] / diagonal[seen]).min(initial=1.0) >= _LEAST_EIGENVALUE:
                return True
        _, unit = _unit_columns(total)
        for least in _CERTIFIED:
            if _is_positive(unit - np.diag(np.full(len(unit), least))):
                self.least = least
                self.checked = diagonal.copy()
                return True
        return False

    def triangle(self) -> Array:
        """R in the combined columns, (n, n)."""
        seen, unit = _unit_columns(self.gram)
        R = np.zeros_like(self.gram)
        size = np.sqrt(np.diag(self.gram)[seen])
        R[np.ix_(seen, seen)] = np.linalg.cholesky(unit).T * size
        return R


def _is_positive(matrix: Array) -> bool:
    """Whether a symmetric matrix has a Cholesky factor, found in a sixth of the time of eigenvalues."""
    return not len(matrix) or scipy.linalg.lapack.dpotrf(matrix, clean=False, overwrite_a=True)[1] == 0


def _unit_columns(gram: Array) -> tuple[np.ndarray, Array]:
    """Columns that are not zero, and their Gram matrix if they had unit length."""
    seen = np.flatnonzero(np.diag(gram) > 0.0)
    size = np.sqrt(np.diag(gram)[seen])
    return seen, gram[np.ix_(seen, seen)] / size / size[:, None]


class RowWeighting(Protocol):
    """Weights rows and collects statistics of them."""

    def __call__(self, samples: Samples, support: tuple[int, ...], rows: Tensor) -> Tensor:
        """Square roots of the weights, (M, 1), of rows (M, columns + 1) of some samples in some columns."""

    def for_worker(self) -> RowWeighting:
        """An empty copy for a worker; it pickles."""

    def add(self, other: Any) -> None:
        """Add the statistics of a worker's copy."""


class RowCompressor:
    """Adds rows to a triangular factor, which is complete after `finish`.

    A Gram matrix takes a third of the time of Householder QR, but squares the condition number, which costs half of the
    digits. Here the Gram matrix is one of combined columns (`ColumnLevels`), which are well conditioned. It is used
    only if its smallest eigenvalue shows that it is as accurate as QR. Otherwise the rows are factorized, and columns
    combined again. Few rows, and rows on a GPU or in single precision, are always factorized.
    """

    def __init__(self, factor: TriangularFactor) -> None:
        """Add rows to a factor."""
        self.factor = factor
        self._levels: dict[tuple[int, ...], ColumnLevels] = {}
        self._sums: dict[tuple[int, ...], _Sum] = {}

    def add(self, support: tuple[int, ...], stacked: Tensor, oversampling: float = 1.0) -> None:
        """Add rows with free space above them.

        Args:
            support: columns in which the rows are not zero.
            stacked: as for `TriangularFactor.add_in_place`.
            oversampling: rows per independent row, at least 1.
        """
        room = stacked.shape[1]
        count = stacked.shape[0] - room
        known = self._sums.get(support)
        least = _ROWS_PER_COLUMN * room if known else max(_LEAST_ROWS, _ROWS_PER_COLUMN * room)
        columns = stacked.T
        if stacked.device.type == "cpu" and stacked.dtype == torch.float64 and count >= least:
            known = known or self._start(support, columns[:, room:].numpy())
        else:
            known = None
        if known is None:
            self.factor.add_in_place(support, stacked, oversampling)
            return
        gram = known.levels.apply(columns.numpy(), room)
        if gram is not None and known.add(gram):
            self._sums[support] = known
        else:
            self._factorize(support, stacked, known, gram is not None)
        self.factor.count(count, oversampling)

    def levels(self, support: tuple[int, ...]) -> ColumnLevels | None:
        """Levels for the rows of a block; None before the first rows."""
        known = self._sums.get(support)
        return None if known is None else known.levels

    def add_gram(self, support: tuple[int, ...], squares: Array, gram: Array, count: int, oversampling: float) -> bool:
        """Add a Gram matrix from `write_gram`, if it is accurate.

        Returns:
            Whether it was added; otherwise give the rows to `add`.
        """
        known = self._sums[support]
        added = known.levels.are_of(gram, squares) and known.add(gram)
        if added:
            self.factor.count(count, oversampling)
        return added

    def finish(self) -> None:
        """Bring the factor up to date."""
        for support, known in self._sums.items():
            self.factor.absorb(support, torch.from_numpy(known.levels.undo(known.triangle())))
        self._sums.clear()
        self._levels.clear()  # later rows are added as if there had been none, whatever cuts them

    def _start(self, support: tuple[int, ...], X: Array) -> _Sum | None:
        """An empty sum, with the column levels of earlier rows or of these; None if QR is as fast."""
        if support not in self._levels:
            sampled = X[:, :: max(1, X.shape[1] // (_ROWS_PER_COLUMN * len(X)))].copy()
            if not np.isfinite(sampled).all():
                return None
            levels = ColumnLevels.of(triangularize(torch.from_numpy(sampled).T).numpy())
            if len(levels.lower) > _MOST_COMBINED * len(X):
                return None
            self._levels[support] = levels
        return _Sum.zeros(self._levels[support])

    def _factorize(self, support: tuple[int, ...], stacked: Tensor, known: _Sum, combined: bool) -> None:
        """Add rows, their columns `combined` or not, and what they were to be added to, by QR; combine columns anew."""
        before = known.triangle() if combined else known.levels.undo(known.triangle())
        stacked[: stacked.shape[1]] = torch.from_numpy(before)
        R = triangularize(stacked).numpy()
        R = known.levels.undo(R) if combined else R
        self._sums.pop(support, None)
        if np.isfinite(R).all():
            anew = _Sum.zeros(ColumnLevels.of(R))
            self._levels[support] = anew.levels
            gram = anew.levels.apply(R.T.copy(), 0)
            if gram is not None and anew.add(gram):
                self._sums[support] = anew
                return
        self.factor.absorb(support, torch.from_numpy(R))
