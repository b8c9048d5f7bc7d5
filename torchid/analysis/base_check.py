"""Does a sensor set see the base: rank(S_b V_x) per contact state, what is lost, why, and what would bring it back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from torchid.analysis.candidates import Candidate, candidates, chosen_from
from torchid.analysis.demands import TOLERANCE, Demand, demands, orthonormal
from torchid.analysis.postures import at_rest, random_postures
from torchid.analysis.screws import simplest_basis, wrench_words
from torchid.parameters import Array
from torchid.problem.plan import State, state_name
from torchid.problem.rows import RowBuilder
from torchid.problem.threads import one_thread
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.projection import base_rank, base_singular_values
from torchid.sensing.sensors import SensorSet

_CHUNK = 1024


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
    """What of the base a set does not see.

    Attributes:
        posture: (n,) [rad or m] where that was looked at.
        directions: (6, m) orthonormal w, force then moment at the base origin in the base frame, with w^T S_b V_x = 0:
            the equation of motion of the base along w is in none of the rows.
        words: the same space in words.
        culprits: frames of each group of contacts whose demand is not met, and the dimensions missing.
        cures: candidates each of which, added alone, leaves fewer dimensions missing.
    """

    posture: Array
    directions: Array
    words: tuple[str, ...]
    culprits: tuple[tuple[tuple[str, ...], int], ...]
    cures: tuple[Candidate, ...]


@dataclass(frozen=True, eq=False)
class StateCheck:
    """A sensor set in one contact state.

    Attributes:
        state: which contacts touch; `name`: their frames joined by "+".
        generic: over random postures; its rank is that of almost every posture.
        zero: at position zero of every joint, where many robots' limbs are straight.
        recorded: over postures of a log, or None.
        lost: None if the generic rank is 6.
        coincident: if the rank falls at position zero only, for each unmet demand the sensors that act alike there.
    """

    state: State
    name: str
    generic: PostureSummary
    zero: PostureSummary
    recorded: PostureSummary | None
    lost: LostBase | None
    coincident: tuple[tuple[str, ...], ...]


@one_thread()
@torch.no_grad()
def check_set(
    robot: Robot,
    contacts: Sequence[Contact],
    states: Iterable[State],
    sensors: SensorSet,
    choice: Sequence[Candidate],
    samples: int = 64,
    seed: int = 0,
    postures: Mapping[State, Array] | None = None,
) -> list[StateCheck]:
    """Check a sensor set in every contact state with the projection itself; nothing to check for a bolted base.

    Args:
        robot: the robot.
        contacts: all contacts.
        states: which of them touch together.
        sensors: the set.
        choice: candidates that may cure it.
        samples: number of random postures.
        seed: of these.
        postures: recorded joint positions (N, n) by state [rad or m].
    """
    if robot.fixed_base:
        return []
    builder, postures = RowBuilder(robot, contacts, sensors), postures or {}
    drawn = random_postures(robot, samples, np.random.default_rng(seed))
    channels = candidates(robot, contacts, per="axis", ft_sensors=robot.ft_names)
    everything = tuple(dict.fromkeys((*channels, *choice)))
    mounted = chosen_from(contacts, sensors, channels)
    checks = []
    for state in states:
        generic = demands(robot, contacts, [state], everything, seed)
        straight = demands(robot, contacts, [state], everything, joint_position=np.zeros(robot.n))
        cause = _Cause(generic, straight, mounted, choice)
        checks.append(_check(builder, state, drawn, postures.get(state), cause))
    return checks


def base_values(builder: RowBuilder, state: State, postures: Array) -> torch.Tensor:
    """Singular values of S_b V_x, (N, 6), at joint positions (N, n) in a contact state."""
    found = torch.zeros(len(postures), 6, dtype=torch.float64)
    for start in range(0, len(postures), _CHUNK):
        samples = at_rest(postures[start : start + _CHUNK], state)
        for index, V in builder.bases(samples, state):
            found[start : start + _CHUNK][index] = base_singular_values(V)
    return found


def coincident(generic: Demand, singular: Demand, chosen: Iterable[Candidate]) -> tuple[str, ...]:
    """The fewest sensors that are independent at one posture but not at another, where the demand is unmet therefore.

    Args:
        generic: a demand at a posture where the chosen sensors meet it; if they do not, nothing is named.
        singular: the same demand where they do not.
        chosen: sensors of one reading each.
    """
    needed = [c for c in chosen if c in generic.vectors]
    if generic.missing(needed) or not singular.missing(needed):
        return ()
    for candidate in tuple(needed):  # those that no sensor can be spared of are independent
        fewer = [c for c in needed if c != candidate]
        needed = needed if generic.missing(fewer) else fewer
    for count in range(1, len(needed) + 1):
        for some in combinations(needed, count):
            if orthonormal(singular.stacked(some)).any(axis=0).sum() < count:
                return tuple(c.name for c in some)
    return ()


@dataclass(frozen=True)
class _Cause:
    """Where to look for what a state lacks.

    Its demands at a random posture and at position zero, the sensors there are, the candidates there could be.
    """

    generic: Sequence[Demand]
    straight: Sequence[Demand]
    mounted: tuple[Candidate, ...]
    choice: Sequence[Candidate]

    def missing(self, *more: Candidate) -> list[int]:
        """Dimensions missing, demand by demand."""
        return [demand.missing((*self.mounted, *more)) for demand in self.generic]

    def alike(self) -> tuple[tuple[str, ...], ...]:
        """Sensors that act alike at position zero only."""
        pairs = zip(self.generic, self.straight, strict=True)
        return tuple(found for pair in pairs if (found := coincident(*pair, self.mounted)))


def _check(builder: RowBuilder, state: State, drawn: Array, recorded: Array | None, cause: _Cause) -> StateCheck:
    zero = np.zeros((1, drawn.shape[1]))
    generic, straight = base_values(builder, state, drawn), base_values(builder, state, zero)
    ranks, lost = base_rank(generic), None
    if ranks.max() < 6:
        regular = zero if base_rank(straight)[0] == ranks.max() else drawn[[int(ranks.argmax())]]
        lost = _lost(builder, state, regular, cause)
    return StateCheck(
        state,
        state_name(builder.contacts, state),
        PostureSummary.of(generic),
        PostureSummary.of(straight),
        None if recorded is None else PostureSummary.of(base_values(builder, state, recorded)),
        lost,
        cause.alike(),
    )


def _lost(builder: RowBuilder, state: State, posture: Array, cause: _Cause) -> LostBase:
    [(_, V)] = builder.bases(at_rest(posture, state), state)
    U, values, _ = np.linalg.svd(V[0, :6].numpy())
    directions = U[:, (values > TOLERANCE).sum() :]
    short = cause.missing()
    groups = zip(cause.generic, short, strict=True)
    return LostBase(
        posture[0],
        directions,
        tuple(wrench_words(wrench) for wrench in simplest_basis(directions)),
        tuple((demand.frames, dimensions) for demand, dimensions in groups if dimensions),
        tuple(c for c in cause.choice if sum(cause.missing(c)) < sum(short)),
    )
