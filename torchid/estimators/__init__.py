"""Estimators: from a linear problem to parameters."""

from torchid.estimators.least_squares import LeastSquares
from torchid.estimators.result import Estimate

__all__ = ["Estimate", "LeastSquares"]
