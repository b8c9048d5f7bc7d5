from .api import (
    analyze,
    check,
    evaluate,
    identify,
)
from .commands.analyze import (
    Analysis,
)
from .commands.check import (
    CheckedLogs,
)
from .commands.evaluate import (
    EvaluatedRun,
)
from .commands.results import (
    BodyEstimate,
    ParameterTable,
)
from .commands.run_folder import (
    Identification,
)
from .distributed import (
    share_work,
)
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
from .fitting.factor_files import (
    FactorFile,
    RowModel,
    read_factors,
    require_same_noise,
    require_same_rows,
    write_factors,
)
from .fitting.fit import (
    Calibration,
    LogFitter,
    calibrations,
    frozen_parameters,
)
from .fitting.left_out import (
    RIDGES,
    choose_ridge,
    cross_validate,
)
from .fitting.noise import (
    estimate_noise,
)
from .fitting.posterior import (
    FittedPosterior,
    JointNetworks,
    ParameterSamples,
    PosteriorSampler,
    RigidPlusResidual,
)
from .fitting.robust import (
    RobustLoss,
    fit_robustly,
)
from .identifiability.base_parameters import (
    BaseParameters,
    base_parameters,
    structural_problem,
)
from .identifiability.confounding import (
    estimate_extras,
)
from .log_checks import (
    Checked,
)
from .logs import (
    Columns,
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
    bind_log,
    compress,
    compress_parts,
    linear_problem,
)
from .problem.compression import (
    CompressedLog,
    compress_in_blocks,
    compress_log,
    fold_compressed,
    merge,
    split_into_folds,
)
from .regressor import (
    FrameJacobian,
    InverseDynamics,
    LoopJacobian,
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
    "Analysis",
    "BodyEstimate",
    "CheckedLogs",
    "EvaluatedRun",
    "Identification",
    "ParameterTable",
    "RIDGES",
    "BaseParameters",
    "Calibration",
    "Checked",
    "Columns",
    "CompressedLog",
    "Conditions",
    "Consistent",
    "Contact",
    "Estimate",
    "ExtraTerms",
    "FactorFile",
    "FittedPosterior",
    "FrameJacobian",
    "InverseDynamics",
    "JointNetworks",
    "LeastSquares",
    "LinearProblem",
    "Log",
    "LogCholeskyParameters",
    "LogFitter",
    "LoopJacobian",
    "MiniBatches",
    "Motion",
    "ParameterSamples",
    "PosteriorSampler",
    "Projection",
    "Regressor",
    "RigidPlusResidual",
    "Robot",
    "RobustLoss",
    "RowBuilder",
    "RowModel",
    "SensorNoise",
    "SensorSet",
    "Sgd",
    "Topics",
    "TorchidError",
    "TorchidWarning",
    "Trainer",
    "TriangularFactor",
    "analyze",
    "assemble",
    "base_parameters",
    "bind_log",
    "calibrations",
    "check",
    "choose_ridge",
    "chosen_sensors",
    "compress",
    "compress_in_blocks",
    "compress_log",
    "compress_parts",
    "cross_validate",
    "estimate_extras",
    "estimate_noise",
    "evaluate",
    "fit_robustly",
    "fold_compressed",
    "frozen_parameters",
    "identify",
    "split_into_folds",
    "linear_problem",
    "load_robot",
    "merge",
    "motion_from_state",
    "named_sensors",
    "preprocess",
    "nearest_consistent",
    "read_factors",
    "read_log",
    "require_same_noise",
    "require_same_rows",
    "share_work",
    "structural_problem",
    "violations",
    "with_ft_sensors",
    "write_factors",
    "write_log",
]
