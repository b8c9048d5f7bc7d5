"""What all samples of a moving robot determine together, whatever each of them loses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property

import numpy as np

from torchid import parameters
from torchid.analysis.candidates import Candidate, sensor_set
from torchid.analysis.rank import structural_rank
from torchid.analysis.structure import structural_problem, structural_samples
from torchid.errors import SensorError
from torchid.parameters import Array
from torchid.problem.linear import LinearProblem
from torchid.problem.plan import State
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.sensors import SensorSet

_UNSEEN = 1e-9  # a share of the largest column in units of the scales, or of unit columns, that is rounding


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
        problem = self.problem(sensor_set(self.robot, self.contacts, chosen), friction=False)
        return structural_rank(problem).rank - _rank_of(_splits(self.robot), problem)

    @cached_property
    def full(self) -> int:
        """The rank with all candidates."""
        return self.rank(self.candidates)


def _splits(robot: Robot) -> Array:
    """Changes of all parameters, (12 L, M), that take inertia from the body before a weld and add it to that beyond."""
    found = [np.zeros((robot.nominal.size, 0))]
    for index, body in enumerate(robot.bodies):
        joint = body.joint
        if joint is None or joint.kind != "fixed" or body.massless or robot.bodies[joint.parent].massless:
            continue
        changes = np.zeros((*robot.nominal.shape, parameters.INERTIAL.stop))
        changes[index, parameters.INERTIAL] = np.eye(parameters.INERTIAL.stop)
        X = parameters.change_of_frame(joint.T_parent_joint @ joint.T_joint_link)
        changes[joint.parent, parameters.INERTIAL] = -X
        found.append(changes.reshape(robot.nominal.size, -1))
    return np.hstack(found)


def _rank_of(changes: Array, problem: LinearProblem) -> int:
    """Rank of what a problem's rows see of some changes of its parameters, (P, M), each of the size of one of them."""
    least = _UNSEEN * np.linalg.norm(problem.A * problem.scale, axis=0).max(initial=0.0)
    sizes = (np.abs(changes) / problem.scale[:, None]).max(axis=0, initial=0.0)
    columns = problem.A @ (changes / np.maximum(sizes, np.finfo(float).tiny))
    norms = np.linalg.norm(columns, axis=0)
    seen = columns[:, norms > least] / norms[norms > least]
    return int(np.linalg.matrix_rank(seen, tol=_UNSEEN)) if seen.size else 0


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
