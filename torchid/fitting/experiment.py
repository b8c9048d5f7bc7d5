"""Robot, contacts, sensors, estimator and conditions of an experiment file, which all commands share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch

from torchid import parameters
from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.estimator import EstimatorConfig
from torchid.config.robot import require_kind
from torchid.config.sensors import ChoiceConfig
from torchid.errors import ConfigError, LogError, UnknownNameError, warn_about_file
from torchid.estimators import Conditions, Consistent, Enclosure, LeastSquares, Mirror
from torchid.fitting.calibration import Calibration, Comparison, calibrations
from torchid.fitting.checked_settings import check_scale_groups, check_terms, require_maps_of
from torchid.fitting.contacts import resolve_contacts, suited_to_preprocessing, with_scalar_sensors
from torchid.fitting.cross_validation import RIDGES, RidgeChoice, choose_ridge
from torchid.fitting.fit import Fit, LogFitter, frozen_parameters
from torchid.fitting.known_masses import known_masses
from torchid.fitting.noise import NoiseSummary, estimate_noise, recorded_sensors
from torchid.fitting.robust import RobustLoss
from torchid.parameters import PARAMETERS, Array
from torchid.problem import Evaluation, ExtraTerms, RowBuilder, Samples
from torchid.problem.compressed_log import Block
from torchid.problem.compression import Part
from torchid.problem.sampled_rows import LogElsewhere
from torchid.reprs import short_repr
from torchid.robot import Robot, body_extents, load_robot, mirror_pairs
from torchid.robot.tree import FT_FIELD
from torchid.sensing import Contact, SensorNoise, SensorSet, chosen_sensors, named_sensors, with_ft_sensors

_FRICTION = PARAMETERS[parameters.FRICTION]
_POSITIVE = ("m", "Ixx", "Iyy", "Izz")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Robot and contacts of an experiment file, with its settings.

    Attributes:
        config: the settings.
        robot: the robot.
        contacts: the contacts in use.
        rolling: what the contacts that roll roll on, and where that is stated, "" if none does.
        noise_stated: whether a user has stated any noise of the forces, once others are estimated (`with_noise`).
    """

    config: ExperimentConfig | AnalyzeConfig
    robot: Robot
    contacts: tuple[Contact, ...]
    rolling: str = ""
    noise_stated: bool = True

    __repr__ = short_repr

    @property
    def noise(self) -> SensorNoise:
        """Noise of the sensors, as stated; a guess where it is not."""
        return SensorNoise(**self.config.sensors.noise.forces)

    @property
    def terms(self) -> ExtraTerms:
        """Extra parameters of sensors and actuators."""
        sensors = self.config.sensors
        offsets = {str(channel): scope for channel, scope in sensors.offsets.items()}
        scales = {str(channel): scope for channel, scope in sensors.scales.items()}
        actuators = vars(self.config.actuators)
        width = actuators["sign_width"]
        known = {"sign_width": None if width == "auto" else width, "delay": False}  # logs are read with the delay
        return ExtraTerms(offsets, scales, **actuators | known)

    @property
    def loss(self) -> RobustLoss | None:
        """Loss of a robust fit, None for least squares."""
        robust = self.config.estimator.robust
        return None if robust is None else RobustLoss.named(robust.loss, robust.tuning, robust.passes)

    def sensors_of(self, choice: ChoiceConfig) -> SensorSet:
        """The sensors of a choice.

        Raises:
            InputError: names that do not fit the robot.
        """
        robot, contacts, noise, ft = self.robot, self.contacts, self.noise, len(self.robot.ft_names)
        if choice.set is not None:
            sensors = named_sensors(choice.set, robot.n, len(contacts), noise, ft)
        else:
            by_name = choice.joint_torques, choice.contact_wrenches
            sensors = chosen_sensors(robot.joint_names, contacts, *by_name, noise, ft)
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

    def estimate_noise(self, logs: Sequence[Samples | LogElsewhere], sensors: SensorSet | None = None) -> NoiseSummary:
        """The noise that bound logs show of some sensors, or of all that those here have; what is stated is kept."""
        if sensors is None:
            here = [log for log in logs if isinstance(log, Samples)]
            sensors = recorded_sensors(self.robot, self.contacts, here, self.noise)
        # without conditions: of the estimator, only the ridge and the rank tolerance matter
        fitter = self.fitter(self.builder(sensors), Conditions(names=self.robot.body_names))
        return estimate_noise(logs, fitter, self.config.sensors.noise.forces.keys())

    def choose_ridge(
        self, parts: Sequence[Part], blocks: Sequence[Block], fitter: LogFitter, conditions: Conditions
    ) -> RidgeChoice:
        """The ridge that predicts held-out folds best, or by one standard error, for the estimator of the settings.

        Args:
            parts: of the blocks, compressed.
            blocks: training logs, as `split_into_folds` or `fold_compressed` cuts them.
            fitter: of their rows.
            conditions: on the parameters.

        Raises:
            ConfigError: too few samples to leave some out.
        """
        settings = self.config.estimator
        estimators = [batch_estimator(replace(settings, ridge=ridge), conditions) for ridge in RIDGES]
        try:
            return choose_ridge(parts, blocks, fitter, estimators, self.loss, rule=settings.ridge_rule)
        except LogError as error:
            accepted = "a number, 0.001 say, or longer logs"
            raise ConfigError.at_field("estimator.ridge", f"{settings.ridge}, but {error.found}", accepted) from error


@dataclass(frozen=True, kw_only=True, repr=False)
class Experiment(Scene):
    """A scene with the sensors of its fit."""

    config: ExperimentConfig
    sensors: SensorSet


S = TypeVar("S", bound=Scene)


def with_noise(scene: S, summary: NoiseSummary) -> S:
    """The scene with estimated noise stated in its settings, so that every later step uses it."""
    config = scene.config
    keys = {one.group.partition(".")[0] for one in summary.groups}
    estimated = {name: x for name, x in vars(summary.noise).items() if name in keys}
    noise = replace(config.sensors.noise, **estimated | config.sensors.noise.forces)
    any_stated = any(one.origin == "stated" for one in summary.groups)
    config = replace(config, sensors=replace(config.sensors, noise=noise))
    stated = replace(scene, config=config, noise_stated=any_stated)
    if isinstance(stated, Experiment):
        return replace(stated, sensors=replace(stated.sensors, noise=summary.noise))
    return stated


def require_device(device: str) -> None:
    """Refuse a device that this machine has not."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError.at_field("device", f"'{device}' is not available here", "cpu, cuda, cuda:0, ...") from error


def set_up_scene(config: ExperimentConfig | AnalyzeConfig) -> Scene:
    """Load the robot of an experiment file and look its contacts up.

    Raises:
        InputError: whatever in the file does not fit the robot.
    """
    require_device(config.device)
    try:
        of = config.robot
        require_kind(of)
        loops, joints = [loop.loop for loop in of.loops], _ft_joints(config)
        robot = load_robot(of.path, of.base_link, of.fixed_base, joints, of.weld, of.tilt, loops, of.passive)
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
    stated = [replace(c, radius=contact.radius) for c, contact in zip(config.contacts, contacts, strict=True)]
    scene = Scene(config=replace(config, contacts=stated), robot=robot, contacts=contacts, rolling=rolling)
    check_scale_groups(scene.terms, robot, contacts)
    return scene


def set_up(config: ExperimentConfig) -> Experiment:
    """As `set_up_scene`, with sensors resolved by name.

    Raises:
        InputError: whatever in the file does not fit the robot, or extra parameters of sensors that are not among the
            measured.
    """
    scene = set_up_scene(config)
    sensors = scene.sensors_of(config.sensors)
    config = replace(config, contacts=scene.config.contacts)
    experiment = Experiment(**vars(scene) | {"config": config}, sensors=sensors)
    check_terms(experiment.terms, config.actuators, scene.robot, scene.contacts, sensors)
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

    Raises:
        InputError: the certified method without Clarabel.
    """
    if settings.name == "least_squares":
        return settings.least_squares
    if settings.name == "sgd" and (settings.consistency == "penalties" or not settings.numeric_ridge):
        return settings.least_squares
    return settings.consistent(conditions)


def conditions_from(settings: EstimatorConfig, robot: Robot) -> Conditions:
    """Conditions on the parameters (L, 12) of a robot's bodies, as an experiment file says.

    Least squares may break them; those of a descent are a margin alone. `com_inside` leaves out bodies that are frozen,
    have no mass, or whose shapes are not known. Two frozen bodies need not be mirror images.

    Args:
        settings: of the estimator.
        robot: for its bodies, shapes and symmetry.

    Raises:
        ConfigError: a bound that nothing can meet or that has nothing to bound; shapes nowhere; bodies that are not
            mirrored (see `mirror_pairs`).
        UnknownNameError: a body or parameter that there is not.
        UrdfError: a shape that is not described by numbers.

    Warns:
        TorchidWarning: bodies without known shapes, or whose centre of mass in the URDF is outside theirs.
    """
    if settings.name != "consistent":
        return Conditions(margin=settings.margin if settings.name == "sgd" else 0.0, names=robot.body_names)
    lower, upper = _bounds(settings, robot)
    return Conditions(
        margin=settings.margin,
        total_mass=None if settings.total_mass is None or settings.total_mass.std else settings.total_mass.value,
        enclosures=_enclosures(settings, robot),
        mirrors=_mirrors(settings, robot),
        lower=lower,
        upper=upper,
        names=robot.body_names,
    )


def _enclosures(settings: EstimatorConfig, robot: Robot) -> tuple[Enclosure, ...]:
    if settings.com_inside is None:
        if settings.com_shapes != EstimatorConfig.com_shapes:
            found = f"{settings.com_shapes}, without com_inside"
            raise ConfigError.at_field("estimator.com_shapes", found, "com_inside: box or ellipsoid as well")
        return ()
    bodies = [i for i, body in enumerate(robot.bodies) if not body.massless and body.name not in settings.frozen]
    extents = body_extents(robot, settings.com_shapes, bodies)
    if not extents:
        found = f"{settings.com_inside}, but {robot.path.name} says of no body that is fitted what shape it has"
        raise ConfigError.at_field("estimator.com_inside", found, f"null, or a {robot.format} with shapes")
    out, outside = [], []
    for body, extent in extents.items():
        half = extent.half if settings.com_inside == "box" else extent.semi_axes
        out.append(Enclosure(body, settings.com_inside, extent.centre, extent.axes, half))
        _, com, _ = parameters.mass_com_inertia(robot.nominal[body])
        local = np.abs(extent.axes.T @ (com - extent.centre)) / half
        if (local.max() if settings.com_inside == "box" else np.linalg.norm(local)) > 1.0:
            outside.append(robot.body_names[body])
    if outside:
        where = f"outside the {settings.com_inside} at {', '.join(outside)}"
        message = f"estimator.com_inside: the {robot.format}'s own centre of mass is {where}"
        warn_about_file(f"{message}; are the shapes where the matter is? (estimator.com_shapes)")
    return tuple(out)


def _mirrors(settings: EstimatorConfig, robot: Robot) -> tuple[Mirror, ...]:
    symmetry = settings.symmetry
    if symmetry is None:
        return ()
    tokens = symmetry.left, symmetry.right, symmetry.normal
    pairs = mirror_pairs(robot, *tokens, "estimator.symmetry", settings.frozen)
    return tuple(
        Mirror(pair.body, pair.image, pair.reflection) for pair in pairs if not robot.bodies[pair.body].massless
    )


def _bounds(settings: EstimatorConfig, robot: Robot) -> tuple[Array | None, Array | None]:
    """Lower and upper bounds, (L, 12), None if the file has none."""
    exact = {name: mass.value for name, mass in settings.masses.items() if not mass.std and name in robot.body_names}
    if not (settings.bounds or exact):
        return None, None
    lower, upper = np.full(robot.nominal.shape, -np.inf), np.full(robot.nominal.shape, np.inf)
    for name, mass in exact.items():
        lower[robot.body_names.index(name), parameters.MASS] = mass
        upper[robot.body_names.index(name), parameters.MASS] = mass
    for name, intervals in (settings.bounds or {}).items():
        if name not in robot.body_names:
            raise UnknownNameError.at_field("estimator.bounds", name, robot.body_names)
        body = robot.body_names.index(name)
        for parameter, (low, high) in intervals.items():
            field = f"estimator.bounds.{name}"
            if parameter not in PARAMETERS:
                raise UnknownNameError.at_field(field, parameter, PARAMETERS)
            number, field = PARAMETERS.index(parameter), f"{field}.{parameter}"
            _check_fitted(settings, robot, body, parameter, field)
            _check_interval(parameter, low, high, field)
            lower[body, number] = -np.inf if low is None else low
            upper[body, number] = np.inf if high is None else high
    return lower, upper


def _check_fitted(settings: EstimatorConfig, robot: Robot, body: int, parameter: str, field: str) -> None:
    """Refuse a bound on what stays as it is in the URDF."""
    name, friction = robot.body_names[body], parameter in _FRICTION
    if name in settings.frozen:
        raise ConfigError.at_field(field, "a bound on a body that is frozen", "one of the two")
    if friction and robot.bodies[body].joint is None:
        raise ConfigError.at_field(field, f"a bound on friction, but {name} is the base", "a body that a joint moves")
    if friction and not settings.friction:
        raise ConfigError.at_field(field, "a bound on friction, which is not fitted", "friction: true")
    if not friction and robot.bodies[body].massless:
        raise ConfigError.at_field(field, f"a bound, but {name} has no mass in the {robot.format}", "a body that has")


def _check_interval(parameter: str, low: float | None, high: float | None, field: str) -> None:
    """Refuse what no number, or no body, is within."""
    if low is not None and high is not None and low > high:
        raise ConfigError.at_field(field, f"{low:g} above {high:g}", "[lower, upper], null for an open side")
    negative = min(x for x in (low, high, 0.0) if x is not None) < 0.0
    if parameter in _FRICTION and negative:
        raise ConfigError.at_field(field, f"[{low}, {high}]", "bounds of at least 0: friction resists")
    if parameter in _POSITIVE and high is not None and high <= 0.0:
        raise ConfigError.at_field(field, f"at most {high:g}", "an upper bound above 0")
