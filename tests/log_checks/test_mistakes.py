"""Mistakes of sign, frame, unit and order in logs of robots that walk and arms that swing: who names which."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from faults import demo_log, of_demo, only
from flying import flight
from mistaken import MISTAKES, NAMED, SENSORS, Cell, case_of, cells, checked, judged
from motions import value
from thinned import study_but
from walking import MACHINES, robot_of, truth

from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Finding, Skipped
from torchid.log_checks.contacts import check_accelerometer
from torchid.log_checks.mistakes import exchanged_names
from torchid.log_checks.standing_feet import measure_foot_slip

EXPLAINED = "unit, sign or frame"
BY_NAME = {mistake.name: mistake for mistake in MISTAKES}
#: Cells of the whole table that are not named, and why: see docs/results.md.
UNNAMED = {("wrenches about another point", "biped", "contacts")}
#: Of a robot that walks upright along the world's x axis, with all sensors.
UPRIGHT = study_but(
    ["quaternion w last for first", "time in minutes", "moments reversed"],
    ["world downward", "contact flags left for right", "quaternion w last for first", "quaternion inverse"]
    + ["time x 2", "time in minutes", "one torque x 1.3", "torques of limbs exchanged", "moments reversed"],
)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", UPRIGHT)
def test_a_mistake_in_the_log_of_a_biped_that_walks_upright_is_named(name: str) -> None:
    case = case_of(MACHINES["biped"], "full", heading=0.0)
    found = checked(case, value(BY_NAME[name].make(case)))
    assert BY_NAME[name].named(found), [(x.name, x.field, x.found) for x in found.findings]


@pytest.mark.parametrize("name", ["one torque x 1.3", "time x 2", "joints swapped"])
def test_a_mistake_in_the_log_of_an_arm_is_named(name: str) -> None:
    case = case_of(MACHINES["arm"], "contacts")
    assert BY_NAME[name].named(checked(case, value(BY_NAME[name].make(case))))


def test_an_accelerometer_is_told_from_the_world_by_where_the_feet_are_and_by_its_mean() -> None:
    case = case_of(MACHINES["quadruped"], "joints")
    of_gravity = ("with gravity twice", "without gravity", "along the world's axes")
    for name in ("accelerometer reversed", "world downward", *(f"accelerometer {one}" for one in of_gravity)):
        assert BY_NAME[name].named(checked(case, value(BY_NAME[name].make(case)))), name


def test_feet_that_stand_do_not_move_and_tell_nothing_of_a_base_that_stands_still() -> None:
    machine = MACHINES["biped"]
    case, robot = case_of(machine, "full", heading=0.0), robot_of(machine)
    assert value(measure_foot_slip(case.log, robot, machine.contacts)) < 0.02
    still = case.log.select(np.zeros(400, np.intp))
    still = replace(still, time=np.arange(400) / 200.0)
    assert measure_foot_slip(still, robot, machine.contacts) is None


@pytest.mark.parametrize(
    ("names", "other"),
    [
        (("l_sole", "r_sole"), ("r_sole", "l_sole")),
        (("LAnkle", "RAnkle", "Neck"), ("RAnkle", "LAnkle", "Neck")),
        (("FL_foot", "FR_foot", "RL_foot", "RR_foot"), ("FR_foot", "FL_foot", "RR_foot", "RL_foot")),
        (("leg_left_1", "leg_right_1"), ("leg_right_1", "leg_left_1")),
    ],
)
def test_sides_are_exchanged_by_name(names: tuple[str, ...], other: tuple[str, ...]) -> None:
    assert next(exchanged_names(names)) == ("left and right", other)


@pytest.mark.parametrize(
    ("names", "limbs", "pairs"),
    [
        (("leg1/yaw", "leg1/lift", "leg2/yaw", "leg2/lift", "leg3/yaw", "leg3/lift"), "leg1 and leg3", 4),
        (tuple(f"{x}_{y}" for x in ("lf", "rf", "lh", "rh") for y in ("haa", "kfe")) + ("tail",), "lf and lh", 7),
        (("joint1", "joint2", "joint3"), "", 0),  # of a chain, whose neighbours are tried
    ],
)
def test_two_limbs_among_others_are_exchanged_by_name(names: tuple[str, ...], limbs: str, pairs: int) -> None:
    found = {what: other for what, other in exchanged_names(names) if what.split()[0] not in ("left", "front", "the")}
    assert len(found) == pairs
    one, _, other = limbs.partition(" and ")
    if pairs:
        assert [name.replace(one, "?").replace(other, one).replace("?", other) for name in names] == list(found[limbs])


def test_names_without_sides_have_none_to_exchange() -> None:
    assert "left and right" not in [what for what, _ in exchanged_names(("shell", "roller", "elbow"))]
    assert list(exchanged_names(("one",))) == []


@pytest.mark.study
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("machine", MACHINES)
def test_who_names_which_mistake(machine: str) -> None:
    found: list[Cell] = list(cells([MACHINES[machine]]))
    assert {cell.sensors for cell in found} == set(SENSORS)
    unnamed = {(cell.mistake, cell.machine, cell.sensors) for cell in found if cell.check not in (NAMED, "-")}
    assert unnamed == {cell for cell in UNNAMED if cell[1] == machine}


@pytest.mark.study
def test_forty_logs_of_robots_unlike_their_urdf_give_no_alarm() -> None:
    alarms = []
    for seed in range(1, 11):
        for place, (name, machine) in enumerate(MACHINES.items()):
            sensors = SENSORS[(seed + place) % len(SENSORS)]
            case = case_of(machine, sensors, seed)
            found = [one.found for one in checked(case, case.log).findings if one.severity != NOTE]
            alarms += [(name, sensors, seed, text) for text in found]
            truth.cache_clear()
    assert alarms == []


def test_a_finding_that_the_clean_log_has_too_does_not_count() -> None:
    case = case_of(MACHINES["arm"], "contacts")
    clean = checked(case, case.log)
    assert judged(BY_NAME["one torque x 1.3"], clean, clean) == "silent"


def test_two_legs_that_are_exchanged_beside_two_that_are_not_are_named() -> None:
    log = demo_log().select(slice(0, 600))
    one, other = "front_left", "rear_right"
    names = tuple(name.replace(one, "?").replace(other, one).replace("?", other) for name in log.joint_names)
    explained = only(of_demo(replace(log, joint_names=names)), EXPLAINED)
    assert (explained.severity, explained.field) == (REJECTED, "joint_names")
    assert explained.found.startswith(f"{other} and {one} exchanged: ")  # in the order of the log


@pytest.mark.parametrize(("drone", "severity"), [("hextilt", SUSPICIOUS), ("borinot", NOTE)])
def test_moments_about_another_point_are_no_mistake_where_the_centre_of_mass_may_be_there(
    drone: str, severity: str
) -> None:
    """100 mm are more than the radius of gyration of the first base (52 mm), and less than that of the second (133)."""
    case = flight(drone, "contacts", 31)
    found = only(checked(case, value(BY_NAME["wrenches about another point"].make(case))), "point")
    assert found.severity == severity
    assert ("centre of mass may have this error" in found.advice) is (severity == NOTE)


def test_the_order_of_a_drones_quaternion_is_named_though_its_small_moments_are_far_off_the_urdfs() -> None:
    case = flight("borinot", "contacts", 1)
    assert not [one for one in checked(case, case.log).findings if one.severity != NOTE]
    explained = only(checked(case, value(BY_NAME["quaternion w first for last"].make(case))), EXPLAINED)
    assert (explained.severity, explained.field) == (REJECTED, "base_quat_xyzw")
    assert explained.found.startswith("wrong order: w first and w last are confused: ")


def test_gravity_of_a_drone_that_accelerates_as_much_is_told_by_its_mean_along_the_worlds_axes() -> None:
    case = flight("borinot", "joints", 2)
    robot, without = robot_of(case.machine), value(BY_NAME["accelerometer without gravity"].make(case))
    size = float(np.median(np.linalg.norm(value(without.imu_specific_force), axis=1)))
    assert 8.0 < size < 10.0
    (known,) = check_accelerometer(case.log, robot)
    assert isinstance(known, Skipped)
    for name in ("without gravity", "with gravity twice"):
        mistake = BY_NAME[f"accelerometer {name}"]
        (found,) = check_accelerometer(value(mistake.make(case)), robot)
        assert isinstance(found, Finding)
        assert found.severity == REJECTED
        assert re.search(mistake.words, found.found)
