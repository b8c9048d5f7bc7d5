"""Quantities that contradict each other: units, signs, frames, orders, delays, flags, weight."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import CONTACTS, changed, demo_log, demo_robot, found, moving, of_demo, only, places, scaled, with_rates
from motions import angles, omega_base, position, slope, uniform, value, velocity
from scipy.spatial.transform import Rotation

from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS, Checked, Finding
from torchid.log_checks.check import check
from torchid.log_checks.contacts import check_weight
from torchid.log_checks.motion import check_angle_unit, compare_derivative
from torchid.log_checks.readings import check_excitation, check_rest, check_still_base
from torchid.logs import Log, read_log, write_log
from torchid.logs.preprocess import preprocess
from torchid.logs.quaternion import angular_velocity_base
from torchid.problem import bind_log
from torchid.problem.samples import is_at_rest
from torchid.robot import load_robot

RATES = (
    "joint_velocity", "joint_acceleration", "base_linear_velocity_world", "base_linear_acceleration_world",
    "base_angular_velocity_base", "base_angular_acceleration_base",
)  # fmt: skip


@cache
def flying(noise: float = 1e-5) -> Log:
    """A base that flies and tumbles on a known path, with three joints; everything is given that can be."""
    log = with_rates(moving(2000, noise))
    t, rng = log.time, np.random.default_rng(1)
    quat = Rotation.from_euler("ZYX", angles(t)).as_quat() + noise * rng.normal(size=(len(t), 4))
    return replace(
        log,
        base_quat_xyzw=quat / np.linalg.norm(quat, axis=1, keepdims=True),
        base_position_world=position(t) + noise * rng.normal(size=(len(t), 3)),
        base_linear_velocity_world=velocity(t),
        base_linear_acceleration_world=slope(velocity, t),
        base_angular_velocity_base=omega_base(t),
        base_angular_acceleration_base=slope(omega_base, t),
    )


def with_imu(log: Log, frame: str = "imu") -> Log:
    """The log with an IMU whose axes are the base's."""
    up = Rotation.from_quat(value(log.base_quat_xyzw)).inv()
    force = up.apply(value(log.base_linear_acceleration_world) + [0.0, 0.0, 9.81])
    return replace(log, imu_frame=frame, imu_specific_force=force, imu_angular_velocity=log.base_angular_velocity_base)


def resting(**fields: Any) -> Log:
    """Two seconds of a tilted base that stands still, with an IMU whose axes are the base's."""
    time, rng = uniform(2.0), np.random.default_rng(2)
    still = np.zeros((1000, 3))
    quat = np.tile(Rotation.from_euler("ZYX", [0.5, 0.2, -0.3]).as_quat(), (1000, 1))
    log = Log(
        "rests.npz", time, ("a", "b", "c"), position(time[:1]) + 1e-5 * rng.normal(size=(1000, 3)),
        base_quat_xyzw=quat, base_linear_acceleration_world=still, base_angular_velocity_base=still,
    )  # fmt: skip
    return replace(with_imu(log, "base_link"), base_angular_velocity_base=None, **fields)


def test_true_velocities_and_accelerations_are_not_complained_of() -> None:
    checked = check(flying())
    assert not [one for one in checked.findings if one.severity != NOTE]
    assert not [skip for skip in checked.skipped if "velocit" in skip.name]


@pytest.mark.parametrize("order", [1, 2])
def test_ratio_correlation_and_delay_of_a_derivative_are_measured(order: int) -> None:
    log = flying()
    derivative = value(log.joint_velocity if order == 1 else log.joint_acceleration)
    late = 1.7 * np.roll(derivative, 7, axis=0)
    measured = value(compare_derivative(log.time, log.joint_position, late, order))
    np.testing.assert_allclose(measured.ratio, 1.7, rtol=0.02)
    np.testing.assert_allclose(measured.delay, 7.0, rtol=0.0, atol=0.1)
    assert (measured.correlation > 0.995).all()


@pytest.mark.parametrize("field", RATES)
def test_a_derivative_in_degrees_or_millimetres_is_named(field: str) -> None:
    linear = field.startswith("base_linear")
    checked = check(scaled(flying(), field, 1e3 if linear else 180.0 / np.pi))
    assert f"{field} is in {'mm' if linear else 'deg'}/s" in only(checked, "unit or sign", field).found
    assert not checked.usable


def test_a_velocity_that_is_half_again_too_large_is_suspicious() -> None:
    finding = only(
        check(changed(flying(), "joint_velocity", lambda v: v[:, 1].__imul__(1.5))), "ratio", "joint_velocity"
    )
    assert (finding.channels, finding.severity) == (("b",), SUSPICIOUS)


def test_velocities_in_radians_betray_positions_in_degrees() -> None:
    slow = scaled(flying(), "joint_position", 180.0 / np.pi)
    assert "joint_position is in deg" in only(check(slow), "unit or sign", "joint_velocity").found


def test_a_velocity_of_the_wrong_sign_is_named_by_joint() -> None:
    wrong = changed(flying(), "joint_velocity", lambda v: v[:, 1].__imul__(-1.0))
    finding = only(check(replace(wrong, joint_acceleration=None)), "unit or sign")
    assert (finding.channels, finding.severity) == (("b",), REJECTED)
    assert "sign" in finding.found


def test_a_velocity_that_lags_is_named_with_the_delay() -> None:
    late = replace(flying(), joint_velocity=np.roll(value(flying().joint_velocity), 6, axis=0), joint_acceleration=None)
    finding = only(check(late), "delay")
    assert "lags the derivative of joint_position by 6" in finding.found
    assert finding.severity == SUSPICIOUS


def test_half_a_sample_of_delay_is_what_integrators_leave() -> None:
    log = flying()
    half = replace(log, joint_velocity=velocity(log.time - 0.5 / 500.0))
    assert not found(check(half), "delay")


def test_velocities_of_other_joints_do_not_follow() -> None:
    swapped = replace(
        flying(), joint_velocity=np.roll(value(flying().joint_velocity), 1, axis=1), joint_acceleration=None
    )
    assert set(only(check(swapped), "derivative").channels) == {"a", "b", "c"}


@pytest.mark.parametrize("field", ["base_linear_velocity_world", "base_linear_acceleration_world"])
def test_a_vector_in_another_frame_than_its_name_says_is_named(field: str) -> None:
    log, turn = flying(), Rotation.from_quat(value(flying().base_quat_xyzw))
    fields: dict[str, Any] = {field: turn.inv().apply(getattr(log, field))}
    if field.endswith("velocity_world"):
        fields["base_linear_acceleration_world"] = None
    finding = only(check(replace(log, **fields)), "frame")
    assert (finding.field, finding.severity) == (field, REJECTED)
    assert "in the base frame" in finding.found


def test_an_acceleration_that_contains_gravity_is_named() -> None:
    log = flying()
    with_gravity = value(log.base_linear_acceleration_world) + [0.0, 0.0, 9.81]
    finding = only(check(replace(log, base_linear_acceleration_world=with_gravity)), "gravity")
    assert "contains gravity" in finding.found


def test_an_angular_velocity_in_the_other_frame_is_named() -> None:
    log, turn = flying(), Rotation.from_quat(value(flying().base_quat_xyzw))
    wrong = replace(
        log, base_angular_velocity_base=turn.apply(omega_base(log.time)), base_angular_acceleration_base=None
    )
    finding = only(check(wrong), "frame or order")
    assert (finding.field, finding.severity) == ("base_angular_velocity_base", REJECTED)
    assert "world frame" in finding.found


@pytest.mark.parametrize("frame", ["base", "world"])
@pytest.mark.parametrize("named", ["wxyz", "xyzw"])
def test_a_quaternion_of_the_other_order_than_its_name_says_is_named(tmp_path: Any, named: str, frame: str) -> None:
    log = flying()
    write_log(replace(log, base_linear_velocity_world=None, base_linear_acceleration_world=None), tmp_path / "log.npz")
    with np.load(tmp_path / "log.npz") as file:
        arrays = dict(file)
    quat = arrays.pop("base_quat_xyzw")
    arrays["base_quat_wxyz" if named == "wxyz" else "base_quat_xyzw"] = quat if named == "wxyz" else np.roll(quat, 1, 1)
    for name in ("velocity", "acceleration"):
        rate = arrays.pop(f"base_angular_{name}_base")
        if name == "velocity":
            turned = Rotation.from_quat(quat).apply(rate) if frame == "world" else rate
            arrays[f"base_angular_velocity_{frame}"] = turned
    np.savez(tmp_path / "wrong.npz", **arrays)
    finding = only(check(read_log(tmp_path / "wrong.npz")), "frame or order")
    assert (finding.field, finding.severity) == ("base_quat_xyzw", REJECTED)
    assert "order" in finding.found


def test_an_orientation_that_rotates_world_to_base_is_named() -> None:
    log = flying()
    inverse = Rotation.from_quat(value(log.base_quat_xyzw)).inv().as_quat()
    finding = only(check(replace(log, base_quat_xyzw=inverse)), "frame or order")
    assert "world to base" in finding.found


def test_an_angular_velocity_of_the_wrong_sign_is_not_blamed_on_the_orientation() -> None:
    quat = value(demo_log().base_quat_xyzw)  # of a base that turns little: there the inverse fits nearly as well
    omega = angular_velocity_base(quat, np.gradient(quat, demo_log().time, axis=0))
    finding = only(check(replace(demo_log(), base_angular_velocity_base=-omega)), "frame or order")
    assert (finding.field, finding.found) == ("base_angular_velocity_base", "the sign is reversed")


def test_the_turn_of_a_gyroscope_along_other_axes_than_the_base_is_found() -> None:
    log, turn = flying(), Rotation.from_rotvec([20.0, -40.0, 100.0], degrees=True)
    omega = turn.inv().apply(value(log.base_angular_velocity_base))
    finding = only(check(replace(log, base_angular_velocity_base=omega)), "frame or order")
    assert (finding.field, finding.severity) == ("base_angular_velocity_base", REJECTED)
    assert "turned by (20, -40, 100) degrees" in finding.found


def test_a_joint_that_turns_more_than_twice_is_in_degrees_unless_it_can() -> None:
    log = scaled(demo_log(), "joint_position", 180.0 / np.pi)
    for checked in (check(log), of_demo(log)):
        assert "degrees" in only(checked, "unit", "joint_position").found
        assert not checked.usable
    one = changed(demo_log(), "joint_position", lambda q: q[:, 2].__iadd__(20.0))
    assert only(check(one), "unit").severity == SUSPICIOUS


def test_a_continuous_joint_may_turn_more_than_twice_unless_most_joints_do(tmp_path: Path) -> None:
    wheel = "rear_right_knee"
    urdf = demo_robot().path.read_text()
    path = tmp_path / "wheeled.urdf"
    path.write_text(re.sub(f'(name="{wheel}" type=)"revolute"', r'\1"continuous"', urdf))
    wheeled = load_robot(path)
    spun = changed(demo_log(), "joint_position", lambda q: q[:, demo_log().joint_names.index(wheel)].__iadd__(20.0))
    assert "degrees" in only(check(spun, demo_robot()), "unit", "joint_position").found
    assert not list(check_angle_unit(spun, wheeled))
    path.write_text(urdf.replace('type="revolute"', 'type="continuous"'))
    (finding,) = check_angle_unit(scaled(demo_log(), "joint_position", 180.0 / np.pi), load_robot(path))
    assert isinstance(finding, Finding)
    assert finding.severity == SUSPICIOUS


def test_a_slip_of_a_marker_in_degrees_is_no_step_in_radians() -> None:
    slipped = changed(moving(), "joint_position", lambda q: q[1000:, 0].__iadd__(0.009))
    assert only(check(slipped), "step").severity == NOTE
    one = check(changed(slipped, "joint_position", lambda q: q[:, 0].__imul__(180.0 / np.pi)))
    assert only(one, "unit").severity == SUSPICIOUS
    assert not found(one, "step")


def test_an_accelerometer_at_rest_reads_gravity() -> None:
    assert {one.severity for one in check(resting()).findings} == {NOTE}
    force = value(resting().imu_specific_force)
    for factor, name, severity in (
        (1.0 / 9.81, "unit", REJECTED), (1.05, "gravity", SUSPICIOUS), (0.01, "gravity", REJECTED)
    ):  # fmt: skip
        assert only(check(resting(imu_specific_force=factor * force)), name).severity == severity


def test_gravity_as_the_accelerometer_sees_it_is_compared_with_the_orientation() -> None:
    log = resting(joint_position=demo_log().joint_position[:1].repeat(1000, 0), joint_names=demo_log().joint_names)
    robot = demo_robot()
    log = replace(log, imu_frame=robot.base_link)
    assert not found(check(log, robot), "gravity")
    reversed_ = check(replace(log, imu_specific_force=-value(log.imu_specific_force)), robot)
    assert "from up" in only(reversed_, "gravity").found
    assert not reversed_.usable
    tilted = Rotation.from_euler("x", 20.0, degrees=True).apply(value(log.imu_specific_force))
    assert only(check(replace(log, imu_specific_force=tilted), robot), "gravity").severity == SUSPICIOUS


def test_a_force_while_a_contact_is_inactive_is_rejected() -> None:
    log = changed(demo_log(), "contact_active", lambda c: c.__setitem__((slice(640, 690), 1), False))
    finding = only(check(log), "force without contact")
    assert (finding.channels, places(finding)) == (("front_right_foot",), {(640, 689)})
    assert finding.severity == REJECTED
    assert value(check(log).repaired.contact_active)[640:690, 1].all()


@pytest.mark.parametrize("flags", [np.zeros_like, np.logical_not], ids=["all off", "inverted"])
def test_feet_that_carry_the_robot_while_no_flag_says_so_are_rejected(flags: Any) -> None:
    log = replace(demo_log(), contact_active=flags(value(demo_log().contact_active)))
    finding = only(of_demo(log), "force without contact")
    assert (finding.severity, set(finding.channels)) == (REJECTED, set(log.contact_names))
    assert not of_demo(log).usable


def test_sensors_that_read_next_to_nothing_do_not_call_a_robot_in_the_air_standing() -> None:
    wrench = value(demo_log().contact_wrench_local)
    air = replace(
        demo_log(), contact_active=np.zeros_like(value(demo_log().contact_active)), contact_wrench_local=0.02 * wrench
    )
    assert not found(of_demo(air), "force without contact")


def test_a_contact_without_a_force_is_suspicious() -> None:
    finding = only(
        check(changed(demo_log(), "contact_wrench_local", lambda w: w[640:690, 1].fill(0.0))), "contact without force"
    )
    assert (finding.severity, places(finding)) == (SUSPICIOUS, {(640, 689)})


def test_a_sensor_that_reads_nothing_is_not_taken_for_a_foot_in_the_air() -> None:
    dead = changed(demo_log(), "contact_wrench_local", lambda w: w[:, 1].fill(0.0))
    finding = only(check(dead), "contact without force")
    assert "its sensor reads 0" in finding.found
    assert "sensors.contact_wrenches" in finding.advice
    in_part = changed(demo_log(), "contact_wrench_local", lambda w: w[:600, 1].fill(0.0))
    assert "clear the flag" in only(check(in_part), "contact without force").advice


def test_a_flag_that_never_changes_though_the_foot_lifts_is_named() -> None:
    always = changed(demo_log(), "contact_active", lambda c: c[:, 2].fill(True))
    finding = only(check(always), "contact without force")
    assert "never changes" in finding.found
    in_the_air = np.flatnonzero(~value(demo_log().contact_active)[:, 2])
    mask = finding.mask(1300)
    assert np.mean(mask[in_the_air]) > 0.9


def test_flags_that_change_later_than_the_forces_are_named_with_the_delay() -> None:
    late = replace(demo_log(), contact_active=np.roll(value(demo_log().contact_active), 6, axis=0))
    assert "the flag changes 6 samples after the force" in only(check(late), "delay").found


def test_a_sensor_that_reads_something_in_the_air_is_named_with_its_offset() -> None:
    checked = of_demo(changed(demo_log(), "contact_wrench_local", lambda w: w[:, 3, 2].__iadd__(35.0)))
    finding = only(checked, "offset")
    assert (finding.channels, finding.severity) == (("rear_right_foot",), NOTE)
    assert "35 N" in finding.found
    assert checked.verdict == "usable"


def carried(factor: float = 1.0, robot: bool = True, **fields: Any) -> Checked:
    """A quadruped at rest, whose feet carry so many times its weight along world axes."""
    rng, weight = np.random.default_rng(5), 9.81 * demo_robot().nominal[:, 0].sum()
    wrench = np.zeros((300, 4, 6))
    wrench[..., 2] = factor * weight / 4.0 * (1.0 + 0.01 * rng.normal(size=(300, 4)))
    log = demo_log().select(np.zeros(300, int))
    log = replace(
        log, time=np.arange(300) / 100.0, joint_position=log.joint_position + 1e-5 * rng.normal(size=(300, 12)),
        joint_torque=None, contact_active=np.ones((300, 4), bool), contact_wrench_local=None,
        contact_wrench_world=wrench,
    )  # fmt: skip
    return check(replace(log, **fields), demo_robot() if robot else None)


def test_a_foot_that_stands_while_its_flag_is_off_is_no_offset() -> None:
    active = np.ones((300, 4), bool)
    active[100:150, 2] = False
    checked = carried(contact_active=active)
    assert places(only(checked, "force without contact")) == {(100, 149)}
    assert not found(checked, "offset")


def test_a_loaded_foot_whose_flag_is_off_is_found_though_it_reads_nothing_in_the_air() -> None:
    active, wrench = np.ones((300, 4), bool), 6.0 * value(carried().log.contact_wrench_world)
    active[100:200, 2] = False  # while it carries 300 N
    active[220:280, 2], wrench[220:280, 2] = False, np.nan
    checked = carried(robot=False, contact_active=active, contact_wrench_world=wrench)
    finding = only(checked, "force without contact")
    assert places(finding) == {(100, 199)}
    assert "carries up to 31" in finding.found
    assert not any("flags" in skip.name for skip in checked.skipped)


def test_a_contact_whose_force_was_not_measured_is_named_and_the_others_are_judged() -> None:
    active, wrench = np.ones((300, 4), bool), value(carried().log.contact_wrench_world).copy()
    active[100:150, 2], wrench[:, 1] = False, np.nan
    checked = carried(robot=False, contact_active=active, contact_wrench_world=wrench)
    assert places(only(checked, "force without contact")) == {(100, 149)}
    (skip,) = [skip for skip in checked.skipped if "flags" in skip.name]
    assert skip.reason == f"{demo_log().contact_names[1]}: its force is missing in some samples of contact"


def test_what_the_feet_carry_at_rest_is_compared_with_the_weight() -> None:
    log = carried().log
    assert not list(check_weight(log, demo_robot()))
    for factor, name, severity in (
        (1.05, "weight", NOTE), (1.5, "weight", SUSPICIOUS), (1e-3, "unit", REJECTED), (1.0 / 9.81, "unit", REJECTED),
        (-1.0, "sign", REJECTED),
    ):  # fmt: skip
        (finding,) = check_weight(scaled(log, "contact_wrench_world", factor), demo_robot())
        assert (finding.name, finding.severity) == (name, severity)  # type: ignore[union-attr]


def test_without_a_robot_the_carried_mass_is_a_note_and_a_pull_still_wrong() -> None:
    assert "20.81 kg" in only(carried(robot=False), "weight").found
    assert not carried(-1.0, robot=False).usable


def test_a_base_that_turns_in_one_place_is_named_unless_nothing_is_derived_from_that() -> None:
    rates: dict[str, Any] = dict.fromkeys(("base_linear_velocity_world", "base_linear_acceleration_world"))
    log = demo_log()
    still = replace(log, base_position_world=np.tile(value(log.base_position_world)[:1], (len(log), 1)), **rates)
    finding = only(of_demo(still), "constant position", "base_position_world")
    assert finding.severity == SUSPICIOUS
    assert "the base turns by 19 degrees" in finding.found
    assert "base_motion: contacts" in finding.advice
    driven = replace(still, base_linear_velocity_world=0.1 * np.random.default_rng(0).normal(size=(len(log), 3)))
    (known,) = check_still_base(driven)
    assert known.severity == NOTE
    assert not list(check_still_base(replace(still, base_quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1)))))


@pytest.mark.filterwarnings("ignore:.*no joint moves:torchid.errors.TorchidWarning")
@pytest.mark.parametrize("moves", ["nothing", "a joint", "the base"])
def test_a_log_in_which_nothing_moves_is_named(moves: str) -> None:
    log = demo_log()
    noise = np.random.default_rng(0).normal(scale=1e-4, size=(len(log), 1))
    rest = {name: getattr(log, name)[:1] + noise for name in ("joint_position", "base_position_world")}
    rest["base_quat_xyzw"] = np.tile(value(log.base_quat_xyzw)[:1], (len(log), 1))
    if moves == "a joint":
        rest["joint_position"][:, 3] = log.joint_position[:, 3]
    elif moves == "the base":
        rest["base_quat_xyzw"] = value(log.base_quat_xyzw)
    still = replace(log, **rest)
    assert is_at_rest([bind_log(preprocess(still, 8.0), demo_robot(), CONTACTS)]) == (moves == "nothing")
    findings = list(check_excitation(still))
    assert [(one.name, one.severity) for one in findings] == ([("no motion", NOTE)] if moves == "nothing" else [])


def test_joints_that_rest_while_others_move_are_named_with_their_share_of_the_time() -> None:
    log, rng, third = demo_log(), np.random.default_rng(0), len(demo_log()) // 3
    position = log.joint_position.copy()
    position[:, 2] = position[0, 2]
    position[third : 2 * third, 5] = position[third, 5]
    moves, rests = (
        replace(log, joint_position=x + 1e-5 * rng.normal(size=x.shape)) for x in (log.joint_position, position)
    )
    assert list(check_rest(moves)) == []
    [finding] = check_rest(rests)
    assert (finding.name, finding.severity) == ("rest", NOTE)
    assert finding.channels == (log.joint_names[2], log.joint_names[5])
    shares = [float(x) for x in re.findall(r"(\d+) %", finding.found)]
    assert shares[0] >= 98.0
    assert 30.0 <= shares[1] <= 40.0
    assert list(check_rest(replace(rests, joint_torque=None))) == []
