"""The interior-point method for the conic problem, and the Gaussian that stands for one cut off by conditions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import torch
from torch import Tensor

from torchid.errors import InputError, NumericalWarning, warn
from torchid.estimators.conic_problem import EQUAL_WITHIN, ConicProblem, Solution
from torchid.parallel import one_thread
from torchid.parameters import Array

_STEPS = 200  # Newton steps
_PHASE_ONE_ROOT = 1e-6  # of the deviations, by the slack, in the objective of phase I
_GOOD_SLACK = 1e-6  # of a starting point, at which phase I stops
_LEAST_SLACK = 1e-9  # of a starting point that is accepted if phase I finds no better one
_MOST_SLACK = 0.01  # bound of the slack in phase I
_ROOM, _MOVES = 0.1, 3  # at rows of a starting point, and moves to get there
_SHORTEST = 1e-6  # least share of a step: below, rounding decides about feasibility


@one_thread()
@torch.inference_mode()
def find_strictly_feasible(problem: ConicProblem) -> tuple[Array, int]:
    """A strictly feasible x, (n,), near 0 where possible, and the Newton steps it took to find (phase I).

    Raises:
        InputError: there is none; names the condition that is violated most.
    """
    x = problem.E.T @ problem.e
    worst = float(problem.slack(x).min(initial=np.inf))
    if worst > _GOOD_SLACK:
        return x, 0
    inside = _with_room(problem, x)
    if problem.slack(inside).min() > _GOOD_SLACK:
        return inside, 0
    path = _PrimalDual(_phase_one(problem))
    point, steps = path.start(np.append(x, 1.0 - worst)), 0
    while point.complementarity > 0.1 * _LEAST_SLACK and steps < _STEPS:
        after = path.step(point)
        if after is None:
            break
        point, steps = after, steps + 1
        if problem.slack(point.x.numpy()[:-1]).min() > _GOOD_SLACK:
            return point.x.numpy()[:-1], steps
    z = point.x.numpy()
    slack = problem.slack(z[:-1])
    if slack.min() > _LEAST_SLACK:
        return z[:-1], steps
    which = int(slack.argmin())
    name = problem.names[which // 4 if which < 4 * len(problem.F0) else which - 3 * len(problem.F0)]
    raise InputError("estimator", name, "excluded by the other conditions", "conditions that some robot can meet")


def _with_room(problem: ConicProblem, x: Array) -> Array:
    """Near x, a point that is well inside the linear conditions: nominal friction of 0 stands on the border of its own.

    Each move, of least length, makes room at the rows that lack it, and may take some from others.
    """
    for _ in range(_MOVES):
        slack = problem.G @ x - problem.h
        tight = slack < _ROOM
        if not tight.any():
            break
        rows = problem.G[tight] @ problem.null_space
        x = x + problem.null_space @ np.linalg.lstsq(rows, _ROOM - slack[tight], rcond=EQUAL_WITHIN)[0]
    return x


def _phase_one(problem: ConicProblem) -> ConicProblem:
    """Min s, with s added to every eigenvalue and slack: a point with negative s is strictly feasible.

    Boyd, Vandenberghe, section 11.4, with two additions: a small quadratic, for directions without a minimum, and a
    lower bound on s, which saves steps.
    """
    n, blocks, rows = len(problem.linear), len(problem.F0), len(problem.h)
    return replace(
        problem,
        root=_PHASE_ONE_ROOT * np.hstack([problem.deviations, np.zeros((n, 1))]),
        target=np.zeros(n),
        linear=np.eye(n + 1)[n],
        constant=0.0,
        F=np.concatenate([problem.F, np.broadcast_to(np.eye(4), (blocks, 1, 4, 4))], axis=1),
        variables=np.concatenate([problem.variables, np.full((blocks, 1), n)], axis=1),
        weights=np.zeros(blocks),
        G=np.vstack([np.hstack([problem.G, np.ones((rows, 1))]), np.eye(n + 1)[n:]]),
        h=np.append(problem.h, -_MOST_SLACK),
        E=np.hstack([problem.E, np.zeros((len(problem.e), 1))]),
    )


def damped_inverse(A: Tensor) -> Callable[[Tensor], Tensor]:
    """B -> A^-1 b for A positive semidefinite, (n, n), with the least damping that works (Levenberg).

    Of A, which it overwrites, the lower triangle counts.
    """
    scale = A.diagonal().abs().clamp_min(torch.finfo(A.dtype).tiny).rsqrt()
    scaled, damping = A.mul_(scale).mul_(scale[:, None]), 0.0
    while True:
        root, failed = torch.linalg.cholesky_ex(scaled)
        if not failed:
            return lambda b: scale * torch.cholesky_solve((scale * b)[:, None], root)[:, 0]
        more = max(1e-15, 10.0 * damping)
        scaled.diagonal().add_(more - damping)
        damping = more


_LOOSE = 1e-6  # relative gap above which there is a warning
_PATIENCE = 2  # steps in a row without a smaller gap: rounding makes small gaps uneven
_SHARE = 0.98  # of the longest step that stays inside
_CENTRE_SHRINK = 0.1  # of the barrier's weight from step to step towards a point of the central path
_CENTRED_CHANGE = 1e-9  # relative, of blocks and slacks, in the last of these steps
_SHORT = 0.2  # length of a corrected step below which a plain one is taken
_ACCURATE, _CENTRED = 1e-9, 0.5  # complementarity, relative to the objective, from which on the gap itself is computed


@one_thread()
@torch.inference_mode()
def solve_barrier(problem: ConicProblem, tolerance: float = 1e-9) -> Solution:
    """Follow the central path until the duality gap is below `tolerance` times the objective.

    Newton's method on primal and dual together, with Mehrotra's predictor and corrector, in the null space of the
    equalities; blocks and multipliers are linearized as by Helmberg, Rendl, Vanderbei, Wolkowicz, "An interior-point
    method for semidefinite programming", 1996. It needs half of the steps of a path that is followed by the primal
    alone. Newton or Gauss-Newton steps in log-Cholesky coordinates need many more: their curvature excites the stiff
    directions of the data.

    Args:
        problem: with objective and conditions.
        tolerance: relative gap; for optima near 0 relative to the problem's floor.

    Raises:
        InputError: the conditions exclude each other.

    Warns:
        NumericalWarning: rounding ended the path early.
    """
    x, steps = find_strictly_feasible(problem)
    path = _PrimalDual(problem)
    point = path.start(x)
    best, worse = Solution(x, problem.objective(x), np.inf, steps), 0
    for count in range(1, _STEPS + 1):
        after = path.step(point)
        if after is not None:
            point, steps = after, steps + 1
        x = point.x.numpy()
        objective, last = problem.objective(x), after is None or count == _STEPS
        scale = max(objective, problem.floor)
        far = point.complementarity > _CENTRED * max(tolerance, _ACCURATE) * scale
        if far and not last and not problem.weights.any():
            continue  # the gap takes as long as a step; with small log-determinants rounding may leave none later on
        gap = problem.gap(x, *path.multipliers(point))
        worse = worse + 1 if gap >= best.gap and not far else 0
        if worse > _PATIENCE:
            break  # rounding errors exceed the progress
        if gap < best.gap:
            best = Solution(x, objective, gap, steps)
        if last or gap <= tolerance * scale:
            break
    if not best.gap <= max(_LOOSE, tolerance) * max(best.objective, problem.floor):
        message = f"estimator: the barrier method stopped at a gap of {best.gap:.1g} to {best.objective:.3g}"
        warn(message, NumericalWarning)
    return best


@dataclass(frozen=True)
class _Point:
    """A strictly feasible point and multipliers.

    Attributes:
        x: (n,).
        whitening: (K, 4, 4), inverse C^-1 of the Cholesky factors of the blocks F_k(x).
        slack: (M,), of the rows.
        Z: (K, 4, 4), multipliers of the blocks, C^T Z_k C.
        y: (M,), multipliers of the rows.
        complementarity: how far the multipliers are from those of a minimizer: the gap where the gradient is balanced.
    """

    x: Tensor
    whitening: Tensor
    slack: Tensor
    Z: Tensor
    y: Tensor
    complementarity: float


@dataclass(frozen=True)
class _Direction:
    """Changes of a point, in its own coordinates; those of the blocks are (K, 4, 4)."""

    x: Tensor
    blocks: Tensor
    slack: Tensor
    Z: Tensor
    y: Tensor


class _PrimalDual:
    """Newton steps on a conic problem, whose arrays are tensors here."""

    def __init__(self, problem: ConicProblem) -> None:
        """They share memory with the arrays."""
        self.problem = problem
        self.F0, self.F = torch.from_numpy(problem.F0), torch.from_numpy(problem.F)
        self.variables = torch.from_numpy(problem.variables)
        self.G, self.h = torch.from_numpy(problem.G), torch.from_numpy(problem.h)
        self.H = torch.from_numpy(problem.hessian)
        self._row_columns = torch.from_numpy(np.flatnonzero(problem.G.any(axis=0)))  # bounds are on one variable each
        self._rows = self.G[:, self._row_columns]
        self.weights = torch.from_numpy(problem.weights)
        self.null_space = torch.from_numpy(problem.null_space) if len(problem.e) else None
        self.eye = torch.eye(4, dtype=self.F0.dtype)

    def with_rows(self, stiffness: Tensor) -> Tensor:
        """Hessian of the quadratic and of rows with a stiffness each, (M,): H + G^T diag(stiffness) G, (n, n)."""
        at = self._row_columns
        return self.H.index_put((at[:, None], at), self._rows.T @ (stiffness[:, None] * self._rows), accumulate=True)

    def factors(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        """Cholesky factors (K, 4, 4) of the blocks and slacks (M,) of the rows at x, (n,); None if it is infeasible."""
        root, failed = torch.linalg.cholesky_ex(self.F0 + (x[self.variables, None, None] * self.F).sum(1))
        slack = self.G @ x - self.h
        return None if failed.any() or not (slack > 0.0).all() else (root, slack)

    def feasible_factors(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The same of a point that is strictly feasible; LinAlgError where rounding says that it is not."""
        factors = self.factors(x)
        if factors is None:
            raise np.linalg.LinAlgError("by rounding, the starting point is not strictly feasible")
        return factors

    def start(self, x: np.ndarray) -> _Point:
        """A strictly feasible x, (n,), with the multipliers of a point of the central path."""
        factors = self.feasible_factors(torch.from_numpy(x.copy()))
        kappa = max(self.problem.objective(x), self.problem.floor) / max(self.problem.degree, 1)
        Z = (self.weights + kappa)[:, None, None] * self.eye
        return self._point(torch.from_numpy(x.copy()), factors, Z, kappa / factors[1])

    def _point(self, x: Tensor, factors: tuple[Tensor, Tensor], Z: Tensor, y: Tensor) -> _Point:
        """The point x, (n,), of these `factors`, with its multipliers."""
        root, slack = factors
        whitening = torch.linalg.solve_triangular(root, self.eye, upper=False)
        off = torch.linalg.eigvalsh(Z - self.weights[:, None, None] * self.eye)
        return _Point(x, whitening, slack, Z, y, float(off.abs().sum() + slack @ y))

    def multipliers(self, point: _Point) -> tuple[np.ndarray, np.ndarray]:
        """Of the blocks, (K, 4, 4), and of the rows, (M,)."""
        return (point.whitening.mT @ point.Z @ point.whitening).numpy(), point.y.numpy()

    def step(self, point: _Point) -> _Point | None:
        """The next point; None where rounding leaves none."""
        Z_root, failed = torch.linalg.cholesky_ex(point.Z)
        if failed.any():
            return None
        solve = self._newton(point)
        none = torch.zeros(())
        affine = solve(0.0, none, none)
        kappa = point.complementarity / max(self.problem.degree, 1)
        shrunk = (1.0 - min(1.0, self._longest(point, Z_root, affine))) ** 3 * kappa
        move = solve(shrunk, _symmetric(affine.blocks @ affine.Z), affine.slack * affine.y)
        length = min(1.0, _SHARE * self._longest(point, Z_root, move))
        if length < _SHORT:  # far from the path, where the corrections mislead: back to a point of it that is as far
            promised = -float(self.problem.gradient(point.x.numpy()) @ affine.x.numpy())
            move = solve(max(kappa, promised / max(self.problem.degree, 1)), none, none)
            length = min(1.0, _SHARE * self._longest(point, Z_root, move))
        return self._moved(point, move, length)

    def centre(self, x: np.ndarray, kappa: float) -> np.ndarray:
        """The point of the central path at a barrier weight, (n,), from a strictly feasible one."""
        point, none = self.start(x), torch.zeros(())
        for _ in range(_STEPS):
            target = max(kappa, _CENTRE_SHRINK * point.complementarity / max(self.problem.degree, 1))
            move = self._newton(point)(target, none, none)
            Z_root, failed = torch.linalg.cholesky_ex(point.Z)
            length = 0.0 if failed.any() else min(1.0, _SHARE * self._longest(point, Z_root, move))
            after = self._moved(point, move, length) if length else None
            if after is None:
                break
            relative = torch.cat([move.blocks.flatten(), move.slack / point.slack])
            point = after
            if target == kappa and length == 1.0 and float(relative.abs().sum()) < _CENTRED_CHANGE:
                break
        return point.x.numpy()

    def _moved(self, point: _Point, move: _Direction, length: float) -> _Point | None:
        """A share of a step from a point; None where rounding leaves none."""
        while (factors := self.factors(point.x + length * move.x)) is None and length > _SHORTEST:
            length *= 0.5  # infeasible by rounding alone
        if factors is None:
            return None
        change = point.whitening @ factors[0]
        Z = _symmetric(change.mT @ (point.Z + length * move.Z) @ change)
        return self._point(point.x + length * move.x, factors, Z, point.y + length * move.y)

    def _newton(self, point: _Point) -> Callable[[float, Tensor, Tensor], _Direction]:
        """Direction towards the point of the path at a barrier weight, with corrections of second order."""
        whitened = point.whitening[:, None] @ self.F @ point.whitening[:, None].mT  # (K, V, 4, 4), C^-1 F C^-T
        flat = whitened.flatten(2)

        def gathered(blocks: Tensor) -> Tensor:
            out = torch.zeros_like(point.x)
            return out.index_put_((self.variables,), (flat @ blocks.flatten(1)[..., None])[..., 0], accumulate=True)

        curvature = flat @ (whitened @ point.Z[:, None]).flatten(2).mT
        stiffness = point.y / point.slack
        hessian = self.with_rows(stiffness)
        rows, columns = self.variables[:, :, None], self.variables[:, None, :]
        hessian.index_put_((rows.expand_as(curvature), columns.expand_as(curvature)), curvature, accumulate=True)
        N = self.null_space
        invert = damped_inverse(hessian if N is None else N.T @ hessian @ N)
        gradient = torch.from_numpy(self.problem.gradient(point.x.numpy())) - self.G.T @ point.y - gathered(point.Z)

        def solve(kappa: float, block_correction: Tensor, row_correction: Tensor) -> _Direction:
            Z = (self.weights + kappa)[:, None, None] * self.eye - point.Z - block_correction
            y = (kappa - row_correction) / point.slack - point.y
            slope = gathered(Z) + self.G.T @ y - gradient
            x = invert(slope) if N is None else N @ invert(N.T @ slope)
            blocks, slack = (x[self.variables, None, None] * whitened).sum(1), self.G @ x
            return _Direction(x, blocks, slack, Z - _symmetric(blocks @ point.Z), y - stiffness * slack)

        return solve

    def _longest(self, point: _Point, Z_root: Tensor, move: _Direction) -> float:
        """The largest share of a step that keeps blocks, slacks and multipliers nonnegative."""
        half = torch.linalg.solve_triangular(Z_root, move.Z, upper=False)
        relative_Z = _symmetric(torch.linalg.solve_triangular(Z_root, half.mT, upper=False))
        eigenvalues = torch.linalg.eigvalsh(torch.cat([move.blocks, relative_Z])).ravel()
        rates = torch.cat([eigenvalues, move.slack / point.slack, move.y / point.y])
        return 1.0 / max(-float(rates.min()), 1e-9) if len(rates) else np.inf


def _symmetric(A: Tensor) -> Tensor:
    return 0.5 * (A + A.mT)


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
@torch.inference_mode()
def barrier_gaussian(conic: ConicProblem) -> BarrierGaussian:
    """The Gaussian for the density exp(-objective / 2) of a problem without log-determinants.

    Raises:
        InputError: the conditions exclude each other.
    """
    x, _ = find_strictly_feasible(conic)
    conditions = _Conditions(conic)
    near = np.zeros(conditions.count, dtype=bool)
    for _ in range(_PASSES):
        mean = _mean(conic, x, near)
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
    mean = _mean(conic, x, near)
    return conditions.gaussian(mean, near)


def _mean(conic: ConicProblem, x: Array, near: np.ndarray) -> Array:
    """Where the density times the barriers of some conditions is largest, from a point inside all."""
    blocks, rows = np.split(near, [len(conic.F0)])
    part = replace(
        conic,
        F0=conic.F0[blocks],
        F=conic.F[blocks],
        variables=conic.variables[blocks],
        weights=conic.weights[blocks],
        G=conic.G[rows],
        h=conic.h[rows],
    )
    return _PrimalDual(part).centre(x, 2.0)


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
