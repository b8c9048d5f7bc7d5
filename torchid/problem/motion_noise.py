"""Noise in the motion of bound samples, samples with more of it, and whether anything moves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchid.logs import Log
from torchid.logs.signal_noise import SignalNoise
from torchid.parameters import GRAVITY, Array

if TYPE_CHECKING:
    from torchid.problem.samples import Samples
    from torchid.sensing import SensorNoise

_JOINTS = ("joint_position", "joint_velocity", "joint_acceleration")
_TURNING = ("base_quat_xyzw", "base_angular_velocity_base", "base_angular_acceleration_base")
_LINEAR = ("base_position_world", "base_linear_velocity_world", "base_linear_acceleration_world")
_GYRO, _ACCELEROMETER = ("imu_angular_velocity", "imu_angular_acceleration"), ("imu_specific_force",)
_ANGLE, _OMEGA, _ALPHA, _FORCE = (slice(3 * k, 3 * k + 3) for k in range(4))  # of the base's 12 quantities

# of splitmix64, as signed numbers: a hash of which every bit looks random
_GOLDEN, _FIRST, _SECOND = -0x61C8864680B583EB, -0x40A7B892E31B1A47, -0x6B2FB644ECCEEE15
_BITS = 48  # taken of each hash
_TICK = 1e-5  # [s] of stamps, whose last bits differ between formats of files


@dataclass(frozen=True)
class MotionNoise:
    """Noise of the motion of some samples of one log: Gaussian at each instant, whatever neighbours have.

    Attributes:
        joints: (n, 3, 3), symmetric square roots of the covariances of position, velocity and acceleration.
        base: (12, 12), that of the base's orientation (a small rotation in the base frame), angular velocity, angular
            acceleration and specific force [rad, rad/s, rad/s^2, m/s^2].
        turns_force: whether the specific force comes from an acceleration in the world, which is turned by the
            orientation that was measured.
    """

    joints: Tensor
    base: Tensor
    turns_force: bool = False

    def perturbed(self, samples: Samples, size: Tensor) -> Samples:
        """Samples with as much noise of the motion again, times a `size`, (B, 1).

        Each of some independent sources has one standard deviation, to one side or the other, which is drawn by the
        time stamp: samples get the same noise wherever they are.
        """
        count = self.joints.shape[0]
        side = size * _sides(samples.time, 3 * count + len(self.base))
        joints, base = self.joints.to(side), self.base.to(side)
        q, v, a = torch.einsum("jkl,bjl->kbj", joints, side[:, : 3 * count].unflatten(1, (count, 3)))
        off = side[:, 3 * count :] @ base.T
        motion, angle = samples.base, off[:, _ANGLE]
        force = motion.specific_force
        if force is not None and self.turns_force:
            turn = torch.linalg.cross(angle, force)
            force = force - turn + 0.5 * torch.linalg.cross(angle, turn)
        moved = replace(
            motion,
            quat_xyzw=None if motion.quat_xyzw is None else _turned(motion.quat_xyzw, angle),
            specific_force=None if force is None else force + off[:, _FORCE],
            angular_velocity=_plus(motion.angular_velocity, off[:, _OMEGA]),
            angular_acceleration=_plus(motion.angular_acceleration, off[:, _ALPHA]),
        )
        return replace(
            samples,
            joint_position=samples.joint_position + q,
            joint_velocity=samples.joint_velocity + v,
            joint_acceleration=samples.joint_acceleration + a,
            base=moved,
        )


def with_noise_alone(samples: Samples, noise: SensorNoise) -> Samples:
    """Samples whose readings are noise alone, one standard deviation to one side or the other, drawn as above.

    Args:
        samples: B of one log.
        noise: of the forces.
    """
    torque, wrench, time = samples.torque, samples.wrench, samples.time
    if torque is not None:
        std = torque.new_tensor(noise.dof_std(samples.joint_position.shape[1], torque.shape[1]))
        torque = 0.0 * torque + std * _sides(time, len(std))
    if wrench is not None:
        sides = _sides(time, wrench.shape[1] * 6).unflatten(1, (-1, 6))
        wrench = 0.0 * wrench + wrench.new_tensor(noise.wrench_std) * sides
    return replace(samples, torque=torque, wrench=wrench)


def bind_motion_noise(
    log: Log, joints: Sequence[int], fixed_base: bool, imu: tuple[Rotation, Array] | None
) -> MotionNoise | None:
    """The noise of a preprocessed log's motion, None if it has none.

    Args:
        log: the log.
        joints: its joints' columns, in the robot's order.
        fixed_base: whether the base does not move.
        imu: rotation of the IMU's frame into the base's and its origin there, (3,) [m]; None without one.
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
    """Covariances, (count, 3, 3), of quantities by name, of which each that was not recorded is derived from the last.

    Args:
        std: of the recorded ones, (count,).
        names: at most 3, each the derivative of the one before.
        derivatives: as `SignalNoise` has them.
        count: of channels.
    """
    out = np.zeros((count, 3, 3))
    recorded = [index for index, name in enumerate(names) if name in std]
    for first, after in pairwise([*recorded, len(names)]):
        own = derivatives[: after - first, : after - first]
        out[:, first:after, first:after] = np.square(std[names[first]])[:, None, None] * own
    return out


def _of_imu(noise: SignalNoise, rotation: Rotation, arm: Array) -> Array:
    """Covariance (12, 12) of the base's motion by an IMU with a lever arm; centripetal acceleration aside."""
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
    """Symmetric S with S S = covariance, (..., k, k), which need not have full rank; others would hang on rounding."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :] @ np.swapaxes(vectors, -1, -2))


def _sides(time: Tensor, count: int) -> Tensor:
    """+1 or -1 for each sample and source, (B, count), drawn by the samples' stamps (B,), at random to all appearances.

    Source: splitmix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
    """
    stamp, bits = (time.double() / _TICK).round().long(), torch.arange(_BITS, device=time.device)
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
    axis, w, half = quat_xyzw[:, :3], quat_xyzw[:, 3:], 0.5 * angle
    vector = axis + w * half + torch.linalg.cross(axis, half)
    return torch.nn.functional.normalize(torch.cat([vector, w - (axis * half).sum(1, keepdim=True)], dim=1), dim=1)


def _plus(x: Tensor | None, off: Tensor) -> Tensor | None:
    return None if x is None else x + off


MIN_MOTION = 0.01
"""Travel [rad or m] up to which a joint stands still."""
MIN_TURN_DEG = 1.0
"""Turn [degrees] from which on a base moves."""
_MIN_ACCELERATION = 0.1 * GRAVITY  # [m/s^2] rms, of a base that is shaken; noise of a pose in half a millimetre: 0.4
_MOST_SAMPLES = 5_000  # evenly spaced


def is_at_rest(logs: Sequence[Samples]) -> bool:
    """Whether in none of some logs a joint or the base moves; not so without any log.

    Forces at rest tell what balances gravity, no inertia and no friction.
    """
    return bool(logs) and not any(_moves(log) for log in logs)


def _moves(log: Samples) -> bool:
    """Whether a joint of a filtered log travels, or its base turns or is shaken."""
    thin = log.every(max(1, len(log) // _MOST_SAMPLES))
    position, base = thin.joint_position, thin.base
    if position.shape[1] and float((position.amax(dim=0) - position.amin(dim=0)).max()) > MIN_MOTION:
        return True
    if base.quat_xyzw is not None:
        cosine = (base.quat_xyzw @ base.quat_xyzw[0]).abs().clamp(max=1.0)
        if float(2.0 * torch.arccos(cosine).max()) > math.radians(MIN_TURN_DEG):
            return True
    force = base.specific_force
    if force is None:
        return False
    return float((force - force.mean(dim=0)).square().sum(dim=1).mean().sqrt()) > _MIN_ACCELERATION
