"""The end of a descent: the least objective on all samples at once, which the compressed problem stands for."""

from __future__ import annotations

import warnings

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from torchid.errors import NumericalWarning
from torchid.estimators.barrier import solve_barrier
from torchid.estimators.conic_loss import ConicLoss
from torchid.estimators.consistent import Consistent
from torchid.estimators.learnable import precondition_by
from torchid.estimators.least_squares import Minimizer
from torchid.estimators.sgd import Sgd, penalties
from torchid.parallel import one_thread
from torchid.parameters import PER_BODY, Array
from torchid.problem import LinearProblem

_STEPS = {"maxiter": 20, "maxcor": 20, "ftol": 0.0, "gtol": 0.0}  # of L-BFGS between preconditioners
_DAMPING = 0.01  # of these, over the objective
_SETTLED, _MET = 1e-12, 1e-10  # relative decrease of the objective in a round, violation of a condition


@one_thread()
def finish(settings: Sgd, problem: LinearProblem, start: Minimizer) -> Minimizer:
    """Minimize the objective of a descent.

    Possible bodies have one minimizer, which the interior-point method computes wherever the descent ended. Descents
    do not reach it: at the border of what is possible, coordinates such as J = R R^T bend faster than they converge,
    so that 800 steps of L-BFGS left a quadruped 0.1 of a parameter's scale away, elsewhere with every rounding.

    Args:
        settings: of the descent; with penalties, `finish` rounds of L-BFGS are taken at most.
        problem: the compressed samples.
        start: where it ended.
    """
    if settings.consistency == "log_cholesky":
        exact = Consistent(settings.ridge, settings.prior, settings.conditions, rank_tolerance=settings.rank_tolerance)
        return exact.minimize(problem)
    conic, y = settings.conic_loss(problem), _deviations(problem, start)
    before = np.inf
    for _ in range(settings.finish or 0):
        damping = _DAMPING * max(float(conic.objective(y)), 1e-12) + settings.penalties.curvature
        P = precondition_by(conic.curvature(y), damping)

        def loss(moved: Array, y: Tensor = y, P: Tensor = P) -> tuple[float, Array]:
            u = torch.from_numpy(moved).requires_grad_()
            value = _penalized(settings, problem, conic, y + P @ u)
            (gradient,) = torch.autograd.grad(value, u)
            return value.item(), gradient.numpy()

        moved = scipy.optimize.minimize(loss, np.zeros(len(y)), jac=True, method="L-BFGS-B", options=_STEPS).x
        y = y + P @ torch.from_numpy(moved)
        value = float(conic.objective(y))
        if conic.update(y) <= _MET and abs(before - value) <= _SETTLED * abs(value):
            break
        before = value
    moves, terms = np.split(y.numpy(), [int(problem.free.sum())])
    phi = problem.nominal.copy()
    phi[problem.free] += problem.scale[problem.free] * moves
    return Minimizer(phi, None if problem.terms is None else terms * problem.terms.size)


def _deviations(problem: LinearProblem, found: Minimizer) -> Tensor:
    """Deviations of the free parameters and terms in units of their scale, (n,)."""
    y = ((found.phi - problem.nominal) / problem.scale)[problem.free]
    if problem.terms is not None:
        y = np.append(y, np.zeros_like(problem.terms.size) if found.psi is None else found.psi / problem.terms.size)
    return torch.from_numpy(y)


def _penalized(settings: Sgd, problem: LinearProblem, conic: ConicLoss, y: Tensor) -> Tensor:
    """Objective, conditions and penalties at deviations (n,)."""
    free, nominal = torch.from_numpy(problem.free), torch.from_numpy(problem.nominal / problem.scale)
    by_body = nominal.masked_scatter(free, nominal[free] + y[: int(free.sum())]).unflatten(0, (-1, PER_BODY))
    bodies = torch.from_numpy(problem.free_bodies())
    value = conic.objective(y) + conic.penalty(y)
    terms = penalties(by_body, bodies, settings.conditions.margin, settings.penalties)
    return value + torch.stack([value * 0.0, *terms.values()]).sum()


def excess(settings: Sgd, problem: LinearProblem, found: Minimizer) -> float:
    """How far the objective of a minimizer is above the least one at most, as a share of that or of what counts as 0.

    Where bodies are possible the least one is that of the interior-point method. With penalties, which only add to the
    quadratic, it is at least what this promises along the gradient.
    """
    problem_of_cones, conic = settings.conic_problem(problem), settings.conic_loss(problem)
    y = _deviations(problem, found)
    if settings.consistency == "log_cholesky":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # of its gap, which counts below
            best = solve_barrier(problem_of_cones)
        value = float(conic.objective(y))
        least = best.objective - (best.gap if np.isfinite(best.gap) else 0.0)
    else:
        y.requires_grad_()
        loss = _penalized(settings, problem, conic, y)
        (gradient,) = torch.autograd.grad(loss, y)
        hessian = 2.0 * conic.root.T @ conic.root
        value = loss.item()
        least = value - 0.5 * float(gradient @ torch.linalg.pinv(hessian, hermitian=True) @ gradient)
    return (value - least) / max(least, problem_of_cones.floor)
