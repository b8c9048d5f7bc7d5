"""Inertial and friction parameters of floating-base robots from logs with partial force sensing.

Building blocks are here; whole runs, from files to folders, are in `torchid.run`, experiment files in `torchid.config`.
"""

import importlib
from typing import TYPE_CHECKING

__version__ = "0.1.0"

if TYPE_CHECKING:
    from torchid.analysis.base_parameters import BaseParameters, base_parameters
    from torchid.analysis.calibration import estimate_extras
    from torchid.analysis.structure import structural_problem
    from torchid.errors import TorchidError, TorchidWarning
    from torchid.estimators import (
        Conditions,
        Consistent,
        Estimate,
        LeastSquares,
        LogCholeskyParameters,
        Sgd,
        Trainer,
        project,
        violations,
    )
    from torchid.hygiene import Checked, without_condemned
    from torchid.hygiene.check import check
    from torchid.logs import Log, Topics, read_log, write_log
    from torchid.logs.preprocess import preprocess
    from torchid.problem import (
        ExtraTerms,
        LinearProblem,
        MiniBatches,
        RowBuilder,
        TriangularFactor,
        assemble,
        bind,
        compress,
        compress_parts,
        linear_problem,
    )
    from torchid.regressor import FrameJacobian, Motion, Regressor, motion_from_state
    from torchid.robot import Robot, load_robot
    from torchid.sensing import (
        Contact,
        Projection,
        SensorNoise,
        SensorSet,
        chosen_sensors,
        named_sensors,
        with_ft_sensors,
    )

_HOMES = {
    "torchid.analysis.base_parameters": ("BaseParameters", "base_parameters"),
    "torchid.analysis.calibration": ("estimate_extras",),
    "torchid.analysis.structure": ("structural_problem",),
    "torchid.errors": ("TorchidError", "TorchidWarning"),
    "torchid.estimators": (
        "Conditions",
        "Consistent",
        "Estimate",
        "LeastSquares",
        "LogCholeskyParameters",
        "Sgd",
        "Trainer",
        "project",
        "violations",
    ),
    "torchid.hygiene": ("Checked", "without_condemned"),
    "torchid.hygiene.check": ("check",),
    "torchid.logs": ("Log", "Topics", "read_log", "write_log"),
    "torchid.logs.preprocess": ("preprocess",),
    "torchid.problem": (
        "ExtraTerms",
        "LinearProblem",
        "MiniBatches",
        "RowBuilder",
        "TriangularFactor",
        "assemble",
        "bind",
        "compress",
        "compress_parts",
        "linear_problem",
    ),
    "torchid.regressor": ("FrameJacobian", "Motion", "Regressor", "motion_from_state"),
    "torchid.robot": ("Robot", "load_robot"),
    "torchid.sensing": (
        "Contact",
        "Projection",
        "SensorNoise",
        "SensorSet",
        "chosen_sensors",
        "named_sensors",
        "with_ft_sensors",
    ),
}
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "BaseParameters",
    "Checked",
    "Conditions",
    "Consistent",
    "Contact",
    "Estimate",
    "ExtraTerms",
    "FrameJacobian",
    "LeastSquares",
    "LinearProblem",
    "Log",
    "LogCholeskyParameters",
    "MiniBatches",
    "Motion",
    "Projection",
    "Regressor",
    "Robot",
    "RowBuilder",
    "SensorNoise",
    "SensorSet",
    "Sgd",
    "Topics",
    "TorchidError",
    "TorchidWarning",
    "Trainer",
    "TriangularFactor",
    "assemble",
    "base_parameters",
    "bind",
    "check",
    "chosen_sensors",
    "compress",
    "compress_parts",
    "estimate_extras",
    "linear_problem",
    "load_robot",
    "motion_from_state",
    "named_sensors",
    "preprocess",
    "project",
    "read_log",
    "structural_problem",
    "violations",
    "with_ft_sensors",
    "without_condemned",
    "write_log",
]


def __getattr__(name: str) -> object:
    """Import on first use: torch and the kinematics take seconds, which `torchid --help` should not."""
    if name not in _HOME_OF:
        raise AttributeError(f"module 'torchid' has no attribute '{name}'")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
