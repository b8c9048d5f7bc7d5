"""`torchid compress`: from the logs of an experiment to a small file of factors each."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

from rich.progress import Progress

from torchid import distributed
from torchid.commands.chosen_settings import Choices, with_chosen_settings
from torchid.commands.folder import COMPRESSED, check_free, file_checksum, new_folder
from torchid.config import ExperimentConfig, inputs_of
from torchid.errors import ConfigError, during, excerpt
from torchid.fitting.experiment import Experiment, set_up, with_noise
from torchid.fitting.factor_files import FactorFile, row_model, write_factors
from torchid.fitting.noise import NoiseSummary
from torchid.identifiability.base_parameters import StateReport, merge_state_reports, require_base, state_reports
from torchid.logs.containers import FACTORS, log_files
from torchid.logs.time_range import log_title, split_range
from torchid.parallel import one_thread
from torchid.problem import Samples
from torchid.problem.compression import compress_log
from torchid.problem.noise import LogOfOtherProcess
from torchid.reading.log_reader import LogReader
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
        noise: that rows were weighted with.
        output: the folder.
        rolling: which contacts roll, on what.
        choices: settings that were left to the logs.
    """

    files: list[CompressedFile]
    states: list[StateReport]
    noise: NoiseSummary
    output: Path
    rolling: str
    choices: Choices


@one_thread()
def compress(config: ExperimentConfig, output: str | Path) -> Compression:
    """Compress the training logs of an experiment and write a folder with a file for each, whole or not at all.

    Noise that the experiment does not state is estimated from these logs together. Processes that share the work each
    read and compress some of the logs, and the first writes: the same files, bit for bit, as from one process.

    Args:
        config: the experiment; what it says of tests and of its own output does not matter.
        output: the folder; one that this function has written is replaced if the experiment says `overwrite`.

    Raises:
        InputError: whatever does not fit; nothing has been written then.
        BaseLostError: the sensors cannot see the base.
    """
    if "://" in str(output):
        raise ConfigError(output, "output", "a URL", "a local folder (copy it from there)")
    output = Path(output)
    config.logs.require_samples("compress")
    distributed.from_first(partial(check_free, output, config.overwrite, COMPRESSED, inputs_of(config)), "output")
    names = _file_names(config.logs.train)
    distributed.require_same(names, "logs.train")
    share = distributed.own_share(
        distributed.broadcast([_size(path) for path in config.logs.train], "sizes of the logs")
    )
    paths = config.logs.train[share]
    with progress_bars() as bars:
        experiment, choices = with_chosen_settings(set_up(config), bars)
        builder = experiment.builder(experiment.sensors)
        with _warning_in_first_process(), distributed.apart():
            logs, excluded = _read(experiment, paths, output, bars)
            states = [state_reports([log], builder) for log in logs]
        together = merge_state_reports(chain.from_iterable(distributed.all_gather(states, "contact states")))
        require_base(together, config.sensors.on_base_lost, experiment.contacts)
        noise = experiment.estimate_noise(_with_those_elsewhere(logs), experiment.sensors)
        factors = _compressed(with_noise(experiment, noise), noise, paths, logs, states, excluded, bars)
        files = _write_all(names, zip(names[share], factors, strict=True), output, config.overwrite)
    return Compression(
        files=files, states=together, noise=noise, output=output, rolling=experiment.rolling, choices=choices
    )


def _file_names(logs: Sequence[Path]) -> list[str]:
    names = [f"{split_range(log).name}{FACTORS}" for log in logs]
    again = [name for name in names if names.count(name) > 1]
    if again:
        reason = f"several logs have the file name {excerpt(again[0])}"
        raise ConfigError.at_field("logs.train", reason, "logs with different names, or several calls")
    return names


def _size(path: Path) -> int:
    """Bytes of a log's files; 1 if they are not here, which reading will say."""
    with suppress(OSError):
        return sum(file.stat().st_size for file in log_files(path))
    return 1


@contextmanager
def _warning_in_first_process() -> Iterator[None]:
    """Let the first process warn of what any of them warns of within the block."""
    with nullcontext() if distributed.is_first() else warnings.catch_warnings(record=True) as caught:
        yield
    for of_process in distributed.all_gather(
        [(str(warning.message), warning.category) for warning in caught or ()], "warnings"
    ):
        for message, category in of_process if distributed.is_first() else ():
            warnings.warn(message, category, stacklevel=2)


def _with_those_elsewhere(logs: Sequence[Samples]) -> list[Samples | LogOfOtherProcess]:
    """All logs of the experiment in order; of those that other processes have, their size."""
    of_processes: list[list[Samples | LogOfOtherProcess]] = [
        [*sizes]
        for sizes in distributed.all_gather(
            [LogOfOtherProcess(len(x), x.oversampling) for x in logs], "sizes of the samples"
        )
    ]
    of_processes[distributed.rank()] = [*logs]
    return list(chain.from_iterable(of_processes))


def _read(
    experiment: Experiment, files: Sequence[Path], output: Path, bars: Progress
) -> tuple[list[Samples], list[int]]:
    """Logs, and how many samples of each were left out."""
    reader = LogReader(replace(experiment, config=replace(experiment.config, output=output)))
    reading = bars.add_task("reading logs", total=len(files))
    logs = reader.read(files, experiment.sensors, lambda _: bars.advance(reading))
    return logs, [reader.excluded.get(str(path), 0) for path in files]


def _compressed(
    experiment: Experiment,
    noise: NoiseSummary,
    paths: Sequence[Path],
    logs: Sequence[Samples],
    states: Sequence[list[StateReport]],
    excluded: Sequence[int],
    bars: Progress,
) -> Iterator[FactorFile]:
    """The logs one by one: only one at a time is in memory twice."""
    builder = experiment.builder(experiment.sensors)
    model = row_model(experiment, builder)
    origins = {group.group: group.origin for group in noise.groups if group.origin != "stated"}
    streaming = bars.add_task("streaming samples", total=sum(map(len, logs)))
    for path, log, log_states, left_out in zip(paths, logs, states, excluded, strict=True):
        yield FactorFile(
            compress_log(log, builder, lambda n: bars.advance(streaming, n)),
            model,
            log_title(path),
            _checksum(path),
            float(log.time[-1] - log.time[0]),
            left_out,
            log_states,
            payloads=[asdict(payload) for payload in experiment.config.logs.payloads_of(path)],
            noise_origins=origins,
        )


def _checksum(path: Path) -> str:
    """SHA-256 of a log's files, and for a part of one of that with the range: parts of a log are different logs.

    So are files that are joined otherwise.
    """
    whole = file_checksum(*log_files(path))
    part = split_range(path)
    text = ("" if part.range is None else part.range.text) + part.kind * part.joins
    return hashlib.sha256(f"{whole}{text}".encode()).hexdigest() if text else whole


def _write_all(
    names: Sequence[str], factors: Iterable[tuple[str, FactorFile]], output: Path, overwrite: bool
) -> list[CompressedFile]:
    """Write the files of all processes, by name, in the first of them: a file of each at a time."""
    rounds: Iterable[list[tuple[str, FactorFile] | None]] = ([factor_file] for factor_file in factors)
    if distributed.world_size() > 1:
        with distributed.apart():
            of_process = list(factors)
        most = max(distributed.all_gather(len(of_process), "numbers of files"))
        rounds = (distributed.all_gather(of_process[k] if k < len(of_process) else None, "files") for k in range(most))
    files = {}
    writing = new_folder(output, overwrite, COMPRESSED) if distributed.is_first() else nullcontext()
    with during("writing", output), writing as folder:
        for of_processes in rounds:
            for name, factor_file in filter(None, of_processes):
                if folder is not None:
                    files[name] = _write(folder / name, factor_file)
    return distributed.broadcast([files[name] for name in names if name in files], "files")


def _write(path: Path, factors: FactorFile) -> CompressedFile:
    write_factors(path, factors)
    log = factors.log
    return CompressedFile(path.name, path.stat().st_size, len(log), log.rows, len(log.by_state))
