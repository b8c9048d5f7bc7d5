"""White noise of the recorded motion: its size, and what preprocessing makes of it."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchid.errors import TorchidWarning
from torchid.logs import Log
from torchid.logs.log import SignalNoise
from torchid.logs.preprocess import make_timeline, preprocess
from torchid.logs.signal_noise import signal_noise, white_noise

RATE, COUNT = 500.0, 20_000
TIME = np.arange(COUNT) / RATE


def path(rates_hz: tuple[float, ...] = (1.0, 3.0)) -> np.ndarray:
    return 0.4 * np.sin(2.0 * np.pi * TIME[:, None] * np.array(rates_hz) + 1.0)


def encoders(deviation: tuple[float, ...], seed: int = 0) -> Log:
    noise = np.array(deviation) * np.random.default_rng(seed).normal(size=(COUNT, len(deviation)))
    return Log("encoders.npz", TIME, tuple(f"j{k}" for k in range(len(deviation))), path()[:, : len(deviation)] + noise)


def test_the_noise_of_each_channel_is_found() -> None:
    found = signal_noise(encoders((1e-3, 1e-5)), None)
    np.testing.assert_allclose(found.std["joint_position"], [1e-3, 1e-5], rtol=0.08)
    assert set(found.std) == {"joint_position"}
    assert np.array_equal(found.derivatives, np.diag([1.0, 0.0, 0.0])), "nothing is derived"


def test_what_is_stated_counts_and_zero_means_none() -> None:
    log = replace(encoders((1e-3, 1e-5)), joint_velocity=np.zeros((COUNT, 2)))
    found = signal_noise(log, None, {"joint_position": 0.5, "joint_velocity": 0.25, "specific_force": 1.0})
    assert found.std["joint_position"].tolist() == [0.5, 0.5]
    assert found.std["joint_velocity"].tolist() == [0.25, 0.25]
    assert not signal_noise(log, None, {"joint_position": 0.0}).found


@pytest.mark.parametrize("hertz", [0.1, 1.0, 5.0, 20.0])
def test_motion_is_no_noise(hertz: float) -> None:
    rng = np.random.default_rng(0)
    walk = sum(np.sin(2.0 * np.pi * hertz * k * TIME[:5000, None] / 3.0 + rng.uniform(0.0, 6.0, 4)) for k in (1, 2, 3))
    assert white_noise(TIME[:5000], np.asarray(walk)).max() < 1e-9


def test_noise_that_a_filter_has_smeared_is_not_taken_for_white_noise() -> None:
    smeared = preprocess(Log("walk.npz", TIME, ("a", "b"), encoders((1e-3, 1e-3)).joint_position), 50.0)
    assert not white_noise(smeared.time[:5000], smeared.joint_position[:5000]).any()


def test_rounding_of_a_text_file_is_noise_of_motion_that_crosses_its_steps() -> None:
    rounded = np.round(path((3.0,)), 4)
    assert white_noise(TIME[:5000], rounded[:5000])[0] == pytest.approx(1e-4 / np.sqrt(12.0), rel=0.15)


def test_the_noise_of_an_orientation_is_that_of_its_angles() -> None:
    rng, turn = np.random.default_rng(1), Rotation.from_rotvec(np.stack([0.3 * path()[:, 0], *2 * [0.1 * TIME]], 1))
    noisy = turn * Rotation.from_rotvec(2e-3 * rng.normal(size=(COUNT, 3)))
    log = replace(encoders((0.0,)), base_quat_xyzw=noisy.as_quat())
    np.testing.assert_allclose(signal_noise(log, None).std["base_quat_xyzw"], 2e-3, rtol=0.05)


@pytest.mark.parametrize(("cutoff_hz", "rate_hz"), [(20.0, None), (20.0, 100.0), (None, None)])
def test_covariances_of_derivatives_are_those_of_a_preprocessed_log(
    cutoff_hz: float | None, rate_hz: float | None
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        clean, noisy = (preprocess(encoders((x, x)), cutoff_hz, rate_hz) for x in (0.0, 1e-3))
    names = ("joint_position", "joint_velocity", "joint_acceleration")
    off = np.stack([getattr(noisy, name) - getattr(clean, name) for name in names]) / 1e-3
    expected = noisy.motion_noise
    assert expected is not None
    found = np.einsum("kni,lni->kl", off, off) / off[0].size
    size = np.sqrt(np.diag(found))
    np.testing.assert_allclose(expected.derivatives / np.outer(size, size), found / np.outer(size, size), atol=0.05)
    assert expected.derivatives[0, 2] < -0.3 * size[0] * size[2], "positions and accelerations are off together"


def test_noise_comes_with_the_preprocessed_log_once() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        log = preprocess(encoders((1e-3, 1e-3)), 20.0)
        again = preprocess(log, 20.0)
    assert log.motion_noise is not None
    assert again.motion_noise is log.motion_noise
    whole = replace(log, motion_noise=None, joint_position=path()[: len(log)])
    assert preprocess(whole) is whole, "nothing to derive, and no noise"


def test_short_logs_say_nothing_and_gaps_leave_the_noise_beside_them() -> None:
    log = encoders((1e-3, 1e-3))
    assert not signal_noise(log.select(slice(0, 90)), None).found
    position = log.joint_position.copy()
    position[7::50] = position[20:25, 0] = np.nan
    for time in (log.time, log.time + np.random.default_rng(1).uniform(0.0, 3e-4, len(log))):
        gappy = replace(log, time=time, joint_position=position)
        np.testing.assert_allclose(signal_noise(gappy, None).std["joint_position"], 1e-3, rtol=0.1)
    position[::20] = np.nan  # stretches of 19 samples would do, of 9 none
    position[::10, 1] = np.nan
    found = signal_noise(replace(log, joint_position=position), None).std["joint_position"]
    np.testing.assert_allclose(found, [1e-3, 0.0], rtol=0.2)
    assert not SignalNoise({}).found
    assert make_timeline(TIME, False, None, None) is None


def test_postures_one_after_the_other_are_no_noise() -> None:
    rng = np.random.default_rng(3)
    log = Log("postures.npz", TIME[:500], ("a", "b"), rng.normal(size=(500, 2)), rng.normal(size=(500, 2)))
    assert not signal_noise(log, None).found
    assert signal_noise(log, None, {"joint_velocity": 0.1}).std["joint_velocity"].tolist() == [0.1, 0.1]


@pytest.mark.parametrize(
    ("moving", "said"), [((), "no joint moves by more than"), ((1,), "these accelerations are largely noise")]
)
def test_a_robot_that_stands_still_is_said_to_have_no_motion(moving: tuple[int, ...], said: str) -> None:
    log = encoders((1e-4, 1e-4))
    still = log.joint_position - path() * np.isin([0, 1], moving, invert=True)
    with pytest.warns(TorchidWarning, match=said):
        preprocess(replace(log, joint_position=still), 10.0)
