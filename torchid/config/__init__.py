"""Settings files: typed dataclasses, YAML, and overrides from the command line."""

from torchid.config.experiment import (
    AnalyzeConfig,
    ExperimentConfig,
    inputs_of,
    load_analysis,
    load_config,
)
from torchid.config.settings_files import dump_config
from torchid.config.simulation import (
    BoundsConfig,
    FootConfig,
    MotionConfig,
    NominalConfig,
    SensorImperfectionsConfig,
    SimulationConfig,
    StepsConfig,
    load_simulation,
)

__all__ = [
    "AnalyzeConfig",
    "BoundsConfig",
    "ExperimentConfig",
    "FootConfig",
    "MotionConfig",
    "NominalConfig",
    "SensorImperfectionsConfig",
    "SimulationConfig",
    "StepsConfig",
    "dump_config",
    "inputs_of",
    "load_analysis",
    "load_config",
    "load_simulation",
]
