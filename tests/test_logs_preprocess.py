"""Preprocessing: derivatives against analytic motions, filters without lag, and what happens to gaps and ends."""

from __future__ import annotations

import dataclasses
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import Log, preprocess, read_log
from torchid.logs.fields import FloatArray
from torchid.logs.quaternion import angular_acceleration_base, angular_velocity_base, rotate, sign_continuous
from torchid.logs.spline import spline_derivatives

DATA = Path(__file__).parents[1].parent / "shared" / "data"
RATE = 500.0


def angles(t: NDArray[Any]) -> NDArray[Any]:
    """Yaw, pitch and roll of a base that turns 3.5 times around in 4 s while it rocks."""
    return np.stack([5.5 * t + 0.5 * np.sin(3 * t), 0.8 * np.sin(4 * t + 0.3), 0.6 * np.cos(5 * t) - 0.2], axis=-1)


def slope(path: Any, t: FloatArray) -> FloatArray:
    """Derivative of an analytic function by a complex step: exact to machine precision."""
    return np.asarray(path(t + 1e-30j).imag / 1e-30)


def omega_base(t: NDArray[Any]) -> NDArray[Any]:
    """Angular velocity in the base frame from the rates of the angles; textbook formula for z-y-x angles."""
    _, pitch, roll = np.moveaxis(angles(t), -1, 0)
    yaw_rate = 5.5 + 1.5 * np.cos(3 * t)
    pitch_rate, roll_rate = 3.2 * np.cos(4 * t + 0.3), -3.0 * np.sin(5 * t)
    return np.stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
            -pitch_rate * np.sin(roll) + yaw_rate * np.cos(roll) * np.cos(pitch),
        ],
        axis=-1,
    )


def position(t: NDArray[Any]) -> NDArray[Any]:
    """A position on a curved path [m]."""
    return np.stack([np.sin(2 * t) + 0.1 * t, 0.3 * np.cos(6 * t + 1), 0.2 * np.sin(5 * t) * np.cos(t)], axis=-1)


def velocity(t: NDArray[Any]) -> NDArray[Any]:
    """Its velocity [m/s]."""
    return np.stack(
        [
            2 * np.cos(2 * t) + 0.1,
            -1.8 * np.sin(6 * t + 1),
            np.cos(5 * t) * np.cos(t) - 0.2 * np.sin(5 * t) * np.sin(t),
        ],
        axis=-1,
    )


def moving_log(time: FloatArray, **fields: Any) -> Log:
    """A free base with one joint on the analytic path, positions only unless `fields` say more."""
    quat = Rotation.from_euler("ZYX", angles(time)).as_quat(canonical=True)  # w >= 0: signs jump
    return Log("moving.npz", time, ("a", "b", "c"), position(time), **{"base_quat_xyzw": quat, **fields})


def uniform(seconds: float = 4.0, rate: float = RATE) -> FloatArray:
    """Uniform stamps [s]."""
    return np.asarray(np.arange(round(seconds * rate)) / rate, dtype=np.float64)


def jittered(seconds: float = 4.0, rate: float = RATE) -> FloatArray:
    """Stamps that are off by up to 30 % of a step [s]."""
    time = uniform(seconds, rate)
    return time + np.random.default_rng(0).uniform(-0.3, 0.3, len(time)) / rate


def value(array: Any) -> Any:
    """The array, which must be there."""
    assert array is not None
    return array


def assert_analytic(log: Log, tolerance: float) -> None:
    """Every derivative of `moving_log` is the analytic one, to `tolerance` times its largest value."""
    t = log.time
    world_base = Rotation.from_euler("ZYX", angles(t))
    expected = {
        "joint_position": position(t),
        "joint_velocity": velocity(t),
        "joint_acceleration": slope(velocity, t),
        "base_linear_velocity_world": velocity(t),
        "base_linear_acceleration_world": slope(velocity, t),
        "base_angular_velocity_base": omega_base(t),
        "base_angular_acceleration_base": slope(omega_base, t),
    }
    for name, truth in expected.items():
        error = np.max(np.abs(value(getattr(log, name)) - truth)) / np.max(np.abs(truth))
        assert error < tolerance, f"{name}: {error:.1e}"
    turned = (Rotation.from_quat(value(log.base_quat_xyzw)).inv() * world_base).magnitude()
    assert np.max(turned) < tolerance
    np.testing.assert_allclose(np.linalg.norm(value(log.base_quat_xyzw), axis=1), 1, rtol=1e-15)


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
    np.testing.assert_allclose(value(out.joint_acceleration), slope(velocity, t)[inside], atol=1e-6)
    np.testing.assert_allclose(value(out.base_linear_acceleration_world), slope(velocity, t)[inside], atol=1e-6)
    np.testing.assert_allclose(value(out.base_angular_acceleration_base), slope(omega_base, t)[inside], atol=1e-5)


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
    np.testing.assert_allclose(value(out.base_angular_velocity_base), omega_base(out.time), atol=1e-6)
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
        value(one.base_angular_velocity_base), value(other.base_angular_velocity_base), atol=1e-11
    )
    np.testing.assert_allclose(
        value(one.base_angular_acceleration_base), value(other.base_angular_acceleration_base), atol=1e-8
    )
    expected = world.apply(value(one.base_linear_acceleration_world))
    np.testing.assert_allclose(expected, value(other.base_linear_acceleration_world), atol=1e-8)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1))
def test_angular_rates_do_not_depend_on_the_length_of_the_quaternion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, d, dd = rng.standard_normal((3, 8, 4))
    s, sd, sdd = rng.uniform(0.5, 2, (8, 1)), *rng.standard_normal((2, 8, 1))
    scaled = (s * q, sd * q + s * d, sdd * q + 2 * sd * d + s * dd)
    scale = 1 + np.max(np.sum(np.abs([d, dd]), axis=(0, 2)) / np.linalg.norm(q, axis=1)) ** 2
    np.testing.assert_allclose(angular_velocity_base(*scaled[:2]), angular_velocity_base(q, d), atol=1e-13 * scale)
    np.testing.assert_allclose(
        angular_acceleration_base(*scaled), angular_acceleration_base(q, d, dd), atol=1e-12 * scale
    )


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(st.booleans(), min_size=400, max_size=400))
def test_flipping_signs_of_quaternions_changes_nothing(flips: list[bool]) -> None:
    t = uniform(0.8)
    quat = sign_continuous(value(moving_log(t).base_quat_xyzw))
    flipped = sign_continuous(quat * np.where(flips, -1.0, 1.0)[:, None])
    assert np.all(np.sum(flipped[1:] * flipped[:-1], axis=1) > 0)
    np.testing.assert_array_equal(flipped * np.sign(flipped[0] @ quat[0]), quat)


def test_rotating_vectors_agrees_with_scipy() -> None:
    rotation = Rotation.random(50, random_state=np.random.default_rng(3))
    vector = np.random.default_rng(4).standard_normal((50, 3))
    np.testing.assert_allclose(rotate(rotation.as_quat(), vector), rotation.apply(vector), atol=1e-15)


def sine_log(hertz: float, time: FloatArray, **fields: Any) -> Log:
    """One joint that swings at one frequency."""
    return Log("sine.npz", time, ("a",), np.sin(2 * np.pi * hertz * time + 0.7)[:, None], **fields)


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
    np.testing.assert_allclose(middle.joint_position[:, 0], gain * np.sin(angle), atol=accuracy)
    np.testing.assert_allclose(value(middle.joint_velocity)[:, 0] / rate, gain * np.cos(angle), atol=accuracy)


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
            np.testing.assert_allclose(columns, np.tile(out.joint_position, columns.shape[1]), atol=1e-13, err_msg=name)
    assert out.arrays().keys() == log.arrays().keys()
    assert 0.2 < np.std(out.joint_position) < 0.45  # white noise keeps 30 Hz of 250 Hz of its power


def test_filters_and_splines_lose_only_the_stated_ends() -> None:
    t = uniform(2.0)
    log = sine_log(1.0, t)
    assert np.array_equal(preprocess(log).time, t[2:-2])
    np.testing.assert_array_equal(preprocess(log, cutoff_hz=10.0).time, t[100:-100])  # 2 periods of 10 Hz
    complete = dataclasses.replace(log, joint_velocity=log.joint_position, joint_acceleration=log.joint_position)
    resampled = preprocess(complete, sample_rate_hz=50.0)
    np.testing.assert_allclose(resampled.time, np.arange(100) / 50, atol=1e-12)
    np.testing.assert_allclose(preprocess(log, sample_rate_hz=50.0).time, 0.004 + np.arange(100) / 50, atol=1e-12)


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
        np.testing.assert_allclose(one, other, atol=1e-12 * np.max(np.abs(one)))


def test_contact_flags_hold_until_the_next_sample() -> None:
    t = uniform(1.0, 100.0)
    active = np.stack([t >= 0.495, t < 0.255], axis=1)
    log = Log("x", t, ("a",), t[:, None], contact_names=("l", "r"), contact_active=active)
    out = preprocess(log, sample_rate_hz=250.0)
    # the first sample at which left is on is 0.50 s, the first at which right is off is 0.26 s
    assert np.array_equal(value(out.contact_active)[:, 0], out.time > 0.499)
    assert np.array_equal(value(out.contact_active)[:, 1], out.time < 0.259)
    down = preprocess(log, sample_rate_hz=50.0)
    np.testing.assert_array_equal(down.contact_active, active[2:-2:2])
    assert np.array_equal(value(preprocess(log).contact_active), active[2:-2])


def gait_log(**fields: Any) -> Log:
    """Two joints and two feet; the left foot lifts after 1 s."""
    t = uniform(2.0, 200.0)
    rng = np.random.default_rng(8)
    active = np.stack([t < 1.0, t >= 0.0], axis=1)
    torque, wrench = rng.standard_normal((len(t), 2)), rng.standard_normal((len(t), 2, 6))
    given = {"joint_torque": torque, "contact_active": active, "contact_wrench_local": wrench, **fields}
    return Log("gait.npz", t, ("hip", "knee"), np.sin(t[:, None] + np.arange(2)), contact_names=("l", "r"), **given)


@pytest.mark.parametrize("request_", [{"cutoff_hz": 20.0}, {"sample_rate_hz": 90.0}], ids=["filter", "resample"])
def test_the_wrench_of_a_swing_foot_counts_as_zero(request_: dict[str, float]) -> None:
    log = gait_log()
    wrench = value(log.contact_wrench_local).copy()
    swing = ~np.asarray(log.contact_active)
    wrench[swing] = np.nan
    zeroed = np.where(swing[:, :, None], 0.0, wrench)
    outs = [
        preprocess(dataclasses.replace(log, contact_wrench_local=w), **request_)
        for w in (value(log.contact_wrench_local), wrench, zeroed)
    ]
    for out in outs:
        np.testing.assert_array_equal(out.contact_wrench_local, outs[2].contact_wrench_local)
        late = out.time > 1.5
        assert np.max(np.abs(value(out.contact_wrench_local)[late, 0])) < 1e-9
    assert np.isnan(wrench).any()  # the log itself stays as it was


@pytest.mark.parametrize("request_", [{"cutoff_hz": 20.0}, {"sample_rate_hz": 90.0}], ids=["filter", "resample"])
def test_channels_never_measured_pass_as_nan_without_a_word(request_: dict[str, float]) -> None:
    log = gait_log()
    torque, wrench = value(log.joint_torque).copy(), value(log.contact_wrench_local).copy()
    torque[:, 1] = np.nan
    wrench[:, 1, 3:] = np.nan
    wrench[log.time < 1.0, 0, 5] = np.nan  # not measured while it matters, some numbers in the swing
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        out = preprocess(dataclasses.replace(log, joint_torque=torque, contact_wrench_local=wrench), **request_)
    whole = preprocess(log, **request_)
    for name, nan in (("joint_torque", np.array([False, True])), ("contact_wrench_local", np.zeros((2, 6), bool))):
        if name == "contact_wrench_local":
            nan[1, 3:] = nan[0, 5] = True
        array, expected = value(getattr(out, name)), value(getattr(whole, name))
        assert np.all(np.isnan(array[:, nan]))
        np.testing.assert_allclose(array[:, ~nan], expected[:, ~nan], atol=1e-14)


@pytest.mark.parametrize("request_", [{"cutoff_hz": 20.0}, {"sample_rate_hz": 90.0}], ids=["filter", "resample"])
def test_a_channel_with_gaps_becomes_nan_and_is_named(request_: dict[str, float]) -> None:
    log = gait_log()
    torque, wrench = value(log.joint_torque).copy(), value(log.contact_wrench_local).copy()
    torque[30:41, 1] = np.nan
    wrench[12, 0, 2] = wrench[300, 0, 2] = np.nan  # the second while that foot is in the air
    broken = dataclasses.replace(log, joint_torque=torque, contact_wrench_local=wrench)
    with pytest.warns(TorchidWarning) as caught:
        out = preprocess(broken, **request_)
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == 2
    assert "gait.npz: joint_torque: NaN in part of knee (samples 30 to 40)" in messages[0]
    assert "contact_wrench_local: NaN in part of l fz (samples 12 to 12)" in messages[1]
    assert all(Path(warning.filename) == Path(__file__) for warning in caught)
    assert np.all(np.isnan(value(out.joint_torque)[:, 1]))
    assert np.all(np.isfinite(value(out.joint_torque)[:, 0]))
    assert np.count_nonzero(np.isnan(value(out.contact_wrench_local)).any(axis=0)) == 1


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
    np.testing.assert_allclose(value(out.joint_velocity)[:, 0], 3 * out.time**2, atol=1e-13)
    np.testing.assert_allclose(value(out.joint_acceleration)[:, 0], 6 * out.time, atol=1e-11)
    assert len(out) == samples - 4


@pytest.mark.parametrize(
    ("time", "arguments", "found"),
    [
        (uniform(4 / RATE), {}, "4 samples; accepted: at least 5"),
        (uniform(1 / RATE), {"sample_rate_hz": 10.0}, "1 samples"),
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
    if not DATA.is_dir():
        pytest.skip(f"no real logs at {DATA}")
    kuka = preprocess(read_log(DATA / "kuka_lwr4" / "run1.npz"), cutoff_hz=5.0, sample_rate_hz=100.0)
    np.testing.assert_allclose(np.diff(kuka.time), 0.01, rtol=1e-9)  # its own stamps are jittered by 35 %
    assert np.max(np.abs(value(kuka.joint_acceleration))) < 5.0
    squats = preprocess(read_log(DATA / "human_squats" / "squats1.npz"), cutoff_hz=6.0)
    assert np.max(np.abs(value(squats.base_angular_velocity_base))) < 3.0
    np.testing.assert_allclose(  # who starts and ends upright has no mean acceleration
        np.mean(value(squats.base_linear_acceleration_world), axis=0), 0.0, atol=0.05
    )
