"""Compressed logs of one fit: read from their files, and refused where they do not belong together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchid.errors import ConfigError, LogError, excerpt
from torchid.fitting.experiment import Experiment, with_noise
from torchid.fitting.factor_files import FactorFile, read_factors
from torchid.fitting.noise import GroupNoise, NoiseSummary
from torchid.fitting.row_model import NOISE, RowModel, require_same_noise, require_same_rows
from torchid.identifiability.base_parameters import StateReport, merge_state_reports
from torchid.problem import RowBuilder
from torchid.problem.extras import NoiseGroups, noise_key

_THE_EXPERIMENT = "the experiment file"
_APART = (
    "detect_contacts",
    "contact_threshold",
    "zero_in_air",
    "base_motion",
    "max_slip",
    "exclude_rejected",
    "memory_gb",
    "cache_gb",
)
"""Keys of preprocessing that do not change what a row is."""


def row_model(experiment: Experiment, builder: RowBuilder) -> RowModel:
    """What the rows of an experiment are formed with."""
    settings = vars(experiment.config.preprocessing)
    model = RowModel.of(experiment.robot, builder, {name: x for name, x in settings.items() if name not in _APART})
    delay = experiment.config.actuators.known_delay
    if not delay:  # a factor without stays what it was
        return model
    return replace(model, settings=model.settings | {"actuators.delay": delay})


@dataclass(frozen=True)
class Fleet:
    """Compressed training logs of one fit, that belong together.

    Attributes:
        experiment: with the noise that they were weighted with.
        files: the logs.
        noise: that they were weighted with.
        states: their contact states.
    """

    experiment: Experiment
    files: list[FactorFile]
    noise: NoiseSummary
    states: list[StateReport]


def read_fleet(experiment: Experiment, on_read: Callable[[Path], None] | None = None) -> Fleet:
    """Read the compressed training logs of an experiment.

    Args:
        experiment: whose training logs are files of factors.
        on_read: called after each file.

    Raises:
        LogError: a file that is damaged, or does not belong to the experiment or to the others.
        ConfigError: the experiment states other noise.
    """
    paths = experiment.config.logs.train
    model = row_model(experiment, experiment.builder(experiment.sensors))
    files: list[FactorFile] = []
    for path in paths:
        one = read_factors(path)
        require_same_rows(path, one.model, model, _THE_EXPERIMENT)
        files.append(one)
        require_same_noise(path, one.model, files[0].model, paths[0])
        if on_read is not None:
            on_read(path)
    _require_different_logs(paths, files)
    _require_stated_noise(experiment, files[0].model, paths[0])
    used, origins, groups = files[0].model.noise, files[0].noise_origins, NoiseGroups.of(experiment.robot)
    noise = groups.noise(groups.values(experiment.noise) | used, experiment.noise)
    listed = [GroupNoise(name, groups.unit(name), origins.get(name, "stated"), x, None) for name, x in used.items()]
    summary = NoiseSummary(noise, listed, {}, 0)
    return Fleet(with_noise(experiment, summary), files, summary, merge_state_reports(one.states for one in files))


def _require_different_logs(paths: Sequence[Path], files: Sequence[FactorFile]) -> None:
    seen: dict[str, Path] = {}
    for path, one in zip(paths, files, strict=True):
        if one.sha256 and one.sha256 in seen:
            found = f"of the same log as {seen[one.sha256]} ({excerpt(one.name)})"
            raise LogError(path, "sha256", found, "factors of every log once")
        seen[one.sha256] = path


def _require_stated_noise(experiment: Experiment, model: RowModel, path: Path) -> None:
    """Refuse an experiment that states other noise than factors were weighted with."""
    used, stated = model.noise, NoiseGroups.of(experiment.robot).values(experiment.noise)
    for name, value in used.items():
        if noise_key(name) in experiment.config.sensors.noise.forces and abs(value - stated[name]) > 1e-9 * value:
            found = f"{stated[name]:g}, but {value:g} in {path}"
            accepted = f"{value:g}, or no such key, or the logs compressed with another"
            raise ConfigError.at_field(f"{NOISE}.{name}", found, accepted)
