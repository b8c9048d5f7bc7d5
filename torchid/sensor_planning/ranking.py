"""Rank and information of sensor sets over all samples of a motion, many sets from one pass."""

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
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import one_thread, run_in_workers, subsample_states, worker_count
from torchid.problem.contact_state import ContactState
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensor_planning.demands import Candidate, sensor_set
from torchid.sensor_planning.search import DemandGroup

_ROUNDING_SHARE = 1e-9  # a share of the largest column in units of the scales, or of unit columns, that is rounding
_SAMPLES = 96  # a contact state: bits change by less than 1 % with four times as many
_ROUNDING = 1e-13
_ROUNDS = 12
_SAME_COST = 1e-9


class MotionStack:
    """Ranks of the stack of many samples, of inertial parameters, for any choice of sensors.

    `rank(S_b V_x) = 6` in every sample suffices to reach every body. It is not necessary: what a sample loses of the
    base depends on its posture, and another sample may show it.

    How inertia is split at a weld with a force/torque sensor does not count: no other sensor could tell.
    """

    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        states: Sequence[ContactState],
        candidates: Sequence[Candidate],
        seed: int = 0,
    ) -> None:
        """Draw samples of every contact state, to be used for all sets."""
        self.robot, self.contacts, self.states = robot, tuple(contacts), tuple(states)
        self.candidates = tuple(candidates)
        self.samples = structural_samples(robot, contacts, states, seed=seed)

    def problem(self, sensors: SensorSet, friction: bool = True) -> LinearProblem:
        """The problem of the samples with a sensor set, as `structural_problem`."""
        return structural_problem(self.robot, self.contacts, sensors, self.states, friction, self.samples)

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

    The dearest are dropped first; a cheaper set of another kind may exist.

    Raises:
        SensorError: the candidates that are left have a lower rank than all of them.
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
    """Bits that any choice from some candidates gives, beside sensors that are there anyway.

    A sensor that is left out takes one row per sample and channel with it: with R the whitened rows of all sensors and
    c the way its channel enters the generalized force, L^-1 Q R, where Q = c^T W and L L^T = Q Q^T.
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
        """Work out the rows of all sensors together.

        Args:
            robot: the robot.
            contacts: its contacts.
            logs: samples to weigh the sensors by; forces in them do not matter.
            candidates: to choose from.
            others: sensors that are there in any case.
            noise: of all sensors.
            prior: (12 L,), how far parameters may be off the nominal ones, 0 where they are known.
        """
        self.candidates = tuple(candidates)
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
            owners, ways = self._ways(builder, samples, state)
            if owners:
                Q = reading_directions(ways, W)
                self._states.append(_StateRows(weight, owners, Q, Q @ R))

    def _ways(self, builder: RowBuilder, samples: Samples, state: ContactState) -> tuple[list[int], Tensor]:
        """How each channel of the candidates enters the generalized force, (B, c, n_rows), and whose it is."""
        J = builder.contact_jacobian(samples)
        base, owners, ways = builder.tree.base_rows, [], []
        for number, candidate in enumerate(self.candidates):
            for dof in candidate.dofs:
                way = J.new_zeros(len(samples), J.shape[-1])
                way[:, base + dof] = 1.0
                ways.append(way)
                owners.append(number)
            if candidate.contact is not None and state[candidate.contact]:
                ways += [J[:, candidate.contact, k] for k in candidate.components]
                owners += [number] * len(candidate.components)
        return owners, torch.stack(ways, dim=1) if ways else J.new_zeros(len(samples), 0, J.shape[-1])

    @one_thread()
    @torch.no_grad()
    def bits(self, chosen: Iterable[Candidate]) -> float:
        """Information [bits] about the parameters, against knowing each to within its prior."""
        kept = {self.candidates.index(candidate) for candidate in chosen}
        information = self._information
        for rows in self._states:
            gone = [row for row, owner in enumerate(rows.owners) if owner not in kept]
            if gone:
                Q = rows.Q[:, gone]
                gram = Q @ Q.mT
                gram.diagonal(dim1=1, dim2=2).add_(_ROUNDING)  # channels that read alike, or nothing
                lost = torch.linalg.solve_triangular(torch.linalg.cholesky(gram), rows.QR[:, gone], upper=False)
                information = information - rows_information(lost, rows.weight)
        return float(0.5 * torch.linalg.slogdet(information).logabsdet / np.log(2.0))


def rank_sets(
    ranking: SetRanking, sets: Sequence[tuple[Candidate, ...]], done: Callable[[], None] | None = None
) -> list[RankedSet]:
    """Sets with their bits, most informative first; `done` is called after each, from several threads."""

    def run(places: Iterator[int]) -> list[tuple[float, int]]:
        ranked = []
        for index in places:
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
    """Sets reached from a sufficient one by exchanging one sensor at a time, uphill in information, best first.

    Args:
        ranking: of the part's candidates.
        part: whose demands every set meets.
        first: where to start.
        keep: sensors that stay.
        exclude: sensors that cannot be taken.
    """
    best = RankedSet(ranking.bits(first), tuple(first))
    climbed = [best]
    for _ in range(_ROUNDS):
        others = _neighbours(part, best.sensors, keep, exclude)
        neighbours = [RankedSet(ranking.bits(chosen), chosen) for chosen in others]
        higher = max(neighbours, key=lambda ranked: ranked.bits, default=best)
        if higher.bits <= best.bits:
            break
        best = higher
        climbed.append(best)
    return climbed[::-1]


def _neighbours(
    part: DemandGroup, chosen: Sequence[Candidate], keep: AbstractSet[Candidate], exclude: AbstractSet[Candidate]
) -> Iterator[tuple[Candidate, ...]]:
    """Sufficient sets that differ by one sensor of the same cost."""
    for gone in chosen:
        for new in part.candidates:
            same_cost = abs(new.cost - gone.cost) <= _SAME_COST * gone.cost
            if gone not in keep and new not in exclude and new not in chosen and same_cost:
                exchanged = tuple(c for c in part.candidates if (c in chosen and c is not gone) or c is new)
                if not any(demand.missing(exchanged) for demand in part.demands):
                    yield exchanged


@dataclass(frozen=True)
class _StateRows:
    """Of B samples with all sensors: rows that hang on each candidate, Q (B, c, nv) and Q R (B, c, P)."""

    weight: float
    owners: list[int]
    Q: Tensor
    QR: Tensor


def _splits(robot: Robot) -> Array:
    """Changes of all parameters, (12 L, M), that take inertia from the body before a weld and add it to that beyond."""
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
    """Rank of the effect on a problem's rows of changes of its parameters, (P, M), each scaled to the size of one."""
    least = _ROUNDING_SHARE * np.linalg.norm(problem.A * problem.scale, axis=0).max(initial=0.0)
    sizes = (np.abs(changes) / problem.scale[:, None]).max(axis=0, initial=0.0)
    columns = problem.A @ (changes / np.maximum(sizes, np.finfo(float).tiny))
    norms = np.linalg.norm(columns, axis=0)
    visible = columns[:, norms > least] / norms[norms > least]
    return int(np.linalg.matrix_rank(visible, tol=_ROUNDING_SHARE)) if visible.size else 0
