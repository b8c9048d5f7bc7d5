"""The experiment file: typed dataclasses, YAML, and overrides from the command line."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_type_hints

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import BeforeValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from torchid.errors import ConfigError, UnknownNameError
from torchid.sensing.sensors import SensorNoise

_STRICT = ConfigDict(extra="forbid")
_PATHS = (("robot", "urdf", False), ("logs", "train", True), ("logs", "test", True))  # and whether it is a list


def _no_flag(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("a number")  # and not 1.0 for `true`
    return value


Number = Annotated[float, BeforeValidator(_no_flag), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Component = Literal["fx", "fy", "fz", "mx", "my", "mz"]


@dataclass(config=_STRICT, frozen=True)
class RobotConfig:
    """Which robot: `base_link` defaults to the URDF's root."""

    urdf: Path
    base_link: str | None = None
    fixed_base: bool = False


@dataclass(config=_STRICT, frozen=True)
class ContactConfig:
    """A contact at a URDF frame: `line_axis` is the frame's axis that a line contact runs along."""

    frame: str
    type: Literal["point", "line", "flat"]
    line_axis: Literal["x", "y", "z"] = "y"


@dataclass(config=_STRICT, frozen=True)
class LogsConfig:
    """Logs to fit on, and logs the fit never sees."""

    train: Annotated[list[Path], Field(min_length=1)]
    test: list[Path] = dataclasses.field(default_factory=list)


@dataclass(config=_STRICT, frozen=True)
class PreprocessingConfig:
    """Zero-phase low-pass [Hz] and resampling [Hz]; None leaves the signals as they are."""

    cutoff_hz: Positive | None = None
    sample_rate_hz: Positive | None = None


@dataclass(config=_STRICT, frozen=True)
class NoiseConfig:
    """Standard deviations of the sensors [N m, N, N m], and floors of the base rows [N, N m] (None: one contact's)."""

    joint_torque: Positive = SensorNoise.joint_torque
    contact_force: Positive = SensorNoise.contact_force
    contact_moment: Positive = SensorNoise.contact_moment
    base_force: Positive | None = None
    base_moment: Positive | None = None


@dataclass(config=_STRICT, frozen=True)
class SensorsConfig:
    """A named set, or sensors by name; `sensors: full` is short for `sensors: {set: full}`."""

    set: Literal["full", "contacts", "joints"] | None = None
    joint_torques: list[str] = dataclasses.field(default_factory=list)
    contact_wrenches: dict[str, list[Component]] = dataclasses.field(default_factory=dict)
    ft_sensors: Annotated[list[str], Field(max_length=0)] = dataclasses.field(default_factory=list)
    noise: NoiseConfig = dataclasses.field(default_factory=NoiseConfig)
    on_base_lost: Literal["error", "warn"] = "error"


@dataclass(config=_STRICT, frozen=True)
class EstimatorConfig:
    """Batch least squares: `ridge` pulls to the URDF, `friction: false` leaves friction at the URDF's values."""

    name: Literal["least_squares"] = "least_squares"
    ridge: NotNegative = 0.0
    rank_tolerance: Annotated[Number, Field(gt=0.0, lt=1.0)] = 1e-10
    friction: bool = True


def _spelled_out(value: object) -> object:
    return {"set": value} if isinstance(value, str) else value


@dataclass(config=_STRICT, frozen=True, kw_only=True)
class ExperimentConfig:
    """One identification run."""

    robot: RobotConfig
    logs: LogsConfig
    output: Path
    sensors: Annotated[SensorsConfig, BeforeValidator(_spelled_out)]
    contacts: list[ContactConfig] = dataclasses.field(default_factory=list)
    preprocessing: PreprocessingConfig = dataclasses.field(default_factory=PreprocessingConfig)
    estimator: EstimatorConfig = dataclasses.field(default_factory=EstimatorConfig)
    device: Annotated[str, Field(pattern=r"^(cpu|cuda(:\d+)?)$")] = "cpu"
    overwrite: bool = False


def load_config(path: str | Path, overrides: Sequence[str] = ()) -> ExperimentConfig:
    """Read and check an experiment file.

    Args:
        path: the YAML file; paths in it are relative to it.
        overrides: `key.subkey=value`, the value in YAML; paths in them are relative to the working directory.

    Raises:
        ConfigError: unreadable file, a value of the wrong kind, a missing key.
        UnknownNameError: a key that does not exist; the message names the nearest that do.
    """
    path = Path(path)
    settings = _absolute(_read(path), path.resolve().parent)
    for text in overrides:
        if "=" not in text:
            raise ConfigError("command line", text, "not an override", "key.subkey=value")
    try:
        given = _container(OmegaConf.from_dotlist(list(overrides)))
    except (OmegaConfBaseException, yaml.YAMLError) as error:
        raise ConfigError("command line", " ".join(overrides), str(error), "key.subkey=value, in YAML") from error
    if isinstance(given.get("sensors"), str) and isinstance(settings.get("sensors"), dict):
        kept = {key: x for key, x in settings["sensors"].items() if key in ("noise", "on_base_lost")}
        settings = settings | {"sensors": kept}  # a named set replaces sensors by name
    try:
        merged = _container(OmegaConf.merge(_expand_sensors(settings), _expand_sensors(_absolute(given, Path.cwd()))))
    except (OmegaConfBaseException, TypeError) as error:
        accepted = "key.subkey=value, a list as a whole: 'contacts=[{frame: l_sole, type: flat}]'"
        raise ConfigError("command line", " ".join(overrides), "does not fit the file", accepted) from error
    try:
        config = TypeAdapter(ExperimentConfig).validate_python(merged)
    except ValidationError as error:
        raise _in_one_line(path, error) from error
    _check_sensors(path, config.sensors)
    return config


def dump_config(config: ExperimentConfig) -> str:
    """The resolved configuration as YAML; `load_config` reads it back."""
    return yaml.safe_dump(TypeAdapter(ExperimentConfig).dump_python(config, mode="json"), sort_keys=False)


def _read(path: Path) -> dict[str, Any]:
    try:
        loaded = _container(OmegaConf.load(path))
    except OSError as error:
        raise ConfigError(path, "file", f"cannot be read ({error.strerror})", "a YAML experiment file") from error
    except (OmegaConfBaseException, yaml.YAMLError, ValueError) as error:
        raise ConfigError(path, "YAML", f"not readable: {error}", "a YAML mapping") from error
    if not isinstance(loaded, dict):
        raise ConfigError(path, "YAML", f"a {type(loaded).__name__}", "a mapping with robot, logs, sensors, output")
    return loaded


def _container(config: Any) -> Any:
    return OmegaConf.to_container(config, resolve=True)


def _expand_sensors(settings: dict[str, Any]) -> dict[str, Any]:
    """Spell `sensors: full` out, so that an override of one of its keys joins it and does not replace it."""
    return settings | {"sensors": _spelled_out(settings["sensors"])} if "sensors" in settings else settings


def _absolute(settings: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The settings with paths made absolute; anything that is not a path where one belongs is left to the checks."""

    def resolved(value: object) -> object:
        return os.path.normpath(folder / Path(value).expanduser()) if isinstance(value, str) else value

    def all_resolved(value: object) -> object:
        return [resolved(item) for item in value] if isinstance(value, list) else value

    settings = dict(settings)
    for section, key, many in _PATHS:
        value = settings.get(section)
        if isinstance(value, Mapping) and key in value:
            settings[section] = {**value, key: all_resolved(value[key]) if many else resolved(value[key])}
    if "output" in settings:
        settings["output"] = resolved(settings["output"])
    return settings


def _check_sensors(path: Path, sensors: SensorsConfig) -> None:
    chosen = bool(sensors.joint_torques or sensors.contact_wrenches)
    if sensors.set is not None and chosen:
        raise ConfigError(path, "sensors", f"set: {sensors.set} together with sensors by name", "one of the two")
    if sensors.set is None and not chosen:
        accepted = "full, contacts, joints, or joint_torques and contact_wrenches by name"
        raise ConfigError(path, "sensors", "no sensor", accepted)


def _in_one_line(path: Path, error: ValidationError) -> ConfigError | UnknownNameError:
    """The first complaint, an unknown key before others: it is the likeliest cause of the rest."""
    complaints = sorted(error.errors(), key=lambda e: e["type"] != "unexpected_keyword_argument")
    first = complaints[0]
    place = [str(part) for part in first["loc"]]
    field = ".".join(place)
    if first["type"] == "unexpected_keyword_argument":
        return UnknownNameError(path, ".".join(place[:-1]) or "key", place[-1], _keys_at(place[:-1]))
    missing = [".".join(map(str, e["loc"])) for e in complaints if e["type"] == "missing"]
    if missing:
        return ConfigError(path, ", ".join(missing), "missing", "a value")
    if place == ["sensors", "ft_sensors"]:
        return ConfigError(path, field, "limb-mounted sensors, which are not supported yet", "an empty list")
    found = first["input"]
    shown = "a mapping" if isinstance(found, Mapping) else "a list" if isinstance(found, list) else repr(found)
    if first["type"] == "dataclass_type":
        return ConfigError(path, field, f"found {shown}", f"a mapping with {', '.join(_keys_at(place))}")
    if first["type"] == "too_short":
        return ConfigError(path, field, "an empty list", "at least one item")
    plain = {"path_type": "a path", "string_pattern_mismatch": "cpu, cuda, cuda:0, ...", "list_type": "a list"}
    if first["type"] in plain:
        return ConfigError(path, field, f"found {shown}", plain[first["type"]])
    accepted = first["msg"].removeprefix("Input should be ").removeprefix("Value error, ")
    return ConfigError(path, field, f"found {shown}", accepted)


def _keys_at(place: list[str]) -> list[str]:
    """Names of the keys accepted at a place in the file."""
    kind: Any = ExperimentConfig
    for part in place:
        if not part.isdigit():
            kind = _dataclass_in(get_type_hints(kind)[part])
    return [field.name for field in dataclasses.fields(kind)]


def _dataclass_in(hint: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return hint
    return next((found for inner in get_args(hint) if (found := _dataclass_in(inner)) is not None), None)
