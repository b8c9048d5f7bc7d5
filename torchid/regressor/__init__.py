"""Batched kinematics and the regressor K(q, v, a)."""

from torchid.regressor.kinematics import Motion, motion_from_state
from torchid.regressor.loops import LoopJacobian
from torchid.regressor.regressor import FrameJacobian, InverseDynamics, Regressor

__all__ = ["FrameJacobian", "InverseDynamics", "LoopJacobian", "Motion", "Regressor", "motion_from_state"]
