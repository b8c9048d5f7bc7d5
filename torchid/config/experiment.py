"""The experiment file of `torchid identify` and `torchid analyze`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field
from pydantic.dataclasses import dataclass

from torchid.config.estimator import MASS_ACCEPTED, ROBUST_ACCEPTED, EstimatorConfig, TaskWeightsConfig, validate_keys
from torchid.config.logs import MAPS_ACCEPTED, SETS, LogsConfig, PreprocessingConfig, entries_spelled_out, resolve_logs
from torchid.config.robot import (
    CHOICE_ACCEPTED,
    COMPONENTS_ACCEPTED,
    GROUPS_ACCEPTED,
    LOOPS_ACCEPTED,
    MJCF_SUFFIXES,
    SCOPES_ACCEPTED,
    WELDS_ACCEPTED,
    WRENCHES_ACCEPTED,
    Choice,
    ContactConfig,
    RobotConfig,
    Sensors,
    SensorsConfig,
    require_one_file,
    spelled_out,
    validate_choice,
)
from torchid.config.settings_files import FileKind, Settings, load, plain_sections
from torchid.errors import ConfigError, about_file
from torchid.logs.columns import check_columns
from torchid.logs.containers import FACTORS
from torchid.logs.ros_topics import check_topics
from torchid.settings import (
    AUTO,
    STRICT,
    BoolOrAuto,
    Device,
    FileName,
    Name,
    NumberOrAuto,
    Positive,
    PositiveOrAuto,
    Seed,
)

Scenarios = dict[FileName, Annotated[list[list[str]], Field(min_length=1)]]


@dataclass(config=STRICT, frozen=True)
class CandidatesConfig:
    """Sensors that could be mounted.

    Attributes:
        joint_torques: joints that could carry a torque sensor; null: all joints.
        contacts: at each contact a force/torque sensor (device), single axes of one (axis), or nothing (none).
        ft_sensors: fixed joints that could carry a force/torque sensor, or single axes of one, as `contacts` says.
        normal_forces: contacts that could carry a sensor of the normal force, `fn`.
    """

    joint_torques: list[str] | None = None
    contacts: Literal["device", "axis", "none"] = "device"
    ft_sensors: list[str] = dataclasses.field(default_factory=list)
    normal_forces: list[str] = dataclasses.field(default_factory=list)


@dataclass(config=STRICT, frozen=True)
class AnalysisConfig:
    """Sensor planning, and comparison of sensor sets.

    Attributes:
        scenarios: contact states by scenario, each a list of frames in contact; null: the states of the training logs,
            or all contacts at once without logs.
        candidates: sensors that could be mounted.
        keep: candidates that every plan contains.
        exclude: candidates that no plan contains.
        costs: cost of one channel, by candidate or by kind (joint_torque, contact, normal_force, ft_sensor).
        criterion: per_sample: each sample determines the base. stack: all samples together determine as much as with
            all candidates. null: per_sample for a floating base, stack for a fixed base.
        compare: sensor sets by name. Each is fitted to the training logs and tested on the test logs.
        seed: of the random postures.
    """

    scenarios: Annotated[Scenarios, Field(min_length=1)] | None = None
    candidates: CandidatesConfig = dataclasses.field(default_factory=CandidatesConfig)
    keep: list[str] = dataclasses.field(default_factory=list)
    exclude: list[str] = dataclasses.field(default_factory=list)
    costs: dict[str, Positive] = dataclasses.field(default_factory=dict)
    criterion: Literal["per_sample", "stack"] | None = None
    compare: dict[Name, Choice] = dataclasses.field(default_factory=dict)
    seed: Seed = 0


@dataclass(config=STRICT, frozen=True)
class ActuatorsConfig:
    """Unknown terms of every joint whose torque is measured.

    auto: a term is kept if a fit with it predicts held-out blocks of the training logs better, and its value is chosen.

    Attributes:
        armature: reflected rotor inertia.
        torque_offset: constant offset of the torque.
        asymmetric_coulomb: Coulomb friction that differs by direction.
        stribeck: velocity scale [rad/s or m/s]. Friction at rest exceeds Coulomb friction; the excess decays with
            exp(-(velocity / stribeck)^2). null: none.
        stiffness: springs, or cables that act as springs.
        sign_width: Coulomb friction follows tanh(velocity / sign_width) [rad/s or m/s]; null: the sign of the velocity.
        delay: time from the recorded or commanded torque until it acts [s].
        stiction: leave out torques of joints at rest, where friction takes any value below Coulomb friction.
    """

    armature: BoolOrAuto = AUTO
    torque_offset: BoolOrAuto = AUTO
    asymmetric_coulomb: BoolOrAuto = AUTO
    stribeck: PositiveOrAuto = None
    stiffness: BoolOrAuto = AUTO
    sign_width: PositiveOrAuto = AUTO
    delay: NumberOrAuto = AUTO
    stiction: BoolOrAuto = AUTO

    @property
    def known_delay(self) -> float:
        """The delay [s], 0 where there is none, or it has not been chosen."""
        return 0.0 if self.delay is None or isinstance(self.delay, str) else self.delay

    @property
    def known(self) -> dict[str, Any]:
        """All terms by name, none where logs have not chosen yet."""
        none = ActuatorsConfig.without_terms()
        return {name: none[name] if x == AUTO else x for name, x in vars(self).items()}

    @staticmethod
    def without_terms() -> dict[str, Any]:
        """What each key is without its term."""
        numbers = ("stribeck", "sign_width", "delay")
        return {field.name: None if field.name in numbers else False for field in dataclasses.fields(ActuatorsConfig)}


@dataclass(config=STRICT, frozen=True)
class FiguresConfig:
    """Figures of the run folder. `format`: their file format."""

    format: Literal["png", "pdf", "svg"] = "png"


@dataclass(config=STRICT, frozen=True, kw_only=True)
class _Common:
    """Keys of identification and analysis. `output` has no default; only Python may pass None: nothing is written."""

    robot: RobotConfig
    sensors: Sensors = dataclasses.field(default_factory=SensorsConfig)
    output: Path | None
    contacts: list[ContactConfig] = dataclasses.field(default_factory=list)
    preprocessing: PreprocessingConfig = dataclasses.field(default_factory=PreprocessingConfig)
    actuators: ActuatorsConfig = dataclasses.field(default_factory=ActuatorsConfig)
    estimator: EstimatorConfig = dataclasses.field(default_factory=EstimatorConfig)
    analysis: AnalysisConfig = dataclasses.field(default_factory=AnalysisConfig)
    figures: FiguresConfig = dataclasses.field(default_factory=FiguresConfig)
    device: Device = "cpu"
    overwrite: bool = False


@dataclass(config=STRICT, frozen=True, kw_only=True)
class ExperimentConfig(_Common):
    """One identification run."""

    logs: LogsConfig
    sensors: Sensors


@dataclass(config=STRICT, frozen=True, kw_only=True)
class AnalyzeConfig(_Common):
    """The same file for an analysis. `logs` may be missing; `sensors` may be missing or contain `noise` alone."""

    logs: LogsConfig | None = None


C = TypeVar("C", ExperimentConfig, AnalyzeConfig)


def _spelled_out(settings: Settings, overriding: Settings) -> Settings:
    """Parts of logs by name; robot, logs and sensors as mappings, where they are a URDF, training logs, a named set.

    An override of one key of sensors joins the others; a named set replaces sensors by name.
    """
    if isinstance(robot := settings.get("robot"), str):
        key = "mjcf" if Path(robot).suffix.lower() in MJCF_SUFFIXES else "urdf"
        settings = settings | {"robot": {key: robot}}
    if isinstance(logs := settings.get("logs"), (str, list)):
        settings = settings | {"logs": {"train": [logs] if isinstance(logs, str) else logs}}
    settings = entries_spelled_out(settings)
    if "sensors" not in settings:
        return settings
    sensors = settings["sensors"]
    if isinstance(overriding.get("sensors"), str) and isinstance(sensors, dict):
        sensors = {key: x for key, x in sensors.items() if key in ("noise", "offsets", "scales", "on_base_lost")}
    return settings | {"sensors": spelled_out(sensors)}


_LISTS = ("", *(f".{name}" for name in SETS))  # a list of logs alone is that to fit on
_FILES = ("", ".file", ".files.*", ".files.*.file")
_EXPERIMENT = FileKind(
    settings=ExperimentConfig,
    name="experiment",
    keys="robot, logs, sensors, output",
    list_example="contacts=[{frame: l_sole, type: flat}]",
    paths=("robot", "robot.urdf", "robot.mjcf", "logs", *(f"logs{name}.*{of}" for name in _LISTS for of in _FILES)),
    outputs=("output",),
    prepare=_spelled_out,
    accepted={
        "contacts": "a list of mappings: [{frame: l_sole, type: flat}]",
        "contacts.*.frame": "the name of a frame of the robot",
        "robot.weld": WELDS_ACCEPTED,
        "robot.loops": LOOPS_ACCEPTED,
        "sensors": CHOICE_ACCEPTED,
        **{f"{where}.contact_wrenches": WRENCHES_ACCEPTED for where in ("sensors", "analysis.compare.*")},
        **{f"{where}.contact_wrenches.*": COMPONENTS_ACCEPTED for where in ("sensors", "analysis.compare.*")},
        "sensors.offsets": SCOPES_ACCEPTED,
        "sensors.scales": f"{SCOPES_ACCEPTED}, or a list of groups",
        "sensors.scales.*": GROUPS_ACCEPTED,
        "analysis.compare.*": CHOICE_ACCEPTED,
        "estimator.robust": ROBUST_ACCEPTED,
        **dict.fromkeys(("estimator.total_mass", "estimator.masses.*"), MASS_ACCEPTED),
        **MAPS_ACCEPTED,
    },
)
_ANALYSIS = FileKind(**(vars(_EXPERIMENT) | {"settings": AnalyzeConfig, "keys": "robot, contacts, output"}))


def load_config(
    path: str | Path | None,
    overrides: Sequence[str] = (),
    sections: Mapping[str, object] | None = None,
    reads_logs: bool = True,
) -> ExperimentConfig:
    """Read and check an experiment file, or the same from Python.

    Args:
        path: the YAML file; paths in it are relative to it, but `output` to the working directory. None: there is none.
        overrides: `key.subkey=value`, the value in YAML; paths in them are relative to the working directory.
        sections: values by key, which override likewise; or all, where there is no file.
        reads_logs: whether its logs will be read; if not, they need not be there, and nobody looks.

    Raises:
        ConfigError: unreadable file, a value of the wrong kind, a missing key.
        UnknownNameError: a key that does not exist; the message names the nearest that do.

    Warns:
        TorchidWarning: a log is both fitted and tested on.
    """
    config, about = _loaded(_EXPERIMENT, path, overrides, sections)
    with about:
        require_one_file(config.robot)
        validate_choice("sensors", config.sensors)
        validate_keys(config.estimator)
        _check_conflicts(config)
        return dataclasses.replace(config, logs=_checked_logs(config, config.logs)) if reads_logs else config


def load_analysis(
    path: str | Path | None,
    overrides: Sequence[str] = (),
    sections: Mapping[str, object] | None = None,
    command: str = "analyze",
) -> AnalyzeConfig:
    """Read an experiment file for a command that needs samples: as `load_config`, but logs may be left out, or sensors.

    Raises:
        ConfigError: as `load_config`, or factors of logs.
    """
    config, about = _loaded(_ANALYSIS, path, overrides, sections)
    with about:
        require_one_file(config.robot)
        validate_choice("sensors", config.sensors, may_be_empty=True)
        validate_keys(config.estimator)
        _check_conflicts(config)
        for name, choice in config.analysis.compare.items():
            validate_choice(f"analysis.compare.{name}", choice)
        if config.logs is not None:
            config.logs.require_samples(command)
            return dataclasses.replace(config, logs=_checked_logs(config, config.logs))
        if config.analysis.compare:
            reason = "needs logs to measure accuracy"
            raise ConfigError.at_field("analysis.compare", reason, "logs.train")
    return config


def _loaded(
    kind: FileKind[C], path: str | Path | None, overrides: Sequence[str], sections: Mapping[str, object] | None
) -> tuple[C, AbstractContextManager[None]]:
    """Settings, and what errors found in them later are about: the file, or what they are about already."""
    given = plain_sections(sections or {})
    if path is None:
        return load(kind, None, overrides, {"output": None} | given), nullcontext()
    config = load(kind, Path(path), overrides, given)
    about = about_file(path)
    if config.output is None and given.get("output", config) is not None:  # left empty in the file or by the shell
        raise ConfigError(path, "output", "found None", "a path")
    return config, about


def inputs_of(config: ExperimentConfig | AnalyzeConfig) -> list[Path]:
    """The robot's file and logs; a bag may be a folder."""
    logs = config.logs
    return [config.robot.path, *(logs.files if logs else [])]


def _check_conflicts(config: _Common) -> None:
    """Refuse the same extra parameter or contact flags under two keys, and settings that contradict each other."""
    actuators = config.actuators
    offsets = config.sensors.offsets
    threshold = config.preprocessing.contact_threshold
    in_air = next((kind for kind in ("contact_force", "contact_moment") if kind in offsets), "")
    twice = (
        (actuators.torque_offset is True and "joint_torque" in offsets,
         "actuators.torque_offset", "the same as sensors.offsets.joint_torque"),
        (config.robot.base_tilt is not None and config.preprocessing.base_motion is not None,
         "robot.base_tilt", "preprocessing.base_motion already finds the tilt of the base"),
        (threshold is not None and config.preprocessing.detect_contacts is not None,
         "preprocessing.contact_threshold", "preprocessing.detect_contacts makes the same flags"),
        (config.preprocessing.zero_in_air and in_air,
         f"sensors.offsets.{in_air}", "preprocessing.zero_in_air subtracts the same"),
    )  # fmt: skip
    for applies, field, reason in twice:
        if applies:
            raise ConfigError.at_field(field, reason, "one of the two")
    if actuators.stribeck is not None and not config.estimator.friction:
        reason = "needs fitted Coulomb friction, but estimator.friction is false"
        raise ConfigError.at_field("actuators.stribeck", reason, "estimator.friction: true, or leave it out")
    if threshold is not None and threshold.below is not None and threshold.below > threshold.above:
        reason = f"{threshold.below:g} N is more than above ({threshold.above:g} N)"
        key = "preprocessing.contact_threshold.below"
        raise ConfigError.at_field(key, reason, "a force [N], at most that of above")


def _checked_logs(config: _Common, logs: LogsConfig) -> LogsConfig:
    """The logs with patterns resolved; refuses logs that the estimator cannot use, or samples with two uses."""
    _check_held_out(config.estimator, logs)
    checked = resolve_logs(logs)
    if logs.topics is not None:
        check_topics(logs.topics, needs_flags=config.preprocessing.needs_flags)
    if logs.columns is not None:
        check_columns(logs.columns)
    _check_factors(config, checked)
    return checked


def _check_factors(config: _Common, logs: LogsConfig) -> None:
    """Refuse factors together with logs, for tests, and for settings that need samples."""
    for key in ("test", "validation"):
        for path in getattr(logs, key):
            if path.suffix == FACTORS:
                raise ConfigError.at_field(f"logs.{key}", f"{path} has factors, without samples to predict", "logs")
    if not logs.compressed:
        return
    for path in logs.train:
        if path.suffix != FACTORS:
            found = f"{path} is a log, but other entries are factors"
            raise ConfigError.at_field("logs.train", found, f"only logs, or only {FACTORS} files")
    reason = "but logs.train has factors, without samples"
    unfit = (
        ("estimator.name", "sgd", config.estimator.name == "sgd", "least_squares or consistent"),
        ("estimator.robust", "set", config.estimator.robust is not None, "null"),
        ("estimator.task_weights", "set", config.estimator.task_weights != TaskWeightsConfig(), "leave it out"),
        (
            "preprocessing.exclude_rejected",
            "true",
            config.preprocessing.exclude_rejected,
            "false (torchid compress applies this key)",
        ),
    )
    for field, found, is_unfit, accepted in unfit:
        if is_unfit:
            raise ConfigError.at_field(field, f"{found}, {reason}", f"{accepted}, or logs instead of factors")


def _check_held_out(estimator: EstimatorConfig, logs: LogsConfig) -> None:
    """Refuse held-out logs without a descent, and patience without held-out logs."""
    if logs.validation and estimator.name != "sgd":
        raise ConfigError.at_field("logs.validation", f"not used by {estimator.name}", "estimator.name: sgd")
    if estimator.training.patience is not None and not logs.validation:
        raise ConfigError.at_field("estimator.training.patience", "needs held-out logs", "logs.validation")
