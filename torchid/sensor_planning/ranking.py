"""Rank and information of sensor sets over all samples of a motion; one pass serves many sets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.errors import SensorError
from torchid.identifiability.base_parameters import structural_rank
from torchid.identifiability.information import prior_directions, reading_directions, rows_information
from torchid.identifiability.structure import structural_problem, structural_samples
from torchid.parallel import one_thread, run_in_workers
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import subsample_states, worker_count
from torchid.problem.contact_state import ContactState
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensor_planning.demands import Candidate, sensor_set
from torchid.sensor_planning.search import DemandGroup

_ROUNDING_SHARE = 1e-9  # of the largest column in units of the scales, or of unit columns: smaller ones are rounding
_SAMPLES = 96  # per contact state: bits change by less than 1 % with four times as many
_ROUNDING = 1e-13
_ROUNDS = 12
_SAME_COST = 1e-9


class MotionStack:
    """Ranks of the stack of many samples, of inertial parameters, for any choice of sensors.

    `rank(S_b V_x) = 6` in every sample suffices to reach every body. It is not necessary: the directions of the base
    that a sample loses depend on its posture, and other samples may determine them.

    The split of inertia at a weld with a force/torque sensor is not counted: no other sensor determines it.
    """

    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        states: Sequence[ContactState],
        candidates: Sequence[Candidate],
        seed: int = 0,
    ) -> None:
        """Draw samples of every contact state, the same for all sets."""
        self.robot, self.contacts, self.states = robot, tuple(contacts), tuple(states)
        self.candidates = tuple(candidates)
        self.samples = structural_samples(robot, contacts, states, seed=seed)

    def problem(
        self, sensors: SensorSet, friction: bool = True, contacts: Sequence[Contact] | None = None
    ) -> LinearProblem:
        """The problem of the samples with a sensor set, as `structural_problem`; `contacts` with other axes."""
        contacts = self.contacts if contacts is None else contacts
        return structural_problem(self.robot, contacts, sensors, self.states, friction, self.samples)

    def rank(self, chosen: Iterable[Candidate]) -> int:
        """Independent combinations of inertial parameters that a set of sensors determines."""
        problem = self.problem(sensor_set(self.robot, self.contacts, chosen), friction=False)
        return structural_rank(problem).rank - _rank_of(_splits(self.robot), problem)

    @cached_property
    def full(self) -> int:
        """The rank with all candidates."""
        return self.rank(self.candidates)


def irredundant_set(
    stack: MotionStack,
    keep: Iterable[Candidate] = (),
    exclude: Iterable[Candidate] = (),
    done: Callable[[], None] | None = None,
) -> tuple[Candidate, ...]:
    """Sensors with which the stack still has the rank of all candidates, and none of which is redundant for it.

    The most expensive are dropped first; a cheaper irredundant set may exist.

    Raises:
        SensorError: without the excluded candidates the rank is lower.
    """
    kept, excluded = frozenset(keep), frozenset(exclude)
    chosen = [c for c in stack.candidates if c not in excluded]
    if stack.rank(chosen) < stack.full:
        found = f"without {', '.join(sorted(c.name for c in excluded))} fewer parameters are determined"
        raise SensorError("sensors", "exclude", found, "other exclusions, or criterion: per_sample")
    for candidate in sorted(set(chosen) - kept, key=lambda c: (-c.cost, stack.candidates.index(c))):
        fewer = [c for c in chosen if c is not candidate]
        if stack.rank(fewer) == stack.full:
            chosen = fewer
        if done is not None:
            done()
    return tuple(chosen)


class RankedSet(NamedTuple):
    """A sensor set with its information [bits]."""

    bits: float
    sensors: tuple[Candidate, ...]


class SetRanking:
    """Information [bits] of any choice of candidates, in addition to given sensors.

    Leaving a sensor out removes one row per sample and channel: L^-1 Q R, where R are the whitened rows of all sensors,
    Q = c^T W with c the direction of the channel in the generalized force, and L L^T = Q Q^T.
    """

    @one_thread()
    @torch.no_grad()
    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        logs: Sequence[Samples],
        candidates: Sequence[Candidate],
        others: Sequence[Candidate],
        noise: SensorNoise,
        prior: Array,
    ) -> None:
        """Compute the rows of all sensors together.

        Args:
            robot: the robot.
            contacts: its contacts.
            logs: samples for which information is computed; their forces are not used.
            candidates: to choose from.
            others: sensors in every set.
            noise: of all sensors.
            prior: (12 L,), prior standard deviation of the parameters about the nominal ones, 0 where they are known.
        """
        self.candidates = tuple(candidates)
        self._always = {reading for other in others for reading in other.readings}
        sensors = sensor_set(robot, contacts, [*candidates, *others], noise)
        builder = RowBuilder(robot, contacts, sensors)
        directions = torch.from_numpy(prior_directions(builder, prior))
        self._states: list[_StateRows] = []
        self._information = torch.eye(directions.shape[1], dtype=torch.float64)
        for samples, state, represented in subsample_states(logs, _SAMPLES):
            weight = represented / samples.oversampling
            rows, W = builder.rows_by_sample(samples, state)
            R = rows[..., :-1] @ directions
            self._information += rows_information(R, weight)
            owners, ways = self._channel_directions(builder, samples, state)
            if owners:
                Q = reading_directions(ways, W)
                self._states.append(_StateRows(weight, owners, Q, Q @ R))

    def _channel_directions(
        self, builder: RowBuilder, samples: Samples, state: ContactState
    ) -> tuple[list[set[int]], Tensor]:
        """Candidates by index that alone read each channel, and its direction in the generalized force.

        Directions are (B, c, n_rows); channels that the other sensors read too have none.
        """
        J = builder.contact_jacobian(samples)
        base, owners, ways = builder.tree.base_rows, dict[tuple[int | None, int], set[int]](), []
        for number, candidate in enumerate(self.candidates):
            for contact, k in candidate.readings:
                if (contact, k) in self._always or (contact is not None and not state[contact]):
                    continue
                if (contact, k) not in owners:
                    way = J.new_zeros(len(samples), J.shape[-1]) if contact is None else J[:, contact, k]
                    if contact is None:
                        way[:, base + k] = 1.0
                    ways.append(way)
                owners.setdefault((contact, k), set()).add(number)
        directions = torch.stack(ways, dim=1) if ways else J.new_zeros(len(samples), 0, J.shape[-1])
        return list(owners.values()), directions

    @one_thread()
    @torch.no_grad()
    def bits(self, chosen: Iterable[Candidate]) -> float:
        """Information gain [bits] about the parameters over the prior."""
        kept = {self.candidates.index(candidate) for candidate in chosen}
        information = self._information
        for rows in self._states:
            left_out = [row for row, owners in enumerate(rows.owners) if owners.isdisjoint(kept)]
            if left_out:
                Q = rows.Q[:, left_out]
                gram = Q @ Q.mT
                gram.diagonal(dim1=1, dim2=2).add_(_ROUNDING)  # dependent or zero channels
                lost = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), rows.QR[:, left_out], upper=False)
                information = information - rows_information(lost, rows.weight)
        return float(0.5 * torch.linalg.slogdet(information).logabsdet / np.log(2.0))


def rank_sets(
    ranking: SetRanking, sets: Sequence[tuple[Candidate, ...]], done: Callable[[], None] | None = None
) -> list[RankedSet]:
    """Sets with their bits, most informative first; `done` is called after each, from several threads."""

    def run(indices: Iterator[int]) -> list[tuple[float, int]]:
        ranked = []
        for index in indices:
            ranked.append((-ranking.bits(sets[index]), index))
            if done is not None:
                done()
        return ranked

    workers = min(worker_count(torch.device("cpu")), max(len(sets), 1))
    ranked = sorted(chain.from_iterable(run_in_workers(range(len(sets)), run, workers)))
    return [RankedSet(-bits, sets[index]) for bits, index in ranked]


def improve_by_exchange(
    ranking: SetRanking,
    part: DemandGroup,
    first: Sequence[Candidate],
    keep: AbstractSet[Candidate],
    exclude: AbstractSet[Candidate],
) -> list[RankedSet]:
    """Sets reached from a sufficient one by exchanging one sensor at a time for more information, best first.

    Args:
        ranking: of the part's candidates.
        part: whose demands every set meets.
        first: the initial set.
        keep: sensors in every set.
        exclude: sensors in no set.
    """
    best = RankedSet(ranking.bits(first), tuple(first))
    visited = [best]
    for _ in range(_ROUNDS):
        others = _neighbours(part, best.sensors, keep, exclude)
        neighbours = [RankedSet(ranking.bits(chosen), chosen) for chosen in others]
        higher = max(neighbours, key=lambda ranked: ranked.bits, default=best)
        if higher.bits <= best.bits:
            break
        best = higher
        visited.append(best)
    return visited[::-1]


def _neighbours(
    part: DemandGroup, chosen: Sequence[Candidate], keep: AbstractSet[Candidate], exclude: AbstractSet[Candidate]
) -> Iterator[tuple[Candidate, ...]]:
    """Sufficient sets that differ by one sensor of the same cost."""
    for old in chosen:
        for new in part.candidates:
            same_cost = abs(new.cost - old.cost) <= _SAME_COST * old.cost
            if old not in keep and new not in exclude and new not in chosen and same_cost:
                exchanged = tuple(c for c in part.candidates if (c in chosen and c is not old) or c is new)
                if not any(demand.missing(exchanged) for demand in part.demands):
                    yield exchanged


@dataclass(frozen=True)
class _StateRows:
    """Of B samples with all sensors: Q (B, c, n_rows) and Q R (B, c, P) of the channels, and their candidates."""

    weight: float
    owners: list[set[int]]
    Q: Tensor
    QR: Tensor


def _splits(robot: Robot) -> Array:
    """Changes of all parameters, (12 L, M), that move inertia from the body before a weld to the one beyond."""
    splits = [np.zeros((robot.nominal.size, 0))]
    for index, body in enumerate(robot.bodies):
        joint = body.joint
        if joint is None or joint.kind != "fixed" or body.massless or robot.bodies[joint.parent].massless:
            continue
        changes = np.zeros((*robot.nominal.shape, parameters.INERTIAL.stop))
        changes[index, parameters.INERTIAL] = np.eye(parameters.INERTIAL.stop)
        X = parameters.change_of_frame(joint.T_parent_joint @ joint.T_joint_link)
        changes[joint.parent, parameters.INERTIAL] = -X
        splits.append(changes.reshape(robot.nominal.size, -1))
    return np.hstack(splits)


def _rank_of(changes: Array, problem: LinearProblem) -> int:
    """Rank of the effect of parameter changes, (P, M), each scaled to size 1, on a problem's rows."""
    least = _ROUNDING_SHARE * np.linalg.norm(problem.A * problem.scale, axis=0).max(initial=0.0)
    sizes = (np.abs(changes) / problem.scale[:, None]).max(axis=0, initial=0.0)
    columns = problem.A @ (changes / np.maximum(sizes, np.finfo(float).tiny))
    norms = np.linalg.norm(columns, axis=0)
    unit_columns = columns[:, norms > least] / norms[norms > least]
    return int(np.linalg.matrix_rank(unit_columns, tol=_ROUNDING_SHARE)) if unit_columns.size else 0
