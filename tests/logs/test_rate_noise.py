"""Accelerations that are noise of what they were derived from."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from motions import value
from scipy.spatial.transform import Rotation

from torchid.errors import TorchidWarning
from torchid.logs import Log
from torchid.logs.preprocess import preprocess

RATE, SIGMA = 500.0, 1e-3


def swinging(sigma: float, sizes: tuple[float, ...] = (0.02, 0.5)) -> Log:
    """Joints that swing at 1 Hz, by so many radians, read by encoders with white noise."""
    time = np.arange(10_000) / RATE
    clean = np.array(sizes) * np.sin(2.0 * np.pi * time[:, None] + np.arange(len(sizes)))
    noise = sigma * np.random.default_rng(0).normal(size=clean.shape)
    return Log("swing.npz", time, tuple(f"joint_{k}" for k in range(len(sizes))), clean + noise)


def said(log: Log, **settings: float) -> str:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TorchidWarning)
        preprocess(log, **settings)
    return " ".join(str(one.message) for one in caught)


def test_a_joint_whose_acceleration_is_noise_is_named_with_the_share_that_is() -> None:
    log, clean = swinging(SIGMA), swinging(0.0)
    text = said(log, cutoff_hz=20.0)
    assert "swing.npz" in text
    assert "joint_0 (" in text
    assert "joint_1" not in text
    share = float(text.split("joint_0 (")[1].split(" %")[0]) / 100.0
    with pytest.warns(TorchidWarning):
        noisy = value(preprocess(log, 20.0).joint_acceleration)[:, 0]
    exact = value(preprocess(clean, 20.0).joint_acceleration)[:, 0]
    assert share == pytest.approx(np.var(noisy - exact) / np.var(noisy), rel=0.1)


def test_the_cutoff_that_is_proposed_is_low_enough() -> None:
    log = swinging(SIGMA)
    proposed = float(said(log, cutoff_hz=20.0).split("set cutoff_hz: ")[1].split(" if")[0])
    assert 2.0 < proposed < 20.0
    assert said(log, cutoff_hz=proposed) == ""


def test_without_a_filter_one_is_proposed_and_recorded_or_clean_accelerations_are_left_alone() -> None:
    log = swinging(SIGMA, (0.5,))
    assert "set preprocessing.cutoff_hz (a low-pass filter)" in said(log)
    assert said(swinging(0.0, (0.5,)), cutoff_hz=20.0) == ""
    rates = {name: np.zeros_like(log.joint_position) for name in ("joint_velocity", "joint_acceleration")}
    assert said(replace(log, **rates), cutoff_hz=20.0) == ""
    assert said(log.select(slice(0, 90)), cutoff_hz=100.0) == "", "too short to say"


def test_a_gyroscope_counts_as_well() -> None:
    log = swinging(0.0, (0.5,))
    rng = np.random.default_rng(1)
    rate = 0.05 * np.sin(2.0 * np.pi * log.time[:, None] + np.arange(3)) + 0.02 * rng.normal(size=(len(log), 3))
    imu = replace(log, imu_frame="base", imu_angular_velocity=rate, imu_specific_force=np.ones((len(log), 3)))
    assert "imu_angular_velocity x (" in said(imu, cutoff_hz=20.0)


def test_uneven_stamps_are_no_noise() -> None:
    time = np.arange(5000) / RATE + np.random.default_rng(2).uniform(-2e-4, 2e-4, 5000)
    log = Log("jitter.npz", time, ("a",), 0.5 * np.sin(2.0 * np.pi * time[:, None]))
    assert said(log, cutoff_hz=20.0) == said(log) == ""


def floating(position_noise: float = 0.0, turn_noise: float = 0.0, velocity: bool = False) -> Log:
    """A base that sways by 5 cm and 0.1 rad at 1 Hz, seen by motion capture, or with its velocity recorded."""
    log, rng = swinging(0.0, (0.5,)), np.random.default_rng(2)
    w, phase = 2.0 * np.pi, log.time[:, None] * 2.0 * np.pi + np.arange(3)
    place = {"base_position_world": 0.05 * np.sin(phase), "base_linear_velocity_world": 0.05 * w * np.cos(phase)}
    name = "base_linear_velocity_world" if velocity else "base_position_world"
    turn = Rotation.from_rotvec(0.1 * np.sin(phase)) * Rotation.from_rotvec(turn_noise * rng.normal(size=phase.shape))
    seen = place[name] + position_noise * rng.normal(size=phase.shape)
    return replace(log, base_quat_xyzw=turn.as_quat(), **{name: seen})


@pytest.mark.parametrize(("noise", "velocity"), [(1e-3, False), (3e-2, True)])
def test_the_linear_acceleration_of_a_base_counts_as_well(noise: float, velocity: bool) -> None:
    log, clean = floating(noise, velocity=velocity), floating(velocity=velocity)
    text = said(log, cutoff_hz=20.0)
    name = f"base_{'linear_velocity' if velocity else 'position'}_world z"
    share = float(text.split(f"{name} (")[1].split(" %")[0]) / 100.0
    with pytest.warns(TorchidWarning):
        noisy = value(preprocess(log, 20.0).base_linear_acceleration_world)[:, 2]
    exact = value(preprocess(clean, 20.0).base_linear_acceleration_world)[:, 2]
    assert share == pytest.approx(np.var(noisy - exact) / np.var(noisy), rel=0.1)
    assert said(clean, cutoff_hz=20.0) == ""


def test_the_angular_acceleration_of_a_base_that_comes_from_its_orientation_counts_as_well() -> None:
    log, clean = floating(turn_noise=1e-3), floating()
    text = said(log, cutoff_hz=20.0)
    share = float(text.split("base_quat_xyzw y (")[1].split(" %")[0]) / 100.0
    with pytest.warns(TorchidWarning):
        noisy = value(preprocess(log, 20.0).base_angular_acceleration_base)[:, 1]
    exact = value(preprocess(clean, 20.0).base_angular_acceleration_base)[:, 1]
    assert share == pytest.approx(np.var(noisy - exact) / np.var(noisy), rel=0.1)


def test_a_base_whose_imu_is_read_needs_no_position() -> None:
    log = floating(1e-3)
    still = {"imu_specific_force": np.ones((len(log), 3)), "imu_angular_velocity": np.zeros((len(log), 3))}
    assert said(replace(log, imu_frame="base", **still), cutoff_hz=20.0) == ""
