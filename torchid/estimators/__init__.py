"""Estimators: from a linear problem to parameters."""

from torchid.estimators.conditions import Conditions, Enclosure, Mirror, Violation, violations
from torchid.estimators.consistent import Consistent, ConsistentEstimate, nearest_consistent
from torchid.estimators.least_squares import ConstrainedEstimate, Estimate, LeastSquares
from torchid.estimators.sgd import (
    FreeParameters,
    LearnableParameters,
    LogCholeskyParameters,
    PenaltyWeights,
    Sgd,
    TrainingSettings,
)
from torchid.estimators.training import Epoch, ResidualEffect, SgdEstimate, Trainer

__all__ = [
    "Conditions",
    "Consistent",
    "ConsistentEstimate",
    "ConstrainedEstimate",
    "Enclosure",
    "Epoch",
    "Estimate",
    "FreeParameters",
    "LearnableParameters",
    "LeastSquares",
    "LogCholeskyParameters",
    "Mirror",
    "PenaltyWeights",
    "ResidualEffect",
    "Sgd",
    "SgdEstimate",
    "Trainer",
    "TrainingSettings",
    "Violation",
    "nearest_consistent",
    "violations",
]
