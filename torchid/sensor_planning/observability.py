"""Observability of the base with a sensor set: rank(S_b V_x) per contact state, what is lost, why, and remedies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from torchid.identifiability.structure import random_postures, resting_samples
from torchid.parallel import one_thread
from torchid.parameters import Array
from torchid.problem import RowBuilder
from torchid.problem.contact_state import ContactState, state_name
from torchid.robot import Robot
from torchid.rounding import BASE_RANK_TOLERANCE
from torchid.sensing import Contact, SensorSet
from torchid.sensing.projection import base_rank, base_singular_values
from torchid.sensor_planning.demands import (
    Candidate,
    Demand,
    candidates,
    contained_candidates,
    demands,
    orthonormal_basis,
    with_scalar_candidates,
)

_ZERO = 1e-5  # share of a unit vector that counts as zero
_CHUNK = 1024
_NEGLIGIBLE = 5e-3  # [m], below the printed precision


@dataclass(frozen=True, eq=False)
class BaseObservability:
    """Observability of the base with a sensor set in one contact state.

    Attributes:
        state: the contact state; `name`: frames in contact, joined by "+".
        generic: over random postures; its rank is that of almost every posture.
        zero: at position zero of every joint, where many robots' limbs are straight.
        recorded: over postures of a log, or None.
        lost: None if the generic rank is 6.
        dependent: if the rank is deficient at position zero only, the sensors dependent there, by unmet demand.
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
    """The part of the base's equations of motion that does not survive the projection with a sensor set.

    Attributes:
        posture: (n,) [rad or m] at which it was computed.
        directions: (6, m) orthonormal w, force then moment at the base origin in the base frame, with w^T S_b V_x = 0:
            the equation of motion of the base along w is in none of the rows.
        descriptions: the same space as text, see `describe_wrench`.
        unmet_groups: frames of each group of contacts whose demand is not met, and the missing dimensions.
        remedies: candidates each of which, added alone, leaves fewer dimensions missing.
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
    builder, postures = RowBuilder(robot, contacts, sensors), postures or {}
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
    """A wrench (6,) at the base origin along the base frame's axes, up to scale and sign.

    "moment about (0.71, 0, 0.71)"; "force along (0, 0, 1)", if its line does not pass through the base origin "through
    (0, 0.1, 0)" [m]; and "with 0.2 m of pitch" [m = N m per N] if a moment about the same line comes with it.
    """
    wrench = wrench / np.linalg.norm(wrench)
    force, moment = wrench[:3], wrench[3:]
    size = float(np.linalg.norm(force))
    if size < _ZERO:
        return f"moment about {_vector(_signed(moment))}"
    through, pitch = np.cross(force, moment) / size**2, float(force @ moment) / size**2
    text = f"force along {_vector(_signed(force))}"
    if np.linalg.norm(through) > _NEGLIGIBLE:
        text += f" through {_vector(through)}"
    return text if abs(pitch) < _NEGLIGIBLE else f"{text} with {pitch:.2g} m of pitch"


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
    generic, straight = base_values(builder, state, drawn), base_values(builder, state, zero)
    ranks, lost = base_rank(generic), None
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
