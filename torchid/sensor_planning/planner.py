"""Plan the sensors of a scenario: the cheapest set with which the base is observable, the most informative of those."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count

import numpy as np

from torchid.errors import SensorError
from torchid.identifiability.structure import random_postures
from torchid.parallel import share_between_forks, thread_count
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples
from torchid.problem.chunks import subsample_states
from torchid.problem.contact_state import ContactState
from torchid.regressor.tree import KinematicTree
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, SensorSet
from torchid.sensing.projection import base_rank
from torchid.sensor_planning.demands import (
    Candidate,
    candidates,
    demands,
    sensor_set,
    total_cost,
    with_scalar_candidates,
)
from torchid.sensor_planning.observability import BaseObservability, assess_sensors, base_values
from torchid.sensor_planning.ranking import (
    MotionStack,
    RankedSet,
    SetRanking,
    improve_by_exchange,
    irredundant_set,
    rank_sets,
)
from torchid.sensor_planning.search import CheapestSet, DemandGroup, all_minimal_sets, cheapest_set, demand_groups

CRITERIA = ("per_sample", "stack")
StepCallback = Callable[[str, int, int], None]
"""Called with a description, the number of steps done, and that of all steps."""

_EXACT = 1e-9
_POSTURES = 500  # of the logs, per contact state
_TRIED = 4  # random postures: their largest rank is that of almost every posture


@dataclass(frozen=True)
class PlanningProblem:
    """A scenario whose sensors are to be planned.

    Attributes:
        robot, contacts, states: the scenario. Contacts at which there are scalar sensors among the candidates are given
            the ground's axes, along which sensor sets of the plan are then to be read.
        candidates: sensors to choose from; `keep`: those in every set; `exclude`: those in none.
        noise: of the sensors.
        logs: motion for which information is computed; if empty, random motion in the scenario's states.
        prior: (12 L,), prior standard deviation of the parameters about the nominal ones, 0 where they are known.
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
    """A part of the robot that can be planned on its own.

    `frames`: its contacts. `sets`: all its minimal sets, in which no sensor is redundant; None if there are too many
    candidates to enumerate. `ranked`: the cheapest of them with their information [bits], most informative first; if
    they were not enumerated, those visited by the exchange search.
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
    """A group of contacts that share joints, and the sensors with which the base survives the projection.

    `joints`: between the base and the contacts. `branches`: names of the branches these belong to. `fewest_readings`:
    the fewest joint torques and contact components that meet this group's demand alone, a lower bound if not `proven`.
    """

    contacts: tuple[str, ...]
    joints: tuple[str, ...]
    branches: tuple[str, ...]
    fewest_readings: int
    proven: bool


@dataclass(frozen=True)
class SensorChoice:
    """The recommended sensors of a scenario.

    Attributes:
        problem: that they solve.
        chosen: the recommended set. Its `cost` is the least possible if `proven`; `lower_bound`: no set costs less.
        parts: independent parts. The minimal sets of the robot are the unions of one set of each part.
    """

    problem: PlanningProblem
    chosen: tuple[Candidate, ...]
    cost: float
    lower_bound: float
    proven: bool
    parts: tuple[PartPlan, ...]

    @property
    def proof(self) -> str:
        """Whether a cheaper set may exist, in words."""
        return "no cheaper set exists" if self.proven else "not proven to be the cheapest"


@dataclass(frozen=True)
class SensorPlan(SensorChoice):
    """The same with the reasons.

    Attributes:
        branches: chains of joints, and which of them contacts constrain; `requirements`: of every group of contacts.
        observability: of the base with the recommended set, state by state.
        stack_rank, stack_full: rank of the stack of samples with it, and with all candidates.
        removals: ranks without each of its sensors.
    """

    branches: tuple[Branch, ...]
    requirements: tuple[ContactRequirement, ...]
    observability: tuple[BaseObservability, ...]
    stack_rank: int
    stack_full: int
    removals: tuple[Removal, ...]


def plan_sensors(problem: PlanningProblem, progress: StepCallback | None = None) -> SensorPlan:
    """The cheapest sensor set for a scenario, and of these the most informative one, with the reasons.

    Raises:
        SensorError: as `choose_sensors`.
    """
    return explain_choice(choose_sensors(problem, progress), progress)


def choose_sensors(problem: PlanningProblem, progress: StepCallback | None = None) -> SensorChoice:
    """The cheapest sensor set for a scenario, and of these the most informative one.

    Raises:
        SensorError: the candidates do not suffice, or a criterion that does not fit the robot.
    """
    report = progress or (lambda *_: None)
    if problem.criterion not in CRITERIA:
        raise SensorError("sensors", "criterion", f"'{problem.criterion}'", ", ".join(CRITERIA))
    if problem.criterion == "per_sample" and problem.robot.fixed_base:
        raise SensorError("sensors", "criterion", "per_sample, which needs a floating base", "stack")
    parts: tuple[PartPlan, ...] = ()
    if problem.criterion == "stack":
        done = _counted(report, "leaving sensors out", len(problem.candidates))
        chosen = irredundant_set(problem.stack, problem.keep, problem.exclude, done)
        cost, floor = total_cost(chosen), total_cost(problem.keep)
        least = CheapestSet(chosen, cost, floor, cost <= floor)
    else:
        all_demands = demands(problem.robot, problem.contacts, problem.states, problem.candidates, problem.seed)
        least = cheapest_set(all_demands, problem.candidates, problem.keep, problem.exclude)
        parts, chosen = _best_parts(problem, demand_groups(all_demands, problem.candidates), least, report)
    return SensorChoice(problem, chosen, least.cost, least.lower_bound, least.proven, parts)


def explain_choice(choice: SensorChoice, progress: StepCallback | None = None) -> SensorPlan:
    """The reasons for a choice of sensors."""
    problem, chosen, stack = choice.problem, choice.chosen, choice.problem.stack
    (progress or (lambda *_: None))("leaving sensors out", 0, 1)

    def ranks_with(sensors: Sequence[Candidate]) -> tuple[int | None, int]:
        return _base_rank(problem, sensors), stack.rank(sensors)

    fewer = [tuple(c for c in chosen if c is not candidate) for candidate in chosen]
    (_, full), (_, rank), *without = share_between_forks(
        [problem.candidates, chosen, *fewer], ranks_with, thread_count()
    )
    return SensorPlan(
        **vars(choice),
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
    children, out = robot.children, []
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
        own = frozenset(part.candidates)
        keep, exclude = problem.keep & own, problem.exclude & own
        sets = all_minimal_sets(part.demands, part.candidates, keep, exclude)
        initial = tuple(c for c in part.candidates if c in chosen)
        ranking = SetRanking(
            robot=problem.robot,
            contacts=problem.contacts,
            logs=logs,
            candidates=part.candidates,
            others=tuple(chosen - own),
            noise=problem.noise,
            prior=problem.prior,
        )
        description = f"ranking sets, {', '.join(frames)}"
        if sets is None:
            report(description, 0, 1)
            ranked = improve_by_exchange(ranking, part, initial, keep, exclude)
        else:
            bound = total_cost(initial) * (1.0 + _EXACT)
            cheapest = [s for s in sets if total_cost(s) <= bound]
            ranked = rank_sets(ranking, cheapest, _counted(report, description, len(cheapest)))
        chosen = (chosen - own) | frozenset(ranked[0].sensors)
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
