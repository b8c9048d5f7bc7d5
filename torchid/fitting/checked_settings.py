"""Parts of a robot that an experiment file names, compared with it: contacts, their radii, extra parameters, maps."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from torchid.config import AnalyzeConfig, ExperimentConfig
from torchid.config.estimator import TaskWeightsConfig
from torchid.config.logs import LogsConfig
from torchid.config.robot import ChoiceConfig, ContactConfig, NoiseConfig
from torchid.errors import ConfigError, InputError, SensorError, UnknownNameError, format_count
from torchid.logs.column_entries import for_all
from torchid.logs.column_map import fits, require_names, values_of_all
from torchid.logs.ros_topics import Topics, require_joints
from torchid.parameters import Array
from torchid.problem import ExtraTerms
from torchid.problem.base_pose import FEET
from torchid.problem.extras import CHANNELS, ScaleGroups, measured_channels
from torchid.problem.floor_pose import FEWEST_POINTS, points_of
from torchid.robot import CollisionShapes, Robot, RollingShape, require_payloads
from torchid.sensing import Contact, SensorSet, validate_contacts
from torchid.sensing.sensors import NORMAL_FORCE, UP, join_numbers
from torchid.settings import AUTO


def check_scale_groups(terms: ExtraTerms, robot: Robot, contacts: Sequence[Contact]) -> None:
    """Refuse groups of `sensors.scales` that name what the robot does not have, or one sensor twice.

    Raises:
        UnknownNameError: a pattern that no joint or frame fits.
        ConfigError: a joint or frame in two groups.
    """
    frames = tuple(contact.frame for contact in contacts)
    names = dict.fromkeys(CHANNELS, frames) | {"joint_torque": robot.joint_names}
    names |= dict.fromkeys(("ft_force", "ft_moment"), robot.ft_names)
    for kind, groups in _groups(terms).items():
        field, group_of = f"sensors.scales.{kind}", dict[str, Sequence[str]]()
        for group in groups:
            for pattern in group:
                if not _fitting(names[kind], pattern):
                    raise UnknownNameError.at_field(field, pattern, names[kind])
            for name in (x for x in names[kind] if any(fits(x, pattern) for pattern in group)):
                if name in group_of:
                    both = f"[{', '.join(group_of[name])}] and [{', '.join(group)}]"
                    raise ConfigError.at_field(field, f"'{name}' in two groups, {both}", "one group, or none, for each")
                group_of[name] = group


def stated_noise(config: NoiseConfig, robot: Robot) -> dict[str, Any]:
    """What is stated of the noise of the forces, by field of `SensorNoise`.

    Raises:
        UnknownNameError: a pattern that no joint fits.
        ConfigError: a joint without a figure, where others have one, or with two.
    """
    stated = config.forces
    if (torque := stated.get("joint_torque")) is not None:
        key, names = "sensors.noise.joint_torque", robot.joint_names
        stated["joint_torque"] = tuple(values_of_all(key, "noise", for_all(torque), "joint", names))
    require_comparable([float(x) for group in stated.values() for x in np.ravel(group)])
    return stated


def require_comparable(noise: Sequence[float]) -> None:
    """Refuse standard deviations of forces by which float64 cannot weight rows. Raises InputError."""
    low, high = min(noise, default=1.0), max(noise, default=1.0)
    if low < 1e-9 or high > min(1e6, 1e7 * low):
        found, accepted = f"from {low:g} to {high:g}", "from 1e-9 to 1e6, the largest at most 1e7 times the smallest"
        raise InputError.at_field("sensors.noise", f"standard deviations {found}", accepted)


def task_weights(config: TaskWeightsConfig, robot: Robot) -> Array | None:
    """Task weights as `SensorSet` has them; None if all are alike, as only their ratios count.

    Raises:
        UnknownNameError: a pattern that no joint fits.
        ConfigError: a joint without a weight, where others have one, or with two; an axis of a fixed base.
    """
    key, base = "estimator.task_weights", (config.base_force, config.base_moment)
    if robot.fixed_base and any(x is not None for x in base):
        raise ConfigError.at_field(key, "axes of the base, which is fixed", "joint_torque alone")
    torque = for_all(1.0 if config.joint_torque is None else config.joint_torque)
    joints = values_of_all(f"{key}.joint_torque", "weight", torque, "joint", robot.joint_names)
    of_base = [np.ones(robot.base_rows // 2) * (1.0 if x is None else x) for x in base]
    weights = np.concatenate([*of_base, joints, np.ones(robot.n_dofs - robot.n)])
    return None if np.ptp(weights) == 0.0 else weights


def check_terms(
    terms: ExtraTerms, actuators: object, robot: Robot, contacts: Sequence[Contact], sensors: SensorSet
) -> None:
    """Refuse extra parameters of channels that nothing measures; all kinds of channels mean those that are measured.

    Args:
        terms: that are fitted.
        actuators: the block of that name.
        robot: the robot.
        contacts: of it.
        sensors: what is measured.

    Raises:
        ConfigError: a kind of channels, or actuators' terms, without a sensor.
        UnknownNameError: a group's pattern that fits no sensor that is measured.
    """
    measured = measured_channels(robot, contacts, sensors)
    for key, scopes in {"offsets": terms.offsets, "scales": terms.scales}.items():
        for channel, scope in scopes.items():
            if channel not in measured and (len(scopes) < len(CHANNELS) or not isinstance(scope, str)):
                accepted = f"{', '.join(measured)}, or log or all for every kind that is measured"
                raise ConfigError.at_field(f"sensors.{key}.{channel}", "no such sensor is measured", accepted)
    for kind, groups in _groups(terms).items():
        for pattern in (pattern for group in groups for pattern in group):
            if not _fitting(measured[kind], pattern):
                what = f"whose {kind} is not measured"
                raise UnknownNameError.at_field(f"sensors.scales.{kind}", pattern, measured[kind], what)
    for name, value in vars(actuators).items():
        unset = value == AUTO and name != "stribeck"  # what logs choose by default
        if value and not unset and "joint_torque" not in measured:
            accepted = "joint torques among the sensors, or no such key"
            raise ConfigError.at_field(f"actuators.{name}", "set, but no joint torque is measured", accepted)


def _groups(terms: ExtraTerms) -> dict[str, ScaleGroups]:
    return {kind: groups for kind, groups in terms.scales.items() if not isinstance(groups, str)}


def _fitting(names: Collection[str], pattern: str) -> bool:
    return any(fits(name, pattern) for name in names)


_ALONG = 0.01  # rad, up to which an IMU's frame is along the base's axes


def require_maps_of(robot: Robot, logs: LogsConfig) -> None:
    """Make sure that maps of topics and columns, and payloads, are of a robot.

    Raises:
        InputError: joints, contacts or links that the robot does not have, or an IMU that does not suit its base.
    """
    joints = [*(body.joint.name for body in robot.bodies if body.joint is not None), *robot.welded]
    require_joints(logs.topics, joints)
    _require_base_axes(robot, logs.topics)
    if logs.columns is not None:
        require_names(logs.columns, {"joint": joints, "contact": robot.links})
    require_payloads(robot, logs.payloads)


def _require_base_axes(robot: Robot, topics: Topics | None) -> None:
    """Refuse an IMU whose quaternion is to be the base's orientation, though its frame is turned against the base."""
    for key in ("low_state", "imu"):
        topic = getattr(topics, key, None)
        if topic is None or not topic.orientation:
            continue
        if topic.frame is None and key == "imu":
            raise ConfigError.at_field("logs.topics.imu.frame", "missing, with orientation: true", "a link of the base")
        if topic.frame in robot.links and robot.links[topic.frame][0] == 0 and not is_along_base(robot, topic.frame):
            angle = np.degrees(_angle_to_base(robot, topic.frame))
            found = f"'{topic.frame}', which is turned by {angle:.0f} deg against {robot.base_link}"
            accepted = "a frame along the base's axes, or orientation: false, which leaves the IMU's quaternion out"
            raise ConfigError.at_field(f"logs.topics.{key}.frame", found, accepted)


def is_along_base(robot: Robot, link: str) -> bool:
    """Whether a link of the base has the axes of the base link."""
    return _angle_to_base(robot, link) <= _ALONG


def _angle_to_base(robot: Robot, link: str) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(robot.links[link][1][:3, :3]) - 1.0), -1.0, 1.0)))


def resolve_contacts(settings: Sequence[ContactConfig], robot: Robot) -> tuple[tuple[Contact, ...], str]:
    """The contacts of a robot, and on what they roll by what source, "" where nothing rolls or could.

    Raises:
        UnknownNameError: a frame that the URDF does not have.
        SensorError: a frame named twice.
        ConfigError: a radius of a flat contact, a centre of another contact than a point, a normal of no length.
        UrdfError: a collision shape that is not described by numbers.
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
        found = RollingShape("point", 0.0, contact.frame) if shape is None else shape
        x, y, z = UP if given.normal is None else given.normal
        a, b, c = found.centre if given.centre == "auto" else given.centre
        radius = found.radius if given.radius == "auto" else given.radius
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
        return f"radius 0: no {missing} found in the URDF; state contacts[].radius if it rolls"
    text = f"{'ball' if contact.kind == 'point' else 'cylinder'} of radius {1e3 * contact.radius:.3g} mm"
    if any(contact.centre):
        text += f" about {join_numbers(float(f'{1e3 * x:.2g}') for x in contact.centre)} mm"
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
    """The contacts, after making sure that flags and a base's motion can follow from them where settings want that.

    Raises:
        ConfigError: a fixed base, closed loops, feet that are too few even if all stand, normals of several floors, or
            thresholds of detection that contradict each other.
    """
    settings = config.preprocessing
    for key in ("detect_contacts", "base_motion"):
        if getattr(settings, key) is not None and config.robot.fixed_base:
            accepted = "null, or a base that floats"
            raise ConfigError.at_field(f"preprocessing.{key}", "set, though robot.fixed_base is true", accepted)
    for key in ("detect_contacts", "contact_threshold"):
        if getattr(settings, key) is not None and not contacts:
            raise ConfigError.at_field(f"preprocessing.{key}", "set, without contacts", "contacts to detect")
    if settings.zero_in_air and not contacts:
        raise ConfigError.at_field("preprocessing.zero_in_air", "true, without contacts", "false, or contacts")
    if settings.detect_contacts is not None:
        if robot.loops:
            found = f"set, for a robot with {format_count(len(robot.loops), 'closed loop')}"
            raise ConfigError.at_field("preprocessing.detect_contacts", found, "contact_threshold, or recorded flags")
        touch, lift = settings.detect_contacts.touch, settings.detect_contacts.lift
        if lift > touch:
            found, accepted = f"{lift:g}, above touch ({touch:g})", "a share of the weight up to that of touch"
            raise ConfigError.at_field("preprocessing.detect_contacts.lift", found, accepted)
    if settings.base_motion is not None:
        _require_floor(contacts)
    return contacts


def _require_floor(contacts: tuple[Contact, ...]) -> None:
    """Refuse contacts that do not say how a base stands above one floor, even if all stand."""
    if sum(map(points_of, contacts)) < FEWEST_POINTS:
        found = f"contacts, but the experiment has {', '.join(f'{c.kind} {c.frame}' for c in contacts) or 'none'}"
        raise ConfigError.at_field("preprocessing.base_motion", found, f"{FEET} among the contacts")
    for index, contact in enumerate(contacts):
        if not np.allclose(contact.normal, contacts[0].normal, rtol=0.0, atol=1e-9):
            found = f"{join_numbers(contact.normal)}, but contacts[0] has {join_numbers(contacts[0].normal)}"
            accepted = "one floor for all contacts, or preprocessing.base_motion: null"
            raise ConfigError.at_field(f"contacts[{index}].normal", found, accepted)
