"""The end of a descent: L-BFGS on all samples at once, which the compressed problem stands for."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.errors import NumericalWarning
from torchid.estimators.barrier import solve_barrier
from torchid.estimators.conic_loss import ConicLoss
from torchid.estimators.learnable import precondition_by
from torchid.estimators.least_squares import Minimizer
from torchid.estimators.sgd import Sgd, penalties
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem

_STEPS = 20  # of L-BFGS between preconditioners
_DAMPING = 0.01  # of these, over the objective
_RESTORATIONS, _RESTORED, _FLAT = 5, 1e-4, 1e-6  # their number, most of the objective that they cost, least slope
_SETTLED, _MET = 1e-9, 1e-10  # relative decrease of the objective in a round, violation of a condition
_RESOLVED = 1e-7  # relative change of the objective in a round, below which line searches end in its rounding
_ASTRAY = 1e-3  # relative change of the objective in a round of steps without a search that is not taken
_FROM_BORDER = 1e-3  # least root of an eigenvalue or of friction at the start: at 0 its gradient is none


class _Roots:
    """Deviations y by roots: J = margin 1 + R R^T and friction r^2, or plain numbers where violations are penalized.

    At the border of what can exist R is singular, but finite, where log-Cholesky coordinates end at minus infinity and
    slow down every method long before.
    """

    def __init__(self, settings: Sgd, problem: LinearProblem, start: Minimizer) -> None:
        free, bodies = problem.free.reshape(-1, PER_BODY), problem.free_bodies()
        possible = settings.consistency == "log_cholesky"
        moving, friction = np.zeros(free.shape, dtype=bool), np.zeros(free.shape, dtype=bool)
        if possible:
            moving[bodies, parameters.INERTIAL] = True
            friction = free & ~moving
        self.free, self.bodies = torch.from_numpy(problem.free), torch.from_numpy(bodies)
        self.moving, self.friction = torch.from_numpy(moving.ravel()), torch.from_numpy(friction.ravel())
        self.nominal = torch.from_numpy(problem.nominal / problem.scale)
        self.margin, scaled = settings.conditions.margin, start.phi / problem.scale
        values, vectors = np.linalg.eigh(
            parameters.pseudo_inertia(scaled.reshape(-1, PER_BODY)[bodies if possible else []])
            - self.margin * np.eye(4)
        )
        self.R = torch.from_numpy(vectors * np.sqrt(values.clip(_FROM_BORDER**2))[:, None])
        self.r = torch.from_numpy(scaled).masked_select(self.friction).clamp_min(_FROM_BORDER**2).sqrt()
        size = np.ones(0) if problem.terms is None else problem.terms.size
        terms = np.zeros_like(size) if start.psi is None else start.psi / size
        plain = [torch.from_numpy(scaled)[self.free & ~self.moving & ~self.friction], torch.from_numpy(terms)]
        self.plain, self.terms = torch.cat(plain), len(terms)
        self.from_pseudo = torch.from_numpy(np.linalg.pinv(parameters.PSEUDO_BASIS.reshape(-1, 16).T))

    @property
    def sizes(self) -> list[int]:
        return [self.R.numel(), len(self.r), len(self.plain)]

    def scaled(self, u: Tensor) -> tuple[Tensor, Tensor]:
        """Parameters (P,) and terms (M,) in units of their scale, `u` away from where the roots are, (n,)."""
        U, r, plain = u.split(self.sizes)
        R = self.R + U.view_as(self.R)
        J = R @ R.mT + self.margin * torch.eye(4, dtype=u.dtype)
        plain, terms = (self.plain + plain).tensor_split([len(self.plain) - self.terms])
        out = self.nominal.masked_scatter(self.free & ~self.moving & ~self.friction, plain)
        out = out.masked_scatter(self.moving, (J.flatten(1) @ self.from_pseudo.T).flatten())
        return out.masked_scatter(self.friction, (self.r + r).square()), terms

    def deviations(self, u: Tensor) -> Tensor:
        scaled, terms = self.scaled(u)
        return torch.cat([(scaled - self.nominal)[self.free], terms])

    def move(self, u: Tensor) -> None:
        U, r, plain = u.split(self.sizes)
        self.R, self.r, self.plain = self.R + U.view_as(self.R), self.r + r, self.plain + plain


@one_thread()
def finish(settings: Sgd, problem: LinearProblem, start: Minimizer) -> Minimizer:
    """Minimize the objective of a descent from where it ended.

    Args:
        settings: of the descent; `finish` rounds of L-BFGS are taken at most.
        problem: the compressed samples.
        start: where it ended.
    """
    roots, conic = _Roots(settings, problem, start), settings.conic_loss(problem)
    before = np.inf
    search: str | None = "strong_wolfe"
    for _ in range(settings.finish or 0):
        still = torch.zeros(sum(roots.sizes), dtype=torch.float64)
        slopes = torch.autograd.functional.jacobian(roots.deviations, still, vectorize=True)
        y = roots.deviations(still)
        damping = _DAMPING * max(float(conic.objective(y)), 1e-12)
        if settings.consistency == "penalties":
            damping += settings.penalties.curvature
        P = precondition_by(slopes.T @ conic.curvature(y) @ slopes, damping)
        raw = still.clone().requires_grad_()
        optimizer = torch.optim.LBFGS(
            [raw],
            max_iter=_STEPS,
            history_size=_STEPS,
            tolerance_grad=0.0,
            tolerance_change=0.0,
            line_search_fn=search,
        )

        def closure(raw: Tensor = raw, P: Tensor = P, optimizer: torch.optim.Optimizer = optimizer) -> Tensor:
            optimizer.zero_grad()
            value = _loss(settings, roots, conic, P @ raw)
            value.backward()
            return value

        optimizer.step(closure)
        moved = (P @ raw).detach()
        y, value = roots.deviations(moved), float(conic.objective(roots.deviations(moved)))
        if not search and not abs(value - before) <= _ASTRAY * abs(before):
            value = before
            break  # steps without a search went astray
        roots.move(moved)
        if conic.update(y) <= _MET and abs(before - value) <= _SETTLED * abs(value):
            break
        if abs(before - value) <= _RESOLVED * abs(value):
            search = None  # values of the loss no longer tell steps apart, but gradients do
        before = value
    if settings.finish:
        _restore(conic, roots, P, _RESTORED * abs(value))
    scaled, terms = roots.scaled(still)
    phi = np.where(problem.free, scaled.numpy() * problem.scale, problem.nominal)
    return Minimizer(phi, None if problem.terms is None else terms.numpy() * problem.terms.size)


def _restore(conic: ConicLoss, roots: _Roots, P: Tensor, most: float) -> None:
    """End what is left of violations by the least move in preconditioned coordinates, if its square is at `most`."""
    still = torch.zeros(len(P), dtype=P.dtype)
    for _ in range(_RESTORATIONS):
        y, slopes = roots.deviations(still), torch.autograd.functional.jacobian(roots.deviations, still, vectorize=True)
        below = conic.G @ y < conic.h
        rows, bounds = torch.cat([conic.E, conic.G[below]]), torch.cat([conic.e, conic.h[below]])
        if not len(rows):
            return
        off = (bounds - rows @ y)[:, None]
        move = torch.linalg.lstsq(rows @ slopes @ P, off, rcond=_FLAT, driver="gelsd").solution[:, 0]
        if float(move.square().sum()) > most:
            return
        roots.move(P @ move)


def _loss(settings: Sgd, roots: _Roots, conic: ConicLoss, u: Tensor) -> Tensor:
    """Objective, conditions and penalties, `u` away from where the roots are."""
    y = roots.deviations(u)
    value = conic.objective(y) + conic.penalty(y)
    if settings.consistency == "penalties":
        by_body = roots.scaled(u)[0].unflatten(0, (-1, PER_BODY))
        terms = penalties(by_body, roots.bodies, settings.conditions.margin, settings.penalties)
        value = value + torch.stack([value * 0.0, *terms.values()]).sum()
    return value


def excess(settings: Sgd, problem: LinearProblem, found: Minimizer) -> float:
    """How far the objective of a minimizer is above the least one at most, as a share of that or of what counts as 0.

    Where bodies are possible the least one is that of the interior-point method. With penalties, which only add to the
    quadratic, it is at least what this promises along the gradient.
    """
    problem_of_cones, conic = settings.conic_problem(problem), settings.conic_loss(problem)
    if settings.consistency == "log_cholesky":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # of its gap, which counts below
            best = solve_barrier(problem_of_cones)
        roots = _Roots(replace(settings, consistency="penalties"), problem, found)
        value = float(conic.objective(roots.deviations(torch.zeros(sum(roots.sizes), dtype=torch.float64))))
        least = best.objective - (best.gap if np.isfinite(best.gap) else 0.0)
    else:
        roots = _Roots(settings, problem, found)
        u = torch.zeros(sum(roots.sizes), dtype=torch.float64, requires_grad=True)
        loss = _loss(settings, roots, conic, u)
        (gradient,) = torch.autograd.grad(loss, u)
        hessian = 2.0 * conic.root.T @ conic.root
        value = loss.item()
        least = value - 0.5 * float(gradient @ torch.linalg.pinv(hessian, hermitian=True) @ gradient)
    return (value - least) / max(least, problem_of_cones.floor)
