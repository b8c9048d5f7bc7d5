"""What commands share: robot, contacts, sensors and logs of an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.sensors import ChoiceConfig
from torchid.errors import ConfigError
from torchid.logs import preprocess, read_log
from torchid.problem import Samples, bind
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact, SensorNoise, SensorSet, check_contacts, chosen_sensors, named_sensors


@dataclass(frozen=True)
class Scene:
    """Robot and contacts of an experiment file, and what is read or chosen by their names."""

    config: ExperimentConfig | AnalyzeConfig
    robot: Robot
    contacts: tuple[Contact, ...]

    @property
    def noise(self) -> SensorNoise:
        """Of the sensors."""
        return SensorNoise(**vars(self.config.sensors.noise))

    def sensors_of(self, choice: ChoiceConfig, source: object = "experiment") -> SensorSet:
        """The sensors of a choice.

        Raises:
            InputError: names that do not fit the robot.
        """
        robot, contacts, noise = self.robot, self.contacts, self.noise
        if choice.set is not None:
            return named_sensors(choice.set, robot.n, len(contacts), noise)
        names = robot.joint_names
        return chosen_sensors(names, contacts, choice.joint_torques, choice.contact_wrenches, noise, source)

    def read_logs(
        self, paths: Sequence[Path], required: SensorSet | None, on_read: Callable[[Path], None] | None = None
    ) -> list[Samples]:
        """Read, preprocess and bind logs; each on its own, so that nothing is differentiated across a seam.

        Args:
            paths: log files.
            required: sensors that must have been recorded.
            on_read: called after each file.
        """
        logs = []
        for path in paths:
            settings = self.config.preprocessing
            log = preprocess(read_log(path), settings.cutoff_hz, settings.sample_rate_hz)
            logs.append(bind(log, self.robot, self.contacts, required))
            if on_read is not None:
                on_read(path)
        return logs


@dataclass(frozen=True)
class Experiment(Scene):
    """An experiment file brought to life."""

    config: ExperimentConfig
    sensors: SensorSet

    def read(
        self, paths: Sequence[Path], required: bool, on_read: Callable[[Path], None] | None = None
    ) -> list[Samples]:
        """As `read_logs`; `required` says whether every sensor of the set must have been recorded."""
        return self.read_logs(paths, self.sensors if required else None, on_read)


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
    robot = load_robot(config.robot.urdf, config.robot.base_link, config.robot.fixed_base)
    if not robot.nv:
        raise ConfigError(source, "robot", "a bolted base without a joint, which never moves", "a robot that can move")
    contacts = check_contacts(robot, [Contact(c.frame, c.type, c.line_axis) for c in config.contacts], source)
    return Scene(config, robot, contacts)


def set_up(config: ExperimentConfig, source: object = "experiment") -> Experiment:
    """As `set_up_scene`, with sensors resolved by name.

    Raises:
        InputError: whatever in the file does not fit the robot.
    """
    scene = set_up_scene(config, source)
    return Experiment(config, scene.robot, scene.contacts, scene.sensors_of(config.sensors, source))
