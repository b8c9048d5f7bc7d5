"""An arm whose friction drops with speed."""

from __future__ import annotations

import numpy as np
from delays import STEP, arm, motion
from synthetic import Array

from torchid.logs import Log

COULOMB, AT_REST = np.array([0.8, 0.5]), np.array([0.6, 0.4])  # [N m], at rest beyond Coulomb friction
NOISE, SLOWER = 0.1, 0.2  # [N m]; joints pass the velocities in some samples


def slow(time: Array, sines: int = 6) -> tuple[Array, Array, Array]:
    q, v, a = motion(SLOWER * time, sines)
    return q, SLOWER * v, SLOWER**2 * a


def recorded(
    velocity: float,
    noise: float = 0.0,
    seed: int = 0,
    at_rest: Array = AT_REST,
    half: float = 0.0,
    sines: int = 6,
    delay: float = 0.0,
) -> Log:
    """A log of the arm with friction by formulas of its own; `half` of what Coulomb friction differs by direction."""
    robot, oracle = arm()
    time = STEP * np.arange(round(20.0 / STEP))
    q, v, a = slow(time + delay, sines)
    friction = np.where(v > 0.0, COULOMB + half, half - COULOMB)
    friction += at_rest * np.where(v > 0.0, 1.0, -1.0) * np.exp(-np.square(v / velocity))
    torque = oracle.forces(q, v, a) + friction + noise * np.random.default_rng(seed).normal(size=v.shape)
    moved = dict(zip(("joint_position", "joint_velocity", "joint_acceleration"), slow(time, sines), strict=True))
    return Log(source="arm.npz", time=time, joint_names=robot.joint_names, joint_torque=torque, **moved)
