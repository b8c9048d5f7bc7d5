"""Whitened, projected rows of the linear problem, one contact state at a time.

In a contact state the projection mixes only the base and the joints between the base and a touching body. Every other
measured joint keeps its own row, which is zero outside its subtree. Both kinds go to the factor as blocks with just
the columns they can touch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchid import parameters
from torchid.parameters import Array
from torchid.problem.plan import Columns, Planner, State, StatePlan
from torchid.problem.samples import Samples
from torchid.problem.workspace import Workspace
from torchid.regressor.dynamics import all_wrench_columns, friction_columns, joint_directions, joint_row
from torchid.regressor.jacobian import generalized_forces, wrenches_at_base
from torchid.regressor.kinematics import BodyStates, JointStates, body_states, joint_states
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.nullspace import null_space, whitened_null_space
from torchid.sensing.sensors import SensorSet


@dataclass(frozen=True)
class ChunkTerms:
    """Dynamics of a chunk of samples: everything that rows and predictions are made of."""

    joints: JointStates
    states: BodyStates
    directions: Tensor
    wrenches: Tensor
    rotation_world_base: Tensor | None

    def select(self, index: Tensor | slice) -> ChunkTerms:
        """The terms of some samples."""
        if isinstance(index, slice):  # all of them
            return self

        def pick(x: Tensor) -> Tensor:
            return x[..., index]

        return ChunkTerms(
            JointStates(*map(pick, vars(self.joints).values())),
            BodyStates(*map(pick, vars(self.states).values())),
            pick(self.directions),
            pick(self.wrenches),
            None if self.rotation_world_base is None else self.rotation_world_base[index],
        )


class RowBuilder(nn.Module):
    """Rows of `W^T [K_columns | f]`: W a basis of V_x's span under which the projected sensor noise is white."""

    def __init__(self, robot: Robot, contacts: Sequence[Contact], sensors: SensorSet) -> None:
        """Fix robot, contacts and sensors."""
        super().__init__()
        self.tree = KinematicTree(robot)
        self.columns = Columns(self.tree)
        self.contacts = tuple(contacts)
        self.sensors = sensors
        self._planner = Planner(robot, self.columns, contacts, sensors)
        self._plans: dict[State, StatePlan] = {}

    @property
    def frames(self) -> list[tuple[int, Array]]:
        """Body of each contact, and the pose (4, 4) of the contact frame in the body's joint frame."""
        return self._planner.frames

    @property
    def device(self) -> torch.device:
        """Where the rows are computed."""
        return self.tree.ancestors.device

    def plan(self, state: State) -> StatePlan:
        """The plan of a contact state, made once."""
        if state not in self._plans:
            self._plans[state] = self._planner.plan(state)
        return self._plans[state]

    def terms(self, samples: Samples, workspace: Workspace | None = None) -> ChunkTerms:
        """Dynamics of some samples; with a workspace, valid until the next call with the same."""
        motion = samples.motion()
        joints = joint_states(self.tree, motion)
        states = body_states(self.tree, motion, joints)
        directions = joint_directions(self.tree, states)
        layout, out = self.columns.layout, None
        if workspace is not None:
            out = workspace.zeros("wrenches", None, states.position, 6, layout.count, len(samples))
        wrenches = all_wrench_columns(states, layout, out)
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
            for rows in self._mixed_rows(samples, plan, terms, workspace):
                yield plan.support, rows
        for joint in plan.lone_joints:
            yield self._lone_row(joint, samples, terms)

    def bases(self, samples: Samples, state: State) -> Iterator[tuple[Tensor | slice, Tensor]]:
        """Orthonormal V_x, (B', base rows + mixed joints, r), with the samples it belongs to, grouped by rank."""
        plan, terms = self.plan(state), self.terms(samples)
        yield from null_space(self._contact_rows(plan, terms)[0])

    def local_wrench(self, samples: Samples, contact: int, terms: ChunkTerms) -> Tensor:
        """Recorded wrench of a contact along its frame's axes, (B, 6)."""
        if samples.wrench is None:
            return samples.time.new_full((len(samples), 6), torch.nan)
        wrench = samples.wrench[:, contact]
        if not samples.wrench_in_world:
            return wrench
        body, T_joint_frame = self.frames[contact]
        rotation = terms.states.rotation[:, :, body].permute(2, 0, 1) @ wrench.new_tensor(T_joint_frame[:3, :3])
        if terms.rotation_world_base is not None:
            rotation = terms.rotation_world_base @ rotation
        return (rotation.mT @ wrench.unflatten(1, (2, 3)).mT).mT.flatten(1)

    def torque(self, samples: Samples) -> Tensor:
        """Recorded joint torques, (B, n), NaN where there are none."""
        return torch.full_like(samples.joint_position, torch.nan) if samples.torque is None else samples.torque

    def _lone_row(self, joint: int, samples: Samples, terms: ChunkTerms) -> tuple[tuple[int, ...], Tensor]:
        row = self.columns.joint_rows[joint]
        inertial = joint_row(row, self.tree, self.columns.layout, terms.directions, terms.wrenches)
        friction = [x for _, *pair in friction_columns(row, terms.joints) for x in pair]
        block = torch.cat([inertial, torch.stack([*friction, self.torque(samples)[:, joint]])])
        columns = (*range(row.start, row.end), *self.columns.friction_of(joint))
        return columns, (block / self.sensors.noise.joint_torque).T

    def _mixed_rows(
        self, samples: Samples, plan: StatePlan, terms: ChunkTerms, workspace: Workspace
    ) -> Iterator[Tensor]:
        unmeasured, measured = self._contact_rows(plan, terms)
        torque = self.torque(samples)[:, list(plan.mixed_joints)]
        f = nn.functional.pad(torque, (self.tree.base_rows, 0))
        if len(plan.wrench_std):
            f = f + (measured.mT @ self._measured_wrench(samples, plan, terms)[..., None])[..., 0]
        for index, W in whitened_null_space(unmeasured, plan.row_std, measured, plan.wrench_std):
            yield self._projected(W.permute(1, 2, 0).contiguous(), f[index].T, plan, terms.select(index), workspace)

    def _projected(self, W: Tensor, f: Tensor, plan: StatePlan, terms: ChunkTerms, workspace: Workspace) -> Tensor:
        """Rows W^T [K | f], (r B, columns + 1), for a basis W, (base rows + mixed joints, r, B), and f, (..., B).

        A wrench on body i does work on the base and on the joints above it only, so that body i's columns of W^T K are
        A_i^T times its wrench columns, with A_i the sum of W's rows along i's path, each carried by its screw axis. No
        joint row is ever formed. Columns are contiguous, as the factorization wants them.
        """
        columns, layout, base_rows = self.columns, self.columns.layout, self.tree.base_rows
        X = workspace.zeros("projected", None, W, len(plan.support) + 1, *W.shape[1:])
        by_body: dict[int, Tensor] = {0: W[:6] if base_rows else W.new_zeros(6, *W.shape[1:])}
        mixed = {
            moved: (place, ratio)
            for place, joint in enumerate(plan.mixed_joints)
            for moved, ratio in columns.joint_rows[joint].moved
        }
        first = plan.support[0] if plan.support else 0
        friction = {column: place for place, column in enumerate(plan.support)}
        for body in range(self.tree.bodies):
            if body:
                by_body[body] = by_body[self.tree.parents[body]]
            if body in mixed:
                place, ratio = mixed[body]
                own = W[base_rows + place] * ratio
                by_body[body] = torch.addcmul(by_body[body], terms.directions[:, body, None], own)
                velocity, start = terms.joints.velocity[body], friction[columns.friction(body)]
                torch.mul(own, torch.sign(velocity), out=X[start])
                torch.mul(own, velocity, out=X[start + 1])
            start, end = layout.starts[body] - first, layout.starts[body + 1] - first
            if start >= 0 and end <= len(plan.support):
                pulling = sum(column < parameters.INERTIA.start for column in layout.kept[body])
                self._carry(terms.wrenches[:, start + first : end + first], by_body[body], pulling, X[start:end])
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

    def _contact_rows(self, plan: StatePlan, terms: ChunkTerms) -> tuple[Tensor, Tensor]:
        """Unmeasured and measured contact rows on the base and the mixed joints, (B, k, base rows + mixed joints)."""
        samples, base_rows = terms.wrenches.shape[-1], self.tree.base_rows
        sizes = [sum(len(getattr(body, kind)) for body in plan.contact_bodies) for kind in ("unmeasured", "measured")]
        both = terms.wrenches.new_zeros(sum(sizes), len(plan.row_std), samples)
        starts = [0, sizes[0]]
        for contact in plan.contact_bodies:
            joints = [plan.mixed_joints[place] for place in contact.joints]
            columns = [*range(base_rows), *(base_rows + place for place in contact.joints)]
            for kind, wrenches in enumerate((contact.unmeasured, contact.measured)):
                if len(wrenches):
                    at_base = wrenches_at_base(terms.states, contact.body, wrenches)
                    rows = generalized_forces(self.tree, terms.directions, contact.body, at_base, joints)
                    target = both[starts[kind] : starts[kind] + len(wrenches)]
                    target.index_copy_(1, torch.tensor(columns, device=rows.device), rows)
                    starts[kind] += len(wrenches)
        return tuple(both.permute(2, 0, 1).split(sizes, dim=1))

    def _measured_wrench(self, samples: Samples, plan: StatePlan, terms: ChunkTerms) -> Tensor:
        """Measured wrench components along the frames' axes, (B, k_m)."""
        places = [place for body in plan.contact_bodies for place in body.components]
        local = {contact: self.local_wrench(samples, contact, terms) for contact in {contact for contact, _ in places}}
        return torch.stack([local[contact][:, k] for contact, k in places], dim=1)
