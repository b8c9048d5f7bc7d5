"""The linear problem of all motions that contact states allow: what sensors could determine at best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchid.analysis.standing import standing_samples
from torchid.problem.linear import LinearProblem
from torchid.problem.plan import State
from torchid.problem.rows import RowBuilder
from torchid.problem.samples import Samples
from torchid.problem.streaming import compress, linear_problem
from torchid.robot import Robot
from torchid.sensing.contacts import Contact
from torchid.sensing.sensors import SensorSet

_SAMPLES_PER_COLUMN = 2  # in every state: a sample gives one row or more, and some directions are rarely excited


def structural_samples(
    robot: Robot, contacts: Sequence[Contact], states: Sequence[State], count: int | None = None, seed: int = 0
) -> list[Samples]:
    """Random samples, see `standing_samples`, of every contact state; they serve any sensor set.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        states: contact states the robot may be in.
        count: samples per state; by default twice the robot's base parameters, friction included.
        seed: of the random numbers.
    """
    count = count or _SAMPLES_PER_COLUMN * (10 + 9 * (len(robot.bodies) - 1))
    rng = np.random.default_rng(seed)
    return [standing_samples(robot, contacts, state, count, rng) for state in states]


def structural_problem(
    robot: Robot,
    contacts: Sequence[Contact],
    sensors: SensorSet,
    states: Sequence[State],
    friction: bool = True,
    samples: Sequence[Samples] | None = None,
) -> LinearProblem:
    """What a sensor set sees of the parameters if the robot may move as it likes in some contact states.

    Its rank bounds that of any log from above. The right-hand side is 0: nothing is to be fitted.

    Args:
        robot: the robot.
        contacts: the contacts in use.
        sensors: which forces are measured.
        states: contact states the robot may be in.
        friction: whether friction is free.
        samples: of these states, if they have been drawn already.
    """
    builder = RowBuilder(robot, contacts, sensors)
    drawn = structural_samples(robot, contacts, states) if samples is None else samples
    return linear_problem(compress(drawn, builder), builder, robot, friction)
