"""Batched kinematics and the regressor K(q, v, a)."""

from torchid.regressor.motion import Motion, motion_from_state
from torchid.regressor.regressor import Regressor

__all__ = ["Motion", "Regressor", "motion_from_state"]
