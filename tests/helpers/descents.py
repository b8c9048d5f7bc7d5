"""Logs to descend on, with and without forces that no rigid body explains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from repository import DEMO as DEMO_FOLDER
from synthetic import UR5, Array, load, random_states
from torch import Tensor, nn

from torchid import parameters
from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.problem import LinearProblem, MiniBatches, RowBuilder, Samples, compress, linear_problem
from torchid.problem.motion import BaseMotion
from torchid.reading.log_reader import LogReader
from torchid.regressor import Regressor
from torchid.robot import Robot
from torchid.sensing import SensorNoise, named_sensors

DEMO = DEMO_FOLDER / "quadruped.yaml"


@dataclass(frozen=True)
class World:
    """Logs of one robot, their mini-batches and their compressed problem."""

    robot: Robot
    builder: RowBuilder
    logs: list[Samples]
    batches: MiniBatches
    problem: LinearProblem

    @classmethod
    def of(cls, robot: Robot, builder: RowBuilder, logs: list[Samples], batch_size: int) -> World:
        logs = [replace(log, motion_noise=None) for log in logs]
        problem = linear_problem(compress(logs, builder), builder, robot)
        return cls(robot, builder, logs, MiniBatches(logs, builder, batch_size), problem)

    def seeded(self, seed: int) -> World:
        return replace(self, batches=MiniBatches(self.logs, self.builder, self.batches.batch_size, seed))


@cache
def demo() -> World:
    """The quadruped that comes with torchid, its joint torques measured, in batches of 128."""
    config = load_config(DEMO)
    experiment = set_up(config)
    builder = RowBuilder(experiment.robot, experiment.contacts, experiment.sensors)
    return World.of(experiment.robot, builder, LogReader(experiment).read(config.logs.train, experiment.sensors), 128)


def true_arm(robot: Robot) -> Array:
    """Parameters (L, 12) of a bolted arm that differs from its URDF and has friction."""
    rng = np.random.default_rng(0)
    truth = parameters.perturb_parameters(robot.nominal, 0.3, rng)
    truth[1:, 10:] = rng.uniform(0.5, 2.0, truth[1:, 10:].shape)
    return truth


def arm_log(robot: Robot, phi: Array, seed: int, count: int, noise: float = 0.1, extra: Any = None) -> Samples:
    """Unrelated random states of a bolted arm, torques of parameters `phi`, (L, 12), and of `extra(q, v, a)`."""
    rng = np.random.default_rng(seed)
    q, v, a = map(torch.from_numpy, random_states(rng, robot.n, count, fixed_base=True))
    torque = Regressor(robot)(q, v, a) @ torch.from_numpy(phi.ravel())
    torque = torque + torch.from_numpy(noise * rng.normal(size=torque.shape))
    if extra is not None:
        torque = torque + extra(q, v, a)
    time_, active = torch.arange(count, dtype=torch.float64), torch.zeros(count, 0, dtype=torch.bool)
    return Samples(f"{seed}.npz", time_, q, v, a, BaseMotion(), torque, None, False, active)


def arm_world(phi: Array | None = None, seed: int = 1, count: int = 300, extra: Any = None) -> World:
    """A bolted UR5 whose torques are measured to 0.1 N m, in batches of 50."""
    robot = load(UR5, fixed_base=True)
    builder = RowBuilder(robot, [], named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=0.1)))
    phi = true_arm(robot) if phi is None else phi
    return World.of(robot, builder, [arm_log(robot, phi, seed, count, extra=extra)], 50)


arm = cache(arm_world)


@cache
def half_way() -> World:
    """An arm of which half the truth is true: a descent to the truth passes by."""
    robot = load(UR5, fixed_base=True)
    return arm_world(0.5 * (robot.nominal + true_arm(robot)), seed=2)


def still(**settings: Any) -> dict[str, Any]:
    """Steps that change nothing."""
    return {"optimizer": {"name": "SGD", "lr": 1e-300}, "schedule": None, "epochs": 1} | settings


def cable(q: Tensor, _v: Tensor, _a: Tensor) -> Tensor:
    """A spring across the second joint and a cable at the fourth [N m]."""
    out = torch.zeros_like(q)
    out[:, 1], out[:, 3] = -8.0 * (q[:, 1] - 0.3), 3.0 * torch.sin(2.0 * q[:, 3])
    return out


class Springs(nn.Module):
    """Springs and cables of unknown strength at every joint, none at first."""

    def __init__(self, n: int) -> None:
        super().__init__()
        self.strength = nn.Parameter(torch.zeros(n, 3, dtype=torch.float64))

    def forward(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return (torch.stack([torch.ones_like(q), q, torch.sin(2.0 * q)], dim=2) * self.strength).sum(2)


class Fixed(nn.Module):
    """A force that is known, or none at all."""

    def __init__(self, force: Any) -> None:
        super().__init__()
        self.force = force

    def forward(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return self.force(q, v, a)


@cache
def with_cable() -> World:
    return arm_world(seed=1, count=600, extra=cable)
