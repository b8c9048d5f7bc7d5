"""What pulls a descent towards bodies that can exist, each term by name."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from torchid import parameters


@dataclass(frozen=True)
class PenaltyWeights:
    """Weights of the penalties beside the mean squared whitened residual.

    Attributes:
        eigenvalue: squares of what the eigenvalues of scaled pseudo-inertias lack to the margin.
        log_det: minus the logarithms of these eigenvalues above the margin, a barrier.
        mass: squares of negative masses, in units of their scale.
        friction: squares of negative friction, in units of its scale.
    """

    eigenvalue: float = 10.0
    log_det: float = 0.0
    mass: float = 10.0
    friction: float = 10.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for item in fields(self):
            value = getattr(self, item.name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"penalties.{item.name}: found {value}; accepted: a finite number of at least 0")

    @property
    def curvature(self) -> float:
        """Bound of the squares' second derivatives, in units of the scale; what is off the diagonal is there twice."""
        return 2.0 * (2.0 * self.eigenvalue + self.mass + self.friction)


def pseudo_inertias(scaled: Tensor) -> Tensor:
    """Pseudo-inertias (L, 4, 4) of parameters (L, 12), differentiable (`parameters.pseudo_inertia` is not)."""
    return torch.tensordot(scaled[:, parameters.INERTIAL], torch.from_numpy(parameters.PSEUDO_BASIS).to(scaled), dims=1)


def penalties(scaled: Tensor, bodies: Tensor, margin: float, weights: PenaltyWeights) -> dict[str, Tensor]:
    """Weighted penalties by name; those of weight 0 are left out.

    Args:
        scaled: (L, 12), parameters in units of their scale.
        bodies: (L',) int, bodies whose inertia is asked to be possible; friction is asked to be of all.
        margin: least eigenvalue asked for.
        weights: of the terms.
    """
    out: dict[str, Tensor] = {}
    if weights.eigenvalue or weights.log_det:
        eigenvalues = torch.linalg.eigvalsh(pseudo_inertias(scaled[bodies]))
        if weights.eigenvalue:
            out["eigenvalue"] = weights.eigenvalue * (margin - eigenvalues).clamp_min(0.0).square().sum()
        if weights.log_det:
            out["log_det"] = -weights.log_det * _extended_log(eigenvalues - margin).sum()
    if weights.mass:
        out["mass"] = weights.mass * scaled[bodies, parameters.MASS].clamp_max(0.0).square().sum()
    if weights.friction:
        out["friction"] = weights.friction * scaled[:, parameters.FRICTION].clamp_max(0.0).square().sum()
    return out


def _extended_log(x: Tensor, least: float = 1e-4) -> Tensor:
    """The logarithm, and below `least` its tangent: a descent that starts outside still finds its way in."""
    inside = x.clamp_min(least)
    return inside.log() + (x - inside) / least
