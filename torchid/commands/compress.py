"""`torchid compress`: from the logs of an experiment to a small file of factors each; and reading these for a fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.progress import Progress

from torchid.commands.folder import COMPRESSED, check_free, new_folder
from torchid.commands.manifest import file_checksum
from torchid.commands.reading import LogReader
from torchid.config import ExperimentConfig, inputs_of
from torchid.errors import ConfigError, LogError, during, excerpt
from torchid.fitting.experiment import Experiment, set_up, stated_noise, with_noise
from torchid.fitting.factor_files import FactorFile, read_factors, write_factors
from torchid.fitting.noise import GroupNoise, NoiseSummary
from torchid.fitting.row_model import RowModel, require_same_noise, require_same_rows
from torchid.identifiability.base_parameters import StateReport, merge_state_reports, require_base, state_reports
from torchid.logs.containers import FACTORS, list_bag_files
from torchid.problem import RowBuilder, Samples
from torchid.problem.compressed_log import compress_log
from torchid.problem.noise import noise_of_groups, std_by_group
from torchid.report.tables import progress_bars

_THE_EXPERIMENT = "the experiment file"
_APART = ("exclude_condemned", "memory_gb")  # keys of preprocessing that do not change what a row is


@dataclass(frozen=True)
class CompressedFile:
    """A file of factors, its name and size [bytes], and what is in it."""

    name: str
    size: int
    samples: int
    rows: int
    states: int


@dataclass(frozen=True, kw_only=True)
class Compression:
    """What `compress` has done.

    Attributes:
        files: that were written.
        states: contact states of all logs.
        noise: that rows were weighed with.
        output: the folder.
    """

    files: list[CompressedFile]
    states: list[StateReport]
    noise: NoiseSummary
    output: Path


def compress(config: ExperimentConfig, output: str | Path) -> Compression:
    """Compress the training logs of an experiment and write a folder with a file for each, whole or not at all.

    Noise that the experiment does not state is estimated from these logs together.

    Args:
        config: the experiment; what it says of tests and of its own output does not matter.
        output: the folder; one that this function has written is replaced if the experiment says `overwrite`.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
        BaseLostError: the sensors cannot see the base.
    """
    output = Path(output)
    config.logs.require_samples("compress")
    check_free(output, config.overwrite, COMPRESSED, inputs_of(config))
    names = _file_names(config.logs.train)
    with progress_bars() as bars:
        experiment = set_up(config)
        logs, excluded = _read(experiment, output, bars)
        builder = experiment.builder(experiment.sensors)
        states = [state_reports([log], builder) for log in logs]
        together = merge_state_reports(states)
        require_base(together, config.sensors.on_base_lost)
        noise = experiment.estimate_noise(logs, experiment.sensors)
        experiment = with_noise(experiment, noise)
        factors = _compressed(experiment, logs, states, excluded, bars)
        with during("writing", output), new_folder(output, config.overwrite, COMPRESSED) as folder:
            files = [_write(folder / name, one) for name, one in zip(names, factors, strict=True)]
    return Compression(files=files, states=together, noise=noise, output=output)


def _file_names(logs: Sequence[Path]) -> list[str]:
    names = [f"{log.stem}{FACTORS}" for log in logs]
    again = [name for name in names if names.count(name) > 1]
    if again:
        found = f"several logs that would become {excerpt(again[0])}"
        raise ConfigError.at_field("logs.train", found, "logs of different names, or several calls")
    return names


def _read(experiment: Experiment, output: Path, bars: Progress) -> tuple[list[Samples], list[int]]:
    """The logs, and how many samples of each were left out."""
    files = experiment.config.logs.train
    reader = LogReader(replace(experiment, config=replace(experiment.config, output=output)))
    reading = bars.add_task("reading logs", total=len(files))
    logs = reader.read(files, experiment.sensors, lambda _: bars.advance(reading))
    return logs, [reader.excluded.get(str(path), 0) for path in files]


def _compressed(
    experiment: Experiment,
    logs: Sequence[Samples],
    states: Sequence[list[StateReport]],
    excluded: Sequence[int],
    bars: Progress,
) -> Iterator[FactorFile]:
    """The logs one by one: only one at a time is in memory twice."""
    builder = experiment.builder(experiment.sensors)
    model = row_model(experiment, builder)
    streaming = bars.add_task("streaming samples", total=sum(map(len, logs)))
    for path, log, own, left_out in zip(experiment.config.logs.train, logs, states, excluded, strict=True):
        yield FactorFile(
            compress_log(log, builder, lambda n: bars.advance(streaming, n)),
            model,
            path.name,
            file_checksum(*(list_bag_files(path) or [path])),
            float(log.time[-1] - log.time[0]),
            left_out,
            own,
        )


def _write(path: Path, factors: FactorFile) -> CompressedFile:
    write_factors(path, factors)
    log = factors.log
    return CompressedFile(path.name, path.stat().st_size, len(log), log.rows, len(log.by_state))


def row_model(experiment: Experiment, builder: RowBuilder) -> RowModel:
    """What the rows of an experiment are formed with."""
    settings = vars(experiment.config.preprocessing)
    return RowModel.of(experiment.robot, builder, {name: x for name, x in settings.items() if name not in _APART})


# ------------------------------------------------------------------------------------------------------ fits of factors


@dataclass(frozen=True)
class Fleet:
    """Compressed training logs of one fit, that belong together.

    Attributes:
        experiment: with the noise that they were weighed with.
        files: the logs.
        noise: that they were weighed with, as if it had been stated.
        states: their contact states.
    """

    experiment: Experiment
    files: list[FactorFile]
    noise: NoiseSummary
    states: list[StateReport]


def read_fleet(experiment: Experiment, bars: Progress) -> Fleet:
    """Read the compressed training logs of an experiment.

    Raises:
        LogError: a file that is damaged, or does not belong to the experiment or to the others.
        ConfigError: the experiment states other noise.
    """
    paths = experiment.config.logs.train
    reading = bars.add_task("reading factors", total=len(paths))
    model = row_model(experiment, experiment.builder(experiment.sensors))
    files: list[FactorFile] = []
    for path in paths:
        one = read_factors(path)
        require_same_rows(path, one.model, model, _THE_EXPERIMENT)
        files.append(one)
        require_same_noise(path, one.model, files[0].model, paths[0])
        bars.advance(reading)
    _require_different_logs(paths, files)
    _require_stated_noise(experiment, files[0].model, paths[0])
    groups = files[0].model.noise
    noise = noise_of_groups(std_by_group(experiment.noise) | groups)
    listed = [GroupNoise(name, "N" if "force" in name else "N m", "stated", x, None) for name, x in groups.items()]
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
    """Refuse an experiment that states other noise than factors were weighed with."""
    used, stated = model.noise, std_by_group(experiment.noise)
    for key in stated_noise(experiment.config.sensors.noise):
        groups = [name for name in used if name.partition(".")[0] == key]
        if any(abs(used[name] - stated[name]) > 1e-9 * used[name] for name in groups):
            own, theirs = (", ".join(f"{x[name]:g}" for name in groups) for x in (stated, used))
            accepted = f"{theirs}, or no such key, or the logs compressed with another"
            raise ConfigError.at_field(f"sensors.noise.{key}", f"{own}, but {theirs} in {path}", accepted)
