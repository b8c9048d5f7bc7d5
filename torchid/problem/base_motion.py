"""How the base moves: from its pose, or from an IMU anywhere on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchid.errors import LogError, UnknownNameError
from torchid.logs import Log
from torchid.parameters import Array
from torchid.regressor import motion_from_state
from torchid.regressor.kinematics import GRAVITY_WORLD, rotation_matrix
from torchid.robot import Robot

_POSE_FIELDS = (
    "base_quat_xyzw",
    "base_angular_velocity_base",
    "base_angular_acceleration_base",
    "base_linear_acceleration_world",
)
_IMU_FIELDS = ("imu_specific_force", "imu_angular_velocity", "imu_angular_acceleration")
_ACCEPTED = {
    "base_quat_xyzw": "base_quat_wxyz or base_quat_xyzw, or imu_frame, imu_specific_force and imu_angular_velocity",
    "base_linear_acceleration_world": "base_position_world, base_linear_velocity_{world,base} or "
    "base_linear_acceleration_{world,base}, or an IMU's readings",
}


@dataclass(frozen=True)
class BaseMotion:
    """All that the dynamics depend on of the base at N samples, in the base frame; None where it is not known.

    Attributes:
        quat_xyzw: (N, 4), rotates base to world.
        specific_force: (N, 3), acceleration of the base origin minus gravity [m/s^2].
        angular_velocity, angular_acceleration: (N, 3) [rad/s, rad/s^2].
    """

    quat_xyzw: Tensor | None = None
    specific_force: Tensor | None = None
    angular_velocity: Tensor | None = None
    angular_acceleration: Tensor | None = None

    @classmethod
    def from_coordinates(cls, q: Tensor, v: Tensor, a: Tensor, fixed_base: bool = False) -> BaseMotion:
        """Of generalized coordinates as `Regressor` takes them; nothing of a bolted base."""
        if fixed_base:
            return cls()
        found = motion_from_state(q, v, a, q.shape[1] - 7)
        return cls(q[:, 3:7], found.base_specific_force, found.base_angular_velocity, found.base_angular_acceleration)

    def map(self, change: Callable[[Tensor], Tensor]) -> BaseMotion:
        """With every tensor changed."""
        return BaseMotion(**{name: change(x) for name, x in vars(self).items() if x is not None})

    @property
    def rotation(self) -> Tensor | None:
        """Rotation base to world, (N, 3, 3), if it is known."""
        return None if self.quat_xyzw is None else rotation_matrix(self.quat_xyzw)


def levelled_base_axes(rotation_world_base: Tensor) -> Tensor:
    """Axes of the levelled base in the base frame, (N, 3, 3), as columns.

    The base is turned by the smallest rotation that makes vertical the axis which is nearest to it: a base that tilts
    takes its horizontal axes along, and none of their noise into the vertical one. Which axis is nearest may change
    where a base lies at 45 degrees; the turn is at most 55 degrees, so that it is always defined.

    Args:
        rotation_world_base: (N, 3, 3), base to world.
    """
    up = rotation_world_base[:, 2]  # vertical, in the base frame
    place = up.abs().argmax(dim=1, keepdim=True)
    nearest = torch.zeros_like(up).scatter(1, place, up.gather(1, place).sign())
    x, y, z = torch.linalg.cross(nearest, up).unbind(1)
    zero = torch.zeros_like(x)
    turn = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).unflatten(1, (3, 3))
    cosine = (nearest * up).sum(1)[:, None, None]
    return torch.eye(3, dtype=up.dtype, device=up.device) + turn + turn @ turn / (1.0 + cosine)


def base_motion(log: Log, robot: Robot) -> BaseMotion:
    """How the base moves in a preprocessed log; of a bolted base, how it is mounted.

    An IMU is taken where the log has one: what it reads is what the dynamics depend on, without differentiation. The
    orientation is kept beside it, for wrenches along world axes.

    Raises:
        LogError: neither the base's motion nor an IMU's readings, or an IMU that is not on the base.
        UnknownNameError: an IMU frame that the robot does not have.
    """
    quat = None if log.base_quat_xyzw is None else torch.from_numpy(log.base_quat_xyzw)
    if robot.fixed_base:
        return BaseMotion(quat)
    if log.imu_frame:
        return _from_imu(log, robot, quat)
    missing = [name for name in _POSE_FIELDS if getattr(log, name) is None]
    if missing or quat is None:
        accepted = _ACCEPTED.get(missing[0], f"{missing[0]}, or a log passed through preprocess()")
        raise LogError(log.source, missing[0], "missing, though the base floats", accepted)
    _, omega, alpha, acceleration = (torch.from_numpy(getattr(log, name)) for name in _POSE_FIELDS)
    force = acceleration - acceleration.new_tensor(GRAVITY_WORLD)
    return BaseMotion(quat, (rotation_matrix(quat).mT @ force[..., None])[..., 0], omega, alpha)


def _on_base(robot: Robot) -> list[str]:
    """Frames that do not move in the base, whatever sensors are in between."""
    still = [0]
    for index, body in enumerate(robot.bodies):  # parents come first
        if body.joint is not None and body.joint.kind == "fixed" and body.parent in still:
            still.append(index)
    return [name for index in still for name in robot.bodies[index].links]


def _from_imu(log: Log, robot: Robot, quat: Tensor | None) -> BaseMotion:
    """The base's motion from that of a frame that is rigidly on it: rigid-body kinematics with the lever arm."""
    if log.imu_frame not in robot.links:
        raise UnknownNameError(log.source, "imu_frame", log.imu_frame, _on_base(robot))
    body, T_base_imu = robot.links[log.imu_frame]
    while (joint := robot.bodies[body].joint) is not None and joint.kind == "fixed":  # a sensor's weld does not move
        body, T_base_imu = joint.parent, joint.T_parent_joint @ joint.T_joint_link @ T_base_imu
    if body != 0:
        found = f"'{log.imu_frame}', which moves with {robot.bodies[body].name}"
        raise LogError(log.source, "imu_frame", found, f"a frame on the base: {', '.join(_on_base(robot)[:8])}")
    for name in _IMU_FIELDS:
        if getattr(log, name) is None:
            raise LogError(log.source, name, "missing", f"{name}, or a log passed through preprocess()")
    turn, arm = Rotation.from_matrix(T_base_imu[:3, :3]), T_base_imu[:3, 3]
    force, omega, alpha = (turn.apply(getattr(log, name)) for name in _IMU_FIELDS)
    at_origin: Array = force - np.cross(alpha, arm) - np.cross(omega, np.cross(omega, arm))
    return BaseMotion(quat, *map(torch.from_numpy, (at_origin, omega, alpha)))
