"""A robot: named bodies in a tree, independent joints, nominal parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from yourdfpy.urdf import Inertial, Link

from torchid import parameters
from torchid.errors import (
    MasslessBodyWarning,
    UnknownNameError,
    UnphysicalInertiaWarning,
    UrdfError,
    current_file,
    during,
    warn,
)
from torchid.parameters import WRENCH_COMPONENTS, Array
from torchid.robot.tree import BodyJoint, BodyTree, JointGeometry, build_chain, build_tree, joint_geometry, link_poses
from torchid.robot.urdf import read_urdf

if TYPE_CHECKING:
    from pytorch_kinematics import Chain

_TRIANGLE_TOLERANCE = 1e-3  # URDFs carry few digits: thin plates break the inequality by rounding alone
_ROUNDING = 1e-6  # of the largest principal inertia
_POINT = 1e-12  # [m^2]: below it a point mass is meant


@dataclass(frozen=True)
class Body:
    """One rigid body: a URDF link, the links welded to it, and the joint that moves it (None for the base)."""

    name: str
    parent: int
    joint: BodyJoint | None
    links: tuple[str, ...]
    massless: bool


@dataclass(frozen=True)
class Robot:
    """A tree of L bodies in the URDF's depth-first order, moved by n independent joints.

    `nominal`, (L, 12), holds the URDF's parameters in the order of `torchid.parameters`. `links[name]` is the index of
    the body that carries a URDF link and the link's pose in that body's link frame, (4, 4) [m].
    """

    path: Path
    base_link: str
    fixed_base: bool
    bodies: tuple[Body, ...]
    links: dict[str, tuple[int, Array]] = field(repr=False)
    nominal: Array = field(repr=False)
    chain: Chain = field(repr=False)

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
        """Bodies that hang on each of the L bodies, depth first."""
        return tuple(
            tuple(child for child, body in enumerate(self.bodies) if child and body.parent == parent)
            for parent in range(len(self.bodies))
        )

    @property
    def massless(self) -> tuple[str, ...]:
        """Bodies without mass or inertia: their inertial parameters stay out of the fit."""
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
            field: what named it, for the error: in `current_file`, or else the URDF.

        Raises:
            UnknownNameError: the URDF has no such link.
        """
        if name not in self.links:
            raise UnknownNameError(current_file() or self.path, field, name, self.links)
        return self.links[name]


def load_robot(
    path: str | Path, base_link: str | None = None, fixed_base: bool = False, ft_joints: Sequence[str] = ()
) -> Robot:
    """Read a URDF into a `Robot`.

    Args:
        path: the URDF file; meshes are never opened.
        base_link: the link that becomes the floating (or bolted) base, by default the URDF's root.
        fixed_base: True if the base does not move.
        ft_joints: fixed joints with a force/torque sensor: what lies beyond is a body of its own.

    Raises:
        UrdfError, UnknownNameError: see `read_urdf` and `build_tree`; also when no body has mass.

    Warns:
        MasslessBodyWarning: a body at the end of a limb has no inertia.
        UnphysicalInertiaWarning: a link's inertia belongs to no distribution of positive mass.
    """
    path = Path(path)
    with during("reading", path):
        links, joints = read_urdf(path)
        tree = build_tree(path, links, joints, base_link, ft_joints)
        nominal = nominal_parameters(path, tree, {link.name: link for link in links})
        massless = ~np.any(nominal[:, parameters.INERTIAL], axis=1)
        if massless.all():
            raise UrdfError(path, "<inertial>", "no link has mass", "at least one link with mass > 0")
        bodies = tuple(
            Body(
                name,
                parent=-1 if joint is None else joint.parent,
                joint=joint,
                links=tuple(link for link, (body, _) in tree.links.items() if body == index),
                massless=bool(massless[index]),
            )
            for index, (name, joint) in enumerate(zip(tree.names, tree.joints, strict=True))
        )
        _warn_of_massless_ends(path, bodies)
        return Robot(path, tree.names[0], fixed_base, bodies, tree.links, nominal, build_chain(tree))


def nominal_parameters(path: Path, tree: BodyTree, links: dict[str, Link]) -> Array:
    """Parameters (L, 12) of the bodies, each in its link frame.

    Warns:
        UnphysicalInertiaWarning: a link's inertia belongs to no distribution of positive mass.
    """
    nominal = np.zeros((len(tree.names), parameters.PER_BODY))
    for name, (body, T_body_link) in tree.links.items():
        inertial = links[name].inertial
        if inertial is None:
            continue
        _warn_if_unphysical(path, name, inertial)
        T_link_com = np.eye(4) if inertial.origin is None else inertial.origin
        at_com = parameters.inertial_vector(inertial.mass, np.zeros(3), inertial.inertia)
        nominal[body, parameters.INERTIAL] += parameters.change_of_frame(T_body_link @ T_link_com) @ at_com
    for body, joint in enumerate(tree.joints):
        if joint is not None:
            nominal[body, parameters.FRICTION] = joint.friction, joint.damping
    return nominal


def _warn_if_unphysical(path: Path, link: str, inertial: Inertial) -> None:
    small, middle, large = np.linalg.eigvalsh(inertial.inertia)
    if large == small == inertial.mass == 0.0:
        return
    if inertial.mass == 0.0:
        what = "mass 0 kg with an inertia that is not 0"
    elif small < -_ROUNDING * large - _POINT * inertial.mass:
        what = f"principal inertias {small:.3g}, {middle:.3g}, {large:.3g} kg m^2 are not all positive"
    elif large > (small + middle) * (1.0 + _TRIANGLE_TOLERANCE) + _POINT * inertial.mass:
        what = f"largest principal inertia {large:.3g} exceeds the sum of the others, {small + middle:.3g} kg m^2"
    else:
        return
    warn(f"{path}: link '{link}': {what}; used as written", UnphysicalInertiaWarning)


def _warn_of_massless_ends(path: Path, bodies: tuple[Body, ...]) -> None:
    parents = {body.parent for body in bodies}
    for index, body in enumerate(bodies):
        if body.massless and index not in parents:
            message = f"{path}: link '{body.name}': no inertia at the end of a limb; its inertia stays out of the fit"
            warn(message, MasslessBodyWarning)
