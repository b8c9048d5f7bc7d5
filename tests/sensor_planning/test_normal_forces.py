"""Scalar sensors of contacts as candidates: what they can take the place of, what they tell, and what they cost."""

from __future__ import annotations

import pytest
from planning import sees_the_base, states_of
from synthetic import G1, SOLO12, load

from torchid.errors import SensorError, UnknownNameError
from torchid.problem.linear import parameter_scale
from torchid.sensing import Contact, chosen_sensors, named_sensors
from torchid.sensor_planning.observability import (
    Candidate,
    assess_sensors,
    candidates,
    sensor_set,
    with_scalar_candidates,
)
from torchid.sensor_planning.planner import PlanningProblem, plan_sensors

FEET = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))
NAMES = tuple(foot.frame for foot in FEET)
GAIT = states_of("1111", "1001", "0110", "0000")


def test_a_scalar_sensor_is_one_channel_named_and_priced_by_itself() -> None:
    robot, contacts = load(G1), (Contact("left_ankle_roll_link", "flat"), Contact("right_rubber_hand", "point"))
    frames = [contact.frame for contact in contacts]
    choice = candidates(robot, contacts, [], normal_forces=frames, costs={"contact": 2.0, "normal_force": 0.5})
    assert [(c.name, c.kind, c.channels, c.cost) for c in choice] == [
        ("left_ankle_roll_link", "contact", 6, 12.0),
        ("left_ankle_roll_link.fn", "normal_force", 1, 0.5),
        ("right_rubber_hand", "contact", 3, 6.0),
        ("right_rubber_hand.fn", "normal_force", 1, 0.5),
    ]
    (alone,) = candidates(robot, contacts, [], "none", {"left_ankle_roll_link.fn": 0.3}, normal_forces=frames[:1])
    assert (alone.name, alone.cost) == ("left_ankle_roll_link.fn", 0.3)
    assert with_scalar_candidates(contacts, candidates(robot, contacts)) == contacts
    assert [contact.along_normal for contact in with_scalar_candidates(contacts, [alone])] == [True, False]
    axes = candidates(robot, with_scalar_candidates(contacts, choice)[1:], [], "axis")
    assert [c.name for c in axes] == [f"right_rubber_hand.{k}" for k in ("fx", "fy", "fn")]
    with pytest.raises(UnknownNameError, match=r"candidates.normal_forces: unknown name 'left_foot'; accepted: left_"):
        candidates(robot, contacts, normal_forces=["left_foot"])
    with pytest.raises(
        SensorError, match=r"normal_forces: left_ankle_roll_link, but candidates.contacts is axis; .*: device or none"
    ):
        candidates(robot, contacts, per="axis", normal_forces=frames[:1])


def test_a_plan_ranks_them_with_the_others_and_takes_them_where_they_are_cheaper() -> None:
    """A leg of three joints needs three readings; the force along the normal is one of them."""
    robot = load(SOLO12)
    prior = parameter_scale(robot.nominal).flatten()

    def problem(**costs: float) -> PlanningProblem:
        choice = candidates(robot, FEET, costs=costs, normal_forces=NAMES)
        return PlanningProblem(robot=robot, contacts=FEET, states=GAIT, candidates=choice, prior=prior)

    plan, bare = plan_sensors(problem()), PlanningProblem(robot, FEET, GAIT, candidates(robot, FEET), prior)
    assert (plan.cost, plan.proven, plan.problem.contacts[0].along_normal) == (12.0, True, True)
    assert bare.contacts == FEET
    for part, (foot, *_), other in zip(plan.parts, ((x,) for x in NAMES), plan_sensors(bare).parts, strict=True):
        assert part.sets is not None
        assert sum(f"{foot}.fn" in [c.name for c in chosen] for chosen in part.sets) == 3
        assert [ranked.bits for ranked in part.ranked] == sorted((r.bits for r in part.ranked), reverse=True)
        known = {names(chosen): bits for bits, chosen in part.ranked}
        for bits_without, chosen in other.ranked:  # the same sets tell as much whether there are scalar sensors or not
            assert known[names(chosen)] == pytest.approx(bits_without, rel=1e-6)
    cheap = plan_sensors(problem(normal_force=0.5))
    assert (cheap.cost, cheap.proven) == (10.0, True)
    assert [c.name for c in cheap.chosen if c.kind == "normal_force"] == [f"{foot}.fn" for foot in NAMES]
    chosen = sensor_set(robot, FEET, cheap.chosen)
    assert sees_the_base(robot, cheap.problem.contacts, GAIT[:3], [chosen]).all()
    assert [state.generic.rank for state in cheap.observability] == [6] * 4
    assert min(removal.base_rank or 0 for removal in cheap.removals) == 5


def test_they_are_remedies_where_no_single_axes_of_the_contact_are_read() -> None:
    robot = load(SOLO12)
    torques = [name for name in robot.joint_names if name not in ("FL_HFE", "FL_KFE", "FR_KFE")]
    choice = candidates(robot, FEET, normal_forces=NAMES)
    for wrenches, remedies in (
        ({}, {"FL_HFE", "FL_KFE", "FL_FOOT", "FL_FOOT.fn", "FR_KFE", "FR_FOOT", "FR_FOOT.fn"}),
        ({"FL_FOOT": ["fy"]}, {"FL_HFE", "FL_KFE", "FL_FOOT", "FR_KFE", "FR_FOOT", "FR_FOOT.fn"}),
    ):
        sensors = chosen_sensors(robot.joint_names, FEET, torques, wrenches)
        (check,) = assess_sensors(robot, FEET, GAIT[:1], sensors, choice)
        assert check.lost is not None
        assert {c.name for c in check.lost.remedies} == remedies
    along = with_scalar_candidates(FEET, choice)
    cured = chosen_sensors(robot.joint_names, along, [*torques, "FL_HFE"], {"FL_FOOT": ["fn"], "FR_FOOT": ["fn"]})
    (check,) = assess_sensors(robot, along, GAIT[:1], cured, choice)
    assert (check.generic.rank, check.lost) == (6, None)
    (check,) = assess_sensors(robot, FEET, GAIT[:1], named_sensors("contacts", robot.n, 4), choice)
    assert check.lost is None


def names(chosen: tuple[Candidate, ...]) -> frozenset[str]:
    return frozenset(c.name for c in chosen)
