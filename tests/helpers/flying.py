"""A drone with an arm that flies: the wrench of its rotors is recorded at its base."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from legged.trajectories import BaseMotion, waves
from mistaken import Case
from scipy.interpolate import make_interp_spline
from synthetic import ROBOTS, Oracle
from walking import KNOTS_HZ, Machine, Truth, recorded, robot_of, unlike

FLYERS: Mapping[str, Path] = {
    "borinot": ROBOTS / "borinot_description/urdf/borinot_flying_arm_2.urdf",
    "hextilt": ROBOTS / "hextilt_description/urdf/hextilt_flying_arm_5.urdf",
}


def flight(name: str, sensors: str, seed: int, seconds: float = 12.0, rate: float = 200.0) -> Case:
    """A log of a drone that is up to 15 % unlike its URDF, without friction."""
    machine = Machine(name, FLYERS[name], (f"{name}__base_link",))
    robot, rng = robot_of(machine), np.random.default_rng(seed)
    oracle, knots = Oracle.of(robot), np.arange(round(seconds * KNOTS_HZ) + 1) / KNOTS_HZ
    time = np.arange(round(seconds * rate)) / rate
    joints = make_interp_spline(knots, 0.8 * waves(rng, knots, robot.n, 0.15, 0.7), k=5)
    path = waves(rng, knots, 6, 0.15, 0.8) * [0.5, 0.5, 0.5, 0.15, 0.15, 0.225]
    path[:, 3] += rng.uniform(-3.0, 3.0)
    origin = make_interp_spline(knots, path, k=5)
    base = BaseMotion.along(origin, time, in_base=True)
    q = np.hstack([origin(time)[:, :3], base.rotation.as_quat(), joints(time)])
    v = np.hstack([base.linear, base.angular, joints(time, 1)])
    a = np.hstack([base.linear_rate, base.angular_rate, joints(time, 2)])
    unlike(oracle, rng, 0.15)
    needed, J = oracle.frictionless_forces(q, v, a), oracle.jacobian(q, machine.feet[0])
    wrench = np.linalg.solve(J[:, :, :6].transpose(0, 2, 1), needed[:, :6, None])[..., 0]
    torque = (needed - np.einsum("nkj,nk->nj", J, wrench))[:, 6:]
    happened = Truth(time, q, v, a, torque, wrench[:, None], np.ones((len(time), 1)))
    return Case(machine, happened, recorded(machine, happened, sensors, seed))
