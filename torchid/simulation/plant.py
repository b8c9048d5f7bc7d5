"""The simulated robot in MuJoCo: feet on the floor, fixed and mimic joints, closed loops."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lxml import etree
from scipy.spatial.transform import Rotation

from torchid import parameters
from torchid.config import FootConfig
from torchid.config.robot import ConstrainedRobot
from torchid.errors import ConfigError, UnknownNameError, UrdfError
from torchid.parameters import Array
from torchid.robot.mjcf import mujoco
from torchid.robot.tree import (
    Loop,
    Mimic,
    joint_origin,
    link_parameters,
    loops_of_file,
    passive_joints,
    resolve_mimics,
    weld_positions,
)
from torchid.robot.urdf import TreeJoint, drop_repeated_origins, parse_xml, read_urdf
from torchid.robot.xml_files import file_kind, is_mjcf, plain_urdf
from torchid.sensing.sensors import NORMAL_FORCE

_RADIUS = 1e-4  # m, of contact points of the file: they touch the floor at their own position
_NARROWEST = 1e-3  # m, of a support polygon


@dataclass(frozen=True)
class Foot:
    """A link that touches the floor with spheres about points, (k, 3) [m] in its frame, of radii (k,) [m].

    `along_normal`: its sensor reads the force along the floor's normal alone.
    """

    frame: str
    points: tuple[tuple[float, float, float], ...]
    radii: tuple[float, ...]
    along_normal: bool = False

    @property
    def middle(self) -> Array:
        """Mean of the points (3,) [m], in the foot's frame."""
        return np.mean(self.points, axis=0)

    @property
    def arms(self) -> Array:
        """The points from their middle, (k, 3) [m]."""
        return np.array(self.points) - self.middle

    @property
    def rolling_radius(self) -> float:
        """Radius of a foot that is one sphere of the URDF [m], 0 of others: they stand on points."""
        return self.radii[0] if len(self.radii) == 1 and self.radii[0] > _RADIUS else 0.0

    @property
    def constrained(self) -> int:
        """Number of its six velocities that the floor constrains: three, or all six if it stands flat."""
        return 6 if form_polygon(np.array(self.points)) else 3


def point_foot(frame: str, radius: float = 0.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Foot:
    """A foot that is one sphere of a radius about a point of its frame [m], or that point."""
    return Foot(frame, (centre,), (max(radius, _RADIUS),))


def find_feet(settings: list[FootConfig], urdf: Path) -> tuple[Foot, ...]:
    """Feet with their contact points, from the simulation file or from the URDF's collision spheres.

    Args:
        settings: of the simulation file.
        urdf: the robot.

    Raises:
        UnknownNameError: the URDF has no such link.
        ConfigError: a foot is named twice, or has no contact points.
        UrdfError: a collision sphere is not described by numbers.
    """
    root = parse_xml(urdf).getroot()
    links = {link.get("name", ""): link for link in root.findall("link")}
    frames = [foot.frame for foot in settings]
    feet = []
    for foot in settings:
        if foot.frame not in links:
            raise UnknownNameError.at_field("feet", foot.frame, links)
        if frames.count(foot.frame) > 1:
            raise ConfigError.at_field("feet", f"'{foot.frame}' named twice", "each frame once")
        along_normal = foot.sensor == NORMAL_FORCE
        if foot.points:
            points = tuple((x, y, z) for x, y, z in foot.points)
            feet.append(Foot(foot.frame, points, (_RADIUS,) * len(points), along_normal))
            continue
        shapes = links[foot.frame].findall("collision")
        spheres = [sphere for shape in shapes if (sphere := _sphere(urdf, foot.frame, shape)) is not None]
        if not spheres:
            missing = f"{foot.frame} has no points here and no collision spheres in {urdf.name}"
            raise ConfigError.at_field("feet", missing, "points: [[x, y, z], ...] in the foot's frame [m]")
        points, radii = zip(*spheres, strict=True)
        feet.append(Foot(foot.frame, points, radii, along_normal))
    return tuple(feet)


def _sphere(urdf: Path, frame: str, shape: object) -> tuple[tuple[float, float, float], float] | None:
    """Centre and radius [m] of a collision shape in its link's frame, None unless it is a sphere."""
    sphere = shape.find("geometry/sphere")  # type: ignore[attr-defined]
    origin = shape.find("origin")  # type: ignore[attr-defined]
    if sphere is None:
        return None
    try:
        radius = float(sphere.get("radius", ""))
        x, y, z = map(float, ("0 0 0" if origin is None else origin.get("xyz", "0 0 0")).split())
    except ValueError as error:
        raise UrdfError(urdf, f"link '{frame}', <sphere>", f"{error}", "numbers for radius and origin") from error
    if not (np.isfinite([x, y, z, radius]).all() and radius > 0.0):
        raise UrdfError(urdf, f"link '{frame}', <sphere>", f"radius {radius:g}", "finite numbers, radius > 0")
    return (x, y, z), radius


def form_polygon(points: Array) -> bool:
    """Whether contact points, (k, 3) [m], span a polygon (do not lie on one line)."""
    return len(points) > 2 and float(np.linalg.svd(points - points.mean(axis=0))[1][1]) > _NARROWEST


WORLD = "world link"
"""Name for a link "world", which MuJoCo would drop."""

_STIFFEST = 0.9999  # largest fraction of a violation's acceleration that MuJoCo's constraints remove


@dataclass(frozen=True)
class JointConstraints:
    """Constraints between the joints of a robot.

    Attributes:
        held: position of fixed joints, by name [rad or m].
        mimics: of mimic joints, by name.
        loops: pairs of frames that coincide.
        inertials: parameters (10,) that replace those of the file, by link; a fixed joint may have moved mass between
            links.
    """

    held: Mapping[str, float] = field(default_factory=dict)
    mimics: Mapping[str, Mimic] = field(default_factory=dict)
    loops: Sequence[Loop] = ()
    inertials: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        path: Path,
        joints: Sequence[TreeJoint],
        loops: Sequence[Loop] = (),
        held: Mapping[str, float] | None = None,
    ) -> JointConstraints:
        """Constraints of a robot's file, and of a run's loops and fixed joints."""
        held = held or {}
        mimics = {
            name: mimic for name, mimic in resolve_mimics(path, joints).items() if mimic.master and name not in held
        }
        return cls(held, mimics, loops)

    def add_to(self, spec: mujoco.MjSpec, physics_hz: float) -> None:
        """Constrain joints of a model as stiffly as its time step allows; fixed joints are removed."""
        for link, values in self.inertials.items():
            set_inertial(spec.body(body_name(link)), values)
        for name, position in self.held.items():
            _hold(spec, spec.joint(name), position)
        for name, mimic in self.mimics.items():
            first = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=name, name2=mimic.master)
            first.data[:5] = [mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0]
        for number, loop in enumerate(self.loops):
            for frame, site in zip(loop.frames, _sites(number), strict=True):
                spec.body(body_name(frame)).add_site(name=site)
            kind = mujoco.mjtEq.mjEQ_CONNECT if loop.kind == "point" else mujoco.mjtEq.mjEQ_WELD
            first, second = _sites(number)
            spec.add_equality(type=kind, name1=first, name2=second, objtype=mujoco.mjtObj.mjOBJ_SITE)
        for equality in spec.equalities:
            equality.solref[:] = [2.0 / physics_hz, 1.0]
            equality.solimp[:2] = _STIFFEST


def body_name(link: str) -> str:
    """Name of a link's body in MuJoCo."""
    return WORLD if link == "world" else link


def _sites(number: int) -> tuple[str, str]:
    """Names of the sites of a loop, in its frames."""
    return f"loop {number} one", f"loop {number} other"


def _hold(spec: mujoco.MjSpec, joint: mujoco.MjsJoint, position: float) -> None:
    """Fix a joint of a URDF at a position [rad or m]."""
    body = joint.parent
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    start = Rotation.from_quat(np.array(body.quat), scalar_first=True)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        body.pos = np.array(body.pos) + start.apply(position * axis)
    else:
        body.quat = (start * Rotation.from_rotvec(position * axis)).as_quat(scalar_first=True)
    spec.delete(joint)


def set_inertial(body: mujoco.MjsBody, values: Array) -> None:
    """Replace the inertial parameters of a body with others, (10,)."""
    body.mass = 0.0
    body.inertia = np.zeros(3)
    body.fullinertia[:] = np.nan  # none, for MuJoCo
    if values[parameters.MASS]:
        body.mass, com, inertia = parameters.mass_com_inertia(values)
        body.ipos = com
        body.fullinertia = inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
        body.iquat = [1.0, 0.0, 0.0, 0.0]


class Followers:
    """Joints of a compiled model that follow others."""

    def __init__(self, model: mujoco.MjModel, mimics: Mapping[str, Mimic]) -> None:
        joints = [(model.joint(name), model.joint(mimic.master)) for name, mimic in mimics.items()]
        self.at, self.rate, self.master_at, self.master_rate = (
            np.array([int(getattr(pair[k], key)[0]) for pair in joints], dtype=int)
            for k in range(2)
            for key in ("qposadr", "dofadr")
        )
        self.ratio = np.array([mimic.multiplier for mimic in mimics.values()])
        self.offset = np.array([mimic.offset for mimic in mimics.values()])

    def place(self, data: mujoco.MjData) -> None:
        """Put them, and their velocities, where the others are."""
        data.qpos[self.at] = self.ratio * data.qpos[self.master_at] + self.offset
        data.qvel[self.rate] = self.ratio * data.qvel[self.master_rate]

    def errors(self, model: mujoco.MjModel, data: mujoco.MjData) -> tuple[Array, Array, Array]:
        """How far they are off: Jacobian (k, nv), errors (k,) [rad or m] and bias accelerations (k,), which are 0."""
        J = np.zeros((len(self.at), model.nv))
        rows = np.arange(len(self.at))
        J[rows, self.rate] = 1.0
        J[rows, self.master_rate] = -self.ratio
        return J, data.qpos[self.at] - self.ratio * data.qpos[self.master_at] - self.offset, np.zeros(len(rows))


def loop_errors(model: mujoco.MjModel, data: mujoco.MjData, loops: Sequence[Loop]) -> tuple[Array, Array, Array]:
    """How far loops are open: Jacobian (k, nv), error (k,) [m, rad] and bias acceleration (k,) of what closes them."""
    jacobians = [np.zeros((0, model.nv))]
    errors = [np.zeros(0)]
    biases = [np.zeros(0)]
    for number, loop in enumerate(loops):
        first, other = (_site_motion(model, data, name) for name in _sites(number))
        rows = list(loop.components)
        jacobians.append((first[2] - other[2])[rows])
        errors.append(np.append(first[0] - other[0], rotation_error(other[1], first[1]))[rows])
        biases.append((first[3] - other[3])[rows])
    return np.concatenate(jacobians), np.concatenate(errors), np.concatenate(biases)


def rotation_error(start: Array, end: Array) -> Array:
    """Error between two rotations (3, 3), (3,): axis in the outer frame times the sine of the angle."""
    R = end @ start.T
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def _site_motion(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> tuple[Array, Array, Array, Array]:
    """Position (3,), rotation to world (3, 3), Jacobian (6, nv) and bias acceleration (6,) of a site."""
    site = model.site(name).id
    J = np.zeros((6, model.nv))
    J_dot = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
    mujoco.mj_jacDot(model, data, J_dot[:3], J_dot[3:], data.site_xpos[site], int(model.site_bodyid[site]))
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy(), J, J_dot @ data.qvel


_SMALLEST = 1e-14  # kg and kg m^2, of links without mass between the axes of a joint of several axes
_DISCARDED = ("transmission", "gazebo", "material", "mujoco")
_SPRING = (0.004, 1.0)  # time constant [s] and damping ratio of the floor; a softer one lets feet creep, by v^2
_STICTION = (0.002, 1.0)  # the same of dry friction in a joint; MuJoCo's own lets joints creep at 0.1 rad/s
_FRICTION = (1.0, 0.005, 0.0001)
_SIMULATED = "a robot that MuJoCo can simulate"
_SLIP_RATIO = 10.0  # friction's stiffness over the normal one's: soft friction creeps


@dataclass(frozen=True)
class FootMotion:
    """Motion of the middle of a foot's points: position (3,), velocity (6,), Jacobian (6, nv), bias acceleration (6,).

    World axes, linear part first; `rotation`, (3, 3), is that of the foot's frame to world.
    """

    position: Array
    rotation: Array
    velocity: Array
    J: Array
    bias: Array

    def rolling(self, radius: float) -> FootMotion:
        """Motion of the material point below the middle of a sphere that rolls on the floor.

        Its linear bias is that of v + omega x l with l fixed in the world.
        """
        J = self.J.copy()
        bias = self.bias.copy()
        J[:3] += radius * np.cross([0.0, 0.0, 1.0], self.J[3:], axisb=0, axisc=0)
        bias[:3] += radius * np.cross([0.0, 0.0, 1.0], self.bias[3:])
        linear = self.velocity[:3]
        angular = self.velocity[3:]
        velocity = np.append(linear + radius * np.cross([0.0, 0.0, 1.0], angular), angular)
        return FootMotion(self.position, self.rotation, velocity, J, bias)


class Plant:
    """A URDF robot with a free base on a soft floor, in MuJoCo's coordinates.

    Generalized velocity: base origin's velocity along world axes (3), base angular velocity along base axes (3),
    joints (n) in the order of `joint_names`. Each step is `observe`, `push`: what a recorder reads in between and
    after belongs to the same instant, the one before the integration.
    """

    def __init__(
        self,
        urdf: Path,
        feet: Sequence[Foot],
        physics_hz: float,
        friction: tuple[float, float] | None = None,
        stated: ConstrainedRobot | None = None,
    ) -> None:
        """Compile the model.

        Args:
            urdf: the robot; its shapes are not used.
            feet: that touch the floor.
            physics_hz: integration rate [Hz].
            friction: Coulomb [N m] and viscous [N m s/rad] friction of every joint; None for the URDF's.
            stated: fixed joints, joints without a motor, and loops besides those of the file.

        Raises:
            UrdfError: MuJoCo does not accept the robot, or it has springs.
            ConfigError: see `weld_positions` and `passive_joints`.
        """
        stated = stated or ConstrainedRobot()
        joints = read_urdf(urdf)[1]
        loops = (*(loop.loop for loop in stated.loops), *loops_of_file(urdf))
        self._constraints = JointConstraints.of(urdf, joints, loops, weld_positions(urdf, joints, stated.weld))
        self.model = compile_model(urdf, feet, physics_hz, constraints=self._constraints)
        self.data = mujoco.MjData(self.model)
        model = self.model
        if is_mjcf(urdf):
            _add_armatures(model, urdf, joints)
        if friction is not None:
            model.dof_frictionloss[6:], model.dof_damping[6:] = friction
        self.nv = model.nv
        self.n = model.nv - 6
        self.joint_names = tuple(model.joint(i).name for i in range(1, model.njnt))
        self.mass = float(model.body_subtreemass[1])
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP  # it integrates another acceleration than qacc
        self.limits = np.where(model.jnt_limited[1:, None], model.jnt_range[1:], [-np.inf, np.inf])
        limited = model.jnt_actfrclimited[1:].astype(bool)
        self.efforts = np.where(limited, model.jnt_actfrcrange[1:, 1], np.inf)
        self.weight = -self.mass * model.opt.gravity  # force that holds the robot up (3,) [N]
        self.foot_frames = tuple(foot.frame for foot in feet)
        self._sensors = [model.site(foot_site(foot)).id for foot in feet]
        self._middles = [model.site(_middle(foot)).id for foot in feet]
        self._bodies = [int(model.site_bodyid[site]) for site in self._middles]
        self._M = np.zeros((self.nv, self.nv))
        self._followers = Followers(model, self._constraints.mimics)
        moving = [name for name in self.joint_names if name not in self._constraints.mimics]
        driven = set(moving).difference(passive_joints(joints, stated.passive, moving))
        self.has_motor = np.array([name in driven for name in self.joint_names])

    # ---------------------------------------------------------------------------------------------------- stepping

    def place(self, position: Array) -> None:
        """Set the configuration, (7 + n,): base position, quaternion w x y z, joints; everything at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = position
        mujoco.mj_forward(self.model, self.data)

    def shift(self, step: Array) -> Array:
        """The configuration a tangent step (nv,) away."""
        position = self.data.qpos.copy()
        mujoco.mj_integratePos(self.model, position, step, 1.0)
        return position

    def observe(self) -> None:
        """Update everything that depends on position and velocity."""
        mujoco.mj_step1(self.model, self.data)

    def push(self, torque: Array) -> None:
        """Apply joint torques (n,) [N m], compute accelerations and contact forces, and integrate one step."""
        self.data.qfrc_applied[6:] = torque
        mujoco.mj_step2(self.model, self.data)

    # --------------------------------------------------------------------------------------------------- reading

    @property
    def position(self) -> Array:
        """Configuration (7 + n,)."""
        return self.data.qpos

    @property
    def velocity(self) -> Array:
        """Generalized velocity (nv,)."""
        return self.data.qvel

    @property
    def acceleration(self) -> Array:
        """Generalized acceleration (nv,) of the last `push`."""
        return self.data.qacc

    @property
    def unstable(self) -> bool:
        """Whether the integration has diverged (MuJoCo then restarts from the initial state)."""
        return any(warning.number for warning in self.data.warning)

    @property
    def wrenches(self) -> Array:
        """Force and moment of the floor on every foot, (F, 6) [N, N m], in the foot's frame, of the last `push`."""
        return -self.data.sensordata.reshape(-1, 6)

    @property
    def inertia(self) -> Array:
        """Joint-space inertia matrix (nv, nv)."""
        if hasattr(self.data, "qM"):  # MuJoCo before 3.11
            mujoco.mj_fullM(self.model, self._M, self.data.qM)
        else:
            mujoco.mj_fullM(self.model, self.data, self._M)
        return self._M

    @property
    def bias(self) -> Array:
        """Coriolis, centrifugal and gravity forces (nv,)."""
        return self.data.qfrc_bias

    @property
    def constraints(self) -> tuple[Array, Array, Array]:
        """Joints that follow others, and closed loops: Jacobian (k, nv), errors (k,), bias accelerations (k,)."""
        follow = self._followers.errors(self.model, self.data)
        loops = loop_errors(self.model, self.data, self._constraints.loops)
        J, off, bias = (np.concatenate(pair) for pair in zip(follow, loops, strict=True))
        return J, off, bias

    @property
    def com(self) -> Array:
        """Centre of mass (3,) [m]."""
        return self.data.subtree_com[1]

    @property
    def base_rotation(self) -> Array:
        """Base to world, (3, 3)."""
        return self.data.xmat[1].reshape(3, 3)

    @property
    def feet_positions(self) -> Array:
        """Origins of the feet's frames (F, 3) [m]."""
        return self.data.site_xpos[self._sensors]

    @property
    def feet_rotations(self) -> Array:
        """Rotations of the feet's frames to world, (F, 3, 3)."""
        return self.data.site_xmat[self._sensors].reshape(-1, 3, 3)

    def foot(self, index: int) -> FootMotion:
        """Where a foot is and how it moves."""
        model = self.model
        data = self.data
        body = self._bodies[index]
        site = self._middles[index]
        J = np.zeros((6, self.nv))
        J_dot = np.zeros((6, self.nv))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
        mujoco.mj_jacDot(model, data, J_dot[:3], J_dot[3:], data.site_xpos[site], body)
        rotation = data.site_xmat[site].reshape(3, 3)
        return FootMotion(data.site_xpos[site], rotation, J @ data.qvel, J, J_dot @ data.qvel)


def _add_armatures(model: mujoco.MjModel, path: Path, joints: Sequence[TreeJoint]) -> None:
    """Add the armatures of an MJCF file to joints, because `plain_urdf` drops them. UrdfError for springs."""
    for joint in joints:
        if joint.stiffness:
            reason = f"has a spring of stiffness {joint.stiffness:g}"
            raise UrdfError(path, f"joint '{joint.name}'", reason, "joints without springs, to simulate")
        if joint.armature:
            model.dof_armature[model.joint(joint.name).dofadr] = joint.armature


def compile_model(
    urdf: Path,
    feet: Sequence[Foot],
    physics_hz: float,
    floating: bool = True,
    constraints: JointConstraints | None = None,
) -> mujoco.MjModel:
    """MuJoCo model of a URDF robot without shapes and joint limits, on a soft floor that only its feet touch.

    Raises:
        UrdfError: MuJoCo does not accept the robot.
    """
    spec = _spec(urdf)
    if constraints is not None:
        constraints.add_to(spec, physics_hz)
    if floating:
        spec.worldbody.first_body().add_freejoint()
    spec.option.timestep = 1.0 / physics_hz
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = _SLIP_RATIO
    spec.option.tolerance = 1e-15
    spec.option.iterations = 100
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], friction=_FRICTION, solref=_SPRING)
    for foot in feet:
        _add_foot(spec, foot)
    try:
        model = spec.compile()
    except ValueError as error:
        raise _refusal(urdf, spec, str(error)) from error
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT  # a stop's force would be in no sensor
    model.dof_solref[:] = _STICTION
    model.dof_solimp[:, :2] = (0.99, 0.999)
    return model


def _spec(urdf: Path) -> mujoco.MjSpec:
    """The URDF without shapes, bolted to the world."""
    root = parse_xml(urdf).getroot()
    if is_mjcf(urdf):
        plain_urdf(root)
    of_shapes = ("link/visual", "link/collision", "joint/mimic")  # `JointConstraints` has the last
    for element in [element for tag in (*_DISCARDED, *of_shapes) for element in root.findall(tag)]:
        element.getparent().remove(element)
    drop_repeated_origins(root)
    for link in root.iterfind("link[@name='world']"):
        link.set("name", WORLD)  # MuJoCo has a world of its own, and would drop this link
    for end in (*root.iterfind("joint/parent[@link='world']"), *root.iterfind("joint/child[@link='world']")):
        end.set("link", WORLD)
    try:
        spec = mujoco.MjSpec.from_string(etree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise UrdfError(urdf, file_kind(urdf), f"MuJoCo refuses it: {error}", _SIMULATED) from error
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = False
    for link, values in _lumped_inertials(urdf).items():
        set_inertial(spec.body(body_name(link)), values)
    if any(body.joints and not body.mass and _carries_mass(body) for body in spec.bodies):
        spec.compiler.boundmass = spec.compiler.boundinertia = _SMALLEST
    return spec


def _lumped_inertials(urdf: Path) -> dict[str, Array]:
    """Parameters (10,) of every link including the links welded to it, 0 for the welded ones.

    MuJoCo checks links one by one. A body may be consistent although its single links (a camera, a foot) are not.
    """
    links, joints = read_urdf(urdf)
    fixed = {joint.child: joint for joint in joints if joint.type == "fixed"}
    out = {link.name: np.zeros(parameters.INERTIAL.stop) for link in links}
    for link in links:
        carrier = link.name
        T = np.eye(4)
        while carrier in fixed:
            T = joint_origin(fixed[carrier]) @ T
            carrier = fixed[carrier].parent
        out[carrier] += link_parameters(link, T)[parameters.INERTIAL]
    return out


def _refusal(urdf: Path, spec: mujoco.MjSpec, message: str) -> UrdfError:
    """Error for a model that MuJoCo does not accept; for a link's inertia in our own words."""
    named = re.search(r"inertia.*Element name '([^']+)'", message, re.DOTALL)
    body = spec.body(named[1]) if named else None
    if named is None or body is None:
        return UrdfError(urdf, file_kind(urdf), f"MuJoCo refuses it: {message}", _SIMULATED)
    if "mjMINVAL" in message:
        joint = body.joints[0].name if body.joints else ""
        held = f", or robot.weld: {{{joint}: 0}} to fix the joint" if joint else ""
        accepted = f"an <inertial> of the link{held}"
        return UrdfError(urdf, f"link '{named[1]}'", "moves, but has no mass or no inertia", accepted)
    reason = "with the links welded to it, its inertia is not physically consistent"
    accepted = "principal moments above 0, none above the sum of the other two"
    return UrdfError(urdf, f"link '{named[1]}'", reason, accepted)


def _carries_mass(body: mujoco.MjsBody) -> bool:
    """Whether a body has mass, or any that it moves."""
    return bool(body.mass) or any(_carries_mass(child) for child in body.bodies)


def _add_foot(spec: mujoco.MjSpec, foot: Foot) -> None:
    """Add a massless plate, welded to the link, with the contact spheres and a six-axis sensor."""
    plate = spec.body(foot.frame).add_body(name=foot_site(foot))
    plate.add_site(name=foot_site(foot))
    plate.add_site(name=_middle(foot), pos=foot.middle)
    for point, radius in zip(foot.points, foot.radii, strict=True):
        plate.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=point,
            size=[radius, 0, 0],
            mass=0.0,
            friction=_FRICTION,
            solref=_SPRING,
        )
    for kind in (mujoco.mjtSensor.mjSENS_FORCE, mujoco.mjtSensor.mjSENS_TORQUE):
        spec.add_sensor(type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=foot_site(foot))


def foot_site(foot: Foot) -> str:
    """Name of the site in a foot's frame."""
    return f"{foot.frame} sensor"


def _middle(foot: Foot) -> str:
    return f"{foot.frame} middle"
