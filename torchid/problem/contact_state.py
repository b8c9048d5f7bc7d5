"""Columns of the rows, and the layout of a contact state: its columns, coupled joints, wrenches and loops' forces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.extras import Extra
from torchid.problem.row_blocks import RowBlock, RowBlocks, row_block
from torchid.problem.samples import Samples
from torchid.regressor.columns import reduced_layout, reduction_matrix
from torchid.regressor.kinematics import BodyStates
from torchid.regressor.loops import LoopClosures, LoopGeometry
from torchid.regressor.regressor import (
    JointRow,
    contact_arms,
    forces_at_base,
    ground_axes,
    joint_rows,
    rolling_arms,
    wrench_transform,
    wrenches_at_base,
)
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.rounding import KINEMATIC_TOLERANCE, is_significant
from torchid.sensing import Contact, SensorSet
from torchid.sensing.sensors import measured_components

if TYPE_CHECKING:
    from torchid.problem.rows import ChunkKinematics


class LineOfAction(NamedTuple):
    """What of forces on a body changes from sample to sample.

    `rolling`: contact whose `rolling_arms` they have, so that they act where it touches the ground. `ground`: contact
    whose `ground_axes` they are along, in its frame's origin; their rows are (k, 3), by these axes.
    """

    rolling: int | None = None
    ground: int | None = None


@dataclass(frozen=True)
class WrenchRows:
    """Wrenches, (k, 6), at a body's joint frame, in its axes.

    `line_of_action`: where and along which axes their forces act, if that is not fixed to the body.
    """

    rows: Tensor
    line_of_action: LineOfAction


def wrenches_at_ground(
    parts: Sequence[WrenchRows], count: int, kinematics: ChunkKinematics, body: int, origin: Callable[[int], Tensor]
) -> Tensor:
    """Wrenches on a body at the base origin in base axes, (6, count, B); of more, a basis of what they span.

    Where they span less at some sample, the basis has directions too many: it costs equations, but lets no
    unmeasured force in.

    Args:
        parts: of the rows.
        count: of the wrenches.
        kinematics: of B samples.
        body: that the wrenches act on.
        origin: of a contact frame in the node's joint frame, (3,) [m].
    """
    rows, states = [], kinematics.states
    for part in parts:
        rolling, ground = part.line_of_action
        arms = None if rolling is None else kinematics.arms[rolling]
        if ground is None:
            rows.append(wrenches_at_base(states, body, part.rows, arms))
        else:
            forces = part.rows @ kinematics.ground_axes[ground]
            rows.append(forces_at_base(states, body, origin(ground), forces, arms))
    at_base = rows[0] if len(rows) == 1 else torch.cat(rows, dim=1)
    if at_base.shape[1] == count:
        return at_base
    Vh: Tensor = torch.linalg.svd(at_base.permute(2, 1, 0), full_matrices=False).Vh
    return Vh[:, :count].permute(2, 1, 0)


@dataclass(frozen=True)
class FramePoses:
    """Poses of a contact's frame in the world, or in a fixed base of which no pose was recorded.

    `rotation`: (B, 3, 3), frame to world. `origin`: (B, 3) [m]; None for wrenches that are about it already.
    """

    rotation: Tensor
    origin: Tensor | None

    @classmethod
    def of(cls, samples: Samples, kinematics: ChunkKinematics, body: int, axes: Tensor, origin: Tensor) -> FramePoses:
        """Those of a frame with such axes, (3, 3), and origin, (3,) [m], in the joint frame of a body."""
        R_world_base, position = kinematics.rotation_world_base, samples.base.position
        rotation = kinematics.states.rotation[:, :, body].permute(2, 0, 1)
        arm = None if position is None else kinematics.states.position[:, body].T + rotation @ origin
        rotation = rotation @ axes
        if R_world_base is not None:
            rotation = R_world_base @ rotation
            arm = None if arm is None else (R_world_base @ arm[..., None])[..., 0]
        return cls(rotation, None if arm is None or position is None else position + arm)

    def in_frame(self, wrench: Tensor) -> Tensor:
        """Wrenches as recorded, (B, 6) [N, N m], at the frame's origin along its axes."""
        force, moment = wrench.unflatten(1, (2, 3)).unbind(1)
        if self.origin is not None:
            moment = moment - torch.linalg.cross(self.origin, force)
        return (self.rotation.mT @ torch.stack([force, moment], dim=2)).mT.flatten(1)

    def of_unit(self, axis: int) -> Tensor:
        """What a recorded component of 1 is there, (B, 6)."""
        unit = self.rotation.new_zeros(len(self.rotation), 6)
        unit[:, axis] = 1.0
        return self.in_frame(unit)

    def reached(self, axis: int) -> range:
        """Components there to which a recorded one adds."""
        first, last = (0, 3) if axis < 3 else (3, 6)
        return range(first, last if self.origin is None else 6)


@dataclass(frozen=True)
class LoopRows:
    """What a loop exerts.

    `wrenches`, (k, 6): on its first body, at the node's joint frame, without directions that never do work. `joints`:
    measured ones on which they do, by their place among the coupled joints; `dofs`: by their number.
    """

    geometry: LoopGeometry
    wrenches: Tensor
    joints: tuple[int, ...]
    dofs: tuple[int, ...]

    def forces(self, tree: KinematicTree, kinematics: ChunkKinematics) -> Tensor:
        """Torques of a unit of each on its joints, (k, joints, B)."""
        at_base = wrenches_at_base(kinematics.states, self.geometry.nodes[0], self.wrenches)
        return self.geometry.forces(tree, kinematics.screw_axes, at_base, self.dofs)


class LoopLayouts:
    """The loops of a robot; `dofs`: degrees of freedom that some of them depends on."""

    def __init__(self, robot: Robot) -> None:
        self._closures = LoopClosures(robot) if robot.loops else None
        self.dofs = frozenset() if self._closures is None else frozenset(self._closures.dofs)
        self._wrenches: dict[tuple[int, tuple[int, ...]], Array] = {}

    def rows(self, coupled: Sequence[int], like: Tensor) -> Iterator[LoopRows]:
        """Rows of each loop that does work on a measured joint.

        Args:
            coupled: measured joints whose rows the projection combines.
            like: a tensor of the rows' type.
        """
        closures = self._closures
        if closures is None:
            return
        for number, loop in enumerate(closures.geometries):
            own = set(loop.dofs(closures.tree))
            joints = tuple(index for index, joint in enumerate(coupled) if joint in own)
            dofs = tuple(coupled[index] for index in joints)
            if (number, dofs) not in self._wrenches:
                self._wrenches[number, dofs] = closures.effective_wrenches(number, dofs)
            if len(wrenches := self._wrenches[number, dofs]):
                yield LoopRows(loop, torch.tensor(wrenches, dtype=like.dtype, device=like.device), joints, dofs)


_DETERMINED = 1e-6  # share of a Jacobian's size: a motor moves the passive joints if no more of its column is left


@dataclass(frozen=True)
class _Group:
    """Loops that share joints, with their degrees of freedom: those of passive joints, and others."""

    loops: tuple[LoopGeometry, ...]
    passive: tuple[int, ...]
    driven: tuple[int, ...]


class MotorForces:
    """Rows of generalized forces as the motors of closed loops feel them.

    With the loops' Jacobian J = [J_a, J_p] by motors and passive joints, a motor's motion moves the passive joints by
    G = -J_p^+ J_a. Of generalized forces f, what goes through the loops drops out of f_a + G^T f_p: the principle of
    virtual work. `none`: the robot has no loops, and rows stay as they are.
    """

    def __init__(self, robot: Robot) -> None:
        self.none = not robot.loops
        self._base, self._groups = robot.base_rows, list[_Group]()
        if self.none:
            return
        closures = LoopClosures(robot)
        dofs = [set(loop.dofs(closures.tree)) for loop in closures.geometries]
        linked = np.array([[bool(one & other) for other in dofs] for one in dofs])
        _, label = connected_components(linked, directed=False)
        for group in range(label.max() + 1):
            members = np.flatnonzero(label == group).tolist()
            own = sorted(set[int]().union(*(dofs[k] for k in members)))
            passive = tuple(dof for dof in own if robot.is_passive[dof])
            driven = tuple(dof for dof in own if not robot.is_passive[dof])
            self._groups.append(_Group(tuple(closures.geometries[k] for k in members), passive, driven))

    @property
    def passive(self) -> tuple[int, ...]:
        """Joints without a motor in loops."""
        return tuple(dof for group in self._groups for dof in group.passive)

    def above(self, dofs: Iterable[int]) -> set[int]:
        """Degrees of freedom with those of all loops that some of them are in, but for passive joints in these."""
        own, out = set(dofs), set(dofs)
        for group in self._groups:
            if own & {*group.passive, *group.driven}:
                out = (out | set(group.driven)) - set(group.passive)
        return out

    def of(self, tree: KinematicTree, kinematics: ChunkKinematics, forces: Tensor) -> Tensor:
        """Generalized forces (..., B, n_rows) with those of motors in loops; NaN at passive joints in them.

        Also NaN where motors do not determine how the passive joints move.

        Args:
            tree: the robot's constants.
            kinematics: of the samples.
            forces: rows as in K.
        """
        if self.none:
            return forces
        out = forces.clone()
        for group in self._groups:
            motion, determined = _passive_motion(tree, kinematics, group)  # (B, p, a), (B, a)
            driven, passive = (tree.index(self._base + k for k in x) for x in (group.driven, group.passive))
            through = (forces[..., passive][..., None, :] @ motion)[..., 0, :]
            out[..., driven] = torch.where(determined, forces[..., driven] + through, torch.nan)
            out[..., passive] = torch.nan
        return out


def _passive_motion(tree: KinematicTree, kinematics: ChunkKinematics, group: _Group) -> tuple[Tensor, Tensor]:
    """Motion of passive joints by that of motors, (B, p, a), and which motors (B, a) determine it."""
    J_p, J_a = (
        torch.cat([loop.jacobian(tree, kinematics.states, dofs) for loop in group.loops]).permute(2, 0, 1)
        for dofs in (group.passive, group.driven)
    )
    values, p = torch.linalg.svdvals(J_p), len(group.passive)
    size = torch.linalg.matrix_norm(torch.cat([J_p, J_a], dim=2))[:, None]
    motion = -torch.linalg.pinv(J_p, rtol=_DETERMINED) @ J_a
    left = torch.linalg.vector_norm(J_a + J_p @ motion, dim=1)
    determined = left <= _DETERMINED * size
    if values.shape[1] < p:  # more passive joints than constraints
        return motion, torch.zeros_like(determined)
    return motion, determined & (values[:, p - 1 : p] > _DETERMINED * size if p else determined)


ContactState = tuple[bool, ...]
"""Which contacts touch the ground."""
IN_THE_AIR = "none"
"""Name of the contact state without any."""


def state_name(contacts: Sequence[Contact], state: ContactState) -> str:
    """Frames in contact, joined by "+"."""
    return " + ".join(contact.frame for contact, active in zip(contacts, state, strict=True) if active) or IN_THE_AIR


class RowColumns:
    """Columns of the rows: those of `reduced_layout`, then two friction columns for each of the L - 1 joints.

    `count`: their number, without the right-hand side.
    """

    def __init__(self, tree: KinematicTree) -> None:
        self.tree = tree
        self.layout = reduced_layout(tree)
        self.joint_rows: list[JointRow] = joint_rows(tree, self.layout)
        self.count = self.layout.count + 2 * (tree.n_nodes - 1)

    def friction(self, body: int) -> int:
        """The first of the two friction columns of a body's joint."""
        return self.layout.count + 2 * (body - 1)

    def joints_above(self, body: int) -> list[int]:
        """Independent joints that move a body."""
        path = set(self.tree.path(body))
        return [j for j, row in enumerate(self.joint_rows) if any(moved in path for moved, _ in row.moved)]

    def rows_above(self, body: int) -> list[int]:
        """Rows of the dynamics that a wrench on a body enters: the base's and those of `joints_above`."""
        base = self.tree.base_rows
        return [*range(base), *(base + joint for joint in self.joints_above(body))]

    @cached_property
    def parameter_map(self) -> Array:
        """Matrix M, (count, 12 L), from parameters to these columns: `K = K_columns @ M`."""
        nodes = self.tree.node_of
        matrix = np.zeros((self.count, len(nodes), parameters.PER_BODY))
        inertial = reduction_matrix(self.tree).reshape(self.layout.count, len(nodes), -1)
        matrix[: self.layout.count, :, parameters.INERTIAL] = inertial
        for body, node in list(enumerate(nodes))[1:]:
            matrix[self.friction(node), body, parameters.COULOMB] = 1.0
            matrix[self.friction(node) + 1, body, parameters.VISCOUS] = 1.0
        return matrix.reshape(self.count, -1)


@dataclass(frozen=True)
class ContactBody:
    """A body with active contacts.

    `unmeasured`: rows that span the unmeasured wrench directions, `measured`: one row per measured component.
    `count`: dimension of that span at almost every sample; more rows are reduced to a basis at each. `components`:
    contact and component of each measured row. `joints`: indices, among the coupled joints, of those that move the
    body.
    """

    body: int
    unmeasured: tuple[WrenchRows, ...]
    count: int
    measured: tuple[WrenchRows, ...]
    components: tuple[tuple[int, int], ...]
    joints: tuple[int, ...]

    @property
    def is_held(self) -> bool:
        """Whether all six components of a wrench on it are unmeasured, so that no combination of rows moves it."""
        return [part.rows.shape for part in self.unmeasured] == [(_WRENCH, _WRENCH)]


@dataclass(frozen=True)
class ContactStateLayout:
    """The bodies, joints and columns of a contact state's rows, which are the same for all its samples.

    Measured joints between the base and a contact, or in a closed loop, are coupled: the projection combines their rows
    with those of the base. All others are uncoupled: each is an equation of its own.

    Attributes:
        contact_bodies: bodies in contact.
        loops: what closed loops exert, which is never measured.
        coupled_joints: indices of independent joints.
        uncoupled_joints: indices of independent joints, with the block of each one's row.
        row_std: noise of the base rows and coupled joints [N, N m].
        wrench_std: noise of the measured components, body by body [N, N m].
        blocks: of the coupled rows.
    """

    contact_bodies: tuple[ContactBody, ...]
    loops: tuple[LoopRows, ...]
    coupled_joints: tuple[int, ...]
    uncoupled_joints: Mapping[int, RowBlock]
    row_std: Tensor
    wrench_std: Tensor
    blocks: RowBlocks

    @cached_property
    def has_own_limbs(self) -> bool:
        """Whether every contact of a floating base has as many unmeasured directions as joints that move it alone."""
        joints = [joint for body in self.contact_bodies for joint in body.joints]
        return (
            len(self.row_std) > len(self.coupled_joints) > 0
            and not self.loops
            and sorted(joints) == list(range(len(self.coupled_joints)))
            and all(body.count == len(body.joints) for body in self.contact_bodies)
        )


class ContactStateLayouts:
    """Layouts of a robot's contact states, with its contacts and sensors."""

    def __init__(
        self,
        robot: Robot,
        columns: RowColumns,
        contacts: Sequence[Contact],
        sensors: SensorSet,
        extras: Sequence[Extra] = (),
    ) -> None:
        self.extras = tuple(extras)
        self.columns = columns
        self.contacts = tuple(contacts)
        self.sensors = sensors
        self.frames = [columns.tree.frame(robot, contact.frame, contact.centre) for contact in contacts]
        self._measured = measured_components(self.contacts, sensors)
        self._loops = LoopLayouts(robot)
        self.dof_std = sensors.noise.dof_std(robot.n, robot.n_dofs)
        self.rolling = tuple(index for index, contact in enumerate(contacts) if contact.radius)
        self.along_normal = tuple(index for index, contact in enumerate(contacts) if contact.along_normal)
        self._points: dict[int, Tensor] = {}
        self._cache: dict[tuple[ContactState, bool], ContactStateLayout] = {}
        self._rotations: dict[int, Tensor] = {}
        self._normals: dict[int, Tensor] = {}

    def layout(self, state: ContactState, recorded_normals: bool = False) -> ContactStateLayout:
        """The layout of a contact state, cached.

        `recorded_normals`: whether each rolling contact has normals of its own, so that those of one body differ.
        """
        recorded_normals = recorded_normals and any(state[contact] for contact in self.rolling)
        key = (state, recorded_normals)
        if key in self._cache:
            return self._cache[key]
        touching: dict[int, list[int]] = {}
        for contact, active in enumerate(state):
            if active:
                touching.setdefault(self.frames[contact][0], []).append(contact)
        moving = {joint for body in touching for joint in self.columns.joints_above(body)} | self._loops.dofs
        measured = np.flatnonzero(self.sensors.torque).tolist()
        coupled = tuple(joint for joint in measured if joint in moving)
        bodies = tuple(
            self._contact_body(body, members, coupled, recorded_normals) for body, members in touching.items()
        )
        loops = tuple(self._loops.rows(coupled, self.columns.tree.joint_map))
        moved = sorted(
            (body, index, ratio)
            for index, joint in enumerate(coupled)
            for body, ratio in self.columns.joint_rows[joint].moved
        )
        extras = [
            (self.columns.count + number, extra)
            for number, extra in enumerate(self.extras)
            if not set(extra.dofs).isdisjoint(coupled) or any(state[contact] for contact, _ in extra.contacts)
        ]
        noise, base_rows = self.sensors.noise, self.columns.tree.base_rows
        self._cache[key] = ContactStateLayout(
            bodies,
            loops,
            coupled,
            {joint: self._uncoupled(joint) for joint in measured if joint not in moving},
            self._tensor(np.append(noise.base_std[:base_rows], self.dof_std[list(coupled)])),
            self._tensor(noise.wrench_std[[k for body in bodies for _, k in body.components]]),
            RowBlocks(
                self.columns.tree,
                self.columns.layout,
                moved,
                [(self.columns.friction(body), self.columns.friction(body) + 1) for body, _, _ in moved],
                [body.joints for body in bodies],
                sum(body.count for body in bodies) + sum(len(loop.wrenches) for loop in loops),
                [(column, *self._met(extra, coupled, bodies)) for column, extra in extras],
                [body.body for body in bodies if body.is_held],
            ),
        )
        return self._cache[key]

    def _uncoupled(self, joint: int) -> RowBlock:
        columns, row = self.columns, self.columns.joint_rows[joint]
        moved = [(node, 0, ratio, (columns.friction(node), columns.friction(node) + 1)) for node, ratio in row.moved]
        extras = tuple(columns.count + number for number, extra in enumerate(self.extras) if joint in extra.dofs)
        return row_block(columns.tree, columns.layout, slice(0, 1), moved, extras=extras)

    def _met(
        self, extra: Extra, coupled: tuple[int, ...], bodies: Sequence[ContactBody]
    ) -> tuple[tuple[int, ...], bool]:
        """Coupled joints whose rows an extra parameter is in, and whether it is in those of the base."""
        if extra.dofs:
            return tuple(coupled.index(dof) for dof in extra.dofs if dof in coupled), False
        nodes = {self.frames[contact][0] for contact, _ in extra.contacts}
        joints = {joint for body in bodies if body.body in nodes for joint in body.joints}
        return tuple(sorted(joints)), bool(self.columns.tree.base_rows)

    def frame_rotation(self, contact: int) -> Tensor:
        """Axes of a contact frame in its node's joint frame, (3, 3), cached."""
        if contact not in self._rotations:
            self._rotations[contact] = self._tensor(self.frames[contact][1][:3, :3])
        return self._rotations[contact]

    def frame_origin(self, contact: int) -> Tensor:
        """Origin of a contact frame in its node's joint frame, (3,) [m], cached."""
        if contact not in self._points:
            self._points[contact] = self._tensor(self.frames[contact][1][:3, 3])
        return self._points[contact]

    def ground(
        self, states: BodyStates, normals: Tensor | None, rotation_world_base: Tensor | None
    ) -> tuple[dict[int, Tensor], dict[int, Tensor]]:
        """What depends on the ground's normal, see `rolling_arms` and `ground_axes`.

        Args:
            states: of the joint frames.
            normals: (B, C, 3), in the world; None for those of the contacts.
            rotation_world_base: (B, 3, 3); None where the base's axes are the world's.

        Returns:
            Moments of unit forces of the ground on each rolling contact, (3, 3, B) [m], and the ground's axes in base
            axes, (3, 3, B), of each that is read along its normal.
        """
        arms, along = {}, {}
        for index in dict.fromkeys((*self.rolling, *self.along_normal)):
            contact, body = self.contacts[index], self.frames[index][0]
            if normals is None:
                normal = self._normal(index)[:, None].expand(3, states.position.shape[-1])
            else:
                normal = normals[:, index].T
            if rotation_world_base is not None:
                normal = (normal.T[:, None] @ rotation_world_base)[:, 0].T
            if contact.radius:
                axes, axis = self.frame_rotation(index), contact.rolling_axis
                arms[index] = contact_arms(states, body, axes, contact.radius, normal, axis)
            if contact.along_normal:
                along[index] = ground_axes(normal)
        return arms, along

    def _normal(self, contact: int) -> Tensor:
        """Stated normal of a contact, (3,), cached."""
        if contact not in self._normals:
            self._normals[contact] = self._tensor(np.array(self.contacts[contact].normal))
        return self._normals[contact]

    def clear(self) -> None:
        """Drop all layouts, when the robot's constants move to another device or precision."""
        self._cache.clear()
        self._rotations.clear()
        self._normals.clear()
        self._points.clear()

    def _contact_body(
        self, body: int, contacts: list[int], coupled: tuple[int, ...], recorded_normals: bool
    ) -> ContactBody:
        unmeasured, measured, components = _Grouped(), _Grouped(), []
        for contact in contacts:
            at_body = wrench_transform(self.frames[contact][1]).T
            for k in self.contacts[contact].components:
                line = self._line_of_action(contact, k)
                row = at_body[k] if line.ground is None else np.eye(3)[k]
                if self._measured[contact, k]:
                    measured.setdefault(line, []).append(row)
                    components.append((contact, k))
                else:
                    alike = self._rolling_alike(line, unmeasured, recorded_normals)
                    unmeasured.setdefault(alike, []).append(row)
        components.sort(key=lambda component: list(measured).index(self._line_of_action(*component)))
        spans = {line: _span(np.array(rows)) for line, rows in unmeasured.items()}
        count = sum(map(len, spans.values()))
        if len(spans) > 1 and not any(line.ground is not None for line in spans):
            count = self._generic_rank(spans)
            if count == _WRENCH:
                spans = {LineOfAction(): np.eye(_WRENCH)}
        above = set(self.columns.joints_above(body))
        joints = tuple(index for index, joint in enumerate(coupled) if joint in above)
        rows = [
            tuple(WrenchRows(self._tensor(np.array(x)), line) for line, x in part.items()) for part in (spans, measured)
        ]
        return ContactBody(body, rows[0], count, rows[1], tuple(components), joints)

    def _line_of_action(self, contact: int, k: int) -> LineOfAction:
        """How a component of a contact acts; moments of one that is read along the normal act as they do of others.

        Forces of several such contacts on a body may span less by chance, as those of cells in a flat sole do: their
        rank is that of each sample, by its null space.
        """
        if contact not in self.along_normal:
            return LineOfAction(contact if contact in self.rolling else None)
        return LineOfAction(contact if contact in self.rolling else None, contact) if k < 3 else LineOfAction()

    def _rolling_alike(
        self, line: LineOfAction, others: Iterable[LineOfAction], recorded_normals: bool
    ) -> LineOfAction:
        """The first of other contacts of the body that touches the ground by the same arm from its origin, or itself.

        Forces of contacts with the same arm span a space that is moved as a whole by it.
        """
        rolling = line.rolling
        if rolling is None or line.ground is not None or recorded_normals:
            return line
        own = self.contacts[rolling]
        for other in others:
            if other.rolling is not None and other.ground is None:
                contact = self.contacts[other.rolling]
                alike = (contact.kind, contact.radius, contact.normal) == (own.kind, own.radius, own.normal)
                if alike and (
                    own.kind == "point" or np.allclose(self._axis(other.rolling), self._axis(rolling), atol=1e-12)
                ):
                    return other
        return line

    def _axis(self, contact: int) -> Array:
        """Axis of a cylinder in its node's joint frame, (3,)."""
        return self.frames[contact][1][:3, "xyz".index(self.contacts[contact].line_axis)]

    def _generic_rank(self, spans: Mapping[LineOfAction, Array]) -> int:
        """Dimension of the space that wrenches span with normals in any directions; it is never larger."""
        rng, moved = np.random.default_rng(0), []
        for (rolling, _), rows in spans.items():
            if rolling is not None:
                contact, normal = self.contacts[rolling], torch.from_numpy(_unit(rng.normal(size=3)))[:, None]
                axis = torch.from_numpy(self._axis(rolling).copy())[:, None] if contact.kind == "line" else None
                arms = rolling_arms(contact.radius, normal, axis)[..., 0].numpy()
                rows = np.hstack([rows[:, :3], rows[:, 3:] + rows[:, :3] @ arms.T])
            moved.append(rows)
        return len(_span(np.concatenate(moved)))

    def _tensor(self, values: Array) -> Tensor:
        ancestors = self.columns.tree.ancestors
        return torch.tensor(values, dtype=ancestors.dtype, device=ancestors.device)


_WRENCH = 6
_Grouped = dict[LineOfAction, list[Array]]


def _span(rows: Array) -> Array:
    """Orthonormal rows that span the same wrenches as others, (k, 6)."""
    _, values, Vh = np.linalg.svd(rows, full_matrices=False)
    span: Array = Vh[is_significant(values, KINEMATIC_TOLERANCE)]
    return span


def _unit(x: Array) -> Array:
    unit: Array = x / np.linalg.norm(x)
    return unit
