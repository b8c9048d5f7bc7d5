"""A robot: named bodies in a tree, independent joints, nominal parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchid import parameters
from torchid.errors import (
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
from torchid.robot.constraints import (
    Loop,
    links_beyond,
    loops_of_file,
    passive_joints,
    validate_loops,
    weld_joints,
    weld_positions,
)
from torchid.robot.tree import (
    BodyJoint,
    BodyTree,
    JointGeometry,
    build_chain,
    build_tree,
    joint_geometry,
    link_parameters,
    link_poses,
    nominal_parameters,
    spread_mass,
)
from torchid.robot.urdf import MOVING_TYPES, has_fixed_base, read_urdf
from torchid.robot.xml_files import file_kind

if TYPE_CHECKING:
    from pytorch_kinematics import Chain


_FIRST_GUESS = (
    "estimator.total_mass in the experiment file, torchid init --total-mass KG, or a guess in each link that moves,"
    " of its mass [kg] and of the inertia of a ball of its size [kg m^2]: <inertial>"
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
        found = list[int]()
        while body > 0:
            found.append(body)
            body = self.bodies[body].parent
        return found[::-1]

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
        matrix, constant = np.zeros((len(self.bodies) - 1, self.n)), np.zeros(len(self.bodies) - 1)
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
        stiffness, rest = (np.array([getattr(x, name) for x in self._joints]) for name in ("stiffness", "rest"))
        return matrix.T @ (stiffness * (constant - rest))

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
        raise TypeError(f"path: found {type(path).__name__}; accepted: that of a URDF or MJCF file")
    path = Path(path)
    with during("reading", path):
        links, joints = read_urdf(path)
        if total_mass is not None and not any(link.inertial is not None and link.inertial.mass for link in links):
            spread_mass(path, links, joints, total_mass)
        if not fixed_base and has_fixed_base(path):
            found = "none, so that its base is fixed to the world"
            raise UrdfError(path, "<freejoint>", found, "robot.fixed_base: true, or a free joint of the base's body")
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
        held, closed = (welded, carried, moved, kinds), loops_of_file(path)
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
            message = f"{path}: link '{body.name}': no inertia at the end of a limb; its inertia is not fitted"
            warn(message, MasslessBodyWarning)
