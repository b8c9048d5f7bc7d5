"""Samples that must not be fitted are found where they are, and a clean log has none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from demo import DEMO
from faults import HERE, changed, demo_log, found, moving, only, places, with_rates
from motions import position, value
from repository import SHARED

from torchid.log_checks import NOTE, REJECTED, SUSPICIOUS
from torchid.log_checks.check import check, repair_log
from torchid.log_checks.findings import widen_mask
from torchid.log_checks.spikes import find_jumps
from torchid.logs import Log, read_log

Array = np.ndarray[Any, Any]


def put(index: object, add: object) -> Callable[[Array], None]:
    def change(array: Array) -> None:
        array[index] += add

    return change


def stop(first: int, last: int, columns: object = slice(None)) -> Callable[[Array], None]:
    """Samples that repeat the one before `first`."""

    def change(array: Array) -> None:
        array[first : last + 1, columns] = array[first - 1, columns]

    return change


@pytest.mark.parametrize("log", [demo_log(), moving(), with_rates(moving())], ids=["demo", "moving", "with rates"])
def test_a_clean_log_has_no_rejected_samples(log: Log) -> None:
    checked = check(log)
    assert checked.verdict == "usable"
    assert not [one for one in checked.findings if one.severity != NOTE]


@pytest.mark.parametrize("last", [HERE, HERE + 2])
@pytest.mark.parametrize(
    ("field", "column", "size"),
    [("joint_position", 2, 0.05), ("joint_torque", 4, 20.0), ("base_position_world", 1, 0.01)],
)
def test_a_spike_is_found_at_its_samples(field: str, column: int, size: float, last: int) -> None:
    spike = only(check(changed(demo_log(), field, put((slice(HERE, last + 1), column), size))), "spike")
    assert (spike.severity, spike.field) == (REJECTED, field)
    assert places(spike) == {(HERE, last)}
    assert len(spike.channels) == 1


def test_a_spike_of_a_contact_force_is_found_by_contact_and_component() -> None:
    spike = only(check(changed(demo_log(), "contact_wrench_local", put((HERE, 1, 2), 100.0))), "spike")
    assert (spike.channels, places(spike)) == (("front_right_foot fz",), {(HERE, HERE)})


def test_a_spike_of_the_orientation_is_found_in_degrees() -> None:
    log = demo_log()
    quat = value(log.base_quat_xyzw).copy()
    quat[HERE] += np.array([np.sin(np.radians(5.0)), 0.0, 0.0, 0.0])  # about 10 degrees
    quat[HERE] /= np.linalg.norm(quat[HERE])
    spike = only(check(replace(log, base_quat_xyzw=quat)), "spike")
    assert (spike.field, places(spike)) == ("base_quat_xyzw", {(HERE, HERE)})
    assert " deg " in spike.found


def test_a_reading_that_is_lost_for_a_while_is_rejected_from_end_to_end() -> None:
    noise = 1e-4 * np.random.default_rng(1).normal(size=40)
    log = changed(demo_log(), "joint_position", lambda q: q.__setitem__((slice(HERE, HERE + 40), 2), noise))
    assert places(only(check(log), "spike")) == {(HERE, HERE + 39)}


def test_a_lasting_step_of_a_position_makes_a_log_useless_unless_one_side_is_short() -> None:
    middle = check(changed(demo_log(), "joint_position", put((slice(HERE, None), 2), 0.05)))
    assert not middle.usable
    assert only(middle, "step").whole
    assert places(only(middle, "step")) == {(HERE - 1, HERE)}
    short = check(changed(demo_log(), "joint_position", put((slice(1250, None), 2), 0.05)))
    assert short.usable
    assert places(only(short, "step")) == {(1250, 1299)}


def test_a_torque_may_step_which_is_only_worth_a_look() -> None:
    checked = check(changed(demo_log(), "joint_torque", put((slice(HERE, None), 2), 30.0)))
    step = only(checked, "step")
    assert (step.severity, places(step)) == (SUSPICIOUS, {(HERE - 1, HERE)})
    assert not checked.rejected.any()


def test_friction_that_reverses_at_the_end_of_a_log_is_no_step() -> None:
    time = np.arange(120) / 100.0 - 0.004
    noise = 0.01 * np.random.default_rng(0).normal(size=120)
    torque = np.where(time < 0.0, 0.3, -0.3) + noise  # of a joint that turns back after its first sample
    log = Log("short.npz", time + 0.004, ("j",), np.cos(4.0 * time)[:, None], joint_torque=torque[:, None])
    assert not found(check(log), "step")


@pytest.mark.parametrize("peak", [0.0, 900.0])
@pytest.mark.parametrize("reset", [0.0, 500.0])
def test_a_heel_strike_without_a_contact_flag_is_no_step_but_a_reset_is(peak: float, reset: float) -> None:
    rng, time = np.random.default_rng(6), np.arange(6000) / 500.0
    phase = time % 1.0
    load = np.where(phase < 0.6, 600.0 + 200.0 * np.sin(phase / 0.2) + peak * np.exp(-phase / 0.004), 0.0)
    wrench = rng.normal(size=(6000, 1, 6))
    wrench[:, 0] += load[:, None] * [0.1, 0.0, 1.0, 0.0, 0.05, 0.0]
    wrench[3170:, 0, 2] += reset
    torque = load[:, None] * [0.1, 0.02, 0.0] + rng.normal(size=(6000, 3))
    log = replace(moving(), time=time, joint_position=position(time), joint_torque=torque)
    checked = check(replace(log, ft_names=("ankle",), ft_wrench=wrench))
    steps = {(one.field, places(one).pop()) for one in found(checked, "step")}
    assert steps == ({("ft_wrench", (3169, 3170))} if reset else set())
    assert not checked.rejected.any()


def test_a_wrapped_angle_costs_two_samples_and_is_unwrapped() -> None:
    log = changed(demo_log(), "joint_position", put((slice(HERE, None), 2), -2.0 * np.pi))
    checked = check(log)
    assert places(only(checked, "wrapped angle")) == {(HERE - 1, HERE)}
    np.testing.assert_allclose(checked.repaired.joint_position[HERE + 1 :], demo_log().joint_position[HERE + 1 :])


def test_where_the_base_is_does_not_matter_so_that_its_jump_costs_two_samples() -> None:
    checked = check(changed(demo_log(), "base_position_world", put((slice(HERE, None), 0), 0.5)))
    assert places(only(checked, "step")) == {(HERE - 1, HERE)}
    moved = value(checked.repaired.base_position_world) - value(demo_log().base_position_world)
    assert np.abs(moved).max() < 0.01


def test_motion_that_begins_and_ends_at_once_has_no_jumps() -> None:
    time = np.arange(3000) / 1000.0
    pulse = np.clip(time - 1.0, 0.0, 1.0)
    for values in (pulse, np.sin(2 * np.pi * pulse), np.maximum(0.0, np.sin(3 * time)), np.round(pulse, 3)):
        assert find_jumps(values, 1000.0 * time, np.zeros(3000, int)) == []


def test_a_sample_that_comes_late_is_no_jump() -> None:
    time = np.arange(2000) / 500.0
    time[1000:] += 0.4 / 500.0
    assert find_jumps(np.sin(5.0 * time), 500.0 * time, np.zeros(2000, int)) == []
    assert len(find_jumps(np.sin(5.0 * time), np.arange(2000.0), np.zeros(2000, int))) == 1, (
        "it would be one with equal steps"
    )


def test_heavy_tailed_noise_has_no_spikes() -> None:
    rng = np.random.default_rng(2)
    for noise in (rng.laplace(size=200_000), rng.normal(size=200_000), rng.logistic(size=200_000)):
        assert find_jumps(np.cumsum(0.1 * noise) + noise, np.arange(200_000.0), np.zeros(200_000, int)) == []


@pytest.mark.parametrize("field", ["joint_position", "joint_torque"])
@pytest.mark.parametrize("last", [HERE, HERE + 9])
def test_a_frame_that_is_sent_again_is_rejected(field: str, last: int) -> None:
    frozen = only(check(changed(demo_log(), field, stop(HERE, last))), "frozen")
    assert (frozen.field, places(frozen)) == (field, {(HERE, last)})
    assert len(frozen.channels) == 12


@pytest.mark.parametrize("field", ["joint_position", "joint_torque"])
def test_one_channel_that_freezes_is_rejected_by_name(field: str) -> None:
    frozen = only(check(changed(demo_log(), field, stop(HERE, HERE + 19, 4))), "frozen")
    assert (frozen.channels, places(frozen)) == (("front_right_thigh",), {(HERE, HERE + 19)})


def test_a_robot_that_rests_between_motions_is_not_frozen() -> None:
    time = np.arange(4000) / 500.0
    pause = np.clip(time, 0.0, 3.0) + np.clip(time - 5.0, 0.0, None)
    swing = np.sin(np.pi * pause)[:, None] ** 2 * [0.5, -0.3, 0.8]  # at rest, to the last bit, from 3 s to 5 s
    for joints in (swing, np.round(swing, 4)):
        assert not found(check(Log("rests.npz", time, ("a", "b", "c"), joints)), "frozen")


def test_a_quantised_encoder_that_rests_is_not_frozen() -> None:
    position = np.round(moving(noise=2e-3).joint_position * 0.0 + moving(noise=2e-3).joint_position[:1], 3)
    flicker = position + 1e-3 * (np.random.default_rng(3).random(position.shape) < 0.3)
    assert not found(check(replace(moving(), joint_position=flicker)), "frozen")


@pytest.mark.parametrize("quantum", [1.5e-5, 1e-4, 1e-3])
@pytest.mark.parametrize("blur", ["none", "single precision", "degrees in single precision"])
def test_rest_and_slow_motion_on_a_grid_are_no_fault(quantum: float, blur: str) -> None:
    """An encoder whose grid is blurred by a conversion: its steps are still whole quanta."""

    def read(angle: Array) -> Array:
        on_grid = quantum * np.round(angle / quantum)
        if blur == "degrees in single precision":
            return np.radians(np.degrees(on_grid).astype(np.float32).astype(np.float64))
        return on_grid.astype(np.float32 if blur == "single precision" else np.float64).astype(np.float64)

    log, rng = moving(4000, noise=0.0), np.random.default_rng(4)
    q = position(log.time)
    creeps = q * [1.0, 0.002, 1.0]  # 2 mrad in a whole log
    stands = q[:1] + 0.6 * quantum * rng.normal(size=q.shape)
    sways = q[:1] + 1e-4 * np.sin(3.0 * log.time)[:, None]
    for joints in (creeps, stands, sways):
        checked = check(replace(log, joint_position=read(joints)))
        assert not checked.rejected.any()
        assert {one.name for one in checked.findings} <= {"constant", "no motion"}


@pytest.mark.parametrize("quantum", [0.0, 1e-4])
def test_a_pose_that_arrives_at_half_the_rate_and_irregularly_is_held(quantum: float) -> None:
    rng = np.random.default_rng(5)
    time, sent = np.arange(2700) / 60.0, np.arange(1351) / 30.0
    place = np.stack([0.3 * sent, 0.05 * np.sin(2.0 * sent), 0.02 * np.sin(5.0 * sent)], axis=1)
    place = quantum * np.round(place / quantum) if quantum else place
    latest = np.searchsorted(np.sort(sent + rng.uniform(0.0, 0.03, len(sent))), time, side="right") - 1
    log = Log("walk.npz", time, ("a", "b", "c"), position(time), base_position_world=place[latest.clip(0)])
    checked = check(log)
    assert "every 2 samples" in only(checked, "held", "base_position_world").found
    assert not checked.rejected.any()


def test_a_mask_is_widened_by_any_distance() -> None:
    where = np.zeros(80, bool)
    where[3] = True
    assert widen_mask(where, 10**15).all()
    np.testing.assert_array_equal(np.flatnonzero(widen_mask(where, 2)), np.arange(1, 6))


@pytest.mark.parametrize("repeats", [0, 1, 20])
def test_a_joint_that_rests_before_and_after_its_only_motion_is_not_held(repeats: int) -> None:
    log = moving()
    part = slice(600, 1400)
    rests = np.clip(np.arange(2000), part.start, part.stop - 1)
    again = 700 + 30 * np.arange(repeats)
    rests[again] = rests[again - 1]
    once = changed(log, "joint_position", lambda q: q.__setitem__((slice(None), 1), q[rests, 1]))
    assert not found(check(once), "held")


def test_a_joint_that_is_sent_at_a_lower_rate_than_the_others_is_named() -> None:
    log = moving()
    held = changed(log, "joint_position", lambda q: q.__setitem__((slice(None), 1), q[np.arange(2000) // 5 * 5, 1]))
    finding = only(check(held), "held")
    assert finding.channels == ("b",)
    assert "b: new values only every 5 samples" in finding.found


def test_a_velocity_of_zero_is_frozen_only_while_the_joint_moves() -> None:
    at_stop = with_rates(moving(noise=0.0))
    stopped = np.maximum(at_stop.joint_position[:, 0], np.percentile(at_stop.joint_position[:, 0], 40.0))
    stands = np.append(np.diff(stopped) == 0.0, False)
    at_stop = changed(at_stop, "joint_position", lambda q: q.__setitem__((slice(None), 0), stopped))
    at_stop = changed(at_stop, "joint_velocity", lambda v: v.__setitem__((stands, 0), 0.0))
    assert not found(check(at_stop), "frozen", "joint_velocity")
    lost = changed(with_rates(moving()), "joint_velocity", lambda v: v.__setitem__((slice(900, 1000), 0), 0.0))
    assert places(only(check(lost), "frozen", "joint_velocity")) == {(901, 999)}


@pytest.mark.parametrize(("field", "band"), [("joint_torque", 0.5), ("joint_velocity", 0.1)])
def test_a_driver_that_reads_nothing_below_some_size_is_not_frozen(field: str, band: float) -> None:
    log = demo_log() if field == "joint_torque" else with_rates(moving())
    dead = changed(log, field, lambda x: x.__setitem__(np.abs(x) < band, 0.0))
    finding = only(check(dead), "dead band")
    assert (finding.severity, finding.field) == (SUSPICIOUS, field)
    assert f"below {band}" in finding.found
    assert not check(dead).rejected.any()


@pytest.mark.parametrize("band", [0.2, 0.5])
def test_torques_that_cross_a_dead_band_faster_than_their_noise_are_not_frozen(band: float) -> None:
    """With steps of 0.2 N m some first readings beyond the band are more than twice as large as its edge."""
    log = read_log(DEMO / "sway_test.npz")
    dead = changed(log, "joint_torque", lambda x: x.__setitem__(np.abs(x) < band, 0.0))
    assert found(check(dead), "dead band")
    assert not found(check(dead), "frozen")


def test_a_sensor_with_a_dead_band_that_is_lost_is_frozen_there_alone() -> None:
    lost = slice(300, 360)
    assert np.abs(value(demo_log().joint_torque)[lost, 2]).min() > 5.0
    dead = changed(demo_log(), "joint_torque", lambda x: x.__setitem__(np.abs(x) < 0.5, 0.0))
    checked = check(changed(dead, "joint_torque", lambda x: x.__setitem__((lost, 2), 0.0)))
    assert found(checked, "dead band")
    assert places(only(checked, "frozen")) == {(lost.start + 1, lost.stop - 1)}


def test_a_torque_that_was_recorded_at_a_lower_rate_and_held_is_named_but_not_rejected() -> None:
    held = replace(demo_log(), joint_torque=value(demo_log().joint_torque)[np.arange(1300) // 4 * 4])
    checked = check(held)
    assert "every 4 samples" in only(checked, "held").found
    assert not checked.rejected.any()


def test_a_saturated_torque_is_rejected_where_it_is_saturated() -> None:
    torque = value(demo_log().joint_torque)
    limit = np.percentile(torque[:, 2], 90.0)
    checked = check(
        changed(demo_log(), "joint_torque", lambda t: t.__setitem__((slice(None), 2), np.minimum(t[:, 2], limit)))
    )
    assert only(checked, "saturated").channels == ("front_left_knee",)
    at_limit = torque[:, 2] >= limit
    first = np.flatnonzero(at_limit)[0]
    assert checked.rejected[first], "the first sample at the limit is as wrong as those that repeat it"
    assert np.mean(checked.rejected[at_limit]) > 0.9
    assert not checked.rejected[~at_limit].any()


def test_a_torque_of_zero_throughout_is_suspicious_and_a_joint_that_never_moves_a_note() -> None:
    torque = only(check(changed(demo_log(), "joint_torque", lambda t: t[:, 2].fill(0.0))), "constant", "joint_torque")
    assert torque.severity == SUSPICIOUS
    still = only(
        check(changed(demo_log(), "joint_position", lambda q: q[:, 2].fill(0.3))), "constant", "joint_position"
    )
    assert (still.severity, still.channels) == (NOTE, ("front_left_knee",))


def test_forces_that_stay_at_one_value_while_joints_move_are_suspicious_also_beside_zeros() -> None:
    def fill(torque: Any) -> None:
        torque[:, 2], torque[:, 5] = 0.0, 3.3

    zero, one = found(check(changed(demo_log(), "joint_torque", fill)), "constant", "joint_torque")
    assert (zero.severity, zero.channels) == (SUSPICIOUS, ("front_left_knee",))
    assert (one.severity, one.channels) == (SUSPICIOUS, (demo_log().joint_names[5],))
    still = changed(demo_log(), "joint_position", lambda q: np.copyto(q, q[:1]))
    torque = changed(still, "joint_torque", lambda t: np.copyto(t, t[:1]))
    assert all(one.severity != SUSPICIOUS for one in found(check(torque), "constant", "joint_torque"))


def test_holes_in_a_channel_are_rejected_and_a_channel_that_is_not_there_is_not() -> None:
    holes = check(changed(demo_log(), "joint_torque", put((slice(200, 210), 1), np.nan)))
    assert places(only(holes, "not measured")) == {(200, 209)}
    assert np.isfinite(value(holes.repaired.joint_torque)).all()
    absent = check(changed(demo_log(), "joint_torque", lambda t: t[:, 1].fill(np.nan)))
    assert only(absent, "not measured").severity == NOTE
    assert not absent.rejected.any()


def test_values_that_nothing_can_have_are_rejected() -> None:
    checked = check(changed(demo_log(), "joint_torque", put((HERE, 3), 1e200)))
    assert places(only(checked, "absurd")) == {(HERE, HERE)}
    assert not check(changed(demo_log(), "joint_torque", put(slice(None), 1e200))).usable


def test_a_repaired_log_differs_where_it_was_rejected_and_nowhere_else() -> None:
    log = changed(demo_log(), "joint_position", put((HERE, 2), 0.3))
    checked = check(log)
    difference = checked.repaired.joint_position != log.joint_position
    assert np.argwhere(difference).tolist() == [[HERE, 2]]
    assert abs(checked.repaired.joint_position[HERE, 2] - demo_log().joint_position[HERE, 2]) < 1e-3
    assert repair_log(demo_log(), ()) is demo_log()


def test_stamps_in_milliseconds_are_named() -> None:
    checked = check(replace(demo_log(), time=1e3 * demo_log().time))
    assert "ms" in only(checked, "unit", "time").found
    assert not checked.usable


def test_a_gap_is_named_with_what_is_missing_and_a_long_one_makes_the_log_useless() -> None:
    time = demo_log().time
    short = only(check(replace(demo_log(), time=time + 0.04 * (np.arange(1300) >= HERE))), "gap")
    assert (short.severity, places(short)) == (SUSPICIOUS, {(HERE - 1, HERE)})
    assert "4 samples missing" in short.found
    long = check(replace(demo_log(), time=time + 0.4 * (np.arange(1300) >= HERE)))
    assert long.reasons == ("time: gap",)


def test_of_two_stamps_that_nearly_coincide_one_is_rejected() -> None:
    time = demo_log().time.copy()
    time[HERE] = time[HERE - 1] + 1e-4
    assert places(only(check(replace(demo_log(), time=time)), "coincident stamps")) == {(HERE, HERE)}


def test_jitter_of_the_stamps_is_told_from_jitter_of_the_sampling() -> None:
    late = 0.3 / 500.0 * np.random.default_rng(4).uniform(-1.0, 1.0, 2000)
    log = moving()
    stamped = only(check(replace(log, time=log.time + late)), "jitter")
    read = position(log.time + late) + 1e-4 * np.random.default_rng(5).normal(size=(2000, 3))
    sampled = only(check(replace(log, time=log.time + late, joint_position=read)), "jitter")
    assert "the stamps jitter, not the sampling" in stamped.found
    assert "the stamps jitter" not in sampled.found
    assert not found(check(log), "jitter")


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"recorded logs are not in {SHARED}")
def test_a_recorded_quadruped_that_stands_and_sways_keeps_its_samples() -> None:
    """Its encoders give whole quanta in single precision; one true spike of a velocity is left."""
    recorded = np.load(SHARED / "go2_standing" / "log.npz")
    q, v, tau = (recorded[name].astype(float) for name in ("joint_position", "joint_velocity", "torque_estimate"))
    names = tuple(map(str, recorded["joint_names"]))
    checked = check(Log("go2", recorded["time"].astype(float), names, q, joint_velocity=v, joint_torque=tau))
    assert checked.rejected.sum() <= 1
    assert not found(checked, "held")
