"""Robots that sway on feet which stand exactly where they are placed, on level or tilted floors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from synthetic import Array, Oracle
from walking import MACHINES, Machine, reach, robot_of

from torchid.logs import Log
from torchid.problem.base_pose import rolled_distance
from torchid.sensing import Contact

RATE = 100.0
Lift = tuple[int, int, int]  # foot, first and last sample in the air


@dataclass(frozen=True, eq=False)
class Stance:
    """A log of joint positions and contact flags, and the pose of the base that goes with it."""

    machine: Machine
    log: Log
    rotation: Array  # (N, 3, 3)
    position: Array  # (N, 3) [m]
    normal: tuple[float, float, float]
    radius: float

    def contacts(self, kind: str | None = None) -> tuple[Contact, ...]:
        kind = kind or self.machine.kind
        return tuple(Contact(foot, kind, radius=self.radius, normal=self.normal) for foot in self.machine.feet)

    @property
    def measured(self) -> Log:
        """The log with the pose of the base."""
        quat = Rotation.from_matrix(self.rotation).as_quat()
        flips = np.cumsum(np.concatenate([[False], (quat[1:] * quat[:-1]).sum(axis=1) < 0.0])) % 2
        quat = quat * np.where(flips, -1.0, 1.0)[:, None]
        return replace(self.log, base_quat_xyzw=quat, base_position_world=self.position)


@cache
def stance(
    name: str,
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0),
    radius: float = 0.0,
    lifts: tuple[Lift, ...] = (),
    samples: int = 160,
    seed: int = 0,
) -> Stance:
    """A machine of `MACHINES` whose feet stand askew; a lifted foot comes down at another place."""
    machine, rng = MACHINES[name], np.random.default_rng(seed)
    robot = robot_of(machine)
    oracle, time = Oracle.of(robot), np.arange(samples) / RATE
    posture = np.array([machine.posture.get(joint, 0.0) for joint in robot.joint_names])
    stand = np.concatenate([[0, 0, 0, 0, 0, 0, 1], posture])
    placed = [oracle.pose(stand[None], foot) for foot in machine.feet]
    home = np.stack([p[0] for _, p in placed])
    floor = float(home[:, 2].min()) - radius
    spots = home + rng.uniform(-0.03, 0.03, home.shape) * [1.0, 1.0, 0.0]
    spots[:, 2] = radius + floor
    yaws = Rotation.from_euler("z", rng.uniform(-0.2, 0.2, (len(home), 1)))
    turn = yaws.as_matrix() @ np.stack([R[0] for R, _ in placed])
    phase, speed = rng.uniform(0.0, 6.0, 6), rng.uniform(2.0, 5.0, 6)
    waves = np.sin(time[:, None] * speed + phase)
    base = np.array([0.02, 0.02, 0.015]) * waves[:, :3] - [0.0, 0.0, 0.03]
    turned = Rotation.from_euler("ZYX", np.array([0.12, 0.06, 0.06]) * waves[:, 3:])
    targets = np.repeat(spots[None], samples, axis=0)
    active = np.ones((samples, len(spots)), dtype=bool)
    for foot, first, last in lifts:
        x = np.clip((np.arange(samples) - first) / (last - first), 0.0, 1.0)[:, None]
        targets[:, foot] += x**3 * (10.0 - 15.0 * x + 6.0 * x * x) * [0.03, -0.02, 0.0]
        targets[:, foot, 2:] += 0.03 * 64.0 * (x * (1.0 - x)) ** 3
        active[first:last, foot] = False
    joints = np.repeat(posture[None], samples, axis=0)
    q, rolled = stand, np.zeros_like(targets)
    for _ in range(6 if radius else 1):
        q = reach(oracle, machine, np.hstack([base, turned.as_quat(), joints]), targets + rolled, turn)
        for k, foot in enumerate(machine.feet):
            if radius:
                far = rolled_distance(oracle.pose(q, foot)[0], radius, np.array([0.0, 0.0, 1.0]))
                rolled[:, k] = _while_standing(far, active[:, k])
    to_world = _tilt(turned[0].as_matrix()[:, 0], normal)
    log = Log(name, time, robot.joint_names, q[:, 7:], contact_names=machine.feet, contact_active=active)
    position = (base - [0.0, 0.0, floor]) @ to_world.T
    return Stance(machine, log, to_world @ turned.as_matrix(), position, normal, radius)


def _while_standing(far: Array, active: Array) -> Array:
    """How far a foot has rolled (N, 3), with nothing while it is in the air."""
    steps = np.diff(far, axis=0, prepend=far[:1]) * (active & np.roll(active, 1))[:, None]
    return np.asarray(np.cumsum(steps, axis=0))


def _tilt(forward: Array, normal: Sequence[float]) -> Array:
    """Rotation (3, 3) of a level floor to one with a normal, on which `forward` has no part along the world's y."""
    up, n = np.array([0.0, 0.0, 1.0]), np.array(normal)
    axis = np.cross(up, n)
    lean = Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-300) * np.arccos(n[2]))

    def sideways(yaw: float) -> float:
        return float((lean * Rotation.from_euler("z", yaw)).apply(forward)[1])

    return (lean * Rotation.from_euler("z", brentq(sideways, -1.5, 1.5, xtol=1e-15))).as_matrix()
