"""What all samples of a moving robot determine together, whatever each of them loses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

from torchid.analysis.candidates import Candidate, sensor_set
from torchid.analysis.rank import structural_rank
from torchid.analysis.structure import structural_problem, structural_samples
from torchid.errors import SensorError
from torchid.problem.linear import LinearProblem
from torchid.problem.plan import State
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.sensors import SensorSet


class MotionStack:
    """Ranks of the stack of many samples, of inertial parameters, for any choice of sensors.

    `rank(S_b V_x) = 6` in every sample suffices to reach every body. It is not necessary: what a sample loses of the
    base depends on its posture, and another sample may show it.
    """

    def __init__(
        self,
        robot: Robot,
        contacts: Sequence[Contact],
        states: Sequence[State],
        candidates: Sequence[Candidate],
        seed: int = 0,
    ) -> None:
        """Draw samples of every contact state, to be used for all sets."""
        self.robot, self.contacts, self.states = robot, tuple(contacts), tuple(states)
        self.candidates = tuple(candidates)
        self.samples = structural_samples(robot, contacts, states, seed=seed)

    def problem(self, sensors: SensorSet, friction: bool = True) -> LinearProblem:
        """What a sensor set sees of the samples, as `structural_problem`."""
        return structural_problem(self.robot, self.contacts, sensors, self.states, friction, self.samples)

    def rank(self, chosen: Iterable[Candidate]) -> int:
        """Independent combinations of inertial parameters that a set of sensors determines."""
        return structural_rank(self.problem(sensor_set(self.robot, self.contacts, chosen), friction=False)).rank

    @cached_property
    def full(self) -> int:
        """The rank with all candidates."""
        return self.rank(self.candidates)


def sparse_set(
    stack: MotionStack,
    keep: Iterable[Candidate] = (),
    exclude: Iterable[Candidate] = (),
    done: Callable[[], None] | None = None,
) -> tuple[Candidate, ...]:
    """Sensors with which the stack still has the rank of all candidates, and none of which can be spared for it.

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
