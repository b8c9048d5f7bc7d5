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
    low_state = None if topics is None else topics.low_state
    if low_state is None or not low_state.orientation or low_state.frame not in robot.links:
        return
    body, T_base_imu = robot.links[low_state.frame]
    angle = float(np.arccos(np.clip(0.5 * (np.trace(T_base_imu[:3, :3]) - 1.0), -1.0, 1.0)))
    if body == 0 and angle > _ALONG:
        found = f"'{low_state.frame}', which is turned by {np.degrees(angle):.0f} deg against {robot.base_link}"
        accepted = "a frame along the base's axes, or orientation: false, which leaves the IMU's quaternion out"
        raise ConfigError.at_field("logs.topics.low_state.frame", found, accepted)
