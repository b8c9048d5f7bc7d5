"""An arm whose torques act later than its log says."""

from __future__ import annotations

from functools import cache

import numpy as np
from synthetic import ROBOTS, Array, Oracle, load

from torchid.logs import Log
from torchid.robot import Robot

STEP, DELAY = 0.005, 0.0037  # [s]
NOISE = 0.02  # [N m]


@cache
def arm() -> tuple[Robot, Oracle]:
    """Two joints with friction, that differ from their URDF."""
    robot = load(ROBOTS / "asr_twodof_description/urdf/TwoDofs.urdf", None, True)
    oracle = Oracle.of(robot)
    oracle.perturb(np.random.default_rng(3), 0.2)
    oracle.friction[:] = 0.0, 0.3
    return robot, oracle


def motion(time: Array, sines: int = 6, size: float = 0.4) -> tuple[Array, Array, Array]:
    """Positions, velocities, accelerations (N, 2), sums of sines up to 3 Hz [rad], one of both if it is one."""
    rng = np.random.default_rng(0)
    rate = 2.0 * np.pi * rng.uniform(0.3, 3.0, (sines, 1 if sines == 1 else 2))
    phase = rng.uniform(0.0, 6.28, (sines, 2))

    def of_order(k: int) -> Array:
        return (size * rate**k * np.sin(time[:, None, None] * rate + phase + 0.5 * np.pi * k)).sum(1)

    return of_order(0), of_order(1), of_order(2)


def recorded(
    delay: float = DELAY, noise: float = 0.0, seed: int = 0, seconds: float = 8.0, shape: tuple[int, float] = (6, 0.4)
) -> Log:
    """A log whose torques act so much later, with white noise."""
    robot, oracle = arm()
    time = STEP * np.arange(round(seconds / STEP))
    torque = oracle.forces(*motion(time + delay, *shape))
    torque += noise * np.random.default_rng(seed).normal(size=torque.shape)
    fields = ("joint_position", "joint_velocity", "joint_acceleration")
    moved = dict(zip(fields, motion(time, *shape), strict=True))
    return Log(source="arm.npz", time=time, joint_names=robot.joint_names, joint_torque=torque, **moved)
