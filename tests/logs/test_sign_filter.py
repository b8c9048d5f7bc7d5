"""Dry friction of joints that vibrate faster than the filter's cutoff."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motions import value

from torchid.errors import TorchidWarning
from torchid.logs import Log
from torchid.logs.dry_friction import wider_low_pass, with_sign_filter
from torchid.logs.log import FloatArray
from torchid.logs.preprocess import lacks_derivatives, make_timeline, move_to_timeline, preprocess
from torchid.logs.signal_noise import MOST_SAMPLES, signal_noise
from torchid.logs.timeline import Timeline

CUTOFF, RATE = 20.0, 500.0  # Hz


def recorded(
    vibration: float, velocity_noise: float = 0.0, position_noise: float = 0.0, with_velocity: bool = True
) -> tuple[Log, FloatArray]:
    """Two joints that swing, and vibrate at 27 and 33 Hz [rad/s]; and their true velocities."""
    time, rng = np.arange(6000) / RATE, np.random.default_rng(0)
    slow, fast = 2.0 * np.pi * np.array([0.4, 0.7]), 2.0 * np.pi * np.array([27.0, 33.0])
    phase = time[:, None]
    velocity = np.cos(slow * phase) + vibration * np.cos(fast * phase + 1.0)
    position = np.sin(slow * phase) / slow + vibration * np.sin(fast * phase + 1.0) / fast
    log = Log(
        "vibrating",
        time=time,
        joint_names=("a", "b"),
        joint_position=position + position_noise * rng.normal(size=position.shape),
        joint_velocity=velocity + velocity_noise * rng.normal(size=velocity.shape) if with_velocity else None,
    )
    return log, velocity


def timeline_of(log: Log, cutoff: float = CUTOFF) -> Timeline:
    timeline = make_timeline(log.time, lacks_derivatives(log), cutoff, None)
    assert timeline is not None
    return timeline


@pytest.mark.parametrize(
    ("noise", "with_velocity"),
    [({}, True), ({"velocity_noise": 0.02}, True), ({}, False), ({"position_noise": 2e-5}, False)],
)
def test_friction_reverses_as_often_as_the_joint_and_not_as_its_filtered_velocity(
    noise: dict[str, float], with_velocity: bool
) -> None:
    log, velocity = recorded(0.8, with_velocity=with_velocity, **noise)
    timeline = timeline_of(log)
    assert timeline.low_pass is not None
    true = timeline.low_pass(np.sign(velocity))[timeline.kept]
    with pytest.warns(TorchidWarning, match=r"the filter removes [34]\d % .*\.cutoff_hz to (40|80|160) or more"):
        found = preprocess(log, CUTOFF).joint_direction
    alone = move_to_timeline(log, timeline, {}).joint_direction  # of velocities behind the timeline's own filter
    assert found is not None
    assert alone is not None
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.05
    assert np.sqrt(np.mean((alone - true) ** 2)) > 0.15


@pytest.mark.parametrize(
    ("vibration", "noise"), [(0.0, {}), (0.0, {"velocity_noise": 0.1}), (0.02, {"velocity_noise": 0.02})]
)
def test_smooth_motion_keeps_the_filter_however_noisy(vibration: float, noise: dict[str, float]) -> None:
    log, _ = recorded(vibration, **noise)
    assert wider_low_pass(log, timeline_of(log)) is None


def test_steps_of_an_encoder_are_no_vibration() -> None:
    log, _ = recorded(0.0, with_velocity=False)
    step = 2.0 * np.pi / 4096.0  # its velocity jumps between 0 and 0.8 rad/s from sample to sample
    coarse = replace(log, joint_position=step * np.round(log.joint_position / step))
    assert wider_low_pass(coarse, timeline_of(coarse)) is None


def noisy(seed: int, velocity_noise: float, position_noise: float) -> tuple[Log, FloatArray]:
    """Four joints that swing with 0.18 rad/s, and their true velocities; with noise of one or the other."""
    rng, time = np.random.default_rng(seed), np.arange(6000) / RATE
    w, phase = 2.0 * np.pi * rng.uniform(0.1, 0.8, (2, 3, 4))
    sines = w * time[:, None, None] + phase
    position, velocity = (0.15 * x.sum(axis=1) for x in (np.sin(sines) / w, np.cos(sines)))
    log = Log(
        "noisy",
        time=time,
        joint_names=tuple("abcd"),
        joint_position=position + position_noise * rng.normal(size=position.shape),
        joint_velocity=velocity + velocity_noise * rng.normal(size=velocity.shape) if velocity_noise else None,
    )
    return log, velocity


@pytest.mark.parametrize("width", [None, 0.02])
@pytest.mark.parametrize(("velocity_noise", "position_noise"), [(0.05, 0.0), (0.1, 0.0), (0.0, 1e-3)])
def test_coulomb_friction_is_no_smaller_for_noise_of_velocities(
    velocity_noise: float, position_noise: float, width: float | None
) -> None:
    found: dict[str, list[FloatArray]] = {"noise known": [], "noise ignored": []}
    for seed in range(8):
        log, velocity = noisy(seed, velocity_noise, position_noise)
        timeline = replace(timeline_of(log), sign_width=width)
        assert timeline.low_pass is not None
        torque = np.sign(velocity) if width is None else np.tanh(velocity / width)
        torque, speed = (timeline.low_pass(x)[timeline.kept] for x in (torque, velocity))
        knows = with_sign_filter(timeline, log, signal_noise(log, timeline))
        for name, one in zip(found, (knows, timeline), strict=True):
            direction = move_to_timeline(log, one, {}).joint_direction
            assert direction is not None
            both = np.stack([direction, speed])
            found[name].append(np.array([np.linalg.lstsq(both[..., j].T, torque[:, j])[0][0] for j in range(4)]))
    off = {name: abs(float(np.mean(x)) - 1.0) for name, x in found.items()}
    assert off["noise known"] < 0.4 * off["noise ignored"]
    assert off["noise ignored"] > 0.02


def test_where_signals_are_exact_friction_reverses_at_once() -> None:
    log, _ = recorded(0.0)
    timeline = timeline_of(log)
    assert with_sign_filter(timeline, log, signal_noise(log, timeline)) is timeline


def held(log: Log, joint: int, samples: int, velocity_noise: float, position_noise: float) -> Log:
    """The log with a joint that is held still for its first samples, whose noise goes on."""
    rng, still = np.random.default_rng(1), np.arange(samples)
    position = log.joint_position.copy()
    position[still, joint] = position[samples - 1, joint] + position_noise * rng.normal(size=samples)
    if log.joint_velocity is None:
        return replace(log, joint_position=position)
    velocity = log.joint_velocity.copy()
    velocity[still, joint] = velocity_noise * rng.normal(size=samples)
    return replace(log, joint_position=position, joint_velocity=velocity)


@pytest.mark.parametrize(("velocity_noise", "position_noise"), [(0.02, 1e-4), (0.02, 0.0), (0.0, 1e-4)])
def test_noise_of_a_joint_that_never_moves_is_no_direction(velocity_noise: float, position_noise: float) -> None:
    log, _ = noisy(0, velocity_noise, position_noise)
    moves = preprocess(log, CUTOFF).joint_direction
    rests = preprocess(held(log, 2, len(log), velocity_noise, position_noise), CUTOFF).joint_direction
    assert moves is not None
    assert rests is not None
    np.testing.assert_array_equal(rests[:, 2], 0.0)
    np.testing.assert_array_equal(np.delete(rests, 2, axis=1), np.delete(moves, 2, axis=1))


def test_a_joint_that_rests_where_noise_is_estimated_may_move_later() -> None:
    log = held(noisy(0, 0.0, 1e-4)[0], 2, MOST_SAMPLES, 0.0, 1e-4)
    timeline, start = timeline_of(log), log.select(slice(0, MOST_SAMPLES))
    noise = signal_noise(log, timeline)
    alone, whole = (value(with_sign_filter(timeline, one, noise).sign_noise) for one in (start, log))
    np.testing.assert_array_equal(np.isinf(alone), [False, False, True, False])
    assert np.isfinite(whole).all()
