"""A base that is turned from the one whose motion logs record: a table that is not level, an IMU mounted askew."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from misread import world
from motions import value
from recordings import GRAVITY, with_imu
from scipy.spatial.transform import Rotation
from synthetic import PANDA, Oracle, load, make_log
from thinned import study_but
from welded import CONTACTS, SENSORS, STATES

from torchid.estimators import LeastSquares
from torchid.fitting.fit import LogFitter
from torchid.fitting.profile import LARGEST_TILT, choose_base_tilt
from torchid.logs import Log
from torchid.problem import RowBuilder, bind_log
from torchid.robot import Robot
from torchid.sensing import named_sensors

TILT = (0.03, -0.05)
TURN = Rotation.from_rotvec([*TILT, 0.0])
VECTORS = ("specific_force", "angular_velocity", "angular_acceleration")


@cache
def skew_machine() -> tuple[Robot, Oracle, Log]:
    """A small one that differs from its URDF, and an exact log of it."""
    w, rng = world(), np.random.default_rng(2)
    contacts = [(contact.frame, len(contact.components)) for contact in CONTACTS]
    return w.robot, w.oracle, make_log(w.oracle, contacts, STATES, 120, rng)


def recorded_askew(log: Log) -> Log:
    """The log of a base that is turned by the inverse of `TILT` in the true one."""
    turned = {name: TURN.apply(value(getattr(log, name))) for name in
              ("base_angular_velocity_base", "base_angular_acceleration_base")}  # fmt: skip
    quat = (Rotation.from_quat(value(log.base_quat_xyzw)) * TURN.inv()).as_quat()
    return replace(log, base_quat_xyzw=quat, **turned)


def test_the_true_base_moves_as_a_log_says_that_records_it() -> None:
    robot, _, log = skew_machine()
    true, found = bind_log(log, robot, CONTACTS), bind_log(recorded_askew(log), tilted(robot), CONTACTS)
    for name in VECTORS:
        x, expected = value(getattr(found.base, name)).numpy(), value(getattr(true.base, name)).numpy()
        np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max(), err_msg=name)
    same = np.abs((value(found.base.quat_xyzw).numpy() * value(true.base.quat_xyzw).numpy()).sum(1))
    np.testing.assert_allclose(same, 1.0, rtol=0.0, atol=1e-14)


def tilted(robot: Robot) -> Robot:
    return replace(robot, base_tilt=TILT)


def test_an_imu_that_is_mounted_askew_reads_the_motion_of_the_true_base() -> None:
    robot, oracle, log = skew_machine()
    read = with_imu(oracle, log, robot.base_link)
    true = bind_log(read, robot, CONTACTS)
    names = ("imu_specific_force", "imu_angular_velocity", "imu_angular_acceleration")
    askew = replace(read, **{name: TURN.apply(value(getattr(read, name))) for name in names})
    found = bind_log(askew, tilted(robot), CONTACTS)
    for name in VECTORS:
        x, expected = value(getattr(found.base, name)).numpy(), value(getattr(true.base, name)).numpy()
        np.testing.assert_allclose(x, expected, rtol=0.0, atol=1e-13 * np.abs(expected).max(), err_msg=name)


def test_a_bolted_arm_stands_on_a_table_as_it_is_turned() -> None:
    robot = load(PANDA, fixed_base=True)
    log = make_log(Oracle.of(robot), [], [[]], 5, np.random.default_rng(0))
    assert bind_log(replace(log, base_quat_xyzw=None), robot, []).base.quat_xyzw is None
    base = bind_log(replace(log, base_quat_xyzw=None), tilted(robot), []).base
    felt = (value(base.rotation).mT.numpy() @ GRAVITY)[0]
    np.testing.assert_allclose(felt, TURN.inv().apply(GRAVITY), rtol=0.0, atol=1e-14)


def fitter_of(robot: Robot, sensors: str) -> LogFitter:
    chosen = named_sensors(sensors, robot.n, len(CONTACTS), ft=len(SENSORS))
    builder = RowBuilder(robot, CONTACTS, chosen)
    return LogFitter(robot=robot, builder=builder, estimator=LeastSquares())


@pytest.mark.parametrize("sensors", study_but(["joints"], ["full", "joints"]))
def test_the_tilt_is_found_and_the_true_robot_leaves_nothing(sensors: str) -> None:
    robot, _, log = skew_machine()
    choice = choose_base_tilt([bind_log(recorded_askew(log), robot, CONTACTS)], fitter_of(robot, sensors))
    np.testing.assert_allclose(choice.value, TILT, rtol=0.0, atol=1e-4)
    assert choice.share is not None
    assert choice.share < 1e-2
    level = choose_base_tilt([bind_log(log, robot, CONTACTS)], fitter_of(robot, sensors))
    np.testing.assert_allclose(level.value, 0.0, rtol=0.0, atol=1e-4)


def test_the_base_of_another_frame_is_no_tilt() -> None:
    """A quarter of a turn about x: the search ends at its bound, and says so."""
    robot, _, log = skew_machine()
    quat = (Rotation.from_quat(value(log.base_quat_xyzw)) * Rotation.from_euler("x", 90, degrees=True)).as_quat()
    samples = bind_log(replace(log, base_quat_xyzw=quat), robot, CONTACTS)
    with pytest.warns(match="0.3 rad, the end of the search range. Is the base's orientation that of another frame"):
        choice = choose_base_tilt([samples], fitter_of(robot, "full"))
    assert max(np.abs(choice.value)) == LARGEST_TILT
