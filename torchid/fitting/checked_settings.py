"""Settings of an experiment file that name parts of the robot, compared with it: extra parameters, maps of logs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from torchid.config.logs import LogsConfig
from torchid.config.sensors import NoiseConfig
from torchid.errors import ConfigError, UnknownNameError
from torchid.logs.column_entries import for_all
from torchid.logs.column_map import fits, require_names, values_of_all
from torchid.logs.ros_topics import Topics, require_joints
from torchid.problem import ExtraTerms
from torchid.problem.extras import CHANNELS, ScaleGroups, measured_channels
from torchid.robot import Robot, require_payloads
from torchid.sensing import Contact, SensorSet


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
    return stated


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
    for key, scopes in _scopes(terms).items():
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
        if value and "joint_torque" not in measured:
            accepted = "joint torques among the sensors, or no such key"
            raise ConfigError.at_field(f"actuators.{name}", "set, but no joint torque is measured", accepted)


def _scopes(terms: ExtraTerms) -> dict[str, Any]:
    return {"offsets": terms.offsets, "scales": terms.scales}


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
