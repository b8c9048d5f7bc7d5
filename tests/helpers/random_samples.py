"""Samples that are random in all: rows know nothing of whether the dynamics close."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from synthetic import Array, random_states

from torchid.problem import Samples
from torchid.problem.motion import BaseMotion
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet, named_sensors

NOISE = SensorNoise(joint_torque=0.3, contact_force=1.5, contact_moment=0.1, base_force=0.7, base_moment=0.05)


def random_samples(
    robot: Robot,
    contacts: Sequence[Contact],
    count: int,
    seed: int | np.random.Generator,
    world: bool = False,
    states: int = 0,
) -> tuple[Samples, tuple[Array, Array, Array]]:
    """Unrelated motion, forces and contact states, with the generalized coordinates (q, v, a).

    Wrenches are along world axes if `world`. Samples cycle through so many contact states; 0: each has its own.
    """
    rng = np.random.default_rng(seed)
    q, v, a = random_states(rng, robot.n, count, robot.fixed_base)
    coordinates = [torch.from_numpy(x) for x in (q, v, a)]
    active = rng.integers(0, 2, (states or count, len(contacts))).astype(bool)
    samples = Samples(
        source=f"{seed}.npz" if isinstance(seed, int) else "random.npz",
        time=torch.arange(count, dtype=torch.float64) * 0.01,
        **{
            f"joint_{name}": x[:, x.shape[1] - robot.n :]
            for name, x in zip(("position", "velocity", "acceleration"), coordinates, strict=True)
        },
        base=BaseMotion.from_coordinates(*coordinates, robot.fixed_base),
        torque=torch.from_numpy(20.0 * rng.normal(size=(count, robot.n))),
        wrench=torch.from_numpy(20.0 * rng.normal(size=(count, len(contacts), 6))),
        wrench_in_world=world,
        active=torch.from_numpy(active[np.arange(count) % len(active)]),
    )
    return samples, (q, v, a)


def sensor_set(name: str, robot: Robot, contacts: Sequence[Contact]) -> SensorSet:
    """A named set; "mixed": every other torque, the first contact's wrench and part of the last one's; or "nothing"."""
    if name in ("full", "contacts", "joints"):
        return named_sensors(name, robot.n, len(contacts), NOISE)
    torque, wrench = np.zeros(robot.n, dtype=bool), np.zeros((len(contacts), 6), dtype=bool)
    if name == "mixed":
        torque[::2], wrench[:1], wrench[-1:, 1:3] = True, True, True
    return SensorSet(torque, wrench, NOISE)
