"""Topics of a bag at the stamps of one: whose stamps count, and what interpolation costs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import (
    IMU,
    JOINT_STATE,
    ODOMETRY,
    STAMPS,
    WRENCH,
    imu,
    joint_state,
    joints_at,
    odometry,
    read_messages,
    refusal,
    wrench,
)
from scipy.spatial.transform import Rotation

from torchid.errors import TorchidWarning

# ------------------------------------------------------------------------------------------------------------ stamps


def test_headers_say_when_not_receipts_and_late_messages_fall_into_place(tmp_path: Path) -> None:
    rng, position = np.random.default_rng(1), np.arange(30.0)
    stamps = 10**18 + np.cumsum(rng.integers(1, 5, 30)) * 10**6
    entries = joints_at(stamps, position=position)
    delayed = [(topic, int(stamps[0] + i * 10**6), *rest) for i, (topic, _, *rest) in enumerate(entries)]
    order = np.argsort(np.arange(30) + rng.integers(0, 6, 30))
    for suffix in (".bag", ".mcap", ".db3"):
        log = read_messages(tmp_path / f"x{suffix}", [delayed[i] for i in order])
        np.testing.assert_allclose(log.time, (stamps - stamps[0]) / 1e9, rtol=0, atol=1e-15)
        np.testing.assert_array_equal(log.joint_position[:, 0], position)


def test_receipts_stand_in_for_stamps_that_are_all_zero(tmp_path: Path) -> None:
    entries = [("/joint_states", int(stamp), *rest[2:]) for stamp, rest in zip(STAMPS, joints_at([0] * 4), strict=True)]
    with pytest.warns(TorchidWarning, match=r"x.mcap: /joint_states: no stamps .* times of receipt"):
        log = read_messages(tmp_path / "x.mcap", entries)
    np.testing.assert_array_equal(log.time, [0.0, 1.0, 2.0, 3.0])


def test_messages_that_come_twice_count_once_and_contradictions_are_refused(tmp_path: Path) -> None:
    once = joints_at(STAMPS, position=np.arange(4.0))
    with pytest.warns(TorchidWarning, match="2 duplicate messages are ignored"):
        log = read_messages(tmp_path / "x.bag", [*once, once[2], once[0]])
    np.testing.assert_array_equal(log.joint_position[:, 0], np.arange(4.0))
    other = joints_at(STAMPS[2:3], position=[7.0])
    assert "different messages with the same stamp, 102.000000000 s" in refusal(tmp_path / "x.bag", [*once, *other])


def test_time_that_no_two_topics_share_is_refused_with_their_times(tmp_path: Path) -> None:
    late = [("/imu", s, IMU, imu(s, [0, 0, 9.81], [0, 0, 0])) for s in map(int, STAMPS + 10**12)]
    message = refusal(tmp_path / "x.mcap", joints_at(STAMPS) + late, imu="/imu")
    assert "/imu starts at 1100.000 s, /joint_states ends at 103.000 s" in message


# --------------------------------------------------------------------------------------------------------- alignment


def every(rate: float, start: float, stop: float, jitter: float = 0.0) -> np.ndarray:
    """Stamps [ns], with a jitter of a share of the step."""
    base = np.arange(start * 1e9, stop * 1e9, 1e9 / rate)
    moved = np.random.default_rng(5).uniform(-jitter, jitter, len(base)) * 1e9 / rate
    return (base + moved).astype(np.int64)


HERTZ = 2.0
#: A spline of degree 5 through samples a step h apart reproduces a sine of frequency f to this times (f h)^6 of its
#: amplitude: (2 pi)^6 |B6(1/2) - B6| / 6!, B6 a Bernoulli polynomial, and 5 % that a frequency as low as here may add.
SPLINE = 1.05 * (2 * np.pi) ** 6 * (1 / 42 + 31 / 32 / 42) / 720


def wave(stamps: Any, phases: Any) -> np.ndarray:
    """Sines of amplitude 1, one per phase."""
    return np.sin(2 * np.pi * HERTZ * np.asarray(stamps)[..., None] / 1e9 + np.asarray(phases))


def test_topics_at_other_rates_follow_a_smooth_motion_as_closely_as_a_spline_does(tmp_path: Path) -> None:
    phases, spin = np.arange(6.0), 2 * np.pi * HERTZ * 2.0 * np.array([1, -2, 2]) / 3  # its quaternion has 2 Hz
    entries = joints_at(stamps := every(500, 1.0, 3.0, 0.3))
    for s in map(int, every(130, 0.52, 4.0)):
        value = wave(s, phases)
        entries.append(("/imu", s, IMU, imu(s, value[:3], value[3:])))
    for s in map(int, every(90, 0.1, 3.5)):
        turn = Rotation.from_rotvec(spin * s / 1e9).as_quat() * (-1) ** (s % 2)  # either sign is the same rotation
        entries.append(("/odom", s, ODOMETRY, odometry(s, wave(s, phases[:3]), turn)))
    for s in map(int, every(60, 0.01, 4.0)):
        entries.append(("/wrench", s, WRENCH, wrench(s, wave(s, phases), "sole")))
    log = read_messages(
        tmp_path / "x.mcap",
        entries,
        imu="/imu",
        odometry={"topic": "/odom", "twist": "none", "frame": "base"},
        contact_wrenches={"sole": "/wrench"},
        contact_force_threshold=0.1,
    )
    np.testing.assert_array_equal(log.time, (stamps - stamps[0]) / 1e9)
    assert log.imu_specific_force is not None
    assert log.imu_angular_velocity is not None
    assert log.contact_wrench_local is not None
    assert log.base_quat_xyzw is not None
    force = np.hstack([log.imu_specific_force, log.imu_angular_velocity])
    for values, columns, rate in (
        (force, phases, 130),
        (log.base_position_world, phases[:3], 90),
        (log.contact_wrench_local[:, 0], phases, 60),
    ):
        error = np.abs(values - wave(stamps, columns)).max()
        assert error < SPLINE * (HERTZ / rate) ** 6
        assert error > 1e-3 * SPLINE * (HERTZ / rate) ** 6, "or the test would prove nothing"
    off = Rotation.from_quat(log.base_quat_xyzw).inv() * Rotation.from_rotvec(np.outer(stamps / 1e9, spin))
    assert off.magnitude().max() < 2 * 2 * SPLINE * (HERTZ / 90) ** 6  # four components, and an angle is twice its sine


def test_the_log_may_take_the_stamps_of_any_topic(tmp_path: Path) -> None:
    fast = every(400, 0.1, 2.0, 0.3)
    states = every(100, 0.13, 1.9)
    entries = joints_at(states, position=wave(states, [0.0])[:, 0])
    entries += [("/imu", s, IMU, imu(s, wave(s, [0, 1, 2]), [0, 0, 0])) for s in map(int, fast)]
    log = read_messages(tmp_path / "x.bag", entries, imu="/imu", rate_topic="imu")
    kept = fast[(fast >= states[0]) & (fast <= states[-1])]
    np.testing.assert_array_equal(log.time, (kept - kept[0]) / 1e9)
    np.testing.assert_array_equal(log.imu_specific_force, wave(kept, [0, 1, 2]))
    inner = slice(80, -80)  # a spline knows less at its ends
    error = np.abs(log.joint_position[inner, 0] - wave(kept, [0.0])[inner, 0]).max()
    assert error < SPLINE * (HERTZ / 100) ** 6


def test_gaps_are_not_bridged_and_do_not_matter_outside_of_the_log(tmp_path: Path) -> None:
    wrenches = every(100, 0.01, 4.0)
    torn = wrenches[(wrenches < 2.0e9) | (wrenches > 2.5e9)]
    content = [("/w", s, WRENCH, wrench(s, wave(s, np.arange(6.0)))) for s in map(int, torn)]
    states = joints_at(every(50, 0.5, 3.5, 0.3))
    message = refusal(tmp_path / "x.mcap", states + content, ft_wrenches={"ft": "/w"})
    assert "/w: a gap of 0.5" in message
    assert "median step 0.01" in message
    assert "at most 10 median steps; cut the bag there" in message
    for kept in (states[:60], states[105:]):
        log = read_messages(tmp_path / "x.mcap", kept + content, ft_wrenches={"ft": "/w"})
        assert log.ft_wrench is not None
        stamps = np.array([stamp for _, stamp, *_ in kept])
        np.testing.assert_allclose(log.ft_wrench[:, 0], wave(stamps, np.arange(6.0)), rtol=0.0, atol=1e-7)


def test_what_was_not_measured_is_not_interpolated(tmp_path: Path) -> None:
    states = every(100, 0.1, 1.0)
    effort = wave(states, [0.0, 1.0, 2.0])
    effort[:, 1], effort[40, 2] = np.nan, np.nan
    entries = [
        ("/joint_states", s, JOINT_STATE, joint_state(s, "abc", position=np.zeros(3), effort=x))
        for s, x in zip(map(int, states), effort, strict=True)
    ]
    entries += [("/imu", s, IMU, imu(s, [0, 0, 9.81], [0, 0, 0])) for s in map(int, every(90, 0.2, 0.8))]
    with pytest.warns(
        TorchidWarning,
        match="/joint_states: joint_torque: NaN in some samples; after interpolation all samples are NaN",
    ):
        log = read_messages(tmp_path / "x.bag", entries, imu="/imu", rate_topic="imu")
    assert log.joint_torque is not None
    assert np.isnan(log.joint_torque).all(axis=0).tolist() == [False, True, True]
    assert np.isnan(log.joint_torque).any(axis=0).tolist() == [False, True, True]
