"""The experiment file of `torchid identify` and `torchid analyze`, and the part of it that reading a bag needs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field
from pydantic.dataclasses import dataclass

from torchid.config.estimator import ROBUST_ACCEPTED, EstimatorConfig, validate_keys
from torchid.config.logs import SETS, LogsConfig, entries_spelled_out, resolve_logs
from torchid.config.reading import FileKind, Settings, dump, load
from torchid.config.sensors import (
    CHOICE_ACCEPTED,
    COMPONENTS_ACCEPTED,
    SCOPES_ACCEPTED,
    STRICT,
    WRENCHES_ACCEPTED,
    Choice,
    ContactConfig,
    Device,
    FileName,
    Sensors,
    SensorsConfig,
    spelled_out,
    validate_choice,
)
from torchid.errors import ConfigError, about_file
from torchid.logs import Columns, Topics
from torchid.logs.column_map import check_columns
from torchid.logs.containers import FACTORS
from torchid.logs.ros_topics import check_topics
from torchid.problem.contact_detection import DetectionConfig
from torchid.settings import NotNegative, Positive, Seed

COLUMNS_ACCEPTED = {f"logs.columns.{key}": "a list of names" for key in ("*_order", "ignore")} | {
    "logs.columns.*": "the name of a column, a pattern such as {joint}_q, or a mapping with column, unit, scale, ..."
}
"""Accepted for entries of a map of columns, in messages."""

JOINTS_ACCEPTED = "the name of a topic, or a mapping with topic and joints"
"""Accepted for the one topic that every bag needs, in messages."""

Name = Annotated[str, Field(min_length=1)]
Scenarios = dict[FileName, Annotated[list[list[str]], Field(min_length=1)]]


@dataclass(config=STRICT, frozen=True)
class CandidatesConfig:
    """Sensors that could be mounted: torques of `joint_torques` (None: all), and at the contacts devices or axes.

    `ft_sensors`: fixed joints that could carry a force/torque sensor, a device unless `contacts` are axes.
    `normal_forces`: contacts that could carry a scalar sensor, `fn`, beside a device or alone.
    """

    joint_torques: list[str] | None = None
    contacts: Literal["device", "axis", "none"] = "device"
    ft_sensors: list[str] = dataclasses.field(default_factory=list)
    normal_forces: list[str] = dataclasses.field(default_factory=list)


@dataclass(config=STRICT, frozen=True)
class AnalysisConfig:
    """Which sensors to plan for, and which sensor sets to compare.

    `scenarios`: contact states by scenario, each a list of the frames in contact; None: the states of the training
    logs, or, without logs, all contacts at once. `keep`: candidates that every plan has, `exclude`: that none has;
    `costs` per channel, by candidate or by kind (joint_torque, contact, normal_force, ft_sensor). `criterion`:
    per_sample, the base survives the projection of every sample (None, for a floating base); stack, many samples
    together determine all that full sensing would (None, for a fixed one). `compare`: sensor sets whose accuracy is
    predicted from the training logs and measured on the test logs; `prior_error`: standard deviation of the URDF's
    parameters, as a share of the size of each body.
    """

    scenarios: Annotated[Scenarios, Field(min_length=1)] | None = None
    candidates: CandidatesConfig = dataclasses.field(default_factory=CandidatesConfig)
    keep: list[str] = dataclasses.field(default_factory=list)
    exclude: list[str] = dataclasses.field(default_factory=list)
    costs: dict[str, Positive] = dataclasses.field(default_factory=dict)
    criterion: Literal["per_sample", "stack"] | None = None
    compare: dict[Name, Choice] = dataclasses.field(default_factory=dict)
    prior_error: Annotated[Positive, Field(le=100.0)] = 0.2
    seed: Seed = 0


@dataclass(config=STRICT, frozen=True)
class RobotConfig:
    """The robot; `base_link` defaults to the URDF's root."""

    urdf: Path
    base_link: str | None = None
    fixed_base: bool = False


@dataclass(config=STRICT, frozen=True)
class ActuatorsConfig:
    """Unknown terms of the actuators, of every joint whose torque is measured.

    `armature`: reflected rotor inertia; `torque_offset`; `asymmetric_coulomb`: Coulomb friction that differs by
    direction; `sign_width` [rad/s or m/s]: Coulomb friction goes with tanh(velocity / width) instead of the sign.
    """

    armature: bool = False
    torque_offset: bool = False
    asymmetric_coulomb: bool = False
    sign_width: Positive | None = None


def _switch(value: object) -> object:
    """All settings at their defaults for true, none for false."""
    return ({} if value else None) if isinstance(value, bool) else value


@dataclass(config=STRICT, frozen=True)
class PreprocessingConfig:
    """Zero-phase low-pass [Hz] and resampling [Hz]; None leaves the signals as they are.

    `contact_margin_s`: samples that are dropped before and after each change of contact [s], None for none.
    `detect_contacts`: true, or its settings, for contact flags from joint torques (`DetectionConfig`) in the place of
    recorded ones.
    `base_motion`: contacts, from the feet that stand on a floor, whatever was recorded of it; None for as recorded.
    `exclude_condemned`: leave out the samples that `torchid check` condemns.
    `memory_gb`: a log whose arrays take more [GB] is read block by block, and its samples are kept on the disk.
    `cache_gb`: room [GB] for samples and factors that later runs of `identify` find beside the output; 0 for none.
    """

    cutoff_hz: Positive | None = None
    sample_rate_hz: Positive | None = None
    contact_margin_s: NotNegative | None = None
    detect_contacts: Annotated[DetectionConfig | None, BeforeValidator(_switch)] = None
    base_motion: Literal["contacts"] | None = None
    exclude_condemned: bool = False
    memory_gb: Positive = 2.0
    cache_gb: NotNegative = 2.0

    @property
    def margin_s(self) -> float | None:
        """Samples that are dropped before and after each change of contact [s], None for none."""
        margins = [self.contact_margin_s, None if self.detect_contacts is None else self.detect_contacts.margin_s]
        return max((margin for margin in margins if margin is not None), default=None)

    @property
    def derived(self) -> tuple[str, ...]:
        """How names of fields of a log begin that are worked out of others, whatever was recorded."""
        flags = () if self.detect_contacts is None else ("contact_active",)
        return flags if self.base_motion is None else (*flags, "base_")


@dataclass(config=STRICT, frozen=True, kw_only=True)
class _Common:
    """The keys of identification and analysis alike."""

    robot: RobotConfig
    sensors: Sensors = dataclasses.field(default_factory=SensorsConfig)
    output: Path
    contacts: list[ContactConfig] = dataclasses.field(default_factory=list)
    preprocessing: PreprocessingConfig = dataclasses.field(default_factory=PreprocessingConfig)
    actuators: ActuatorsConfig = dataclasses.field(default_factory=ActuatorsConfig)
    estimator: EstimatorConfig = dataclasses.field(default_factory=EstimatorConfig)
    analysis: AnalysisConfig = dataclasses.field(default_factory=AnalysisConfig)
    device: Device = "cpu"
    overwrite: bool = False


@dataclass(config=STRICT, frozen=True, kw_only=True)
class ExperimentConfig(_Common):
    """One identification run."""

    logs: LogsConfig
    sensors: Sensors


@dataclass(config=STRICT, frozen=True, kw_only=True)
class AnalyzeConfig(_Common):
    """The same file for an analysis, which needs neither logs nor sensors; `sensors` may be `noise` alone."""

    logs: LogsConfig | None = None


def _spelled_out(settings: Settings, overriding: Settings) -> Settings:
    """Parts of logs by name, and sensors as a mapping.

    An override of one key of sensors joins the others; a named set replaces sensors by name.
    """
    settings = entries_spelled_out(settings)
    if "sensors" not in settings:
        return settings
    sensors = settings["sensors"]
    if isinstance(overriding.get("sensors"), str) and isinstance(sensors, dict):
        sensors = {key: x for key, x in sensors.items() if key in ("noise", "offsets", "scales", "on_base_lost")}
    return settings | {"sensors": spelled_out(sensors)}


_EXPERIMENT = FileKind(
    settings=ExperimentConfig,
    name="experiment",
    keys="robot, logs, sensors, output",
    list_example="contacts=[{frame: l_sole, type: flat}]",
    paths=("robot.urdf", *(f"logs.{name}.*{of}" for name in SETS for of in ("", ".file"))),
    urls=("logs.train.*",),
    outputs=("output",),
    prepare=_spelled_out,
    accepted={
        "contacts": "a list of mappings: [{frame: l_sole, type: flat}]",
        "contacts.*.frame": "the name of a frame in the URDF",
        "sensors": CHOICE_ACCEPTED,
        **{f"{where}.contact_wrenches": WRENCHES_ACCEPTED for where in ("sensors", "analysis.compare.*")},
        **{f"{where}.contact_wrenches.*": COMPONENTS_ACCEPTED for where in ("sensors", "analysis.compare.*")},
        "sensors.offsets": SCOPES_ACCEPTED,
        "sensors.scales": SCOPES_ACCEPTED,
        "analysis.compare.*": CHOICE_ACCEPTED,
        "estimator.robust": ROBUST_ACCEPTED,
        "logs.topics.joint_states": JOINTS_ACCEPTED,
        **COLUMNS_ACCEPTED,
    },
)
_ANALYSIS = FileKind(**(vars(_EXPERIMENT) | {"settings": AnalyzeConfig, "keys": "robot, contacts, output"}))


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> ExperimentConfig:
    """Read and check an experiment file.

    Args:
        path: the YAML file; paths in it are relative to it, but `output` to the working directory.
        overrides: `key.subkey=value`, the value in YAML; paths in them are relative to the working directory.

    Raises:
        ConfigError: unreadable file, a value of the wrong kind, a missing key.
        UnknownNameError: a key that does not exist; the message names the nearest that do.

    Warns:
        TorchidWarning: a log is both fitted and tested on.
    """
    path = Path(path)
    config = load(_EXPERIMENT, path, overrides)
    with about_file(path):
        validate_choice("sensors", config.sensors)
        validate_keys(config.estimator)
        _check_extras(config)
        return dataclasses.replace(config, logs=_checked_logs(config, config.logs))


def load_analysis(path: str | Path, overrides: Sequence[str] = ()) -> AnalyzeConfig:
    """Read an experiment file for `torchid analyze`: as `load_config`, but logs and sensors may be left out."""
    path = Path(path)
    config = load(_ANALYSIS, path, overrides)
    with about_file(path):
        validate_choice("sensors", config.sensors, may_be_empty=True)
        validate_keys(config.estimator)
        _check_extras(config)
        for name, choice in config.analysis.compare.items():
            validate_choice(f"analysis.compare.{name}", choice)
        if config.logs is not None:
            return dataclasses.replace(config, logs=_checked_logs(config, config.logs))
        if config.analysis.compare:
            found = "set, without logs to predict accuracy from"
            raise ConfigError.at_field("analysis.compare", found, "logs.train too")
    return config


def inputs_of(config: ExperimentConfig | AnalyzeConfig) -> list[Path]:
    """URDF and logs; a bag may be a folder."""
    logs = config.logs
    return [config.robot.urdf, *(logs.files if logs else [])]


def dump_config(config: ExperimentConfig | AnalyzeConfig) -> str:
    """The resolved configuration as YAML; `load_config` reads it back."""
    return dump(config)


@dataclass(config=STRICT, frozen=True)
class _TopicsOfLogs:
    topics: Topics


@dataclass(config=STRICT, frozen=True)
class _TopicsFile:
    logs: _TopicsOfLogs


@dataclass(config=STRICT, frozen=True)
class _ColumnsOfLogs:
    columns: Columns


@dataclass(config=STRICT, frozen=True)
class _ColumnsFile:
    logs: _ColumnsOfLogs


def _alone(name: str) -> Callable[[Settings, Settings], Settings]:
    """What leaves one key of `logs` alone of all settings."""

    def prepare(settings: Settings, _: Settings) -> Settings:
        logs = settings.get("logs")
        return {"logs": {key: x for key, x in logs.items() if key == name} if isinstance(logs, dict) else {}}

    return prepare


_TOPICS = FileKind(
    settings=_TopicsFile,
    name="experiment",
    keys="logs.topics",
    list_example="logs.topics.joint_states.joints=[l_knee]",
    prepare=_alone("topics"),
    accepted={"logs.topics.joint_states": JOINTS_ACCEPTED},
)
_COLUMNS = FileKind(
    settings=_ColumnsFile,
    name="experiment",
    keys="logs.columns",
    list_example="logs.columns.joint_order=[l_knee]",
    prepare=_alone("columns"),
    accepted=COLUMNS_ACCEPTED,
)


def load_topics(path: str | Path) -> Topics:
    """Read `logs.topics` from an experiment file, whatever its other keys are.

    Raises:
        ConfigError: unreadable file, no `logs.topics`, a value of the wrong kind.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    topics = load(_TOPICS, Path(path)).logs.topics
    with about_file(path):
        check_topics(topics)
    return topics


def load_columns(path: str | Path) -> Columns:
    """Read `logs.columns` from an experiment file, as `load_topics` does `logs.topics`."""
    columns = load(_COLUMNS, Path(path)).logs.columns
    with about_file(path):
        check_columns(columns)
    return columns


def _check_extras(config: _Common) -> None:
    """Refuse the same extra parameter under two keys, and extra parameters for a descent, which has none."""
    actuators, sensors = config.actuators, config.sensors
    if actuators.torque_offset and "joint_torque" in sensors.offsets:
        found = "set together with sensors.offsets.joint_torque, which is the same"
        raise ConfigError.at_field("actuators.torque_offset", found, "one of the two")
    unknowns = {f"actuators.{name}": x is True for name, x in vars(actuators).items()}
    unknowns |= {f"sensors.{name}": bool(getattr(sensors, name)) for name in ("offsets", "scales")}
    for field, is_set in unknowns.items():
        if is_set and config.estimator.name == "sgd":
            raise ConfigError.at_field(field, "set, which sgd has not", "estimator.name: least_squares or consistent")


def _checked_logs(config: _Common, logs: LogsConfig) -> LogsConfig:
    """The logs with patterns resolved; refuses logs that an estimator has no use for, or with two uses."""
    _check_held_out(config.estimator, logs)
    checked = resolve_logs(logs)
    if logs.topics is not None:
        check_topics(logs.topics)
    if logs.columns is not None:
        check_columns(logs.columns)
    _check_factors(config, checked)
    return checked


def _check_factors(config: _Common, logs: LogsConfig) -> None:
    """Refuse factors of logs beside logs, for tests, and for whatever needs samples."""
    for key in ("test", "validation"):
        for path in getattr(logs, key):
            if path.suffix == FACTORS:
                raise ConfigError.at_field(f"logs.{key}", f"{path}, factors without samples to predict", "logs")
    if not logs.compressed:
        return
    for path in logs.train:
        if path.suffix != FACTORS:
            found = f"{path} beside factors of other logs"
            raise ConfigError.at_field("logs.train", found, f"logs alone, or {FACTORS} files alone")
    reason, logs_too = "but logs.train names factors, which have no samples", ", or the logs"
    if config.estimator.name == "sgd":
        raise ConfigError.at_field("estimator.name", f"sgd, {reason}", f"least_squares or consistent{logs_too}")
    if config.estimator.robust is not None:
        raise ConfigError.at_field("estimator.robust", f"set, {reason}", f"null{logs_too}")
    if config.preprocessing.exclude_condemned:
        accepted = f"false, as torchid compress has left them out if it was told so{logs_too}"
        raise ConfigError.at_field("preprocessing.exclude_condemned", f"true, {reason}", accepted)


def _check_held_out(estimator: EstimatorConfig, logs: LogsConfig) -> None:
    """Refuse held-out logs without a descent, and patience without held-out logs."""
    if logs.validation and estimator.name != "sgd":
        raise ConfigError.at_field(
            "logs.validation", f"set, which {estimator.name} has no use for", "estimator.name: sgd"
        )
    if estimator.training.patience is not None and not logs.validation:
        raise ConfigError.at_field(
            "estimator.training.patience", "set, without logs to hold out", "logs.validation too"
        )
