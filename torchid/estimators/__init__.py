"""Estimators: from a linear problem to parameters."""

from torchid.estimators.conditions import Conditions, Enclosure, Mirror, Violation, violations
from torchid.estimators.consistent import Consistent, ConsistentEstimate, project
from torchid.estimators.least_squares import LeastSquares
from torchid.estimators.result import Estimate

__all__ = [
    "Conditions",
    "Consistent",
    "ConsistentEstimate",
    "Enclosure",
    "Estimate",
    "LeastSquares",
    "Mirror",
    "Violation",
    "project",
    "violations",
]
