"""Settings that an experiment leaves to its training logs: filter, base's tilt, friction's sign, delay, ridge."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.progress import Progress

from torchid import distributed
from torchid.commands.check import recorded_segments
from torchid.errors import InputError, TorchidWarning, join_names
from torchid.estimators import Conditions
from torchid.fitting.experiment import Experiment, RobotSetup, S, with_radius
from torchid.fitting.fit import LogFitter
from torchid.fitting.left_out import (
    TERMS,
    Reading,
    RidgeChoice,
    TermsChoice,
    block_edges,
    choose_terms,
    compress_reading,
    thinned,
    with_terms,
)
from torchid.fitting.noise import force_gain, recorded_sensors
from torchid.fitting.profile import (
    Profile,
    choose_base_tilt,
    choose_data,
    choose_delay,
    choose_radius,
    choose_sign_width,
    choose_stribeck,
)
from torchid.log_checks.readings import new_poses
from torchid.logs import Log
from torchid.logs.cutoff import CutoffChoice, choose_cutoff
from torchid.logs.low_pass import DROPPED_PERIODS
from torchid.logs.read import files_of_recordings_kept
from torchid.logs.timeline import LOSSLESS_RATE
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.compression import Block, Part, compress_parts
from torchid.reading.log_reader import LogReader, memory_needed
from torchid.sensing import SensorSet
from torchid.settings import AUTO

Chosen = TypeVar("Chosen")

MARGINS = (None, 0.03, 0.06)
"""Times around changes of contact without which fits are tried [s]."""

MOST_TRIED = 20_000
"""Samples of a log that settings are chosen with."""

_OCTAVES = 8  # of cutoffs that are tried
_LOWEST_HZ = 2.5  # of these: nobody moves slower to be identified
_PERIODS = 12.0 * DROPPED_PERIODS  # of a cutoff in the shortest log, at least: of a fourth held back a third is left


@dataclass(frozen=True)
class SampleRates:
    """Sample rates of preprocessed logs [Hz], by file."""

    rates_hz: dict[str, float]

    def __str__(self) -> str:
        rates = dict.fromkeys(f"{rate:.4g} Hz" for rate in self.rates_hz.values())
        return f"{join_names(list(rates))}: every k-th sample, at least {LOSSLESS_RATE:g} times the cutoff"


@dataclass
class Choices:
    """How settings were chosen, in the order in which they are; None for what the experiment states."""

    cutoff: CutoffChoice | None = None
    radius: Profile | None = None
    contact_margin: Profile | None = None
    stiction: Profile | None = None
    base_tilt: Profile | None = None
    sign_width: Profile | None = None
    terms: TermsChoice | None = None
    delay: Profile | None = None
    stribeck: Profile | None = None
    sample_rate: SampleRates | None = None

    @property
    def adopted_terms(self) -> list[str]:
        """Kinds of extra parameters that the logs have added."""
        return [] if self.terms is None else [*self.terms.adopted]

    @property
    def adopted(self) -> str:
        """What the logs have added to the model, and what nearly, in one line; "" for nothing."""
        named = [] if self.terms is None else [str(self.terms)]
        if self.stiction is not None and self.stiction.value:
            named.append("samples at rest are left out")
        if self.sign_width is not None and self.sign_width.value is not None:
            named.append(f"Coulomb friction follows tanh(velocity / {self.sign_width.value:.2g} rad/s)")
        if self.delay is not None and self.delay.value:
            named.append(f"torques act {1e3 * self.delay.value:.3g} ms late")
        return "; ".join(text for text in named if text != "none")

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
    """
    if setup.config.logs is None or setup.config.logs.compressed:
        return setup, Choices()
    choices = Choices()
    trials = _Trials()
    setup = _with_chosen_data(setup, choices, trials, bars)
    setup = _with_chosen_terms(setup, choices, trials, bars)
    return _with_actuators(setup, **setup.config.actuators.known), choices


def _with_chosen_data(setup: S, choices: Choices, trials: _Trials, bars: Progress) -> S:
    """The setup with the band and the samples that are fitted, and the tilt of the base."""
    finds_cutoff = setup.config.preprocessing.cutoff_hz == AUTO
    shortest = 0.0
    if finds_cutoff:
        choices.cutoff, shortest = _chosen("cutoff", partial(_cutoff_of_motion, setup), bars)
        setup = _with_preprocessing(setup, cutoff_hz=choices.cutoff.cutoff_hz)
    if setup.open_radii:
        choices.radius = _chosen("radius of feet", partial(_radius, setup, trials), bars)
        setup = setup if choices.radius.value is None else with_radius(setup, choices.radius.value)
    actuators = setup.config.actuators
    if actuators.stiction == AUTO and actuators.stribeck is None and trials.measures_torques(setup):
        by_value = {value: _with_actuators(setup, stiction=value) for value in (False, True)}
        choices.stiction = _chosen("samples at rest", partial(_data, by_value, trials), bars)
        setup = _with_actuators(setup, stiction=bool(choices.stiction.value))
    if setup.config.preprocessing.contact_margin_s == AUTO:
        margins = {margin: _with_preprocessing(setup, contact_margin_s=margin) for margin in MARGINS}
        choices.contact_margin = _chosen("margin of contacts", partial(_data, margins, trials), bars)
        setup = _with_preprocessing(setup, contact_margin_s=choices.contact_margin.value)
    if finds_cutoff and choices.cutoff is not None and choices.cutoff.cutoff_hz is not None:
        choices.cutoff = _chosen("cutoff", partial(_cutoff, setup, trials, choices.cutoff, shortest), bars)
        setup = _with_preprocessing(setup, cutoff_hz=choices.cutoff.cutoff_hz)
    if setup.config.robot.base_tilt == AUTO:
        choices.base_tilt = _chosen("base tilt", lambda: choose_base_tilt(*trials.whole(setup)), bars)
        tilt = choices.base_tilt.value
        config = replace(setup.config, robot=replace(setup.config.robot, base_tilt=tilt))
        setup = replace(setup, robot=replace(setup.robot, base_tilt=tilt), config=config)
    return setup


def _with_chosen_terms(setup: S, choices: Choices, trials: _Trials, bars: Progress) -> S:
    """The setup with the terms of actuators that are fitted, and their numbers."""
    if setup.config.actuators.sign_width == AUTO and setup.config.estimator.friction and trials.measures_torques(setup):
        widths = partial(_with_actuators, setup)
        choices.sign_width = _chosen(
            "sign width",
            lambda: choose_sign_width(lambda width: trials.reading(widths(sign_width=width)), trials.kinds(setup)),
            bars,
        )
        setup = _with_actuators(setup, sign_width=choices.sign_width.value)
    if candidates := trials.candidates(setup):
        choices.terms = _chosen("terms of actuators", partial(trials.choose_terms, setup), bars)
        adopted = choices.terms.adopted
        setup = _with_actuators(setup, **{name: name in adopted for name in candidates if name != "delay"})
        if "delay" in adopted:
            choices.delay = _chosen("delay of torques", lambda: choose_delay(*trials.whole(setup), setup.terms), bars)
    if setup.config.actuators.delay == AUTO:
        setup = _with_actuators(setup, delay=choices.delay.value if choices.delay else 0.0)
    if setup.config.actuators.stribeck == AUTO:
        trial = partial(trials.whole, setup)
        choices.stribeck = _chosen(
            "Stribeck velocity", lambda: choose_stribeck(lambda v: trial(stribeck=v), setup.terms), bars
        )
        setup = _with_actuators(setup, stribeck=choices.stribeck.value)
    return setup


def _chosen(name: str, choose: Callable[[], Chosen], bars: Progress) -> Chosen:
    """What the first process chooses."""
    bar = bars.add_task(f"choosing the {name}", total=None)
    choice = distributed.from_first(choose, name)
    bars.update(bar, total=1, completed=1)
    return choice


class _Trials:
    """Readings of the training logs with different settings, in the same blocks."""

    def __init__(self) -> None:
        self._recorded: dict[Path, Log] = {}
        self._edges: dict[str, Array] | None = None
        self._noise: Mapping[str, Any] | None = None  # of the last reading that estimated it

    @staticmethod
    def measures_torques(setup: RobotSetup) -> bool:
        """Whether any joint's torque is measured."""
        return not isinstance(setup, Experiment) or bool(setup.sensors.torque[: setup.robot.n].any())

    def candidates(self, setup: RobotSetup) -> list[str]:
        """Terms that the logs are to choose."""
        config = setup.config
        if not self.measures_torques(setup):
            return []
        auto = [name for name in TERMS if getattr(config.actuators, name) == AUTO]
        unfit = {"torque_offset"} if "joint_torque" in config.sensors.offsets else set[str]()
        if config.preprocessing.filter_hz is None or any(
            map(_is_large(setup), config.logs.train if config.logs else ())
        ):
            unfit.add("delay")
        return [name for name in auto if name not in unfit]

    def kinds(self, setup: RobotSetup) -> list[str]:
        """Kinds of all extra parameters of a trial: those that are stated, and the candidates."""
        stated = [name for name, x in setup.config.actuators.known.items() if x is True]
        stated += ["scale"] if setup.terms.scales else []
        return [*stated, "stribeck", "offset", *self.candidates(setup)]

    def reading(self, setup: RobotSetup, estimate_noise: bool = False) -> Reading:
        """The logs with all terms that are stated or may be chosen. Raises InputError: as `LogReader.read`."""
        names = self.candidates(setup)
        setup = _with_actuators(setup, **{name: True for name in names if name != "delay"})
        logs, fitter = self.logs_and_fitter(setup, estimate_noise)
        self._edges = self._edges or block_edges(logs)
        terms = replace(setup.terms, slope="delay" in names)
        gain = setup.config.sensors.gain_error
        if gain and self.measures_torques(setup) and "joint_torque" not in terms.scales:
            terms = replace(terms, scales={**terms.scales, "joint_torque": "all"})
        else:
            gain = 0.0
        return compress_reading(logs, self._edges, with_terms(fitter, terms), gain)

    def logs_and_fitter(self, setup: RobotSetup, estimate_noise: bool = False) -> tuple[list[Samples], LogFitter]:
        """Some samples of the logs, and a fitter of their rows, weighted with noise that may be of a reading before."""
        logs, sensors = self._read(setup)
        logs = thinned(logs)
        if estimate_noise or self._noise is None:
            self._noise = setup.estimate_noise(logs, sensors, suggest=False).known
        setup = replace(setup, estimated_noise=self._noise)
        builder = setup.builder(replace(sensors, noise=setup.noise))
        return logs, setup.fitter(builder, Conditions(names=setup.robot.body_names))

    def whole(self, setup: RobotSetup, **actuators: Any) -> tuple[list[Samples], LogFitter]:
        """All samples, and a fitter of their rows as they are weighted now, with these settings of actuators."""
        setup = _with_actuators(setup, **actuators)
        logs, sensors = self._read(setup)
        return logs, setup.fitter(setup.builder(sensors), Conditions(names=setup.robot.body_names))

    def _read(self, setup: RobotSetup) -> tuple[list[Samples], SensorSet]:
        """The logs and the sensors of their rows, all that were recorded where the setup states none."""
        sensors = setup.sensors if isinstance(setup, Experiment) else None
        files = setup.config.logs
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", TorchidWarning)  # said where the logs are read for the fit
            logs = _TrialReader(setup, self._recorded).read(files.train if files else [], sensors)
        return logs, sensors or recorded_sensors(setup.robot, setup.contacts, logs, setup.noise)

    def choose_terms(self, setup: RobotSetup) -> TermsChoice:
        """Terms of actuators by the error on left-out blocks."""
        fixed = [kind for kind in self.kinds(setup) if kind not in (names := self.candidates(setup))]
        return choose_terms(self.reading(setup), names, fixed)


def needs_these_torques(setup: RobotSetup) -> bool:
    """Whether the bodies of the robot's file need about the forces of the logs; False for logs that cannot be read."""
    try:
        setup = _with_actuators(setup, **setup.config.actuators.without_terms())
        setup = _with_preprocessing(setup, cutoff_hz=_cutoff_of_motion(setup)[0].cutoff_hz, contact_margin_s=None)
        logs, fitter = _Trials().logs_and_fitter(setup)
        gain = force_gain(fitter.build_problem(compress_parts(logs, fitter.builder)).assembly.problem)
    except InputError:
        return False
    return is_near_nominal(gain)


def lower_cutoff(setup: RobotSetup) -> CutoffChoice | None:
    """The band that a fit predicts, None where it is not narrower than the one that is fitted, or not known."""
    files = setup.config.logs
    cutoff = setup.config.preprocessing.filter_hz
    if files is None or files.compressed or cutoff is None:
        return None
    with suppress(InputError):
        lower = _cutoff(setup, _Trials(), CutoffChoice(cutoff, by_noise=False), _cutoff_of_motion(setup)[1])
        return None if lower.limit_hz is None else lower
    return None


def is_near_nominal(gain: float | None) -> bool:
    """Whether a factor of forces, None for none that is clear, is one of another mass, gear or current: up to three."""
    return gain is not None and 1.0 / _LARGEST_GAIN < gain < _LARGEST_GAIN


_LARGEST_GAIN = 3.0


class _TrialReader(LogReader):
    """Reads logs once for all settings, of those larger than `MOST_TRIED` samples the middle."""

    def __init__(self, setup: RobotSetup, recorded: dict[Path, Log]) -> None:
        super().__init__(setup)
        self._kept = recorded

    def _size_gb(self, path: Path) -> float:
        return 0.0

    def _recorded(self, path: Path) -> Log:
        files = self.setup.config.logs
        if path not in self._kept and files is not None:
            if _is_large(self.setup)(path):
                settings = self.setup.config.preprocessing
                log = next(recorded_segments(path, files, settings, settings.exclude_rejected)).log
            else:
                log = super()._recorded(path)
            excess = max(len(log) - MOST_TRIED, 0)
            self._kept[path] = log.select(slice(excess // 2, len(log) - excess + excess // 2)) if excess else log
        return self._kept[path]


def _is_large(setup: RobotSetup) -> Callable[[Path], bool]:
    """Whether a log is larger than the memory that it may take."""
    limit = setup.config.preprocessing.memory_gb
    return lambda path: memory_needed(path, limit) > limit


def with_sample_rates(choices: Choices, setup: RobotSetup, logs: Sequence[Samples]) -> Choices:
    """The choices with what `preprocessing.sample_rate_hz: auto` has made of logs, if they were read so."""
    if setup.config.preprocessing.sample_rate_hz != AUTO:
        return choices
    rates = {log.source: 1.0 / float(np.median(np.diff(log.time.numpy()))) for log in logs if len(log) > 1}
    return replace(choices, sample_rate=SampleRates(rates))


def _cutoff(setup: RobotSetup, trials: _Trials, limit: CutoffChoice, shortest: float) -> CutoffChoice:
    """The widest band that the model predicts, up to a limit; `shortest`: how long the shortest log is [s]."""
    widest_hz = setup.config.preprocessing.filter_hz or 0.0
    lowest_hz = max(_LOWEST_HZ, _PERIODS / shortest)
    tried = [widest_hz / 2**k for k in range(_OCTAVES) if not k or widest_hz / 2**k >= lowest_hz]
    setups = {cutoff: _with_preprocessing(setup, cutoff_hz=cutoff) for cutoff in tried}
    chosen = _data(setups, trials, estimate_noise=True).value
    return limit if chosen == tried[0] else replace(limit, cutoff_hz=float(f"{chosen:.2g}"), limit_hz=limit.cutoff_hz)


def _data(setups: Mapping[Any, RobotSetup], trials: _Trials, estimate_noise: bool = False) -> Profile:
    """What `choose_data` makes of setups that leave ever more samples out, or more of the band."""
    readings = {value: partial(trials.reading, variant, estimate_noise) for value, variant in setups.items()}
    return choose_data(readings, trials.kinds(next(iter(setups.values()))))


def _radius(setup: RobotSetup, trials: _Trials) -> Profile:
    def read(radius: float | None) -> Reading:
        return trials.reading(setup if radius is None else with_radius(setup, radius))

    choice = choose_radius(read, trials.kinds(setup))
    if choice.value is not None:
        trials.reading(with_radius(setup, choice.value), estimate_noise=True)  # which other choices are made with
    return choice


def _cutoff_of_motion(setup: RobotSetup) -> tuple[CutoffChoice, float]:
    """By the middle of each training log, and how long the shortest of them is [s]."""
    settings = setup.config.preprocessing
    files = setup.config.logs
    if files is None:
        return CutoffChoice(None, by_noise=False), 0.0
    with files_of_recordings_kept():
        logs = [next(recorded_segments(path, files, settings)).log for path in files.train]
    from_feet = settings.base_motion is not None
    rate = None if settings.sample_rate_hz == AUTO else settings.sample_rate_hz
    shortest = min(float(log.time[-1] - log.time[0]) for log in logs)
    logs = [new_poses(log) for log in logs]  # whose rate bounds the band, not that of a file which repeats them
    return choose_cutoff(logs, setup.config.sensors.noise.motion, rate, base_is_derived=from_feet), shortest


def _with_preprocessing(setup: S, **stated: Any) -> S:
    config = setup.config
    return replace(setup, config=replace(config, preprocessing=replace(config.preprocessing, **stated)))


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
