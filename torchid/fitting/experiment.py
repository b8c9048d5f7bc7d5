"""Robot, contacts, sensors, estimator and conditions of an experiment file, which all commands share."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch

from torchid import distributed
from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.estimator import EstimatorConfig
from torchid.config.robot import ChoiceConfig, require_kind
from torchid.errors import ConfigError, LogError, TorchidWarning, UnknownNameError, join_names
from torchid.estimators import Conditions, Consistent, LeastSquares
from torchid.fitting.calibration import Calibration, Comparison, calibrations
from torchid.fitting.checked_settings import (
    check_scale_groups,
    check_terms,
    require_maps_of,
    resolve_contacts,
    stated_noise,
    suited_to_preprocessing,
    task_weights,
    with_scalar_sensors,
)
from torchid.fitting.cross_validation import RIDGES, STRONGER, RidgeChoice, choose_ridge
from torchid.fitting.fit import Fit, LogFitter, frozen_parameters
from torchid.fitting.left_out import RIDGE
from torchid.fitting.noise import NoiseSummary, estimate_noise, mean_noise_square, recorded_sensors
from torchid.fitting.prior_knowledge import conditions_from, known_masses
from torchid.fitting.robust import RobustLoss
from torchid.log_checks.model import Declared
from torchid.problem import Evaluation, ExtraTerms, RowBuilder, Samples
from torchid.problem.compression import Block, Part, merge_states
from torchid.problem.noise import LogOfOtherProcess
from torchid.reprs import short_repr
from torchid.robot import Robot, load_robot
from torchid.robot.constraints import matching_joints
from torchid.robot.tree import FT_FIELD
from torchid.sensing import Contact, SensorNoise, SensorSet, chosen_sensors, named_sensors, with_ft_sensors
from torchid.settings import AUTO


@dataclass(frozen=True, kw_only=True)
class RobotSetup:
    """Robot and contacts of an experiment file, with its settings.

    Attributes:
        config: the settings.
        robot: the robot.
        contacts: the contacts in use.
        rolling: what the contacts that roll roll on, and where that is stated, "" if none does.
        open_radii: frames of points whose radius the settings leave open.
        estimated_noise: by field of `SensorNoise`, what logs show of the noise that is not stated (`with_noise`).
        noise_stated: whether a user has stated any noise of the forces, once others are estimated.
    """

    config: ExperimentConfig | AnalyzeConfig
    robot: Robot
    contacts: tuple[Contact, ...]
    rolling: str = ""
    open_radii: frozenset[str] = frozenset()
    estimated_noise: Mapping[str, Any] = field(default_factory=dict)
    noise_stated: bool = True

    __repr__ = short_repr

    @property
    def noise(self) -> SensorNoise:
        """Noise of the sensors, as stated or estimated; a guess where it is neither.

        Raises:
            InputError: as `stated_noise`.
        """
        return SensorNoise(**{**self.estimated_noise, **stated_noise(self.config.sensors.noise, self.robot)})

    @property
    def noise_of_readings(self) -> SensorNoise | None:
        """The noise of readings as recorded, NaN where it is unknown; None where it is not stated of any sensor.

        Noise that was estimated beside a stated one is in proportion to it. Without any, it comes from the residuals
        themselves, which it could not judge.
        """
        stated = stated_noise(self.config.sensors.noise, self.robot)
        known = {**self.estimated_noise, **stated} if self.noise_stated else stated
        return SensorNoise.of_known(known) if known else None

    @property
    def terms(self) -> ExtraTerms:
        """Extra parameters of sensors and actuators."""
        sensors = self.config.sensors
        offsets = {str(channel): scope for channel, scope in sensors.offsets.items()}
        scales = {str(channel): scope for channel, scope in sensors.scales.items()}
        known = self.config.actuators.known
        terms = {name: x for name, x in known.items() if name not in ("delay", "stiction")}  # logs are read with both
        return ExtraTerms(offsets, scales, **terms)

    @property
    def declared(self) -> Declared:
        """What the settings say of sensors and actuators, for checks of the logs.

        Raises:
            InputError: as `stated_noise`.
        """
        stated = stated_noise(self.config.sensors.noise, self.robot)
        delay, finds_tilt = self.config.actuators.delay or 0.0, self.config.robot.base_tilt == AUTO
        noise = SensorNoise.of_known(stated) if stated else None
        return Declared(noise, self.terms, delay, finds_tilt, self.config.sensors.on_base_lost == "warn")

    @property
    def loss(self) -> RobustLoss | None:
        """Loss of a robust fit, None for least squares."""
        robust = self.config.estimator.robust
        return None if robust is None else RobustLoss.named(robust.loss, robust.tuning, robust.passes)

    def sensors_of(self, choice: ChoiceConfig) -> SensorSet:
        """The sensors of a choice. Raises InputError: names that do not fit the robot."""
        robot, contacts, noise, ft = self.robot, self.contacts, self.noise, len(self.robot.ft_names)
        if choice.set is not None:
            sensors = named_sensors(choice.set, robot.n, len(contacts), noise, ft)
        else:
            field, joints = "sensors.joint_torques", robot.joint_names
            torques = [name for key in choice.joint_torques for name in matching_joints(field, key, joints)]
            sensors = chosen_sensors(joints, contacts, torques, choice.contact_wrenches, noise, ft)
        measured = with_ft_sensors(sensors, robot, choice.ft_sensors)
        return replace(measured, torque=measured.torque | robot.is_passive)  # known: 0

    def builder(self, sensors: SensorSet) -> RowBuilder:
        """Builder of the rows of some sensors, on the device of the settings."""
        return RowBuilder(self.robot, self.contacts, sensors, self.terms).to(self.config.device)

    def evaluation(self, noise: SensorNoise | None = None) -> Evaluation:
        """Evaluation of predicted forces, on the device of the settings; `noise` to compare their errors with."""
        return Evaluation(self.robot, self.contacts, self.config.device, self.terms, noise)

    def conditions(self) -> Conditions:
        """Conditions on the parameters.

        Raises:
            InputError: as `conditions_from`.

        Warns:
            TorchidWarning: as `conditions_from`.
        """
        return conditions_from(self.config.estimator, self.robot)

    def frozen(self) -> np.ndarray:
        """Parameters of frozen bodies, (12 L,) bool.

        Raises:
            UnknownNameError: a frozen body that the robot does not have.
        """
        return frozen_parameters(self.robot, self.config.estimator.frozen, "estimator.frozen")

    def fitter(self, builder: RowBuilder, conditions: Conditions) -> LogFitter:
        """Fitter of logs with the estimator of the settings; for a descent, the batch estimator that it approaches.

        Raises:
            InputError: a frozen body that the robot does not have, or an estimator that is not installed.
        """
        settings = self.config.estimator
        return LogFitter(
            robot=self.robot,
            builder=builder,
            estimator=batch_estimator(settings, conditions),
            friction=settings.friction,
            frozen=self.frozen(),
            masses=known_masses(settings, self.robot),
        )

    def calibrations(self, fit: Fit, builder: RowBuilder) -> Comparison[Calibration]:
        """Nominal and identified parameters of a fit, with the extra parameters that fit them best."""
        return calibrations(fit, self.robot, builder, self.loss)

    def estimate_noise(
        self,
        logs: Sequence[Samples | LogOfOtherProcess],
        sensors: SensorSet | None = None,
        suggest: bool = True,
    ) -> NoiseSummary:
        """The noise that bound logs show of some sensors, or of all that those here have; what is stated is kept.

        `suggest`: as `estimate_noise` takes it.
        """
        if sensors is None:
            here = [log for log in logs if isinstance(log, Samples)]
            sensors = recorded_sensors(self.robot, self.contacts, here, self.noise)
        # without conditions: of the estimator, only the ridge and the rank tolerance matter
        fitter = self.fitter(self.builder(sensors), Conditions(names=self.robot.body_names))
        return estimate_noise(logs, fitter, self.config.sensors.noise.forces.keys(), suggest)

    def choose_ridge(
        self, parts: Sequence[Part], blocks: Sequence[Block], fitter: LogFitter, conditions: Conditions
    ) -> RidgeChoice:
        """The ridge by the size of the residuals, or by one standard error, for the estimator of the settings.

        Bodies are off the URDF by a relative error of about 20 to 30 %, and residuals are no white noise: what the
        model lacks does not average out. A ridge of `RIDGE` times the mean squared residual says both, whatever
        the length of the log; larger ones are taken where left-out blocks ask for them.

        Args:
            parts: of the blocks, compressed.
            blocks: training logs, as `split_into_folds` or `fold_compressed` cuts them.
            fitter: of their rows.
            conditions: on the parameters.

        Raises:
            ConfigError: too few samples to leave some out.
        """
        settings, ridges = self.config.estimator, RIDGES
        if settings.ridge == AUTO:
            plain = LeastSquares(rank_tolerance=settings.rank_tolerance)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TorchidWarning)  # the fit says the same
                problem = fitter.build_problem(merge_states(parts, fitter.builder)).assembly.problem
                left = plain.solve(problem).residual_std
            ridges = tuple(float(f"{max(RIDGE * left**2, RIDGES[0]) * factor:.2g}") for factor in STRONGER)
            if len({part.fold for part in parts}) < 2:
                return RidgeChoice(ridges[0], ridges[:1], (left**2,), (0.0,))
        estimators = [batch_estimator(replace(settings, ridge=ridge), conditions) for ridge in ridges]
        try:
            return choose_ridge(parts, blocks, fitter, estimators, self.loss, rule=settings.ridge_rule)
        except LogError as error:
            accepted = "a number, 0.001 say, or longer logs"
            raise ConfigError.at_field("estimator.ridge", f"{settings.ridge}, but {error.found}", accepted) from error


@dataclass(frozen=True, kw_only=True, repr=False)
class Experiment(RobotSetup):
    """A setup with the sensors of its fit."""

    config: ExperimentConfig
    sensors: SensorSet


S = TypeVar("S", bound=RobotSetup)


def with_noise(setup: S, summary: NoiseSummary) -> S:
    """The setup with estimated noise beside what its settings state, so that every later step uses it."""
    return with_estimated_noise(setup, summary.known, summary.any_stated)


def with_estimated_noise(setup: S, estimated: Mapping[str, Any], any_stated: bool) -> S:
    """As `with_noise`, by field of `SensorNoise`; `any_stated`: of the noise of what the sensors read."""
    known = replace(setup, estimated_noise=estimated, noise_stated=any_stated)
    if isinstance(known, Experiment):
        return replace(known, sensors=replace(known.sensors, noise=known.noise))
    return known


def with_radius(setup: S, radius: float) -> S:
    """The setup whose feet of open radius are balls about their frames [m]."""
    contacts = tuple(
        replace(x, radius=radius, centre=(0.0, 0.0, 0.0)) if x.frame in setup.open_radii else x for x in setup.contacts
    )
    stated = [
        replace(x, radius=radius, centre=[0.0] * 3) if x.frame in setup.open_radii else x for x in setup.config.contacts
    ]
    text = f"{join_names(sorted(setup.open_radii))}: ball of radius {1e3 * radius:.3g} mm, by the logs"
    return replace(setup, contacts=contacts, config=replace(setup.config, contacts=stated), rolling=text)


def with_task_weights(experiment: Experiment, logs: Sequence[Samples]) -> Experiment:
    """The experiment, its rows weighted by control task too, by a factor at which noise alone leaves them 1."""
    weights = task_weights(experiment.config.estimator.task_weights, experiment.robot)
    if weights is None:
        return experiment
    sensors = replace(experiment.sensors, task_weights=weights)
    size = distributed.from_first(lambda: mean_noise_square(logs, experiment.builder(sensors)), "task weights")
    return replace(experiment, sensors=replace(sensors, task_weights=weights / np.sqrt(size)))


def require_device(device: str) -> None:
    """Refuse a device that this machine has not; it is not connected to: forks, which read logs, could not be made."""
    kind, _, index = device.partition(":")
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    is_there = kind == "cuda" and (index or "0").isdecimal() and int(index or "0") < gpus
    if device != "cpu" and not is_there:
        raise ConfigError.at_field("device", f"'{device}' is not available here", "cpu, cuda, cuda:0, ...")


def set_up_robot(config: ExperimentConfig | AnalyzeConfig) -> RobotSetup:
    """Load the robot of an experiment file and look its contacts up.

    Raises:
        InputError: whatever in the file does not fit the robot.
    """
    require_device(config.device)
    try:
        of = config.robot
        require_kind(of)
        loops, joints = [loop.loop for loop in of.loops], _ft_joints(config)
        total = None if (mass := config.estimator.total_mass) is None else mass.value
        robot = load_robot(of.path, of.base_link, of.fixed_base, joints, of.weld, of.tilt, loops, of.passive, total)
    except UnknownNameError as error:
        if error.field != FT_FIELD:
            raise
        field = _ft_field(config, error.name)
        raise UnknownNameError.at_field(field, error.name, error.valid, error.what) from error
    if not robot.nv:
        raise ConfigError.at_field("robot", "a fixed base without a joint, which never moves", "a robot that can move")
    if config.logs is not None:
        require_maps_of(robot, config.logs)
    contacts, rolling = resolve_contacts(config.contacts, robot)
    contacts = suited_to_preprocessing(with_scalar_sensors(contacts, config.sensors), config, robot)
    stated = [
        replace(c, radius=contact.radius, centre=list(contact.centre) if any(contact.centre) else c.centre)
        for c, contact in zip(config.contacts, contacts, strict=True)
    ]
    open_radii = frozenset(c.frame for c in config.contacts if c.type == "point" and c.radius == AUTO)
    config = replace(config, contacts=stated)
    setup = RobotSetup(config=config, robot=robot, contacts=contacts, rolling=rolling, open_radii=open_radii)
    check_scale_groups(setup.terms, robot, contacts)
    stated_noise(config.sensors.noise, robot)
    return setup


def set_up(config: ExperimentConfig) -> Experiment:
    """As `set_up_robot`, with sensors resolved by name.

    Raises:
        InputError: whatever in the file does not fit the robot, or extra parameters of sensors that are not among the
            measured.
    """
    setup = set_up_robot(config)
    sensors = setup.sensors_of(config.sensors)
    config = replace(config, contacts=setup.config.contacts)
    task_weights(config.estimator.task_weights, setup.robot)  # wrong names are told before logs are read
    experiment = Experiment(**vars(setup) | {"config": config}, sensors=sensors)
    check_terms(experiment.terms, config.actuators, setup.robot, setup.contacts, sensors)
    return experiment


def _ft_joints(config: ExperimentConfig | AnalyzeConfig) -> list[str]:
    """Fixed joints that carry a force/torque sensor in some sensor set of the file, or could in one to be planned."""
    choices = [config.sensors, *config.analysis.compare.values()]
    planned = config.analysis.candidates.ft_sensors if isinstance(config, AnalyzeConfig) else []
    return list(dict.fromkeys([*(name for choice in choices for name in choice.ft_sensors), *planned]))


def _ft_field(config: ExperimentConfig | AnalyzeConfig, name: str) -> str:
    """Where a file names a fixed joint."""
    choices = {"sensors": config.sensors} | {f"analysis.compare.{key}": x for key, x in config.analysis.compare.items()}
    named = (f"{key}.ft_sensors" for key, choice in choices.items() if name in choice.ft_sensors)
    return next(named, "analysis.candidates.ft_sensors")


def batch_estimator(settings: EstimatorConfig, conditions: Conditions) -> LeastSquares | Consistent:
    """What solves a compressed problem in one go; for a descent, what it approaches with the same ridge.

    Penalties of a descent are not part of it.

    Args:
        settings: of the estimator.
        conditions: from `conditions_from`.
    """
    if settings.name == "least_squares":
        return settings.least_squares
    if settings.name == "sgd" and (settings.consistency == "penalties" or not settings.numeric_ridge):
        return settings.least_squares
    return settings.consistent(conditions)
