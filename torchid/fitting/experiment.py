"""Robot, contacts, sensors, estimator and conditions of an experiment file, compared with the robot that it names."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
import torch

from torchid import distributed
from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.estimator import EstimatorConfig, TaskWeightsConfig
from torchid.config.logs import LogsConfig
from torchid.config.robot import ChoiceConfig, ContactConfig, NoiseConfig, require_kind
from torchid.errors import (
    ConfigError,
    InputError,
    LogError,
    SensorError,
    TorchidWarning,
    UnknownNameError,
    format_count,
    join_names,
)
from torchid.estimators import Conditions, Consistent, LeastSquares
from torchid.fitting.fit import LogFitter, frozen_parameters
from torchid.fitting.left_out import RIDGE, RIDGES, STRONGER, RidgeChoice, choose_ridge
from torchid.fitting.noise import NoiseSummary, estimate_noise, mean_noise_square, recorded_sensors
from torchid.fitting.prior_knowledge import conditions_from, known_masses
from torchid.fitting.robust import RobustLoss
from torchid.log_checks.equations import Declared
from torchid.logs.columns import fits, for_all, require_names, values_of_all
from torchid.logs.ros_topics import Topics, require_joints
from torchid.parameters import Array
from torchid.problem import Evaluation, ExtraTerms, RowBuilder, Samples
from torchid.problem.base_pose import FEET, FEWEST_POINTS, points_of
from torchid.problem.compression import BY_FOLD, Block, Part, merge
from torchid.problem.extras import CHANNELS, ScaleGroups, measured_channels
from torchid.problem.noise import LogOfOtherProcess
from torchid.reprs import short_repr
from torchid.robot import CollisionShapes, Robot, RollingShape, load_robot, require_payloads
from torchid.robot.tree import FT_FIELD, matching_joints
from torchid.sensing import (
    Contact,
    SensorNoise,
    SensorSet,
    chosen_sensors,
    named_sensors,
    validate_contacts,
    with_ft_sensors,
)
from torchid.sensing.sensors import NORMAL_FORCE, UP, join_numbers
from torchid.settings import AUTO


def check_scale_groups(terms: ExtraTerms, robot: Robot, contacts: Sequence[Contact]) -> None:
    """Check the groups of `sensors.scales`.

    Raises:
        UnknownNameError: no joint or frame matches a pattern.
        ConfigError: a joint or frame is in two groups.
    """
    frames = tuple(contact.frame for contact in contacts)
    names = dict.fromkeys(CHANNELS, frames) | {"joint_torque": robot.joint_names}
    names |= dict.fromkeys(("ft_force", "ft_moment"), robot.ft_names)
    for kind, groups in _groups(terms).items():
        field = f"sensors.scales.{kind}"
        group_of = dict[str, Sequence[str]]()
        for group in groups:
            for pattern in group:
                if not _fitting(names[kind], pattern):
                    raise UnknownNameError.at_field(field, pattern, names[kind])
            for name in (x for x in names[kind] if any(fits(x, pattern) for pattern in group)):
                if name in group_of:
                    both = f"[{', '.join(group_of[name])}] and [{', '.join(group)}]"
                    raise ConfigError.at_field(field, f"'{name}' in two groups, {both}", "at most one group for a name")
                group_of[name] = group


def stated_noise(config: NoiseConfig, robot: Robot) -> dict[str, Any]:
    """Stated noise of the forces, by field of `SensorNoise`.

    Raises:
        UnknownNameError: no joint matches a pattern.
        ConfigError: a joint has no value although others have, or has two.
    """
    stated = config.forces
    if (torque := stated.get("joint_torque")) is not None:
        key = "sensors.noise.joint_torque"
        stated["joint_torque"] = tuple(values_of_all(key, "noise", for_all(torque), "joint", robot.joint_names))
    require_comparable([float(x) for group in stated.values() for x in np.ravel(group)])
    return stated


def require_comparable(noise: Sequence[float]) -> None:
    """Raise InputError if standard deviations are too different to weight rows in float64."""
    low = min(noise, default=1.0)
    high = max(noise, default=1.0)
    if low < 1e-9 or high > min(1e6, 1e7 * low):
        reason = f"from {low:g} to {high:g}"
        accepted = "from 1e-9 to 1e6, the largest at most 1e7 times the smallest"
        raise InputError.at_field("sensors.noise", f"standard deviations {reason}", accepted)


def task_weights(config: TaskWeightsConfig, robot: Robot) -> Array | None:
    """Task weights for `SensorSet`; None if all are equal, because only their ratios matter.

    Raises:
        UnknownNameError: no joint matches a pattern.
        ConfigError: a joint has no weight although others have, or has two; or weights for the axes of a fixed base.
    """
    key = "estimator.task_weights"
    base = (config.base_force, config.base_moment)
    if robot.fixed_base and any(x is not None for x in base):
        raise ConfigError.at_field(key, "base_force or base_moment of a fixed base", "joint_torque only")
    torque = for_all(1.0 if config.joint_torque is None else config.joint_torque)
    joints = values_of_all(f"{key}.joint_torque", "weight", torque, "joint", robot.joint_names)
    of_base = [np.ones(robot.base_rows // 2) * (1.0 if x is None else x) for x in base]
    weights = np.concatenate([*of_base, joints, np.ones(robot.n_dofs - robot.n)])
    return None if np.ptp(weights) == 0.0 else weights


def check_terms(
    terms: ExtraTerms, actuators: object, robot: Robot, contacts: Sequence[Contact], sensors: SensorSet
) -> None:
    """Raise an error for extra parameters of channels that are not measured.

    Settings for all channels mean the measured ones.

    Args:
        terms: extra parameters to fit.
        actuators: the block `actuators`.
        robot: the robot.
        contacts: of the robot.
        sensors: what is measured.

    Raises:
        ConfigError: a channel or an actuator term has no sensor.
        UnknownNameError: no measured sensor matches a group's pattern.
    """
    measured = measured_channels(robot, contacts, sensors)
    for key, scopes in {"offsets": terms.offsets, "scales": terms.scales}.items():
        for channel, scope in scopes.items():
            if channel not in measured and (len(scopes) < len(CHANNELS) or not isinstance(scope, str)):
                accepted = f"{', '.join(measured)}, or {key}: log or all, for all measured kinds"
                raise ConfigError.at_field(f"sensors.{key}.{channel}", "no such sensor is measured", accepted)
    for kind, groups in _groups(terms).items():
        for pattern in (pattern for group in groups for pattern in group):
            if not _fitting(measured[kind], pattern):
                what = f"its {kind} is not measured"
                raise UnknownNameError.at_field(f"sensors.scales.{kind}", pattern, measured[kind], what)
    by_default = vars(type(actuators)())
    for name, value in vars(actuators).items():
        if value and value != by_default[name] and "joint_torque" not in measured:
            accepted = "joint torques in sensors, or remove this key"
            raise ConfigError.at_field(f"actuators.{name}", "set, but no joint torque is measured", accepted)


def _groups(terms: ExtraTerms) -> dict[str, ScaleGroups]:
    return {kind: groups for kind, groups in terms.scales.items() if not isinstance(groups, str)}


def _fitting(names: Collection[str], pattern: str) -> bool:
    return any(fits(name, pattern) for name in names)


_ALONG = 0.01  # rad, accepted angle between an IMU's frame and the base axes


def require_maps_of(robot: Robot, logs: LogsConfig) -> None:
    """Check that maps of topics and columns, and payloads, fit a robot.

    Raises:
        InputError: the robot has no such joint, contact or link, or an IMU does not fit its base.
    """
    joints = [*(body.joint.name for body in robot.bodies if body.joint is not None), *robot.welded]
    require_joints(logs.topics, joints)
    _require_base_axes(robot, logs.topics)
    if logs.columns is not None:
        require_names(logs.columns, {"joint": joints, "contact": robot.links})
    require_payloads(robot, logs.payloads)


def _require_base_axes(robot: Robot, topics: Topics | None) -> None:
    """Raise ConfigError if an IMU's quaternion is used for the base but its frame is rotated relative to the base."""
    for key in ("low_state", "imu"):
        topic = getattr(topics, key, None)
        if topic is None or not topic.orientation:
            continue
        if topic.frame is None and key == "imu":
            raise ConfigError.at_field("logs.topics.imu.frame", "missing with orientation: true", "a link of the base")
        if topic.frame in robot.links and robot.links[topic.frame][0] == 0 and not is_along_base(robot, topic.frame):
            angle = np.degrees(_angle_to_base(robot, topic.frame))
            reason = f"'{topic.frame}' is rotated by {angle:.0f} deg relative to {robot.base_link}"
            accepted = "a frame with the axes of the base, or orientation: false to ignore the IMU's quaternion"
            raise ConfigError.at_field(f"logs.topics.{key}.frame", reason, accepted)


def is_along_base(robot: Robot, link: str) -> bool:
    """Whether a link of the base has the axes of the base link."""
    return _angle_to_base(robot, link) <= _ALONG


def _angle_to_base(robot: Robot, link: str) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(robot.links[link][1][:3, :3]) - 1.0), -1.0, 1.0)))


def resolve_contacts(settings: Sequence[ContactConfig], robot: Robot) -> tuple[tuple[Contact, ...], str]:
    """The contacts of a robot, and a text about what they roll on and where this comes from ("" if nothing rolls).

    Raises:
        UnknownNameError: the robot has no such frame.
        SensorError: a frame is named twice.
        ConfigError: a flat contact has a radius, a line or flat contact has a centre, or a normal has length 0.
        UrdfError: a collision shape is not described by numbers.
    """
    contacts = validate_contacts(robot, [Contact(c.frame, c.type, c.line_axis) for c in settings])
    out: list[Contact] = []
    frames: dict[str, list[str]] = {}
    shapes: CollisionShapes | None = None
    for index, (contact, given) in enumerate(zip(contacts, settings, strict=True)):
        shape = None
        if given.radius == "auto" and contact.kind != "flat":
            shapes = shapes or CollisionShapes(robot)
            shape = shapes.about(contact.frame, contact.rolling_axis)
        rolling = RollingShape("point", 0.0, contact.frame) if shape is None else shape
        x, y, z = UP if given.normal is None else given.normal
        a, b, c = rolling.centre if given.centre == "auto" else given.centre
        radius = rolling.radius if given.radius == "auto" else given.radius
        try:
            contact = replace(contact, normal=(x, y, z), radius=radius, centre=(a, b, c))
        except SensorError as error:
            raise ConfigError.at_field(f"contacts[{index}].{error.field}", error.found, error.accepted) from error
        out.append(contact)
        if contact.kind != "flat" and (contact.radius or given.radius == "auto"):
            frames.setdefault(_rolling_text(contact, shape, given.radius == "auto"), []).append(contact.frame)
    return tuple(out), "; ".join(f"{', '.join(names)}: {text}" for text, names in frames.items())


def _rolling_text(contact: Contact, shape: RollingShape | None, is_auto: bool) -> str:
    """On what a contact rolls, and from where that is known."""
    if is_auto and shape is None:
        missing = "sphere" if contact.kind == "point" else "cylinder along the line"
        return f"radius 0: no {missing} in the robot file; set contacts[].radius if it rolls"
    text = f"{'ball' if contact.kind == 'point' else 'cylinder'} of radius {1e3 * contact.radius:.3g} mm"
    if any(contact.centre):
        text += f", centre {join_numbers(float(f'{1e3 * x:.2g}') for x in contact.centre)} mm"
    text += "" if contact.normal == UP else f", normal {join_numbers(contact.normal)}"
    if shape is None:
        return f"{text}, as stated"
    source = f"the mesh {shape.file}" if shape.file else f"the collision {shape.kind}"
    return f"{text}, from {source}" + (f" of {shape.link}" if shape.link != contact.frame else "")


def with_scalar_sensors(contacts: Sequence[Contact], sensors: ChoiceConfig) -> tuple[Contact, ...]:
    """The contacts, those with a scalar sensor (`fn`) read along the ground's normal."""
    scalar = {frame for frame, names in sensors.contact_wrenches.items() if NORMAL_FORCE in names}
    return tuple(replace(x, along_normal=True) if x.frame in scalar else x for x in contacts)


def suited_to_preprocessing(
    contacts: tuple[Contact, ...], config: ExperimentConfig | AnalyzeConfig, robot: Robot
) -> tuple[Contact, ...]:
    """Check that flags and base motion can follow from the contacts, as far as settings need this; return the contacts.

    Raises:
        ConfigError: the base is fixed, the robot has loops, there are too few feet, normals differ, or thresholds of
            detection contradict each other.
    """
    settings = config.preprocessing
    for key in ("detect_contacts", "base_motion"):
        if getattr(settings, key) is not None and config.robot.fixed_base:
            accepted = "null, or a floating base"
            raise ConfigError.at_field(f"preprocessing.{key}", "set, but robot.fixed_base is true", accepted)
    for key in ("detect_contacts", "contact_threshold"):
        if getattr(settings, key) is not None and not contacts:
            raise ConfigError.at_field(f"preprocessing.{key}", "set, but contacts is empty", "the feet in contacts")
    if settings.zero_in_air and not contacts:
        raise ConfigError.at_field("preprocessing.zero_in_air", "true, but contacts is empty", "false, or contacts")
    if settings.detect_contacts is not None:
        if robot.loops:
            reason = f"set, but the robot has {format_count(len(robot.loops), 'closed loop')}"
            raise ConfigError.at_field("preprocessing.detect_contacts", reason, "contact_threshold, or recorded flags")
        touch = settings.detect_contacts.touch
        lift = settings.detect_contacts.lift
        if lift > touch:
            reason = f"{lift:g}, above touch ({touch:g})"
            accepted = "a fraction of the weight, at most touch"
            raise ConfigError.at_field("preprocessing.detect_contacts.lift", reason, accepted)
    if settings.base_motion is not None:
        _require_floor(contacts)
    return contacts


def _require_floor(contacts: tuple[Contact, ...]) -> None:
    """Raise ConfigError if the contacts do not determine the base pose above one floor, even if all stand."""
    if sum(map(points_of, contacts)) < FEWEST_POINTS:
        reason = f"contacts, but the contacts are {', '.join(f'{c.kind} {c.frame}' for c in contacts) or 'none'}"
        raise ConfigError.at_field("preprocessing.base_motion", reason, f"{FEET} in contacts")
    for index, contact in enumerate(contacts):
        if not np.allclose(contact.normal, contacts[0].normal, rtol=0.0, atol=1e-9):
            reason = f"{join_numbers(contact.normal)}, but contacts[0] has {join_numbers(contacts[0].normal)}"
            accepted = "the same normal for all contacts, or preprocessing.base_motion: null"
            raise ConfigError.at_field(f"contacts[{index}].normal", reason, accepted)


@dataclass(frozen=True, kw_only=True)
class RobotSetup:
    """Robot and contacts of an experiment file, with its settings.

    Attributes:
        config: the settings.
        robot: the robot.
        contacts: the contacts in use.
        rolling: text about what contacts roll on and where this comes from, "" if nothing rolls.
        open_radii: frames of point contacts without a stated radius.
        estimated_noise: estimated values of noise that is not stated, by field of `SensorNoise` (`with_noise`).
        noise_stated: whether the user stated any noise of the forces.
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
        """Noise of the recorded readings, NaN where unknown; None if no sensor's noise is stated.

        Estimated noise is relative to the stated one. Without any stated noise it comes from the residuals, so it could
        not judge them.
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
        delay = self.config.actuators.delay or 0.0
        finds_tilt = self.config.robot.base_tilt == AUTO
        noise = SensorNoise.of_known(stated) if stated else None
        return Declared(noise, self.terms, delay, finds_tilt, self.config.sensors.on_base_lost == "warn")

    @property
    def loss(self) -> RobustLoss | None:
        """Loss of a robust fit, None for least squares."""
        robust = self.config.estimator.robust
        return None if robust is None else RobustLoss.named(robust.loss, robust.tuning, robust.passes)

    def sensors_of(self, choice: ChoiceConfig) -> SensorSet:
        """The sensors of a choice. Raises InputError: names that do not fit the robot."""
        robot = self.robot
        contacts = self.contacts
        noise = self.noise
        ft = len(self.robot.ft_names)
        if choice.set is not None:
            sensors = named_sensors(choice.set, robot.n, len(contacts), noise, ft)
        else:
            field = "sensors.joint_torques"
            joints = robot.joint_names
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
        """Choose the ridge from the size of the residuals, or by one standard error, for the estimator of the settings.

        Bodies differ from the URDF by about 20 to 30 %, and residuals are not white noise: model errors do not average
        out. A ridge of `RIDGE` times the mean squared residual covers both, for any length of the log. Cross-validation
        may choose a larger one.

        Args:
            parts: of the blocks, compressed.
            blocks: training logs from `split_into_folds` or `fold_compressed`.
            fitter: of the rows.
            conditions: on the parameters.

        Raises:
            ConfigError: too few samples to leave some out.
        """
        settings = self.config.estimator
        ridges = RIDGES
        if settings.ridge == AUTO:
            plain = LeastSquares(rank_tolerance=settings.rank_tolerance)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", TorchidWarning)  # the fit says the same
                problem = fitter.build_problem(merge(parts, fitter.builder, *BY_FOLD)).assembly.problem
                residual_std = plain.solve(problem).residual_std
            ridges = tuple(float(f"{max(RIDGE * residual_std**2, RIDGES[0]) * factor:.2g}") for factor in STRONGER)
            if len({part.fold for part in parts}) < 2:
                return RidgeChoice(ridges[0], ridges[:1], (residual_std**2,), (0.0,))
        estimators = [batch_estimator(replace(settings, ridge=ridge), conditions) for ridge in ridges]
        try:
            return choose_ridge(parts, blocks, fitter, estimators, rule=settings.ridge_rule)
        except LogError as error:
            accepted = "a number such as 0.001, or longer logs"
            raise ConfigError.at_field("estimator.ridge", f"{settings.ridge}, but {error.found}", accepted) from error


@dataclass(frozen=True, kw_only=True, repr=False)
class Experiment(RobotSetup):
    """A setup with the sensors of its fit."""

    config: ExperimentConfig
    sensors: SensorSet


S = TypeVar("S", bound=RobotSetup)


def with_noise(setup: S, summary: NoiseSummary) -> S:
    """Add estimated noise to the stated one; all later steps use it."""
    return with_estimated_noise(setup, summary.known, summary.any_stated)


def with_estimated_noise(setup: S, estimated: Mapping[str, Any], any_stated: bool) -> S:
    """As `with_noise`, by field of `SensorNoise`; `any_stated`: of the noise of what the sensors read."""
    known = replace(setup, estimated_noise=estimated, noise_stated=any_stated)
    if isinstance(known, Experiment):
        return replace(known, sensors=replace(known.sensors, noise=known.noise))
    return known


def with_radius(setup: S, radius: float) -> S:
    """Replace contacts without a stated radius by balls about their frames; `radius` in [m]."""
    contacts = tuple(
        replace(x, radius=radius, centre=(0.0, 0.0, 0.0)) if x.frame in setup.open_radii else x for x in setup.contacts
    )
    stated = [
        replace(x, radius=radius, centre=[0.0] * 3) if x.frame in setup.open_radii else x for x in setup.config.contacts
    ]
    text = f"{join_names(sorted(setup.open_radii))}: ball of radius {1e3 * radius:.3g} mm, chosen from the logs"
    return replace(setup, contacts=contacts, config=replace(setup.config, contacts=stated), rolling=text)


def with_task_weights(experiment: Experiment, logs: Sequence[Samples]) -> Experiment:
    """Add task weights to the rows, scaled so that pure noise has mean square 1."""
    weights = task_weights(experiment.config.estimator.task_weights, experiment.robot)
    if weights is None:
        return experiment
    sensors = replace(experiment.sensors, task_weights=weights)
    size = distributed.from_first(lambda: mean_noise_square(logs, experiment.builder(sensors)), "task weights")
    return replace(experiment, sensors=replace(sensors, task_weights=weights / np.sqrt(size)))


def require_device(device: str) -> None:
    """Raise ConfigError if this machine does not have the device. Opens no connection to it, to allow forks later."""
    kind, _, index = device.partition(":")
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    is_there = kind == "cuda" and (index or "0").isdecimal() and int(index or "0") < gpus
    if device != "cpu" and not is_there:
        raise ConfigError.at_field("device", f"'{device}' is not available on this machine", "cpu, cuda, cuda:0, ...")


def set_up_robot(config: ExperimentConfig | AnalyzeConfig) -> RobotSetup:
    """Load the robot of an experiment file and resolve its contacts.

    Raises:
        InputError: a setting does not fit the robot.
    """
    require_device(config.device)
    try:
        settings = config.robot
        require_kind(settings)
        loops = [loop.loop for loop in settings.loops]
        joints = _ft_joints(config)
        total = None if (mass := config.estimator.total_mass) is None else mass.value
        robot = load_robot(
            settings.path,
            settings.base_link,
            settings.fixed_base,
            joints,
            settings.weld,
            settings.tilt,
            loops,
            settings.passive,
            total,
        )
    except UnknownNameError as error:
        if error.field != FT_FIELD:
            raise
        field = _ft_field(config, error.name)
        raise UnknownNameError.at_field(field, error.name, error.valid, error.what) from error
    if not robot.nv:
        raise ConfigError.at_field("robot", "no joint moves and the base is fixed", "a robot that can move")
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

    Args:
        settings: of the estimator.
        conditions: from `conditions_from`.
    """
    penalized = settings.name == "sgd" and settings.consistency == "penalties"
    if settings.name == "least_squares" or penalized or (settings.name == "sgd" and not settings.numeric_ridge):
        return settings.least_squares
    return settings.consistent(conditions)
