"""Exchanging one sensor at a time climbs to the most informative of the smallest sets."""

from __future__ import annotations

from functools import cache

import pytest
from synthetic import SOLO12, load

from torchid.identifiability.base_parameters import structural_problem, structural_samples
from torchid.sensing import Contact, SensorNoise
from torchid.sensor_planning.observability import Candidate, candidates, demands, sensor_set
from torchid.sensor_planning.planner import SetRanking, improve_by_exchange, rank_sets
from torchid.sensor_planning.search import DemandGroup, all_minimal_sets, demand_groups

FEET = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))
STATES = ((True,) * 4,)


@cache
def leg() -> tuple[SetRanking, DemandGroup, list[tuple[float, tuple[Candidate, ...]]]]:
    """Ranking, demands and all minimal sets, best first, of one leg of a quadruped whose other feet are measured."""
    robot = load(SOLO12)
    offered = candidates(robot, FEET, per="axis")
    part = demand_groups(demands(robot, FEET, STATES, offered), offered)[0]
    others = [c for c in offered if c.contact is not None and c not in part.candidates]
    everything = structural_problem(robot, FEET, sensor_set(robot, FEET, offered), STATES)
    logs = structural_samples(robot, FEET, STATES, 40)
    prior = everything.scale * everything.free
    ranking = SetRanking(robot, FEET, logs, part.candidates, others, SensorNoise(), prior)
    sets = all_minimal_sets(part.demands, part.candidates)
    assert sets is not None
    return ranking, part, rank_sets(ranking, sets)


def test_every_start_leads_to_the_best_of_all_minimal_sets() -> None:
    ranking, part, ranked = leg()
    assert ranked[0][0] > ranked[-1][0] + 1.0, "sets must differ for the test to mean anything"
    for _, start in ranked:
        climbed = improve_by_exchange(ranking, part, start, frozenset(), frozenset())
        assert [bits for bits, _ in climbed] == sorted((bits for bits, _ in climbed), reverse=True)
        assert {chosen for _, chosen in climbed} <= {chosen for _, chosen in ranked}
        assert climbed[0][0] == pytest.approx(ranked[0][0], rel=1e-9)
