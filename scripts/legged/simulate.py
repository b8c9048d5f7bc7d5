"""Exact logs of a true robot: along a prescribed motion by inverse dynamics, or simulated on its feet in MuJoCo."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from legged.gait import Motion, Reference
from legged.robots import FRICTION_WIDTH, TrueRobot
from torchid.logs import Log
from torchid.parameters import Array

RATE = 500.0  # Hz, of logs
_PLANNED_HZ = 100.0
_SETTLE_S = 0.5  # cut off at the beginning
_FALLEN = 0.15  # m, of the base's height from the planned one
_CLOSED = 1e-6  # N or N m


@dataclass(frozen=True)
class Exact:
    """What truly happened.

    Attributes:
        log: positions, velocities, accelerations, torques and contact forces of the same instants.
        rate: generalized velocity half a step later, (N, 6 + n): the rate of the positions in a simulation with steps.
        arm: from the frames' origins to where the ground acts, mean weighted by force, (N, F, 3) [m], world axes.
    """

    log: Log
    rate: Array
    arm: Array


def prescribed(true: TrueRobot, reference: Reference, seconds: float, name: str = "prescribed") -> Exact:
    """Exact inverse dynamics along the reference, the ground acting at the lowest points of the spheres.

    Coulomb friction has the sign of the velocity. Feet may pull on the ground.

    Raises:
        ValueError: the feet that stand cannot hold the base.
    """
    motion = reference.at(_SETTLE_S + np.arange(round(seconds * RATE)) / RATE)
    forces = _inverse_dynamics(true, motion)
    if not forces.missed < _CLOSED:
        raise ValueError(f"{true.legged.name}: the feet cannot hold the base, by {forces.missed:.2g} N or N m")
    velocity = motion.v[:, 6:]
    friction = true.friction[:, 0] * np.sign(velocity) + true.friction[:, 1] * velocity
    record = _Recorder(true, len(motion.time))
    record.q, record.v, record.after, record.a = motion.q, motion.v, motion.v, motion.a
    record.torque, record.wrench, record.arm = forces.torque + friction, forces.wrench, forces.arm
    record.active = motion.ready > 0.0
    return record.exact(name)


def simulated(true: TrueRobot, reference: Reference, seconds: float, name: str = "simulated") -> Exact:
    """The robot on its feet, joints driven towards the reference by stiff controllers and the torque that it needs.

    Raises:
        ValueError: it falls.
    """
    model, data = true.model, mujoco.MjData(true.model)
    step = model.opt.timestep
    time = np.arange(round((_SETTLE_S + seconds) / step)) * step
    wanted = reference.at(time)
    ahead = _needed_torque(true, reference, time)
    first, every = round(_SETTLE_S / step), round(1.0 / (RATE * step))
    record = _Recorder(true, -((first - len(time)) // every))
    p, d = (gain * true.strength for gain in true.legged.gains)
    coulomb, viscous = true.friction.T
    data.qpos[:] = wanted.q[0]
    wanted_q, wanted_v = wanted.q[:, 7:], wanted.v[:, 6:]
    for i in range(len(time)):
        mujoco.mj_step1(model, data)
        v = data.qvel[6:]
        torque = ahead[i] + p * (wanted_q[i] - data.qpos[7:]) + d * (wanted_v[i] - v)
        friction = 0.0 if true.dry else coulomb * np.tanh(v / FRICTION_WIDTH) + viscous * v
        data.qfrc_applied[6:] = torque - friction
        number = (i - first) // every if i >= first and (i - first) % every == 0 else None
        if number is not None:
            record.state(number, data, torque)
        mujoco.mj_step2(model, data)
        if number is not None:
            record.forces(number, data)
            if not abs(data.qpos[2] - wanted.q[i, 2]) < _FALLEN:
                raise ValueError(f"{true.legged.name}: falls at {time[i]:.2f} s")
    return record.exact(name)


def _needed_torque(true: TrueRobot, reference: Reference, time: Array) -> Array:
    """Joint torques (N, n) [N m] that the reference takes, friction included; where feet cannot hold it, nearly."""
    planned = reference.at(np.arange(round((time[-1] + 0.1) * _PLANNED_HZ)) / _PLANNED_HZ)
    torque = _inverse_dynamics(true, planned).torque + true.friction_torque(planned.v[:, 6:])
    at = time * _PLANNED_HZ
    index = np.minimum(at.astype(int), len(torque) - 2)
    share = (at - index)[:, None]
    return (1.0 - share) * torque[index] + share * torque[index + 1]


@dataclass(frozen=True)
class _Forces:
    """Joint torques without friction (N, n), wrenches (N, F, 6) and arms (N, F, 3), and what no foot can hold."""

    torque: Array
    wrench: Array
    arm: Array
    missed: float


def _inverse_dynamics(true: TrueRobot, motion: Motion) -> _Forces:
    """Forces along a motion; those of the ground have the least sum of squares, feet that are not ready taking less."""
    model = copy.deepcopy(true.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.dof_damping[:] = 0.0
    data, spheres = mujoco.MjData(model), list(true.foot_of_geom.items())
    feet, nv = [foot for _, foot in spheres], model.nv
    bodies = [int(model.geom_bodyid[geom]) for geom, _ in spheres]
    down = np.array([0.0, 0.0, true.legged.radius])
    count = len(motion.time)
    torque, wrench = np.zeros((count, nv - 6)), np.zeros((count, len(true.legged.feet), 6))
    arm, missed = np.zeros((count, len(true.legged.feet), 3)), 0.0
    J = np.zeros((len(spheres), 3, nv))
    for i in range(count):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[i], motion.v[i], motion.a[i]
        mujoco.mj_inverse(model, data)
        needed = data.qfrc_inverse
        points = data.geom_xpos[[geom for geom, _ in spheres]] - down
        for Jp, point, body in zip(J, points, bodies, strict=True):
            mujoco.mj_jac(model, data, Jp, None, point, body)
        A = J.reshape(-1, nv)[:, :6].T
        weighted = A * np.repeat(motion.ready[i, feet], 3)
        force = weighted.T @ (np.linalg.pinv(weighted @ A.T, rcond=1e-6) @ needed[:6])
        missed = max(missed, float(np.abs(A @ force - needed[:6]).max()))
        torque[i] = (needed - J.reshape(-1, nv).T @ force)[6:]
        wrench[i], arm[i] = _gather(true.origins(data), feet, points, force.reshape(-1, 3))
    return _Forces(torque, wrench, arm, missed)


def _gather(origins: Array, feet: list[int], points: Array, force: Array) -> tuple[Array, Array]:
    """Wrenches at the feet's origins (F, 6), and mean arms (F, 3), of forces (k, 3) on feet at points (k, 3)."""
    wrench, arm, weight = np.zeros((len(origins), 6)), np.zeros((len(origins), 3)), np.zeros(len(origins))
    for foot, point, one in zip(feet, points, force, strict=True):
        lever = point - origins[foot]
        wrench[foot] += np.concatenate([one, np.cross(lever, one)])
        arm[foot] += abs(one[2]) * lever
        weight[foot] += abs(one[2])
    return wrench, arm / np.where(weight > 0.0, weight, 1.0)[:, None]


class _Recorder:
    """Samples of what happens in a simulation."""

    def __init__(self, true: TrueRobot, count: int) -> None:
        self._true, nv, feet = true, true.model.nv, len(true.legged.feet)
        self.q, self.v, self.after, self.a = np.zeros((count, nv + 1)), *np.zeros((3, count, nv))
        self.torque = np.zeros((count, nv - 6))
        self.wrench, self.arm = np.zeros((count, feet, 6)), np.zeros((count, feet, 3))
        self.active = np.zeros((count, feet), dtype=bool)

    def state(self, number: int, data: Any, torque: Array) -> None:
        """Before the integration, which changes position and velocity."""
        self.q[number], self.v[number], self.torque[number] = data.qpos, data.qvel, torque

    def forces(self, number: int, data: Any) -> None:
        """After it: accelerations and contact forces are those of the instant before."""
        forces = (data.qfrc_smooth + data.qfrc_constraint)[None]
        mujoco.mj_solveM(self._true.model, data, self.a[number : number + 1], forces)  # qacc is that to 1e-6 only
        self.after[number] = data.qvel
        feet, points, force, local = [], [], [], np.zeros(6)
        for k in range(data.ncon):
            contact = data.contact[k]
            mujoco.mj_contactForce(self._true.model, data, k, local)
            feet.append(self._true.foot_of_geom[int(contact.geom[1])])
            points.append(contact.pos.copy())
            force.append(contact.frame.reshape(3, 3).T @ local[:3])
        self.wrench[number], self.arm[number] = _gather(
            self._true.origins(data), feet, np.array(points), np.array(force)
        )
        self.active[number] = self.wrench[number].any(axis=1)

    def exact(self, name: str) -> Exact:
        """All of it as a log."""
        log = Log(
            name,
            time=np.arange(len(self.q)) / RATE,
            joint_names=self._true.robot.joint_names,
            joint_position=self.q[:, 7:],
            joint_velocity=self.v[:, 6:],
            joint_acceleration=self.a[:, 6:],
            joint_torque=self.torque,
            base_position_world=self.q[:, :3],
            base_quat_xyzw=self.q[:, [4, 5, 6, 3]],
            base_linear_velocity_world=self.v[:, :3],
            base_angular_velocity_base=self.v[:, 3:6],
            base_linear_acceleration_world=self.a[:, :3],
            base_angular_acceleration_base=self.a[:, 3:6],
            contact_names=self._true.legged.feet,
            contact_active=self.active,
            contact_wrench_world=self.wrench,
        )
        return Exact(log, 0.5 * (self.v + self.after), self.arm)
