"""What commands share: robot, contacts, sensors and logs of an experiment file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.sensors import ChoiceConfig
from torchid.errors import ConfigError, LogError, UnknownNameError
from torchid.hygiene import Checked, check, without_condemned
from torchid.logs import Log, preprocess, read_log
from torchid.logs.blocks import size_of
from torchid.problem import Samples, bind
from torchid.problem.extras import ExtraTerms
from torchid.robot import Robot, load_robot
from torchid.robot.tree import FT_FIELD
from torchid.run.large_logs import GIGABYTE, LargeLog, away_from_changes, folder_beside
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
    """Robot and contacts of an experiment file, and what is read or chosen by their names.

    `excluded`: how many samples of each log that was read were left out because they are condemned.
    """

    config: ExperimentConfig | AnalyzeConfig
    robot: Robot
    contacts: tuple[Contact, ...]
    excluded: dict[str, int] = field(default_factory=dict, kw_only=True)

    @property
    def noise(self) -> SensorNoise:
        """Of the sensors."""
        return SensorNoise(**vars(self.config.sensors.noise))

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
            limit = GIGABYTE * self.config.preprocessing.memory_gb
            size = size_of(path, limit)
            logs.append(self._read(path, required) if size <= limit else self._read_large(path, required, size))
            if on_read is not None:
                on_read(path)
        return logs

    def _read(self, path: Path, required: SensorSet | None) -> Samples:
        """A log that fits into memory."""
        settings, files = self.config.preprocessing, self.config.logs
        recorded = read_log(path, None if files is None else files.topics)
        checked = self._checked(recorded)
        clean = recorded if checked is None else checked.repaired
        log = preprocess(clean, settings.cutoff_hz, settings.sample_rate_hz)
        samples = bind(log, self.robot, self.contacts, required)
        if checked is not None:
            count = len(samples)
            samples = without_condemned(samples, checked, settings.cutoff_hz, derived=log is not clean)
            self.excluded[str(path)] = count - len(samples)
        if settings.contact_margin_s is None:
            return samples
        kept = away_from_changes(recorded, samples.time.numpy(), settings.contact_margin_s)
        return samples if kept is None else samples[torch.from_numpy(np.flatnonzero(kept))]

    def _read_large(self, path: Path, required: SensorSet | None, size: int) -> Samples:
        """A log that does not."""
        settings = self.config.preprocessing
        if settings.exclude_condemned:
            found = f"set for arrays of {size / GIGABYTE:.2g} GB, which are not in memory at once"
            accepted = (
                f"a preprocessing.memory_gb above {size / GIGABYTE:.2g}, or parts of the log that torchid check passes"
            )
            raise LogError(path, "preprocessing.exclude_condemned", found, accepted)
        folder = folder_beside(self.config.output)
        return LargeLog(path, settings, self.robot, self.contacts, required, folder).samples()

    def _checked(self, log: Log) -> Checked | None:
        """What the checks of a log say, if condemned samples are to be left out."""
        settings = self.config.preprocessing
        return check(log, self.robot, self.contacts, settings.cutoff_hz) if settings.exclude_condemned else None


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
    try:
        robot = load_robot(config.robot.urdf, config.robot.base_link, config.robot.fixed_base, _ft_joints(config))
    except UnknownNameError as error:
        if error.field != FT_FIELD:
            raise
        raise UnknownNameError(source, _ft_field(config, error.name), error.name, error.valid) from error
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
        InputError: whatever in the file does not fit the robot.
    """
    scene = set_up_scene(config, source)
    return Experiment(config, scene.robot, scene.contacts, scene.sensors_of(config.sensors, source))
