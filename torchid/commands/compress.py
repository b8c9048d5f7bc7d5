"""`torchid compress`: from the logs of an experiment to a small file of factors each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.progress import Progress

from torchid.commands.folder import COMPRESSED, check_free, new_folder
from torchid.commands.manifest import file_checksum
from torchid.commands.reading import LogReader
from torchid.config import ExperimentConfig, inputs_of
from torchid.errors import ConfigError, during, excerpt
from torchid.fitting.experiment import Experiment, set_up, with_noise
from torchid.fitting.factor_files import FactorFile, write_factors
from torchid.fitting.fleet import row_model
from torchid.fitting.noise import NoiseSummary
from torchid.identifiability.base_parameters import StateReport, merge_state_reports, require_base, state_reports
from torchid.logs.containers import FACTORS, list_bag_files
from torchid.problem import Samples
from torchid.problem.compressed_log import compress_log
from torchid.report.tables import progress_bars


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
