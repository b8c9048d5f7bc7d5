"""The planner finds what trying every set with the projection finds: the cheapest, and all that spare no sensor."""

from __future__ import annotations

import math
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning import MACHINES, RANDOM, Machine, axes_and_devices, minimal_of, states_of, subsets, sufficient_sets, tried
from synthetic import G1, load

from torchid.errors import SensorError
from torchid.sensing import Contact
from torchid.sensor_planning.observability import candidates, demands
from torchid.sensor_planning.search import all_minimal_sets, bound_cost, cheapest_set, demand_groups

machines = pytest.mark.parametrize("name", MACHINES)


@machines
def test_all_sets_without_a_sensor_to_spare_are_those_that_trying_every_set_finds(name: str) -> None:
    machine, (robot, choice, sufficient) = MACHINES[name], tried(name)
    assert len(choice) <= 12
    wanted = demands(robot, machine.contacts, machine.states, choice)
    parts = [all_minimal_sets(part.demands, part.candidates) for part in demand_groups(wanted, choice)]
    assert all(sets is not None for sets in parts)
    found = [frozenset().union(*sets) for sets in product(*parts)]  # type: ignore[arg-type]
    assert len(set(found)) == len(found)
    assert set(found) == minimal_of(sufficient, choice)
    for sets in parts:
        assert [len(s) for s in sets or ()] == sorted(len(s) for s in sets or ())


@machines
def test_the_cheapest_set_costs_what_the_cheapest_of_all_costs_and_is_proven(name: str) -> None:
    machine, (robot, bare, sufficient) = MACHINES[name], tried(name)
    minimal, rng = minimal_of(sufficient, bare), np.random.default_rng(len(name))
    for prices in (None, rng.integers(1, 6, len(bare)), rng.uniform(0.5, 5.0, len(bare))):
        costs = None if prices is None else dict(zip([c.name for c in bare], map(float, prices), strict=True))
        choice = axes_and_devices(machine, robot, costs)
        wanted = demands(robot, machine.contacts, machine.states, choice)
        least = cheapest_set(wanted, choice)
        price = {c.name: c.cost for c in choice}
        expected = min(sum(price[c.name] for c in chosen) for chosen in minimal)
        assert least.proven
        assert least.lower_bound == pytest.approx(expected, rel=1e-9)
        assert least.cost == pytest.approx(sum(c.cost for c in least.chosen), rel=1e-12) == expected
        assert {c.name for c in least.chosen} in [{c.name for c in chosen} for chosen in minimal]


@machines
def test_kept_sensors_stay_excluded_ones_go_and_the_rest_is_the_cheapest_again(name: str) -> None:
    machine, (robot, choice, sufficient) = MACHINES[name], tried(name)
    wanted = demands(robot, machine.contacts, machine.states, choice)
    member = subsets(len(choice))
    size = member @ [c.cost for c in choice]
    for kept, gone in ((0, len(choice) - 1), (len(choice) - 1, 0), (1, 2)):
        allowed = sufficient & member[:, kept] & ~member[:, gone]
        if not allowed.any():
            with pytest.raises(SensorError, match="all together do not determine"):
                cheapest_set(wanted, choice, keep=[choice[kept]], exclude=[choice[gone]])
            continue
        least = cheapest_set(wanted, choice, keep=[choice[kept]], exclude=[choice[gone]])
        assert choice[kept] in least.chosen
        assert choice[gone] not in least.chosen
        assert least.lower_bound == pytest.approx(least.cost) == pytest.approx(size[allowed].min())


@st.composite
def trees(draw: st.DrawFn) -> Machine:
    """A trunk and two limbs of a few joints of any kind, with one or two contacts anywhere."""
    axis = st.sampled_from(["x", "y", "z", RANDOM, "slide x", "slide z"])
    count = [draw(st.integers(0, 2)), draw(st.integers(1, 3)), draw(st.integers(1, 2))]
    trunk, left, right = (tuple(draw(st.lists(axis, min_size=n, max_size=n))) for n in count)
    top = f"trunk{len(trunk)}" if trunk else "base"
    chains = {"trunk": ("base", trunk), "left": (top, left), "right": (top, right)}
    links = ["base", *(f"{name}{k + 1}" for name, (_, axes) in chains.items() for k in range(len(axes)))]
    frames = draw(st.lists(st.sampled_from(links[1:]), min_size=1, max_size=2, unique=True))
    per = draw(st.sampled_from(["axis", "device"]))
    kinds = ["point"] if per == "axis" and len(frames) == 2 else ["point", "line", "flat"]
    contacts = tuple(Contact(frame, draw(st.sampled_from(kinds))) for frame in frames)
    states = states_of("1") if len(frames) == 1 else draw(st.sampled_from([states_of("11"), states_of("10", "11")]))
    return Machine(chains, contacts, states, per, draw(st.integers(0, 99)))


@given(trees(), st.integers(0, 2**20))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_the_bound_is_the_least_cost_on_any_small_tree(machine: Machine, seed: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        robot = machine.robot(Path(folder))
        names = [c.name for c in axes_and_devices(machine, robot)]
        prices = np.random.default_rng(seed).integers(1, 5, len(names)).astype(float)
        choice = axes_and_devices(machine, robot, dict(zip(names, prices, strict=True)))
        sufficient = sufficient_sets(machine, robot, choice)
    wanted = demands(robot, machine.contacts, machine.states, choice)
    expected = float((subsets(len(choice)) @ prices)[sufficient].min())
    least = cheapest_set(wanted, choice)
    assert (least.cost, least.proven) == (expected, True)
    assert least.lower_bound == pytest.approx(expected)
    for demand in wanted:
        alone = bound_cost(demand, choice)
        assert alone.bound == sum(c.cost for c in alone.chosen) == cheapest_set([demand], choice).cost
        assert alone.bound <= expected
    if len(wanted) == 1:
        assert alone.bound == expected


def test_too_many_candidates_to_enumerate_are_refused_and_too_little_time_leaves_a_set_with_a_bound() -> None:
    robot = load(G1)
    hands = [Contact("left_rubber_hand", "flat"), Contact("right_rubber_hand", "flat")]
    choice = candidates(robot, hands, per="axis", costs={"left_elbow_joint": 1.3, "joint_torque": 1.1})
    wanted = demands(robot, hands, states_of("11", "10"), choice)
    (part,) = demand_groups(wanted, choice)
    assert len(part.candidates) == 3 + 2 * 7 + 12
    assert all_minimal_sets(part.demands, part.candidates) is None
    hurried = cheapest_set(wanted, choice, seconds=0.0)
    assert all_minimal_sets(part.demands, hurried.chosen) == [hurried.chosen]
    assert 0.0 < hurried.lower_bound <= hurried.cost
    assert hurried.proven == math.isclose(hurried.lower_bound, hurried.cost)
