"""Robots with closed loops, and their motion on the constraints as MuJoCo computes it, with its constraint forces."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from synthetic import Array

from torchid import parameters
from torchid.logs import Log
from torchid.regressor.loops import LoopClosures
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact

_OPTIONS = """<compiler angle="radian"/><option jacobian="dense"/>
 <default><joint damping="0.3" armature="0.01"/><geom contype="0" conaffinity="0"/></default>"""


def _ankle(side: str, y: float, linear: bool) -> str:
    """A leg whose ankle, a universal joint, two cranks or linear motors on the shank move by rods with ball ends."""
    rods, motor = "", 'type="slide" axis="0 0 1"' if linear else 'axis="0 1 0"'
    for name, x in (("front", 0.05), ("back", -0.05)):
        rods += f"""<body name="{side}_{name}_crank" pos="{x} 0.03 -0.1">
         <joint name="{side}_{name}_motor" {motor}/>
         <geom type="capsule" fromto="0 0 0 {x} 0 0" size=".01" mass=".2"/>
         <body name="{side}_{name}_rod" pos="{x} 0 0"><joint name="{side}_{name}_rod_x" axis="1 0 0"/>
          <joint name="{side}_{name}_rod_y" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 .01 -.2" size=".008" mass=".15"/></body></body>"""
    return f"""<body name="{side}_thigh" pos="0 {y} -.1"><joint name="{side}_roll" axis="1 0 0"/>
      <joint name="{side}_hip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.01 0 -.35" size=".04" mass="2.5"/>
      <body name="{side}_shank" pos="0 0 -.35"><joint name="{side}_knee" axis="0 1 0"/>
       <geom type="capsule" fromto="0 0 0 0 0.01 -.3" size=".03" mass="1.5"/>{rods}
       <body name="{side}_foot" pos="0 0 -.3"><joint name="{side}_pitch" axis="0 1 0"/>
        <joint name="{side}_ankle_roll" axis="1 0 0"/>
        <geom type="box" size=".1 .04 .01" pos=".03 0 -.04" mass=".8"/>
        <site name="{side}_sole" pos=".03 0 -.05"/></body>
      </body></body>"""


def _biped(linear: bool) -> str:
    closures = "".join(
        f'<connect name="{side}_{rod}" body1="{side}_{rod}_rod" body2="{side}_foot" anchor="0 .01 -.2"/>'
        for side in ("left", "right")
        for rod in ("front", "back")
    )
    motors = "".join(
        f'<motor joint="{side}_{name}"/>'
        for side in ("left", "right")
        for name in ("roll", "hip", "knee", "front_motor", "back_motor")
    )
    return f"""<mujoco>{_OPTIONS}<worldbody><body name="pelvis" pos="0 0 1"><freejoint/>
     <geom type="box" size=".1 .15 .1" pos=".02 0 .05" mass="9"/>
     {_ankle("left", 0.1, linear)}{_ankle("right", -0.1, linear)}</body></worldbody>
     <equality>{closures}</equality><actuator>{motors}</actuator></mujoco>"""


def _leg(weld: bool) -> str:
    """A leg whose knee a four-bar in a tilted plane moves; the loop is cut at a pin, or in the coupler's middle."""
    rod = '<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".01" mass=".3"/>'
    half = '<geom type="capsule" fromto="0 0 0 0 0 -.15" size=".01" mass=".3"/>'
    other = """<body name="lower_coupler" pos="-.06 0 0"><joint name="pin" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 .15" size=".01" mass=".2"/></body>"""
    closure = (
        '<weld name="middle" body1="coupler" body2="lower_coupler" anchor="0 0 .15" relpose="0 0 -.15 1 0 0 0"/>'
        if weld
        else '<connect name="pin" body1="coupler" body2="shank" anchor="0 0 -.3"/>'
    )
    return f"""<mujoco>{_OPTIONS}<worldbody><body name="trunk" pos="0 0 1" euler=".2 .3 .4"><freejoint/>
     <geom type="box" size=".2 .1 .08" pos=".02 .01 0" mass="6"/>
     <body name="hip" pos=".2 .1 0" euler=".3 0 .2"><joint name="abduction" axis="1 0 0"/>
      <geom type="sphere" size=".05" mass=".7"/>
      <body name="thigh"><joint name="hip" axis="0 1 0"/>
       <geom type="capsule" fromto="0 0 0 .01 .02 -.3" size=".03" mass="1.5"/>
       <body name="shank" pos="0 0 -.3"><joint name="knee" axis="0 1 0"/>
        <geom type="capsule" fromto="-.06 0 0 .1 0 -.25" size=".02" mass=".6"/><site name="toe" pos=".1 0 -.27"/>
        {other if weld else ""}</body></body>
      <body name="crank"><joint name="crank" axis="0 1 0"/>
       <geom type="capsule" fromto="0 0 0 -.06 0 0" size=".015" mass=".4"/>
       <body name="coupler" pos="-.06 0 0"><joint name="coupler" axis="0 1 0"/>{half if weld else rod}</body></body>
     </body></body></worldbody><equality>{closure}</equality>
     <actuator><motor joint="abduction"/><motor joint="hip"/><motor joint="crank"/></actuator></mujoco>"""


MODELS = {
    "biped": _biped(linear=False),
    "biped with linear motors": _biped(linear=True),
    "four-bar leg": _leg(weld=False),
    "welded coupler": _leg(weld=True),
}
_SOLES = (Contact("left_sole", "flat"), Contact("right_sole", "flat"))
FEET = {
    "biped": _SOLES,
    "biped with linear motors": _SOLES,
    "four-bar leg": (Contact("toe", "point"),),
    "welded coupler": (Contact("toe", "point"),),
}
RANKS = {"biped": 12, "biped with linear motors": 12, "four-bar leg": 2, "welded coupler": 3}
"""Independent constraints of all loops."""


@dataclass(frozen=True)
class LoopWorld:
    """A robot as MuJoCo has it, what a log has of it, and MuJoCo's own Jacobian of the loops.

    `true`, (L, 12): parameters; `robot` has others. `loops`, (N, k, n): by the robot's joints; `base`, (N, k, 6): by
    MuJoCo's base.
    """

    path: Path
    robot: Robot
    true: Array
    log: Log
    loops: Array
    base: Array

    @property
    def contacts(self) -> tuple[Contact, ...]:
        return FEET[self.path.stem]


@cache
def loop_world(name: str, count: int = 300, seed: int = 0, rigid: bool = False) -> LoopWorld:
    """Random states on the constraints under random motor torques and, in stance, wrenches of the ground.

    MuJoCo's constraint forces are soft: accelerations open the loops. If rigid, these keep them closed instead. The
    robot is the same for all seeds.
    """
    path = Path(mkdtemp()) / f"{name}.xml"
    path.write_text(MODELS[name])
    robot = load_robot(path)
    true = robot.nominal.copy()
    moved = np.array([body.joint is not None for body in robot.bodies])
    true[moved, parameters.COULOMB] = np.random.default_rng(2).uniform(0.1, 0.5, moved.sum())
    model = mujoco.MjModel.from_xml_path(str(path))
    return _record(path, robot, true, model, count, np.random.default_rng(seed), rigid)


def closed_positions(robot: Robot, count: int, rng: np.random.Generator) -> Array:
    """Joint positions (count, n) at which the loops are closed, up to 0.4 rad from those of 0."""
    q, closed = LoopClosures(robot).closed(torch.from_numpy(rng.uniform(-0.4, 0.4, (2 * count, robot.n))))
    near = q[closed & (q.abs().amax(1) < 1.0)]
    assert len(near) >= count
    return np.asarray(near[:count].numpy())


def _record(
    path: Path,
    robot: Robot,
    true: Array,
    model: mujoco.MjModel,
    count: int,
    rng: np.random.Generator,
    rigid: bool,
) -> LoopWorld:
    data, contacts = mujoco.MjData(model), FEET[path.stem]
    ids = [model.joint(name).id for name in robot.joint_names]
    at, rate = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
    friction = {body.joint.name: true[k, parameters.COULOMB] for k, body in enumerate(robot.bodies) if body.joint}
    coulomb = np.array([friction[name] for name in robot.joint_names])
    q, quat = closed_positions(robot, count, rng), Rotation.random(count, rng)
    active = rng.random((count, len(contacts))) < 0.6
    possible = np.array([np.isin(range(6), contact.components) for contact in contacts])
    wrench = np.where(active[..., None] & possible, [30.0, 30.0, 30.0, 3.0, 3.0, 3.0], 0.0)
    wrench *= rng.normal(size=wrench.shape)
    (v, a), torque = np.zeros((2, count, 6 + robot.n)), np.zeros((count, robot.n))
    loops, base, carried = [], [], []
    for k in range(count):
        data.qpos[:7] = [0.0, 0.0, 1.0, *np.roll(quat[k].as_quat(), 1)]
        data.qpos[at], data.qvel[:] = q[k], 0.0
        mujoco.mj_fwdPosition(model, data)
        equal = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        J = np.array(data.efc_J).reshape(-1, model.nv)[equal]
        assert np.abs(data.efc_pos[equal]).max() < 1e-12
        loops.append(J[:, rate])
        base.append(J[:, :6])
        drawn = rng.normal(size=model.nv)
        data.qvel[:] = drawn - np.linalg.pinv(J, rcond=1e-9) @ (J @ drawn)
        data.qfrc_applied[:] = 0.0
        through = np.zeros(model.nv)
        for contact, read in zip(itertools.compress(contacts, active[k]), wrench[k][active[k]], strict=True):
            _push(model, data, contact, read, through)
        data.qfrc_applied[:] = through
        data.qfrc_applied[rate] -= coulomb * np.sign(data.qvel[rate])
        data.ctrl[:] = 5.0 * rng.normal(size=model.nu)
        mujoco.mj_forward(model, data)
        if rigid:
            v[k], a[k] = ([*x[:6], *x[rate]] for x in (data.qvel, _rigid_acceleration(robot, model, data, at, rate)))
            torque[k] = data.qfrc_actuator[rate]
            carried.append(np.inf)
            continue
        mujoco.mj_inverse(model, data)  # with the constraint forces of this acceleration, to the last digits
        v[k], a[k] = ([*x[:6], *x[rate]] for x in (data.qvel, data.qacc))
        torque[k] = (data.qfrc_inverse - through)[rate] + coulomb * np.sign(data.qvel[rate])
        assert np.abs(torque[k][robot.is_passive]).max() < 1e-9
        carried.append(np.abs(data.qfrc_constraint[rate]).max())
    assert np.median(carried) > 1.0, "loops must carry forces"
    torque[:, robot.is_passive] = np.nan  # nobody measures what has no motor
    log = _log(path, robot, (q, v, a), torque, quat, (active, wrench))
    nominal = parameters.perturb_parameters(true, 0.2, np.random.default_rng(1))
    nominal[:, parameters.FRICTION] *= 0.5
    return LoopWorld(path, replace(robot, nominal=nominal), true, log, np.array(loops), np.array(base))


def _log(
    path: Path,
    robot: Robot,
    motion: tuple[Array, Array, Array],
    torque: Array,
    quat: Rotation,
    contact: tuple[Array, Array],
) -> Log:
    """What a robot records, with motions q (N, n), v and a (N, 6 + n) in MuJoCo's axes of the base."""
    (q, v, a), (active, wrench), contacts = motion, contact, FEET[path.stem]
    return Log(
        f"{path.stem}.npz",
        0.01 * np.arange(len(q)),
        robot.joint_names,
        q,
        joint_velocity=v[:, 6:],
        joint_acceleration=a[:, 6:],
        joint_torque=torque,
        base_quat_xyzw=quat.as_quat(),
        base_angular_velocity_base=v[:, 3:6],
        base_angular_acceleration_base=a[:, 3:6],
        base_linear_acceleration_world=a[:, :3],
        contact_names=tuple(contact.frame for contact in contacts),
        contact_active=active,
        contact_wrench_local=wrench,
    )


def _push(model: mujoco.MjModel, data: mujoco.MjData, contact: Contact, wrench: Array, total: Array) -> None:
    """Add the generalized forces (nv,) of a wrench (6,) on a contact, along its frame's axes."""
    site = model.site(contact.frame)
    axes = data.site_xmat[site.id].reshape(3, 3)
    force, moment = axes @ wrench[:3], axes @ wrench[3:]
    mujoco.mj_applyFT(model, data, force, moment, data.site_xpos[site.id], int(site.bodyid[0]), total)


def _rigid_acceleration(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData, at: Array, rate: Array) -> Array:
    """Acceleration under MuJoCo's inertia and forces with constraint forces that keep the loops closed."""
    closures = LoopClosures(robot)
    q, v = (torch.from_numpy(x[None].copy()) for x in (data.qpos[at], data.qvel[rate]))
    J = np.zeros((closures.jacobian(q).shape[1], model.nv))
    J[:, rate] = closures.jacobian(q)[0].numpy()
    forces = np.vstack([data.qfrc_smooth, J])
    moved = np.zeros_like(forces)
    mujoco.mj_solveM(model, data, moved, forces)
    free, through = moved[0], moved[1:]
    force = np.linalg.pinv(J @ through.T, rcond=1e-9) @ (-closures.drift(q, v)[0].numpy() - J @ free)
    return np.asarray(free + through.T @ force)
