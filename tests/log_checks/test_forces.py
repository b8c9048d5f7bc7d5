"""Forces that contradict the URDF: which usual mistake explains it."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import CONTACTS, CUTOFF, changed, demo_log, demo_robot, found, of_demo, only, scaled
from mistaken import case_of
from motions import value
from repository import CONFIGS, SHARED
from synthetic import PANDA, ROBOTS, Oracle, load
from thinned import each_once, study_but
from urdfs import joint, link, write
from walking import MACHINES, robot_of

from torchid.commands.check import check_experiment
from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Checked, scales
from torchid.log_checks.check import check
from torchid.log_checks.model import NominalModel, bind_some_samples, preprocess_pieces
from torchid.log_checks.scales import DeviationRows
from torchid.logs import Log, read_log
from torchid.logs.preprocess import preprocess
from torchid.parameters import GRAVITY, VISCOUS
from torchid.problem import bind_log
from torchid.robot import Robot, load_robot
from torchid.sensing import Contact

EXPLAINED = "unit, sign or frame"
ELSEWHERE = pytest.mark.skipif(not SHARED.is_dir(), reason=f"recorded logs are not in {SHARED}")


@cache
def arm(size: float = 1.0, gravity: tuple[float, ...] = (0.0, 0.0, -1.0)) -> tuple[Robot, Log]:
    """A bolted arm whose inertia is up to 20 % off its URDF, swinging for 8 s; positions and torques with noise."""
    robot, rng = load(PANDA, fixed_base=True), np.random.default_rng(0)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    oracle.model.gravity.linear = GRAVITY * np.array(gravity)
    time, n = np.arange(1600) / 200.0, robot.n
    phase = 2.0 * np.pi * time[:, None] * rng.uniform(0.2, 0.6, n) + rng.uniform(0.0, 6.0, n)
    rate, swing = np.gradient(phase, time, axis=0), size * rng.uniform(0.3, 0.8, n)
    q = size * rng.uniform(-0.5, 0.5, n) + swing * np.sin(phase)
    torque = oracle.forces(q, swing * rate * np.cos(phase), -swing * rate**2 * np.sin(phase))
    noise = rng.normal(size=(2, *q.shape))
    return robot, Log("arm.npz", time, robot.joint_names, q + 1e-5 * noise[0], joint_torque=torque + 0.1 * noise[1])


def rescaled(log: Log, joints: Sequence[int], factor: float) -> Log:
    """The log with some joints' torques times a factor."""
    torque = value(log.joint_torque).copy()
    torque[:, joints] *= factor
    return replace(log, joint_torque=torque)


def of_arm(change: Callable[[Log], Log] = lambda log: log) -> Checked:
    robot, log = arm()
    return check(change(log), robot, (), 5.0)


def test_forces_of_a_robot_that_differs_from_its_urdf_by_a_fifth_are_not_complained_of() -> None:
    for checked in (of_arm(), of_demo(demo_log())):
        assert checked.verdict == "usable"
        assert {one.name for one in checked.findings} <= {"weight"}


@pytest.mark.parametrize("armature", [0.0, 20.0])
def test_neither_friction_nor_armature_larger_than_a_load_is_taken_for_another_scale_of_the_force(
    tmp_path: Path, armature: float
) -> None:
    slides = [
        joint(name, parent, child, "prismatic", f'<axis xyz="{axis}"/><limit lower="-1" upper="1" effort="9"/>')
        for name, parent, child, axis in (("x", "base", "arm", "1 0 0"), ("quill", "arm", "tool", "0 0 1"))
    ]
    robot = load_robot(write(tmp_path, link("base"), link("arm"), link("tool"), *slides), fixed_base=True)
    time, rng = np.arange(4000) / 200.0, np.random.default_rng(0)
    rate, size = 2.0 * np.pi * np.array([0.5, 0.3]), np.array([0.5, 0.1])
    phase = rate * time[:, None]
    v, a = size * rate * np.cos(phase), -size * rate**2 * np.sin(phase)
    force = a * [2.0 + armature, 1.1] + [0.0, 1.1 * GRAVITY] + [0.0, 15.0] * np.sign(v) + 0.1 * rng.normal(size=v.shape)
    log = Log("stage.npz", time, robot.joint_names, size * np.sin(phase), joint_torque=force)
    samples = bind_some_samples(preprocess_pieces(log, 10.0), robot, (), 240)
    gains = value(scales.fit_torque_gains(samples, NominalModel(robot, ())))
    assert abs(gains.gain[1] - 1.0 / 1.1) < gains.spread[1]  # 2.3 times that, if friction is taken for small
    if armature:
        assert gains.gain[0] < 1.0 / 1.3 < 1.3 < gains.reverse[0]  # mass or armature: any factor


@pytest.mark.parametrize(
    ("recorded", "factor"),
    each_once([("arm", "contacts"), ("quadruped", "joints"), ("biped", "full")], [-1.0, 0.5, 2.0, 8.0]),
)
def test_of_joints_half_of_which_have_another_factor_none_that_is_right_is_named(
    recorded: tuple[str, str], factor: float
) -> None:
    case = case_of(MACHINES[recorded[0]], recorded[1])
    names = case.log.joint_names
    wrong = np.random.default_rng(5).choice(len(names), len(names) // 2, replace=False).tolist()
    checked = check(rescaled(case.log, wrong, factor), robot_of(case.machine), case.machine.contacts, CUTOFF)
    named = {joint for one in checked.findings if one.field == "joint_torque" for joint in one.channels}
    assert named <= {names[joint] for joint in wrong}
    assert len(named) >= len(wrong) // 2


@ELSEWHERE
def test_torques_that_armature_and_friction_make_up_have_no_factor() -> None:
    """Chirps by a PD law of a quadruped that hangs with its base held: rotors outweigh its legs."""
    urdf = ROBOTS / "go2_description" / "urdf" / "go2.urdf"
    checked = list(check_experiment(CONFIGS / "go2_in_air.yaml", [f"robot.urdf={urdf}"]))
    assert checked
    assert not any(found(one, "scale") for one in checked)


def test_halved_torques_are_not_taken_for_slow_time() -> None:
    case = case_of(MACHINES["quadruped"], "joints")
    halved = rescaled(case.log, range(len(case.log.joint_names)), 0.5)
    checked = check(halved, robot_of(case.machine), case.machine.contacts, CUTOFF)
    assert not found(checked, "unit", "time")
    assert only(checked, "scale", "joint_torque").found.startswith(
        "all torques: the factor that fits the URDF best is 1."
    )


@pytest.mark.parametrize(
    ("gravity", "tilt"),
    [((0.0, -1.0, 0.0), "[1.5708, 0.0000]"), ((-1.0, 0.0, 0.0), "[0.0000, -1.5708]")],
    ids=["beside it", "before it"],
)
def test_an_arm_on_a_wall_is_named_with_its_tilt(gravity: tuple[float, ...], tilt: str) -> None:
    robot, log = arm(gravity=gravity)
    finding = only(check(log, robot, (), 5.0), "unit, sign or frame")
    assert finding.found.startswith("mounted on a wall")
    assert finding.advice.startswith(f"robot.base_tilt: {tilt}")
    assert check(log, replace(robot, base_tilt=tuple(json.loads(tilt))), (), 5.0).verdict == "usable"


def test_friction_of_the_urdf_that_the_forces_contradict_is_named_and_nothing_is_rejected() -> None:
    robot, log = arm()
    nominal = robot.nominal.copy()
    nominal[2, VISCOUS] = 400.0
    stated = replace(robot, nominal=nominal)
    checked = check(log, stated, (), 5.0)
    friction = only(checked, "friction")
    assert friction.severity == NOTE
    assert f"without the friction that it states: viscous up to 400 in {robot.joint_names[1]}" in friction.found
    assert checked.verdict == "usable"
    reversed_too = check(rescaled(log, [1], -1.0), stated, (), 5.0)
    assert only(reversed_too, "sign").channels == (robot.joint_names[1],), "judged without that friction"
    stiff = 80.0 * np.sign(np.gradient(log.joint_position, log.time, axis=0)) + value(log.joint_torque)  # [N m]
    checked = check(replace(log, joint_torque=stiff), stated, (), 5.0)
    assert "mostly by the friction that it states: viscous up to 400" in only(checked, "friction").found
    assert not found(checked, "forces")
    assert checked.verdict == "usable", "friction of the robot is larger than its load, too"
    degrees = check(replace(log, joint_position=np.rad2deg(log.joint_position)), stated, (), 5.0)
    assert any("degrees" in one.found and one.severity == REJECTED for one in degrees.findings)


@pytest.mark.parametrize("joint", [1, 3])
def test_a_reversed_torque_of_a_bolted_arm_is_named(joint: int) -> None:
    checked = of_arm(lambda log: rescaled(log, [joint], -1.0))
    sign = only(checked, "sign")
    assert (sign.severity, sign.channels) == (REJECTED, (arm()[0].joint_names[joint],))
    assert not checked.usable


@pytest.mark.parametrize("measured", [True, False], ids=["contact forces measured", "contact forces unknown"])
def test_reversed_torques_of_a_standing_robot_are_seen_through_the_contacts_null_space(measured: bool) -> None:
    log = rescaled(demo_log(), [1, 5], -1.0)
    log = log if measured else replace(log, contact_wrench_local=None)
    assert set(only(of_demo(log), "sign").channels) == {"front_left_thigh", "front_right_knee"}


@pytest.mark.parametrize("factor", study_but([1.2], [0.5, 1.2, 2.0]))
def test_torques_that_all_have_one_factor_contradict_the_contact_forces(factor: float) -> None:
    case = case_of(MACHINES["quadruped"], "full")
    wrong = replace(case.log, joint_torque=factor * value(case.log.joint_torque))
    checked = check(wrong, robot_of(case.machine), case.machine.contacts, CUTOFF)
    blamed = [one for one in checked.findings if one.severity != NOTE]
    assert [(one.field, one.name) for one in blamed] == [("joint_torque", "scale")], blamed
    stated = re.search("all torques: the factor that fits the URDF best is ([0-9.]+)", blamed[0].found)
    assert float(value(stated)[1]) == pytest.approx(1.0 / factor, rel=0.2)


@pytest.mark.parametrize("factor", study_but([1.2], [0.8, 1.0, 1.2]))
def test_a_common_factor_of_a_bolted_arms_torques_is_noted_as_one_of_torques_or_masses(factor: float) -> None:
    """Beside masses up to 15 % off; the factor itself within three of its standard deviations."""
    case = case_of(MACHINES["arm"], "contacts")
    log = replace(case.log, joint_torque=factor * value(case.log.joint_torque))
    findings = check(log, robot_of(case.machine), (), CUTOFF).findings
    assert {one.severity for one in findings} <= {NOTE}
    found = [re.match("all torques are ([0-9.]+) [+]- ([0-9.]+) times", one.found) for one in findings]
    stated = [(float(one[1]), float(one[2])) for one in found if one is not None]
    assert len(stated) == (factor != 1.0)
    assert all(abs(stated_factor - factor) < 3.0 * std for stated_factor, std in stated)


def test_a_factor_that_is_far_from_minus_one_is_not_called_a_reversed_torque() -> None:
    finding = only(of_arm(lambda log: rescaled(log, [3], -30.0)), "scale", "joint_torque")
    assert finding.channels == ("panda_joint4",)
    assert not found(of_arm(lambda log: rescaled(log, [3], -30.0)), "sign")


def test_torques_that_dry_friction_may_hold_are_not_judged_in_a_robot_that_stands_still() -> None:
    robot = load(PANDA, fixed_base=True)
    rng, rest = np.random.default_rng(1), np.zeros((1, robot.n))
    q = np.array([[0.2, 0.7, -0.3, -1.5, 0.2, 1.5, 0.1, 0.02]])
    torque = Oracle.of(robot).forces(q, rest, rest)[0]
    light = [0, 4, 6]
    torque[light] = [-0.7, 0.9, -0.4]  # [N m], of friction: hardly any gravity is left for them
    noise = rng.normal(size=(2, 800, robot.n))
    held = Log(
        "held.npz",
        np.arange(800) / 200.0,
        robot.joint_names,
        q + 1e-5 * noise[0],
        joint_torque=torque + 0.01 * noise[1],
    )
    assert not [one for one in check(held, robot, (), 5.0).findings if one.severity != NOTE]


def test_torques_that_are_all_zero_say_nothing_of_time() -> None:
    zero = of_arm(lambda log: replace(log, joint_torque=np.zeros_like(value(log.joint_torque))))
    assert zero.usable
    assert not found(zero, "unit", "time")


def test_factors_that_one_block_of_time_makes_up_are_compared_within_blocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of a segment of wrong readings, in which the joints of reference have factors of 0.02 and all others fit."""
    robot, log = arm()
    shape = (scales.TIME_BLOCKS, 5 + 3)
    blocks = np.where(np.arange(8) < 5, 1.1, 0.0) * np.ones(shape)
    blocks[0, :3] = 0.02
    gain = np.array([0.02, 0.02, 0.02, 0.7, 0.75])
    gains = scales.TorqueGains(np.arange(5), gain, gain, np.zeros(3), np.full(8, 0.05), blocks, None)
    monkeypatch.setattr("torchid.log_checks.forces.fit_torque_gains", lambda *_: gains)
    assert not found(check(log, robot, (), 5.0), "scale")


def test_a_joint_whose_torque_is_noise_alone_is_not_judged() -> None:
    _, log = arm()
    rng = np.random.default_rng(1)
    checked = of_arm(
        lambda log: changed(log, "joint_torque", lambda t: t[:, 6].__setitem__(slice(None), rng.normal(size=1600)))
    )
    assert not found(checked, "sign")
    (skipped,) = (skip for skip in checked.skipped if skip.name == "sign of torques")
    assert log.joint_names[6] in skipped.reason


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_torque_that_is_friction_alone_is_reversed_where_it_would_drive_its_joint(sign: float) -> None:
    robot, log = arm()
    rate = np.gradient(log.joint_position[:, 6], log.time)
    torque = value(log.joint_torque).copy()
    torque[:, 6] += 4.0 * np.sign(rate) + 2.0 * rate  # [N m]; bodies beyond need 0.1
    checked = check(rescaled(replace(log, joint_torque=torque), [6], sign), robot, (), 5.0)
    assert not [
        skip for skip in checked.skipped if skip.name == "sign of torques" and robot.joint_names[6] in skip.reason
    ]
    if sign > 0.0:
        assert not found(checked, "sign")
    else:
        reversed_ = only(checked, "sign")
        assert (reversed_.severity, reversed_.channels) == (REJECTED, (robot.joint_names[6],))
        assert "friction, which would drive the joint" in reversed_.found


#: Joints of `arm` that move at nearly one rate: of a sine, either one's torques fit both.
OF_ONE_RATE = {(0, 5), (1, 4), (3, 6)}
OTHER_PAIRS = [pair for pair in itertools.combinations(range(7), 2) if pair not in OF_ONE_RATE]


@pytest.mark.parametrize("pair", study_but([(1, 2), (0, 6), (4, 5)], OTHER_PAIRS))
def test_torques_of_any_two_joints_that_are_exchanged_are_named(pair: tuple[int, int]) -> None:
    """Of wrists, too, whose torques are a hundredth of the shoulder's."""
    order = list(range(len(arm()[1].joint_names)))
    order[pair[0]], order[pair[1]] = pair[1], pair[0]
    finding = only(of_arm(lambda log: replace(log, joint_torque=value(log.joint_torque)[:, order])), EXPLAINED)
    assert (finding.severity, finding.field) == (REJECTED, "joint_torque")
    assert finding.channels == tuple(f"panda_joint{1 + joint}" for joint in pair)


def test_a_torque_of_the_motor_side_of_a_gear_is_suspicious() -> None:
    scale = only(of_arm(lambda log: rescaled(log, [1], 0.02)), "scale")
    assert (scale.severity, scale.channels) == (SUSPICIOUS, (arm()[0].joint_names[1],))


def test_rows_are_laid_out_anew_where_other_torques_are_known() -> None:
    log, robot = preprocess(demo_log().select(slice(0, 300)), CUTOFF), demo_robot()
    fewer = changed(log, "joint_torque", lambda torque: torque[:, 4].fill(np.nan))
    model = NominalModel(robot, CONTACTS)
    whole, found, expected = (
        one.compare([bind_log(part, robot, CONTACTS)])
        for one, part in ((model, log), (model, fewer), (NominalModel(robot, CONTACTS), fewer))
    )
    assert found.misfit == expected.misfit != whole.misfit


def test_of_foot_sensors_alone_no_rows_but_the_base_s_are_compared() -> None:
    case = case_of(MACHINES["biped"], "contacts")
    model = NominalModel(robot_of(case.machine), case.machine.contacts)
    samples = bind_some_samples(preprocess_pieces(case.log, CUTOFF), model.robot, model.contacts, 150)
    rows = value(DeviationRows.of(samples, model))
    ((W, equations, columns, target),) = rows.parts
    assert W.shape[2] == equations.shape[1] == columns.shape[1] == target.shape[1] == 6
    assert equations.all()


def test_a_unit_that_leaves_a_third_of_the_misfit_may_be_another_robot() -> None:
    checked = of_demo(scaled(demo_log().select(slice(0, 600)), "joint_torque", 1.3 / 9.81))
    explained = only(checked, EXPLAINED)
    assert explained.found.startswith("in kgm")
    assert explained.advice.endswith("; or is quadruped.urdf another robot's?")


def test_positions_in_degrees_are_named_even_where_no_joint_turns_far() -> None:
    robot, log = arm(0.1)
    assert np.abs(log.joint_position).max() < np.radians(12.0)
    checked = check(scaled(log, "joint_position", 180.0 / np.pi), robot, (), 5.0)
    explained = only(checked, EXPLAINED)
    assert (explained.field, explained.found[:10]) == ("joint_position", "in degrees")


def test_one_joint_in_degrees_is_named() -> None:
    checked = of_demo(changed(demo_log(), "joint_position", lambda q: q[:, 11].__imul__(180.0 / np.pi)))
    assert only(checked, EXPLAINED).found.startswith("rear_right_knee in degrees")
    assert not found(checked, "forces")


def test_one_torque_in_another_unit_is_rejected_by_name() -> None:
    robot, log = arm()
    finding = only(check(rescaled(log, [1], 1e3), robot, (), 5.0), "unit")
    assert (finding.severity, finding.channels) == (REJECTED, (robot.joint_names[1],))
    assert "in mN m" in finding.found


def test_forces_that_are_far_too_large_are_not_explained_by_what_makes_them_small() -> None:
    swapped = of_demo(replace(demo_log(), contact_wrench_local=value(demo_log().contact_wrench_local)[:, ::-1]))
    assert "; see force without contact of contact_active" in only(swapped, "forces").found
    assert not found(swapped, EXPLAINED)


@ELSEWHERE
def test_moments_of_a_force_plate_in_newton_millimetres_are_named() -> None:
    folder = SHARED / "human_squats"
    log, robot = read_log(folder / "static1.npz"), load_robot(folder / "human.urdf")
    wrench = value(log.contact_wrench_world) * [1.0, 1.0, 1.0, 1e3, 1e3, 1e3]
    contacts = [Contact(name, "flat") for name in log.contact_names]
    checked = check(replace(log, contact_wrench_world=wrench), robot, contacts, 6.0)
    assert only(checked, EXPLAINED).found.startswith("moments in N mm")


def test_a_bolted_robot_is_not_asked_for_its_base_nor_for_contacts() -> None:
    robot, log = arm()
    assert not {"weight at rest", "contact flags against forces", "angular velocity against orientation"} & {
        skip.name for skip in check(log, robot, (), 5.0).skipped
    }


def test_a_floating_base_that_nothing_holds_is_asked_for_its_contacts() -> None:
    log = demo_log()
    bare = replace(log, contact_names=(), contact_active=None, contact_wrench_local=None)
    assert "name under contacts" in only(check(bare, demo_robot(), (), CUTOFF), "forces").advice


def test_what_no_usual_mistake_explains_is_only_suspicious() -> None:
    shuffled = of_arm(lambda log: replace(log, joint_torque=np.roll(value(log.joint_torque), 400, axis=0)))
    finding = only(shuffled, "forces")
    assert finding.severity == SUSPICIOUS
    assert "no usual mistake" in finding.found


def test_a_log_of_another_robot_is_not_usable() -> None:
    robot, log = arm()
    renamed = check(replace(log, joint_names=tuple(f"x_{name}" for name in log.joint_names)), robot)
    assert only(renamed, "does not fit").field == "joint_names"
    assert not renamed.usable
    unknown = check(demo_log(), demo_robot(), CONTACTS[:3], CUTOFF)
    assert "active, but not among" in only(unknown, "does not fit").found


def test_a_log_without_a_robot_says_what_was_not_checked() -> None:
    reasons = {skip.name: skip.reason for skip in check(arm()[1]).skipped}
    assert "no robot" in reasons["forces against the model"]


def test_a_long_log_is_compared_in_pieces() -> None:
    robot, log = arm()
    index: Any = np.concatenate([np.arange(1600), np.arange(1600)[::-1]] * 16)
    long = replace(log.select(index), time=np.arange(len(index)) / 200.0)
    flipped = rescaled(long, [1], -1.0)
    assert only(check(flipped, robot, (), 5.0), "sign").channels == (robot.joint_names[1],)


def test_torques_of_motors_of_one_type_that_are_an_eighth_are_named_with_the_key_of_their_scale() -> None:
    """Three of seven joints: a unit for all torques would be wrong for the other four."""
    case = case_of(MACHINES["arm"], "contacts")
    torque = value(case.log.joint_torque).copy()
    torque[:, 1:4] /= 8.0
    result = check(replace(case.log, joint_torque=torque), robot_of(case.machine), case.machine.contacts, CUTOFF)
    finding = only(result, "scale", "joint_torque")
    assert {case.log.joint_names[1], case.log.joint_names[3]} <= set(finding.channels)
    assert "or set sensors.scales: {joint_torque: [[" in finding.advice
