"""What `torchid identify` fits: training logs, or factors of them, read and compressed, with noise and ridge chosen."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

from rich.progress import Progress

from torchid import distributed
from torchid.commands.chosen_settings import Choices, with_chosen_settings, with_ridge
from torchid.commands.training import descent_settings
from torchid.config import ExperimentConfig
from torchid.estimators import Conditions
from torchid.fitting.cross_validation import RidgeChoice
from torchid.fitting.experiment import Experiment, set_up, with_noise, with_task_weights
from torchid.fitting.factor_files import FactorFile, read_fleet
from torchid.fitting.fit import LogFitter
from torchid.fitting.noise import NoiseSummary
from torchid.identifiability.base_parameters import StateReport, require_base, state_reports
from torchid.problem import RowBuilder, Samples
from torchid.problem.compression import Block, Part, compress_in_blocks, fold_compressed, split_into_folds
from torchid.reading.log_reader import LogReader, check_read


@dataclass
class Stopwatch:
    """Adds up seconds by step: `with clock("read"): ...`."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Add what the block takes to a step."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


@dataclass
class CompressedData:
    """Training logs in folds, or factors of them, with the noise of their weights, and compressed; test logs.

    `experiment`: with that noise, and what the logs have chosen. `factors`: files that the training logs come from, if
    they do.
    """

    experiment: Experiment
    logs: dict[str, list[Samples]]
    factors: list[FactorFile]
    excluded: Mapping[str, int]
    states: list[StateReport]
    noise: NoiseSummary
    builder: RowBuilder
    blocks: Sequence[Block]
    parts: list[Part]
    choices: Choices


@dataclass
class PreparedData(CompressedData):
    """Data with the ridge chosen."""

    conditions: Conditions
    fitter: LogFitter
    ridge: RidgeChoice | None


def prepare(config: ExperimentConfig, clock: Stopwatch, bars: Progress) -> PreparedData:
    """Read and compress what an experiment fits, and choose its ridge.

    Raises:
        InputError: whatever does not fit.
        BaseLostError: the sensors cannot see the base.
    """
    with clock("read"):
        experiment = set_up(config)
        conditions = experiment.conditions()
        if config.estimator.name == "sgd":
            descent_settings(config)  # before any work
    data = (_data_of_factors if config.logs.compressed else _data_of_logs)(experiment, clock, bars)
    with clock("ridge"):
        experiment, ridge = with_ridge(data.experiment, data.parts, data.blocks, data.builder, conditions, bars)
    fitter = experiment.fitter(data.builder, conditions)
    return PreparedData(**vars(data) | {"experiment": experiment}, conditions=conditions, fitter=fitter, ridge=ridge)


def _data_of_logs(experiment: Experiment, clock: Stopwatch, bars: Progress) -> CompressedData:
    """The logs of an experiment, read and compressed."""
    with clock("settings"):
        experiment, choices = with_chosen_settings(experiment, bars)
    with clock("read"):
        logs, excluded = _read(experiment, bars)
    with clock("noise"):
        states = state_reports(logs["train"], experiment.builder(experiment.sensors))
        require_base(states, experiment.config.sensors.on_base_lost, experiment.contacts)
        noise = distributed.from_first(partial(experiment.estimate_noise, logs["train"], experiment.sensors), "noise")
        experiment = with_task_weights(with_noise(experiment, noise), logs["train"])
    with clock("compress"):
        builder = experiment.builder(experiment.sensors)
        blocks = split_into_folds(logs["train"], builder)
        streaming = bars.add_task("streaming samples", total=sum(map(len, logs["train"])))
        parts = compress_in_blocks(blocks, builder, progress=partial(bars.advance, streaming))
    return CompressedData(experiment, logs, [], excluded, states, noise, builder, blocks, parts, choices)


def _data_of_factors(experiment: Experiment, clock: Stopwatch, bars: Progress) -> CompressedData:
    """The logs of an experiment that fits factors of logs."""
    with clock("read"):
        reading = bars.add_task("reading factors", total=len(experiment.config.logs.train))
        fleet = read_fleet(experiment, lambda _: bars.advance(reading))
        require_base(fleet.states, experiment.config.sensors.on_base_lost, experiment.contacts)
        logs, _ = _read(fleet.experiment, bars)
    with clock("compress"):
        builder = fleet.experiment.builder(fleet.experiment.sensors)
        blocks = fold_compressed([one.log for one in fleet.files], builder)
        parts = [part for block in blocks for part in block.parts]
    excluded = {one.log.source: one.excluded for one in fleet.files if one.excluded}
    return CompressedData(
        experiment=fleet.experiment,
        logs=logs,
        factors=fleet.files,
        excluded=excluded,
        states=fleet.states,
        noise=fleet.noise,
        builder=builder,
        blocks=blocks,
        parts=parts,
        choices=Choices(),
    )


def _read(experiment: Experiment, bars: Progress) -> tuple[dict[str, list[Samples]], dict[str, int]]:
    """Logs by use but for those of which there are factors, and how many samples of each were left out as rejected.

    Those that are trained on, or decide when to stop, have every sensor of the set.
    """
    reader, settings = LogReader(experiment), experiment.config.logs
    files = {name: getattr(settings, name) for name in ("train", "validation", "test")}
    if settings.compressed:
        files["train"] = []
    reading = bars.add_task("reading logs", total=sum(map(len, files.values())))
    logs = {
        name: reader.read(paths, None if name == "test" else experiment.sensors, lambda _: bars.advance(reading))
        for name, paths in files.items()
    }
    check_read(logs)
    return logs, reader.excluded
