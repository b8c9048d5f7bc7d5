"""Information of sensor sets from one pass equals that of the problem built with just these sensors."""

from __future__ import annotations

import numpy as np
import pytest
from planning import NOISE, bits
from synthetic import G1, PANDA, SOLO12, load

from torchid.identifiability.base_parameters import structural_samples
from torchid.parameters import Array
from torchid.problem import RowBuilder, Samples, compress, linear_problem
from torchid.robot import Robot
from torchid.sensing import Contact
from torchid.sensor_planning.observability import Candidate, candidates, sensor_set
from torchid.sensor_planning.planner import SetRanking

FEET = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))
SOLES = (Contact("left_ankle_roll_link", "flat"), Contact("right_ankle_roll_link", "line"))
CASES = {
    "quadruped": (SOLO12, False, FEET, ((True,) * 4, (True, False, False, True), (False,) * 4)),
    "humanoid": (G1, False, SOLES, ((True, True), (True, False))),
    "arm": (PANDA, True, (Contact("panda_hand", "flat"),), ((True,), (False,))),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("per", ["axis", "device"])
def test_leaving_sensors_out_of_the_rows_is_building_the_rows_without_them(case: str, per: str) -> None:
    urdf, fixed, contacts, states = CASES[case]
    robot = load(urdf, fixed_base=fixed)
    logs = structural_samples(robot, contacts, states, 25)
    offered, rng = candidates(robot, contacts, per=per), np.random.default_rng(1)
    prior = prior_of(robot, contacts, logs, offered)
    others = tuple(c for c in offered if rng.uniform() < 0.2)
    open_ = tuple(c for c in offered if c not in others)
    ranking = SetRanking(robot, contacts, logs, open_, others, NOISE, prior)
    for share in (0.0, 0.4, 0.7, 1.0):
        chosen = tuple(c for c in open_ if rng.uniform() < share)
        expected = bits(robot, contacts, logs, (*others, *chosen), prior)
        assert ranking.bits(chosen) == pytest.approx(expected, rel=1e-8, abs=1e-6)


def prior_of(robot: Robot, contacts: tuple[Contact, ...], logs: list[Samples], offered: tuple[Candidate, ...]) -> Array:
    builder = RowBuilder(robot, contacts, sensor_set(robot, contacts, offered))
    problem = linear_problem(compress(logs, builder), builder, robot)
    return problem.scale * problem.free
