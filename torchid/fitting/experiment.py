"""Robot, contacts, sensors and conditions of an experiment file, which all commands share."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import torch

from torchid import parameters
from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.estimator import EstimatorConfig
from torchid.config.sensors import ChoiceConfig
from torchid.errors import ConfigError, TorchidWarning, UnknownNameError
from torchid.estimators import Conditions, Enclosure, Mirror
from torchid.parameters import PARAMETERS, Array
from torchid.problem import ExtraTerms
from torchid.problem.extras import CHANNELS, measured_channels
from torchid.robot import Robot, body_extents, load_robot, mirror_pairs
from torchid.robot.tree import FT_FIELD
from torchid.sensing import (
    Contact,
    SensorNoise,
    SensorSet,
    chosen_sensors,
    named_sensors,
    validate_contacts,
    with_ft_sensors,
)

_FRICTION = PARAMETERS[parameters.FRICTION]
_POSITIVE = ("m", "Ixx", "Iyy", "Izz")


def conditions_from(settings: EstimatorConfig, robot: Robot, source: object = "experiment") -> Conditions:
    """Conditions on the parameters (L, 12) of a robot's bodies, as an experiment file says.

    `com_inside` leaves out bodies that are frozen, have no mass, or whose shapes are not known. Two frozen bodies need
    not be mirror images.

    Args:
        settings: of the estimator.
        robot: for its bodies, shapes and symmetry.
        source: named in errors.

    Raises:
        ConfigError: a bound that nothing can meet or that has nothing to bound; shapes nowhere; bodies that are not
            mirrored (see `mirror_pairs`).
        UnknownNameError: a body or parameter that there is not.
        UrdfError: a shape that is not described by numbers.

    Warns:
        TorchidWarning: bodies without known shapes, or whose centre of mass in the URDF is outside theirs.
    """
    lower, upper = _bounds(settings, robot, source)
    return Conditions(
        margin=settings.margin,
        total_mass=settings.total_mass,
        enclosures=_enclosures(settings, robot, source),
        mirrors=_mirrors(settings, robot, source),
        lower=lower,
        upper=upper,
        names=robot.body_names,
    )


def _enclosures(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Enclosure, ...]:
    if settings.com_inside is None:
        if settings.com_shapes != EstimatorConfig.com_shapes:
            found = f"{settings.com_shapes}, without com_inside"
            raise ConfigError(source, "estimator.com_shapes", found, "com_inside: box or ellipsoid as well")
        return ()
    bodies = [i for i, body in enumerate(robot.bodies) if not body.massless and body.name not in settings.frozen]
    extents = body_extents(robot, settings.com_shapes, bodies)
    if not extents:
        found = f"{settings.com_inside}, but {robot.path.name} says of no body that is fitted what shape it has"
        raise ConfigError(source, "estimator.com_inside", found, "null, or a URDF with shapes")
    out, outside = [], []
    for body, extent in extents.items():
        half = extent.half if settings.com_inside == "box" else extent.semi_axes
        out.append(Enclosure(body, settings.com_inside, extent.centre, extent.axes, half))
        _, com, _ = parameters.mass_com_inertia(robot.nominal[body])
        local = np.abs(extent.axes.T @ (com - extent.centre)) / half
        if (local.max() if settings.com_inside == "box" else np.linalg.norm(local)) > 1.0:
            outside.append(robot.body_names[body])
    if outside:
        message = f"the URDF's own centre of mass is outside the {settings.com_inside} at {', '.join(outside)}"
        advice = "are the shapes where the matter is? (estimator.com_shapes)"
        warnings.warn(f"{source}: estimator.com_inside: {message}; {advice}", TorchidWarning, stacklevel=4)
    return tuple(out)


def _mirrors(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Mirror, ...]:
    symmetry = settings.symmetry
    if symmetry is None:
        return ()
    pairs = mirror_pairs(
        robot, symmetry.left, symmetry.right, symmetry.normal, source, "estimator.symmetry", settings.frozen
    )
    return tuple(
        Mirror(pair.body, pair.image, pair.reflection) for pair in pairs if not robot.bodies[pair.body].massless
    )


def _bounds(settings: EstimatorConfig, robot: Robot, source: object) -> tuple[Array | None, Array | None]:
    """Lower and upper bounds, (L, 12), None if the file has none."""
    if not settings.bounds:
        return None, None
    lower, upper = np.full(robot.nominal.shape, -np.inf), np.full(robot.nominal.shape, np.inf)
    for name, intervals in settings.bounds.items():
        if name not in robot.body_names:
            raise UnknownNameError(source, "estimator.bounds", name, robot.body_names)
        body = robot.body_names.index(name)
        for parameter, (low, high) in intervals.items():
            field = f"estimator.bounds.{name}"
            if parameter not in PARAMETERS:
                raise UnknownNameError(source, field, parameter, PARAMETERS)
            number, field = PARAMETERS.index(parameter), f"{field}.{parameter}"
            _check_fitted(settings, robot, body, parameter, source, field)
            _check_interval(parameter, low, high, source, field)
            lower[body, number] = -np.inf if low is None else low
            upper[body, number] = np.inf if high is None else high
    return lower, upper


def _check_fitted(
    settings: EstimatorConfig, robot: Robot, body: int, parameter: str, source: object, field: str
) -> None:
    """Refuse a bound on what stays as it is in the URDF."""
    name, friction = robot.body_names[body], parameter in _FRICTION
    if name in settings.frozen:
        raise ConfigError(source, field, "a bound on a body that is frozen", "one of the two")
    if friction and robot.bodies[body].joint is None:
        raise ConfigError(source, field, f"a bound on friction, but {name} is the base", "a body that a joint moves")
    if friction and not settings.friction:
        raise ConfigError(source, field, "a bound on friction, which is not fitted", "friction: true")
    if not friction and robot.bodies[body].massless:
        raise ConfigError(source, field, f"a bound, but {name} has no mass in the URDF", "a body that has")


def _check_interval(parameter: str, low: float | None, high: float | None, source: object, field: str) -> None:
    """Refuse what no number, or no body, is within."""
    if low is not None and high is not None and low > high:
        raise ConfigError(source, field, f"{low:g} above {high:g}", "[lower, upper], null for an open side")
    negative = min(x for x in (low, high, 0.0) if x is not None) < 0.0
    if parameter in _FRICTION and negative:
        raise ConfigError(source, field, f"[{low}, {high}]", "bounds of at least 0: friction resists")
    if parameter in _POSITIVE and high is not None and high <= 0.0:
        raise ConfigError(source, field, f"at most {high:g}", "an upper bound above 0")


@dataclass(frozen=True)
class Scene:
    """Robot and contacts of an experiment file, and what is chosen by their names."""

    config: ExperimentConfig | AnalyzeConfig
    robot: Robot
    contacts: tuple[Contact, ...]

    @property
    def noise(self) -> SensorNoise:
        """Of the sensors, as stated; a guess where it is not."""
        return SensorNoise(**{name: x for name, x in vars(self.config.sensors.noise).items() if x is not None})

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


@dataclass(frozen=True)
class Experiment(Scene):
    """An experiment file brought to life."""

    config: ExperimentConfig
    sensors: SensorSet


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
        field = _ft_field(config, error.name)
        raise UnknownNameError(source, field, error.name, error.valid, error.what) from error
    if not robot.nv:
        raise ConfigError(source, "robot", "a bolted base without a joint, which never moves", "a robot that can move")
    contacts = validate_contacts(robot, [Contact(c.frame, c.type, c.line_axis) for c in config.contacts], source)
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
        InputError: whatever in the file does not fit the robot, or unknowns of sensors that are not among the measured.
    """
    scene = set_up_scene(config, source)
    experiment = Experiment(config, scene.robot, scene.contacts, scene.sensors_of(config.sensors, source))
    _check_terms(experiment, source)
    return experiment


def _check_terms(experiment: Experiment, source: object) -> None:
    """Refuse unknowns of kinds of channels that nothing measures; all kinds together mean those that are measured."""
    terms = experiment.terms
    measured = measured_channels(experiment.robot, experiment.contacts, experiment.sensors)
    for field, scopes in (("offsets", terms.offsets), ("scales", terms.scales)):
        for channel in scopes:
            if channel not in measured and len(scopes) < len(CHANNELS):
                accepted = f"{', '.join(measured)}, or log or all for every kind that is measured"
                raise ConfigError(source, f"sensors.{field}.{channel}", "no such sensor is measured", accepted)
    for name, wanted in vars(experiment.config.actuators).items():
        if wanted and "joint_torque" not in measured:
            accepted = "joint torques among the sensors, or no such key"
            raise ConfigError(source, f"actuators.{name}", "set, but no joint torque is measured", accepted)
