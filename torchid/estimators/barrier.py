"""The primal-dual barrier method for the conic problem, its Newton steps batched over bodies in torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchid.errors import NumericalWarning, warn
from torchid.estimators.conic_problem import ConicProblem, Solution
from torchid.estimators.strict_feasibility import ConicTensors, damped_inverse, find_strictly_feasible
from torchid.problem.chunks import one_thread

_STEPS = 200
_LOOSE = 1e-6  # relative gap above which there is a warning
_PATIENCE = 2  # steps in a row without a smaller gap: rounding makes small gaps uneven
_SHARE = 0.98  # of the longest step that stays inside
_SHORT = 0.2  # length of a corrected step below which a plain one is taken
_SHORTEST = 1e-6  # least share of a step: below, rounding decides about feasibility
_ACCURATE, _CENTRED = 1e-9, 0.5  # complementarity, relative to the objective, from which on the gap itself is computed


@one_thread()
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
        if not last and point.complementarity > _CENTRED * max(tolerance, _ACCURATE) * scale:
            continue  # the gap takes as long as a step
        gap = problem.gap(x, *path.multipliers(point))
        worse = worse + 1 if gap >= best.gap else 0
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


class _PrimalDual(ConicTensors):
    """Newton steps on a problem."""

    def __init__(self, problem: ConicProblem) -> None:
        super().__init__(problem)
        self.weights = torch.from_numpy(problem.weights)
        self.null_space = torch.from_numpy(problem.null_space) if len(problem.e) else None
        self.eye = torch.eye(4, dtype=self.F0.dtype)

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

        curvature = flat @ (whitened @ point.Z[:, None]).mT.flatten(2).mT
        stiffness = point.y / point.slack
        hessian = self.H + self.G.T @ (stiffness[:, None] * self.G)
        rows, columns = self.variables[:, :, None], self.variables[:, None, :]
        hessian.index_put_((rows.expand_as(curvature), columns.expand_as(curvature)), curvature, accumulate=True)
        N = self.null_space
        invert = damped_inverse(_symmetric(hessian if N is None else N.T @ hessian @ N))
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
        return 1.0 / max(-float(rates.min()), 1e-9) if len(rates) else 1.0


def _symmetric(A: Tensor) -> Tensor:
    return 0.5 * (A + A.mT)
