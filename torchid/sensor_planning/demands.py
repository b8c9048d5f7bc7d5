"""What contacts demand of the sensors for the base to survive the projection.

In a contact state, let J = [J_b | J_1 ... J_n] be the rows of the contact Jacobian, one per component that an active
contact can exert. V_x spans the generalized velocities that move no unmeasured joint and no unmeasured component, so
`rank(S_b V_x) = 6` (Mistry et al. 2009) says: whatever way the base moves, measured joints can keep the unmeasured
components of the contacts' velocities at zero. That is

    range(J_b)  lies in  span{J_j : torque j measured} + span{e_r : component r measured}.

A force/torque sensor in a limb is six motionless joints more, so that it contributes six vectors J_j.

Every sensor is thus a few vectors of one linear space, and a set suffices if their span contains the target range(J_b).
Contacts that share no joint have rows of their own in every J_j and e_r, so each connected group of contacts makes
a demand of its own, the same in every contact state it appears in.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import numpy as np

from torchid.identifiability.structure import random_postures, resting_samples
from torchid.parameters import Array
from torchid.problem import RowBuilder
from torchid.problem.contact_state import State
from torchid.robot import Robot
from torchid.rounding import BASE_RANK_TOLERANCE
from torchid.sensing import Contact
from torchid.sensor_planning.candidates import Candidate, sensor_set

TOLERANCE = 1e-6
"""A share of unit vectors below this counts as zero, as in the rank of S_b V_x that this predicts.

Axes that a URDF's rounded angles (1.5708) tilt by 4e-6 from parallel count as independent in both.
"""


@dataclass(frozen=True, eq=False)
class Demand:
    """What a group of contacts demands, at one posture.

    Attributes:
        contacts: places of the group's contacts, ascending; `frames`: their names.
        joints: places of the independent joints between the base and the contacts, ascending.
        rows: (k,) the contact that each row of J belongs to.
        target: (k, d) orthonormal basis of range(J_b).
        vectors: (k, w) unit vectors of every candidate that acts on the group; others, and those that act on it with
            no lever, are absent.
    """

    contacts: tuple[int, ...]
    frames: tuple[str, ...]
    joints: tuple[int, ...]
    rows: tuple[int, ...]
    target: Array
    vectors: Mapping[Candidate, Array]

    def stacked(self, chosen: Iterable[Candidate]) -> Array:
        """All vectors of some candidates, (k, w)."""
        return np.hstack([np.zeros((len(self.rows), 0)), *(self.vectors[c] for c in chosen if c in self.vectors)])

    def missing(self, chosen: Iterable[Candidate]) -> int:
        """Dimensions of the target that some candidates leave unreached; 0 if they meet the demand."""
        return int(self.unreached(orthonormal_basis(self.stacked(chosen))))

    def unreached(self, basis: Array) -> Array:
        """Dimensions of the target outside the span of orthonormal (or zero) columns (..., k, r), int (...)."""
        return np.asarray(
            (np.linalg.svd(orthogonal_part(self.target, basis), compute_uv=False) > BASE_RANK_TOLERANCE).sum(-1)
        )

    def gains(self, basis: Array) -> dict[Candidate, int]:
        """Dimensions that each candidate adds to a span (k, r)."""
        values = ((c, np.linalg.svd(orthogonal_part(x, basis), compute_uv=False)) for c, x in self.vectors.items())
        return {candidate: int((s > BASE_RANK_TOLERANCE).sum()) for candidate, s in values}


def orthonormal_basis(vectors: Array) -> Array:
    """Orthonormal basis of the span of unit columns, (..., k, w) to (..., k, min(k, w)), padded with zero columns."""
    U, values, _ = np.linalg.svd(vectors, full_matrices=False)
    return U * (values > BASE_RANK_TOLERANCE * values[..., :1])[..., None, :]


def orthogonal_part(vectors: Array, basis: Array) -> Array:
    """The part of vectors (k, w) that is orthogonal to a span (..., k, r): (..., k, w)."""
    return vectors - basis @ (np.swapaxes(basis, -1, -2) @ vectors)


def span_basis(vectors: Array) -> Array:
    """Orthonormal basis (k, r) of the span of parts of unit vectors (k, w); small ones are none."""
    U, values, _ = np.linalg.svd(vectors, full_matrices=False)
    return U[:, values > BASE_RANK_TOLERANCE]


def demands(
    robot: Robot,
    contacts: Sequence[Contact],
    states: Iterable[State],
    candidates: Sequence[Candidate],
    seed: int = 0,
    joint_position: Array | None = None,
) -> list[Demand]:
    """What some contact states demand, each group of contacts once; nothing for a bolted base.

    Args:
        robot: the robot.
        contacts: all contacts.
        states: which of them touch the ground together.
        candidates: sensors to choose from.
        seed: of the random posture, which represents almost all.
        joint_position: (n,) instead of that [rad or m].
    """
    if robot.fixed_base:
        return []
    if joint_position is None:
        joint_position = random_postures(robot, 1, np.random.default_rng(seed))[0]
    builder = RowBuilder(robot, contacts, sensor_set(robot, contacts, ()))
    linking = {*range(robot.n), *(dof for candidate in candidates for dof in candidate.dofs)}
    J = builder.contact_jacobian(resting_samples(joint_position[None], (False,) * len(contacts)))[0].numpy()
    above = [linking.intersection(builder.columns.joints_above(body)) for body, _ in builder.frames]
    groups = dict.fromkeys(group for state in states for group in _groups(above, state))
    joints = {group: sorted(set().union(*(above[place] for place in group)) & set(range(robot.n))) for group in groups}
    return [_demand(group, tuple(joints[group]), contacts, J, candidates) for group in groups]


def _groups(above: Sequence[AbstractSet[int]], state: State) -> list[tuple[int, ...]]:
    """Active contacts, grouped by shared joints among those `above` each."""
    active = [place for place, touching in enumerate(state) if touching]
    return [tuple(active[k] for k in group) for group in connected_groups([above[place] for place in active])]


def connected_groups(sets: Sequence[AbstractSet[Hashable]]) -> list[tuple[int, ...]]:
    """Places of sets that are linked by common members, ascending; an empty set is alone."""
    groups: list[tuple[list[int], set[Hashable]]] = []
    for place, members in enumerate(sets):
        touched = [group for group in groups if group[1] & members]
        groups = [group for group in groups if not group[1] & members]
        places = sorted([place, *(k for group in touched for k in group[0])])
        groups.append((places, set(members).union(*(group[1] for group in touched))))
    return sorted(tuple(places) for places, _ in groups)


def _demand(
    group: tuple[int, ...],
    joints: tuple[int, ...],
    contacts: Sequence[Contact],
    J: Array,
    candidates: Sequence[Candidate],
) -> Demand:
    """What a group demands, from the Jacobians of all contacts, (C, 6, n_rows)."""
    rows = [(place, k) for place in group for k in contacts[place].components]
    J_group = np.stack([J[row] for row in rows])
    J_group /= np.linalg.norm(J_group[:, :6])
    vectors = {}
    for candidate in candidates:
        if candidate.dofs:
            x = J_group[:, [6 + dof for dof in candidate.dofs]]
            length = np.linalg.norm(x, axis=0)
            if (length > BASE_RANK_TOLERANCE).any():
                vectors[candidate] = x[:, length > BASE_RANK_TOLERANCE] / length[length > BASE_RANK_TOLERANCE]
        elif candidate.contact in group:
            read = [rows.index((candidate.contact, k)) for k in candidate.components]
            vectors[candidate] = np.eye(len(rows))[:, read]
    frames = tuple(contacts[place].frame for place in group)
    return Demand(group, frames, joints, tuple(place for place, _ in rows), span_basis(J_group[:, :6]), vectors)
