"""The convex problem behind every consistent estimate: a quadratic, 4 x 4 semidefinite blocks, linear conditions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torchid.parameters import Array

_REACH = 1e3  # scales of the parameters: no better point is looked for further away, where the data say nothing
_WORTH = 1e-6  # least size of an objective, as a share of what deviations of one scale cost: a thousandth of one


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

    @property
    def degree(self) -> int:
        """Degree of the barrier: near its minimizer at weight kappa the duality gap is this times kappa."""
        return 4 * len(self.base) + len(self.h)

    @cached_property
    def H(self) -> Array:
        """Hessian of the quadratic, (n, n)."""
        return 2.0 * self.root.T @ self.root

    @cached_property
    def moves(self) -> Array:
        """Orthonormal moves that keep E x, (n, n - Q)."""
        if not len(self.e):
            return np.eye(len(self.linear))
        return np.ascontiguousarray(np.linalg.svd(self.E)[2][len(self.e) :].T)

    @cached_property
    def size(self) -> float:
        """Size of the objective: at x = 0, or that of a small deviation if there it is nothing."""
        curvature = float(np.square(self.root).sum()) / max(len(self.linear), 1)
        return max(self.objective(np.zeros(len(self.linear))), _WORTH * curvature, float(np.finfo(float).tiny))

    @cached_property
    def unconstrained(self) -> float | None:
        """Least objective without conditions; None where log-determinants keep one."""
        if self.weights.any() or self.linear.any():
            return None
        return self.objective(np.linalg.lstsq(self.root, self.target)[0])

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
        residual = self.gradient(x) - self.G.T @ y
        np.subtract.at(residual, self.variables, np.einsum("kvij,kij->kv", self.slopes, Z))
        residual = self.moves @ (self.moves.T @ residual)
        blocks = self.blocks(x)
        gap = float(y @ (self.G @ x - self.h))
        for k, weight in enumerate(self.weights):
            if weight == 0.0:
                gap += float(np.sum(Z[k] * blocks[k]))
                continue
            # A weighted block depends on ten variables, and its multiplier takes up what is left there.
            rest = np.linalg.lstsq(self.slopes[k].reshape(10, 16), residual[self.variables[k]])[0].reshape(4, 4)
            residual[self.variables[k]] = 0.0
            relative = np.linalg.eigvals(blocks[k] @ (Z[k] + rest)).real / weight
            gap += weight * float((relative - 1.0 - np.log(relative)).sum()) if relative.min() > 0.0 else np.inf
        values, vectors = self._curvature
        off = np.abs(vectors.T @ residual)
        bowl = np.divide(off**2, 2.0 * values, out=np.full_like(off, np.inf), where=values > 0.0)
        return gap + float(np.minimum(bowl, _REACH * off).sum())

    @cached_property
    def _curvature(self) -> tuple[Array, Array]:
        """Eigenvalues and eigenvectors, (n, n - Q), of the Hessian along the moves."""
        values, vectors = np.linalg.eigh(self.moves.T @ self.H @ self.moves)
        return values, self.moves @ vectors
