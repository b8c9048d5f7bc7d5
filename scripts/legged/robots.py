"""Legged robots, how they stand and step, and true ones whose masses, friction and rotors are not in their URDFs."""

from __future__ import annotations

import copy
import sysconfig
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

import torchid
from torchid.errors import InputError, TorchidWarning
from torchid.parameters import FRICTION, INERTIAL, Array
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact

FRICTION_WIDTH = 0.02  # rad/s: Coulomb friction of the truth is fc tanh(v / width); a sharper one would chatter
_EXAMPLES = Path("cmeel.prefix/share/example-robot-data/robots")
_DEMO = Path(torchid.__file__).parent / "demo"
_GRIP = (1.5, 0.0, 0.0)  # sliding friction; a sphere or a corner of a sole neither resists turning nor rolling
_FLOOR = (0.004, 1.0)  # time constant [s] and damping ratio of the contacts
_STIFF = (0.98, 0.998, 1e-4, 0.5, 2.0)  # impedance; a harder floor lets standing feet jump from step to step
_SLIP_RATIO = 20.0  # friction's stiffness over the normal one's: soft friction creeps


def example_robot(name: str) -> Path:
    """A URDF of the package example-robot-data, which need not be there."""
    return Path(sysconfig.get_path("purelib")) / _EXAMPLES / name


@dataclass(frozen=True)
class Legged:
    """A robot and how it is made to move.

    Attributes:
        name: for tables.
        urdf: the nominal robot.
        feet: frames that touch the ground.
        kind: of the contacts.
        points: centres of the spheres that touch the ground, (k, 3) [m] in the feet's frames.
        radius: of the spheres [m].
        posture: joint positions by name, others 0 [rad].
        lifted: groups of feet that are in the air at one time, in turn.
        swing, hop, both: seconds in the air while the others can hold the robot, and while they cannot; between swings.
        lift: height of a swing [m].
        sway: of the base [m], and four times that [rad] in rotation.
        waving: of joints that are no legs' [rad].
        friction, armature: ranges of Coulomb friction [N m], viscous friction [N m s/rad] and of armature [kg m^2].
        gains: stiffness [N m/rad] and damping [N m s/rad] of the joints' controllers.
    """

    name: str
    urdf: Path
    feet: tuple[str, ...]
    kind: str
    points: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)
    radius: float = 0.0
    posture: Mapping[str, float] = field(default_factory=dict, hash=False)
    lifted: tuple[tuple[int, ...], ...] = ()
    swing: float = 0.35
    hop: float = 0.16
    both: float = 0.35
    lift: float = 0.05
    sway: float = 0.02
    waving: float = 0.3
    friction: tuple[tuple[float, float], tuple[float, float]] = ((0.1, 0.4), (0.02, 0.1))
    armature: tuple[float, float] = (0.005, 0.015)
    gains: tuple[float, float] = (250.0, 5.0)

    @property
    def available(self) -> bool:
        """Whether its URDF is installed."""
        return self.urdf.is_file()

    def holds(self, lifted: tuple[int, ...]) -> bool:
        """Whether the other feet can hold the robot at rest."""
        return len(self.feet) - len(lifted) >= (1 if self.kind == "flat" else 3)

    def contacts(self, rolling: bool = True) -> tuple[Contact, ...]:
        """Contacts as torchid has them; `rolling`: with the spheres' radius, if they are points."""
        radius = self.radius if rolling and self.kind == "point" else 0.0
        return tuple(Contact(foot, self.kind, radius=radius) for foot in self.feet)


def sphere_radius(legged: Legged) -> float:
    """Of the spheres that touch the ground in MuJoCo [m], which has no points."""
    return max(legged.radius, 1e-4)


def _bent(pairs: Mapping[str, float], *limbs: str) -> dict[str, float]:
    return {limb.format(joint): angle for limb in limbs for joint, angle in pairs.items()}


_PAWS = ("FL", "FR", "RL", "RR")
_DEMO_PAWS = ("front_left", "front_right", "rear_left", "rear_right")
_SOLE = ((-0.05, 0.025, -0.03), (-0.05, -0.025, -0.03), (0.12, 0.03, -0.03), (0.12, -0.03, -0.03))
_TROT = ((0,), (3,), (1,), (2,), (0, 3), (1, 2), (0, 3), (1, 2))

GO2 = Legged(
    "Go2",
    example_robot("go2_description/urdf/go2.urdf"),
    tuple(f"{paw}_foot" for paw in _PAWS),
    "point",
    radius=0.022,
    posture=_bent({"thigh_joint": 0.8, "calf_joint": -1.5}, *(f"{paw}_{{}}" for paw in _PAWS)),
    lifted=_TROT,
)
G1 = Legged(
    "G1",
    example_robot("g1_description/urdf/g1_29dof_rev_1_0.urdf"),
    ("left_ankle_roll_link", "right_ankle_roll_link"),
    "flat",
    _SOLE,
    0.005,
    _bent(
        {"hip_pitch_joint": -0.4, "knee_joint": 0.8, "ankle_pitch_joint": -0.4, "elbow_joint": 0.6},
        "left_{}",
        "right_{}",
    ),
    lifted=((0,), (1,)),
    swing=0.6,
    both=0.9,
    lift=0.04,
    sway=0.012,
    waving=0.15,
    friction=((0.2, 1.0), (0.05, 0.3)),
    armature=(0.01, 0.03),
    gains=(2000.0, 20.0),
)
QUADRUPED = Legged(
    "quadruped",
    _DEMO / "quadruped.urdf",
    tuple(f"{paw}_foot" for paw in _DEMO_PAWS),
    "point",
    posture=_bent({"thigh": 0.6, "knee": -1.2}, *(f"{paw}_{{}}" for paw in _DEMO_PAWS)),
    lifted=_TROT,
)
ROBOTS = {one.name: one for one in (GO2, G1, QUADRUPED)}


def require_available(names: Iterable[str]) -> None:
    """Make sure that the URDFs of some of `ROBOTS` are installed.

    Raises:
        InputError: one is not.
    """
    for name in names:
        if not ROBOTS[name].available:
            found = f"{name}, whose URDF is not there ({ROBOTS[name].urdf})"
            raise InputError("arguments", "--robots", found, "the package example-robot-data installed")


@cache
def nominal_robot(legged: Legged) -> Robot:
    """The robot by its URDF."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        return load_robot(legged.urdf)


@dataclass(frozen=True, eq=False)
class TrueRobot:
    """A robot in MuJoCo on flat ground that differs from its URDF.

    Attributes:
        legged: the robot.
        robot: by its URDF.
        model: in MuJoCo's coordinates, joints in the order of `robot.joint_names`; without friction in the joints.
        phi: true parameters, (L, 12), friction included.
        armature: (n,) [kg m^2].
        foot_of_geom: foot by number of the geometry.
        dry: whether MuJoCo itself has the friction of the joints, which then stick; else it is a torque on them.
    """

    legged: Legged
    robot: Robot
    model: Any
    phi: Array
    armature: Array
    foot_of_geom: Mapping[int, int]
    dry: bool = False

    @property
    def friction(self) -> Array:
        """Coulomb and viscous friction by joint, (n, 2) [N m, N m s/rad]."""
        return self.phi[1:, FRICTION]

    @property
    def strength(self) -> Array:
        """Size of the joints' actuators (n,), 1 of most."""
        return _strength(self.model)

    def origins(self, data: Any) -> Array:
        """Where the feet's frames are in a state of MuJoCo, (F, 3) [m]."""
        out = []
        for frame in self.legged.feet:
            body, T = self.robot.links[frame]
            index = self.model.body(self.robot.body_names[body]).id
            out.append(data.xpos[index] + data.xmat[index].reshape(3, 3) @ T[:3, 3])
        return np.array(out)

    def friction_torque(self, velocity: Array) -> Array:
        """Torque that friction takes at joint velocities (..., n) [N m]."""
        return self.friction[:, 0] * np.tanh(velocity / FRICTION_WIDTH) + self.friction[:, 1] * velocity

    @classmethod
    def unlike_its_urdf(cls, legged: Legged, seed: int = 0, share: float = 0.2) -> TrueRobot:
        """Mass, centre of mass and inertia of every body off by up to a share; friction and armature of every joint."""
        robot, rng = nominal_robot(legged), np.random.default_rng([seed, 3])
        model, foot_of_geom = _compile(legged, robot)
        bodies = [model.body(name).id for name in robot.body_names]
        for index in bodies:
            mass, inertia = model.body_mass[index], model.body_inertia[index]
            if mass > 0.0:
                m, i = 1.0 + share * rng.uniform(-1.0, 1.0, 2)
                radius = np.sqrt(inertia.sum() / (2.0 * mass))
                model.body_ipos[index] += share * radius * rng.uniform(-1.0, 1.0, 3)
                turned = Rotation.from_rotvec(share * rng.uniform(-1.0, 1.0, 3))
                quat = turned * Rotation.from_quat(model.body_iquat[index][[1, 2, 3, 0]])
                model.body_iquat[index] = quat.as_quat()[[3, 0, 1, 2]]
                model.body_mass[index], model.body_inertia[index] = m * mass, i * m * inertia
        scale = _strength(model)
        phi = np.zeros((len(bodies), 12))
        phi[:, INERTIAL] = [_inertial(model, index) for index in bodies]
        coulomb, viscous = (scale * rng.uniform(*limits, robot.n) for limits in legged.friction)
        phi[1:, FRICTION] = np.stack([coulomb, viscous], axis=1)
        model.dof_armature[6:] = scale * rng.uniform(*legged.armature, robot.n)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return cls(legged, robot, model, phi, model.dof_armature[6:].copy(), foot_of_geom)


def with_dry_friction(true: TrueRobot, integrator: str, time_constant: float) -> TrueRobot:
    """The robot with joints that stick, on a floor of another softness [s]; "implicitfast", "implicit" or "euler"."""
    model = copy.deepcopy(true.model)
    model.dof_frictionloss[6:], model.dof_damping[6:] = true.friction.T
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
    model.geom_solref[:, 0] = time_constant
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(true, model=model, dry=True)


def _strength(model: Any) -> Array:
    """Size of the joints' actuators (n,), 1 of most: wrists have small gears."""
    limits = model.jnt_actfrcrange[1:, 1]
    efforts = np.where(model.jnt_actfrclimited[1:].astype(bool) & (limits > 0.0), limits, 1.0)
    return np.minimum(1.0, efforts / np.median(efforts))


def _inertial(model: Any, index: int) -> Array:
    """Mass, first moments and inertia about the body frame's origin: Ixx, Ixy, Ixz, Iyy, Iyz, Izz."""
    mass, com = float(model.body_mass[index]), model.body_ipos[index]
    R = Rotation.from_quat(model.body_iquat[index][[1, 2, 3, 0]]).as_matrix()
    about = R @ np.diag(model.body_inertia[index]) @ R.T + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate([[mass], mass * com, about[np.triu_indices(3)]])


def _compile(legged: Legged, robot: Robot) -> tuple[Any, dict[int, int]]:
    """The URDF with its welded links lumped and spheres as feet, on flat ground; and the foot of every sphere."""
    root = etree.parse(str(legged.urdf)).getroot()
    for link in root.findall("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    spec = mujoco.MjSpec.from_string(etree.tostring(root, encoding="unicode"))
    spec.compiler.balanceinertia = False
    spec.compiler.fusestatic = True
    spec.worldbody.first_body().add_freejoint()
    spec.option.timestep = 5e-4
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = _SLIP_RATIO
    spec.option.tolerance, spec.option.iterations = 1e-14, 100
    contact = {"friction": _GRIP, "solref": _FLOOR, "solimp": _STIFF, "condim": 3}
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=1, **contact)
    for number, frame in enumerate(legged.feet):
        body, T = robot.links[frame]
        for k, point in enumerate(legged.points):
            spec.body(robot.body_names[body]).add_geom(
                name=f"foot {number} {k}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=(T @ [*point, 1.0])[:3],
                size=[sphere_radius(legged), 0, 0],
                mass=0.0,
                contype=2,
                conaffinity=1,
                **contact,
            )
    model = spec.compile()
    names = tuple(model.joint(i).name for i in range(1, model.njnt))
    if names != robot.joint_names:
        raise ValueError(f"{legged.urdf.name}: joints {names} in MuJoCo, {robot.joint_names} in torchid")
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    model.dof_damping[:], model.dof_frictionloss[:] = 0.0, 0.0
    feet = {model.geom(f"foot {i} {k}").id: i for i in range(len(legged.feet)) for k in range(len(legged.points))}
    return model, feet
