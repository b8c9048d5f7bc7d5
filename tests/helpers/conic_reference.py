"""Least objective, misfit and prior by a second formulation: matrices of matter, second-order cones, Clarabel."""

from __future__ import annotations

import warnings
from typing import Any

import cvxpy as cp
import numpy as np
from physical import pseudo
from synthetic import Array

from torchid.estimators import Conditions
from torchid.problem import LinearProblem

ACCURACY = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11}


class Bodies:
    """Bodies as pseudo-inertias J (4, 4) in units of their scale, and friction."""

    def __init__(self, problem: LinearProblem, conditions: Conditions, units: Array | None = None) -> None:
        """`units`: parameters (12 L,) whose pseudo-inertias L L^T are units, J = L M L^T of a variable M."""
        self.scale = problem.scale.reshape(-1, 12)
        self.nominal = problem.nominal.reshape(-1, 12)
        free = problem.free.reshape(-1, 12)
        self.M = [cp.Variable((4, 4), symmetric=True) if row[0] else None for row in free]
        scaled = self.nominal / self.scale
        roots = [
            np.linalg.cholesky(pseudo(z)) if units is not None and row[0] else np.eye(4)
            for z, row in zip((scaled if units is None else units.reshape(-1, 12) / self.scale), free, strict=True)
        ]
        inverse = [np.linalg.inv(L) for L in roots]
        self.M_nominal = [W @ pseudo(z) @ W.T for W, z in zip(inverse, scaled, strict=True)]
        self.J = [None if M is None else L @ M @ L.T for L, M in zip(roots, self.M, strict=True)]
        self.friction = cp.Variable((len(free), 2))
        self.held: list[Any] = []
        numbers = []
        for body, row in enumerate(free):
            known = self.nominal[body] / self.scale[body]
            J = self.J[body]
            if J is None:
                numbers.append(known[:10])
            else:
                second, t = J[:3, :3], cp.trace(J[:3, :3])
                inertia = [t - second[0, 0], -second[0, 1], -second[0, 2], t - second[1, 1], -second[1, 2]]
                numbers.append(cp.hstack([J[3, 3], J[0, 3], J[1, 3], J[2, 3], *inertia, t - second[2, 2]]))
                self.held.append(J - conditions.margin * np.eye(4) >> 0)
            for place in range(2):
                if row[10 + place]:
                    self.held.append(self.friction[body, place] >= 0.0)
                else:
                    self.held.append(self.friction[body, place] == known[10 + place])
        self.scaled = [cp.hstack([ten, self.friction[body]]) for body, ten in enumerate(numbers)]
        self.phi = [cp.multiply(self.scale[body], z) for body, z in enumerate(self.scaled)]
        self._conditions(conditions, free)

    def _conditions(self, conditions: Conditions, free: np.ndarray) -> None:
        total = sum(phi[0] for phi in self.phi)
        if conditions.total_mass is not None:
            self.held.append(total / conditions.total_mass == 1.0)
        for bound, sign in ((conditions.lower, 1.0), (conditions.upper, -1.0)):
            if bound is None:
                continue
            for body, number in zip(*np.nonzero(np.isfinite(bound) & free), strict=True):
                limit = bound[body, number] / self.scale[body, number]
                self.held.append(sign * self.scaled[body][number] >= sign * limit)
        for e in conditions.enclosures:
            mass = self.scaled[e.body][0]
            moment = self.phi[e.body][1:4] / self.scale[e.body, 0]
            off = np.diag(1.0 / e.half) @ e.axes.T @ (moment - e.centre * mass)
            self.held.append(cp.norm(off, np.inf if e.kind == "box" else 2) <= mass)
        for mirror in conditions.mirrors:
            T = np.eye(4)
            T[:3, :3] = mirror.reflection
            here, there = (self._physical(body) for body in (mirror.body, mirror.image))
            size = np.abs(pseudo(self.nominal[mirror.image])).max()
            self.held.append((T @ here @ T.T - there) / size == 0.0)
            self.held.append(self.friction[mirror.body] == self.friction[mirror.image])

    def _physical(self, body: int) -> Any:
        """Pseudo-inertia of a body in SI units."""
        return sum(pseudo(unit) * self.phi[body][k] for k, unit in enumerate(np.eye(12)[:10]))

    def prior(self, name: str) -> Any:
        """Of all free bodies; those of matter where bodies have `units`."""
        if name == "euclidean":
            return sum(
                cp.sum_squares(z - nominal / scale)
                for z, nominal, scale in zip(self.scaled, self.nominal, self.scale, strict=True)
            )
        value = cp.sum_squares(self.friction - (self.nominal / self.scale)[:, 10:])
        for M, nominal in zip(self.M, self.M_nominal, strict=True):
            if M is not None:
                value += cp.sum_squares(M - nominal) if name == "pullback" else cp.trace(M) - 4.0 - cp.log_det(M)
        return value


def _solved(objective: Any, held: list[Any]) -> float:
    """Least objective, as accurately as it comes."""
    programme = cp.Problem(cp.Minimize(objective), held)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        programme.solve(solver=cp.CLARABEL, **ACCURACY)
    return float(programme.value)


def least_objective(
    problem: LinearProblem, conditions: Conditions, prior: str, ridge: float, reference: Array | None = None
) -> float:
    """Least mean square of the residual and ridge times prior under the conditions; `reference` for the pull-back."""
    units = problem.nominal if reference is None else reference
    bodies = Bodies(problem, conditions, None if prior == "euclidean" else units)
    size = max(float(problem.b @ problem.b + problem.residual) / problem.rows, ridge, 1e-300)
    A, b = (x / np.sqrt(problem.rows * size) for x in (problem.A * problem.scale, problem.b))
    misfit = cp.sum_squares(A @ cp.hstack(bodies.scaled) - b)
    if problem.terms is not None:
        C, D, z = (x / np.sqrt(problem.rows * size) for x in (problem.terms.C, problem.terms.D, problem.terms.z))
        phi, psi = cp.hstack(bodies.phi), cp.Variable(len(problem.terms.size))
        misfit += cp.sum_squares(C @ phi + D @ psi - z)
        bodies.held += [one.terms @ psi + one.parameters @ phi >= 0.0 for one in problem.terms.conditions]
    least = _solved(misfit + ridge / size * bodies.prior(prior) if ridge else misfit, bodies.held)
    return least * size + problem.residual / problem.rows


def least_misfit(problem: LinearProblem, conditions: Conditions) -> float:
    """Least mean square of the residual under the conditions."""
    return least_objective(problem, conditions, "euclidean", 0.0)


def least_prior(problem: LinearProblem, conditions: Conditions, prior: str, phi: Array, tolerance: float) -> float:
    """Least prior of all parameters that predict what `phi`, (12 L,), does and meet the conditions."""
    bodies = Bodies(problem, conditions, None if prior == "euclidean" else problem.nominal)
    A = problem.A * problem.scale
    _, values, right = np.linalg.svd(A[:, problem.free], full_matrices=False)
    seen = np.zeros((int((values > tolerance * values[0]).sum()), len(problem.free)))
    seen[:, problem.free] = right[: len(seen)]
    same = seen @ (cp.hstack(bodies.scaled) - phi / problem.scale) == 0.0
    return _solved(bodies.prior(prior), [*bodies.held, same])
