"""Contacts, sensor sets by name, and the check that the sensors see the base."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from synthetic import ANYMAL, UR5, Oracle, load, make_log

from torchid.errors import BaseLostError, BaseLostWarning, SensorError, UnknownNameError, about_file
from torchid.identifiability.base_parameters import (
    StateReport,
    merge_state_reports,
    require_base,
    state_reports,
)
from torchid.problem import RowBuilder, bind_log
from torchid.sensing import Contact, SensorNoise, SensorSet, chosen_sensors, named_sensors, validate_contacts
from torchid.sensing.sensors import minimized_errors

FEET = [Contact(f"{leg}_FOOT", "point") for leg in ("LF", "RF", "LH", "RH")]
JOINTS = ("hip", "knee", "ankle")
SOLES = (Contact("l_sole", "flat"), Contact("r_sole", "point"))


def test_a_contact_pushes_only_as_its_kind_can() -> None:
    assert Contact("foot", "point").component_names == ("fx", "fy", "fz")
    assert Contact("foot", "flat").component_names == ("fx", "fy", "fz", "mx", "my", "mz")
    for axis in "xyz":
        moments = tuple(f"m{other}" for other in "xyz" if other != axis)
        assert Contact("foot", "line", axis).component_names == ("fx", "fy", "fz", *moments)
    assert Contact("foot", "line") == Contact("foot", "line", "y")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("full", "errors of joint torques and base forces"),
        ("contacts", "errors of base forces, independent of joint torque"),
        ("joints", "errors of joint torques and base forces, independent of contact force"),
    ],
)
def test_a_set_says_what_errors_it_minimizes(name: str, says: str) -> None:
    robot = load(ANYMAL)
    assert minimized_errors(robot, FEET, named_sensors(name, robot.n, len(FEET))) == says


def test_what_is_unmeasured_of_some_sensors_is_named() -> None:
    robot = load(ANYMAL)
    sensors = chosen_sensors(robot.joint_names, FEET, robot.joint_names[2:], {"LF_FOOT": ["fx", "fy", "fz"]})
    hidden = f"torque of {', '.join(robot.joint_names[:2])} and unmeasured force at RF_FOOT, LH_FOOT, RH_FOOT"
    says = f"errors of joint torques and base forces, independent of {hidden}"
    assert minimized_errors(robot, FEET, sensors) == says
    arm = load(UR5, fixed_base=True)
    assert minimized_errors(arm, [], named_sensors("joints", arm.n, 0)) == "errors of joint torques"


@pytest.mark.parametrize(
    ("contacts", "error", "message"),
    [
        ([Contact("LF_FOO", "point")], UnknownNameError, r"contacts\[0\].frame: unknown name 'LF_FOO'; .*LF_FOOT"),
        ([*FEET, FEET[2]], SensorError, r"contacts\[4\].frame: 'LH_FOOT' named twice; accepted: each frame once"),
    ],
    ids=["unknown", "twice"],
)
def test_a_contact_that_cannot_be_is_refused_by_its_place(
    contacts: list[Contact], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as raised, about_file("experiment.yaml"):
        validate_contacts(load(ANYMAL), contacts)
    assert "experiment.yaml" in str(raised.value)


def test_a_contact_of_an_unknown_kind_cannot_be_made() -> None:
    with pytest.raises(SensorError, match="contact 'RF_FOOT': type: 'Flat'; accepted: point, line, flat"):
        Contact("RF_FOOT", "Flat")
    with pytest.raises(SensorError, match="contact 'LF_FOOT': line_axis: 'w'; accepted: x, y, z"):
        Contact("LF_FOOT", "line", "w")


@pytest.mark.parametrize(("name", "torque", "wrench"), [("full", 1, 1), ("contacts", 0, 1), ("joints", 1, 0)])
def test_named_sets_are_masks(name: str, torque: bool, wrench: bool) -> None:
    sensors = named_sensors(name, 5, 2)
    np.testing.assert_array_equal(sensors.torque, np.full(5, bool(torque)))
    np.testing.assert_array_equal(sensors.wrench, np.full((2, 6), bool(wrench)))
    assert sensors.torque.dtype == sensors.wrench.dtype == np.bool_
    assert sensors.noise == SensorNoise()


def test_another_name_is_refused_by_the_three_that_exist() -> None:
    with pytest.raises(SensorError, match="'joint'; accepted: full, contacts, joints, or a mapping"):
        named_sensors("joint", 5, 2)


def test_chosen_sensors_stand_where_their_names_do_in_any_order() -> None:
    noise = SensorNoise(joint_torque=3.0)
    chosen = chosen_sensors(JOINTS, SOLES, ["ankle", "hip"], {"r_sole": ["fz"], "l_sole": ["mz", "fx"]}, noise)
    np.testing.assert_array_equal(chosen.torque, [True, False, True])
    np.testing.assert_array_equal(np.argwhere(chosen.wrench), [[0, 0], [0, 5], [1, 2]])
    assert chosen.noise is noise
    nothing = chosen_sensors(JOINTS, SOLES, [], {})
    assert not nothing.torque.any()
    assert not nothing.wrench.any()


@pytest.mark.parametrize(
    ("torques", "wrenches", "error", "message"),
    [
        (["kneee"], {}, UnknownNameError, "sensors.joint_torques: unknown name 'kneee'; accepted: knee"),
        ([], {"r_sol": ["fx"]}, UnknownNameError, "sensors.contact_wrenches: unknown name 'r_sol'; accepted: r_sole"),
        ([], {"l_sole": ["tx"]}, UnknownNameError, "contact_wrenches.l_sole: unknown name 'tx'; accepted: .*fx"),
        ([], {"r_sole": ["mz"]}, SensorError, "r_sole: 'mz' does not exist at a point contact; accepted: fx, fy, fz"),
    ],
    ids=["joint", "contact", "component", "impossible component"],
)
def test_a_sensor_that_does_not_exist_is_refused_by_the_nearest_names(
    torques: list[str], wrenches: dict[str, list[str]], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        chosen_sensors(JOINTS, SOLES, torques, wrenches)


# --------------------------------------------------------------------------------------------------------- the base


def reports(torques: bool, first_foot: bool) -> list[StateReport]:
    """Of a quadruped that stands on three feet half the time, on four a third, and flies for the rest."""
    robot = load(ANYMAL)
    states = [[True] * 4, [False, True, True, True], [False, True, True, True], [False, True, True, True],
              [True] * 4, [False] * 4]  # fmt: skip
    rng = np.random.default_rng(0)
    log = make_log(Oracle.of(robot), [(foot.frame, 3) for foot in FEET], states, 60, rng)
    wrench = np.zeros((4, 6), dtype=bool)
    wrench[0, :3] = first_foot
    sensors = SensorSet(np.full(robot.n, torques), wrench)
    return state_reports([bind_log(log, robot, FEET)], RowBuilder(robot, FEET, sensors))


def test_torque_sensors_see_the_base_in_every_contact_state() -> None:
    three, four, flight = reports(torques=True, first_foot=False)
    assert (three.name, three.samples, three.rows) == ("RF_FOOT + LH_FOOT + RH_FOOT", 30, 18 - 9)
    assert (four.name, four.samples, four.rows) == ("LF_FOOT + RF_FOOT + LH_FOOT + RH_FOOT", 20, 18 - 12)
    assert (flight.name, flight.samples, flight.rows) == ("none", 10, 18)
    assert three.base_rank == four.base_rank == flight.base_rank == 6
    assert flight.base_singular_value == pytest.approx(1.0, abs=1e-14)
    assert four.base_singular_value is not None
    assert 1e-6 < four.base_singular_value < 1.0
    require_base([three, four, flight])


def test_one_measured_foot_among_four_sees_nothing_of_the_base_but_in_flight() -> None:
    three, four, flight = reports(torques=False, first_foot=True)
    assert (three.base_rank, three.rows) == (0, 0)
    assert (four.base_rank, four.rows) == (0, 0)
    assert (flight.base_rank, flight.rows) == (6, 6)
    with pytest.raises(
        BaseLostError, match="RF_FOOT \\+ LH_FOOT \\+ RH_FOOT \\(30 samples\\): rank 0 of 6; "
    ) as raised:
        require_base([three, four, flight])
    assert "LF_FOOT + RF_FOOT + LH_FOOT + RH_FOOT (20 samples): rank 0 of 6" in str(raised.value)
    assert "none" not in str(raised.value)
    assert "accepted:" in str(raised.value)


def test_who_asks_to_go_on_is_warned() -> None:
    lost = reports(torques=False, first_foot=True)
    with pytest.warns(BaseLostWarning, match="30 samples.*do not determine the parameters of some bodies"):
        require_base(lost, "warn")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        require_base([lost[2]], "warn")


def test_the_axes_of_line_contacts_are_named_where_the_base_is_lost() -> None:
    lost = [StateReport("l_blade + r_sole", 9, 2, 4, 0.0), StateReport("r_blade + r_sole", 9, 4, 6, 0.1)]
    contacts = [Contact("l_blade", "line", "x"), Contact("r_blade", "line"), Contact("r_sole", "point")]
    with pytest.raises(BaseLostError, match="along x of l_blade, or set line_axis; accepted: more"):
        require_base(lost, contacts=contacts)
    with pytest.raises(BaseLostError) as raised:
        require_base(lost, contacts=contacts[2:])
    assert "line_axis" not in str(raised.value)


def test_a_sample_of_a_long_log_counts_as_one_of_a_short_log() -> None:
    short = [StateReport("stand", 1, 6, 2, value, 0.0, {2: 1.0}) for value in (0.0, 0.1, 0.4)]
    long = StateReport("stand", 9, 8, 6, 0.3, 1.0, {6: 1.0})
    for logs in ([*short, long], [long, *short[::-1]]):
        (report,) = merge_state_reports([[log] for log in logs])
        assert (report.samples, report.rows, report.base_rank, report.base_singular_value) == (12, 8, 6, 0.3)
        assert report.base_rank_shares == {6: pytest.approx(0.75), 2: pytest.approx(0.25)}
        assert report.base_full_share == pytest.approx(0.75)
    (report,) = merge_state_reports([[log] for log in short])
    assert (report.base_rank, report.base_singular_value, report.base_full_share) == (2, 0.1, 0.0)
    (report,) = merge_state_reports([[replace(long, samples=3)], *([log] for log in short)])
    assert report.base_rank == 6, "which half of the samples reach"
