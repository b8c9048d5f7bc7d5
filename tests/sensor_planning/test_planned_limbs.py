"""Force/torque sensors in limbs among the planner's candidates; minimal sets are tried in test_minimal_sets.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from planning import RANDOM, Machine, states_of
from synthetic import load
from welded import SENSORS, machine

from torchid import parameters
from torchid.errors import UnknownNameError
from torchid.robot import Robot
from torchid.sensing import Contact, named_sensors, with_ft_sensors
from torchid.sensor_planning.observability import assess_sensors, candidates, demands, sensor_set
from torchid.sensor_planning.planner import MotionStack, PlanningProblem, irredundant_set, plan_sensors

LEG = Machine(
    {"leg": ("base", (RANDOM, RANDOM, RANDOM, "weld", RANDOM, RANDOM)), "arm": ("base", (RANDOM, "weld"))},
    (Contact("leg6", "flat"),),
    states_of("1"),
)


@pytest.fixture(scope="module")
def leg(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return LEG.robot(tmp_path_factory.mktemp("leg"))


def test_candidates_are_devices_or_axes_with_costs_by_kind_or_name(leg: Robot) -> None:
    device = candidates(leg, LEG.contacts, ft_sensors=leg.ft_names, costs={"ft_sensor": 0.5, "j_arm2": 7.0})
    found = {c.name: (c.kind, c.channels, c.cost) for c in device if c.kind == "ft_sensor"}
    assert found == {"j_leg4": ("ft_sensor", 6, 3.0), "j_arm2": ("ft_sensor", 6, 7.0)}
    by_axis = candidates(leg, LEG.contacts, per="axis", ft_sensors=["j_leg4"])
    assert [c.name for c in by_axis if c.kind == "ft_sensor"] == [
        f"j_leg4.{k}" for k in ("fx", "fy", "fz", "mx", "my", "mz")
    ]
    assert not [c for c in candidates(leg, LEG.contacts) if c.kind == "ft_sensor"], "none unless they are named"
    with pytest.raises(UnknownNameError, match="'j_leg5'.*accepted: "):
        candidates(leg, LEG.contacts, ft_sensors=["j_leg5"])


def test_a_sensor_counts_where_a_contact_lies_beyond_it_and_nowhere_else(leg: Robot) -> None:
    offered = candidates(leg, LEG.contacts, ft_sensors=leg.ft_names)
    (demand,) = demands(leg, LEG.contacts, LEG.states, offered)
    acting = {c.name for c in demand.vectors}
    assert "j_leg4" in acting
    assert "j_arm2" not in acting
    alone = [c for c in offered if c.name == "j_leg4"]
    assert demand.missing(alone) == 0, "six readings in the leg make up for the foot's wrench"
    sensors = with_ft_sensors(named_sensors("joints", leg.n, 1, ft=2), leg, ["j_leg4"])
    sensors.torque[: leg.n] = False
    (check,) = assess_sensors(leg, LEG.contacts, LEG.states, sensors, offered)
    assert (check.generic.rank, check.lost) == (6, None)
    sensors.torque[leg.dof_names.index("j_leg4.fx")] = False
    (check,) = assess_sensors(leg, LEG.contacts, LEG.states, sensors, offered)
    assert check.generic.rank == 5
    assert check.lost is not None
    assert {"j_leg1", "leg6", "j_leg4"} <= {c.name for c in check.lost.remedies}
    assert "j_arm2" not in {c.name for c in check.lost.remedies}


def test_the_planner_keeps_excludes_and_prices_them(leg: Robot) -> None:
    offered = candidates(leg, LEG.contacts, ft_sensors=leg.ft_names, costs={"contact": 2.0, "ft_sensor": 0.5})
    by_name = {c.name: c for c in offered}
    prior = np.ones(12 * len(leg.bodies))
    found = plan_sensors(PlanningProblem(leg, LEG.contacts, LEG.states, offered, prior))
    assert (found.cost, found.proven, [c.name for c in found.chosen]) == (3.0, True, ["j_leg4"])
    assert found.removals[0].base_rank == 0
    without = PlanningProblem(leg, LEG.contacts, LEG.states, offered, prior, exclude=frozenset({by_name["j_leg4"]}))
    assert [c.name for c in plan_sensors(without).chosen] == ["leg6"]
    kept = PlanningProblem(leg, LEG.contacts, LEG.states, offered, prior, keep=frozenset({by_name["j_arm2"]}))
    assert plan_sensors(kept).cost == 6.0


# -------------------------------------------------------------------------------------- the stack of all samples

FEET = (Contact("sole", "flat"), Contact("thigh", "point"))
STATES = states_of("11", "10")


@pytest.mark.parametrize("sensors", [SENSORS, SENSORS[1:3]], ids="+".join)
def test_how_a_limb_is_split_at_a_weld_is_not_asked_of_the_stack(tmp_path: Path, sensors: tuple[str, ...]) -> None:
    """All sensors together determine no more of the robot as it was before its welds were cut open."""
    path = machine(tmp_path)
    lumped, split = load(path), load(path, ft_joints=sensors)
    plain = MotionStack(lumped, FEET, STATES, candidates(lumped, FEET))
    offered = candidates(split, FEET, ft_sensors=sensors)
    stack = MotionStack(split, FEET, STATES, offered)
    assert stack.full == plain.full
    assert stack.rank(c for c in offered if c.kind != "ft_sensor") == plain.full
    in_limbs = [c for c in offered if c.kind == "ft_sensor"]
    assert 0 < stack.rank(in_limbs) <= plain.full
    chosen = irredundant_set(stack)
    assert stack.rank(chosen) == plain.full
    assert len(chosen) < len(offered)


def test_what_sensors_in_limbs_determine_of_the_lumped_robot_is_what_is_left_when_splits_are_eliminated(
    tmp_path: Path,
) -> None:
    path = machine(tmp_path)
    robot, lumped = load(path, ft_joints=SENSORS[1:3]), load(path)
    offered = candidates(robot, FEET, ft_sensors=SENSORS[1:3])
    stack = MotionStack(robot, FEET, STATES, offered)
    chosen = [c for c in offered if c.kind == "ft_sensor"]
    problem = stack.problem(sensor_set(robot, FEET, chosen), friction=False)
    inertial = np.flatnonzero(np.arange(problem.A.shape[1]) % parameters.PER_BODY < parameters.INERTIAL.stop)
    lump = np.zeros((10 * len(lumped.bodies), problem.A.shape[1]))
    for index, body in enumerate(robot.bodies):
        home, T = lumped.links[body.name]
        X = parameters.change_of_frame(T)
        lump[10 * home : 10 * home + 10, 12 * index : 12 * index + 10] = X
    np.testing.assert_allclose(lump @ robot.nominal.flatten(), lumped.nominal[:, :10].flatten(), rtol=0.0, atol=1e-12)
    _, values, Vt = np.linalg.svd(lump[:, inertial])
    splits = Vt[(values > 1e-9).sum() :].T
    A = problem.A[:, inertial] / np.linalg.norm(problem.A, 2)
    hidden = A @ splits
    rest = A - hidden @ np.linalg.pinv(hidden, rcond=1e-9) @ A
    assert stack.rank(chosen) == np.linalg.matrix_rank(rest, tol=1e-9)
