"""The conic problem behind every consistent estimate: a quadratic, linear matrix inequalities, linear conditions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg

from torchid.errors import InputError
from torchid.parameters import Array

EQUAL_WITHIN = 1e-9
"""Numbers closer than this share of their scale count as equal."""

_SEARCH_RADIUS = 1e3
"""Radius, in scales of the parameters, within which a gap is valid along directions that the data do not determine."""


@dataclass(frozen=True)
class Solution:
    """An approximate minimizer.

    Attributes:
        x: (n,).
        objective: at x.
        gap: duality gap, which bounds how far the objective is above the least one.
        steps: Newton steps.
    """

    x: Array
    objective: float
    gap: float
    steps: int


@dataclass(frozen=True)
class LinearCondition:
    """row @ x >= bound, or == bound, and its name for messages."""

    name: str
    row: Array
    bound: float


@dataclass(frozen=True)
class ConicProblem:
    """min ||R x - r||^2 + c^T x + constant - sum_k w_k log det F_k(x), with F_k(x) >= 0, G x >= h, E x = e.

    The linear matrix inequalities are F_k(x) = F0_k + sum_v x_v F_kv, as in Boyd, Vandenberghe, "Convex Optimization",
    section 4.6, each on ten of the variables.

    Attributes:
        root: R, (m, n); target: r, (m,); linear: c, (n,); constant.
        F0: (K, 4, 4).
        F: (K, 10, 4, 4), zero where an inequality depends on fewer than ten variables.
        variables: (K, 10) int, which entries of x those are.
        weights: (K,) >= 0, of the log-determinants in the objective (an entropic prior's).
        G, h: (M, n), (M,).
        E, e: (Q, n), (Q,), rows of E orthonormal.
        names: (K,) and then (M,): of the conditions, for messages.
        floor: > 0, the objective that counts as 0: below, gaps are relative to this.
        deviations: (n, n): `deviations @ x` is the deviation of the parameters from nominal, in units of their scale,
            and then the terms of the problem in units of their size.
    """

    root: Array
    target: Array
    linear: Array
    constant: float
    F0: Array
    F: Array
    variables: np.ndarray
    weights: Array
    G: Array
    h: Array
    E: Array
    e: Array
    names: tuple[str, ...]
    floor: float
    deviations: Array

    @property
    def degree(self) -> int:
        """Degree of the barrier: near its minimizer at weight kappa the duality gap is this times kappa."""
        return 4 * len(self.F0) + len(self.h)

    @cached_property
    def hessian(self) -> Array:
        """Hessian of the quadratic, (n, n)."""
        return 2.0 * self.root.T @ self.root

    @cached_property
    def null_space(self) -> Array:
        """Orthonormal basis of the null space of E, (n, n - Q)."""
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
        """F_k(x), (K, 4, 4)."""
        return self.F0 + np.einsum("kv,kvij->kij", x[self.variables], self.F)

    def slack(self, x: Array) -> Array:
        """Distance of x from the border of every condition: eigenvalues of F_k(x) (4 K,), then G x - h (M,)."""
        return np.concatenate([np.linalg.eigvalsh(self.blocks(x)).ravel(), self.G @ x - self.h])

    def active(self, x: Array, tolerance: float) -> tuple[str, ...]:
        """Names of conditions from whose border x (n,) is no further than a tolerance; an entropic prior is none."""
        blocks, rows = np.split(self.slack(x), [4 * len(self.F0)])
        slack = np.append(np.where(self.weights > 0.0, np.inf, blocks.reshape(-1, 4).min(axis=1, initial=np.inf)), rows)
        return tuple(dict.fromkeys(name for name, one in zip(self.names, slack, strict=True) if one <= tolerance))

    def gradient(self, x: Array) -> Array:
        """Gradient of the quadratic and the linear term, (n,)."""
        return 2.0 * self.root.T @ (self.root @ x - self.target) + self.linear

    def objective(self, x: Array) -> float:
        """Objective at x (n,); inf where a block with a weight is not positive definite."""
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
        """Objective at x less the dual objective: no feasible point within `_SEARCH_RADIUS` is better by more.

        Whatever the multipliers, weak duality holds, so that this bounds the error of any solver.

        Args:
            x: (n,), a point that meets the conditions.
            Z: (K, 4, 4), positive semidefinite multipliers of the blocks; of weighted blocks, w_k / J_k and the like.
            y: (M,) >= 0, multipliers of the rows.
        """
        blocks, weighted = self.blocks(x), self.weights > 0.0
        multiplier_slopes = np.zeros_like(self.F)  # w F^-1 dF F^-1 of weighted blocks
        inverse = np.linalg.inv(blocks[weighted])[:, None]
        multiplier_slopes[weighted] = self.weights[weighted, None, None, None] * inverse @ self.F[weighted] @ inverse
        residual = self.gradient(x) - self.G.T @ y - self._gathered(Z)
        # A Newton step balances the part of it in directions in which quadratic and log-determinants are stiff enough.
        step = None if weighted.any() else self._balancing_step(residual)
        if step is None:
            values, vectors = self._stiffness_modes(multiplier_slopes)
            modes = vectors.T @ (self.null_space.T @ residual)
            balanced = np.abs(modes) <= 2.0 * _SEARCH_RADIUS * values
            lengths = modes[balanced] / np.maximum(values[balanced], np.finfo(float).tiny)
            step = -self.null_space @ (vectors[:, balanced] @ lengths)
        multiplier_change = np.einsum("kv,kvij->kij", step[self.variables], multiplier_slopes)
        unbalanced = self.null_space.T @ (residual + self.hessian @ step + self._gathered(multiplier_change))
        gap = 0.5 * step @ self.hessian @ step + y @ (self.G @ x - self.h) + _SEARCH_RADIUS * np.abs(unbalanced).sum()
        products = blocks @ (Z - multiplier_change)
        gap += np.trace(products[~weighted], axis1=1, axis2=2).sum()
        weights = self.weights[weighted, None]
        relative = np.linalg.eigvals(products[weighted]).real / weights
        if relative.min(initial=1.0) <= 0.0:
            return np.inf
        return float(gap + (weights * (relative - 1.0 - np.log(relative))).sum())

    def _balancing_step(self, residual: Array) -> Array | None:
        """The Newton step of the quadratic; None where it is not stiff enough in all directions."""
        if self._stiffness_root is None:
            return None
        lengths = scipy.linalg.cho_solve((self._stiffness_root, True), self.null_space.T @ residual)
        return -self.null_space @ lengths if np.linalg.norm(lengths) <= 2.0 * _SEARCH_RADIUS else None

    @cached_property
    def _stiffness_root(self) -> Array | None:
        """Lower triangular factor of the quadratic in the null space of the equalities; None by rounding."""
        reduced = self.null_space.T @ self.hessian @ self.null_space if len(self.e) else self.hessian
        try:
            return np.asarray(np.linalg.cholesky(reduced))
        except np.linalg.LinAlgError:
            return None

    def _stiffness_modes(self, multiplier_slopes: Array) -> tuple[Array, Array]:
        """Those of quadratic and log-determinants, whose multipliers change by these slopes, (K, 10, 4, 4)."""
        hessian = self.hessian.copy()
        pairs = (self.variables[:, :, None], self.variables[:, None, :])
        np.add.at(hessian, pairs, np.einsum("kuij,kvij->kuv", multiplier_slopes, self.F))
        values, vectors = np.linalg.eigh(self.null_space.T @ hessian @ self.null_space)
        return values, vectors

    def _gathered(self, Z: Array) -> Array:
        """Sum of <Z_k, dF_k/dx>, (n,)."""
        out = np.zeros(len(self.linear))
        np.add.at(out, self.variables, np.einsum("kvij,kij->kv", self.F, Z))
        return out


def reduce_equalities(rows: list[LinearCondition], count: int) -> tuple[Array, Array]:
    """The same equalities E x = e in as few orthonormal rows as they have rank.

    Args:
        rows: the equalities.
        count: of entries in x, n.

    Returns:
        E, (rank, n), with orthonormal rows, and e, (rank,).

    Raises:
        InputError: they contradict each other, or parameters that are not free.
    """
    E, e = np.array([row.row for row in rows]).reshape(len(rows), count), np.array([row.bound for row in rows])
    U, values, right = np.linalg.svd(E, full_matrices=False)
    kept = values > 1e-10 * values.max(initial=0.0)
    off = np.abs(e - U[:, kept] @ (U[:, kept].T @ e)) > EQUAL_WITHIN * (1.0 + np.abs(e).max(initial=0.0))
    if off.any():
        names = ", ".join(dict.fromkeys(row.name for row, wrong in zip(rows, off, strict=True) if wrong))
        found = "contradicts what is held fixed or the other equalities"
        raise InputError("estimator", names, found, "equalities that some parameters meet")
    return right[kept], (U[:, kept].T @ e) / values[kept]


def remove_implied(rows: list[LinearCondition], E: Array, e: Array) -> list[LinearCondition]:
    """The inequalities without those that equalities E x = e imply: with them there is no strictly feasible point.

    Raises:
        InputError: an inequality contradicts the equalities.
    """
    out = []
    for row in rows:
        along = E @ row.row
        if np.linalg.norm(row.row - E.T @ along) > EQUAL_WITHIN * np.linalg.norm(row.row):
            out.append(row)
        elif along @ e < row.bound - EQUAL_WITHIN * (1.0 + abs(row.bound)):
            raise InputError("estimator", row.name, "excluded by equalities", "conditions that some robot can meet")
    return out
