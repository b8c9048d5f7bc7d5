"""What sensors read of an exact log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from legged.simulate import Exact
from torchid.logs import Log
from torchid.parameters import Array

_GRAVITY_WORLD = (0.0, 0.0, -9.81)


@dataclass(frozen=True)
class Noise:
    """Standard deviations of white noise in every sample [rad, rad/s, m/s^2, rad, N m, N, N m]."""

    joint_position: float = 1e-3
    angular_velocity: float = 0.01
    specific_force: float = 0.05
    base_orientation: float = 2e-3
    joint_torque: float = 0.3
    contact_force: float = 2.0
    contact_moment: float = 0.1

    def times(self, motion: float, force: float) -> Noise:
        """Multiples of the noise of what moves, and of forces."""
        forces = ("joint_torque", "contact_force", "contact_moment")
        return Noise(**{name: value * (force if name in forces else motion) for name, value in vars(self).items()})


def record(exact: Exact, imu_frame: str, noise: Noise, rng: np.random.Generator, name: str | None = None) -> Log:
    """Positions, torques, contact forces, orientation and an IMU at the base's origin: rates are to be derived.

    Args:
        exact: what happened.
        imu_frame: the base link.
        noise: of the sensors.
        rng: draws it.
        name: source of the log, by default the exact log's.
    """
    log, count = exact.log, len(exact.log)
    assert log.base_quat_xyzw is not None
    assert log.base_linear_acceleration_world is not None
    turn = Rotation.from_quat(log.base_quat_xyzw)
    tilt = Rotation.from_rotvec(noise.base_orientation * rng.normal(size=(count, 3)))
    force = turn.inv().apply(log.base_linear_acceleration_world - _GRAVITY_WORLD)

    def read(values: Array | None, deviation: float | Array) -> Array:
        assert values is not None
        return values + deviation * rng.normal(size=values.shape)

    return Log(
        name or log.source,
        time=log.time,
        joint_names=log.joint_names,
        joint_position=read(log.joint_position, noise.joint_position),
        joint_torque=read(log.joint_torque, noise.joint_torque),
        base_quat_xyzw=(turn * tilt).as_quat(),
        imu_frame=imu_frame,
        imu_specific_force=read(force, noise.specific_force),
        imu_angular_velocity=read(exact.rate[:, 3:6], noise.angular_velocity),
        contact_names=log.contact_names,
        contact_active=log.contact_active,
        contact_wrench_world=read(log.contact_wrench_world, np.repeat([noise.contact_force, noise.contact_moment], 3)),
    )
