"""What identification and evaluation share: robot, contacts, sensors and logs of an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from torchid.config import ExperimentConfig
from torchid.errors import ConfigError
from torchid.logs import preprocess, read_log
from torchid.problem import Samples, bind
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact, SensorNoise, SensorSet, check_contacts, chosen_sensors, named_sensors


@dataclass(frozen=True)
class Experiment:
    """An experiment file brought to life."""

    config: ExperimentConfig
    robot: Robot
    contacts: tuple[Contact, ...]
    sensors: SensorSet

    def read(
        self, paths: Sequence[Path], required: bool, on_read: Callable[[Path], None] | None = None
    ) -> list[Samples]:
        """Read, preprocess and bind logs; each on its own, so that nothing is differentiated across a seam.

        Args:
            paths: log files.
            required: whether every sensor of the set must have been recorded.
            on_read: called after each file.
        """
        logs = []
        for path in paths:
            settings = self.config.preprocessing
            log = preprocess(read_log(path), settings.cutoff_hz, settings.sample_rate_hz)
            logs.append(bind(log, self.robot, self.contacts, self.sensors if required else None))
            if on_read is not None:
                on_read(path)
        return logs


def set_up(config: ExperimentConfig, source: object = "experiment") -> Experiment:
    """Load the robot and resolve contacts and sensors by name.

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
    contacts = check_contacts(robot, [Contact(c.frame, c.type, c.line_axis) for c in config.contacts], source)
    chosen, levels = config.sensors, config.sensors.noise
    noise = SensorNoise(
        levels.joint_torque, levels.contact_force, levels.contact_moment, levels.base_force, levels.base_moment
    )
    if chosen.set is not None:
        sensors = named_sensors(chosen.set, robot.n, len(contacts), noise)
    else:
        sensors = chosen_sensors(
            robot.joint_names, contacts, chosen.joint_torques, chosen.contact_wrenches, noise, source
        )
    return Experiment(config, robot, contacts, sensors)
