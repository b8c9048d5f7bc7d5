"""The Gaussian that stands for another one cut off by conditions: that of a logarithmic barrier."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from torchid.estimators.barrier import find_strictly_feasible
from torchid.estimators.conic_problem import ConicProblem
from torchid.parallel import one_thread
from torchid.parameters import Array

UPPER = np.triu_indices(4)
"""Rows and columns of the ten entries that a symmetric (4, 4) matrix is held in."""

ENTRY_WEIGHTS = np.where(UPPER[0] == UPPER[1], 1.0, 2.0)
"""How often each of them is in the matrix, (10,)."""

CURVATURE = 0.25
"""Share of the barrier's Hessian in that of the Gaussian.

With all of it chains reach the tails too seldom: 40 000 draws of an exponential tail had a standard deviation 4 % too
small. With a quarter it is within 1 %, for as many passes.
"""

_RARE = 0.01  # share of draws that a condition excludes, above which it counts as near
_DRAWS, _PASSES = 400, 6
_STEPS, _DONE, _ENOUGH, _SHORTEST = 100, 1e-10, 1e-4, 1e-9  # of Newton's method
_CLOSE = 0.05  # squared decrement from which on full steps converge quadratically
_GROWTH = 50.0  # of the quadratic from one point of the central path to the next


@dataclass(frozen=True)
class BarrierGaussian:
    """N(mean, C C^T) for a density exp(-||R x - r||^2 / 2) within conditions F_k(x) >= 0, G x >= h, E x = e.

    `mean` minimizes ||R x - r||^2 / 2 - sum log det F_k(x) - sum log (G x - h), summed over the conditions that are
    near, and the covariance is the inverse of the Hessian there with a share `CURVATURE` of the barrier's. Of an
    exponential tail that a bound cuts off the mean is exactly right, and the standard deviation twice what it is.
    Without conditions nearby, it is the Gaussian itself.

    Attributes:
        mean: (n,), inside all conditions.
        root: (n, n), upper triangular, `root.T @ root` the inverse covariance.
        directions: C, (n, d), of the null space of E.
        blocks: (K, 10, n), change of the entries `UPPER` of J^-1/2 F_k(x) J^-1/2, where J = F_k(mean), by x.
        rows: (M, n), change of (G x - h) by x, relative to what it is at the mean.
        near: (K + M,) bool, the conditions that have a barrier.
    """

    mean: Array
    root: Array
    directions: Array
    blocks: Array
    rows: Array
    near: np.ndarray

    @property
    def covariance(self) -> Array:
        """(n, n)."""
        return self.directions @ self.directions.T

    def marginal(self, variables: np.ndarray, blocks: np.ndarray, rows: np.ndarray) -> BarrierGaussian:
        """The Gaussian of some variables, (m,) int, whatever the others are, some blocks, (K,), and rows, (M,) bool."""
        rest = np.setdiff1d(np.arange(len(self.mean)), variables)
        triangle = np.asarray(np.linalg.qr(self.root[:, [*rest, *variables]], mode="r"))
        directions = np.asarray(np.linalg.qr(self.directions[variables].T, mode="r")).T
        return BarrierGaussian(
            mean=self.mean[variables],
            root=triangle[len(rest) :, len(rest) :],
            directions=directions,
            blocks=self.blocks[blocks][:, :, variables],
            rows=self.rows[rows][:, variables],
            near=self.near[np.concatenate([blocks, rows])],
        )


@one_thread()
def barrier_gaussian(conic: ConicProblem) -> BarrierGaussian:
    """The Gaussian for the density exp(-objective / 2) of a problem without log-determinants.

    Raises:
        InputError: the conditions exclude each other.
    """
    x, _ = find_strictly_feasible(conic)
    conditions = _Conditions(conic)
    near = np.zeros(conditions.count, dtype=bool)
    for _ in range(_PASSES):
        mean = _minimizer(conditions, x, near)
        outside = conditions.outside(mean[:, None])[:, 0]
        if not outside.any():
            found = conditions.gaussian(mean, near)
            drawn = np.random.default_rng(0).normal(size=(found.directions.shape[1], _DRAWS))
            outside = conditions.outside(mean[:, None] + found.directions @ drawn).mean(axis=1) > _RARE
        if not (outside & ~near).any():
            break
        near |= outside
    else:
        near[:] = True
    mean = _minimizer(conditions, x, near)
    return conditions.gaussian(mean, near)


class _Conditions:
    """The conditions of a problem in dense arrays."""

    def __init__(self, conic: ConicProblem) -> None:
        self.conic, n = conic, len(conic.linear)
        self.slopes = np.zeros((len(conic.F0), 4, 4, n))
        for slope, F, variables in zip(self.slopes, conic.F, conic.variables, strict=True):
            slope[:, :, variables] = F.transpose(1, 2, 0)
        self.count = len(conic.F0) + len(conic.h)
        self.N = conic.null_space

    def blocks(self, x: Array) -> Array:
        """F_k, (K, B, 4, 4), at points (n, B)."""
        of_variables = x[self.conic.variables]  # (K, 10, B)
        return self.conic.F0[:, None] + np.einsum("kvb,kvij->kbij", of_variables, self.conic.F)

    def outside(self, x: Array) -> np.ndarray:
        """Whether points (n, B) break each condition, (K + M, B)."""
        of_blocks = np.linalg.eigvalsh(self.blocks(x))[..., 0] <= 0.0
        return np.concatenate([of_blocks, self.conic.G @ x <= self.conic.h[:, None]])

    def relative(self, x: Array) -> tuple[Array, Array] | None:
        """Slopes of blocks, (K, 4, 4, n), and rows, (M, n), relative to their values at x; None outside of them."""
        values, slack = self.blocks(x[:, None])[:, 0], self.conic.G @ x - self.conic.h
        try:
            inverse = np.linalg.inv(np.linalg.cholesky(values))
        except np.linalg.LinAlgError:
            return None
        if not (slack > 0.0).all():
            return None
        slopes = np.matmul(inverse[:, None, None], np.moveaxis(self.slopes, -1, 1)[:, :, None])[:, :, 0]
        return np.moveaxis(slopes @ np.swapaxes(inverse, 1, 2)[:, None], 1, -1), self.conic.G / slack[:, None]

    def gaussian(self, mean: Array, near: np.ndarray) -> BarrierGaussian:
        """The Gaussian of a minimizer."""
        relative = self.relative(mean)
        if relative is None:
            raise np.linalg.LinAlgError("by rounding, a point is not inside the conditions")
        blocks, rows = relative[0][:, UPPER[0], UPPER[1]], relative[1]
        root = np.asarray(np.linalg.qr(np.concatenate([self.conic.root, *_near_rows(blocks, rows, near)]), mode="r"))
        reduced = np.linalg.qr(root @ self.N, mode="r")
        directions = scipy.linalg.solve_triangular(reduced, self.N.T, trans=1).T
        return BarrierGaussian(mean, root, directions, blocks, rows, near)


def _near_rows(blocks: Array, rows: Array, near: np.ndarray) -> tuple[Array, Array]:
    """Rows X of the barrier's Hessian X^T X at the point that slopes are relative to."""
    weighted = blocks[near[: len(blocks)]] * np.sqrt(CURVATURE * ENTRY_WEIGHTS)[:, None]
    return weighted.reshape(-1, blocks.shape[-1]), np.sqrt(CURVATURE) * rows[near[len(blocks) :]]


def _minimizer(conditions: _Conditions, x: Array, near: np.ndarray) -> Array:
    """Where the density times the barriers of some conditions is largest, from a point inside.

    Newton's method from afar may run into conditions nearby where data are sharp, and take ever shorter steps along
    them. Then the quadratic begins small beside the barriers, and grows.
    """
    found, decrement = _newton(conditions, x, near, 1.0, _STEPS)
    if decrement < _CLOSE:
        return found
    share = 1.0 / _newton(conditions, x, near, 1.0, 0)[1]
    while share < 1.0:
        x, _ = _newton(conditions, x, near, share, _STEPS)
        share *= _GROWTH
    return _newton(conditions, x, near, 1.0, _STEPS)[0]


def _newton(conditions: _Conditions, x: Array, near: np.ndarray, share: float, steps: int) -> tuple[Array, float]:
    """Minimizer of a share of the quadratic and the barriers, from a point inside, and the last squared decrement."""
    conic, N, sharp = conditions.conic, conditions.N, np.sqrt(share)
    of_blocks, of_rows = near[: len(conic.F0)], near[len(conic.F0) :]

    def value(x: Array) -> float:
        misfit, slack = sharp * (conic.root @ x - conic.target), (conic.G @ x - conic.h)[of_rows]
        try:
            roots = np.linalg.cholesky(conditions.blocks(x[:, None])[of_blocks, 0])
        except np.linalg.LinAlgError:
            return np.inf
        if slack.min(initial=1.0) <= 0.0:
            return np.inf
        determinants = 2.0 * np.log(np.diagonal(roots, axis1=1, axis2=2)).sum()
        return float(0.5 * misfit @ misfit - determinants - np.log(slack).sum())

    before = value(x)
    for count in range(steps + 1):
        inverse = np.linalg.inv(np.linalg.cholesky(conditions.blocks(x[:, None])[of_blocks, 0]))
        slopes = np.einsum("kij,kjln,kml->kimn", inverse, conditions.slopes[of_blocks], inverse, optimize=True)
        rows = conic.G[of_rows] / (conic.G @ x - conic.h)[of_rows, None]
        J = np.concatenate([sharp * conic.root, slopes.reshape(-1, len(x)), rows]) @ N
        misfit = share * (conic.root @ x - conic.target)
        gradient = N.T @ (conic.root.T @ misfit - np.einsum("kiin->n", slopes) - rows.sum(axis=0))
        R = np.linalg.qr(J, mode="r")
        half = scipy.linalg.solve_triangular(R, gradient, trans=1)
        step, decrement, length = -N @ scipy.linalg.solve_triangular(R, half), float(half @ half), 1.0
        if count == steps or decrement < _DONE:
            break
        while not _is_enough(before, after := value(x + length * step), length, decrement) and length > _SHORTEST:
            length *= 0.5
        if length <= _SHORTEST:
            break
        x, before = x + length * step, after
    return x, decrement


def _is_enough(before: float, after: float, length: float, decrement: float) -> bool:
    """Whether a step lowers a self-concordant function by enough; near its minimum full ones do, beyond rounding.

    Boyd, Vandenberghe, "Convex Optimization", section 9.6.
    """
    return after < np.inf and (decrement < _CLOSE or after <= before - _ENOUGH * length * decrement)
