from .errors import (
    TorchidError,
    TorchidWarning,
)
from .estimators import (
    Conditions,
    Consistent,
    Estimate,
    LeastSquares,
    LogCholeskyParameters,
    Sgd,
    Trainer,
    nearest_consistent,
    violations,
)
from .identifiability.base_parameters import (
    BaseParameters,
    base_parameters,
)
from .identifiability.confounding import (
    estimate_extras,
)
from .identifiability.structure import (
    structural_problem,
)
from .log_checks import (
    Checked,
    without_condemned,
)
from .log_checks.check import (
    check,
)
from .logs import (
    Log,
    Topics,
    read_log,
    write_log,
)
from .logs.preprocess import (
    preprocess,
)
from .problem import (
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
from .regressor import (
    FrameJacobian,
    Motion,
    Regressor,
    motion_from_state,
)
from .robot import (
    Robot,
    load_robot,
)
from .sensing import (
    Contact,
    Projection,
    SensorNoise,
    SensorSet,
    chosen_sensors,
    named_sensors,
    with_ft_sensors,
)

__version__: str

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
    "nearest_consistent",
    "read_log",
    "structural_problem",
    "violations",
    "with_ft_sensors",
    "without_condemned",
    "write_log",
]
