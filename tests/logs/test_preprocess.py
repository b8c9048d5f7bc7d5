"""Preprocessing: derivatives against analytic motions, and what is refused."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from motions import (
    RATE,
    assert_analytic,
    jittered,
    moving_log,
    omega_base,
    position,
    sine_log,
    slope,
    uniform,
    value,
    velocity,
)
from repository import SHARED
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import Log, read_log
from torchid.logs.log import FloatArray
from torchid.logs.preprocess import preprocess
from torchid.logs.quaternion import (
    angular_acceleration_base,
    angular_velocity_base,
    make_sign_continuous,
    rotate_to_world,
)


@pytest.mark.parametrize("time", [uniform(), jittered(), 1e4 + uniform()], ids=["uniform", "jittered", "late"])
def test_derivatives_of_a_base_that_turns_around_several_times_are_analytic(time: FloatArray) -> None:
    log = moving_log(time, base_position_world=position(time))
    quat = value(log.base_quat_xyzw)
    assert np.any(np.sum(quat[1:] * quat[:-1], axis=1) < 0)  # q changes sign on the way
    # late stamps are rounded to 2e-12 s, which a second derivative at 500 Hz multiplies by 1e6
    assert_analytic(preprocess(log), 1e-5 if time[0] > 1 else 3e-7)


def test_derivatives_are_those_of_the_quantity_given_last() -> None:
    t = uniform()
    marked = moving_log(
        t,
        joint_velocity=velocity(t) + 7.0,
        base_linear_velocity_world=velocity(t) + 7.0,
        base_position_world=position(t),
        base_angular_velocity_base=omega_base(t) + 7.0,
    )
    out = preprocess(marked)
    inside = slice(2, -2)
    np.testing.assert_array_equal(out.joint_velocity, velocity(t)[inside] + 7.0)
    np.testing.assert_array_equal(out.base_linear_velocity_world, velocity(t)[inside] + 7.0)
    np.testing.assert_array_equal(out.base_angular_velocity_base, omega_base(t)[inside] + 7.0)
    np.testing.assert_allclose(value(out.joint_acceleration), slope(velocity, t)[inside], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(
        value(out.base_linear_acceleration_world), slope(velocity, t)[inside], rtol=0.0, atol=1e-6
    )
    np.testing.assert_allclose(
        value(out.base_angular_acceleration_base), slope(omega_base, t)[inside], rtol=0.0, atol=1e-5
    )


def test_accelerations_that_the_log_gives_are_used() -> None:
    t = uniform()
    log = moving_log(
        t,
        joint_acceleration=np.full((len(t), 3), 3.0),
        base_linear_acceleration_world=np.full((len(t), 3), 4.0),
        base_angular_acceleration_base=np.full((len(t), 3), 5.0),
    )
    out = preprocess(log)
    assert np.all(value(out.joint_acceleration) == 3.0)
    assert np.all(value(out.base_linear_acceleration_world) == 4.0)
    assert np.all(value(out.base_angular_acceleration_base) == 5.0)
    np.testing.assert_allclose(value(out.base_angular_velocity_base), omega_base(out.time), rtol=0.0, atol=1e-6)
    assert out.base_linear_velocity_world is None  # the equations of motion do without it


@pytest.mark.parametrize("time", [uniform(), jittered()], ids=["uniform", "jittered"])
@pytest.mark.parametrize("sample_rate", [None, 123.0])
def test_a_filter_far_above_the_motion_leaves_it_as_it_was(time: FloatArray, sample_rate: float | None) -> None:
    out = preprocess(moving_log(time, base_position_world=position(time)), 40.0, sample_rate)
    # what the filter does not know of the ends, then what is left inside
    assert_analytic(out, 0.03)
    assert_analytic(out.select(slice(len(out) // 4, -len(out) // 4)), 1e-5)
    np.testing.assert_allclose(np.diff(out.time), 1 / (sample_rate or RATE), rtol=0.01 if sample_rate is None else 1e-9)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.sampled_from([None, 40.0]))
def test_turning_the_world_changes_no_angular_rate_in_the_base_frame(
    turn: tuple[float, float, float], cutoff: float | None
) -> None:
    t = uniform(0.6)
    log = moving_log(t, base_position_world=position(t))
    world = Rotation.from_rotvec(turn)
    turned = dataclasses.replace(
        log,
        base_quat_xyzw=(world * Rotation.from_quat(value(log.base_quat_xyzw))).as_quat(),
        base_position_world=world.apply(value(log.base_position_world)),
    )
    one, other = preprocess(log, cutoff), preprocess(turned, cutoff)
    # a rounding of 1e-16 is multiplied by 5 * 500^2 in a second derivative
    np.testing.assert_allclose(
        value(one.base_angular_velocity_base), value(other.base_angular_velocity_base), rtol=0.0, atol=1e-11
    )
    np.testing.assert_allclose(
        value(one.base_angular_acceleration_base), value(other.base_angular_acceleration_base), rtol=0.0, atol=1e-8
    )
    expected = world.apply(value(one.base_linear_acceleration_world))
    np.testing.assert_allclose(expected, value(other.base_linear_acceleration_world), rtol=0.0, atol=1e-8)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_angular_rates_do_not_depend_on_the_length_of_the_quaternion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, d, dd = rng.standard_normal((3, 8, 4))
    s, sd, sdd = rng.uniform(0.5, 2, (8, 1)), *rng.standard_normal((2, 8, 1))
    scaled = (s * q, sd * q + s * d, sdd * q + 2 * sd * d + s * dd)
    scale = 1 + np.max(np.sum(np.abs([d, dd]), axis=(0, 2)) / np.linalg.norm(q, axis=1)) ** 2
    np.testing.assert_allclose(
        angular_velocity_base(*scaled[:2]), angular_velocity_base(q, d), rtol=0.0, atol=1e-13 * scale
    )
    np.testing.assert_allclose(
        angular_acceleration_base(*scaled), angular_acceleration_base(q, d, dd), rtol=0.0, atol=1e-12 * scale
    )


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(st.booleans(), min_size=400, max_size=400))
def test_flipping_signs_of_quaternions_changes_nothing(flips: list[bool]) -> None:
    t = uniform(0.8)
    quat = make_sign_continuous(value(moving_log(t).base_quat_xyzw))
    flipped = make_sign_continuous(quat * np.where(flips, -1.0, 1.0)[:, None])
    assert np.all(np.sum(flipped[1:] * flipped[:-1], axis=1) > 0)
    np.testing.assert_array_equal(flipped * np.sign(flipped[0] @ quat[0]), quat)


def test_rotating_vectors_agrees_with_scipy() -> None:
    rotation = Rotation.random(50, random_state=np.random.default_rng(3))
    vector = np.random.default_rng(4).standard_normal((50, 3))
    np.testing.assert_allclose(
        rotate_to_world(rotation.as_quat(), vector), rotation.apply(vector), rtol=0.0, atol=1e-15
    )


def test_a_robot_without_joints_is_preprocessed() -> None:
    t = uniform(1.0)
    none = np.zeros((len(t), 0))
    log = dataclasses.replace(
        moving_log(t, base_position_world=position(t)), joint_names=(), joint_position=none, joint_torque=none
    )
    for out in (preprocess(log), preprocess(log, 20.0), preprocess(log, 20.0, 50.0)):
        assert value(out.joint_acceleration).shape == value(out.joint_torque).shape == (len(out), 0)
        assert value(out.base_angular_acceleration_base).shape == (len(out), 3)


@pytest.mark.parametrize("samples", [5, 6, 7])
def test_very_short_logs_are_differentiated_as_well_as_they_can_be(samples: int) -> None:
    t = uniform(samples / 10, 10.0)
    out = preprocess(Log("x", t, ("a",), (t**3)[:, None]))  # a cubic: exact for splines of degree 3 and 5
    np.testing.assert_allclose(value(out.joint_velocity)[:, 0], 3 * out.time**2, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(value(out.joint_acceleration)[:, 0], 6 * out.time, rtol=0.0, atol=1e-11)
    assert len(out) == samples - 4


@pytest.mark.parametrize(
    ("time", "arguments", "found"),
    [
        (uniform(4 / RATE), {}, "4 samples; accepted: at least 5"),
        (uniform(1 / RATE), {"sample_rate_hz": 10.0}, "1 sample;"),
        (uniform(0.1), {"cutoff_hz": 20.0}, "0.098 s (50 samples); accepted: more than 0.2 s"),
        (uniform(10 / RATE), {"cutoff_hz": 200.0}, "10 samples"),
        (np.append(uniform(), 5.0), {}, "a step of 1.002 s after sample 1999"),
        (uniform()[::-1].copy(), {}, "after 3.998 at sample 0"),
    ],
)
def test_time_stamps_that_do_not_do_are_named(time: FloatArray, arguments: dict[str, float], found: str) -> None:
    with pytest.raises(LogError) as caught:
        preprocess(sine_log(1.0, time), **arguments)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("sine.npz: time: ")
    assert found in str(caught.value)


@pytest.mark.parametrize("wrong", [0.0, -3.0, 250.0, 1e9, float("nan"), float("inf"), True, "20"])
def test_cutoffs_outside_zero_to_nyquist_are_refused(wrong: Any) -> None:
    with pytest.raises(InputError, match=r"sine.npz: preprocessing.cutoff_hz: .*accepted: .*below 250 Hz"):
        preprocess(sine_log(1.0, uniform()), cutoff_hz=wrong)


def test_a_cutoff_that_no_stamps_in_ms_allow_is_answered_with_the_unit() -> None:
    with pytest.raises(InputError, match=r"cutoff_hz: 8.0; .*below 0.25 Hz, .*steps of 2 s: are stamps in seconds\?\)"):
        preprocess(sine_log(1.0, 1e3 * uniform()), cutoff_hz=8.0)
    with pytest.raises(InputError, match="median sample rate$"):
        preprocess(sine_log(1.0, uniform()), cutoff_hz=300.0)


@pytest.mark.parametrize("time", [uniform(), jittered()], ids=["uniform", "jittered"])
@pytest.mark.parametrize("each", [1, 4, 5])
def test_a_rate_that_divides_the_logs_keeps_every_kth_of_its_samples(time: FloatArray, each: int) -> None:
    log = moving_log(time, base_position_world=position(time), joint_torque=np.cos(9.0 * position(time)))
    rate = 1.0 / np.median(np.diff(log.time))  # of the grid that jittered stamps are filtered on
    every, some = preprocess(log, 20.0), preprocess(log, 20.0, rate / each)
    for name in ("time", "joint_acceleration", "base_angular_acceleration_base", "joint_torque", "joint_direction"):
        np.testing.assert_array_equal(value(getattr(some, name)), value(getattr(every, name))[::each], err_msg=name)
    assert some.noise_bandwidth_hz == every.noise_bandwidth_hz


@pytest.mark.parametrize("wrong", [0.0, -3.0, 5000.1, float("nan"), float("inf")])
def test_sample_rates_that_only_invent_samples_are_refused(wrong: float) -> None:
    with pytest.raises(InputError, match=r"preprocessing.sample_rate_hz: .*below 5000 Hz"):
        preprocess(sine_log(1.0, uniform()), sample_rate_hz=wrong)


def test_a_cutoff_below_the_bases_turning_is_refused() -> None:
    t = uniform(20.0, 100.0)
    quat = Rotation.from_rotvec(np.outer(t, [0, 0, 2 * np.pi * 4])).as_quat()  # 4 turns a second: q swings at 2 Hz
    log = Log("spin.npz", t, ("a",), t[:, None], base_quat_xyzw=quat, base_position_world=np.zeros((len(t), 3)))
    with pytest.raises(InputError, match=r"preprocessing.cutoff_hz: .*removes the base's rotation"):
        preprocess(log, cutoff_hz=1.0)
    out = preprocess(log, cutoff_hz=10.0)
    np.testing.assert_allclose(value(out.base_angular_velocity_base)[200:-200, 2], 8 * np.pi, rtol=1e-9)


def test_stamps_that_nearly_coincide_are_worth_a_warning() -> None:
    t = uniform(1.0)
    t[100] = t[99] + 1e-5
    with pytest.warns(TorchidWarning, match="time: a step of 1e-05 s after sample 99") as caught:
        preprocess(sine_log(1.0, t))
    assert Path(caught[0].filename) == Path(__file__)


def test_an_orientation_alone_says_how_a_bolted_base_is_mounted_and_no_more() -> None:
    assert preprocess(moving_log(uniform())).base_linear_acceleration_world is None


def test_values_that_are_not_finite_are_refused() -> None:
    t = uniform(1.0)
    for name in ("joint_position", "joint_velocity"):
        log = sine_log(1.0, t, **({} if name == "joint_position" else {name: np.zeros((len(t), 1))}))
        getattr(log, name)[7] = np.nan
        with pytest.raises(LogError, match=f"{name}: nan at sample 7, a"):
            preprocess(log)


def test_the_real_logs_give_plausible_motions() -> None:
    if not SHARED.is_dir():
        pytest.skip(f"no real logs at {SHARED}")
    kuka = preprocess(read_log(SHARED / "kuka_lwr4" / "run1.npz"), cutoff_hz=5.0, sample_rate_hz=100.0)
    np.testing.assert_allclose(np.diff(kuka.time), 0.01, rtol=1e-9)  # its own stamps are jittered by 35 %
    assert np.max(np.abs(value(kuka.joint_acceleration))) < 5.0
    squats = preprocess(read_log(SHARED / "human_squats" / "squats1.npz"), cutoff_hz=6.0)
    assert np.max(np.abs(value(squats.base_angular_velocity_base))) < 3.0
    np.testing.assert_allclose(  # who starts and ends upright has no mean acceleration
        np.mean(value(squats.base_linear_acceleration_world), axis=0), 0.0, atol=0.05
    )
