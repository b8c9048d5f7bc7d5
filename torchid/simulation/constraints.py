"""What constrains a simulated robot: feet on the floor, joints that are held or follow others, closed loops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from torchid import parameters
from torchid.config import FootConfig
from torchid.errors import ConfigError, UnknownNameError, UrdfError
from torchid.parameters import Array
from torchid.robot.constraints import Loop
from torchid.robot.mjcf_model import mujoco
from torchid.robot.tree import Mimic, resolve_mimics
from torchid.robot.urdf import TreeJoint, parse_xml
from torchid.sensing.sensors import NORMAL_FORCE

_RADIUS = 1e-4  # m, of contact points that the file gives: where they touch the floor is where they are
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
    """The feet with their contact points, from the file or from the URDF's collision spheres.

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
            raise ConfigError.at_field("feet", f"'{foot.frame}' named twice", "every foot once")
        along_normal = foot.sensor == NORMAL_FORCE
        if foot.points:
            points = tuple((x, y, z) for x, y, z in foot.points)
            feet.append(Foot(foot.frame, points, (_RADIUS,) * len(points), along_normal))
            continue
        shapes = links[foot.frame].findall("collision")
        spheres = [sphere for shape in shapes if (sphere := _sphere(urdf, foot.frame, shape)) is not None]
        if not spheres:
            missing = f"no points, and {urdf.name} has no collision spheres at {foot.frame}"
            raise ConfigError.at_field("feet", missing, "points: [[x, y, z], ...] in the frame of the foot")
        points, radii = zip(*spheres, strict=True)
        feet.append(Foot(foot.frame, points, radii, along_normal))
    return tuple(feet)


def _sphere(urdf: Path, frame: str, shape: object) -> tuple[tuple[float, float, float], float] | None:
    """Centre and radius [m] of a collision shape in its link's frame, None unless it is a sphere."""
    sphere, origin = shape.find("geometry/sphere"), shape.find("origin")  # type: ignore[attr-defined]
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
    """Whether contact points, (k, 3) [m], form a polygon: do not all lie on a line."""
    return len(points) > 2 and float(np.linalg.svd(points - points.mean(axis=0))[1][1]) > _NARROWEST


WORLD = "world link"
"""Name of a link that is called as MuJoCo's own world."""

_STIFFEST = 0.9999  # share of a violation's acceleration that MuJoCo's constraints take away at most


@dataclass(frozen=True)
class JointConstraints:
    """What keeps joints of a robot from moving one by one.

    Attributes:
        held: position of joints that do not move, by name [rad or m].
        mimics: of joints that follow another one, by name.
        loops: pairs of frames that coincide.
        inertials: parameters (10,) in place of those that the file has, of links by name: what a held joint carries
            can be known together with what carries it alone.
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
        """Those of a robot's file, with its joints, and of loops and held joints that a run has."""
        held = held or {}
        mimics = {name: one for name, one in resolve_mimics(path, joints).items() if one.master and name not in held}
        return cls(held, mimics, loops)

    def add_to(self, spec: mujoco.MjSpec, physics_hz: float) -> None:
        """Constrain joints of a model, as stiffly as its steps allow; held joints are no joints any more."""
        for link, values in self.inertials.items():
            set_inertial(spec.body(body_name(link)), values)
        for name, position in self.held.items():
            _hold(spec, spec.joint(name), position)
        for name, mimic in self.mimics.items():
            one = spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1=name, name2=mimic.master)
            one.data[:5] = [mimic.offset, mimic.multiplier, 0.0, 0.0, 0.0]
        for number, loop in enumerate(self.loops):
            for frame, site in zip(loop.frames, _sites(number), strict=True):
                spec.body(body_name(frame)).add_site(name=site)
            kind = mujoco.mjtEq.mjEQ_CONNECT if loop.kind == "point" else mujoco.mjtEq.mjEQ_WELD
            one, other = _sites(number)
            spec.add_equality(type=kind, name1=one, name2=other, objtype=mujoco.mjtObj.mjOBJ_SITE)
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
    """Fix a joint of a URDF, whose anchor is its body's origin, at a position [rad or m]."""
    body, axis = joint.parent, np.array(joint.axis) / np.linalg.norm(joint.axis)
    start = Rotation.from_quat(np.array(body.quat), scalar_first=True)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        body.pos = np.array(body.pos) + start.apply(position * axis)
    else:
        body.quat = (start * Rotation.from_rotvec(position * axis)).as_quat(scalar_first=True)
    spec.delete(joint)


def set_inertial(body: mujoco.MjsBody, values: Array) -> None:
    """Replace the inertial parameters of a body with others, (10,)."""
    body.mass, body.inertia, body.fullinertia[:] = 0.0, np.zeros(3), np.nan  # none of the last, for MuJoCo
    if values[parameters.MASS]:
        body.mass, com, inertia = parameters.mass_com_inertia(values)
        body.ipos, body.fullinertia = com, inertia[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]
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
        J, rows = np.zeros((len(self.at), model.nv)), np.arange(len(self.at))
        J[rows, self.rate] = 1.0
        J[rows, self.master_rate] = -self.ratio
        return J, data.qpos[self.at] - self.ratio * data.qpos[self.master_at] - self.offset, np.zeros(len(rows))


def loop_errors(model: mujoco.MjModel, data: mujoco.MjData, loops: Sequence[Loop]) -> tuple[Array, Array, Array]:
    """How far loops are open: Jacobian (k, nv), error (k,) [m, rad] and bias acceleration (k,) of what closes them."""
    jacobians, errors, biases = [np.zeros((0, model.nv))], [np.zeros(0)], [np.zeros(0)]
    for number, loop in enumerate(loops):
        one, other = (_site_motion(model, data, name) for name in _sites(number))
        rows = list(loop.components)
        jacobians.append((one[2] - other[2])[rows])
        errors.append(np.append(one[0] - other[0], rotation_error(other[1], one[1]))[rows])
        biases.append((one[3] - other[3])[rows])
    return np.concatenate(jacobians), np.concatenate(errors), np.concatenate(biases)


def rotation_error(start: Array, end: Array) -> Array:
    """Error between two rotations (3, 3), (3,): axis in the outer frame times the sine of the angle."""
    R = end @ start.T
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def _site_motion(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> tuple[Array, Array, Array, Array]:
    """Position (3,), rotation to world (3, 3), Jacobian (6, nv) and bias acceleration (6,) of a site."""
    site = model.site(name).id
    J, J_dot = np.zeros((6, model.nv)), np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
    mujoco.mj_jacDot(model, data, J_dot[:3], J_dot[3:], data.site_xpos[site], int(model.site_bodyid[site]))
    return data.site_xpos[site].copy(), data.site_xmat[site].reshape(3, 3).copy(), J, J_dot @ data.qvel
