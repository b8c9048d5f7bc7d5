"""Joint positions to look at where no motion matters."""

from __future__ import annotations

import numpy as np
import torch

from torchid.parameters import Array
from torchid.problem.base_motion import BaseMotion
from torchid.problem.plan import State
from torchid.problem.samples import Samples
from torchid.regressor.motion import GRAVITY_WORLD
from torchid.robot import Robot

_ANGLE, _STROKE = 1.5, 0.3  # [rad], [m] either way


def random_postures(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n), uniform, up to 1.5 rad or 0.3 m either way."""
    slides = (robot.joint_map[0] != 0.0).T @ robot.geometry.prismatic[1:]
    return np.where(slides, _STROKE, _ANGLE) * rng.uniform(-1.0, 1.0, (count, robot.n))


def at_rest(joint_position: Array, state: State) -> Samples:
    """Samples of an upright robot at rest, at joint positions (N, n) [rad or m] in a contact state, without forces."""
    q = torch.from_numpy(np.ascontiguousarray(joint_position, dtype=float))
    still, base = torch.zeros_like(q), q.new_zeros(len(q), 3)
    upright, gravity = (q.new_tensor(x).expand(len(q), -1) for x in ((0.0, 0.0, 0.0, 1.0), GRAVITY_WORLD))
    return Samples(
        source="postures",
        time=q.new_zeros(len(q)),
        joint_position=q,
        joint_velocity=still,
        joint_acceleration=still,
        base=BaseMotion(upright, -gravity, base, base),
        torque=None,
        wrench=None,
        wrench_in_world=False,
        active=torch.tensor(state, dtype=torch.bool).expand(len(q), len(state)),
    )
