"""A robot: named bodies in a tree, independent joints, nominal parameters, mirror images, and payloads."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import pydantic.dataclasses
import torch
from pydantic import Field

from torchid import parameters
from torchid.errors import (
    ConfigError,
    MasslessBodyWarning,
    UnknownNameError,
    UrdfError,
    current_file,
    during,
    format_count,
    join_names,
    warn,
)
from torchid.parameters import WRENCH_COMPONENTS, Array
from torchid.reprs import short_repr
from torchid.robot.tree import (
    BodyJoint,
    BodyTree,
    JointGeometry,
    Loop,
    build_chain,
    build_tree,
    joint_geometry,
    link_parameters,
    link_poses,
    links_beyond,
    loops_of_file,
    nominal_parameters,
    passive_joints,
    spread_mass,
    validate_loops,
    weld_joints,
    weld_positions,
)
from torchid.robot.urdf import MOVING_TYPES, has_fixed_base, read_urdf
from torchid.robot.xml_files import file_kind
from torchid.settings import STRICT, Name, Number, Positive

if TYPE_CHECKING:
    from pytorch_kinematics import Chain


_FIRST_GUESS = (
    "estimator.total_mass in the experiment file, torchid init --total-mass KG, or a guess in each moving link:"
    " its mass [kg] and the inertia of a ball of its size [kg m^2]: <inertial>"
    '<mass value="1"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial>'
)


@dataclass(frozen=True)
class Body:
    """One rigid body: a URDF link, the links welded to it, and the joint that moves it (None for the base)."""

    name: str
    parent: int
    joint: BodyJoint | None
    links: tuple[str, ...]
    massless: bool

    __repr__ = short_repr


@dataclass(frozen=True)
class Robot:
    """A tree of L bodies in the URDF's depth-first order, moved by n independent joints.

    `nominal`, (L, 12), holds the URDF's parameters in the order of `torchid.parameters`. `links[name]` is the index of
    the body that carries a URDF link and the link's pose in that body's link frame, (4, 4) [m]. `welded[name]` is the
    position [rad or m] at which a joint of the URDF is held; `links_beyond_welds[name]`, (10,), are the URDF's inertial
    parameters, in its body's link frame, of a link that such a joint carries; `moved_beyond_welds` are those that some
    joint of the file moves.
    Of an MJCF robot, links and joints are those of `torchid.robot.mjcf.urdf_document`.
    `kind_of_welded` has such joints' types. `base_tilt`: rotation [rad] about the base link's x and y axes from the
    base whose motion logs record to this one. `loops`: pairs of frames that the tree's joints must keep together.
    `passive`: joints without a motor, whose torque is zero and need not be in logs.
    """

    path: Path
    base_link: str
    fixed_base: bool
    bodies: tuple[Body, ...]
    links: dict[str, tuple[int, Array]] = field(repr=False)
    nominal: Array = field(repr=False)
    chain: Chain = field(repr=False)
    welded: dict[str, float] = field(default_factory=dict)
    links_beyond_welds: dict[str, Array] = field(default_factory=dict, repr=False)
    moved_beyond_welds: tuple[str, ...] = field(default=(), repr=False)
    kind_of_welded: dict[str, str] = field(default_factory=dict, repr=False)
    base_tilt: tuple[float, float] = (0.0, 0.0)
    loops: tuple[Loop, ...] = ()
    passive: tuple[str, ...] = ()

    __repr__ = short_repr

    def _headline(self) -> str:
        base = "fixed" if self.fixed_base else "floating"
        mass = f"{self.nominal[:, 0].sum():.3f} kg"
        joints = join_names(self.joint_names)
        moved = f"{base} base {self.base_link}, {self.n} joints {joints}"
        loops = f", {format_count(len(self.loops), 'closed loop')}" if self.loops else ""
        return f"{self.path.name}, {len(self.bodies)} bodies, {mass}, {moved}{loops}"

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """The n independent joints, depth first; a mimic joint is not one of them, nor is a weld."""
        moving = (body.joint for body in self.bodies if body.joint is not None and body.joint.kind != "fixed")
        return tuple(joint.name for joint in moving if joint.mimic is None)

    @cached_property
    def ft_names(self) -> tuple[str, ...]:
        """The F fixed joints with a force/torque sensor, depth first."""
        return tuple(body.joint.name for body in self.bodies if body.joint is not None and body.joint.kind == "fixed")

    @cached_property
    def dof_names(self) -> tuple[str, ...]:
        """Rows of K below the base's: the n joints, then the six components of each force/torque sensor.

        Such a sensor counts as six motionless degrees of freedom whose generalized force is measured.
        """
        return (*self.joint_names, *(f"{name}.{k}" for name in self.ft_names for k in WRENCH_COMPONENTS))

    @cached_property
    def format(self) -> str:
        """What its file is, which nominal parameters are from: "URDF" or "MJCF"."""
        return file_kind(self.path)

    @property
    def sliding(self) -> tuple[str, ...]:
        """Names of the independent joints that slide: their torque is a force."""
        joints = {body.joint.name: body.joint.kind for body in self.bodies if body.joint is not None}
        return tuple(name for name in self.joint_names if joints[name] == "prismatic")

    @cached_property
    def is_passive(self) -> np.ndarray:
        """Which of `dof_names` are joints without a motor, (n + 6 F,) bool."""
        return np.isin(self.dof_names, self.passive)

    @property
    def n_dofs(self) -> int:
        """Number of `dof_names`: n joints and six components of each force/torque sensor in a limb, n + 6 F."""
        return len(self.dof_names)

    @property
    def n(self) -> int:
        """Number of independent joints."""
        return len(self.joint_names)

    @property
    def base_rows(self) -> int:
        """Rows of the dynamics that belong to the base: 6, or 0 for a fixed base."""
        return 0 if self.fixed_base else 6

    @property
    def nv(self) -> int:
        """Number of generalized velocities: n + 6, or n for a fixed base."""
        return self.n + self.base_rows

    @property
    def n_rows(self) -> int:
        """Rows of K: those of the base, then one for each of `dof_names`; nv + 6 F."""
        return self.base_rows + self.n_dofs

    @property
    def body_names(self) -> tuple[str, ...]:
        """Names of the L bodies: the link each joint moves; the base link for the base."""
        return tuple(body.name for body in self.bodies)

    @cached_property
    def children(self) -> tuple[tuple[int, ...], ...]:
        """Child bodies of each of the L bodies, depth first."""
        return tuple(
            tuple(child for child, body in enumerate(self.bodies) if child and body.parent == parent)
            for parent in range(len(self.bodies))
        )

    def bodies_to(self, body: int) -> list[int]:
        """Bodies from the base on, without it, to one, which is the last."""
        path = list[int]()
        while body > 0:
            path.append(body)
            body = self.bodies[body].parent
        return path[::-1]

    @property
    def massless(self) -> tuple[str, ...]:
        """Bodies without mass or inertia: their inertial parameters are not fitted."""
        return tuple(body.name for body in self.bodies if body.massless)

    @cached_property
    def geometry(self) -> JointGeometry:
        """Joint frames and axes, one row per body."""
        return joint_geometry(self.chain, self.body_names)

    @cached_property
    def joint_map(self) -> tuple[Array, Array]:
        """`(M, c)`, (L - 1, n) and (L - 1,): positions of all joints from the independent ones, `M q + c`."""
        matrix = np.zeros((len(self.bodies) - 1, self.n))
        constant = np.zeros(len(self.bodies) - 1)
        for row, body in enumerate(self.bodies[1:]):
            joint = body.joint
            if joint is not None and joint.mimic is not None:
                matrix[row, self.joint_names.index(joint.mimic.master)] = joint.mimic.multiplier
                constant[row] = joint.mimic.offset
            elif joint is not None and joint.kind != "fixed":
                matrix[row, self.joint_names.index(joint.name)] = 1.0
        return matrix, constant

    @cached_property
    def armature(self) -> Array:
        """Reflected rotor inertia of the independent joints and of those that mimic them, (n,) [kg m^2 or kg]."""
        return (self.joint_map[0] ** 2).T @ np.array([joint.armature for joint in self._joints])

    @cached_property
    def stiffness(self) -> Array:
        """Of the springs in the independent joints and in those that mimic them, (n,) [N m/rad or N/m]."""
        return (self.joint_map[0] ** 2).T @ np.array([joint.stiffness for joint in self._joints])

    @cached_property
    def spring_torque(self) -> Array:
        """Torque (n,) [N m or N] that holds the joints at position 0 against their springs."""
        matrix, constant = self.joint_map
        stiffness, rest_position = (
            np.array([getattr(x, name) for x in self._joints]) for name in ("stiffness", "rest")
        )
        return matrix.T @ (stiffness * (constant - rest_position))

    @property
    def _joints(self) -> list[BodyJoint]:
        """Joints of the L - 1 bodies after the base."""
        return [body.joint for body in self.bodies if body.joint is not None]

    def link_poses(self, joint_position: torch.Tensor) -> dict[str, torch.Tensor]:
        """Pose of every URDF link in the base link's frame, from pytorch-kinematics.

        Args:
            joint_position: (B, n) [rad or m], by `joint_names`.

        Returns:
            `T_base_link`, (B, 4, 4) [m], by link name.
        """
        matrix, constant = (torch.as_tensor(x, dtype=torch.float64) for x in self.joint_map)
        in_depth_first_order = joint_position @ matrix.T + constant
        order = {body.joint.name: i for i, body in enumerate(self.bodies[1:]) if body.joint is not None}
        columns = [order[name] for name in self.chain.get_joint_parameter_names()]
        return link_poses(self.chain, in_depth_first_order[:, columns])

    def link(self, name: str, field: str = "link") -> tuple[int, Array]:
        """Body index and pose in that body, (4, 4) [m], of a URDF link.

        Args:
            name: the link.
            field: the setting or log field that names it, for the error: in `current_file`, or else the URDF.

        Raises:
            UnknownNameError: the URDF has no such link.
        """
        if not isinstance(name, str) or name not in self.links:
            raise UnknownNameError(current_file() or self.path, field, str(name), self.links)
        return self.links[name]


def load_robot(
    path: str | Path,
    base_link: str | None = None,
    fixed_base: bool = False,
    ft_joints: Sequence[str] = (),
    weld: Mapping[str, float] | Sequence[str] = (),
    base_tilt: tuple[float, float] = (0.0, 0.0),
    loops: Sequence[Loop] = (),
    passive: Sequence[str] | None = None,
    total_mass: float | None = None,
) -> Robot:
    """Read a URDF or, by MuJoCo, an MJCF file into a `Robot`.

    Args:
        path: the file; meshes are not opened, but for those of an MJCF file that a body's inertia is made of.
        base_link: the link that becomes the floating (or fixed) base, by default the root of the URDF.
        fixed_base: True if the base does not move.
        ft_joints: fixed joints with a force/torque sensor: the links beyond form a body of their own.
        weld: names or patterns of joints that are held, at 0 or at the position [rad or m] that a mapping gives.
        base_tilt: rotation [rad] about the base link's x and y axes from the base whose motion logs record to this one:
            of a table that is not level, or of an IMU that is mounted askew.
        loops: closed loops beside those that an MJCF file has.
        passive: names or patterns of joints without a motor; None for those that an MJCF file with loops says are.
        total_mass: of the robot [kg], which `spread_mass` shares out where no link of the file has mass.

    Raises:
        UrdfError, UnknownNameError: see `read_urdf` and `build_tree`; also when no body has mass, or when the base of
            an MJCF file has no free joint and is not said to be fixed.
        ConfigError: see `weld_positions`, `validate_loops` and `passive_joints`.
        InputError: an MJCF file, and MuJoCo is not installed.
        TypeError: `path` is the model of another library.

    Warns:
        TorchidWarning: a mass is shared out.
        MasslessBodyWarning: a body at the end of a limb has no inertia.
        UnphysicalInertiaWarning: a link's inertia belongs to no distribution of positive mass.
    """
    if not isinstance(path, (str, Path)):
        raise TypeError(f"path: found {type(path).__name__}; accepted: the path of a URDF or MJCF file")
    path = Path(path)
    with during("reading", path):
        links, joints = read_urdf(path)
        if total_mass is not None and not any(link.inertial is not None and link.inertial.mass for link in links):
            spread_mass(path, links, joints, total_mass)
        if not fixed_base and has_fixed_base(path):
            reason = "missing: the base is fixed to the world"
            raise UrdfError(path, "<freejoint>", reason, "robot.fixed_base: true, or a free joint on the base body")
    welded = weld_positions(path, joints, weld if isinstance(weld, Mapping) else dict.fromkeys(weld, 0.0))
    by_name = {link.name: link for link in links}
    with during("reading", path):
        tree = build_tree(path, links, weld_joints(joints, welded), base_link, ft_joints)
        nominal = nominal_parameters(path, tree, by_name)
        massless = ~np.any(nominal[:, parameters.INERTIAL], axis=1)
        if massless.all():
            raise UrdfError(path, "<inertial>", "no link has mass", _FIRST_GUESS)
        bodies = _bodies(tree, massless)
        _warn_of_massless_ends(path, bodies)
        beyond = links_beyond(joints, welded, {name: body for name, (body, _) in tree.links.items()}, tree.names)
        carried = {name: link_parameters(by_name[name], tree.links[name][1]) for name in beyond}
        kinds = {joint.name: joint.type for joint in joints if joint.name in welded}
        chain = build_chain(tree)
        moved = tuple(joint.child for joint in joints if joint.type in MOVING_TYPES and joint.child in carried)
        held = (welded, carried, moved, kinds)
        closed = loops_of_file(path)
        robot = Robot(path, tree.names[0], fixed_base, bodies, tree.links, nominal, chain, *held, base_tilt)
    validate_loops([*loops, *closed], robot.links)
    return replace(robot, loops=(*loops, *closed), passive=passive_joints(joints, passive, robot.joint_names))


def _bodies(tree: BodyTree, massless: np.ndarray) -> tuple[Body, ...]:
    """The bodies of a tree; `massless`, (L,) bool."""
    return tuple(
        Body(
            name,
            parent=-1 if joint is None else joint.parent,
            joint=joint,
            links=tuple(link for link, (body, _) in tree.links.items() if body == index),
            massless=bool(massless[index]),
        )
        for index, (name, joint) in enumerate(zip(tree.names, tree.joints, strict=True))
    )


def _warn_of_massless_ends(path: Path, bodies: tuple[Body, ...]) -> None:
    parents = {body.parent for body in bodies}
    for index, body in enumerate(bodies):
        if body.massless and index not in parents:
            message = f"{path}: link '{body.name}' at the end of a limb has no inertia; its inertia is not fitted"
            warn(message, MasslessBodyWarning)


INERTIA_ACCEPTED = "ixx, ixy, ixz, iyy, iyz, izz [kg m^2] about the payload's centre of mass, physically consistent"


@pydantic.dataclasses.dataclass(config=STRICT, frozen=True)
class Payload:
    """A load that is fixed to a link.

    Attributes:
        link: of the URDF.
        mass: [kg].
        center_of_mass: (3,) in the link's frame [m].
        inertia: Ixx, Ixy, Ixz, Iyy, Iyz, Izz about the load's centre of mass, along the link's axes [kg m^2]; a point
            mass by default.
    """

    link: Name
    mass: Positive
    center_of_mass: Annotated[tuple[Number, ...], Field(min_length=3, max_length=3)]
    inertia: Annotated[tuple[Number, ...], Field(min_length=6, max_length=6)] = (0.0,) * 6

    @property
    def about_center(self) -> Array:
        """Inertial parameters (10,) about the centre of mass, along the link's axes."""
        return np.array([self.mass, 0.0, 0.0, 0.0, *self.inertia])

    @property
    def inertial(self) -> Array:
        """Inertial parameters (10,) in the link's frame."""
        inertia = parameters.inertia_matrix(self.about_center)
        return parameters.inertial_vector(self.mass, np.array(self.center_of_mass), inertia)


def payload_parameters(robot: Robot, payloads: Sequence[Payload], recording: str = "") -> Array:
    """What payloads add to the robot's parameters, (12 L,), each body's in its link frame.

    Args:
        robot: that carries them.
        payloads: loads.
        recording: in which it does, for errors.

    Raises:
        UnknownNameError: the URDF has no such link.
        ConfigError: an inertia that no body has, or a link of a body that has none of its own.
    """
    where = f" of {recording}" if recording else ""
    added = np.zeros_like(robot.nominal)
    for payload in payloads:
        body, T_body_link = robot.link(payload.link, f"payload.link{where}")
        if parameters.consistency_margin(payload.about_center) < parameters.POSSIBLE_MARGIN:
            reason = f"{list(payload.inertia)} is not physically consistent"
            raise ConfigError.at_field(f"payload.inertia{where}", reason, INERTIA_ACCEPTED)
        if robot.bodies[body].massless:
            reason = f"the body of '{payload.link}' has no mass in the {robot.format}"
            raise ConfigError.at_field(
                f"payload.link{where}", reason, "a link on a body with mass, or an <inertial> for this one"
            )
        added[body, parameters.INERTIAL] += parameters.change_of_frame(T_body_link) @ payload.inertial
    return added.flatten()


def require_payloads(robot: Robot, payloads: Mapping[str, Sequence[Payload]]) -> None:
    """Refuse payloads, by recording, that a robot cannot carry, as `payload_parameters`."""
    for recording, of_recording in payloads.items():
        payload_parameters(robot, of_recording, recording)


def with_payload(robot: Robot, added: Array | None) -> Robot:
    """The robot with the nominal parameters that it has with payloads, which add (12 L,) to its own; None for none."""
    return robot if added is None else replace(robot, nominal=robot.nominal + added.reshape(robot.nominal.shape))


MIRROR_TOLERANCE = 1e-3
"""Greatest distance of an origin from its mirror image, in units of the robot's size."""


@dataclass(frozen=True)
class MirrorPair:
    """Indices of two bodies, and the matrix (3, 3) that takes vectors of the first one's link to the second one's."""

    body: int
    image: int
    reflection: Array


def mirror_pairs(
    robot: Robot,
    left: str,
    right: str,
    normal: str = "y",
    field: str = "symmetry",
    apart: Collection[str] = (),
) -> tuple[MirrorPair, ...]:
    """Pairs of bodies whose names become each other's if `left` and `right` change places in them.

    All of them do, or else one alone: LAnkleRoll and RAnkleRoll differ in one letter of three, L and R. With all joints
    at 0 the two bodies must be mirror images with respect to the plane through the base link's origin whose normal is
    the base link's axis `normal`: with D the reflection, D p_i = p_j for the origins, to `MIRROR_TOLERANCE`, and D a_i
    parallel to a_j for the joints' axes. From one link frame to the other the reflection is R_j^T D R_i.

    Args:
        robot: any.
        left: part of the names of bodies on one side, as "l_".
        right: the part in its stead in the names of their mirror images.
        normal: "x", "y" or "z".
        field: that names them, for errors.
        apart: bodies that need no counterpart; two of them are no pair.

    Raises:
        ConfigError: no pair at all; a body without its counterpart; a body with two; a pair that is not mirrored, or
            of which one has no mass.
    """
    names = robot.body_names
    pairs = _by_name(names, left, right, apart, field)
    poses = robot.link_poses(torch.zeros(1, robot.n, dtype=torch.float64))
    T = np.stack([poses[name][0].numpy() for name in names])
    size = float(np.ptp(T[:, :3, 3], axis=0).max())
    D = np.eye(3)
    D["xyz".index(normal), "xyz".index(normal)] = -1.0
    out = []
    for i, j in pairs:
        pair = f"{names[i]} and {names[j]}"
        accepted = "mirror images when all joints are at 0"
        off = float(np.linalg.norm(D @ T[i, :3, 3] - T[j, :3, 3]))
        if off > MIRROR_TOLERANCE * size:
            reason = f"{pair} miss being mirror images along {normal} by {off:.3g} m, in a robot of {size:.3g} m"
            raise ConfigError.at_field(field, reason, f"{accepted}, within {MIRROR_TOLERANCE * size:.2g} m")
        aslant = _angle(robot, T, D, i, j)
        if aslant > MIRROR_TOLERANCE:
            raise ConfigError.at_field(field, f"the joints of {pair} are {aslant:.3g} rad off", accepted)
        if robot.bodies[i].massless != robot.bodies[j].massless:
            raise ConfigError.at_field(field, f"one of {pair} has no mass", "two bodies with mass")
        out.append(MirrorPair(i, j, T[j, :3, :3].T @ D @ T[i, :3, :3]))
    return tuple(out)


def _by_name(
    names: tuple[str, ...], left: str, right: str, apart: Collection[str], field: str
) -> list[tuple[int, int]]:
    """Indices of bodies whose names answer to each other."""
    if left == right:
        raise ConfigError.at_field(field, f"'{left}' for both sides", "different parts of names for left and right")
    images = {name: _images(name, left, right, names) for name in names}
    for name, counterparts in images.items():
        expected = _exchanged(name, left, right)
        if not counterparts and name not in apart and expected != name:
            raise ConfigError.at_field(field, f"{name} has no counterpart", f"a body named {expected}")
        if len(counterparts) > 1 or any(images[image] != [name] for image in counterparts):
            others = [other for other in names if other in counterparts or name in images[other]]
            raise ConfigError.at_field(field, f"{name} corresponds to {' and to '.join(others)}", "one counterpart")
    pairs = [(i, names.index(images[name][0])) for i, name in enumerate(names) if images[name]]
    if not pairs:
        raise ConfigError.at_field(
            field, f"no two bodies differ in '{left}' and '{right}'", f"parts of names: {join_names(names)}"
        )
    return [(i, j) for i, j in pairs if i < j and not (names[i] in apart and names[j] in apart)]


def _images(name: str, left: str, right: str, names: tuple[str, ...]) -> list[str]:
    """Bodies whose name is this one with left and right exchanged wherever they are words, or else once anywhere."""
    exchanged = _exchanged(name, left, right)
    if exchanged != name and exchanged in names:
        return [exchanged]
    candidates = [
        name[:i] + other + name[i + len(token) :]
        for token, other in ((left, right), (right, left))
        for i in range(len(name))
        if name.startswith(token, i)
    ]
    return [other for other in names if other in candidates]


def _exchanged(name: str, left: str, right: str) -> str:
    """The name with left and right exchanged, other than inside words, as l_ is in shell_link."""
    alone = []
    for token in sorted((left, right), key=len, reverse=True):
        before = "(?<![A-Za-z0-9])" if token[0].isalnum() else ""
        after = "(?![A-Za-z0-9])" if token[-1].isalnum() else ""
        alone.append(before + re.escape(token) + after)
    return re.sub("|".join(alone), lambda match: right if match[0] == left else left, name)


def _angle(robot: Robot, T: Array, D: Array, i: int, j: int) -> float:
    """Angle between the axis of body j's joint and the mirrored one of body i's [rad], pi if only one slides."""
    body_joint = robot.bodies[i].joint
    image_joint = robot.bodies[j].joint
    if body_joint is None or image_joint is None:
        return 0.0
    if body_joint.kind != image_joint.kind:
        return float(np.pi)
    axes = [
        T[k, :3, :3] @ joint.T_joint_link[:3, :3].T @ joint.axis for k, joint in ((i, body_joint), (j, image_joint))
    ]
    return float(np.arcsin(min(1.0, float(np.linalg.norm(np.cross(D @ axes[0], axes[1]))))))
