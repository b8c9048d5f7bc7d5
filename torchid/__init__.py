"""Inertial and friction parameters of floating-base robots from logs with partial force sensing.

Building blocks are here; whole runs, from files to folders, are in `torchid.run`, experiment files in `torchid.config`.
"""

from torchid.errors import TorchidError, TorchidWarning
from torchid.estimators import Estimate, LeastSquares
from torchid.logs import Log, preprocess, read_log, write_log
from torchid.problem import LinearProblem, RowBuilder, TriangularFactor, bind, compress, linear_problem
from torchid.regressor import FrameJacobian, Motion, Regressor, motion_from_state
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact, Projection, SensorNoise, SensorSet, chosen_sensors, named_sensors

__all__ = [
    "Contact",
    "Estimate",
    "FrameJacobian",
    "LeastSquares",
    "LinearProblem",
    "Log",
    "Motion",
    "Projection",
    "Regressor",
    "Robot",
    "RowBuilder",
    "SensorNoise",
    "SensorSet",
    "TorchidError",
    "TorchidWarning",
    "TriangularFactor",
    "bind",
    "chosen_sensors",
    "compress",
    "linear_problem",
    "load_robot",
    "motion_from_state",
    "named_sensors",
    "preprocess",
    "read_log",
    "write_log",
]
