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
    together determine all that full sensing would (None, for a fixed one). `compare`: sensor sets whose fits of the
    training logs are measured on the test logs.
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
    """Unknown terms of the actuators, of every joint whose torque is measured.

    `armature`: reflected rotor inertia; `torque_offset`; `asymmetric_coulomb`: Coulomb friction that differs by
    direction; `stiffness` of springs, or of cables that act as such; `sign_width` [rad/s or m/s]: Coulomb friction goes
    with tanh(velocity / width) instead of the sign; auto, with the width that leaves least of the training logs.
    `stribeck` [rad/s or m/s]: friction at rest beyond Coulomb friction, which drops with exp(-(velocity / stribeck)^2);
    auto, with the velocity that leaves least, or without such friction where the logs do not determine it.
    `delay` [s]: joint torques act so much later than recorded or commanded; auto, the delay that leaves least.
    `stiction`: where a joint rests, friction is whatever holds it, so that its torque counts as unmeasured.

    auto: as blocks of the training logs that a fit has not seen are predicted better (`torchid.fitting.left_out`).
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
    """How figures are written: `format`, of their files. TensorBoard and `report.html` have pictures of their own."""

    format: Literal["png", "pdf", "svg"] = "png"


@dataclass(config=STRICT, frozen=True, kw_only=True)
class _Common:
    """The keys of identification and analysis alike; no `output`, as Python alone may say: nothing is written."""

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
    """The same file for an analysis, which needs neither logs nor sensors; `sensors` may be `noise` alone."""

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
        _check_extras(config)
        _check_threshold(config.preprocessing)
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
        _check_extras(config)
        _check_threshold(config.preprocessing)
        for name, choice in config.analysis.compare.items():
            validate_choice(f"analysis.compare.{name}", choice)
        if config.logs is not None:
            config.logs.require_samples(command)
            return dataclasses.replace(config, logs=_checked_logs(config, config.logs))
        if config.analysis.compare:
            reason = "set, without logs to predict accuracy from"
            raise ConfigError.at_field("analysis.compare", reason, "logs.train too")
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


def _check_threshold(settings: PreprocessingConfig) -> None:
    """Refuse two sources of contact flags, and a threshold below that is above."""
    threshold = settings.contact_threshold
    key = "preprocessing.contact_threshold"
    if threshold is None:
        return
    if settings.detect_contacts is not None:
        reason = "set together with preprocessing.detect_contacts, which makes the same flags"
        raise ConfigError.at_field(key, reason, "one of the two")
    if threshold.below is not None and threshold.below > threshold.above:
        reason = f"{threshold.below:g}, more than above ({threshold.above:g})"
        raise ConfigError.at_field(f"{key}.below", reason, "a force [N] up to that of above")


def _check_extras(config: _Common) -> None:
    """Refuse the same extra parameter under two keys, and extra parameters for a descent, which has none."""
    actuators = config.actuators
    sensors = config.sensors
    if actuators.torque_offset is True and "joint_torque" in sensors.offsets:
        reason = "set together with sensors.offsets.joint_torque, which is the same"
        raise ConfigError.at_field("actuators.torque_offset", reason, "one of the two")
    if actuators.stribeck is not None and not config.estimator.friction:
        reason = "set, but estimator.friction: false leaves the Coulomb friction that it drops to at the URDF's"
        raise ConfigError.at_field("actuators.stribeck", reason, "estimator.friction: true, or no such key")
    if config.robot.base_tilt is not None and config.preprocessing.base_motion is not None:
        reason = "set together with preprocessing.base_motion, which finds how the base itself is turned"
        raise ConfigError.at_field("robot.base_tilt", reason, "one of the two")
    twice = [kind for kind in ("contact_force", "contact_moment") if kind in sensors.offsets]
    if config.preprocessing.zero_in_air and twice:
        reason = "set together with preprocessing.zero_in_air, which subtracts the same"
        raise ConfigError.at_field(f"sensors.offsets.{twice[0]}", reason, "one of the two")


def _checked_logs(config: _Common, logs: LogsConfig) -> LogsConfig:
    """The logs with patterns resolved; refuses logs that an estimator has no use for, or with two uses."""
    _check_held_out(config.estimator, logs)
    checked = resolve_logs(logs)
    if logs.topics is not None:
        check_topics(logs.topics, needs_flags=config.preprocessing.needs_flags)
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
    reason = "but logs.train names factors, which have no samples"
    unfit = (
        ("estimator.name", "sgd", config.estimator.name == "sgd", "least_squares or consistent"),
        ("estimator.robust", "set", config.estimator.robust is not None, "null"),
        ("estimator.task_weights", "set", config.estimator.task_weights != TaskWeightsConfig(), "no such key"),
        (
            "preprocessing.exclude_rejected",
            "true",
            config.preprocessing.exclude_rejected,
            "false, as torchid compress has left them out if it was told so",
        ),
    )
    for field, found, is_unfit, accepted in unfit:
        if is_unfit:
            raise ConfigError.at_field(field, f"{found}, {reason}", f"{accepted}, or the logs")


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
