"""What sensors robots need to know their base, what is lost without one, and what brings it back."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from planning import MACHINES, sees_the_base, states_of, tried
from synthetic import ANYMAL, G1, PANDA, SOLO12, Oracle, load, random_states

from torchid.errors import SensorError, UnknownNameError
from torchid.identifiability.base_parameters import random_postures
from torchid.parameters import Array
from torchid.problem import RowBuilder
from torchid.problem.contact_state import ContactState
from torchid.report.analysis import describe_singular_postures
from torchid.robot import Robot
from torchid.sensing import Contact, SensorSet, named_sensors
from torchid.sensing.projection import null_space
from torchid.sensor_planning.observability import (
    BaseObservability,
    Candidate,
    LostBase,
    PostureSummary,
    assess_sensors,
    base_values,
    candidates,
    contained_candidates,
    demands,
    describe_wrench,
    sensor_set,
)
from torchid.sensor_planning.planner import contact_requirements
from torchid.sensor_planning.search import all_minimal_sets, bound_cost, cheapest_set, demand_groups

SOLES = (Contact("left_ankle_roll_link", "flat"), Contact("right_ankle_roll_link", "flat"))
HAND = Contact("left_rubber_hand", "point")
STANDING = states_of("11")
QUADRUPEDS = {
    "Solo12": (SOLO12, ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")),
    "ANYmal": (ANYMAL, ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")),
}


@cache
def g1() -> Robot:
    return load(G1)


def names(chosen: tuple[Candidate, ...]) -> list[str]:
    return [candidate.name for candidate in chosen]


# ------------------------------------------------------------------------------------------------ what robots need


def test_a_standing_humanoid_needs_six_readings_per_leg_and_none_in_arms_or_waist() -> None:
    choice = candidates(g1(), SOLES, per="axis")
    wanted = demands(g1(), SOLES, STANDING, choice)
    least = cheapest_set(wanted, choice)
    assert (least.cost, least.lower_bound, least.proven) == (12.0, 12.0, True)
    parts = demand_groups(wanted, choice)
    assert [len(part.candidates) for part in parts] == [12, 12]
    for part, side in zip(parts, ("left_", "right_"), strict=True):
        assert all(c.name.startswith(side) and "shoulder" not in c.name for c in part.candidates)
        assert {len(chosen) for chosen in all_minimal_sets(part.demands, part.candidates) or ()} == {6}


@pytest.mark.parametrize("radius", [0.0, 0.03])
@pytest.mark.parametrize("name", QUADRUPEDS)
def test_a_quadruped_on_points_or_balls_needs_three_readings_per_leg_whatever_its_gait(
    name: str, radius: float
) -> None:
    urdf, feet = QUADRUPEDS[name]
    robot, contacts = load(urdf), tuple(Contact(foot, "point", radius=radius) for foot in feet)
    gait = states_of("1111", "1001", "0110", "0000")
    choice = candidates(robot, contacts)
    least = cheapest_set(demands(robot, contacts, gait, choice), choice)
    assert (least.cost, least.lower_bound, least.proven) == (12.0, 12.0, True)
    found = contact_requirements(robot, contacts, gait)
    assert [(need.fewest_readings, need.proven, need.contacts) for need in found] == [
        (3, True, (foot,)) for foot in feet
    ]
    assert all(len(need.joints) == 3 and len(need.branches) == 1 for need in found)
    assert sees_the_base(robot, contacts, gait[:3], [sensor_set(robot, contacts, least.chosen)]).all()


def test_two_hands_on_a_rail_share_the_waist_and_need_less_by_axes_than_by_torques() -> None:
    hands = (Contact("left_rubber_hand", "flat"), Contact("right_rubber_hand", "flat"))
    costs = {}
    for per in ("device", "axis"):
        choice = candidates(g1(), hands, per=per)
        wanted = demands(g1(), hands, STANDING, choice)
        assert [demand.contacts for demand in wanted] == [(0, 1)]
        least = cheapest_set(wanted, choice)
        assert (least.proven, bound_cost(wanted[0], choice).bound) == (True, least.cost)
        assert sees_the_base(g1(), hands, STANDING, [sensor_set(g1(), hands, least.chosen)]).all()
        costs[per] = least.cost
    # Three waist torques answer for the base's rotation; for its translation, three forces at each hand. No three
    # torques of an arm span a translation, so that torques need nine in both arms, or six and a device.
    assert costs == {"device": 12.0, "axis": 9.0}


def test_six_torques_of_a_planar_leg_do_not_replace_a_foots_force_torque_sensor() -> None:
    robot, _, _ = tried("a planar leg")
    contacts = MACHINES["a planar leg"].contacts
    torques = [c for c in candidates(robot, contacts) if c.kind == "joint_torque"]
    with pytest.raises(SensorError, match=r"do not determine 3 of 6 dimensions of leg6; accepted: ") as refused:
        cheapest_set(demands(robot, contacts, states_of("1"), torques), torques)
    assert "\n" not in str(refused.value)


def test_a_bolted_base_demands_nothing() -> None:
    robot = load(PANDA, fixed_base=True)
    contacts = (Contact("panda_link7", "flat"),)
    choice = candidates(robot, contacts)
    wanted = demands(robot, contacts, states_of("1"), choice)
    assert wanted == []
    assert cheapest_set(wanted, choice).chosen == ()
    assert assess_sensors(robot, contacts, states_of("1"), sensor_set(robot, contacts, ()), choice) == []


# --------------------------------------------------------------------------------------- limbs, candidates, prices


def test_candidates_are_named_priced_and_turned_into_masks_and_back() -> None:
    robot, contacts = g1(), (SOLES[0], HAND)
    torques = ["left_knee_joint", "left_hip_yaw_joint"]
    device = candidates(robot, contacts, torques, costs={"joint_torque": 3.0, "left_knee_joint": 2.5, "contact": 0.5})
    assert [(c.name, c.cost, c.channels) for c in device] == [
        ("left_hip_yaw_joint", 3.0, 1), ("left_knee_joint", 2.5, 1),
        ("left_ankle_roll_link", 3.0, 6), ("left_rubber_hand", 1.5, 3),
    ]  # fmt: skip
    assert candidates(robot, contacts, torques, per="none") == candidates(robot, (), torques)
    axis = candidates(robot, contacts, [], per="axis")
    assert names(axis)[4:] == [
        "left_ankle_roll_link.my", "left_ankle_roll_link.mz",
        "left_rubber_hand.fx", "left_rubber_hand.fy", "left_rubber_hand.fz",
    ]  # fmt: skip
    for chosen in (device[1:3], device[:1], ()):
        assert contained_candidates(contacts, sensor_set(robot, contacts, chosen), device) == chosen
    assert contained_candidates(contacts, sensor_set(robot, contacts, axis[1:3]), device) == ()
    assert contained_candidates(contacts, named_sensors("contacts", robot.n, 2), device) == device[2:]


def test_what_cannot_be_a_candidate_or_a_price_is_refused_in_one_line() -> None:
    robot, contacts = g1(), SOLES
    with pytest.raises(UnknownNameError, match="unknown name 'left_kne_joint'; accepted: left_knee_joint"):
        candidates(robot, contacts, ["left_kne_joint"])
    with pytest.raises(UnknownNameError, match="costs: unknown name 'left_knee'; accepted: left_knee_joint"):
        candidates(robot, contacts, costs={"left_knee": 2.0})
    with pytest.raises(SensorError, match="candidates.per: 'foot'; accepted: device, axis, none"):
        candidates(robot, contacts, per="foot")
    for price in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SensorError, match=r"costs.contact: .*; accepted: a positive number"):
            candidates(robot, contacts, costs={"contact": price})
    choice = candidates(robot, contacts)
    with pytest.raises(SensorError, match="'left_knee_joint' is also in exclude"):
        cheapest_set([], choice, keep=[choice[3]], exclude=choice[3:5])


# ------------------------------------------------------------------------------------------- what is lost, and why


def bases(
    robot: Robot, contacts: tuple[Contact, ...], state: ContactState, sensors: SensorSet, posture: Array
) -> Array:
    """S_b V_x, (6, r), with Pinocchio's Jacobian."""
    q = random_states(np.random.default_rng(0), robot.n, 1)[0]
    q[0, 7:] = posture
    rows = [np.eye(robot.nv)[6:][~sensors.torque]]
    for contact, active, measured in zip(contacts, state, sensors.wrench, strict=True):
        unmeasured = [k for k in contact.components if active and not measured[k]]
        rows.append(Oracle.of(robot).jacobian(q, contact.frame)[0][unmeasured])
    [(_, V)] = null_space(torch.from_numpy(np.vstack(rows))[None])
    return V[0, :6].numpy()


def test_without_any_sensor_of_a_minimal_set_the_base_is_lost_as_told_and_each_cure_brings_it_back() -> None:
    contacts, states = (*SOLES, HAND), states_of("110", "011")
    choice = candidates(g1(), contacts)
    chosen = cheapest_set(demands(g1(), contacts, states, choice), choice).chosen
    complete = assess_sensors(g1(), contacts, states, sensor_set(g1(), contacts, chosen), choice)
    assert [(check.generic.rank, check.lost) for check in complete] == [(6, None), (6, None)]
    for removed in chosen[1::2]:
        left = tuple(c for c in chosen if c != removed)
        sensors = sensor_set(g1(), contacts, left)
        checks = assess_sensors(g1(), contacts, states, sensors, choice, samples=16)
        lost = [(check.state, check.lost) for check in checks if check.lost is not None]
        assert lost
        for state, what in lost:
            assert isinstance(what, LostBase)
            kept = bases(g1(), contacts, state, sensors, what.posture)
            size = what.directions.shape[1]
            assert size == len(what.descriptions) == 6 - np.linalg.matrix_rank(kept, tol=1e-6) > 0
            np.testing.assert_allclose(what.directions.T @ what.directions, np.eye(size), rtol=0.0, atol=1e-12)
            np.testing.assert_allclose(what.directions.T @ kept, 0.0, atol=1e-9)
            assert sum(dimensions for _, dimensions in what.unmet_groups) == 1
            assert removed in what.remedies
            for cure in (removed, what.remedies[0], what.remedies[-1]):
                cured = sensor_set(g1(), contacts, (*left, cure))
                assert sees_the_base(g1(), contacts, (state,), [cured]).all(), cure.name


def test_a_planar_leg_loses_what_moves_out_of_its_plane() -> None:
    robot, _, _ = tried("a planar leg")
    contacts = MACHINES["a planar leg"].contacts
    choice = candidates(robot, contacts, per="axis")
    torques = [c for c in choice if c.kind == "joint_torque"]
    (check,) = assess_sensors(robot, contacts, states_of("1"), sensor_set(robot, contacts, torques), choice)
    assert (check.generic.rank, check.dependent) == (3, ())
    assert check.lost is not None
    assert sorted(check.lost.descriptions) == [
        "force along (0, 1, 0)",
        "moment about (0, 0, 1)",
        "moment about (1, 0, 0)",
    ]
    assert check.lost.unmet_groups == ((("leg6",), 3),)
    assert names(check.lost.remedies) == ["leg6.fy", "leg6.mx", "leg6.mz"]


def test_straight_legs_make_three_pitch_torques_act_alike() -> None:
    choice = candidates(g1(), SOLES)
    torques = [c for c in choice if c.kind == "joint_torque"]
    bent = random_postures(g1(), 50, np.random.default_rng(5))
    recorded = {STANDING[0]: np.vstack([bent, np.zeros((1, g1().n))])}
    sensors = sensor_set(g1(), SOLES, torques)
    (check,) = assess_sensors(g1(), SOLES, STANDING, sensors, choice, postures=recorded)
    assert (check.generic.rank, check.lost) == (6, None)
    assert check.zero.rank < 6
    assert check.dependent == tuple(
        tuple(f"{side}_{joint}_joint" for joint in ("hip_pitch", "knee", "ankle_pitch")) for side in ("left", "right")
    )
    assert check.recorded is not None
    assert check.recorded.least == pytest.approx(check.zero.least)
    values = base_values(RowBuilder(g1(), SOLES, sensors), STANDING[0], bent)[:, -1].numpy()
    assert check.recorded.median == pytest.approx(np.median([*values, check.zero.least]), rel=1e-9)
    (measured,) = assess_sensors(g1(), SOLES, STANDING, named_sensors("contacts", g1().n, 2), choice)
    assert (measured.zero.rank, measured.dependent) == (6, ())


@pytest.mark.parametrize(
    ("wrench", "text"),
    [
        ((0, 0, -2, 0, 0, 0), "force along (0, 0, 1)"),
        ((0, 0, 0, 3, 0, 3), "moment about (0.71, 0, 0.71)"),
        ((0, 0, 1, 0.2, 0, 0), "force along (0, 0, 1) through (0, 0.2, 0)"),
        ((0, 0, -1, 0, 0, 0.5), "force along (0, 0, 1) with pitch -0.5 m"),
        ((2, 0, 0, 0.5, 0, -0.6), "force along (1, 0, 0) through (0, 0.3, 0) with pitch 0.25 m"),
    ],
)
def test_a_wrench_is_put_in_words(wrench: tuple[float, ...], text: str) -> None:
    assert describe_wrench(np.array(wrench, dtype=float)) == text


def test_a_base_that_is_often_all_but_lost_is_warned_of() -> None:
    def checked(low: float) -> BaseObservability:
        random, zero = PostureSummary(6, 0.1, low, low), PostureSummary(6, 0.1, 0.1, 0.1)
        return BaseObservability((True,), "sole", random, zero, None, None, ())

    (line,) = describe_singular_postures([checked(1e-3), checked(1e-8)])
    assert "In 1 of 2 contact states" in line
