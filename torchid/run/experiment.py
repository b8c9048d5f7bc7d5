"""What commands share: robot, contacts and sensors of an experiment file."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.sensors import ChoiceConfig
from torchid.errors import ConfigError, UnknownNameError
from torchid.problem.extras import CHANNELS, ExtraTerms, measured_channels
from torchid.robot import Robot, load_robot
from torchid.robot.tree import FT_FIELD
from torchid.sensing import (
    Contact,
    SensorNoise,
    SensorSet,
    check_contacts,
    chosen_sensors,
    named_sensors,
    with_ft_sensors,
)


@dataclass(frozen=True)
class Scene:
    """Robot and contacts of an experiment file, and what is chosen by their names."""

    config: ExperimentConfig | AnalyzeConfig
    robot: Robot
    contacts: tuple[Contact, ...]

    @property
    def noise(self) -> SensorNoise:
        """Of the sensors, as stated; a guess where it is not."""
        return SensorNoise(**{name: x for name, x in vars(self.config.sensors.noise).items() if x is not None})

    @property
    def terms(self) -> ExtraTerms:
        """Unknowns beside the bodies' parameters."""
        sensors = self.config.sensors
        offsets, scales = ({str(channel): x for channel, x in s.items()} for s in (sensors.offsets, sensors.scales))
        return ExtraTerms(offsets, scales, **vars(self.config.actuators))

    def sensors_of(self, choice: ChoiceConfig, source: object = "experiment") -> SensorSet:
        """The sensors of a choice.

        Raises:
            InputError: names that do not fit the robot.
        """
        robot, contacts, noise, ft = self.robot, self.contacts, self.noise, len(self.robot.ft_names)
        if choice.set is not None:
            sensors = named_sensors(choice.set, robot.n, len(contacts), noise, ft)
        else:
            by_name = choice.joint_torques, choice.contact_wrenches
            sensors = chosen_sensors(robot.joint_names, contacts, *by_name, noise, source, ft)
        return with_ft_sensors(sensors, robot, choice.ft_sensors, source)


@dataclass(frozen=True)
class Experiment(Scene):
    """An experiment file brought to life."""

    config: ExperimentConfig
    sensors: SensorSet


def set_up_scene(config: ExperimentConfig | AnalyzeConfig, source: object = "experiment") -> Scene:
    """Load the robot and look its contacts up.

    Raises:
        InputError: whatever in the file does not fit the robot.
    """
    try:
        torch.empty(0, device=config.device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            source, "device", f"'{config.device}' is not available here", "cpu, cuda, cuda:0, ..."
        ) from error
    try:
        robot = load_robot(config.robot.urdf, config.robot.base_link, config.robot.fixed_base, _ft_joints(config))
    except UnknownNameError as error:
        if error.field != FT_FIELD:
            raise
        field = _ft_field(config, error.name)
        raise UnknownNameError(source, field, error.name, error.valid, error.what) from error
    if not robot.nv:
        raise ConfigError(source, "robot", "a bolted base without a joint, which never moves", "a robot that can move")
    contacts = check_contacts(robot, [Contact(c.frame, c.type, c.line_axis) for c in config.contacts], source)
    return Scene(config, robot, contacts)


def _ft_joints(config: ExperimentConfig | AnalyzeConfig) -> list[str]:
    """Fixed joints that carry a force/torque sensor in some sensor set of the file, or could in one to be planned."""
    choices = [config.sensors, *config.analysis.compare.values()]
    planned = config.analysis.candidates.ft_sensors if isinstance(config, AnalyzeConfig) else []
    return list(dict.fromkeys([*(name for choice in choices for name in choice.ft_sensors), *planned]))


def _ft_field(config: ExperimentConfig | AnalyzeConfig, name: str) -> str:
    """Where a file names a fixed joint."""
    choices = {"sensors": config.sensors} | {f"analysis.compare.{key}": x for key, x in config.analysis.compare.items()}
    named = (f"{place}.ft_sensors" for place, choice in choices.items() if name in choice.ft_sensors)
    return next(named, "analysis.candidates.ft_sensors")


def set_up(config: ExperimentConfig, source: object = "experiment") -> Experiment:
    """As `set_up_scene`, with sensors resolved by name.

    Raises:
        InputError: whatever in the file does not fit the robot, or unknowns of sensors that are not among the measured.
    """
    scene = set_up_scene(config, source)
    experiment = Experiment(config, scene.robot, scene.contacts, scene.sensors_of(config.sensors, source))
    _check_terms(experiment, source)
    return experiment


def _check_terms(experiment: Experiment, source: object) -> None:
    """Refuse unknowns of kinds of channels that nothing measures; all kinds together mean those that are measured."""
    terms = experiment.terms
    measured = measured_channels(experiment.robot, experiment.contacts, experiment.sensors)
    for field, scopes in (("offsets", terms.offsets), ("scales", terms.scales)):
        for channel in scopes:
            if channel not in measured and len(scopes) < len(CHANNELS):
                accepted = f"{', '.join(measured)}, or log or all for every kind that is measured"
                raise ConfigError(source, f"sensors.{field}.{channel}", "no such sensor is measured", accepted)
    for name, wanted in vars(experiment.config.actuators).items():
        if wanted and "joint_torque" not in measured:
            accepted = "joint torques among the sensors, or no such key"
            raise ConfigError(source, f"actuators.{name}", "set, but no joint torque is measured", accepted)
