"""What an experiment file says of its logs, compared with the robot that they are of."""

from __future__ import annotations

import numpy as np

from torchid.config.logs import LogsConfig
from torchid.errors import ConfigError
from torchid.logs.column_map import require_names
from torchid.logs.ros_topics import Topics, require_joints
from torchid.robot import Robot, require_payloads

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
