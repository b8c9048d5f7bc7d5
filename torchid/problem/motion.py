"""Motion of the base, from its pose or from an IMU anywhere on it, and noise in the motion of bound samples."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchid.errors import LogError, UnknownNameError
from torchid.logs import Log
from torchid.logs.log import POINTS, SignalNoise
from torchid.parameters import Array
from torchid.regressor import motion_from_state
from torchid.regressor.kinematics import GRAVITY_WORLD, rotation_matrix
from torchid.robot import Robot
from torchid.sensing import Contact

MIN_MOTION = 0.01
"""A joint with less travel [rad or m] counts as still."""
MIN_TURN_DEG = 1.0
"""A base with less rotation [degrees] counts as still."""

FROM_PREPROCESS = "the field; torchid.preprocess(log) computes it"
"""Accepted for a missing derivative, in messages."""

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
    "base_linear_acceleration_{world,base}, or IMU readings",
}


@dataclass(frozen=True)
class BaseMotion:
    """Motion of the base at N samples, in the base frame, as the dynamics need it; None where unknown.

    Attributes:
        quat_xyzw: (N, 4), rotates base to world.
        specific_force: (N, 3), acceleration of the base origin minus gravity [m/s^2].
        angular_velocity, angular_acceleration: (N, 3) [rad/s, rad/s^2].
        position: (N, 3) [m], of the origin in the world; only for wrenches about the world's origin.
    """

    quat_xyzw: Tensor | None = None
    specific_force: Tensor | None = None
    angular_velocity: Tensor | None = None
    angular_acceleration: Tensor | None = None
    position: Tensor | None = None

    @classmethod
    def from_coordinates(cls, q: Tensor, v: Tensor, a: Tensor, fixed_base: bool = False) -> BaseMotion:
        """Motion of the base from q (B, n + 7), v, a (B, n + 6), as `Regressor` takes them; empty for a fixed base."""
        if fixed_base:
            return cls()
        motion = motion_from_state(q, v, a, q.shape[1] - 7)
        return cls(
            q[:, 3:7], motion.base_specific_force, motion.base_angular_velocity, motion.base_angular_acceleration
        )

    def map(self, function: Callable[[Tensor], Tensor]) -> BaseMotion:
        """Apply a function to every tensor."""
        return BaseMotion(**{name: function(x) for name, x in vars(self).items() if x is not None})

    def tilted(self, tilt: Sequence[float] | Array, count: int) -> BaseMotion:
        """Motion of a base that is rotated relative to the recorded one by a rotation vector about x and y [rad].

        `count`: number of samples, for an unknown motion. The motion noise does not change.
        """
        if not np.any(tilt):
            return self
        turn = Rotation.from_rotvec([*tilt, 0.0])
        to_tilted = torch.from_numpy(turn.as_matrix())
        recorded = np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)) if self.quat_xyzw is None else self.quat_xyzw.numpy()
        vectors = ("specific_force", "angular_velocity", "angular_acceleration")
        turned = {name: x @ to_tilted for name in vectors if (x := getattr(self, name)) is not None}
        if self.quat_xyzw is not None or not turned:
            turned["quat_xyzw"] = torch.from_numpy((Rotation.from_quat(recorded) * turn).as_quat())
        return replace(self, **turned)

    @property
    def rotation(self) -> Tensor | None:
        """Rotation base to world, (N, 3, 3), if it is known."""
        return None if self.quat_xyzw is None else rotation_matrix(self.quat_xyzw)


def levelled_base_axes(rotation_world_base: Tensor) -> Tensor:
    """Axes of the levelled base in the base frame, (N, 3, 3), as columns.

    The smallest rotation makes the base axis nearest to the vertical exactly vertical. So a tilted base does not mix
    noise of the horizontal axes into the vertical one. The nearest axis may change at a tilt of 45 degrees; the
    rotation is at most 55 degrees, so it is always defined.

    Args:
        rotation_world_base: (N, 3, 3), base to world.
    """
    up = rotation_world_base[:, 2]  # vertical, in the base frame
    index = up.abs().argmax(dim=1, keepdim=True)
    nearest = torch.zeros_like(up).scatter(1, index, up.gather(1, index).sign())
    v = torch.linalg.cross(nearest, up)
    x, y, z = v.unbind(1)
    cosine = (nearest * up).sum(1)
    diagonal = cosine[:, None, None] * torch.eye(3, dtype=up.dtype, device=up.device)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).unflatten(1, (3, 3))
    return diagonal + cross + v[:, :, None] * (v / (1.0 + cosine[:, None]))[:, None]


def base_motion(log: Log, robot: Robot) -> BaseMotion:
    """Motion of the robot's base in a preprocessed log; for a fixed base only its orientation.

    An IMU is preferred, because it measures what the dynamics need without differentiation. The orientation is kept for
    wrenches along world axes.

    Raises:
        LogError: the log has neither the base's motion nor IMU readings, or the IMU is not on the base.
        UnknownNameError: the robot has no such IMU frame.
    """
    return _recorded_base(log, robot).tilted(robot.base_tilt, len(log))


def _recorded_base(log: Log, robot: Robot) -> BaseMotion:
    """As `base_motion`, of the recorded base, without the robot's `base_tilt`."""
    quat = None if log.base_quat_xyzw is None else torch.from_numpy(log.base_quat_xyzw)
    if robot.fixed_base:
        return BaseMotion(quat)
    if log.imu_frame:
        return _from_imu(log, robot, quat)
    missing = [name for name in _POSE_FIELDS if getattr(log, name) is None]
    if missing or quat is None:
        accepted = _ACCEPTED.get(missing[0], FROM_PREPROCESS)
        raise LogError(log.source, missing[0], "missing, but the robot has a floating base", accepted)
    _, omega, alpha, acceleration = (torch.from_numpy(getattr(log, name)) for name in _POSE_FIELDS)
    force = acceleration - acceleration.new_tensor(GRAVITY_WORLD)
    return BaseMotion(quat, (rotation_matrix(quat).mT @ force[..., None])[..., 0], omega, alpha)


def position_for_moments(log: Log, robot: Robot, contacts: Sequence[Contact]) -> Tensor | None:
    """Position of the base in the world, (N, 3) [m], if contact moments are about the world's origin; else None.

    A fixed base without a recorded pose is at the world's origin.

    Raises:
        LogError: the position is missing.
    """
    has_moments = any(max(contact.components) >= 3 and not contact.along_normal for contact in contacts)
    if not log.moments_about_world_origin or not has_moments:
        return None
    if log.base_position_world is not None:
        return torch.from_numpy(log.base_position_world)
    if robot.fixed_base and log.base_quat_xyzw is None:
        return torch.zeros(len(log), 3, dtype=torch.float64)
    reason = "moments about the world's origin need base_position_world, which is missing"
    accepted = "base_position_world and the base's orientation, or moments about the origins of the contact frames"
    raise LogError(log.source, POINTS, reason, accepted)


def _links_on_base(robot: Robot) -> list[str]:
    """Links fixed to the base, also through force/torque sensors."""
    fixed = [0]
    for index, body in enumerate(robot.bodies):  # parents come first
        if body.joint is not None and body.joint.kind == "fixed" and body.parent in fixed:
            fixed.append(index)
    return [name for index in fixed for name in robot.bodies[index].links]


def imu_pose(log: Log, robot: Robot) -> tuple[Rotation, Array]:
    """Rotation of the IMU frame into the base frame, and its origin there, (3,) [m].

    Raises:
        LogError: the IMU is not on the base.
        UnknownNameError: the robot has no such frame.
    """
    if log.imu_frame not in robot.links:
        raise UnknownNameError(log.source, "imu_frame", log.imu_frame, _links_on_base(robot))
    body, T_base_imu = robot.links[log.imu_frame]
    while (joint := robot.bodies[body].joint) is not None and joint.kind == "fixed":  # a sensor's weld does not move
        body = joint.parent
        T_base_imu = joint.T_parent_joint @ joint.T_joint_link @ T_base_imu
    if body != 0:
        reason = f"'{log.imu_frame}' is on {robot.bodies[body].name}, not on the base"
        raise LogError(log.source, "imu_frame", reason, f"a frame on the base: {', '.join(_links_on_base(robot)[:8])}")
    return Rotation.from_matrix(T_base_imu[:3, :3]), T_base_imu[:3, 3]


def _from_imu(log: Log, robot: Robot, quat: Tensor | None) -> BaseMotion:
    """Motion of the base from that of an IMU fixed to it: rigid-body kinematics with the lever arm."""
    rotation, arm = imu_pose(log, robot)
    for name in _IMU_FIELDS:
        if getattr(log, name) is None:
            raise LogError(log.source, name, "missing", FROM_PREPROCESS)
    force, omega, alpha = (rotation.apply(getattr(log, name)) for name in _IMU_FIELDS)
    at_origin: Array = force - np.cross(alpha, arm) - np.cross(omega, np.cross(omega, arm))
    return BaseMotion(quat, *map(torch.from_numpy, (at_origin, omega, alpha)))


_JOINTS = ("joint_position", "joint_velocity", "joint_acceleration")
_TURNING = ("base_quat_xyzw", "base_angular_velocity_base", "base_angular_acceleration_base")
_LINEAR = ("base_position_world", "base_linear_velocity_world", "base_linear_acceleration_world")
_GYRO = ("imu_angular_velocity", "imu_angular_acceleration")
_ACCELEROMETER = ("imu_specific_force",)
_ANGLE, _OMEGA, _ALPHA, _FORCE = (slice(3 * k, 3 * k + 3) for k in range(4))  # of the base's 12 quantities

# of splitmix64, as signed numbers: a hash of which every bit looks random
_GOLDEN = -0x61C8864680B583EB
_FIRST = -0x40A7B892E31B1A47
_SECOND = -0x6B2FB644ECCEEE15
_BITS = 48  # taken of each hash
_TICK = 1e-5  # [s] of stamps, whose last bits differ between formats of files


@dataclass(frozen=True)
class MotionNoise:
    """Noise of the motion of one log's samples: Gaussian and independent between samples.

    Attributes:
        joints: (n, 3, 3), symmetric square roots of the covariances of position, velocity and acceleration.
        base: (12, 12), that of the base's orientation (small rotation in the base frame), angular velocity, angular
            acceleration and specific force [rad, rad/s, rad/s^2, m/s^2].
        turns_force: whether the specific force comes from an acceleration in the world, rotated by the measured
            orientation.
    """

    joints: Tensor
    base: Tensor
    turns_force: bool = False

    def drawn(self, time: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """Noise of joints, (3, B, n), and of the base, (B, 12), at time stamps (B,), times a `size`, (B, 1).

        Each independent source is plus or minus one standard deviation; the time stamp determines the sign, so a sample
        always gets the same noise.
        """
        count = self.joints.shape[0]
        side = size * random_sides(time, 3 * count + len(self.base))
        joints = self.joints.to(side)
        base = self.base.to(side)
        of_joints = torch.einsum("jkl,bjl->kbj", joints, side[:, : 3 * count].unflatten(1, (count, 3)))
        return of_joints, side[:, 3 * count :] @ base.T

    def added_to(self, base: BaseMotion, noise: Tensor) -> BaseMotion:
        """The motion of a base with noise (B, 12) added."""
        angle, omega, alpha, at_force = noise.split(3, dim=1)
        force = base.specific_force
        if force is not None and self.turns_force:
            turn = torch.linalg.cross(angle, force)
            force = force - turn + 0.5 * torch.linalg.cross(angle, turn)
        return replace(
            base,
            quat_xyzw=None if base.quat_xyzw is None else _turned(base.quat_xyzw, angle),
            specific_force=_plus(force, at_force),
            angular_velocity=_plus(base.angular_velocity, omega),
            angular_acceleration=_plus(base.angular_acceleration, alpha),
        )


def bind_motion_noise(
    log: Log, joints: Sequence[int], fixed_base: bool, imu: tuple[Rotation, Array] | None
) -> MotionNoise | None:
    """Noise of a preprocessed log's motion; None without noise.

    Args:
        log: the log.
        joints: columns of its joints in the robot's order.
        fixed_base: whether the base does not move.
        imu: rotation of the IMU frame into the base frame and its origin there, (3,) [m]; or None.
    """
    noise = log.motion_noise
    if noise is None or not noise.found:
        return None
    ordered = {name: std[joints] for name, std in noise.std.items() if name in _JOINTS}
    of_joints = _chain(ordered, _JOINTS, noise.derivatives, len(joints))
    base = np.zeros((12, 12))
    turning = _chain(noise.std, _TURNING, noise.derivatives, 3)
    if imu is not None:
        turning[:, 1:] = turning[:, :, 1:] = 0.0
        base = _of_imu(noise, *imu)
    for axis, covariance in enumerate(turning):
        base[axis:9:3, axis:9:3] += covariance
    if imu is None:
        base[_FORCE, _FORCE] = np.eye(3) * _chain(noise.std, _LINEAR, noise.derivatives, 3)[:, 2, 2].mean()
    if fixed_base:
        base[3:] = base[:, 3:] = 0.0
    joint_roots, base_root = (torch.from_numpy(_square_root(x)) for x in (of_joints, base))
    return MotionNoise(joint_roots, base_root, turns_force=imu is None and not fixed_base)


def _chain(std: Mapping[str, Array], names: Sequence[str], derivatives: Array, count: int) -> Array:
    """Covariances, (count, 3, 3), of quantities by name; each unrecorded one is the derivative of the one before.

    Args:
        std: of the recorded ones, (count,).
        names: at most 3, each the derivative of the one before.
        derivatives: as in `SignalNoise`.
        count: of channels.
    """
    out = np.zeros((count, 3, 3))
    recorded = [index for index, name in enumerate(names) if name in std]
    for first, after in pairwise([*recorded, len(names)]):
        covariance = derivatives[: after - first, : after - first]
        out[:, first:after, first:after] = np.square(std[names[first]])[:, None, None] * covariance
    return out


def _of_imu(noise: SignalNoise, rotation: Rotation, arm: Array) -> Array:
    """Covariance (12, 12) of the base's motion from an IMU with a lever arm, without centripetal acceleration."""
    sources = np.zeros((9, 9))  # angular velocity, angular acceleration, specific force
    for axis, covariance in enumerate(_chain(noise.std, _GYRO, noise.derivatives, 3)):
        sources[axis:6:3, axis:6:3] = covariance[:2, :2]
    sources[6:, 6:] = np.diag(_chain(noise.std, _ACCELEROMETER, noise.derivatives, 3)[:, 0, 0])
    R = rotation.as_matrix()
    x, y, z = arm
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.zeros((12, 9))
    T[_OMEGA, :3] = T[_ALPHA, 3:6] = T[_FORCE, 6:] = R
    T[_FORCE, 3:6] = cross @ R  # - alpha x arm
    return np.asarray(T @ sources @ T.T)


def _square_root(covariance: Array) -> Array:
    """Symmetric S with S S = covariance, (..., k, k), also for singular covariances."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ np.swapaxes(vectors, -1, -2))


def random_sides(time: Tensor, count: int) -> Tensor:
    """Pseudo-random +1 or -1 for each sample and source, (B, count), determined by the time stamps (B,).

    Source: splitmix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
    """
    stamp = (time.double() / _TICK).round().long()
    bits = torch.arange(_BITS, device=time.device)
    words = []
    for _ in range(-(-count // _BITS)):
        stamp = stamp + _GOLDEN
        words.append((_hash(stamp)[:, None] >> bits) & 1)
    drawn = torch.cat(words, dim=1)
    return (2 * drawn[:, :count] - 1).to(time.dtype)


def _hash(x: Tensor) -> Tensor:
    x = (x ^ _shift(x, 30)) * _FIRST
    x = (x ^ _shift(x, 27)) * _SECOND
    return x ^ _shift(x, 31)


def _shift(x: Tensor, bits: int) -> Tensor:
    """The bits of integers moved to the right, zeros after them."""
    return (x >> bits) & (2 ** (64 - bits) - 1)


def _turned(quat_xyzw: Tensor, angle: Tensor) -> Tensor:
    """Rotations (B, 4) after small ones (B, 3) about their own axes."""
    axis = quat_xyzw[:, :3]
    w = quat_xyzw[:, 3:]
    half = 0.5 * angle
    vector = axis + w * half + torch.linalg.cross(axis, half)
    return torch.nn.functional.normalize(torch.cat([vector, w - (axis * half).sum(1, keepdim=True)], dim=1), dim=1)


def _plus(x: Tensor | None, off: Tensor) -> Tensor | None:
    return None if x is None else x + off
