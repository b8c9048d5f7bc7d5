"""An IMU anywhere on the base in place of the base's pose: the same motion, the same parameters."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from motions import angles, omega_base, position, slope, uniform, value, velocity
from recordings import GRAVITY, POSE, in_world, states_of, with_imu
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic import G1, Oracle, load, make_log
from urdfs import BASE, joint, link, write
from welded import SENSORS, machine

from torchid.errors import InputError, LogError, UnknownNameError
from torchid.logs import Log
from torchid.logs.preprocess import preprocess
from torchid.problem import Samples, bind_log
from torchid.problem.motion import base_motion
from torchid.regressor import Regressor
from torchid.robot import Robot
from torchid.sensing import Contact

FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
CONTACTS = tuple(Contact(frame, "flat") for frame in FEET)
IMU = "imu_in_pelvis"
MOTION = ("specific_force", "angular_velocity", "angular_acceleration")


@cache
def recorded() -> tuple[Robot, Oracle, Log]:
    """A humanoid that differs from its URDF."""
    robot, rng = load(G1), np.random.default_rng(0)
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    states = [[True, True], [True, False], [False, True], [False, False]]
    return robot, oracle, make_log(oracle, [(frame, 6) for frame in FEET], states, 400, rng)


def assert_same_motion(found: Samples, expected: Samples, relative: float = 1e-13) -> None:
    for name in MOTION:
        x, true = value(getattr(found.base, name)).numpy(), value(getattr(expected.base, name)).numpy()
        np.testing.assert_allclose(x, true, rtol=0.0, atol=relative * np.abs(true).max(), err_msg=name)


@pytest.mark.parametrize("spin", [0.0, 1.0, 40.0], ids=["still", "turning", "tumbling"])
@pytest.mark.parametrize("frame", ["trunk", "hips"])
def test_a_skew_imu_off_the_base_origin_gives_the_motion_that_the_pose_gives(
    tmp_path: Path, frame: str, spin: float
) -> None:
    robot, rng = load(machine(tmp_path)), np.random.default_rng(1)
    assert robot.links[frame][0] == 0
    log = make_log(Oracle.of(robot), [], [[]], 50, rng)
    log = replace(log, base_angular_velocity_base=spin * value(log.base_angular_velocity_base))
    read = with_imu(Oracle.of(robot), log, frame)
    found, size = bind_log(read, robot, ()), np.abs(value(read.imu_specific_force)).max()
    assert_same_motion(found, bind_log(log, robot, ()), 1e-15 * max(size, 100.0))
    assert found.base.quat_xyzw is None
    if frame == "hips" and spin == 40.0:
        assert size > 300.0, "most of what such an IMU reads is the lever's"


def test_an_imu_beyond_a_force_torque_sensor_is_still_on_the_base(tmp_path: Path) -> None:
    path, rng = machine(tmp_path), np.random.default_rng(2)
    plain, split = load(path), load(path, None, False, SENSORS)
    oracle = Oracle.of(plain)
    log = make_log(oracle, [], [[]], 20, rng)
    assert split.links["hips"][0] != 0
    assert_same_motion(bind_log(with_imu(oracle, log, "hips"), split, ()), bind_log(log, plain, ()))


def test_neither_heading_nor_place_nor_velocity_is_asked_for() -> None:
    robot, oracle, log = recorded()
    samples = bind_log(with_imu(oracle, log, IMU), robot, CONTACTS)
    assert samples.base.rotation is None
    K = Regressor(robot)(*samples.coordinates())
    expected = Regressor(robot)(*map(torch.from_numpy, states_of(log)))
    np.testing.assert_allclose(K, expected, rtol=0.0, atol=1e-12 * float(expected.abs().max()))


def test_gravity_comes_from_the_imu_even_where_the_recorded_orientation_is_off() -> None:
    """The orientation turns world wrenches and nothing else."""
    robot, oracle, log = recorded()
    off = np.tile([0.0, 0.0, 0.0, 1.0], (len(log), 1))
    samples = bind_log(replace(with_imu(oracle, log, IMU), base_quat_xyzw=off), robot, CONTACTS)
    assert_same_motion(samples, bind_log(log, robot, CONTACTS))


def test_a_bolted_robot_needs_neither_imu_nor_pose_and_takes_no_notice_of_them(tmp_path: Path) -> None:
    robot, rng = load(machine(tmp_path), fixed_base=True), np.random.default_rng(3)
    log = make_log(Oracle.of(robot), [], [[]], 10, rng)
    still = np.zeros((10, 3))
    read = replace(log, imu_frame="hand", imu_specific_force=still, imu_angular_velocity=still)
    plain, with_readings = bind_log(log, robot, ()), bind_log(read, robot, ())
    for x, y in zip(plain.coordinates(), with_readings.coordinates(), strict=True):
        torch.testing.assert_close(x, y, rtol=0.0, atol=0.0)


def test_raw_readings_differentiated_by_preprocessing_follow_the_analytic_motion(tmp_path: Path) -> None:
    """A base that turns fast, an IMU 0.4 m off its origin and skew, at 500 Hz."""
    turned = '<origin xyz="0.3 -0.2 0.15" rpy="0.4 -0.7 1.9"/>'
    robot = load(write(tmp_path, BASE, link("imu"), joint("imu_joint", "base", "imu", "fixed", turned)))
    time, (_, T) = uniform(), robot.links["imu"]
    R_world_base, omega = Rotation.from_euler("ZYX", angles(time)), omega_base(time)
    alpha, arm, R_base_imu = slope(omega_base, time), T[:3, 3], Rotation.from_matrix(T[:3, :3])
    at_origin = R_world_base.inv().apply(slope(velocity, time) - GRAVITY)
    force = at_origin + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    log = Log(
        "imu.npz",
        time,
        (),
        position(time)[:, :0],
        imu_frame="imu",
        imu_specific_force=R_base_imu.inv().apply(force),
        imu_angular_velocity=R_base_imu.inv().apply(omega),
    )
    for cutoff, tolerance in ((None, 1e-6), (30.0, 2e-2)):
        out = preprocess(log, cutoff_hz=cutoff)
        found, inside = base_motion(out, robot), np.isin(time, out.time)
        for name, true in zip(MOTION, (at_origin, omega, alpha), strict=True):
            error = np.abs(value(getattr(found, name)).numpy() - true[inside]).max()
            assert error < tolerance * np.abs(true).max(), f"{name}: {error:.1e}"


# ----------------------------------------------------------------------------------------------------- refusals


def refusal(log: Log, robot: Robot, kind: type[InputError] = LogError) -> str:
    return refused(lambda: bind_log(log, robot, CONTACTS), "synthetic.npz: ", kind)


def test_an_imu_on_a_moving_limb_is_refused_with_the_body_it_moves_with() -> None:
    robot, oracle, log = recorded()
    message = refusal(replace(with_imu(oracle, log, IMU), imu_frame="imu_in_torso"), robot)
    assert "imu_frame: 'imu_in_torso' is on torso_link, not on the base" in message
    assert "a frame on the base: pelvis" in message


def test_an_imu_at_a_frame_that_does_not_exist_is_refused_with_the_nearest() -> None:
    robot, oracle, log = recorded()
    message = refusal(replace(with_imu(oracle, log, IMU), imu_frame="imu_in_pelvic"), robot, UnknownNameError)
    assert "'imu_in_pelvic'" in message
    assert IMU in message


def test_an_imu_at_a_frame_that_does_not_exist_is_not_sent_to_a_limb() -> None:
    robot, oracle, log = recorded()
    message = refusal(replace(with_imu(oracle, log, IMU), imu_frame="imu_in_tors"), robot, UnknownNameError)
    assert "imu_in_torso" in robot.links
    assert set(message.split("accepted: ")[1].split(", ")) <= set(robot.bodies[0].links)


@pytest.mark.parametrize("name", ["imu_specific_force", "imu_angular_velocity", "imu_angular_acceleration"])
def test_a_missing_reading_is_named(name: str) -> None:
    robot, oracle, log = recorded()
    assert f"{name}: missing" in refusal(replace(with_imu(oracle, log, IMU), **{name: None}), robot)


@pytest.mark.parametrize("name", POSE)
def test_a_floating_base_without_imu_needs_its_pose(name: str) -> None:
    robot, _, log = recorded()
    message = refusal(replace(log, **{name: None}), robot)
    assert f"{name}: missing" in message
    if name == "base_quat_xyzw":
        assert "imu_specific_force" in message


def test_wrenches_along_world_axes_need_the_orientation_that_no_imu_gives() -> None:
    robot, oracle, log = recorded()
    message = refusal(with_imu(oracle, in_world(oracle, log), IMU), robot)
    assert "contact_wrench_world" in message
    assert "base_quat" in message
    assert "contact_wrench_local" in message
