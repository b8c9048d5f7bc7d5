"""The convex problem behind every consistent estimate: a quadratic, 4 x 4 semidefinite blocks, linear conditions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchid.errors import InputError
from torchid.parameters import Array
from torchid.rounding import is_significant

SAME = 1e-9
"""Numbers closer than this share of their scale are one."""

REACH = 1e3
"""Scales of the parameters: no better point is looked for further away, where the data say nothing."""


@dataclass(frozen=True)
class Solution:
    """A minimizer.

    Attributes:
        x: (n,).
        objective: there.
        gap: its distance to the dual objective, which bounds how far it is above the least one.
        steps: Newton steps, or iterations of the conic solver.
    """

    x: Array
    objective: float
    gap: float
    steps: int


@dataclass(frozen=True)
class Row:
    """A linear condition: row @ x >= bound, or == bound."""

    name: str
    row: Array
    bound: float


@dataclass(frozen=True)
class ConicProblem:
    """min ||R x - r||^2 + c^T x + constant - sum_k w_k log det J_k(x), with J_k(x) >= 0, G x >= h, E x = e.

    Attributes:
        root: R, (m, n); target: r, (m,); linear: c, (n,); constant.
        base: (K, 4, 4), `J_k(0)`.
        slopes: (K, 10, 4, 4), change of J_k with each of its variables; zero where it depends on fewer than ten.
        variables: (K, 10) int, which entries of x those are.
        weights: (K,) >= 0, of the log-determinants in the objective (an entropic prior's).
        G, h: (M, n), (M,).
        E, e: (Q, n), (Q,), rows of E orthonormal.
        names: (K,) and then (M,): what each condition says, for messages.
        floor: > 0, an objective that is as good as none: below, gaps are relative to this.
        deviations: (n, n): `deviations @ x` is what parameters deviate by from nominal, in units of their scale.
        start: (n,), a point that is known to be inside all conditions; None where they are not known to leave room.
    """

    root: Array
    target: Array
    linear: Array
    constant: float
    base: Array
    slopes: Array
    variables: np.ndarray
    weights: Array
    G: Array
    h: Array
    E: Array
    e: Array
    names: tuple[str, ...]
    floor: float
    deviations: Array
    start: Array | None = None

    @property
    def degree(self) -> int:
        """Degree of the barrier: near its minimizer at weight kappa the duality gap is this times kappa."""
        return 4 * len(self.base) + len(self.h)

    @cached_property
    def hessian(self) -> Array:
        """Hessian of the quadratic, (n, n)."""
        return 2.0 * self.root.T @ self.root

    @cached_property
    def moves(self) -> Array:
        """Orthonormal moves that keep E x, (n, n - Q)."""
        if not len(self.e):
            return np.eye(len(self.linear))
        return np.ascontiguousarray(np.linalg.svd(self.E)[2][len(self.e) :].T)

    @cached_property
    def unconstrained(self) -> float | None:
        """Least objective without conditions; None where log-determinants keep one."""
        if self.weights.any() or self.linear.any():
            return None
        return self.objective(np.asarray(np.linalg.lstsq(self.root, self.target)[0], dtype=np.float64))

    def blocks(self, x: Array) -> Array:
        """J_k(x), (K, 4, 4)."""
        return self.base + np.einsum("kv,kvij->kij", x[self.variables], self.slopes)

    def slack(self, x: Array) -> Array:
        """How far every condition is from being broken: eigenvalues of the blocks (4 K,), then G x - h (M,)."""
        return np.concatenate([np.linalg.eigvalsh(self.blocks(x)).ravel(), self.G @ x - self.h])

    def gradient(self, x: Array) -> Array:
        """Of the quadratic and the linear term, (n,)."""
        return 2.0 * self.root.T @ (self.root @ x - self.target) + self.linear

    def objective(self, x: Array) -> float:
        """Value at x; inf where a weighted block is not positive definite."""
        misfit = self.root @ x - self.target
        value = misfit @ misfit + self.linear @ x + self.constant
        weighted = self.weights > 0.0
        if weighted.any():
            eigenvalues = np.linalg.eigvalsh(self.blocks(x)[weighted])
            if eigenvalues.min() <= 0.0:
                return np.inf
            value -= float((self.weights[weighted] * np.log(eigenvalues).sum(1)).sum())
        return float(value)

    def gap(self, x: Array, Z: Array, y: Array) -> float:
        """Objective at x less the dual objective: no point of the domain within reach is better by more.

        Whatever the multipliers, weak duality holds, so that this bounds the error of any solver.

        Args:
            x: (n,), a point that meets the conditions.
            Z: (K, 4, 4), positive semidefinite multipliers of the blocks; of weighted blocks, w_k / J_k and the like.
            y: (M,) >= 0, multipliers of the rows.
        """
        blocks, weighted = self.blocks(x), self.weights > 0.0
        turned = np.zeros_like(self.slopes)  # w J^-1 dJ J^-1, change of a weighted block's multiplier
        inverse = np.linalg.inv(blocks[weighted])[:, None]
        turned[weighted] = self.weights[weighted, None, None, None] * inverse @ self.slopes[weighted] @ inverse
        hessian = self.hessian.copy()
        pairs = (self.variables[:, :, None], self.variables[:, None, :])
        np.add.at(hessian, pairs, np.einsum("kuij,kvij->kuv", turned, self.slopes))
        residual = self.gradient(x) - self.G.T @ y - self._gathered(Z)
        # A Newton step says what the quadratic and the log-determinants can take up of it, at least cost.
        values, vectors = np.linalg.eigh(self.moves.T @ hessian @ self.moves)
        modes = vectors.T @ (self.moves.T @ residual)
        seen = np.abs(modes) <= 2.0 * REACH * values
        step = -self.moves @ (vectors[:, seen] @ (modes[seen] / np.maximum(values[seen], np.finfo(float).tiny)))
        taken = np.einsum("kv,kvij->kij", step[self.variables], turned)
        left = self.moves.T @ (residual + self.hessian @ step + self._gathered(taken))
        gap = 0.5 * step @ self.hessian @ step + y @ (self.G @ x - self.h) + REACH * np.abs(left).sum()
        products = blocks @ (Z - taken)
        gap += np.trace(products[~weighted], axis1=1, axis2=2).sum()
        weights = self.weights[weighted, None]
        relative = np.linalg.eigvals(products[weighted]).real / weights
        if relative.min(initial=1.0) <= 0.0:
            return np.inf
        return float(gap + (weights * (relative - 1.0 - np.log(relative))).sum())

    def _gathered(self, Z: Array) -> Array:
        """Sum of <Z_k, dJ_k/dx>, (n,)."""
        out = np.zeros(len(self.linear))
        np.add.at(out, self.variables, np.einsum("kvij,kij->kv", self.slopes, Z))
        return out


def independent(rows: list[Row], count: int) -> tuple[Array, Array]:
    """The same equalities in as few rows as they have rank.

    Raises:
        InputError: they contradict each other, or what is held fixed.
    """
    E, e = np.array([row.row for row in rows]).reshape(len(rows), count), np.array([row.bound for row in rows])
    U, values, right = np.linalg.svd(E, full_matrices=False)
    kept = is_significant(values)
    off = np.abs(e - U[:, kept] @ (U[:, kept].T @ e)) > SAME * (1.0 + np.abs(e).max(initial=0.0))
    if off.any():
        names = ", ".join(dict.fromkeys(row.name for row, wrong in zip(rows, off, strict=True) if wrong))
        found = "contradicts what is held fixed or the other equalities"
        raise InputError("estimator", names, found, "equalities that some parameters meet")
    return right[kept], (U[:, kept].T @ e) / values[kept]


def with_room(rows: list[Row], E: Array, e: Array) -> list[Row]:
    """The rows that the equalities leave open: a barrier has no inside where they settle one.

    Raises:
        InputError: the equalities contradict one.
    """
    out = []
    for row in rows:
        along = E @ row.row
        if np.linalg.norm(row.row - E.T @ along) > SAME * np.linalg.norm(row.row):
            out.append(row)
        elif along @ e < row.bound - SAME * (1.0 + abs(row.bound)):
            raise InputError("estimator", row.name, "excluded by equalities", "conditions that some robot can meet")
    return out
