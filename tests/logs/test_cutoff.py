"""The cutoff that the noise of a motion asks for."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
from motions import value
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

from torchid.errors import LogError, TorchidWarning
from torchid.logs import Log
from torchid.logs.cutoff import choose_cutoff
from torchid.logs.log import FloatArray
from torchid.logs.preprocess import preprocess
from torchid.logs.signal_noise import MOST_SAMPLES

RATE, COUNT = 500.0, 15_000
TIME = 7.0 + np.arange(COUNT) / RATE


def wander(width: int, hertz: float, seed: int) -> FloatArray:
    """Random motion of some channels whose spectrum falls steeply beyond a frequency."""
    white = np.random.default_rng(seed).normal(size=(COUNT + 2000, width))
    smooth = sosfilt(butter(3, hertz, fs=RATE, output="sos"), white, axis=0)[2000:]
    return np.asarray(smooth / smooth.std(axis=0))


def noise(width: int, std: float) -> FloatArray:
    return std * np.random.default_rng(99).normal(size=(COUNT, width))


def encoders(hertz: float, std: float) -> tuple[Log, Log]:
    """Joint positions as they are, and as encoders with noise read them."""
    clean = 0.3 * wander(3, hertz, 0)
    log = Log("wander.npz", TIME, ("a", "b", "c"), clean)
    return log, replace(log, joint_position=clean + noise(3, std))


def turning(hertz: float, std: float, rates: bool) -> tuple[Log, Log]:
    """A body without joints that turns about all axes: its orientation, or the readings of its gyroscope too."""
    turn = Rotation.from_rotvec(0.4 * wander(3, hertz, 1))
    log = Log("turn.npz", TIME, (), np.empty((COUNT, 0)), base_quat_xyzw=turn.as_quat())
    if not rates:
        return log, replace(log, base_quat_xyzw=(turn * Rotation.from_rotvec(noise(3, std))).as_quat())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        angular = preprocess(log).base_angular_velocity_base
    inner = slice(2, -2)
    log = replace(log.select(inner), base_angular_velocity_base=value(angular))
    return log, replace(log, base_angular_velocity_base=value(angular) + noise(3, std)[inner])


def forces(log: Log) -> FloatArray:
    """Torques of three pendulums, whose weight turns with their angle: inertia 2 kg m^2, moment of weight 20 N m."""
    clean = {"joint_velocity": None, "joint_acceleration": None, "joint_torque": None}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        exact = preprocess(replace(log, **clean))
    inside = np.searchsorted(log.time, exact.time - 1e-9)
    out = np.zeros_like(log.joint_position)
    out[inside] = 2.0 * value(exact.joint_acceleration) + 20.0 * np.cos(exact.joint_position)
    return out


def misfit(noisy: Log, torque: FloatArray, cutoff: float) -> float:
    """Largest relative error of inertia and weight, fitted to filtered torques of a filtered motion."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        found = preprocess(replace(noisy, joint_torque=torque).select(slice(10, -10)), cutoff)
    columns = np.stack([value(found.joint_acceleration).ravel(), np.cos(found.joint_position).ravel()], axis=1)
    inertia, weight = np.linalg.lstsq(columns, value(found.joint_torque).ravel(), rcond=None)[0]
    return float(max(abs(inertia / 2.0 - 1.0), abs(weight / 20.0 - 1.0)))


def error(clean: Log, noisy: Log, field: str, cutoff: float) -> float:
    """Mean square error of derived accelerations."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchidWarning)
        found, exact = (preprocess(log, hertz) for log, hertz in ((noisy, cutoff), (clean, None)))
    near = np.searchsorted(exact.time, found.time + 1e-9) - 1
    difference = value(getattr(found, field)) - value(getattr(exact, field))[near]
    return float(np.square(difference).sum(axis=1).mean())


@pytest.mark.parametrize("std", [1e-4, 1e-3])
@pytest.mark.parametrize(("hertz", "angle"), [(0.5, 1.0), (2.0, 0.3), (2.0, 1.0)])
def test_neither_wide_angles_nor_noise_bias_parameters(hertz: float, angle: float, std: float) -> None:
    """Too low a cutoff, and the weight of wide angles is off; too high, and the inertia is."""
    clean, _ = encoders(hertz, 0.0)
    clean = replace(clean, joint_position=angle / 0.3 * clean.joint_position)
    noisy, torque = replace(clean, joint_position=clean.joint_position + noise(3, std)), forces(clean)
    choice = choose_cutoff([noisy])
    assert choice.by_noise
    chosen = choice.cutoff_hz
    assert chosen is not None
    assert misfit(noisy, torque, chosen) < 1e-3
    assert max(misfit(noisy, torque, cutoff) for cutoff in (1.5, 90.0)) > 0.02, "it matters"


@pytest.mark.parametrize("rates", [True, False], ids=["gyroscope", "orientation"])
def test_of_a_base_that_turns_nine_tenths_are_kept_without_noise(rates: bool) -> None:
    clean, noisy = turning(4.0, 0.15 if rates else 1e-3, rates)
    choice = choose_cutoff([noisy])
    assert choice.by_noise
    assert choice.cutoff_hz is not None
    kept, nothing = (error(clean, noisy, "base_angular_acceleration_base", hertz) for hertz in (choice.cutoff_hz, 1.0))
    assert kept < 0.1 * nothing


def test_more_noise_asks_for_a_lower_cutoff_and_none_for_the_usual_one() -> None:
    clean, noisy = encoders(3.0, 1e-3)
    found = choose_cutoff([noisy]).cutoff_hz
    stated = [choose_cutoff([noisy], {"joint_position": std}).cutoff_hz for std in (1e-2, 1e-3, 1e-4)]
    assert stated == sorted(stated, key=lambda x: x or 0.0)
    assert stated[0] != stated[1] != stated[2]
    assert found == pytest.approx(stated[1], rel=0.06)
    none = choose_cutoff([clean])
    assert (none.cutoff_hz, none.by_noise) == (10.0, False)
    assert "the default" in str(none)
    assert choose_cutoff([noisy], {"joint_position": 0.0}) == none
    assert choose_cutoff([clean], sample_rate_hz=25.0).cutoff_hz == 5.0


@pytest.mark.parametrize("lost", ["", "repeated", "missing"])
@pytest.mark.parametrize("step", [1e-4, 1e-3])
@pytest.mark.parametrize("rate", [1000.0, 4000.0])
def test_neither_coarse_encoders_nor_lost_samples_are_taken_for_motion(rate: float, step: float, lost: str) -> None:
    """Joints that go from point to point: at even speed, readings are stairs, whose lines are far above the motion."""
    rng, time = np.random.default_rng(17), np.arange(8 * int(rate)) / rate
    corners = [np.r_[0.0, np.cumsum(rng.uniform(0.3, 1.2, 40))] for _ in range(3)]
    angle = np.stack([np.interp(time, x, rng.uniform(-1.0, 1.0, 41)) for x in corners], axis=1)
    for width in (0.1, 0.05, 0.02):
        angle = uniform_filter1d(angle, int(width * rate), axis=0)
    read, gone = step * np.round(angle / step), (rng.uniform(size=len(time)) < 0.05) & (time > 0.0)
    kept = ~gone if lost == "missing" else np.ones(len(time), dtype=bool)
    if lost == "repeated":
        read = read[np.maximum.accumulate(np.where(gone, 0, np.arange(len(time))))]
    choice = choose_cutoff([Log("moves.npz", time[kept], (*"abc",), read[kept])])
    assert choice.cutoff_hz is not None
    assert 5.0 < choice.cutoff_hz < 60.0


def test_logs_count_together_by_their_length() -> None:
    quiet, loud = encoders(3.0, 1e-4)[1], encoders(3.0, 3e-3)[1]
    low, high = choose_cutoff([loud]).cutoff_hz, choose_cutoff([quiet]).cutoff_hz
    assert low is not None
    assert high is not None
    assert 1.5 * low < high
    together = choose_cutoff([quiet, loud]).cutoff_hz
    assert together is not None
    assert low <= together < high
    assert choose_cutoff([loud, loud.select(slice(0, 7000))]).cutoff_hz == pytest.approx(low, rel=0.06)


def test_uneven_stamps_and_a_motionless_channel_make_no_difference() -> None:
    clean, noisy = encoders(3.0, 1e-3)
    still = replace(noisy, joint_names=(*"abcd",), joint_position=np.c_[noisy.joint_position, np.full(COUNT, 0.1)])
    assert choose_cutoff([still]) == choose_cutoff([noisy])
    jitter = np.random.default_rng(5).uniform(-0.2, 0.2, COUNT) / RATE
    moved = np.stack([np.interp(TIME + jitter, TIME, channel) for channel in clean.joint_position.T], axis=1)
    uneven = replace(clean, time=TIME + jitter, joint_position=moved + noise(3, 1e-3))
    assert choose_cutoff([uneven], {"joint_position": 1e-3}).cutoff_hz == pytest.approx(
        choose_cutoff([noisy], {"joint_position": 1e-3}).cutoff_hz, rel=0.13
    )


def test_samples_that_were_not_measured_are_passed_over() -> None:
    """Those at the end of a table whose rows are the union of several clocks, which are left out of the fit."""
    _, noisy = encoders(1.5, 1e-4)
    lost = noisy.joint_position.copy()
    lost[[MOST_SAMPLES + 7, *range(COUNT - 5, COUNT)]] = np.nan
    assert choose_cutoff([replace(noisy, joint_position=lost)]) == choose_cutoff([noisy])


@pytest.mark.parametrize(("factor", "step"), [(1e3, "2 s"), (1e9, "2e+06 s")], ids=["ms", "ns"])
def test_stamps_in_another_unit_are_refused_with_their_step(factor: float, step: str) -> None:
    _, log = encoders(3.0, 1e-4)
    with pytest.raises(
        LogError, match=f"wander.npz: time: a median step of {re.escape(step)}; accepted: steps of at most 0.5 s"
    ):
        choose_cutoff([log, replace(log, source="wander.npz", time=factor * log.time)])


def test_where_accelerations_were_recorded_nothing_is_filtered() -> None:
    log = encoders(3.0, 1e-3)[1]
    rates = {name: np.zeros_like(log.joint_position) for name in ("joint_velocity", "joint_acceleration")}
    assert choose_cutoff([replace(log, **rates)]).cutoff_hz is None
    assert "recorded" in str(choose_cutoff([replace(log, **rates)]))


def test_the_motion_of_a_base_that_is_worked_out_of_joints_does_not_count() -> None:
    joints, turn = encoders(1.0, 1e-3)[1], turning(4.0, 1e-3, rates=False)[1]
    both = replace(joints, base_quat_xyzw=turn.base_quat_xyzw)
    assert choose_cutoff([both], base_is_derived=True) == choose_cutoff([joints])
    assert choose_cutoff([both]).cutoff_hz != choose_cutoff([joints]).cutoff_hz


@pytest.mark.parametrize("std", [1e-4, 3e-4])
def test_the_weight_of_a_body_is_at_most_one_percent_of_noise(std: float) -> None:
    """Joints that shake fast ask for a high cutoff, at which a position's noise is as large as gravity."""
    shaking, stated = encoders(30.0, 1e-5)[1], {"joint_position": 1e-5}
    slow, upright = 0.05 * wander(3, 0.4, 3), np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))
    clean = replace(shaking, base_position_world=slow, base_quat_xyzw=upright)
    noisy = replace(clean, base_position_world=slow + noise(3, std))
    free, bounded = (choose_cutoff([log], stated).cutoff_hz for log in (clean, noisy))
    assert free is not None
    assert bounded is not None
    gravity = 9.81**2
    assert error(clean, noisy, "base_linear_acceleration_world", free) > 0.1 * gravity, "it matters"
    assert 0.005 * gravity < error(clean, noisy, "base_linear_acceleration_world", bounded) < 0.015 * gravity
