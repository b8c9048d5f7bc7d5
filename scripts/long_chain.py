"""A Gaussian cut off by conditions, sampled by long chains of another kind: hit-and-run with exact chords, in NumPy.

It shares nothing with `torchid.estimators.truncated_gaussian` but the conic problem: no Gaussian of a barrier, no
ellipses, no rejection. Each step draws from the exact distribution along a line through the state (Smith, "Efficient
Monte Carlo procedures for generating points uniformly distributed over bounded regions", Operations Research 1984).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from torchid.estimators.conic import ConicProblem, solve_barrier
from torchid.parameters import Array


class LongChain:
    """Chains in the density exp(-objective / 2) of a problem without equalities, in its conditions; `x` is (chains, n).

    A step moves all variables, or those of two bodies: of one drawn at random, and one that the data couple it with.
    """

    def __init__(self, problem: ConicProblem, owners: np.ndarray, chains: int, seed: int) -> None:
        """Start where the density is largest.

        Args:
            problem: the problem.
            owners: (n,) int, the body that each variable belongs to.
            chains: their number.
            seed: of the random numbers.
        """
        if len(problem.e):
            raise ValueError("problem: found equalities; accepted: inequalities alone")
        self.problem, self.rng = problem, np.random.default_rng(seed)
        self.x = np.tile(solve_barrier(problem).x, (chains, 1))
        self.residual = self.x @ problem.root.T - problem.target
        self.all = _Move.of(problem, np.arange(self.x.shape[1]))
        covariance = self.all.spread @ self.all.spread.T
        deviation = np.sqrt(np.diag(covariance))
        bodies = np.unique(owners)
        member = (owners[:, None] == bodies).astype(float)
        coupled = member.T @ np.square(covariance / np.outer(deviation, deviation)) @ member
        np.fill_diagonal(coupled, 0.0)
        self.partners = coupled / coupled.sum(axis=1, keepdims=True)
        self.members = [np.flatnonzero(owners == body) for body in bodies]
        self.moves: dict[tuple[int, int], _Move] = {}

    def run(self, steps: int, each: Callable[[Array], None] | None = None, every: int = 1) -> None:
        """Take steps; `each` is called with the states at every so many of them."""
        for number in range(1, steps + 1):
            self._step(self._move() if number % 10 else self.all)
            if number % 100 == 0:
                self.residual = self.x @ self.problem.root.T - self.problem.target
            if each is not None and number % every == 0:
                each(self.x)

    def _move(self) -> _Move:
        one = int(self.rng.integers(len(self.members)))
        other = int(self.rng.choice(len(self.members), p=self.partners[one]))
        pair = min(one, other), max(one, other)
        if pair not in self.moves:
            self.moves[pair] = _Move.of(self.problem, np.concatenate([self.members[k] for k in pair]))
        return self.moves[pair]

    def _step(self, move: _Move) -> None:
        directions = self.rng.normal(size=(len(self.x), move.spread.shape[1])) @ move.spread.T
        slope = directions @ move.columns.T
        weight = np.einsum("bi,bi->b", slope, slope)
        centre = -np.einsum("bi,bi->b", slope, self.residual) / weight
        whole = np.zeros_like(self.x)
        whole[:, move.variables] = directions
        low, high = self._chord(move, whole)
        root = np.sqrt(weight)
        moved = centre + _truncated_normal((low - centre) * root, (high - centre) * root, self.rng) / root
        moved = np.clip(moved, 0.999999 * low, 0.999999 * high)  # rounding
        self.x = self.x + moved[:, None] * whole
        self.residual = self.residual + moved[:, None] * slope

    def _chord(self, move: _Move, directions: Array) -> tuple[Array, Array]:
        """How far each state can go along its direction, backwards and forwards, (chains,)."""
        problem, blocks, rows = self.problem, move.blocks, move.rows
        slopes, variables = problem.F[blocks], problem.variables[blocks]
        F = problem.F0[blocks] + np.einsum("bkv,kvij->bkij", self.x[:, variables], slopes, optimize=True)
        D = np.einsum("bkv,kvij->bkij", directions[:, variables], slopes, optimize=True)
        inverse = np.linalg.inv(np.linalg.cholesky(F))
        values = np.linalg.eigvalsh(inverse @ D @ np.swapaxes(inverse, -1, -2)).reshape(len(self.x), -1)
        along, slack = directions @ problem.G[rows].T, self.x @ problem.G[rows].T - problem.h[rows]
        rates = np.concatenate([values, along / slack], axis=1)
        tiny = 1e-300
        return -1.0 / np.maximum(rates.max(axis=1), tiny), 1.0 / np.maximum(-rates.min(axis=1), tiny)


@dataclass(frozen=True)
class _Move:
    """Some variables, directions of them that the data allow alike, their columns, and conditions that they are in."""

    variables: np.ndarray
    spread: Array
    columns: Array
    blocks: np.ndarray
    rows: np.ndarray

    @classmethod
    def of(cls, problem: ConicProblem, variables: np.ndarray) -> _Move:
        columns = problem.root[:, variables]
        spread = np.linalg.inv(np.linalg.qr(columns, mode="r"))
        blocks = np.flatnonzero(np.isin(problem.variables, variables).any(axis=1))
        rows = np.flatnonzero(problem.G[:, variables].any(axis=1))
        return cls(variables, spread, columns, blocks, rows)


def _truncated_normal(low: Array, high: Array, rng: np.random.Generator) -> Array:
    """Standard normal numbers between bounds, far into the tails."""
    flipped = low + high < 0.0
    near, far = np.where(flipped, -high, low), np.where(flipped, -low, high)  # the nearer one to 0 first
    of_near, of_far = log_ndtr(-near), log_ndtr(-far)
    ratio = np.exp(of_far - of_near)
    drawn = -ndtri_exp(of_near + np.log(ratio + rng.uniform(size=len(low)) * (1.0 - ratio)))
    drawn = np.clip(drawn, near, far)
    return np.where(flipped, -drawn, drawn)
