"""Contacts detected from joint torques: those of simulated walkers, whatever else was recorded, and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from faults import CONTACTS, demo_log, demo_robot
from legged.gait import Reference
from legged.recording import Noise, record
from legged.robots import FRICTION_WIDTH, G1, GO2, QUADRUPED, Legged, TrueRobot
from legged.simulate import Exact, simulated
from motions import value
from refusals import refused
from stances import stance
from synthetic import Array, Oracle, load
from thinned import STUDY
from walkers import INSTALLED, WALKERS
from walking import robot_of

from torchid.errors import LogError, UnknownNameError
from torchid.log_checks.check import check
from torchid.logs import Log
from torchid.logs.preprocess import away_from_stamps, find_unloaded
from torchid.problem import Samples, contact_detection
from torchid.problem.contact_detection import (
    DetectionConfig,
    ForcesAlongNormals,
    detect_contacts,
    prepare,
    with_detected_contacts,
)
from torchid.problem.rows import RowBuilder
from torchid.robot import Robot
from torchid.sensing import Contact

SECONDS, AGREEING = 5.0, 0.97
DEFAULT = DetectionConfig()
ONCE = DetectionConfig(refit=False)
NO_IMU = {"imu_frame": "", "imu_specific_force": None, "imu_angular_velocity": None}
NO_BASE = NO_IMU | {"base_quat_xyzw": None, "contact_wrench_world": None}


@cache
def walked(legged: Legged, seconds: float = SECONDS, seed: int = 0) -> tuple[TrueRobot, Exact]:
    """Crawls and trots, or steps, of a robot whose masses, friction and armature are not its URDF's."""
    true = TrueRobot.unlike_its_urdf(legged, seed)
    return true, simulated(true, Reference(true, seconds, seed=seed), seconds)


@cache
def noisy(legged: Legged, seconds: float = SECONDS, seed: int = 0) -> Log:
    true, exact = walked(legged, seconds, seed)
    return record(exact, true.robot.base_link, Noise(), np.random.default_rng(seed))


@cache
def flags(legged: Legged, seconds: float = SECONDS, seed: int = 0) -> Array:
    """What is detected in the noisy recording, (N, C)."""
    return detect_contacts(
        noisy(legged, seconds, seed), walked(legged, seconds, seed)[0].robot, legged.contacts(), DEFAULT
    ).active


def agreement(found: Array, true: Array, margin: int) -> tuple[float, float]:
    """Share of flags that agree, and of samples whose flags all do further than a margin from a detected change."""
    kept = np.ones(len(found), dtype=bool)
    for change in np.flatnonzero((found[1:] != found[:-1]).any(axis=1)):
        kept[max(0, change - margin + 1) : change + margin + 1] = False
    assert kept.mean() > 0.7
    return float((found == true).mean()), float((found == true)[kept].all(axis=1).mean())


def assert_agrees(legged: Legged, seconds: float, seed: int, least: float) -> None:
    true, exact = walked(legged, seconds, seed)
    active = value(exact.log.contact_active)
    assert 0.05 < 1.0 - active.mean() < 0.5, "feet must be in the air for a while"
    found = flags(legged, seconds, seed)
    margin = round(DEFAULT.margin_s / float(np.median(np.diff(exact.log.time))))
    each, together = agreement(found, active, margin)
    assert each >= least
    assert together >= least


@pytest.mark.parametrize("legged", [*WALKERS[1:], pytest.param(GO2, id="Go2", marks=[INSTALLED, STUDY])])
def test_flags_of_a_noisy_recording_are_those_of_the_simulator(legged: Legged) -> None:
    assert_agrees(legged, SECONDS, 0, AGREEING)


@pytest.mark.study
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("legged", WALKERS[:2])
def test_flags_of_a_long_noisy_recording_are_those_of_the_simulator(legged: Legged, seed: int) -> None:
    assert_agrees(legged, 20.0, seed, AGREEING)  # 0.977 to 0.988 measured


def test_a_foot_that_keeps_still_stands_however_little_it_carries() -> None:
    """One foot carries 2 % of G1 for a second."""
    true, exact = walked(G1)
    active = value(exact.log.contact_active)

    def missed(log: Log, light: float) -> float:
        found = detect_contacts(log, true.robot, G1.contacts(), replace(ONCE, light=light)).active
        return float((active & ~found).sum() / active.sum())

    by_load = 1.0
    assert missed(exact.log, DEFAULT.light) < 0.2 * missed(exact.log, by_load)
    assert missed(noisy(G1), DEFAULT.light) < 0.5 * missed(noisy(G1), by_load)  # whose speeds are against other feet
    without = replace(noisy(G1), **NO_BASE)
    assert missed(without, DEFAULT.light) == missed(without, by_load), "no speed without the base's angular velocity"


@pytest.mark.parametrize("legged", [WALKERS[0], pytest.param(G1, id="G1", marks=[INSTALLED, STUDY])])
def test_masses_that_are_fitted_in_between_leave_no_foot_that_stands_unnoticed(legged: Legged) -> None:
    true, exact = walked(legged)
    active = value(exact.log.contact_active)

    def missed(settings: DetectionConfig) -> int:
        found = detect_contacts(exact.log, true.robot, legged.contacts(), settings)
        return int(((active & ~found.active).any(axis=1) & found.certain).sum())

    assert missed(ONCE) > 0
    assert missed(DEFAULT) <= 0.25 * missed(ONCE)


@pytest.mark.parametrize("legged", [WALKERS[1], pytest.param(GO2, id="Go2", marks=[INSTALLED, STUDY])])
def test_contacts_that_may_stand_leave_nothing_that_carries_out_of_more_samples(legged: Legged) -> None:
    true, exact = walked(legged)
    found = detect_contacts(exact.log, true.robot, legged.contacts(), DEFAULT)
    assert (found.possible | ~found.active).all()
    assert (found.clear | ~found.certain).all()
    kept = []
    for flags, trusted in (found.flags(possible=False), found.flags(possible=True)):
        away = away_from_stamps(exact.log.time, exact.log.time[~trusted], DEFAULT.margin_s)
        missed = (value(exact.log.contact_active) & ~flags).any(axis=1) & away
        assert missed.mean() < 0.001
        kept.append(away.mean())
    assert kept[1] > kept[0] + 0.05


def test_a_foot_that_the_floor_pulls_is_not_taken_for_one_in_the_air() -> None:
    """The demo's, which hold on to it: where one is lifted, the one across pulls with up to 40 % of the weight."""
    log = demo_log()
    standing = value(log.contact_active)[:, [log.contact_names.index(one.frame) for one in CONTACTS]]
    found = detect_contacts(log, demo_robot(), CONTACTS, DEFAULT)
    flags, trusted = found.flags(possible=True)
    assert trusted.mean() > 0.9
    assert not (standing & ~flags)[trusted].any()
    assert (flags == standing)[trusted].mean() > AGREEING - 0.02
    flags, trusted = found.flags(possible=False)
    assert trusted.mean() > 0.8
    assert (standing & ~flags)[trusted].mean() < 1e-3


@pytest.mark.study
@INSTALLED
def test_parameters_of_the_wider_filter_show_a_foot_that_hardly_touches(monkeypatch: pytest.MonkeyPatch) -> None:
    """A foot of G1 touches for 80 ms with less than 0.8 % of the weight, which parameters of 20 Hz are not good for."""
    true, exact = walked(G1, 20.0, 24)
    time, active = exact.log.time, value(exact.log.contact_active)

    def missed() -> int:
        found = detect_contacts(exact.log, true.robot, G1.contacts(), DEFAULT, sign_width=FRICTION_WIDTH)
        flags, clear = found.flags(possible=True)
        kept = away_from_stamps(time, time[~clear], DEFAULT.margin_s)
        return int(((active & ~flags).any(axis=1) & kept).sum())

    assert missed() == 0
    monkeypatch.setattr(contact_detection, "_FITS", 1)
    assert missed() > 0


@pytest.mark.parametrize(("share", "is_clear"), [(0.05, False), (0.015, True)], ids=["impact", "light"])
def test_a_foot_that_scuffs_the_floor_for_a_moment_is_not_certain(share: float, is_clear: bool) -> None:
    """For 6 ms a foot in the air carries a share of the weight, which no force filtered to 20 Hz shows."""
    true, exact = walked(QUADRUPED)
    log, contacts = exact.log, QUADRUPED.contacts()
    clean = detect_contacts(log, true.robot, contacts, DEFAULT)
    away = find_unloaded(log.time, value(log.contact_active) | clean.active, 0.05)
    foot = int(away.sum(axis=0).argmax())
    sure = away[:, foot] & clean.certain & away_from_stamps(log.time, log.time[~clean.certain], 0.05)
    middle = int(np.flatnonzero(sure)[sure.sum() // 2])
    oracle, wrench = Oracle.of(true.robot), np.zeros(3)
    wrench[2] = share * 9.81 * float(true.robot.nominal[:, 0].sum())
    torque = value(log.joint_torque).copy()
    frames = slice(middle, middle + 3)
    pose = np.concatenate([value(log.base_position_world), value(log.base_quat_xyzw), log.joint_position], axis=1)
    J, R = oracle.jacobian(pose[frames], contacts[foot].frame), oracle.pose(pose[frames], contacts[foot].frame)[0]
    torque[frames] -= np.einsum("bij,bi->bj", J[:, :3, 6:], np.einsum("bji,j->bi", R, wrench))
    scuffed = replace(log, joint_torque=torque)
    found = detect_contacts(scuffed, true.robot, contacts, DEFAULT)
    assert not found.certain[frames].any()
    assert found.clear[frames].all() == is_clear, "impacts are dropped, nothing else if it counts as standing"
    assert found.possible[frames, foot].all()
    assert detect_contacts(scuffed, true.robot, contacts, ONCE).certain[frames].all()


def test_no_parameters_are_fitted_where_something_else_carries_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    weight = 9.81 * float(robot_of(stance("quadruped").machine).nominal[:, 0].sum())
    robot = robot_of(stance("quadruped").machine)
    fitted = list[int]()

    def fit(samples: Samples, _: RowBuilder, robot: Robot) -> tuple[Array, Array]:
        fitted.append(len(samples))
        return robot.nominal, np.zeros(robot.n)

    monkeypatch.setattr(contact_detection, "fitted_parameters", fit)
    for carried, expected in ((0.01, []), (0.25, [180])):  # on its belly, on its feet; less both ends
        log, contacts = still(np.full(4, carried * weight))
        detect_contacts(replace(log, base_position_world=np.zeros((len(log), 3))), robot, contacts, DEFAULT)
        assert fitted == expected


def normal_forces(log: Log, robot: Robot, contacts: Sequence[Contact], cutoff_hz: float) -> tuple[Array, Array]:
    """Stamps (K,) [s] of a filtered log, and forces (K, C) [N] along the ground's normal."""
    whole = prepare(log, robot, contacts, cutoff_hz)
    return whole.log.time, ForcesAlongNormals.of(whole, robot, contacts).of_samples(whole)


def test_samples_whose_flags_may_be_wrong_are_not_certain() -> None:
    """Both ends are known to a filter's period, and stances too short to count are in doubt."""
    true, exact = walked(QUADRUPED)
    found = detect_contacts(noisy(QUADRUPED), true.robot, QUADRUPED.contacts(), ONCE)
    time = exact.log.time - exact.log.time[0]
    ends = (time < 2.0 / DEFAULT.cutoff_hz - 0.01) | (time > time[-1] - 2.0 / DEFAULT.cutoff_hz + 0.01)
    assert not found.certain[ends].any()
    assert found.certain[~ends].mean() > 0.9
    stamps, forces = normal_forces(noisy(QUADRUPED), true.robot, QUADRUPED.contacts(), DEFAULT.cutoff_hz)
    samples = np.searchsorted(exact.log.time, stamps - 1e-9)
    weight = 9.81 * float(true.robot.nominal[:, 0].sum())
    doubtful = ((forces > DEFAULT.touch * weight) & ~found.active[samples]).any(axis=1)
    assert doubtful.any(), "impacts and swings load a foot for a moment"
    assert not found.certain[samples][doubtful].any()


@pytest.mark.parametrize(
    ("legged", "recorded"),
    [
        pytest.param(GO2, NO_IMU, id="Go2, orientation alone", marks=INSTALLED),
        pytest.param(GO2, NO_BASE, id="Go2, nothing of the base", marks=[INSTALLED, STUDY]),
        pytest.param(QUADRUPED, NO_IMU, id="quadruped, orientation alone", marks=STUDY),
        pytest.param(QUADRUPED, NO_BASE, id="quadruped, nothing of the base"),
    ],
)
def test_point_feet_are_told_without_an_imu(legged: Legged, recorded: dict[str, None]) -> None:
    true, exact = walked(legged)
    found = detect_contacts(replace(noisy(legged), **recorded), true.robot, legged.contacts(), DEFAULT).active
    each, _ = agreement(found, value(exact.log.contact_active), 10)
    assert each >= AGREEING


def test_armature_and_friction_are_not_taken_for_loads() -> None:
    true, exact = walked(QUADRUPED)
    stamps, found = normal_forces(noisy(QUADRUPED), true.robot, QUADRUPED.contacts(), DEFAULT.cutoff_hz)
    samples = np.searchsorted(exact.log.time, stamps - 1e-9)
    air = ~value(exact.log.contact_active)[samples]
    force = value(exact.log.contact_wrench_world)[samples, :, 2]
    weight = 9.81 * float(true.robot.nominal[:, 0].sum())
    assert np.percentile(np.abs(found[air]), 80.0) < 0.02 * weight
    assert np.sqrt(np.square(found - force).mean()) < 0.04 * weight


def test_the_order_of_joints_does_not_matter_and_contacts_keep_theirs() -> None:
    true, _ = walked(QUADRUPED)
    log, rng = noisy(QUADRUPED), np.random.default_rng(0)
    joints = rng.permutation(len(log.joint_names))
    shuffled = replace(
        log,
        joint_names=tuple(log.joint_names[x] for x in joints),
        joint_position=log.joint_position[:, joints],
        joint_torque=value(log.joint_torque)[:, joints],
    )
    contacts = QUADRUPED.contacts()
    found = flags(QUADRUPED)
    np.testing.assert_array_equal(detect_contacts(shuffled, true.robot, contacts, DEFAULT).active, found)
    flagged = with_detected_contacts(log, true.robot, contacts[::-1])[0]
    assert flagged.contact_names == log.contact_names, "wrenches keep their columns"
    assert (value(flagged.contact_active) == found).mean() > 0.999
    bare = replace(log, contact_names=(), contact_active=None, contact_wrench_world=None)
    assert with_detected_contacts(bare, true.robot, contacts[::-1])[0].contact_names == tuple(
        contact.frame for contact in contacts[::-1]
    )


def test_sensors_in_limbs_change_nothing() -> None:
    true, _ = walked(QUADRUPED)
    contacts, log = QUADRUPED.contacts(), noisy(QUADRUPED)
    split = load(QUADRUPED.urdf, None, False, ("front_left_sole",))
    assert split.n_dofs == true.robot.n + 6
    found = detect_contacts(log, split, contacts, DEFAULT).active
    assert (found == flags(QUADRUPED)).mean() > 0.999


def test_gaps_in_a_reading_leave_the_flags_around_them() -> None:
    true, _ = walked(QUADRUPED)
    log = noisy(QUADRUPED)
    torque, position = value(log.joint_torque).copy(), log.joint_position.copy()
    torque[700:704, 2], position[900, 5] = np.nan, np.nan
    holed = replace(log, joint_torque=torque, joint_position=position)
    assert (detect_contacts(holed, true.robot, QUADRUPED.contacts(), DEFAULT).active == flags(QUADRUPED)).mean() > 0.99


# ----------------------------------------------------------------------------------------------- known loads, no motion


def still(loads: Array, samples: int = 200) -> tuple[Log, tuple[Contact, ...]]:
    """A quadruped that is held still while its feet are pressed up with loads (4,) [N]."""
    case = stance("quadruped")
    robot = robot_of(case.machine)
    oracle = Oracle.of(robot)
    q = np.concatenate([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], case.log.joint_position[0]])[None]
    zero = np.zeros((1, 18))
    torque = oracle.frictionless_forces(q, zero, zero)[0]
    for foot, carried in zip(case.machine.feet, loads, strict=True):
        J, R = oracle.jacobian(q, foot)[0], oracle.pose(q, foot)[0][0]
        torque = torque - J[:3].T @ (R.T @ np.array([0.0, 0.0, carried]))
    every = np.ones((samples, 1))
    log = Log(
        "still", np.arange(samples) / 100.0, robot.joint_names, every * q[:, 7:], joint_torque=every * torque[6:],
        base_quat_xyzw=every * q[:, 3:7],
    )  # fmt: skip
    return log, case.contacts()


def test_loads_of_a_robot_that_stands_are_worked_out() -> None:
    weight = 9.81 * float(robot_of(stance("quadruped").machine).nominal[:, 0].sum())
    loads = weight * np.array([0.3, 0.2, 0.3, 0.2])
    log, contacts = still(loads)
    stamps, found = normal_forces(log, robot_of(stance("quadruped").machine), contacts, 10.0)
    np.testing.assert_allclose(found, np.tile(loads, (len(stamps), 1)), rtol=0.0, atol=0.02 * weight)


@pytest.mark.parametrize("carried", [0.0, 0.01], ids=["held in the air", "lying on its belly"])
def test_feet_of_a_robot_that_something_else_carries_do_not_stand(carried: float) -> None:
    robot = robot_of(stance("quadruped").machine)
    weight = 9.81 * float(robot.nominal[:, 0].sum())
    log, contacts = still(np.full(4, carried * weight))
    assert not detect_contacts(log, robot, contacts, DEFAULT).active.any()
    log, contacts = still(np.array([0.25, 0.25, 0.25, 0.0]) * weight)
    np.testing.assert_array_equal(
        detect_contacts(log, robot, contacts, DEFAULT).active, np.tile([True, True, True, False], (len(log), 1))
    )


# -------------------------------------------------------------------------------------------------- checks and refusals


def test_flags_that_were_made_are_not_rejected_by_the_checks() -> None:
    true, _ = walked(QUADRUPED)
    log, contacts = noisy(QUADRUPED), QUADRUPED.contacts()
    late = replace(log, contact_active=np.roll(value(log.contact_active), 20, axis=0))
    rejected = [x.field for x in check(late, true.robot, contacts).findings if x.severity == "rejected"]
    assert "contact_active" in rejected
    for made in (late, with_detected_contacts(late, true.robot, contacts)[0]):
        findings = check(made, true.robot, contacts, derived=("contact_active",)).findings
        assert not [x for x in findings if x.field in ("contact_active", "contact_names")]


def test_a_leg_without_torques_is_refused() -> None:
    true, _ = walked(QUADRUPED)
    log, contacts = noisy(QUADRUPED), QUADRUPED.contacts()
    torque = value(log.joint_torque).copy()
    torque[::3, log.joint_names.index("front_left_knee")] = np.nan
    message = refused(
        lambda: with_detected_contacts(replace(log, joint_torque=torque), true.robot, contacts),
        "simulated: joint_torque: above front_left_foot, measured only at front_left_hip, front_left_thigh;",
        LogError,
    )
    assert "at least 3 joints above each contact" in message
    assert detect_contacts(log, true.robot, (), DEFAULT).active.shape == (len(log), 0)


def test_a_log_without_torques_or_joints_is_refused_in_one_line() -> None:
    true, _ = walked(QUADRUPED)
    log, contacts = noisy(QUADRUPED), QUADRUPED.contacts()
    without = replace(log, joint_torque=None)
    refused(lambda: with_detected_contacts(without, true.robot, contacts), "simulated: joint_torque: missing", LogError)
    other = replace(log, joint_names=("knie", *log.joint_names[1:]))
    line = "simulated: joint_names: unknown name 'knie'"
    refused(lambda: with_detected_contacts(other, true.robot, contacts), line, UnknownNameError)
    unnamed = replace(log, contact_names=("toe", *log.contact_names[1:]))
    line = f"simulated: contact_names: contact '{log.contact_names[0]}' missing"
    refused(lambda: with_detected_contacts(unnamed, true.robot, contacts), line, LogError)
    refused(
        lambda: with_detected_contacts(log.select(slice(0, 3)), true.robot, contacts), "simulated: time: ", LogError
    )
