"""Plan the sensors of a scenario: rank and information of sets over a motion, the cheapest set, the most telling."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, count
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchid import parameters
from torchid.errors import SensorError
from torchid.identifiability.base_parameters import (
    random_postures,
    structural_problem,
    structural_rank,
    structural_samples,
)
from torchid.identifiability.information import prior_directions, reading_directions, rows_information
from torchid.parallel import one_thread, run_in_workers, share_between_forks, thread_count
from torchid.parameters import Array
from torchid.problem import LinearProblem, RowBuilder, Samples
from torchid.problem.chunks import subsample_states, worker_count
from torchid.problem.contact_state import ContactState
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.projection import base_rank
from torchid.sensor_planning.observability import (
    BaseObservability,
    Candidate,
    assess_sensors,
    base_values,
    candidates,
    demands,
    sensor_set,
    total_cost,
    with_scalar_candidates,
)
from torchid.sensor_planning.search import CheapestSet, DemandGroup, all_minimal_sets, cheapest_set, demand_groups

_ROUNDING_SHARE = 1e-9  # of the largest column in units of the scales, or of unit columns: smaller ones are rounding
_SAMPLES = 96  # per contact state: bits change by less than 1 % with four times as many
_ROUNDING = 1e-13


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
        self.robot = robot
        self.contacts = tuple(contacts)
        self.states = tuple(states)
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
    """A sensor set with the rank of all candidates in which no sensor is redundant.

    The most expensive sensors are dropped first; a cheaper irredundant set may exist.

    Raises:
        SensorError: without the excluded candidates the rank is lower.
    """
    kept = frozenset(keep)
    excluded = frozenset(exclude)
    chosen = [c for c in stack.candidates if c not in excluded]
    if stack.rank(chosen) < stack.full:
        reason = f"without {', '.join(sorted(c.name for c in excluded))} the data determine fewer parameters"
        raise SensorError("sensors", "exclude", reason, "fewer exclusions, or criterion: per_sample")
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
        base = builder.tree.base_rows
        owners = dict[tuple[int | None, int], set[int]]()
        ways = []
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


CRITERIA = ("per_sample", "stack")
StepCallback = Callable[[str, int, int], None]
"""Called with a description, the number of steps done, and that of all steps."""

_EXACT = 1e-9
_POSTURES = 500  # of the logs, per contact state
_TRIED = 4  # random postures: their largest rank is that of almost every posture


@dataclass(frozen=True)
class PlanningProblem:
    """A scenario for sensor planning.

    Attributes:
        robot, contacts, states: the scenario. Contacts with scalar candidates get the axes of the ground; sensor sets
            of the plan refer to these axes.
        candidates: sensors to choose from.
        keep: sensors in every set.
        exclude: sensors in no set.
        noise: of the sensors.
        logs: motion for the information; if empty, random motion in the scenario's states.
        prior: (12 L,), prior standard deviation of the parameters, 0 where they are known.
        criterion: one of `CRITERIA`.
        seed: of random postures and motion.
    """

    robot: Robot
    contacts: tuple[Contact, ...]
    states: tuple[ContactState, ...]
    candidates: tuple[Candidate, ...]
    prior: Array
    keep: frozenset[Candidate] = frozenset()
    exclude: frozenset[Candidate] = frozenset()
    noise: SensorNoise = field(default_factory=SensorNoise)
    logs: tuple[Samples, ...] = ()
    criterion: str = "per_sample"
    seed: int = 0

    def __post_init__(self) -> None:
        """Give contacts the axes that scalar sensors read along."""
        object.__setattr__(self, "contacts", with_scalar_candidates(self.contacts, self.candidates))

    @cached_property
    def stack(self) -> MotionStack:
        """Random motion in the scenario's states, drawn once."""
        return MotionStack(self.robot, self.contacts, self.states, self.candidates, self.seed)

    def assess(self, sensors: SensorSet, contacts: Sequence[Contact] | None = None) -> list[BaseObservability]:
        """Observability of the base with a sensor set, by contact state, over the postures of the logs as well.

        `contacts`: with the axes that the set is read along, if they are not the problem's.
        """
        pieces: dict[ContactState, list[Array]] = {}
        for samples, state, _ in subsample_states(self.logs, _POSTURES):
            pieces.setdefault(state, []).append(samples.joint_position.numpy())
        return assess_sensors(
            robot=self.robot,
            contacts=self.contacts if contacts is None else contacts,
            states=self.states,
            sensors=sensors,
            choice=self.candidates,
            seed=self.seed,
            postures={state: np.concatenate(positions) for state, positions in pieces.items()},
        )


@dataclass(frozen=True)
class PartPlan:
    """Plan of an independent part of the robot.

    `frames`: its contacts. `sets`: all its minimal (irredundant) sets; None with too many candidates to enumerate.
    `ranked`: the cheapest of them with their information [bits], most informative first; or the single set that was
    found.
    """

    frames: tuple[str, ...]
    candidates: tuple[Candidate, ...]
    sets: tuple[tuple[Candidate, ...], ...] | None
    ranked: tuple[RankedSet, ...]


@dataclass(frozen=True)
class Removal:
    """Without one sensor: least rank(S_b V_x) over the states, and the rank of the stack of samples."""

    candidate: Candidate
    base_rank: int | None
    stack_rank: int


@dataclass(frozen=True)
class Branch:
    """A chain of joints without branching, between the base, branching bodies and tips.

    `joints`: its independent joints, from the base outward. `contacts`: frames beyond it, in contact in some state.
    """

    joints: tuple[str, ...]
    contacts: tuple[str, ...]

    @property
    def name(self) -> str:
        """First and last joint."""
        return self.joints[0] if len(self.joints) == 1 else f"{self.joints[0]} ... {self.joints[-1]}"

    @property
    def constrained(self) -> bool:
        """Whether there is a contact beyond it; sensors in other branches do not help to observe the base."""
        return bool(self.contacts)


@dataclass(frozen=True)
class ContactRequirement:
    """A group of contacts that share joints, and the sensors that keep the base observable.

    `joints`: between the base and the contacts. `branches`: names of the branches of these joints. `fewest_readings`:
    least number of joint torques and contact components for this group alone, a lower bound if not `proven`.
    """

    contacts: tuple[str, ...]
    joints: tuple[str, ...]
    branches: tuple[str, ...]
    fewest_readings: int
    proven: bool


@dataclass(frozen=True)
class SensorPlan:
    """Recommended sensors of a scenario, with the reasons.

    Attributes:
        problem: the planning problem.
        chosen: the recommended set.
        cost: of the set; the least possible if `proven`.
        lower_bound: no set costs less.
        parts: independent parts. The minimal sets of the robot are the unions of one set of each part.
        branches: chains of joints, and whether contacts constrain them.
        requirements: of every group of contacts.
        observability: of the base with the recommended set, by contact state.
        stack_rank, stack_full: rank of the stacked samples with the set, and with all candidates.
        removals: ranks without each of its sensors.
    """

    problem: PlanningProblem
    chosen: tuple[Candidate, ...]
    cost: float
    lower_bound: float
    proven: bool
    parts: tuple[PartPlan, ...]
    branches: tuple[Branch, ...]
    requirements: tuple[ContactRequirement, ...]
    observability: tuple[BaseObservability, ...]
    stack_rank: int
    stack_full: int
    removals: tuple[Removal, ...]

    @property
    def proof(self) -> str:
        """Whether a cheaper set may exist, in words."""
        return "no cheaper set exists" if self.proven else "not proven to be the cheapest"


def plan_sensors(problem: PlanningProblem, progress: StepCallback | None = None) -> SensorPlan:
    """Find the cheapest sensor set for a scenario; among equally cheap sets, the most informative one.

    Raises:
        SensorError: the candidates do not suffice, or the criterion does not fit the robot.
    """
    report = progress or (lambda *_: None)
    if problem.criterion not in CRITERIA:
        raise SensorError("sensors", "criterion", f"'{problem.criterion}'", ", ".join(CRITERIA))
    if problem.criterion == "per_sample" and problem.robot.fixed_base:
        raise SensorError("sensors", "criterion", "per_sample, but the robot has a fixed base", "stack")
    parts: tuple[PartPlan, ...] = ()
    if problem.criterion == "stack":
        done = _counted(report, "leaving sensors out", len(problem.candidates))
        chosen = irredundant_set(problem.stack, problem.keep, problem.exclude, done)
        cost = total_cost(chosen)
        floor = total_cost(problem.keep)
        least = CheapestSet(chosen, cost, floor, cost <= floor)
    else:
        all_demands = demands(problem.robot, problem.contacts, problem.states, problem.candidates, problem.seed)
        least = cheapest_set(all_demands, problem.candidates, problem.keep, problem.exclude)
        parts, chosen = _best_parts(problem, demand_groups(all_demands, problem.candidates), least, report)
    report("leaving sensors out", 0, 1)
    stack, fewer = problem.stack, [tuple(c for c in chosen if c is not candidate) for candidate in chosen]
    (_, full), (_, rank), *without = share_between_forks(
        [problem.candidates, chosen, *fewer],
        lambda sensors: (_base_rank(problem, sensors), stack.rank(sensors)),
        thread_count(),
    )
    return SensorPlan(
        problem=problem,
        chosen=chosen,
        cost=least.cost,
        lower_bound=least.lower_bound,
        proven=least.proven,
        parts=parts,
        branches=branches(problem.robot, problem.contacts, problem.states),
        requirements=contact_requirements(problem.robot, problem.contacts, problem.states, problem.seed),
        observability=tuple(problem.assess(sensor_set(problem.robot, problem.contacts, chosen))),
        stack_rank=rank,
        stack_full=full,
        removals=tuple(Removal(candidate, *ranks) for candidate, ranks in zip(chosen, without, strict=True)),
    )


def branches(robot: Robot, contacts: Sequence[Contact], states: Iterable[ContactState]) -> tuple[Branch, ...]:
    """All branches with independent joints, depth first; a chain of mimic joints has none."""
    used = [contact.frame for contact, *active in zip(contacts, *states, strict=True) if any(active)]
    tree = KinematicTree(robot)
    above = {frame: {tree.body_of[node] for node in tree.path(tree.frame(robot, frame)[0])} for frame in used}
    children = robot.children
    out = []
    for first, body in enumerate(robot.bodies[1:], start=1):
        if body.parent > 0 and len(children[body.parent]) == 1:
            continue
        chain = [first]
        while len(children[chain[-1]]) == 1:
            chain += children[chain[-1]]
        names = [joint.name for k in chain if (joint := robot.bodies[k].joint) is not None]
        joints = tuple(name for name in names if name in robot.joint_names)
        if joints:
            out.append(Branch(joints, tuple(frame for frame in used if first in above[frame])))
    return tuple(out)


def contact_requirements(
    robot: Robot, contacts: Sequence[Contact], states: Iterable[ContactState], seed: int = 0
) -> tuple[ContactRequirement, ...]:
    """Requirements of every group of contacts, with all joint torques and contact components as candidates."""
    states = tuple(states)
    limbs = branches(robot, contacts, states)
    channels = candidates(robot, contacts, per="axis")
    out = []
    for demand in demands(robot, contacts, states, channels, seed):
        least = cheapest_set([demand], channels)
        joints = tuple(robot.joint_names[j] for j in demand.joints)
        through = tuple(limb.name for limb in limbs if not set(limb.joints).isdisjoint(joints))
        out.append(
            ContactRequirement(
                contacts=demand.frames,
                joints=joints,
                branches=through,
                fewest_readings=round(least.lower_bound),
                proven=least.proven,
            )
        )
    return tuple(out)


def _best_parts(
    problem: PlanningProblem, parts: Sequence[DemandGroup], least: CheapestSet, report: StepCallback
) -> tuple[tuple[PartPlan, ...], tuple[Candidate, ...]]:
    """Every part with its minimal sets, and the union of their most informative cheapest sets.

    Parts are ranked in turn, with the best sets of the previous parts and the first sets of the next ones.
    """
    chosen = frozenset(least.chosen)
    logs = problem.logs or problem.stack.samples
    out = []
    for part in parts:
        frames = tuple(dict.fromkeys(frame for demand in part.demands for frame in demand.frames))
        of_part = frozenset(part.candidates)
        keep = problem.keep & of_part
        exclude = problem.exclude & of_part
        sets = all_minimal_sets(part.demands, part.candidates, keep, exclude)
        initial = tuple(c for c in part.candidates if c in chosen)
        ranking = SetRanking(
            robot=problem.robot,
            contacts=problem.contacts,
            logs=logs,
            candidates=part.candidates,
            others=tuple(chosen - of_part),
            noise=problem.noise,
            prior=problem.prior,
        )
        description = f"ranking sets, {', '.join(frames)}"
        bound = total_cost(initial) * (1.0 + _EXACT)
        cheapest = [initial] if sets is None else [s for s in sets if total_cost(s) <= bound]
        ranked = rank_sets(ranking, cheapest, _counted(report, description, len(cheapest)))
        chosen = (chosen - of_part) | frozenset(ranked[0].sensors)
        out.append(PartPlan(frames, part.candidates, None if sets is None else tuple(sets), tuple(ranked)))
    return tuple(out), tuple(c for c in problem.candidates if c in chosen)


def _base_rank(problem: PlanningProblem, chosen: Sequence[Candidate]) -> int | None:
    """Least rank(S_b V_x) over the states, each at a generic posture; None for a fixed base."""
    if problem.robot.fixed_base:
        return None
    postures = random_postures(problem.robot, _TRIED, np.random.default_rng(problem.seed))
    builder = RowBuilder(problem.robot, problem.contacts, sensor_set(problem.robot, problem.contacts, chosen))
    return min(int(base_rank(base_values(builder, state, postures)).max()) for state in problem.states)


def _counted(report: StepCallback, what: str, steps: int) -> Callable[[], None]:
    """Callback without arguments that reports one step more at every call."""
    numbers = count(1)
    return lambda: report(what, next(numbers), steps)
