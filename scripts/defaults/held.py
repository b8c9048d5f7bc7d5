"""Robots whose base is held: an arm on a table, a quadruped on a stand."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
from lxml import etree

from defaults.models import Model
from torchid.logs import Log
from torchid.parameters import Array

RATE = 1000.0  # Hz
_WAVES = 5
_STEP = 5e-4


class Excitation:
    """Sums of sines about a posture, within a share of the joints' ranges."""

    def __init__(self, rng: np.random.Generator, centre: Array, reach: Array, hz: tuple[float, float]) -> None:
        """Draw it; `reach`: (n,) [rad], never exceeded."""
        self._centre = centre
        self._hz = rng.uniform(*hz, (_WAVES, len(centre)))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (_WAVES, len(centre)))
        size = rng.uniform(0.3, 1.0, (_WAVES, len(centre)))
        self._size = reach * size / size.sum(axis=0)

    def at(self, time: Array) -> tuple[Array, Array, Array]:
        """Positions, velocities and accelerations (N, n)."""
        rate = 2.0 * np.pi * self._hz
        angle = time[:, None, None] * rate + self._phase
        q = self._centre + (self._size * np.sin(angle)).sum(axis=1)
        v = (self._size * rate * np.cos(angle)).sum(axis=1)
        return q, v, -(self._size * rate**2 * np.sin(angle)).sum(axis=1)


def prescribed(model: Model, motion: Excitation, seconds: float, friction: Array, armature: Array) -> Log:
    """The motion as planned, with torques by inverse dynamics; Coulomb friction has the sign of the velocity."""
    time = np.arange(round(seconds * RATE)) / RATE
    q, v, a = motion.at(time)
    torque = model.forces(model.configuration(q), model.rates(v), model.rates(a))
    torque += friction[:, 0] * np.sign(v) + friction[:, 1] * v + armature * a
    return _log(model, time, q, v, a, torque)


def simulated(
    model: Model, urdf: Path, motion: Excitation, seconds: float, friction: Array, armature: Array, integrator: str
) -> Log:
    """Driven along the motion by stiff controllers in MuJoCo, whose dry friction sticks."""
    plant = _compile(urdf, model, friction, armature, integrator)
    data = mujoco.MjData(plant)
    time = np.arange(round((0.5 + seconds) / _STEP), dtype=float) * _STEP
    q, v, a = motion.at(time)
    order = [int(plant.joint(name).id) for name in model.joints]
    inertia = model.inertias(model.configuration(q[::2000])) + armature
    p, d = inertia * 60.0**2, inertia * 2.0 * 60.0
    data.qpos[order], data.qvel[order] = q[0], v[0]
    every, first = round(1.0 / (RATE * _STEP)), round(0.5 / _STEP)
    count = (len(time) - first) // every
    record = np.zeros((4, count, len(order)))
    for i in range(len(time)):
        mujoco.mj_step1(plant, data)
        at, speed = data.qpos[order].copy(), data.qvel[order].copy()
        # gravity and what moves: a controller of the true robot, so that it follows
        torque = p * (q[i] - at) + d * (v[i] - speed) + data.qfrc_bias[order] + inertia * a[i]
        data.qfrc_applied[order] = torque
        mujoco.mj_step2(plant, data)
        number = (i - first) // every
        if i >= first and (i - first) % every == 0 and number < count:
            record[:, number] = at, speed, (data.qvel[order] - speed) / _STEP, torque
    return _log(model, np.arange(count) / RATE, *record)


def _compile(urdf: Path, model: Model, friction: Array, armature: Array, integrator: str) -> mujoco.MjModel:
    root = etree.parse(str(urdf)).getroot()
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    for joint in root.findall("joint"):
        if joint.get("type") != "fixed" and joint.get("name") not in model.joints:
            joint.set("type", "fixed")
    spec = mujoco.MjSpec.from_string(etree.tostring(root, encoding="unicode"))
    spec.compiler.balanceinertia, spec.compiler.fusestatic = False, True
    spec.option.timestep = _STEP
    spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    plant = spec.compile()
    plant.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    for k, name in enumerate(model.joints):
        dof = plant.joint(name).id
        plant.dof_frictionloss[dof], plant.dof_damping[dof] = friction[k]
        plant.dof_armature[dof] = armature[k]
    mujoco.mj_setConst(plant, mujoco.MjData(plant))
    return plant


def _log(model: Model, time: Array, q: Array, v: Array, a: Array, torque: Array) -> Log:
    return Log(
        "held",
        time=time,
        joint_names=model.joints,
        joint_position=q,
        joint_velocity=v,
        joint_acceleration=a,
        joint_torque=torque,
    )
