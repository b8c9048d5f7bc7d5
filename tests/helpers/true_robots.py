"""True robots that differ from their URDFs, what was recorded of them, and fits of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from synthetic import G1, ROBOTS, TALOS_FULL, Array, Oracle, load, make_log, random_states

from torchid import parameters
from torchid.estimators import Estimate, LeastSquares
from torchid.problem import RowBuilder, Samples, bind_log, compress, linear_problem
from torchid.regressor import Regressor
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet

ANYMAL_B = ROBOTS / "anymal_b_simple_description/robots/anymal.urdf"
SAMPLES, UNSEEN = 600, 100
EXACT = 1e-12  # of the largest force; 3e-15 measured


def stepping(feet: int) -> list[list[bool]]:
    """Every foot down, and each lifted in turn."""
    return [[True] * feet, *([foot != lifted for foot in range(feet)] for lifted in range(feet))]


@dataclass(frozen=True)
class Kind:
    """A robot, its feet, and the joints of the leg above the first foot."""

    urdf: Path
    feet: tuple[str, ...]
    foot: str
    leg: tuple[str, ...]

    @property
    def contacts(self) -> tuple[Contact, ...]:
        return tuple(Contact(frame, self.foot) for frame in self.feet)

    @property
    def states(self) -> list[list[bool]]:
        """Every foot down, each lifted in turn, a trot for a quadruped, flight."""
        count = len(self.feet)
        trot = [[True, False, False, True]] if count == 4 else []
        return [*stepping(count), *trot, [False] * count]


LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
KINDS = {
    "G1": Kind(
        G1, ("left_ankle_roll_link", "right_ankle_roll_link"), "flat", tuple(f"left_{part}_joint" for part in LEG)
    ),
    "ANYmal": Kind(ANYMAL_B, ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT"), "point", ("LF_HAA", "LF_HFE", "LF_KFE")),
    "Talos": Kind(
        TALOS_FULL, ("left_sole_link", "right_sole_link"), "flat", tuple(f"leg_left_{k}_joint" for k in range(1, 7))
    ),
}


@dataclass(frozen=True)
class World:
    """A true robot that differs from its URDF, and what was recorded of it."""

    kind: Kind
    robot: Robot
    oracle: Oracle
    logs: list[Samples]


@cache
def world(name: str) -> World:
    """Made once per robot: the oracle's Python loops cost more than the fits."""
    kind, rng = KINDS[name], np.random.default_rng(len(name))
    robot = load(kind.urdf)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    size = 3 if kind.foot == "point" else 6
    contacts = [(frame, size) for frame in kind.feet]
    logs = [make_log(oracle, contacts, kind.states, n, rng, f"{n}.npz") for n in (SAMPLES // 3, SAMPLES * 2 // 3)]
    return World(kind, robot, oracle, [bind_log(log, robot, kind.contacts) for log in logs])


def fit(w: World, sensors: SensorSet, logs: Sequence[Samples] | None = None, **options: int) -> Estimate:
    """Least squares on logs whose unmeasured forces are not even numbers."""
    builder = RowBuilder(w.robot, w.kind.contacts, sensors)
    hidden = [hide(samples, sensors) for samples in logs or w.logs]
    factor = compress(hidden, builder, **options)  # type: ignore[arg-type]
    return LeastSquares().solve(linear_problem(factor, builder, w.robot))


def hide(samples: Samples, sensors: SensorSet) -> Samples:
    """NaN for all that the sensors do not measure: nothing can leak into the fit."""
    assert samples.torque is not None
    assert samples.wrench is not None
    torque, wrench = samples.torque.clone(), samples.wrench.clone()
    torque[:, ~torch.from_numpy(sensors.torque)] = torch.nan
    wrench[:, ~torch.from_numpy(sensors.wrench)] = torch.nan
    return replace(samples, torque=torque, wrench=wrench)


@cache
def unseen(name: str) -> tuple[Array, Array, Array]:
    return random_states(np.random.default_rng(99), world(name).robot.n, UNSEEN)


def predicted(robot: Robot, phi: Array, q: Array, v: Array, a: Array) -> Array:
    """K phi, (B, nv), by the dense regressor."""
    return (Regressor(robot)(*map(torch.from_numpy, (q, v, a))) @ torch.from_numpy(phi)).numpy()


def true_parameters(oracle: Oracle, robot: Robot) -> Array:
    """All parameters of the oracle by the robot's bodies, (L, 12); without friction where no joint moves."""
    phi = np.zeros(robot.nominal.shape)
    phi[:, parameters.INERTIAL] = oracle.inertial_parameters(robot)
    for index, body in enumerate(robot.bodies):
        if body.joint is not None and body.joint.name in oracle.moving:
            phi[index, parameters.FRICTION] = oracle.friction[oracle.moving.index(body.joint.name)]
    return phi


def driving(robot: Robot) -> set[str]:
    """Joints that others mimic."""
    return {body.joint.mimic.master for body in robot.bodies if body.joint and body.joint.mimic}


def worst(found: Array, true: Array) -> float:
    """Largest error over largest force among the base forces, base moments and joint torques."""
    groups = [g for g in (slice(0, 3), slice(3, 6), slice(6, None)) if true[:, g].size]
    return max(float(np.abs(found[:, g] - true[:, g]).max() / np.abs(true[:, g]).max()) for g in groups)
