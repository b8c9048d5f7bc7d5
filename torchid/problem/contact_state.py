"""Columns of the rows and, for each contact state, their layout: coupled joints, wrenches of contacts, blocks of rows.

Rows `W^T [K | f]` pose the same problem if W is multiplied by any orthogonal matrix from the right. This freedom is
used to create zeros, because the time of a factorization grows with the square of the columns. At most three rows
combine the moment on the base. The next three combine its force but not its moment, so inertias of bodies that no
coupled joint moves are not in them. All other rows combine joints only.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.extras import Extra
from torchid.regressor.columns import ColumnLayout, reduced_layout, reduction_matrix
from torchid.regressor.kinematics import BodyStates
from torchid.regressor.loops import LoopClosures, LoopGeometry
from torchid.regressor.regressor import JointRow, joint_rows, rolling_arms, wrench_transform, wrenches_at_base
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.rounding import KINEMATIC_TOLERANCE, is_significant
from torchid.sensing import Contact, SensorSet
from torchid.sensing.sensors import measured_components

ContactState = tuple[bool, ...]
"""Which contacts touch the ground."""
IN_THE_AIR = "none"
"""Name of the contact state without any."""
_WRENCH = 6


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
class LoopRows:
    """Forces of a closed loop.

    `wrenches`, (k, 6): on its first body, at the node's joint frame, without directions that never do work. `joints`:
    measured joints on which they do work, by index among the coupled joints; `dofs`: by degree of freedom.
    """

    geometry: LoopGeometry
    wrenches: Tensor
    joints: tuple[int, ...]
    dofs: tuple[int, ...]

    def forces(self, tree: KinematicTree, states: BodyStates, screw_axes: Tensor) -> Tensor:
        """Torques of a unit of each on its joints, (k, joints, B)."""
        at_base = wrenches_at_base(states, self.geometry.nodes[0], self.wrenches)
        return self.geometry.forces(tree, screw_axes, at_base, self.dofs)


_DETERMINED = 1e-6  # largest relative residual of a Jacobian column that a motor determines


@dataclass(frozen=True)
class _LoopGroup:
    """Loops that share joints, with their degrees of freedom: those of passive joints, and others."""

    loops: tuple[LoopGeometry, ...]
    passive: tuple[int, ...]
    driven: tuple[int, ...]


class MotorForces:
    """Generalized forces as the motors of closed loops feel them.

    With the loops' Jacobian J = [J_a, J_p] for motors and passive joints, a motor moves the passive joints by G =
    -J_p^+ J_a. In f_a + G^T f_p the loop forces cancel (principle of virtual work). `none`: the robot has no loops, and
    rows do not change.
    """

    def __init__(self, robot: Robot) -> None:
        self.none = not robot.loops
        self._base = robot.base_rows
        self._groups = list[_LoopGroup]()
        if self.none:
            return
        closures = LoopClosures(robot)
        dofs = [set(loop.dofs(closures.tree)) for loop in closures.geometries]
        linked = np.array([[bool(dofs_of_loop & other) for other in dofs] for dofs_of_loop in dofs])
        _, label = connected_components(linked, directed=False)
        for group in range(label.max() + 1):
            members = np.flatnonzero(label == group).tolist()
            members_dofs = sorted(set[int]().union(*(dofs[k] for k in members)))
            passive = tuple(dof for dof in members_dofs if robot.is_passive[dof])
            driven = tuple(dof for dof in members_dofs if not robot.is_passive[dof])
            self._groups.append(_LoopGroup(tuple(closures.geometries[k] for k in members), passive, driven))

    @property
    def passive(self) -> tuple[int, ...]:
        """Joints without a motor in loops."""
        return tuple(dof for group in self._groups for dof in group.passive)

    def above(self, dofs: Iterable[int]) -> set[int]:
        """Degrees of freedom, extended by those of all loops they are in, without passive joints of these loops."""
        given = set(dofs)
        out = set(dofs)
        for group in self._groups:
            if given & {*group.passive, *group.driven}:
                out = (out | set(group.driven)) - set(group.passive)
        return out

    def of(self, tree: KinematicTree, states: BodyStates, forces: Tensor) -> Tensor:
        """Generalized forces (..., B, n_rows) with those of motors in loops; NaN at passive joints in loops.

        Also NaN where motors do not determine the motion of the passive joints.

        Args:
            tree: the robot's constants.
            states: of the joint frames.
            forces: rows as in K.
        """
        if self.none:
            return forces
        out = forces.clone()
        for group in self._groups:
            motion, determined = _passive_motion(tree, states, group)  # (B, p, a), (B, a)
            driven, passive = (tree.index(self._base + k for k in x) for x in (group.driven, group.passive))
            through = (forces[..., passive][..., None, :] @ motion)[..., 0, :]
            out[..., driven] = torch.where(determined, forces[..., driven] + through, torch.nan)
            out[..., passive] = torch.nan
        return out


def _passive_motion(tree: KinematicTree, states: BodyStates, group: _LoopGroup) -> tuple[Tensor, Tensor]:
    """Motion of passive joints by that of motors, (B, p, a), and which motors (B, a) determine it."""
    J_p, J_a = (
        torch.cat([loop.jacobian(tree, states, dofs) for loop in group.loops]).permute(2, 0, 1)
        for dofs in (group.passive, group.driven)
    )
    values = torch.linalg.svdvals(J_p)
    p = len(group.passive)
    size = torch.linalg.matrix_norm(torch.cat([J_p, J_a], dim=2))[:, None]
    motion = -torch.linalg.pinv(J_p, rtol=_DETERMINED) @ J_a
    undetermined = torch.linalg.vector_norm(J_a + J_p @ motion, dim=1)
    determined = undetermined <= _DETERMINED * size
    if values.shape[1] < p:  # more passive joints than constraints
        return motion, torch.zeros_like(determined)
    return motion, determined & (values[:, p - 1 : p] > _DETERMINED * size if p else determined)


@dataclass(frozen=True)
class Nodes:
    """Consecutive nodes whose wrench columns meet the rows of a block in one product.

    Attributes:
        nodes: numbers of them.
        kept: the inertial parameters of each that matter: the first of those that its columns are of.
        all_kept: those that its columns are of.
        columns: the columns, among those of all nodes.
        sources: numbers of the path sums, one for each node, or one for all.
    """

    nodes: range
    kept: tuple[int, ...]
    all_kept: tuple[int, ...]
    columns: range
    sources: range

    @property
    def n_with_force(self) -> int:
        """Number of the parameters that demand a force; inertias demand moments only."""
        return sum(column < parameters.INERTIA.start for column in self.kept)


@dataclass(frozen=True)
class RowBlock:
    """Rows that combine the same degrees of freedom.

    Attributes:
        rows: which of a sample's.
        base: base rows that they combine: "all", "force" or "none".
        moved: nodes that the joints move whose rows they combine, parents first: node, number of the joint, ratio of
            its motion, and the number of the path sum that the node's adds to, None if it starts from nothing.
        nodes: on whose inertial parameters they depend.
        inertial: the columns of these.
        friction: columns of the joints' friction.
        extras: columns of extra parameters.
    """

    rows: slice
    base: str
    moved: tuple[tuple[int, int, float, int | None], ...]
    nodes: tuple[Nodes, ...]
    inertial: tuple[int, ...]
    friction: tuple[int, ...]
    extras: tuple[int, ...]

    @property
    def support(self) -> tuple[int, ...]:
        """Columns in which the rows can differ from zero."""
        return (*self.inertial, *self.friction, *self.extras)


class RowBlocks:
    """Blocks of a contact state's coupled rows.

    `order`: of the degrees of freedom (base rows, then coupled joints) for a triangular W: joints from the leaves to
    the base, then the base's force, then its moment. `has_triangular_base`: whether another W is made triangular in the
    base rows (see `torchid.problem.null_bases.triangularize_base_rows`).
    """

    def __init__(
        self,
        columns: RowColumns,
        coupled: Sequence[int],
        bodies: Sequence[ContactBody],
        loop_forces: int,
        extras: Sequence[tuple[int, Sequence[int], bool]],
    ) -> None:
        """Find out which degrees of freedom the rows combine.

        Args:
            columns: of the rows.
            coupled: numbers of the coupled joints.
            bodies: in contact.
            loop_forces: number of forces of closed loops.
            extras: extra parameters: column, coupled joints it depends on, whether it depends on the base.
        """
        self._columns = columns
        self._extras = extras
        self._held = [body.body for body in bodies if body.is_held]
        self._unmeasured = sum(body.count for body in bodies) + loop_forces
        self._moved = sorted(
            (node, index, ratio)
            for index, joint in enumerate(coupled)
            for node, ratio in columns.joint_rows[joint].moved
        )
        self._joints = tuple(range(len(coupled)))
        self._base_rows = columns.tree.base_rows
        last_node = {joint: node for node, joint, _ in self._moved}
        leaves_first = sorted(self._joints, key=lambda joint: -last_node[joint])
        self.order = (*(self._base_rows + joint for joint in leaves_first), *range(self._base_rows))
        self._triangular = tuple(self._triangular_blocks(leaves_first, [body.joints for body in bodies]))
        self._by_rank: dict[int, tuple[RowBlock, ...]] = {}
        self.has_triangular_base = bool(self._base_rows and self._unmeasured)

    def of_rank(self, rank: int) -> tuple[RowBlock, ...]:
        """The blocks of samples that have so many coupled rows."""
        if not self._unmeasured:
            return self._triangular
        if rank not in self._by_rank:
            moment = min(3, rank) if self._base_rows else 0
            force = min(3, rank - moment) if self._base_rows else 0
            joints = rank - moment - force
            ends = {"none": joints, "force": joints + force, "all": rank}
            starts = [0, joints, joints + force]
            self._by_rank[rank] = tuple(
                self._block(slice(start, end), self._joints, base)
                for start, (base, end) in zip(starts, ends.items(), strict=True)
                if start < end
            )
        return self._by_rank[rank]

    def _triangular_blocks(self, leaves_first: Sequence[int], contacts: Sequence[Sequence[int]]) -> Iterator[RowBlock]:
        """Blocks of limbs that share no joint, and of the base; W combines a joint with those before it in its limb."""
        linked = np.eye(len(self._joints), dtype=bool)
        for joints in contacts:
            linked[np.ix_(joints, joints)] = True
        limb = connected_components(linked, directed=False)[1]
        start = 0
        for number, run in groupby(leaves_first, key=lambda joint: int(limb[joint])):
            end = start + len(list(run))
            members = tuple(sorted(joint for joint in leaves_first[:end] if limb[joint] == number))
            yield self._block(slice(start, end), members, "none")
            start = end
        if self._base_rows:
            yield self._block(slice(start, start + 3), self._joints, "force")
            yield self._block(slice(start + 3, start + 6), self._joints, "all")

    def _block(self, rows: slice, joints: tuple[int, ...], base: str) -> RowBlock:
        extras = tuple(
            column
            for column, extra_joints, enters_base in self._extras
            if (enters_base and base != "none") or not set(joints).isdisjoint(extra_joints)
        )
        moved = [entry for entry in self._moved if entry[1] in joints]
        return row_block(self._columns, rows, moved, base, extras, self._held)


def row_block(
    columns: RowColumns,
    rows: slice,
    moved: Sequence[tuple[int, int, float]],
    base: str = "none",
    extras: tuple[int, ...] = (),
    held: Sequence[int] = (),
) -> RowBlock:
    """Make a block of rows.

    The combinations in W do not move a node that the ground holds (`A_x W = 0`). The path sums of such nodes are zero,
    and so are the columns of all nodes that move with one.

    Args:
        columns: of all rows.
        rows: which of a sample's.
        moved: nodes that the joints move, ascending: node, joint, ratio of its motion.
        base: base rows that are combined: "all", "force" or "none".
        extras: columns of extra parameters.
        held: nodes that the ground holds, by six unmeasured wrench components.
    """
    tree = columns.tree
    layout = columns.layout
    numbers = {node: number for number, (node, *_) in enumerate(moved, start=base != "none")}
    sources: list[int | None] = [None if base == "none" else 0]
    for node in range(1, tree.n_nodes):
        sources.append(numbers.get(node, sources[tree.parents[node]]))
    zero = {None, *(sources[node] for node in held)}
    kept: list[tuple[int, ...]] = []
    for all_kept, source in zip(layout.kept, sources, strict=True):
        demands_no_moment = base == "force" and source == 0
        of_node = [k for k in all_kept if not demands_no_moment or k < parameters.INERTIA.start]
        kept.append(() if source in zero else tuple(of_node))
    nodes = tuple(_runs(layout, kept, sources))
    inertial = (
        run.columns.start + len(run.all_kept) * number + k
        for run in nodes
        for number in range(len(run.nodes))
        for k in range(len(run.kept))
    )
    return RowBlock(
        rows=rows,
        base=base,
        moved=tuple((node, joint, ratio, sources[tree.parents[node]]) for node, joint, ratio in moved),
        nodes=nodes,
        inertial=tuple(inertial),
        friction=tuple(columns.friction(node) + k for node, *_ in moved for k in range(2)),
        extras=extras,
    )


def _runs(layout: ColumnLayout, kept: Sequence[tuple[int, ...]], sources: Sequence[int | None]) -> Iterator[Nodes]:
    """Runs of consecutive nodes that keep the same parameters and have one path sum in common, or successive ones."""
    start = 0
    while start < len(sources):
        end = start + 1
        if kept[start]:  # which no node without a path sum has
            steps: list[int] = []
            while (
                end < len(sources)
                and (layout.kept[end], kept[end]) == (layout.kept[start], kept[start])
                and (step := (sources[end] or 0) - (sources[end - 1] or 0)) in (0, 1)
                and step == (steps or [step])[0]
            ):
                steps.append(step)
                end += 1
            yield Nodes(
                nodes=range(start, end),
                kept=kept[start],
                all_kept=layout.kept[start],
                columns=range(layout.starts[start], layout.starts[end]),
                sources=range(sources[start] or 0, (sources[end - 1] or 0) + 1),
            )
        start = end


@dataclass(frozen=True)
class ContactBody:
    """A body with active contacts.

    Attributes:
        body: its node.
        unmeasured: contacts with unmeasured components, and these components.
        span: (k, 6), wrenches at the node's joint frame that span the unmeasured ones of every sample; None if they
            change with the ground's normal.
        count: dimension of their space at almost every sample; more wrenches are reduced to a basis for each sample.
        measured: contact and component of each measured row.
        joints: indices, among the coupled joints, of those that move the body.
    """

    body: int
    unmeasured: tuple[tuple[int, tuple[int, ...]], ...]
    span: Tensor | None
    count: int
    measured: tuple[tuple[int, int], ...]
    joints: tuple[int, ...]

    @property
    def is_held(self) -> bool:
        """Whether all six wrench components are unmeasured, so that no combination of rows moves the body."""
        return self.span is not None and len(self.span) == _WRENCH


@dataclass(frozen=True)
class ContactStateLayout:
    """Bodies, joints and columns of a contact state's rows; they are the same for all its samples.

    Measured joints between the base and a contact, or in a closed loop, are coupled: the projection combines their rows
    with those of the base. All others are uncoupled: each is an equation of its own.

    Attributes:
        contact_bodies: bodies in contact.
        loops: forces of closed loops, which are never measured.
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

    @property
    def measured(self) -> list[tuple[int, int]]:
        """Contact and component of each measured row, body by body."""
        return [component for body in self.contact_bodies for component in body.measured]

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
    """Layouts of a robot's contact states, with its contacts and sensors.

    `frames`: node of each contact, and the pose of its frame in the node's joint frame, (4, 4) [m]. `dof_std`: noise of
    the degrees of freedom.
    """

    def __init__(
        self,
        robot: Robot,
        columns: RowColumns,
        contacts: Sequence[Contact],
        sensors: SensorSet,
        extras: Sequence[Extra] = (),
    ) -> None:
        self.columns = columns
        self.contacts = tuple(contacts)
        self.sensors = sensors
        self.extras = tuple(extras)
        self.frames = [columns.tree.frame(robot, contact.frame, contact.centre) for contact in contacts]
        self.dof_std = sensors.noise.dof_std(robot.n, robot.n_dofs)
        self._measured = measured_components(self.contacts, sensors)
        self._loops = LoopClosures(robot) if robot.loops else None
        self._cache: dict[tuple[ContactState, bool], ContactStateLayout] = {}

    def clear(self) -> None:
        """Drop all layouts, when the robot's constants move to another device or precision."""
        self._cache.clear()

    def layout(self, state: ContactState, recorded_normals: bool = False) -> ContactStateLayout:
        """The layout of a contact state, cached.

        `recorded_normals`: whether each rolling contact has normals of its own, so that those of one body differ.
        """
        rolls = any(active and contact.radius for active, contact in zip(state, self.contacts, strict=True))
        key = state, recorded_normals and rolls
        if key not in self._cache:
            self._cache[key] = self._layout(*key)
        return self._cache[key]

    def _layout(self, state: ContactState, recorded_normals: bool) -> ContactStateLayout:
        columns = self.columns
        noise = self.sensors.noise
        base_rows = self.columns.tree.base_rows
        touching: dict[int, list[int]] = {}
        for contact in np.flatnonzero(state).tolist():
            touching.setdefault(self.frames[contact][0], []).append(contact)
        moving = set() if self._loops is None else set(self._loops.dofs)
        moving.update(joint for body in touching for joint in columns.joints_above(body))
        measured = np.flatnonzero(self.sensors.torque).tolist()
        coupled = tuple(joint for joint in measured if joint in moving)
        bodies = tuple(self._contact_body(*body, coupled, recorded_normals) for body in touching.items())
        loops = tuple(self._loop_rows(coupled))
        extras = [
            (columns.count + number, *self._reach(extra, coupled, bodies))
            for number, extra in enumerate(self.extras)
            if not set(extra.dofs).isdisjoint(coupled) or any(state[contact] for contact, _ in extra.contacts)
        ]
        return ContactStateLayout(
            contact_bodies=bodies,
            loops=loops,
            coupled_joints=coupled,
            uncoupled_joints={joint: self._uncoupled(joint) for joint in measured if joint not in moving},
            row_std=self._tensor(np.append(noise.base_std[:base_rows], self.dof_std[list(coupled)])),
            wrench_std=self._tensor(noise.wrench_std[[k for body in bodies for _, k in body.measured]]),
            blocks=RowBlocks(columns, coupled, bodies, sum(len(loop.wrenches) for loop in loops), extras),
        )

    def _uncoupled(self, joint: int) -> RowBlock:
        moved = [(node, 0, ratio) for node, ratio in self.columns.joint_rows[joint].moved]
        extras = tuple(self.columns.count + number for number, extra in enumerate(self.extras) if joint in extra.dofs)
        return row_block(self.columns, slice(0, 1), moved, extras=extras)

    def _reach(
        self, extra: Extra, coupled: tuple[int, ...], bodies: Sequence[ContactBody]
    ) -> tuple[tuple[int, ...], bool]:
        """Coupled joints whose rows an extra parameter is in, and whether it is in those of the base."""
        if extra.dofs:
            return tuple(coupled.index(dof) for dof in extra.dofs if dof in coupled), False
        nodes = {self.frames[contact][0] for contact, _ in extra.contacts}
        joints = {joint for body in bodies if body.body in nodes for joint in body.joints}
        return tuple(sorted(joints)), bool(self.columns.tree.base_rows)

    def _loop_rows(self, coupled: Sequence[int]) -> Iterator[LoopRows]:
        """Rows of each loop that does work on a coupled joint."""
        if self._loops is None:
            return
        for number, loop in enumerate(self._loops.geometries):
            loop_dofs = set(loop.dofs(self.columns.tree))
            joints = tuple(index for index, joint in enumerate(coupled) if joint in loop_dofs)
            dofs = tuple(coupled[index] for index in joints)
            wrenches = self._loops.effective_wrenches(number, dofs)
            if len(wrenches):
                yield LoopRows(loop, self._tensor(wrenches), joints, dofs)

    def _contact_body(
        self, body: int, contacts: list[int], coupled: tuple[int, ...], recorded_normals: bool
    ) -> ContactBody:
        components = {contact: self.contacts[contact].components for contact in contacts}
        measured = [(contact, k) for contact in contacts for k in components[contact] if self._measured[contact, k]]
        unmeasured = {
            contact: tuple(k for k in components[contact] if not self._measured[contact, k]) for contact in contacts
        }
        unmeasured = {contact: chosen for contact, chosen in unmeasured.items() if chosen}
        count, span = self._span(unmeasured, recorded_normals)
        above = set(self.columns.joints_above(body))
        joints = tuple(index for index, joint in enumerate(coupled) if joint in above)
        return ContactBody(body, tuple(unmeasured.items()), span, count, tuple(measured), joints)

    def _span(self, unmeasured: Mapping[int, tuple[int, ...]], recorded_normals: bool) -> tuple[int, Tensor | None]:
        """Dimension and, where it is the same at all samples, basis of a body's unmeasured wrenches, (k, 6).

        The dimension is that with normals in any directions; it is never larger. Forces of several contacts that are
        read along the normal may span less by chance, as those of cells in a flat sole do: their rank is that of each
        sample, by its null space.
        """
        if any(self.contacts[contact].along_normal for contact in unmeasured):
            return sum(map(len, unmeasured.values())), None
        rng = np.random.default_rng(0)
        normals = dict[object, Array]()
        rows = [np.zeros((0, _WRENCH))]
        for number, components in unmeasured.items():
            contact = self.contacts[number]
            pose = self.frames[number][1]
            wrenches = wrench_transform(pose).T[list(components)]
            if contact.radius:
                key = number if recorded_normals else contact.normal
                normal = normals.setdefault(key, _unit(rng.normal(size=3)))
                axis = pose[:3, "xyz".index(contact.line_axis)].copy() if contact.kind == "line" else None
                arms = _arms(contact.radius, normal, axis)
                wrenches = np.hstack([wrenches[:, :3], wrenches[:, 3:] + wrenches[:, :3] @ arms.T])
            rows.append(wrenches)
        _, values, Vh = np.linalg.svd(np.concatenate(rows), full_matrices=False)
        span = Vh[is_significant(values, KINEMATIC_TOLERANCE)]
        if len(span) == _WRENCH:
            return _WRENCH, self._tensor(np.eye(_WRENCH))
        return len(span), None if normals else self._tensor(span)

    def _tensor(self, values: Array) -> Tensor:
        ancestors = self.columns.tree.ancestors
        return torch.tensor(values, dtype=ancestors.dtype, device=ancestors.device)


def _unit(x: Array) -> Array:
    unit: Array = x / np.linalg.norm(x)
    return unit


def _arms(radius: float, normal: Array, axis: Array | None) -> Array:
    """`rolling_arms` of one sample, (3, 3)."""
    along = None if axis is None else torch.from_numpy(axis)[:, None]
    return np.asarray(rolling_arms(radius, torch.from_numpy(normal)[:, None], along)[..., 0])
