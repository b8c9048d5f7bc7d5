"""The fast path: a barrier method whose Newton steps are batched over bodies in torch."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchid.errors import InputError, NumericalWarning
from torchid.estimators.conic import ConicProblem
from torchid.parameters import Array
from torchid.problem.threads import one_thread

_SHRINK = 0.05  # of the barrier's weight from stage to stage; 0.1 takes a fifth more steps
_CENTRED = 1e-3  # squared Newton decrement at which a stage is done
_NEARLY = 0.1  # the same where rounding ends a stage
_STEPS, _STAGES, _HALVINGS = 60, 60, 60
_ARMIJO = 1e-4
_INSIDE = 1e-6  # least slack of a starting point
_DEEP = 0.01  # and the most that is looked for
_FLOOR = 1e-3  # of the objective at the start, for optima near 0


@dataclass(frozen=True)
class Solution:
    """A minimizer x, its objective, a bound on how far that is above the least one, Newton steps taken."""

    x: Array
    objective: float
    gap: float
    steps: int


def solve_barrier(problem: ConicProblem, tolerance: float = 1e-9) -> Solution:
    """Follow the central path until the duality gap is below `tolerance` times the objective.

    Newton's method on the quadratic minus kappa times the log-determinants of the blocks and the logarithms of the
    linear slacks, in the null space of the equalities. Newton or Gauss-Newton steps in log-Cholesky coordinates need
    ten times as many iterations: their curvature excites the stiff directions of the data.

    Args:
        problem: what to minimize.
        tolerance: relative gap.

    Raises:
        InputError: the conditions exclude each other.
    """
    with one_thread():
        return _follow(problem, tolerance)


def _follow(problem: ConicProblem, tolerance: float) -> Solution:
    x, steps = _interior(problem)
    path = _Path(problem)
    start = abs(problem.objective(x))
    kappa, gap = max(start, np.finfo(float).tiny) / max(problem.degree, 1), np.inf
    for _ in range(_STAGES):
        there, taken, centred = path.centre(x, kappa)
        steps += taken
        if not centred and np.isfinite(gap):
            break  # rounding is all that is left: the last point of the path stands
        x = there
        gap = kappa * problem.degree if centred else np.inf
        if gap <= tolerance * (abs(problem.objective(x)) + _FLOOR * start):
            break
        kappa *= _SHRINK
    if not np.isfinite(gap):
        warnings.warn(
            "estimator: the barrier method found no point of the central path", NumericalWarning, stacklevel=4
        )
    return Solution(x, problem.objective(x), gap, steps)


def _interior(problem: ConicProblem) -> tuple[Array, int]:
    """A strictly feasible x, near 0 if that is one, and the Newton steps it took to find."""
    x: Array = np.linalg.pinv(problem.E) @ problem.e
    worst = float(problem.slack(x).min(initial=np.inf))
    if worst > _INSIDE:
        return x, 0
    relaxed = _relaxed(problem)
    path, z, kappa, steps = _Path(relaxed), np.append(x, 1.0 - worst), 1.0, 0
    for _ in range(_STAGES):
        z, taken, _ = path.centre(z, kappa)
        steps += taken
        if problem.slack(z[:-1]).min() > _INSIDE:
            return z[:-1], steps
        if kappa * relaxed.degree < 0.1 * _INSIDE:
            break
        kappa *= _SHRINK
    slack = problem.slack(z[:-1])
    which = int(slack.argmin())
    name = problem.names[which // 4 if which < 4 * len(problem.base) else which - 3 * len(problem.base)]
    raise InputError("estimator", name, "excluded by the other conditions", "conditions that some robot can meet")


def _relaxed(problem: ConicProblem) -> ConicProblem:
    """Min s, with s added to every eigenvalue and slack: negative s is what `_interior` looks for."""
    n, blocks, rows = len(problem.c), len(problem.base), len(problem.h)
    slopes = np.concatenate([problem.slopes, np.broadcast_to(np.eye(4), (blocks, 1, 4, 4))], axis=1)
    variables = np.concatenate([problem.variables, np.full((blocks, 1), n)], axis=1)
    return replace(
        problem,
        H=np.diag(np.append(np.full(n, 1e-2), 0.0)),
        c=np.append(np.zeros(n), 1.0),
        constant=0.0,
        slopes=slopes,
        variables=variables,
        weights=np.zeros(blocks),
        G=np.vstack([np.hstack([problem.G, np.ones((rows, 1))]), np.eye(n + 1)[n:]]),
        h=np.append(problem.h, -_DEEP),  # or growing bodies would have no bound
        E=np.hstack([problem.E, np.zeros((len(problem.e), 1))]),
    )


class _Path:
    """The central path of a problem, as tensors."""

    def __init__(self, problem: ConicProblem) -> None:
        self.H, self.c = torch.from_numpy(problem.H), torch.from_numpy(problem.c)
        self.base, self.slopes = torch.from_numpy(problem.base), torch.from_numpy(problem.slopes)
        self.variables, self.weights = torch.from_numpy(problem.variables), torch.from_numpy(problem.weights)
        self.G, self.h = torch.from_numpy(problem.G), torch.from_numpy(problem.h)
        free = np.eye(len(problem.c))
        if len(problem.e):
            free = np.linalg.svd(problem.E)[2][len(problem.e) :].T  # moves that keep E x
        self.T = torch.from_numpy(np.ascontiguousarray(free))

    def centre(self, x: Array, kappa: float) -> tuple[Array, int, bool]:
        """The point of the path at barrier weight `kappa`, Newton steps to it from x inside, and if it was reached."""
        here = torch.from_numpy(x)
        value, taken = self._merit(here, kappa), 0
        while taken < _STEPS:
            taken += 1
            gradient, hessian = self._derivatives(here, kappa)
            slope = self.T.T @ gradient
            move = -(self.T @ _solved(self.T.T @ hessian @ self.T, slope))
            descent = float(gradient @ move)
            length = 1.0
            for _ in range(_HALVINGS):
                there = here + length * move
                new = self._merit(there, kappa)
                if new <= value + _ARMIJO * length * descent:
                    here, value = there, new
                    break
                length *= 0.5
            else:
                return here.numpy(), taken, -descent <= _NEARLY * kappa
            if -descent <= _CENTRED * kappa:
                return here.numpy(), taken, True
        return here.numpy(), taken, False

    def _blocks(self, x: Tensor) -> Tensor:
        return self.base + (x[self.variables, None, None] * self.slopes).sum(1)

    def _merit(self, x: Tensor, kappa: float) -> float:
        """Quadratic and barrier, inf outside."""
        slack = self.G @ x - self.h
        root, failed = torch.linalg.cholesky_ex(self._blocks(x))
        if failed.any() or (slack <= 0.0).any():
            return float("inf")
        logdet = 2.0 * root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        barrier = ((self.weights + kappa) * logdet).sum() + kappa * slack.log().sum()
        return float(0.5 * x @ self.H @ x + self.c @ x - barrier)

    def _derivatives(self, x: Tensor, kappa: float) -> tuple[Tensor, Tensor]:
        """Gradient (n,) and Hessian (n, n) of the merit."""
        weights = self.weights + kappa
        root = torch.linalg.cholesky(self._blocks(x))[:, None]
        half = torch.linalg.solve_triangular(root, self.slopes, upper=False)
        inside = torch.linalg.solve_triangular(root, half.mT, upper=False).flatten(2)  # (K, V, 16), C^-1 E C^-T
        trace = inside[..., ::5].sum(-1)
        slack = self.G @ x - self.h
        gradient = self.H @ x + self.c - kappa * (self.G.T @ (1.0 / slack))
        gradient.index_put_((self.variables,), -weights[:, None] * trace, accumulate=True)
        scaled = self.G / slack[:, None]
        hessian = self.H + kappa * scaled.T @ scaled
        rows, columns = self.variables[:, :, None], self.variables[:, None, :]
        curvature = weights[:, None, None] * (inside @ inside.mT)
        hessian.index_put_((rows.expand_as(curvature), columns.expand_as(curvature)), curvature, accumulate=True)
        return gradient, hessian


def _solved(A: Tensor, b: Tensor) -> Tensor:
    """A^-1 b for A positive semidefinite, with as much damping as it takes (Levenberg)."""
    diagonal = A.diagonal().abs().clamp_min(torch.finfo(A.dtype).tiny)
    scale = diagonal.rsqrt()
    scaled = scale[:, None] * A * scale
    damping = 0.0
    while True:
        root, failed = torch.linalg.cholesky_ex(scaled + damping * torch.eye(len(b), dtype=A.dtype))
        if not failed:
            return scale * torch.cholesky_solve((scale * b)[:, None], root)[:, 0]
        damping = max(1e-15, 10.0 * damping)
