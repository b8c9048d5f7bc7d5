"""The conic problem as a differentiable loss: its objective, and its conditions as an augmented Lagrangian."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from torchid.estimators.conic_problem import ConicProblem
from torchid.parameters import Array


class ConicLoss(nn.Module):
    """Objective and augmented Lagrangian of a conic problem in y, the deviations in units of their scale, (n,).

    Their weights are `stiffness` over what the objective yields along them: an update leaves 1 / (1 + 2 stiffness) of
    a violation, at most. They add weight * (||(multiplier - slack)_+||^2 - ||multiplier||^2), equalities without the
    positive part; with the multipliers of `update` the minimizer of the sum meets them exactly.

    Source: Bertsekas, "Constrained Optimization and Lagrange Multiplier Methods", 1982, chapters 2 and 5.
    """

    root: Tensor
    target: Tensor
    linear: Tensor
    G: Tensor
    h: Tensor
    row_weight: Tensor
    E: Tensor
    e: Tensor
    F0: Tensor
    F: Tensor
    variables: Tensor
    block_weight: Tensor
    log_det_weight: Tensor
    weighted_start: Tensor
    weighted_slopes: Tensor
    log_det_variables: Tensor
    of_rows: Tensor
    of_equalities: Tensor
    of_blocks: Tensor

    def __init__(self, conic: ConicProblem, enforced: int, hessian: Array, stiffness: float) -> None:
        """Start without multipliers.

        Args:
            conic: the problem.
            enforced: how many of its first blocks are met anyway.
            hessian: (n, n) in x, of the whole objective's quadratic, by which conditions are weighed.
            stiffness: of the conditions.
        """
        super().__init__()
        inverse = np.linalg.inv(conic.deviations)
        own = [inverse[np.ix_(at, at)] for at in conic.variables]
        F = np.array([np.einsum("vw,vij->wij", one, x) for one, x in zip(own, conic.F, strict=True)])
        F = F.reshape(conic.F.shape)
        soft = (conic.weights == 0.0) & (np.arange(len(conic.F0)) >= enforced)
        hessian, kept = inverse.T @ hessian @ inverse, conic.weights > 0.0
        for weight, at, slopes in zip(
            conic.weights[kept], conic.variables[kept], F[kept].reshape(-1, 10, 16), strict=True
        ):
            hessian[np.ix_(at, at)] += weight * slopes @ slopes.T  # at y = 0, where relative blocks are 1
        values, vectors = np.linalg.eigh(hessian)
        root = vectors / np.sqrt(np.maximum(values, 1e-12 * values.max(initial=0.0)) + np.finfo(float).tiny)
        G, E = conic.G @ inverse, conic.E @ inverse
        whitening = np.linalg.inv(np.linalg.cholesky((E @ root) @ (E @ root).T)) if len(E) else np.zeros((0, 0))
        compliance = np.einsum("kwij,kwn->kijn", F[soft], root[conic.variables[soft]])
        self.constant, self.stiffness = conic.constant, stiffness
        arrays = {
            "root": conic.root @ inverse,
            "target": conic.target,
            "linear": inverse.T @ conic.linear,
            "G": G,
            "h": conic.h,
            "row_weight": stiffness / np.square(G @ root).sum(1),
            "E": whitening @ E,
            "e": whitening @ conic.e,
            "F0": conic.F0[soft],
            "F": F[soft],
            "variables": conic.variables[soft],
            "block_weight": 10.0 * stiffness / np.square(compliance).sum((1, 2, 3)),
            "log_det_weight": conic.weights[kept],
            "weighted_start": conic.F0[kept],
            "weighted_slopes": F[kept],
            "log_det_variables": conic.variables[kept],
            "of_rows": np.zeros(len(G)),
            "of_equalities": np.zeros(len(E)),
            "of_blocks": np.zeros_like(conic.F0[soft]),
        }
        for name, array in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(array)), persistent=name.startswith("of_"))

    def objective(self, y: Tensor) -> Tensor:
        """The objective at y."""
        value = (self.root @ y - self.target).square().sum() + self.linear @ y + self.constant
        if not len(self.weighted_start):
            return value
        blocks = _blocks(self.weighted_start, self.weighted_slopes, self.log_det_variables, y)
        return value - self.log_det_weight @ torch.linalg.eigvalsh(blocks).clamp_min(1e-300).log().sum(1)

    def penalty(self, y: Tensor) -> Tensor:
        """What the conditions add to the objective."""
        rows = (self.of_rows - self.G @ y + self.h).clamp_min(0.0).square() - self.of_rows.square()
        equalities = (self.of_equalities - self.E @ y + self.e).square() - self.of_equalities.square()
        value = self.row_weight @ rows + self.stiffness * equalities.sum()
        if not len(self.F0):
            return value
        violated = torch.linalg.eigvalsh(self.of_blocks - self._soft_blocks(y)).clamp_min(0.0)
        return value + self.block_weight @ (violated.square().sum(1) - self.of_blocks.square().sum((1, 2)))

    @torch.no_grad()
    def update(self, y: Tensor) -> float:
        """Move the multipliers to those of a minimizer y; returns by how much y violates a condition at most."""
        slack, off = self.G @ y - self.h, self.E @ y - self.e
        values, vectors = torch.linalg.eigh(self.of_blocks - self._soft_blocks(y))
        worst = torch.cat([-slack, off.abs(), -torch.linalg.eigvalsh(self._soft_blocks(y)).flatten()])
        self.of_rows.sub_(slack).clamp_min_(0.0)
        self.of_equalities.sub_(off)
        self.of_blocks.copy_((vectors * values.clamp_min(0.0)[:, None]) @ vectors.mT)
        return float(worst.max().clamp_min(0.0)) if len(worst) else 0.0

    @torch.no_grad()
    def curvature(self, y: Tensor) -> Tensor:
        """Second derivative of the quadratic and of rows at y, (n, n)."""
        active = torch.where(self.of_rows > self.G @ y - self.h, self.row_weight, 0.0)
        return 2.0 * (
            self.root.T @ self.root + self.G.T @ (active[:, None] * self.G) + self.stiffness * self.E.T @ self.E
        )

    def _soft_blocks(self, y: Tensor) -> Tensor:
        return _blocks(self.F0, self.F, self.variables, y)


def _blocks(F0: Tensor, F: Tensor, variables: Tensor, y: Tensor) -> Tensor:
    return F0 + (y[variables][..., None, None] * F).sum(1)
