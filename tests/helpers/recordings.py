"""What other sensors than ideal ones would have recorded of a synthetic log: IMUs, world axes, offsets, scales."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
from motions import value
from scipy.spatial.transform import Rotation
from synthetic import Array, Oracle

from torchid.logs import Log

GRAVITY = np.array([0.0, 0.0, -9.81])
POSE = (
    "base_quat_xyzw",
    "base_linear_acceleration_world",
    "base_angular_velocity_base",
    "base_angular_acceleration_base",
)


def states_of(log: Log) -> tuple[Array, Array, Array]:
    """Generalized coordinates of a floating base whose origin happens to be at rest where the world's is, or of joints.

    A log without the base's acceleration is one of a bolted robot.
    """
    joints = (log.joint_position, value(log.joint_velocity), value(log.joint_acceleration))
    if log.base_linear_acceleration_world is None:
        return joints
    quat, still = value(log.base_quat_xyzw), np.zeros((len(log), 3))
    linear = Rotation.from_quat(quat).inv().apply(value(log.base_linear_acceleration_world))
    base = (
        np.hstack([still, quat]),
        np.hstack([still, value(log.base_angular_velocity_base)]),
        np.hstack([linear, value(log.base_angular_acceleration_base)]),
    )
    q, v, a = (np.hstack(pair) for pair in zip(base, joints, strict=True))
    return q, v, a


def with_imu(oracle: Oracle, log: Log, frame: str, keep: Sequence[str] = ()) -> Log:
    """The log with the readings of an IMU at a frame, by Pinocchio, in place of the base's pose and its derivatives.

    Args:
        oracle: the robot.
        log: with the base's pose.
        frame: a link.
        keep: fields among `POSE` that stay.
    """
    index = oracle.model.getFrameId(frame, pin.FrameType.BODY)
    force, omega, alpha = [], [], []
    for state in zip(*states_of(log), strict=True):
        pin.forwardKinematics(oracle.model, oracle.data, *oracle._state(*state))
        pin.updateFramePlacements(oracle.model, oracle.data)
        moving = (oracle.model, oracle.data, index, pin.LOCAL)
        R = oracle.data.oMf[index].rotation
        force.append(pin.getFrameClassicalAcceleration(*moving).linear - R.T @ GRAVITY)
        omega.append(pin.getFrameVelocity(*moving).angular)
        alpha.append(pin.getFrameAcceleration(*moving).angular)
    gone = {name: None for name in POSE if name not in keep}
    return replace(
        log,
        imu_frame=frame,
        imu_specific_force=np.array(force),
        imu_angular_velocity=np.array(omega),
        imu_angular_acceleration=np.array(alpha),
        **gone,  # type: ignore[arg-type]
    )


def in_world(oracle: Oracle, log: Log) -> Log:
    """The log with its contact wrenches along world axes; a bolted base may be mounted askew."""
    q, local = states_of(log)[0], value(log.contact_wrench_local)
    bolted = not oracle.base and log.base_quat_xyzw is not None
    mounting = Rotation.from_quat(log.base_quat_xyzw).as_matrix() if bolted else np.eye(3)
    turned = np.empty_like(local)
    for k, frame in enumerate(log.contact_names):
        R = mounting @ oracle.pose(q, frame)[0]
        turned[:, k] = (local[:, k].reshape(-1, 2, 3) @ R.transpose(0, 2, 1)).reshape(-1, 6)
    return replace(log, contact_wrench_local=None, contact_wrench_world=turned)


def on_plates(oracle: Oracle, log: Log) -> Log:
    """The log with its contact wrenches along world axes and about the world's origin, of a base that is anywhere.

    The world of a bolted base without a pose is the base.
    """
    turned, q = in_world(oracle, log), states_of(log)[0]
    base = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1)))
    place = np.random.default_rng(4).uniform(-3.0, 3.0, (len(log), 3))
    if not oracle.base and log.base_quat_xyzw is not None:
        base = Rotation.from_quat(log.base_quat_xyzw)
    wrench = value(turned.contact_wrench_world).copy()
    placed = bool(oracle.base) or log.base_quat_xyzw is not None
    for k, frame in enumerate(log.contact_names):
        origin = base.apply(oracle.pose(q, frame)[1]) + placed * place
        wrench[:, k, 3:] += np.cross(origin, wrench[:, k, :3])
    known = {"base_position_world": place} if placed else {}
    return replace(turned, contact_wrench_world=wrench, moments_about_world_origin=True, **known)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Miscalibration:
    """Offsets and scales: a reading y stands for the force s y - o.

    `torque`, `torque_scale`: (n,); `wrench`, `wrench_scale`: (C, 6), along the axes that the log has; `ft`, `ft_scale`:
    (F, 6).
    """

    torque: Array
    torque_scale: Array
    wrench: Array
    wrench_scale: Array
    ft: Array
    ft_scale: Array

    @classmethod
    def random(cls, log: Log, rng: np.random.Generator, scaled: Collection[str] = ()) -> Miscalibration:
        """Offsets of up to 80 N and 8 N m everywhere, scales up to 10 % off of the channels that are `scaled`."""
        size = np.array([80.0] * 3 + [8.0] * 3)
        n, C, F = len(log.joint_names), len(log.contact_names), len(log.ft_names)

        def scale(shape: tuple[int, ...], *channels: str) -> Array:
            off = np.repeat([channel in scaled for channel in channels], shape[-1] // len(channels))
            return 1.0 + 0.1 * off * rng.uniform(-1.0, 1.0, shape)

        return cls(
            8.0 * rng.uniform(-1.0, 1.0, n),
            scale((n,), "joint_torque"),
            size * rng.uniform(-1.0, 1.0, (C, 6)),
            scale((C, 6), "contact_force", "contact_moment"),
            size * rng.uniform(-1.0, 1.0, (F, 6)),
            scale((F, 6), "ft_force", "ft_moment"),
        )

    def read(self, log: Log) -> Log:
        """The log as such sensors record it; those of contacts read 0 while nothing touches."""
        change: dict[str, Array] = {"joint_torque": (value(log.joint_torque) + self.torque) / self.torque_scale}
        name = "contact_wrench_local" if log.contact_wrench_world is None else "contact_wrench_world"
        if (wrench := getattr(log, name)) is not None:
            change[name] = (wrench + self.wrench) / self.wrench_scale
        if log.ft_wrench is not None:
            change["ft_wrench"] = (log.ft_wrench + self.ft) / self.ft_scale
        return replace(log, **change)  # type: ignore[arg-type]
