"""The low-pass filter: phase, gain, what it spoils, and what it costs."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest
from motions import RATE, jittered, moving_log, position, sine_log, uniform, value

from torchid.logs import Log
from torchid.logs.log import FloatArray
from torchid.logs.preprocess import preprocess
from torchid.logs.timeline import lay_out_timeline, spline_derivatives
from torchid.settings import AUTO


@pytest.mark.parametrize("hertz", [3.0, 10.0, 20.0, 40.0, 100.0])
@pytest.mark.parametrize("time", [uniform(), jittered()], ids=["uniform", "jittered"])
def test_a_sine_keeps_its_phase_and_loses_the_butterworth_share(time: FloatArray, hertz: float) -> None:
    out = preprocess(sine_log(hertz, time), cutoff_hz=20.0)
    middle = out.select((out.time > 1.0) & (out.time < 3.0))
    warp = np.tan(np.pi * hertz / RATE) / np.tan(np.pi * 20.0 / RATE)
    gain = 1 / (1 + warp**8)  # 1/2 at the cutoff, 3e-6 at five times the cutoff
    angle = 2 * np.pi * hertz * middle.time + 0.7
    rate = 2 * np.pi * hertz
    # up to the quintic spline through 12 samples a period (40 Hz), or 5 (100 Hz) which the jitter spreads
    accuracy = 1e-5 if hertz <= 20 else 2e-4 if hertz <= 40 else 2e-3
    np.testing.assert_allclose(middle.joint_position[:, 0], gain * np.sin(angle), rtol=0.0, atol=accuracy)
    np.testing.assert_allclose(value(middle.joint_velocity)[:, 0] / rate, gain * np.cos(angle), rtol=0.0, atol=accuracy)


@pytest.mark.parametrize("rate", [None, 100.0, 137.0])
def test_the_share_of_noise_that_is_left_does_not_depend_on_the_rate_afterwards(rate: float | None) -> None:
    t = uniform(400.0)
    noise = np.random.default_rng(7).standard_normal((len(t), 4))
    log = Log("noise.npz", t, ("a", "b", "c", "d"), np.zeros((len(t), 4)), joint_torque=noise)
    out = preprocess(log, 12.0, rate)
    share = value(out.noise_share)
    assert share == pytest.approx(out.noise_bandwidth_hz / (RATE / 2), rel=1e-9)
    # 400 s hold some 40,000 independent values
    assert np.mean(value(out.joint_torque) ** 2) == pytest.approx(share, rel=0.03)


def test_every_channel_passes_the_same_filter() -> None:
    rng = np.random.default_rng(2)
    t = jittered(2.0)
    noise = rng.standard_normal(len(t))
    three, wrench = np.tile(noise[:, None], 3), np.tile(noise[:, None, None], (1, 1, 6))
    log = Log(
        "noise.npz",
        t,
        ("a",),
        noise[:, None],
        joint_velocity=noise[:, None],
        joint_acceleration=noise[:, None],
        joint_torque=noise[:, None],
        base_position_world=three,
        base_linear_velocity_world=three,
        base_linear_acceleration_world=three,
        base_angular_velocity_base=three,
        base_angular_acceleration_base=three,
        contact_names=("foot",),
        contact_active=np.ones((len(t), 1), bool),
        contact_wrench_world=wrench,
    )
    out = preprocess(log, cutoff_hz=30.0, sample_rate_hz=100.0)
    for name, array in out.arrays().items():
        if name not in ("time", "contact_active"):
            columns = array.reshape(len(out), -1)
            np.testing.assert_allclose(
                columns, np.tile(out.joint_position, columns.shape[1]), rtol=0.0, atol=1e-13, err_msg=name
            )
    assert out.arrays().keys() == log.arrays().keys()
    assert 0.2 < np.std(out.joint_position) < 0.45  # white noise keeps 30 Hz of 250 Hz of its power


def test_filters_and_splines_lose_only_the_stated_ends() -> None:
    t = uniform(2.0)
    log = sine_log(1.0, t)
    assert np.array_equal(preprocess(log).time, t[2:-2])
    np.testing.assert_array_equal(preprocess(log, cutoff_hz=10.0).time, t[100:-100])  # 2 periods of 10 Hz
    complete = dataclasses.replace(log, joint_velocity=log.joint_position, joint_acceleration=log.joint_position)
    resampled = preprocess(complete, sample_rate_hz=50.0)
    np.testing.assert_allclose(resampled.time, np.arange(100) / 50, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(
        preprocess(log, sample_rate_hz=50.0).time, 0.004 + np.arange(100) / 50, rtol=0.0, atol=1e-12
    )


def test_what_the_kept_ends_of_a_filtered_log_are_off_by() -> None:
    rng = np.random.default_rng(1)
    t = uniform(12.0, 200.0)
    long = Log("x", t, ("a",), np.sin(9 * t + 0.4)[:, None] + 0.05 * rng.standard_normal((len(t), 1)))
    whole = preprocess(long, cutoff_hz=6.0)
    part = preprocess(long.select(slice(800, 1600)), cutoff_hz=6.0)
    same = whole.select(np.isin(whole.time, part.time))
    for name, share in (("joint_position", 0.002), ("joint_velocity", 0.003), ("joint_acceleration", 0.01)):
        error = np.abs(value(getattr(part, name)) - value(getattr(same, name)))
        scale = np.sqrt(np.mean(value(getattr(same, name)) ** 2))
        assert np.max(error) < share * scale, name
        assert np.max(error[100:-100]) < 1e-4 * scale, name


def test_noise_at_the_kept_ends_of_an_unfiltered_log_is_that_of_its_inside() -> None:
    t = uniform(0.2)
    out = preprocess(Log("x", t, tuple(map(str, range(len(t)))), np.eye(len(t))))
    for array in (value(out.joint_velocity), value(out.joint_acceleration)):
        gain = np.linalg.norm(array, axis=1)
        assert np.max(gain) < 1.4 * gain[len(gain) // 2]


def test_a_complete_log_is_returned_as_is() -> None:
    t = uniform(1.0)
    log = preprocess(moving_log(t, base_position_world=position(t)))
    assert preprocess(log) is log
    bare = dataclasses.replace(log, base_position_world=None, base_linear_velocity_world=None)
    assert preprocess(bare) is bare


def test_deriving_alone_copies_nothing_that_the_log_gives() -> None:
    t = uniform(1.0)
    torque = np.where(np.arange(len(t))[:, None] % 7, np.nan, np.ones((len(t), 3)))
    log = moving_log(t, base_position_world=position(t), joint_torque=torque)
    out = preprocess(log)
    for name in ("time", "joint_position", "joint_torque", "base_position_world"):
        assert np.shares_memory(getattr(out, name), getattr(log, name)), name


@pytest.mark.parametrize("samples", [300, 3_000, 20_000])
def test_a_channel_among_others_is_filtered_as_it_is_alone(samples: int) -> None:
    low_pass = lay_out_timeline(np.arange(samples) / RATE, 20.0, None, differentiates=False).low_pass
    assert low_pass is not None
    channels = np.random.default_rng(0).standard_normal((samples, 7, 2))
    together = low_pass(channels)
    for place in np.ndindex(7, 2):
        np.testing.assert_array_equal(together[(slice(None), *place)], low_pass(channels[(slice(None), *place)]))


def test_memory_stays_within_three_times_the_log() -> None:
    t = jittered(120.0)
    channels = np.sin(t[:, None] + np.arange(12))
    log = Log("x", t, tuple("abcdefghijkl"), channels, joint_torque=channels)
    size = sum(array.nbytes for array in log.arrays().values())
    tracemalloc.start()
    preprocess(log, cutoff_hz=20.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * size


def test_one_spline_and_a_chain_of_short_ones_are_the_same() -> None:
    t = jittered(4.0)
    values, at = position(t), np.linspace(t[0], t[-1], 1234)
    whole = spline_derivatives(t, values, at, (0, 1, 2), block=10**6)
    for one, other in zip(whole, spline_derivatives(t, values, at, (0, 1, 2), block=100), strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12 * np.max(np.abs(one)))


@pytest.mark.parametrize("time", [uniform(), jittered()], ids=["uniform", "jittered"])
@pytest.mark.parametrize(("cutoff", "each"), [(10.0, 10), (11.0, 9), (9.99, 10), (60.0, 1), (150.0, 1)])
def test_of_a_filtered_log_as_few_samples_are_kept_as_are_five_times_the_cutoff(
    time: FloatArray, cutoff: float, each: int
) -> None:
    log = sine_log(1.0, time)
    every, few = preprocess(log, cutoff), preprocess(log, cutoff, AUTO)
    assert RATE / each >= 5.0 * cutoff or each == 1
    np.testing.assert_array_equal(few.time, every.time[::each])
    for name in ("joint_position", "joint_velocity", "joint_acceleration"):
        np.testing.assert_array_equal(value(getattr(few, name)), value(getattr(every, name))[::each])


def test_without_a_filter_all_samples_are_kept() -> None:
    derived = preprocess(sine_log(1.0, uniform()))
    np.testing.assert_array_equal(preprocess(sine_log(1.0, uniform()), sample_rate_hz=AUTO).time, derived.time)
    assert preprocess(derived, sample_rate_hz=AUTO) is derived


@pytest.mark.parametrize("time", [uniform(), jittered()], ids=["uniform", "jittered"])
@pytest.mark.parametrize("given", ["joint_position", "joint_velocity"])
def test_dry_friction_is_smeared_as_the_filter_smears_its_torque(time: FloatArray, given: str) -> None:
    angle = 2 * np.pi * 1.3 * time[:, None] + np.array([0.3, 2.0])
    q, v = np.sin(angle) / (2 * np.pi * 1.3), np.cos(angle)
    log = Log("friction.npz", time, ("a", "b"), q, v if given == "joint_velocity" else None, joint_torque=np.sign(v))
    for rate in (None, 100.0):
        out = preprocess(log, cutoff_hz=10.0, sample_rate_hz=rate)
        sign, torque = np.sign(value(out.joint_velocity)), value(out.joint_torque)
        off = np.abs(value(out.joint_direction) - torque)
        assert off.max() < 0.06  # a recorded sign reverses at a sample, half a step off
        assert np.sqrt(np.mean(off**2)) < 0.05 * np.sqrt(np.mean((sign - torque) ** 2))
        assert np.abs(sign - torque).max() > 0.9
        again = preprocess(out, sample_rate_hz=50.0)
        np.testing.assert_allclose(value(again.joint_direction)[:, 0], value(again.joint_torque)[:, 0], atol=0.06)
    assert preprocess(log).joint_direction is None
    assert preprocess(log, sample_rate_hz=100.0).joint_direction is None
    assert "joint_direction" not in out.arrays()
    np.testing.assert_array_equal(value(out.select(slice(3, 9)).joint_direction), value(out.joint_direction)[3:9])


def test_a_joint_at_rest_has_no_direction() -> None:
    log = Log("rest.npz", uniform(2.0), ("a",), np.ones((len(uniform(2.0)), 1)))
    assert not value(preprocess(log, cutoff_hz=10.0).joint_direction).any()


@pytest.mark.parametrize("time", [uniform(), jittered()], ids=["uniform", "jittered"])
@pytest.mark.parametrize("given", ["joint_position", "joint_velocity"])
def test_friction_that_reverses_over_a_width_is_smeared_as_well(time: FloatArray, given: str) -> None:
    width, angle = 0.08, 2 * np.pi * 1.3 * time[:, None] + np.array([0.3, 2.0])
    q, v = np.sin(angle) / (2 * np.pi * 1.3), np.cos(angle)
    torque = np.tanh(v / width)
    log = Log("friction.npz", time, ("a", "b"), q, v if given == "joint_velocity" else None, joint_torque=torque)

    def off(sign_width: float | None) -> float:
        out = preprocess(log, cutoff_hz=10.0, sign_width=sign_width)
        return float(np.abs(value(out.joint_direction) - value(out.joint_torque)).max())

    assert off(width) < 0.02  # the width acts on what is left of the velocity by the filter
    assert off(None) > 10 * off(width)
    sharp = preprocess(log, cutoff_hz=10.0, sign_width=1e-9)
    np.testing.assert_allclose(
        value(sharp.joint_direction), value(preprocess(log, cutoff_hz=10.0).joint_direction), rtol=0.0, atol=1e-6
    )
