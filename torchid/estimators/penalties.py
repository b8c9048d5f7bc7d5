"""Penalties of a descent that may leave what is physically consistent: of eigenvalues, masses and friction."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchid import parameters
from torchid.settings import NotNegative, validate_settings

LEAST_LOGARITHM = 1e-4
"""Eigenvalue above the margin below which the barrier goes on as the tangent of its logarithm."""


@dataclass(frozen=True)
class PenaltyWeights:
    """Weights of the penalties beside the mean squared whitened residual.

    Attributes:
        eigenvalue: squares of the shortfall of scaled pseudo-inertias' eigenvalues from the margin.
        log_det: minus the logarithms of these eigenvalues less the margin, a barrier.
        mass: squares of negative masses, in units of their scale.
        friction: squares of negative friction, in units of its scale.
    """

    eigenvalue: NotNegative = 10.0
    log_det: NotNegative = 0.0
    mass: NotNegative = 10.0
    friction: NotNegative = 10.0

    def __post_init__(self) -> None:
        validate_settings(self)

    @property
    def curvature(self) -> float:
        """Bound of the second derivatives, in units of the scale; off-diagonal entries of a matrix count twice."""
        return 2.0 * (2.0 * self.eigenvalue + self.mass + self.friction)


def penalties(scaled: Tensor, bodies: Tensor, margin: float, weights: PenaltyWeights) -> dict[str, Tensor]:
    """Weighted penalties by name; those of weight 0 are left out.

    Args:
        scaled: (L, 12), parameters in units of their scale.
        bodies: (L',) int, bodies whose inertia is penalized; friction is penalized for all.
        margin: least eigenvalue without a penalty.
        weights: of the terms.
    """
    out: dict[str, Tensor] = {}
    if weights.eigenvalue or weights.log_det:
        basis = torch.from_numpy(parameters.PSEUDO_BASIS).to(scaled)
        eigenvalues = torch.linalg.eigvalsh(torch.tensordot(scaled[bodies][:, parameters.INERTIAL], basis, dims=1))
        if weights.eigenvalue:
            out["eigenvalue"] = weights.eigenvalue * (margin - eigenvalues).clamp_min(0.0).square().sum()
        if weights.log_det:
            above = eigenvalues - margin
            inside = above.clamp_min(LEAST_LOGARITHM)
            out["log_det"] = -weights.log_det * (inside.log() + (above - inside) / LEAST_LOGARITHM).sum()
    if weights.mass:
        out["mass"] = weights.mass * scaled[bodies, parameters.MASS].clamp_max(0.0).square().sum()
    if weights.friction:
        out["friction"] = weights.friction * scaled[:, parameters.FRICTION].clamp_max(0.0).square().sum()
    return out
