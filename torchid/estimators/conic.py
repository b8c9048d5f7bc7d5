"""The convex problem behind every consistent estimate: a quadratic, 4 x 4 semidefinite blocks, linear conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchid.parameters import Array


@dataclass(frozen=True)
class ConicProblem:
    """min 1/2 x^T H x + c^T x + constant - sum_k w_k log det J_k(x), with J_k(x) >= 0, G x >= h, E x = e.

    Attributes:
        H: (n, n) positive semidefinite; c: (n,); constant.
        base: (K, 4, 4), `J_k(0)`.
        slopes: (K, 10, 4, 4), change of J_k with each of its variables; zero where it depends on fewer than ten.
        variables: (K, 10) int, which entries of x those are.
        weights: (K,) >= 0, of the log-determinants in the objective (an entropic prior's).
        G, h: (M, n), (M,).
        E, e: (Q, n), (Q,), rows of E independent.
        names: (K,) and then (M,): what each condition says, for messages.
    """

    H: Array
    c: Array
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
        """Degree of the barrier: the duality gap at barrier weight kappa is this times kappa."""
        return 4 * len(self.base) + len(self.h)

    def blocks(self, x: Array) -> Array:
        """J_k(x), (K, 4, 4)."""
        return self.base + np.einsum("kv,kvij->kij", x[self.variables], self.slopes)

    def slack(self, x: Array) -> Array:
        """How far every condition is from being broken: eigenvalues of the blocks (4 K,), then G x - h (M,)."""
        return np.concatenate([np.linalg.eigvalsh(self.blocks(x)).ravel(), self.G @ x - self.h])

    def objective(self, x: Array) -> float:
        """Value at a feasible x; inf where a weighted block is not positive definite."""
        value = 0.5 * x @ self.H @ x + self.c @ x + self.constant
        weighted = self.weights > 0.0
        if weighted.any():
            eigenvalues = np.linalg.eigvalsh(self.blocks(x)[weighted])
            if eigenvalues.min() <= 0.0:
                return np.inf
            value -= float((self.weights[weighted] * np.log(eigenvalues).sum(1)).sum())
        return float(value)
