"""Candidate sensors, what contacts demand of them, and observability of the base with a sensor set."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch

from torchid.errors import SensorError, UnknownNameError, UrdfError
from torchid.identifiability.base_parameters import closed_postures, random_postures, resting_samples
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.contact_state import ContactState, state_name
from torchid.robot import Robot
from torchid.robot.tree import LOOPS_FIELD
from torchid.rounding import BASE_RANK_TOLERANCE
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values
from torchid.sensing.sensors import NORMAL_FORCE, NORMAL_INDEX, measured_components

SENSOR_KINDS = ("joint_torque", "contact", "normal_force", "ft_sensor")
PER = ("device", "axis", "none")
SPAN_TOLERANCE = 1e-6
"""A share of unit vectors below this counts as zero, as in the rank of S_b V_x that this predicts.

Axes that a URDF's rounded angles (1.5708) tilt by 4e-6 from parallel count as independent in both.
"""


@dataclass(frozen=True)
class Candidate:
    """A sensor that a plan may choose.

    `kind`: one of `SENSOR_KINDS`. `dofs`: indices in the robot's `dof_names` measured by a torque sensor or a limb
    force/torque sensor. `contact`: index of the contact, and `components`, in `WRENCH_COMPONENTS`, of a contact sensor.
    A scalar sensor has the component along the ground's normal, see `with_scalar_candidates`. `name`: the joint; the
    contact's frame for a whole device, "l_sole.fx" for one axis, "l_sole.fn" for a scalar sensor.
    """

    name: str
    kind: str
    cost: float
    dofs: tuple[int, ...] = ()
    contact: int | None = None
    components: tuple[int, ...] = ()

    @property
    def channels(self) -> int:
        """Number of measured components."""
        return len(self.readings)

    @property
    def readings(self) -> tuple[tuple[int | None, int], ...]:
        """What it measures: None and an index in `dof_names`, or the contact and a component."""
        return (*((None, dof) for dof in self.dofs), *((self.contact, k) for k in self.components))


def total_cost(chosen: Iterable[Candidate]) -> float:
    """Total cost of some candidates."""
    return sum(candidate.cost for candidate in chosen)


def candidates(
    robot: Robot,
    contacts: Sequence[Contact],
    joint_torques: Sequence[str] | None = None,
    per: str = "device",
    costs: Mapping[str, float] | None = None,
    ft_sensors: Sequence[str] = (),
    normal_forces: Sequence[str] = (),
) -> tuple[Candidate, ...]:
    """All candidate sensors: joint torques in the robot's order, then contact sensors, then limb sensors.

    Args:
        robot: the robot.
        contacts: all contacts; a sensor measures the components that its contact can transmit.
        joint_torques: joints that can have a torque sensor; None for all with a motor.
        per: "device" for one force/torque sensor per contact, "axis" for one candidate per component (also for limb
            sensors), or "none" for no contact sensors.
        costs: by name of a candidate, or by kind and then per channel; 1 per channel by default.
        ft_sensors: fixed joints that can have a force/torque sensor; the robot must be loaded with them.
        normal_forces: frames of contacts that can have a scalar sensor of the normal force, with or without a device.

    Raises:
        UnknownNameError: a joint, a contact, or a name in `costs` does not exist.
        SensorError: `per` is not in `PER`, or is "axis" with scalar sensors; or a cost is not positive.
    """
    if per not in PER:
        raise SensorError("sensors", "candidates.per", f"'{per}'", ", ".join(PER))
    driven = [name for name in robot.joint_names if name not in robot.passive]  # the torque of others is known
    chosen = driven if joint_torques is None else joint_torques
    for name in chosen:
        if name not in driven:
            what = "a joint without a motor" if name in robot.passive else ""
            raise UnknownNameError("sensors", "candidates.joint_torques", name, driven, what)
    offered = [
        Candidate(name, "joint_torque", 1.0, dofs=(j,)) for j, name in enumerate(robot.joint_names) if name in chosen
    ]
    limbs = _in_limbs(robot, ft_sensors, per == "axis")
    return _with_costs([*offered, *_at_contacts(contacts, per, normal_forces), *limbs], costs or {})


def _at_contacts(contacts: Sequence[Contact], per: str, normal_forces: Sequence[str]) -> list[Candidate]:
    """Sensors of contacts, as devices or axis by axis, and scalar ones."""
    frames = [contact.frame for contact in contacts]
    offered = []
    for name in normal_forces:
        if name not in frames:
            raise UnknownNameError("sensors", "candidates.normal_forces", name, frames)
    if normal_forces and per == "axis":
        reason = f"{', '.join(normal_forces)}, but candidates.contacts is axis"
        raise SensorError("sensors", "candidates.normal_forces", reason, "candidates.contacts: device or none")
    for index, contact in enumerate(contacts):
        if per == "device":
            components = tuple(contact.components)
            offered.append(Candidate(contact.frame, "contact", 1.0, contact=index, components=components))
        elif per == "axis":
            names = [(f"{contact.frame}.{contact.component_name(k)}", k) for k in contact.components]
            offered += [Candidate(name, "contact", 1.0, contact=index, components=(k,)) for name, k in names]
        if contact.frame in normal_forces:
            name = f"{contact.frame}.{NORMAL_FORCE}"
            offered.append(Candidate(name, "normal_force", 1.0, contact=index, components=(NORMAL_INDEX,)))
    return offered


def _in_limbs(robot: Robot, names: Sequence[str], by_axis: bool) -> list[Candidate]:
    """Force/torque sensors at fixed joints, as devices or axis by axis."""
    offered = []
    for name in names:
        if name not in robot.ft_names:
            raise UnknownNameError("sensors", "candidates.ft_sensors", name, robot.ft_names)
        first = robot.n + 6 * robot.ft_names.index(name)
        if by_axis:
            offered += [Candidate(robot.dof_names[k], "ft_sensor", 1.0, dofs=(k,)) for k in range(first, first + 6)]
        else:
            offered.append(Candidate(name, "ft_sensor", 1.0, dofs=tuple(range(first, first + 6))))
    return offered


def _with_costs(offered: Sequence[Candidate], costs: Mapping[str, float]) -> tuple[Candidate, ...]:
    names = [*SENSOR_KINDS, *(candidate.name for candidate in offered)]
    for name, cost in costs.items():
        if name not in names:
            raise UnknownNameError("sensors", "costs", name, names)
        if not (math.isfinite(cost) and cost > 0.0):
            raise SensorError("sensors", f"costs.{name}", str(cost), "a positive number")
    prices = [costs.get(c.name, c.channels * costs.get(c.kind, 1.0)) for c in offered]
    return tuple(replace(c, cost=float(price)) for c, price in zip(offered, prices, strict=True))


def with_scalar_candidates(
    contacts: Sequence[Contact], candidates: Iterable[Candidate], sensors: SensorSet | None = None
) -> tuple[Contact, ...]:
    """Give contacts with candidates of kind "normal_force" the axes of the ground.

    Whole wrenches are equivalent along any axes. A contact with single measured components along its frame's axes keeps
    these axes, so it cannot have a scalar sensor too.
    """
    along = {candidate.contact for candidate in candidates if candidate.kind == "normal_force"}
    if sensors is not None:
        measured = measured_components(contacts, sensors)
        along -= {c for c, contact in enumerate(contacts) if 0 < measured[c].sum() < len(contact.components)}
    return tuple(replace(x, along_normal=True) if c in along else x for c, x in enumerate(contacts))


def sensor_set(
    robot: Robot, contacts: Sequence[Contact], chosen: Iterable[Candidate], noise: SensorNoise | None = None
) -> SensorSet:
    """The sensor set that consists of some candidates; torques of joints without a motor are known."""
    torque = robot.is_passive.copy()
    wrench = np.zeros((len(contacts), 6), dtype=bool)
    for candidate in chosen:
        torque[list(candidate.dofs)] = True
        if candidate.contact is not None:
            wrench[candidate.contact, list(candidate.components)] = True
    return SensorSet(torque, wrench, noise or SensorNoise())


def contained_candidates(
    contacts: Sequence[Contact], sensors: SensorSet, candidates: Sequence[Candidate]
) -> tuple[Candidate, ...]:
    """The candidates in a sensor set: those with all components measured."""
    wrench = measured_components(contacts, sensors)
    return tuple(
        c
        for c in candidates
        if sensors.torque[list(c.dofs)].all() and (c.contact is None or wrench[c.contact, list(c.components)].all())
    )


@dataclass(frozen=True, eq=False)
class Demand:
    """Demand of a group of contacts at one posture: the sensors' vectors must span the target.

    Attributes:
        contacts: indices of the group's contacts, ascending.
        frames: their names.
        joints: indices of the independent joints between the base and the contacts, ascending.
        rows: (k,) contact of each row of J.
        target: (k, d) orthonormal basis of range(J_b).
        vectors: (k, w) unit vectors of every candidate that acts on the group with a lever arm.
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
        """Dimensions of the target outside the span of some candidates; 0 if they meet the demand."""
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
    """Orthonormal basis (k, r) of the span of parts of unit vectors (k, w), without negligible ones."""
    U, values, _ = np.linalg.svd(vectors, full_matrices=False)
    return U[:, values > BASE_RANK_TOLERANCE]


def demands(
    robot: Robot,
    contacts: Sequence[Contact],
    states: Iterable[ContactState],
    candidates: Sequence[Candidate],
    seed: int = 0,
    joint_position: Array | None = None,
) -> list[Demand]:
    """Demands of contact states, each group of contacts once; empty for a fixed base.

    Args:
        robot: the robot.
        contacts: all contacts.
        states: contact states.
        candidates: sensors to choose from.
        seed: of the random posture (ranks there are those of almost every posture).
        joint_position: (n,), a posture to use instead; with closed loops, the nearest closed one [rad or m].

    Raises:
        UrdfError: the motors do not determine the motion of a loop.
    """
    if robot.fixed_base:
        return []
    if joint_position is None:
        joint_position = random_postures(robot, 1, np.random.default_rng(seed))[0]
    elif robot.loops:
        joint_position = closed_postures(robot, joint_position[None])[0]
    builder = RowBuilder(robot, contacts, sensor_set(robot, contacts, ()))
    linking = {*range(robot.n), *(dof for candidate in candidates for dof in candidate.dofs)}
    J = _jacobian(builder, resting_samples(joint_position[None], (False,) * len(contacts)), robot)
    above = [linking & builder.motors.above(builder.columns.joints_above(body)) for body, _ in builder.frames]
    groups = dict.fromkeys(group for state in states for group in _groups(above, state))
    joints = {group: sorted(set().union(*(above[index] for index in group)) & set(range(robot.n))) for group in groups}
    return [_demand(group, tuple(joints[group]), contacts, J, candidates) for group in groups]


def _jacobian(builder: RowBuilder, posture: Samples, robot: Robot) -> Array:
    """Jacobians (C, 6, n_rows) of all contacts at a posture, by the motion of motors where there are loops."""
    J = builder.contact_jacobian(posture).permute(1, 2, 0, 3)
    by_motors = builder.motors.of(builder.tree, builder.kinematics(posture).states, J)[:, :, 0].numpy()
    by_motors[..., [robot.base_rows + dof for dof in builder.motors.passive]] = 0.0
    if np.isnan(by_motors).any():
        reason = "the motors of a loop do not determine its other joints"
        raise UrdfError(robot.path, LOOPS_FIELD, reason, "one motor per degree of freedom of a loop, to plan sensors")
    return np.asarray(by_motors)


def _groups(above: Sequence[AbstractSet[int]], state: ContactState) -> list[tuple[int, ...]]:
    """Active contacts, grouped by shared joints; `above`: joints between the base and each contact."""
    active = [index for index, in_contact in enumerate(state) if in_contact]
    return [tuple(active[k] for k in group) for group in connected_groups([above[index] for index in active])]


def connected_groups(sets: Sequence[AbstractSet[Hashable]]) -> list[tuple[int, ...]]:
    """Indices of sets that are linked by common members, ascending; an empty set is a group of its own."""
    groups: list[tuple[list[int], set[Hashable]]] = []
    for index, members in enumerate(sets):
        linked = [group for group in groups if group[1] & members]
        groups = [group for group in groups if not group[1] & members]
        indices = sorted([index, *(k for group in linked for k in group[0])])
        groups.append((indices, set(members).union(*(group[1] for group in linked))))
    return sorted(tuple(indices) for indices, _ in groups)


def _demand(
    group: tuple[int, ...],
    joints: tuple[int, ...],
    contacts: Sequence[Contact],
    J: Array,
    candidates: Sequence[Candidate],
) -> Demand:
    """Demand of a group, from the Jacobians of all contacts, (C, 6, n_rows)."""
    rows = [(index, k) for index in group for k in contacts[index].components]
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
            measured_rows = [rows.index((candidate.contact, k)) for k in candidate.components]
            vectors[candidate] = np.eye(len(rows))[:, measured_rows]
    frames = tuple(contacts[index].frame for index in group)
    return Demand(group, frames, joints, tuple(index for index, _ in rows), span_basis(J_group[:, :6]), vectors)


_ZERO = 1e-5  # share of a unit vector that counts as zero
_CHUNK = 1024
_NEGLIGIBLE = 5e-3  # [m], below the printed precision


@dataclass(frozen=True, eq=False)
class BaseObservability:
    """Observability of the base with a sensor set in one contact state.

    Attributes:
        state: the contact state.
        name: frames in contact, joined by "+".
        generic: over random postures; its rank is that of almost every posture.
        zero: at joint positions of 0, where the limbs of many robots are straight.
        recorded: over postures of a log, or None.
        lost: the unobservable part; None if the generic rank is 6.
        dependent: linearly dependent sensors by unmet demand, if the rank is deficient only at joint positions of 0.
    """

    state: ContactState
    name: str
    generic: PostureSummary
    zero: PostureSummary
    recorded: PostureSummary | None
    lost: LostBase | None
    dependent: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False)
class PostureSummary:
    """Smallest singular value of S_b V_x over some postures, and the best rank among them."""

    rank: int
    median: float
    low: float
    least: float

    @classmethod
    def of(cls, singular_values: torch.Tensor) -> PostureSummary:
        """From singular values (B, 6); `low` is the fifth percentile."""
        smallest = singular_values[:, -1].numpy()
        low, median = np.quantile(smallest, (0.05, 0.5))
        return cls(int(base_rank(singular_values).max()), float(median), float(low), float(smallest.min()))


@dataclass(frozen=True, eq=False)
class LostBase:
    """The part of the base's equations of motion that the projection removes with a sensor set.

    Attributes:
        posture: (n,) [rad or m] of the computation.
        directions: (6, m) orthonormal w, force then moment at the base origin in the base frame, with w^T S_b V_x = 0:
            no row contains the base's equation of motion along w.
        descriptions: the same space as text, see `describe_wrench`.
        unmet_groups: frames of each group of contacts with an unmet demand, and the missing dimensions.
        remedies: single candidates that reduce the missing dimensions.
    """

    posture: Array
    directions: Array
    descriptions: tuple[str, ...]
    unmet_groups: tuple[tuple[tuple[str, ...], int], ...]
    remedies: tuple[Candidate, ...]


@one_thread()
@torch.no_grad()
def assess_sensors(
    robot: Robot,
    contacts: Sequence[Contact],
    states: Iterable[ContactState],
    sensors: SensorSet,
    choice: Sequence[Candidate],
    samples: int = 64,
    seed: int = 0,
    postures: Mapping[ContactState, Array] | None = None,
) -> list[BaseObservability]:
    """Observability of the base with a sensor set in every contact state, from S_b V_x; none for a fixed base.

    Args:
        robot: the robot.
        contacts: all contacts.
        states: contact states.
        sensors: the set.
        choice: candidates for remedies; scalar sensors only where the set reads no single axes of the contact.
        samples: number of random postures.
        seed: of these.
        postures: recorded joint positions (N, n) by state [rad or m].
    """
    if robot.fixed_base:
        return []
    contacts = with_scalar_candidates(contacts, choice, sensors)
    choice = [
        c for c in choice if c.kind != "normal_force" or (c.contact is not None and contacts[c.contact].along_normal)
    ]
    builder = RowBuilder(robot, contacts, sensors)
    postures = postures or {}
    drawn = random_postures(robot, samples, np.random.default_rng(seed))
    channels = candidates(robot, contacts, per="axis", ft_sensors=robot.ft_names)
    everything = tuple(dict.fromkeys((*channels, *choice)))
    mounted = contained_candidates(contacts, sensors, channels)
    checks = []
    for state in states:
        generic = demands(robot, contacts, [state], everything, seed)
        straight = demands(robot, contacts, [state], everything, joint_position=np.zeros(robot.n))
        state_demands = _StateDemands(generic, straight, mounted, choice)
        checks.append(_assess_state(builder, state, drawn, postures.get(state), state_demands))
    return checks


def base_values(builder: RowBuilder, state: ContactState, postures: Array) -> torch.Tensor:
    """Singular values of S_b V_x, (N, 6), at joint positions (N, n) in a contact state."""
    values = torch.zeros(len(postures), 6, dtype=torch.float64)
    for start in range(0, len(postures), _CHUNK):
        samples = resting_samples(postures[start : start + _CHUNK], state)
        for index, V in builder.null_space_bases(state, builder.kinematics(samples)):
            values[start : start + _CHUNK][index] = base_singular_values(V)
    return values


def _dependent_sensors(generic: Demand, singular: Demand, chosen: Iterable[Candidate]) -> tuple[str, ...]:
    """The smallest group of sensors that is independent at one posture but dependent at another, where they fail.

    Args:
        generic: a demand at a posture at which the chosen sensors meet it; if they do not, the result is empty.
        singular: the same demand at a posture at which they do not.
        chosen: sensors of one component each.
    """
    needed = [c for c in chosen if c in generic.vectors]
    if generic.missing(needed) or not singular.missing(needed):
        return ()
    for candidate in tuple(needed):  # reduce to a minimal set, which is independent
        fewer = [c for c in needed if c != candidate]
        needed = needed if generic.missing(fewer) else fewer
    for count in range(1, len(needed) + 1):
        for group in combinations(needed, count):
            if orthonormal_basis(singular.stacked(group)).any(axis=0).sum() < count:
                return tuple(c.name for c in group)
    return ()


def simple_wrench_basis(space: Array) -> list[Array]:
    """Wrenches (6,) that span a space (6, m), with many zeros by Gauss-Jordan elimination; pure moments come last.

    The pivot is the largest remaining force component, or moment component if no force remains.
    """
    rows = np.array(space.T)
    done = 0
    for block in (slice(0, 3), slice(3, 6)):
        while done < len(rows):
            remaining = np.abs(rows[done:, block])
            row, column = divmod(int(np.argmax(remaining)), 3)
            if remaining[row, column] < _ZERO:
                break
            rows[[done, done + row]] = rows[[done + row, done]]
            rows[done] /= rows[done, block.start + column]
            others = np.arange(len(rows)) != done
            rows[others] -= np.outer(rows[others, block.start + column], rows[done])
            done += 1
    return list(rows[:done])


def describe_wrench(wrench: Array) -> str:
    """Text of a wrench (6,) at the base origin along the base axes, up to scale and sign.

    "moment about (0.71, 0, 0.71)"; "force along (0, 0, 1)", with "through (0, 0.1, 0)" [m] if its line does not pass
    through the base origin, and "with pitch 0.2 m" [m = N m per N] if there is a moment about the same line.
    """
    wrench = wrench / np.linalg.norm(wrench)
    force = wrench[:3]
    moment = wrench[3:]
    size = float(np.linalg.norm(force))
    if size < _ZERO:
        return f"moment about {_vector(_signed(moment))}"
    through = np.cross(force, moment) / size**2
    pitch = float(force @ moment) / size**2
    text = f"force along {_vector(_signed(force))}"
    if np.linalg.norm(through) > _NEGLIGIBLE:
        text += f" through {_vector(through)}"
    return text if abs(pitch) < _NEGLIGIBLE else f"{text} with pitch {pitch:.2g} m"


@dataclass(frozen=True)
class _StateDemands:
    """Demands of a state at a random posture and at position zero, the mounted sensors, and candidates for remedies."""

    generic: Sequence[Demand]
    straight: Sequence[Demand]
    mounted: tuple[Candidate, ...]
    choice: Sequence[Candidate]

    def missing(self, *more: Candidate) -> list[int]:
        """Missing dimensions, demand by demand."""
        return [demand.missing((*self.mounted, *more)) for demand in self.generic]

    def dependent(self) -> tuple[tuple[str, ...], ...]:
        """Sensors that are dependent at position zero only."""
        pairs = zip(self.generic, self.straight, strict=True)
        return tuple(sensors for pair in pairs if (sensors := _dependent_sensors(*pair, self.mounted)))


def _assess_state(
    builder: RowBuilder, state: ContactState, drawn: Array, recorded: Array | None, state_demands: _StateDemands
) -> BaseObservability:
    zero = np.zeros((1, drawn.shape[1]))
    generic = base_values(builder, state, drawn)
    straight = base_values(builder, state, zero)
    ranks = base_rank(generic)
    lost = None
    if ranks.max() < 6:
        regular = zero if base_rank(straight)[0] == ranks.max() else drawn[[int(ranks.argmax())]]
        lost = _lost_base(builder, state, regular, state_demands)
    return BaseObservability(
        state=state,
        name=state_name(builder.contacts, state),
        generic=PostureSummary.of(generic),
        zero=PostureSummary.of(straight),
        recorded=None if recorded is None else PostureSummary.of(base_values(builder, state, recorded)),
        lost=lost,
        dependent=state_demands.dependent(),
    )


def _lost_base(builder: RowBuilder, state: ContactState, posture: Array, state_demands: _StateDemands) -> LostBase:
    [(_, V)] = builder.null_space_bases(state, builder.kinematics(resting_samples(posture, state)))
    U, values, _ = np.linalg.svd(V[0, :6].numpy())
    directions = U[:, (values > BASE_RANK_TOLERANCE).sum() :]
    missing = state_demands.missing()
    groups = zip(state_demands.generic, missing, strict=True)
    return LostBase(
        posture=posture[0],
        directions=directions,
        descriptions=tuple(describe_wrench(wrench) for wrench in simple_wrench_basis(directions)),
        unmet_groups=tuple((demand.frames, dimensions) for demand, dimensions in groups if dimensions),
        remedies=tuple(c for c in state_demands.choice if sum(state_demands.missing(c)) < sum(missing)),
    )


def _signed(direction: Array) -> Array:
    """Of unit length, the largest component positive."""
    direction = direction / np.linalg.norm(direction)
    return direction * np.sign(direction[np.argmax(np.abs(direction).round(6))])


def _vector(x: Array) -> str:
    return f"({', '.join(f'{value:.2f}'.rstrip('0').rstrip('.') for value in np.round(x, 2) + 0.0)})"
