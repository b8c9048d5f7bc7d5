"""Whitened, projected rows of the linear problem, one contact state at a time.

In a contact state the projection mixes only the base and the joints between the base and a touching body. Every other
measured joint keeps its own row, which is zero outside its subtree. Both kinds go to the factor as blocks with just
the columns they can touch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.samples import Samples, measured_components
from torchid.problem.workspace import Workspace
from torchid.regressor.dynamics import all_wrench_columns, friction_columns, joint_directions, joint_row, joint_rows
from torchid.regressor.jacobian import body_jacobian, wrench_map
from torchid.regressor.kinematics import BodyStates, JointStates, body_states, joint_states
from torchid.regressor.reduction import reduced_layout, reduction_matrix
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.nullspace import null_space
from torchid.sensing.projection import whitened
from torchid.sensing.sensors import SensorSet

State = tuple[bool, ...]


@dataclass(frozen=True)
class ContactBody:
    """A body with active contacts.

    `unmeasured`, (k_x, 6): orthonormal rows that span the unmeasured wrench directions, `measured`, (k_m, 6): one row
    per measured component, both as wrenches at the body's joint frame, in its axes.
    `components`: contact and component of each measured row; `std`: (k_m,) their noise.
    """

    body: int
    unmeasured: Tensor
    measured: Tensor
    components: tuple[tuple[int, int], ...]
    std: Tensor


@dataclass(frozen=True)
class StatePlan:
    """What is constant in a contact state: bodies in contact; joints mixed by the projection; joints left alone."""

    contact_bodies: tuple[ContactBody, ...]
    mixed_joints: tuple[int, ...]
    lone_joints: tuple[int, ...]
    support: tuple[int, ...]


@dataclass(frozen=True)
class ChunkTerms:
    """Dynamics of a chunk of samples: everything that rows and predictions are made of."""

    joints: JointStates
    states: BodyStates
    directions: Tensor
    wrenches: Tensor
    rotation_world_base: Tensor | None

    def select(self, index: Tensor) -> ChunkTerms:
        """The terms of some samples."""

        def pick(x: Tensor) -> Tensor:
            return x.index_select(-1, index)

        return ChunkTerms(
            JointStates(*map(pick, vars(self.joints).values())),
            BodyStates(*map(pick, vars(self.states).values())),
            pick(self.directions),
            pick(self.wrenches),
            None if self.rotation_world_base is None else self.rotation_world_base[index],
        )


class RowBuilder(nn.Module):
    """Rows of `L^-1 V_x^T [K_reduced | f]`, where L L^T is the covariance of the projected sensor noise.

    Columns: those of `reduced_layout`, then two friction columns for each of the L - 1 joints.
    """

    def __init__(self, robot: Robot, contacts: Sequence[Contact], sensors: SensorSet) -> None:
        """Fix robot, contacts and sensors."""
        super().__init__()
        self.tree = KinematicTree(robot)
        self.contacts = tuple(contacts)
        self.sensors = sensors
        self.layout = reduced_layout(self.tree)
        self.joint_rows = joint_rows(self.tree, self.layout)
        self._measured = measured_components(self.contacts, sensors)
        self.frames = [self._frame(robot, contact) for contact in self.contacts]
        self._plans: dict[State, StatePlan] = {}

    def _frame(self, robot: Robot, contact: Contact) -> tuple[int, Array]:
        body, T_link_frame = robot.link(contact.frame)
        return body, self.tree.T_joint_link[body] @ T_link_frame

    @property
    def device(self) -> torch.device:
        """Where the rows are computed."""
        return self.tree.ancestors.device

    @property
    def columns(self) -> int:
        """Number of columns, without the right-hand side."""
        return self.layout.count + 2 * (self.tree.bodies - 1)

    def column_map(self) -> Array:
        """`(columns, 12 L)`: the rows' columns from all parameters, `K = K_columns @ column_map()`."""
        matrix = np.zeros((self.columns, self.tree.bodies, parameters.PER_BODY))
        inertial = reduction_matrix(self.tree).reshape(self.layout.count, self.tree.bodies, -1)
        matrix[: self.layout.count, :, parameters.INERTIAL] = inertial
        for body in range(1, self.tree.bodies):
            matrix[self._friction_column(body), body, parameters.COULOMB] = 1.0
            matrix[self._friction_column(body) + 1, body, parameters.VISCOUS] = 1.0
        return matrix.reshape(self.columns, -1)

    def plan(self, state: State) -> StatePlan:
        """The plan of a contact state, made once."""
        if state not in self._plans:
            self._plans[state] = self._make_plan(state)
        return self._plans[state]

    def terms(self, samples: Samples, workspace: Workspace | None = None) -> ChunkTerms:
        """Dynamics of some samples; with a workspace, valid until the next call with the same."""
        motion = samples.motion()
        joints = joint_states(self.tree, motion)
        states = body_states(self.tree, motion, joints)
        directions = joint_directions(self.tree, states)
        out = None
        if workspace is not None:
            out = workspace.zeros("wrenches", None, states.position, 6, self.layout.count, len(samples))
        wrenches = all_wrench_columns(states, self.layout, out)
        return ChunkTerms(joints, states, directions, wrenches, samples.rotation_world_base)

    def rows(
        self, samples: Samples, state: State, workspace: Workspace | None = None
    ) -> Iterator[tuple[tuple[int, ...], Tensor]]:
        """Blocks of rows for samples that share a contact state; no gradient flows through reused buffers.

        Yields:
            (columns, rows): rows are (M, len(columns) + 1), the right-hand side last.
        """
        workspace = workspace or Workspace()
        plan, terms = self.plan(state), self.terms(samples, workspace)
        if self.tree.base_rows or plan.mixed_joints:
            yield plan.support, self._mixed_rows(samples, plan, terms, workspace)
        for joint in plan.lone_joints:
            row = self.joint_rows[joint]
            torque = self._torque(samples)[:, joint]
            friction = friction_columns(row, terms.joints)
            inertial = joint_row(row, self.tree, self.layout, terms.directions, terms.wrenches)
            extra = [x for _, coulomb, viscous in friction for x in (coulomb, viscous)]
            block = torch.cat([inertial, torch.stack([*extra, torque])]) / self.sensors.noise.joint_torque
            yield (*range(row.start, row.end), *self._friction_support(joint)), block.T

    def bases(self, samples: Samples, state: State) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """Orthonormal V_x, (B', base rows + mixed joints, r), with the samples it belongs to, grouped by rank."""
        plan, terms = self.plan(state), self.terms(samples)
        unmeasured, _ = self._contact_jacobians(plan, terms, len(samples))
        yield from null_space(unmeasured)

    def _make_plan(self, state: State) -> StatePlan:
        touching: dict[int, list[int]] = {}
        for contact, active in enumerate(state):
            if active:
                touching.setdefault(self.frames[contact][0], []).append(contact)
        moving = {joint for body in touching for joint in self._joints_above(body)}
        measured = np.flatnonzero(self.sensors.torque).tolist()
        mixed = tuple(joint for joint in measured if joint in moving)
        inertial = range(self.layout.count)
        if not self.tree.base_rows:
            used = [self.joint_rows[joint] for joint in mixed]
            inertial = range(min((r.start for r in used), default=0), max((r.end for r in used), default=0))
        friction = sorted({column for joint in mixed for column in self._friction_support(joint)})
        return StatePlan(
            tuple(self._contact_body(body, members) for body, members in touching.items()),
            mixed,
            tuple(joint for joint in measured if joint not in moving),
            (*inertial, *friction),
        )

    def _contact_body(self, body: int, contacts: list[int]) -> ContactBody:
        unmeasured, measured, components = [np.zeros((0, 6))], [np.zeros((0, 6))], []
        for contact in contacts:
            at_body = wrench_map(self.frames[contact][1]).T
            for k in self.contacts[contact].components:
                if self._measured[contact, k]:
                    measured.append(at_body[k][None])
                    components.append((contact, k))
                else:
                    unmeasured.append(at_body[k][None])
        stacked = np.concatenate(unmeasured)
        _, values, Vh = np.linalg.svd(stacked, full_matrices=False)
        span = Vh[values > 1e-9 * max(values, default=0.0)]
        std = self.sensors.noise.wrench[[k for _, k in components]]
        span_, measured_, std_ = (
            torch.tensor(x, dtype=torch.float64, device=self.device) for x in (span, np.concatenate(measured), std)
        )
        return ContactBody(body, span_, measured_, tuple(components), std_)

    def _mixed_rows(self, samples: Samples, plan: StatePlan, terms: ChunkTerms, workspace: Workspace) -> Tensor:
        unmeasured, measured = self._contact_jacobians(plan, terms, len(samples))
        wrench = self._measured_wrench(samples, plan, terms)
        torque = self._torque(samples)[:, list(plan.mixed_joints)]
        f = torch.nn.functional.pad(torque, (self.tree.base_rows, 0)) + (measured.mT @ wrench[..., None])[..., 0]
        noise = self.sensors.noise
        row_noise = [*noise.base[: self.tree.base_rows], *[noise.joint_torque] * len(plan.mixed_joints)]
        variance = f.new_tensor(row_noise) ** 2
        std = torch.cat([body.std for body in plan.contact_bodies]) if plan.contact_bodies else f.new_zeros(0)
        pieces = []
        for index, V in null_space(unmeasured):
            W = whitened(V, measured[index], variance, std**2)
            part = terms if isinstance(index, slice) else terms.select(index)
            pieces.append(self._projected(W.permute(1, 2, 0).contiguous(), f[index].T, plan, part, workspace))
        return pieces[0] if len(pieces) == 1 else torch.cat(pieces)

    def _projected(self, W: Tensor, f: Tensor, plan: StatePlan, terms: ChunkTerms, workspace: Workspace) -> Tensor:
        """Rows W^T [K | f], (r B, columns + 1), for a basis W, (base rows + mixed joints, r, B), and f, (..., B).

        A wrench on body i does work on the base and on the joints above it only, so that body i's columns of W^T K are
        A_i^T times its wrench columns, with A_i the sum of W's rows along i's path, each carried by its screw axis. No
        joint row is ever formed. Columns are contiguous, as the factorization wants them.
        """
        rows, samples = W.shape[1:]
        X = workspace.zeros("projected", None, W, len(plan.support) + 1, rows, samples)
        carried = W[: self.tree.base_rows] if self.tree.base_rows else W.new_zeros(6, rows, samples)
        by_body: dict[int, Tensor] = {0: carried}
        mixed = {moved: (joint, ratio) for joint in plan.mixed_joints for moved, ratio in self.joint_rows[joint].moved}
        first = plan.support[0] if plan.support else 0
        place = {column: i for i, column in enumerate(plan.support)}
        for body in range(self.tree.bodies):
            if body:
                carried = by_body[self.tree.parents[body]]
                if body in mixed:
                    joint, ratio = mixed[body]
                    own = W[self.tree.base_rows + plan.mixed_joints.index(joint)] * ratio
                    carried = torch.addcmul(carried, terms.directions[:, body, None], own)
                    velocity = terms.joints.velocity[body]
                    start = place[self._friction_column(body)]
                    torch.mul(own, torch.sign(velocity), out=X[start])
                    torch.mul(own, velocity, out=X[start + 1])
                by_body[body] = carried
            start, end = self.layout.starts[body] - first, self.layout.starts[body + 1] - first
            if start >= 0 and end <= len(plan.support):
                pulling = sum(column < parameters.INERTIA.start for column in self.layout.kept[body])
                self._carry(terms.wrenches[:, start + first : end + first], carried, pulling, X[start:end])
        torch.sum(W * f[:, None], dim=0, out=X[-1])
        return X.flatten(1).T

    @staticmethod
    def _carry(wrenches: Tensor, carried: Tensor, pulling: int, out: Tensor) -> None:
        """Write A^T w for wrench columns (6, c, B) into (c, r, B); only the first `pulling` columns have a force."""
        torch.mul(wrenches[3][:, None], carried[3], out=out)
        for k in (4, 5):
            out.addcmul_(wrenches[k][:, None], carried[k])
        for k in (0, 1, 2):
            out[:pulling].addcmul_(wrenches[k, :pulling, None], carried[k])

    def _contact_jacobians(self, plan: StatePlan, terms: ChunkTerms, samples: int) -> tuple[Tensor, Tensor]:
        """Unmeasured and measured contact rows on the base and the mixed joints, (B, k, base rows + mixed joints)."""
        width = self.tree.base_rows + len(plan.mixed_joints)
        sizes = [sum(len(rows) for rows in kind) for kind in zip(*((b.unmeasured, b.measured) for b in plan.contact_bodies), strict=True)]
        unmeasured, measured = (terms.wrenches.new_zeros(k, width, samples) for k in sizes or (0, 0))
        above, below = 0, 0
        for contact in plan.contact_bodies:
            moving = set(self._joints_above(contact.body))
            places = [i for i, joint in enumerate(plan.mixed_joints) if joint in moving]
            joints = [plan.mixed_joints[i] for i in places]
            J = body_jacobian(self.tree, terms.states, terms.directions, contact.body, joints)
            columns = [*range(self.tree.base_rows), *(self.tree.base_rows + i for i in places)]
            for rows, target, start in ((contact.unmeasured, unmeasured, above), (contact.measured, measured, below)):
                if len(rows):
                    target[start : start + len(rows), columns] = torch.tensordot(rows, J, dims=1)
            above, below = above + len(contact.unmeasured), below + len(contact.measured)
        return unmeasured.permute(2, 0, 1), measured.permute(2, 0, 1)

    def _measured_wrench(self, samples: Samples, plan: StatePlan, terms: ChunkTerms) -> Tensor:
        """Measured wrench components along the frames' axes, (B, k_m)."""
        columns = []
        local: dict[int, Tensor] = {}
        for contact_body in plan.contact_bodies:
            for contact, k in contact_body.components:
                if contact not in local:
                    local[contact] = self.local_wrench(samples, contact, terms)
                columns.append(local[contact][:, k])
        return torch.stack(columns, dim=1) if columns else samples.time.new_zeros(len(samples), 0)

    def local_wrench(self, samples: Samples, contact: int, terms: ChunkTerms) -> Tensor:
        """Recorded wrench of a contact along its frame's axes, (B, 6)."""
        if samples.wrench is None:
            return samples.time.new_full((len(samples), 6), torch.nan)
        wrench = samples.wrench[:, contact]
        if not samples.wrench_in_world:
            return wrench
        body, T_joint_frame = self.frames[contact]
        R_joint_frame = wrench.new_tensor(T_joint_frame[:3, :3])
        rotation = terms.states.rotation[:, :, body].permute(2, 0, 1) @ R_joint_frame
        if terms.rotation_world_base is not None:
            rotation = terms.rotation_world_base @ rotation
        return (rotation.mT @ wrench.unflatten(1, (2, 3)).mT).mT.flatten(1)

    def _torque(self, samples: Samples) -> Tensor:
        if samples.torque is None:
            return torch.full_like(samples.joint_position, torch.nan)
        return samples.torque

    def _joints_above(self, body: int) -> list[int]:
        path = set(self.tree.path(body))
        return [j for j, row in enumerate(self.joint_rows) if any(moved in path for moved, _ in row.moved)]

    def _friction_column(self, body: int) -> int:
        return self.layout.count + 2 * (body - 1)

    def _friction_support(self, joint: int) -> list[int]:
        return [self._friction_column(body) + k for body, _ in self.joint_rows[joint].moved for k in (0, 1)]
