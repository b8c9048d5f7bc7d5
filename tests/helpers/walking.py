"""Robots that walk, and arms that swing, with feet that stand still and forces of a machine unlike its URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from legged.trajectories import BaseMotion, Swing, waves
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from simulated import BIPED, QUADRUPED
from synthetic import G1, PANDA, Array, Oracle, load

from torchid.logs import Log
from torchid.robot import Robot
from torchid.sensing import Contact

KNOTS_HZ = 50.0
LAG = 0.01  # [s] of the force sensors' filter
RAMP = 0.12  # [s] in which a foot takes its load, and gives it away


@dataclass(frozen=True, eq=False)
class Machine:
    """A robot and how it walks: feet that are lifted in turn, each swinging for a while."""

    name: str
    urdf: Path
    feet: tuple[str, ...] = ()
    kind: str = "flat"
    posture: Mapping[str, float] = field(default_factory=dict)
    swing: float = 0.5  # [s]
    both: float = 0.35  # [s] from one foot's swing to the next
    lift: float = 0.05  # [m]
    size: float = 0.02  # [m] and 4 x [rad] of how the base sways beside

    @property
    def contacts(self) -> tuple[Contact, ...]:
        return tuple(Contact(foot, self.kind) for foot in self.feet)

    @property
    def bolted(self) -> bool:
        return not self.feet


def _bent(pairs: Sequence[tuple[str, float]], *limbs: str) -> dict[str, float]:
    return {limb.format(joint): angle for limb in limbs for joint, angle in pairs}


_LEG = (("hip_flexion", -0.45), ("knee_flexion", 0.9), ("ankle_flexion", -0.45))
_G1_LEG = (("hip_pitch_joint", -0.4), ("knee_joint", 0.8), ("ankle_pitch_joint", -0.4))
_G1_ARM = (("shoulder_roll_joint", 0.0), ("elbow_joint", 0.6))
_PAW = (("thigh", 0.6), ("knee", -1.2))
_PAWS = ("front_left", "front_right", "rear_left", "rear_right")

MACHINES = {
    one.name: one
    for one in (
        Machine("biped", BIPED, ("l_sole", "r_sole"), posture=_bent(_LEG, "l_{}", "r_{}")),
        Machine(
            "quadruped",
            QUADRUPED,
            tuple(f"{leg}_foot" for leg in _PAWS),
            "point",
            _bent(_PAW, *(f"{leg}_{{}}" for leg in _PAWS)),
            swing=0.4,
            both=0.3,
            size=0.015,
        ),
        Machine(
            "humanoid",
            G1,
            ("left_ankle_roll_link", "right_ankle_roll_link"),
            posture=_bent((*_G1_LEG, *_G1_ARM), "left_{}", "right_{}"),
        ),
        Machine("arm", PANDA, posture={"panda_joint4": -1.5, "panda_joint6": 1.5}),
    )
}


@cache
def robot_of(machine: Machine) -> Robot:
    """The robot by its URDF."""
    return load(machine.urdf, None, machine.bolted)


@dataclass(frozen=True)
class Truth:
    """What happened: coordinates (N, 7 + n), velocities and accelerations (N, 6 + n) as Pinocchio has them, forces."""

    time: Array
    q: Array
    v: Array
    a: Array
    torque: Array
    wrench: Array  # (N, C, 6), local
    share: Array  # (N, C), of the load that a foot is ready to take


class Gait:
    """Where the feet are and what they carry, at any time."""

    def __init__(self, machine: Machine, home: Array, seconds: float, rng: np.random.Generator) -> None:
        """Plan swings of feet that start at `home` (C, 3) [m]."""
        self.machine, self.home = machine, home
        period, feet = machine.swing + machine.both, len(machine.feet)
        starts = np.arange(0.6, seconds + period, period)
        order = [0, 3, 1, 2] if feet == 4 else list(range(feet))
        turn = int(rng.integers(feet))
        self.swings = [(float(t), order[(i + turn) % feet]) for i, t in enumerate(starts)]
        step = rng.uniform(-0.06, 0.1) if feet == 2 else rng.uniform(-0.04, 0.06)
        self.strides = [np.array([step, 0.0, 0.0]) + rng.uniform(-0.01, 0.01, 3) * [1, 1, 0] for _ in self.swings]
        self.forward = step / (feet * period)

    def feet(self, time: Array) -> tuple[Array, Array]:
        """Positions (N, C, 3) [m] and readiness to carry (N, C)."""
        place = np.repeat(self.home[None], len(time), axis=0)
        ready = np.ones((len(time), len(self.home)))
        for (start, foot), stride in zip(self.swings, self.strides, strict=True):
            swing = Swing.at(time, start, self.machine.swing, self.machine.lift, RAMP)
            place[:, foot] += swing.progress[:, None] * stride
            place[:, foot, 2] += swing.height
            ready[:, foot] = np.minimum(ready[:, foot], swing.ready)
        return place, ready

    def sway(self, time: Array) -> Array:
        """Horizontal path (N, 2) [m] that keeps the base over the feet that carry."""
        knots, places = [0.0], [self.home[:, :2].mean(axis=0)]
        for start, foot in self.swings:
            at = start + 0.5 * self.machine.swing
            stance = np.delete(self.feet(np.array([at]))[0][0, :, :2], foot, axis=0)
            knots.append(at)
            places.append(stance.mean(axis=0))
        return np.asarray(CubicSpline(knots, places)(time))


def _legs(oracle: Oracle, frame: str) -> list[int]:
    """Velocity indices of the joints between the base and a frame."""
    model = oracle.model
    joint = model.frames[model.getFrameId(frame, pin.FrameType.BODY)].parentJoint
    found = []
    while joint > 1:
        found.append(model.joints[joint].idx_v)
        joint = model.parents[joint]
    return found[::-1]


def reach(oracle: Oracle, machine: Machine, q: Array, targets: Array, turn: Array) -> Array:
    """Coordinates q (N, 7 + n) with feet moved to targets (N, C, 3) and, flat ones, to rotations (C, 3, 3)."""
    model, data = oracle.model, oracle.data
    out = np.array([oracle.coordinates(one) for one in q])
    legs = [(model.getFrameId(foot, pin.FrameType.BODY), _legs(oracle, foot)) for foot in machine.feet]
    flat = machine.kind == "flat"
    for i in range(len(out)):
        full = out[i]
        if i:
            for _, leg in legs:
                full[np.array(leg) + 1] = out[i - 1, np.array(leg) + 1]
        for _ in range(12):
            pin.computeJointJacobians(model, data, full)
            pin.updateFramePlacements(model, data)
            worst = 0.0
            for k, (frame, leg) in enumerate(legs):
                placed = data.oMf[frame]
                error = targets[i, k] - placed.translation
                if flat:
                    error = np.append(error, placed.rotation @ pin.log3(placed.rotation.T @ turn[k]))
                J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[: len(error), leg]
                full[np.array(leg) + 1] += J.T @ np.linalg.solve(J @ J.T + 1e-9 * np.eye(len(J)), error)
                worst = max(worst, float(np.abs(error).max()))
            if worst < 1e-10:
                break
        else:
            raise ValueError(f"{machine.name}: out of reach at knot {i} by {worst:.2g}")
    places = [model.joints[model.getJointId(name)].idx_q for name in oracle.joint_names]
    return np.hstack([out[:, :7], out[:, places]])


def _carried(J: Array, needed: Array, ready: Array, kind: str) -> Array:
    """Wrenches (N, C, 6) that hold the base: the least sum of squares, feet that are not ready taking less."""
    size = np.array([1.0, 1.0, 1.0, 0.08, 0.08, 0.08] if kind == "flat" else [1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) ** 2
    weight = (ready[:, :, None] * size).reshape(len(J), -1)
    A = J.reshape(len(J), -1, J.shape[-1])[:, :, :6].transpose(0, 2, 1)  # (N, 6, 6 C)
    weighted = A * weight[:, None]
    solved = np.linalg.solve(weighted @ A.transpose(0, 2, 1), needed[:, :6, None])
    return (weighted.transpose(0, 2, 1) @ solved)[..., 0].reshape(len(J), -1, 6)


@cache
def truth(
    machine: Machine, seed: int, heading: float | None = None, seconds: float = 12.0, rate: float = 200.0,
    share: float = 0.15,
) -> Truth:  # fmt: skip
    """What happened to a robot that is up to `share` unlike its URDF and walks along a heading [rad], None for any."""
    rng, robot = np.random.default_rng(seed), robot_of(machine)
    oracle = Oracle.of(robot)
    knots = np.arange(round(seconds * KNOTS_HZ) + 1) / KNOTS_HZ
    time = np.arange(round(seconds * rate)) / rate
    n = robot.n
    posture = np.array([machine.posture.get(name, 0.0) for name in robot.joint_names])
    joints = posture + (0.5 if machine.bolted else 0.15) * waves(rng, knots, n, 0.15, 0.7)
    if machine.bolted:
        path = make_interp_spline(knots, joints, k=5)
        q, v, a = path(time), path(time, 1), path(time, 2)
        wrench, ready, J = np.zeros((len(time), 0, 6)), np.ones((len(time), 0)), np.zeros((len(time), 0, 6, n))
    else:
        path, gait = _walked(machine, robot, oracle, knots, joints, rng)
        base = BaseMotion.along(path[0], time, in_base=True)
        legs = path[1]
        q = np.hstack([path[0](time)[:, :3], base.rotation.as_quat(), legs(time)])
        v, a = (
            np.hstack([base.linear, base.angular, legs(time, 1)]),
            np.hstack([base.linear_rate, base.angular_rate, legs(time, 2)]),
        )
        ready = gait.feet(time)[1]
        J = np.stack([oracle.jacobian(q, foot) for foot in machine.feet], axis=1)
    unlike(oracle, rng, share)
    if not machine.bolted:  # the world's axes are anybody's
        anywhere = rng.uniform(0.4, 1.2) * rng.choice([-1.0, 1.0])
        turn = Rotation.from_euler("z", anywhere if heading is None else heading)
        q[:, :3], q[:, 3:7] = turn.apply(q[:, :3]), (turn * Rotation.from_quat(q[:, 3:7])).as_quat()
    needed = oracle.frictionless_forces(q, v, a)
    if not machine.bolted:
        wrench = _carried(J, needed, ready, machine.kind)
        needed = needed - np.einsum("nckj,nck->nj", J, wrench)
    torque = needed[:, oracle.base :] + _friction(rng, v[:, oracle.base :], needed[:, oracle.base :], share)
    return Truth(time, q, v, a, torque, wrench, ready)


def _walked(
    machine: Machine, robot: Robot, oracle: Oracle, knots: Array, joints: Array, rng: np.random.Generator
) -> tuple[tuple[Any, Any], Gait]:
    """Splines of the base's position and angles, and of the joints, with feet that stay where they stand."""
    stand = np.concatenate([[0, 0, 0, 0, 0, 0, 1], [machine.posture.get(name, 0.0) for name in robot.joint_names]])
    placed = [oracle.pose(stand[None], foot) for foot in machine.feet]
    home, turn = np.stack([p[0] for _, p in placed]), np.stack([R[0] for R, _ in placed])
    gait = Gait(machine, home, float(knots[-1]) + 0.5, rng)
    swaying = waves(rng, knots, 6, 0.3, 1.5)
    base = np.zeros((len(knots), 6))
    lean = 0.4 if len(machine.feet) == 2 else 0.6  # what is left where the zero-moment point is to stay over the feet
    ideal = gait.sway(knots) - gait.home[:, :2].mean(axis=0)
    base[:, :2] = ideal * [1.0, lean]
    base[:, :3] += machine.size * swaying[:, :3]
    base[:, 2] -= 0.01
    base[:, 3:] = 4.0 * machine.size * swaying[:, 3:]
    turned = Rotation.from_euler("ZYX", base[:, 3:]).as_quat()
    q = reach(oracle, machine, np.hstack([base[:, :3], turned, joints]), gait.feet(knots)[0], turn)
    return (make_interp_spline(knots, base, k=5), make_interp_spline(knots, q[:, 7:], k=5)), gait


def unlike(oracle: Oracle, rng: np.random.Generator, share: float) -> None:
    """Change masses by up to `share`, centres of mass by as much of the body's radius, inertias accordingly."""
    for index in range(oracle.model.njoints):
        inertia = oracle.model.inertias[index]
        if inertia.mass > 0.0 and share > 0.0:
            m, i = 1.0 + share * rng.uniform(-1.0, 1.0, 2)
            radius = np.sqrt(np.trace(inertia.inertia) / (2.0 * inertia.mass))
            lever = inertia.lever + share * radius * rng.uniform(-1.0, 1.0, 3)
            oracle.model.inertias[index] = pin.Inertia(m * inertia.mass, lever, i * m * inertia.inertia)


def _friction(rng: np.random.Generator, v: Array, torque: Array, share: float) -> Array:
    """Friction that no URDF has: a tenth of what the joint gives, at most 3 N m, Coulomb and viscous."""
    if share == 0.0:
        return np.zeros_like(v)
    size = np.minimum(3.0, 0.15 * np.sqrt(np.square(torque).mean(axis=0))) * rng.uniform(0.2, 1.0, v.shape[1])
    return size * (np.tanh(v / 0.05) + 0.3 * v)


def specific_force(happened: Truth) -> Array:
    """What an accelerometer at the base's origin reads, (N, 3) [m/s^2]."""
    v, a = happened.v, happened.a
    gravity = Rotation.from_quat(happened.q[:, 3:7]).inv().apply([0.0, 0.0, -9.81])
    return a[:, :3] + np.cross(v[:, 3:6], v[:, :3]) - gravity


FIELDS = {
    "full": ("joint_torque", "contact_wrench_local", "base_position_world"),
    "contacts": ("contact_wrench_local", "base_position_world"),
    "joints": ("joint_torque", "imu_specific_force", "imu_angular_velocity", "imu_frame"),
}


def recorded(machine: Machine, happened: Truth, sensors: str = "full", seed: int = 0, noise: float = 1.0) -> Log:
    """The log of a sensor set: positions and orientation; forces with noise, behind a filter of 10 ms."""
    rng, robot = np.random.default_rng([seed, 7]), robot_of(machine)
    time, q, count = happened.time, happened.q, len(happened.time)
    step = float(time[1] - time[0])

    def read(values: Array, size: Array | float) -> Array:
        blend = 1.0 - np.exp(-step / LAG)
        late, _ = lfilter([blend], [1.0, blend - 1.0], values, axis=0, zi=(1.0 - blend) * values[:1])
        return late + noise * size * rng.normal(size=values.shape)

    torque = read(happened.torque, 0.01 * np.sqrt(np.square(happened.torque).mean(axis=0)) + 0.02)
    if machine.bolted:
        return Log(
            machine.name, time, robot.joint_names, q + 1e-4 * noise * rng.normal(size=q.shape), joint_torque=torque
        )
    active = happened.share > 0.0
    weight = 9.81 * float(robot.nominal[:, 0].sum())
    size = weight * np.array([2e-3, 2e-3, 2e-3, 2e-4, 2e-4, 2e-4])
    wrench = happened.wrench * happened.share[..., None].astype(bool)
    if machine.kind == "point":
        size[3:] = 0.0
    known = {
        "joint_torque": torque,
        "contact_wrench_local": read(wrench, size),
        "imu_frame": robot.bodies[0].name,
        "imu_specific_force": specific_force(happened) + 0.02 * noise * rng.normal(size=(count, 3)),
        "imu_angular_velocity": happened.v[:, 3:6] + 2e-3 * noise * rng.normal(size=(count, 3)),
        "base_position_world": q[:, :3] + 1e-4 * noise * rng.normal(size=(count, 3)),
    }
    fields: dict[str, Any] = {name: known[name] for name in FIELDS[sensors]}
    tilt = Rotation.from_rotvec(2e-4 * noise * rng.normal(size=(count, 3)))
    quat = (Rotation.from_quat(q[:, 3:7]) * tilt).as_quat()
    return Log(
        machine.name,
        time,
        robot.joint_names,
        q[:, 7:] + 1e-4 * noise * rng.normal(size=(count, robot.n)),
        base_quat_xyzw=quat,
        contact_names=machine.feet,
        contact_active=active,
        **fields,
    )
