"""Settings that an experiment leaves to its training logs: filter, base's tilt, friction's sign, delay, ridge."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from rich.progress import Progress

from torchid import distributed
from torchid.commands.check import recorded_segments
from torchid.errors import TorchidWarning, about_file, join_names, warn_about_file
from torchid.estimators import Conditions
from torchid.fitting.cross_validation import RidgeChoice
from torchid.fitting.delay import DelayChoice, choose_delay
from torchid.fitting.experiment import Experiment, RobotSetup, S
from torchid.fitting.fit import LogFitter
from torchid.fitting.noise import recorded_sensors
from torchid.fitting.separable import (
    SignWidthChoice,
    StribeckChoice,
    TiltChoice,
    choose_base_tilt,
    choose_sign_width,
    choose_stribeck,
)
from torchid.logs import Log
from torchid.logs.cutoff import CutoffChoice, choose_cutoff
from torchid.logs.dry_friction import dry_friction_by_setting, with_sign_filter
from torchid.logs.log import FloatArray
from torchid.logs.preprocess import lacks_derivatives, make_timeline
from torchid.logs.read import files_of_recordings_kept
from torchid.logs.signal_noise import SignalNoise
from torchid.logs.timeline import LOSSLESS_RATE
from torchid.problem import ExtraTerms, RowBuilder, Samples
from torchid.problem.compressed_log import Block
from torchid.problem.log_joints import columns_in_order, joint_order
from torchid.problem.parts import Part
from torchid.reading.log_reader import LogReader
from torchid.sensing import SensorSet
from torchid.settings import AUTO

Chosen = TypeVar("Chosen")
_UNFILTERED = (
    "actuators.delay: auto without a filter: noise between samples is smaller than at them, which draws the delay to "
    "half a step; accepted: a preprocessing.cutoff_hz, or auto"
)


@dataclass(frozen=True)
class SampleRates:
    """Sample rates of preprocessed logs [Hz], by file."""

    rates_hz: dict[str, float]

    def __str__(self) -> str:
        rates = dict.fromkeys(f"{rate:.4g} Hz" for rate in self.rates_hz.values())
        return f"{join_names(list(rates))}: every k-th sample at {LOSSLESS_RATE:g} cutoffs or more"


@dataclass(frozen=True)
class Choices:
    """How settings were chosen, in the order in which they are; None for what the experiment states."""

    cutoff: CutoffChoice | None = None
    base_tilt: TiltChoice | None = None
    sign_width: SignWidthChoice | None = None
    delay: DelayChoice | None = None
    stribeck: StribeckChoice | None = None
    sample_rate: SampleRates | None = None

    def by_name(self) -> dict[str, object]:
        """The same by name, in words."""
        return {name.replace("_", " "): choice for name, choice in vars(self).items()}


def with_chosen_settings(setup: S, bars: Progress) -> tuple[S, Choices]:
    """The setup with numbers, or none, where its settings leave them to the training logs, and how they were chosen.

    Args:
        setup: with logs to fit on; without sensors, all that were recorded count.
        bars: shows that this goes on.

    Raises:
        InputError: logs that cannot be read, or lack what is needed.

    Warns:
        TorchidWarning: a delay is to be found in logs that are not filtered.
    """
    if setup.config.logs is None:
        return setup, Choices()
    cutoff = tilt = width = delay = stribeck = None
    if setup.config.preprocessing.cutoff_hz == AUTO:
        cutoff = _chosen("cutoff", partial(_cutoff, setup), bars)
        settings = replace(setup.config.preprocessing, cutoff_hz=cutoff.cutoff_hz)
        setup = replace(setup, config=replace(setup.config, preprocessing=settings))
    if setup.config.robot.base_tilt == AUTO:
        tilt = _chosen("base tilt", partial(_base_tilt, setup), bars)
        stated = replace(setup.config.robot, base_tilt=tilt.tilt)
        robot = replace(setup.robot, base_tilt=tilt.tilt)
        setup = replace(setup, robot=robot, config=replace(setup.config, robot=stated))
    reader = WidthReader(setup)
    if setup.config.actuators.sign_width == AUTO:
        width = _chosen("sign width", partial(choose_sign_width, partial(_logs_of, setup, reader, "sign_width")), bars)
        setup = _with_actuators(setup, sign_width=width.width)
    if setup.config.actuators.delay == AUTO:
        if cutoff is None and setup.config.preprocessing.cutoff_hz is None:
            warn_about_file(_UNFILTERED)
        delay = _chosen("delay of torques", partial(_delay, setup, reader), bars)
        setup = _with_actuators(setup, delay=delay.delay)
    if setup.config.actuators.stribeck == AUTO:
        reader = WidthReader(setup) if setup.config.actuators.known_delay and delay else reader
        stribeck = _chosen("Stribeck velocity", partial(_stribeck, setup, reader), bars)
        setup = _with_actuators(setup, stribeck=stribeck.velocity)
    return setup, Choices(cutoff, tilt, width, delay, stribeck)


def with_sample_rates(choices: Choices, setup: RobotSetup, logs: Sequence[Samples]) -> Choices:
    """The choices with what `preprocessing.sample_rate_hz: auto` has made of logs, if they were read so."""
    if setup.config.preprocessing.sample_rate_hz != AUTO:
        return choices
    rates = {log.source: 1.0 / float(np.median(np.diff(log.time.numpy()))) for log in logs if len(log) > 1}
    return replace(choices, sample_rate=SampleRates(rates))


def _chosen(name: str, choose: Callable[[], Chosen], bars: Progress) -> Chosen:
    """What the first process chooses."""
    bar = bars.add_task(f"choosing the {name}", total=None)
    choice = distributed.from_first(choose, name)
    bars.update(bar, total=1, completed=1)
    return choice


def _cutoff(setup: RobotSetup) -> CutoffChoice:
    """By the middle of each training log."""
    settings, files = setup.config.preprocessing, setup.config.logs
    if files is None:
        return CutoffChoice(None, by_noise=False)
    with files_of_recordings_kept():
        logs = [next(recorded_segments(path, files, settings)).log for path in files.train]
    stated, from_feet = setup.config.sensors.noise.motion, settings.base_motion is not None
    rate = None if settings.sample_rate_hz == AUTO else settings.sample_rate_hz
    return choose_cutoff(logs, stated, rate, base_is_derived=from_feet)


def _base_tilt(setup: RobotSetup) -> TiltChoice:
    return choose_base_tilt(*_logs_and_fitter(setup, WidthReader(setup)))


def _delay(setup: RobotSetup, reader: WidthReader) -> DelayChoice:
    return choose_delay(*_logs_and_fitter(setup, reader), setup.terms)


def _stribeck(setup: RobotSetup, reader: WidthReader) -> StribeckChoice:
    return choose_stribeck(partial(_logs_of, setup, reader, "stribeck"), setup.terms)


def _logs_of(
    setup: RobotSetup, reader: WidthReader, name: str, value: float | None
) -> tuple[Sequence[Samples], LogFitter]:
    """As `_logs_and_fitter`, with a value of one of the settings of actuators."""
    return _logs_and_fitter(_with_actuators(setup, **{name: value}), reader)


def _logs_and_fitter(setup: RobotSetup, reader: WidthReader) -> tuple[Sequence[Samples], LogFitter]:
    """The training logs, and a fitter of their rows."""
    sensors = setup.sensors if isinstance(setup, Experiment) else None
    logs = reader.logs(setup.terms, sensors)
    if sensors is None:
        sensors = recorded_sensors(setup.robot, setup.contacts, logs, setup.noise)
    return logs, setup.fitter(setup.builder(sensors), Conditions(names=setup.robot.body_names))


def _with_actuators(setup: S, **stated: Any) -> S:
    config = setup.config
    return replace(setup, config=replace(config, actuators=replace(config.actuators, **stated)))


def with_ridge(
    experiment: Experiment,
    parts: Sequence[Part],
    blocks: Sequence[Block],
    builder: RowBuilder,
    conditions: Conditions,
    bars: Progress,
) -> tuple[Experiment, RidgeChoice | None]:
    """The experiment with a ridge that is a number, and how it was chosen, if it was."""
    config = experiment.config
    if not config.estimator.chooses_ridge:
        return experiment, None
    bar = bars.add_task("choosing the ridge", total=None)
    fitter = experiment.fitter(builder, conditions)
    choice = distributed.broadcast(experiment.choose_ridge(parts, blocks, fitter, conditions), "ridge")
    bars.update(bar, total=1, completed=1)
    chosen = replace(config, estimator=replace(config.estimator, ridge=choice.ridge))
    return replace(experiment, config=chosen), choice


@dataclass(frozen=True)
class _Directions:
    """What the filter makes of a log's dry friction, by the width of its sign and the Stribeck velocity.

    `stamps`: (K,) of the preprocessed log [s]; `order`: columns of the robot's joints.
    """

    stamps: FloatArray
    order: list[int]
    by_setting: Callable[[float | None, float | None], dict[str, FloatArray]]

    def applied(self, samples: Samples, terms: ExtraTerms) -> Samples:
        """Some of the samples, with those of the terms."""
        at = np.searchsorted(self.stamps, samples.time.numpy())
        fields: dict[str, Any] = {"direction": None, "stribeck": None}
        for name, found in self.by_setting(terms.sign_width, terms.stribeck).items():
            fields[name.removeprefix("joint_")] = torch.from_numpy(columns_in_order(found[at], self.order))
        return replace(samples, **fields)


class WidthReader(LogReader):
    """Reads logs that fit into memory once for all widths and Stribeck velocities.

    Others are read anew for each, since the filter comes after friction.

    So are logs whose base moves as the feet say: they are filtered in segments.
    """

    def __init__(self, setup: RobotSetup) -> None:
        super().__init__(setup)
        self._directions: dict[str, _Directions] = {}
        self._logs: list[Samples] | None = None

    def logs(self, terms: ExtraTerms, required: SensorSet | None) -> list[Samples]:
        """The training logs as `read` gives them with the dry friction of terms; with the same `required` each time."""
        files, actuators = self.setup.config.logs, self.setup.config.actuators
        if self._logs is None or len(self._directions) < len(self._logs):
            own: dict[str, Any] = {"sign_width": terms.sign_width, "stribeck": terms.stribeck}
            config = replace(self.setup.config, actuators=replace(actuators, **own))
            self.setup, self._directions = replace(self.setup, config=config), {}
            self._logs = self.read(files.train if files else [], required)
            return self._logs
        return [self._directions[log.source].applied(log, terms) for log in self._logs]

    def _preprocessed(self, clean: Log) -> Log:
        log, settings = super()._preprocessed(clean), self.setup.config.preprocessing
        if settings.base_motion is None:
            rates = settings.filter_hz, settings.sample_rate_hz
            with about_file(log.source):
                timeline = make_timeline(clean.time, lacks_derivatives(clean), *rates)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TorchidWarning)  # said where the log was read
                filtered = timeline and with_sign_filter(timeline, clean, log.motion_noise or SignalNoise({}))
            by_setting = dry_friction_by_setting(clean, filtered) if filtered else (lambda *_: {})
            self._directions[log.source] = _Directions(log.time, joint_order(log, self.setup.robot), by_setting)
        return log
