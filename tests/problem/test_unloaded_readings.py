"""What sensors of contacts read in the air: where it counts, what it says of offsets, and what it must not say."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from misread import world
from motions import value
from recordings import Miscalibration
from unknowns import fit
from welded import CONTACTS

from torchid.fitting.fit import warn_of_masked
from torchid.logs import Log
from torchid.logs.preprocess import UNLOADED_MARGIN_S, find_unloaded, preprocess
from torchid.problem import ExtraTerms, RowBuilder, Samples, bind_log, compress_parts
from torchid.problem.compression import Part
from torchid.problem.unloaded_sensors import unloaded_offset_equations
from torchid.sensing import SensorNoise, named_sensors

EVERY = {"contact_force": "log", "contact_moment": "log"}
OFFSETS = ExtraTerms(offsets=EVERY)
ALL = ExtraTerms(offsets={**EVERY, "joint_torque": "log"})
NOISE = SensorNoise(contact_force=2.0, contact_moment=0.2)
PAUSE = 40  # samples of the skew machine in which nothing touches; at 100 Hz, 30 of them are further than the margin


@cache
def swinging() -> tuple[Log, Miscalibration]:
    """A log whose last samples are in the air, read by sensors that are off and read nothing else there."""
    w = world()
    log, off = w.logs[0], w.sensors[0]
    order = np.argsort(~value(log.contact_active).any(axis=1), kind="stable")
    chosen = np.append(order, np.repeat(order[-1:], PAUSE))
    log = log.select(chosen)
    log = replace(log, time=0.01 * np.arange(len(chosen)))
    exerts = np.array([[k in contact.components for k in range(6)] for contact in CONTACTS])
    touches = value(log.contact_active)[..., None] & exerts
    wrench = np.where(touches, value(log.contact_wrench_local), off.wrench)
    return replace(log, contact_wrench_local=wrench), off


def bound(log: Log) -> Samples:
    return bind_log(log, world().robot, CONTACTS)


def builder_of(terms: ExtraTerms = OFFSETS, name: str = "full") -> RowBuilder:
    robot = world().robot
    return RowBuilder(robot, CONTACTS, named_sensors(name, robot.n, len(CONTACTS), NOISE, len(robot.ft_names)), terms)


def written(reading: float) -> Log:
    """The log with a number in place of all readings in the air."""
    log, _ = swinging()
    free = ~value(log.contact_active)[..., None]
    return replace(log, contact_wrench_local=np.where(free, reading, value(log.contact_wrench_local)))


def of_air(log: Log, terms: ExtraTerms = OFFSETS) -> list[Part]:
    return [part for part in compress_parts([bound(log)], builder_of(terms), threads=1) if part.unloaded]


# ---------------------------------------------------------------------------------------------- which readings count


def test_a_reading_counts_from_the_margin_away_from_the_last_contact_to_the_margin_before_the_next() -> None:
    time = np.cumsum(np.random.default_rng(0).uniform(0.001, 0.02, 800))
    active = np.stack([np.sin(3.0 * time) > 0.0, time < 0.0, time > 0.0], axis=1)
    far = np.abs(time[:, None] - time[active[:, 0]]).min(axis=1) > UNLOADED_MARGIN_S
    found = find_unloaded(time, active)
    np.testing.assert_array_equal(found[:, 0], far)
    assert 0.2 < far.mean() < 0.45
    assert found[:, 1].all()
    assert not found[:, 2].any()


@pytest.mark.parametrize("settings", [{}, {"cutoff_hz": 6.0}, {"cutoff_hz": 6.0, "sample_rate_hz": 71.0}], ids=str)
def test_a_filter_leaves_readings_in_the_air_as_they_were_recorded(settings: dict[str, float]) -> None:
    """Of an offset of 60 N beside forces of 500 N, neither of which smears into the other."""
    rng, time = np.random.default_rng(1), np.arange(900) * 0.01
    active = np.sin(2.0 * time)[:, None] * np.array([1.0, -1.0, 1.0]) > -0.2
    smooth = np.sin(time)[:, None] * np.ones((1, world().robot.n))
    still = np.zeros((len(time), 3))
    wrench = np.where(active[..., None], 500.0 * rng.normal(size=(len(time), 3, 6)), 60.0)
    log = Log(
        "a.npz", time, world().robot.joint_names, smooth, joint_torque=smooth,
        base_quat_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1)), base_linear_acceleration_world=still,
        base_angular_velocity_base=still, base_angular_acceleration_base=still,
        contact_names=tuple(contact.frame for contact in CONTACTS), contact_active=active, contact_wrench_local=wrench,
    )  # fmt: skip
    found = value(bound(preprocess(log, **settings)).unloaded).numpy()
    assert set(np.unique(found[np.isfinite(found)])) == {60.0}
    assert np.isfinite(found).mean() == pytest.approx(find_unloaded(time, active).mean(), abs=0.02)


def test_all_that_is_said_of_contacts_is_in_the_order_of_the_experiment() -> None:
    log = swinging()[0]
    log = replace(log, contact_share=0.5 * value(log.contact_active) + [0.1, 0.2, 0.3])
    there, back = (bind_log(log, world().robot, contacts) for contacts in (CONTACTS, CONTACTS[::-1]))
    for name in ("active", "wrench", "share", "unloaded"):
        columns = value(getattr(there, name)).numpy()
        assert not np.array_equal(columns[:, 0], columns[:, -1], equal_nan=columns.dtype != bool)
        np.testing.assert_array_equal(value(getattr(back, name)).numpy(), columns[:, ::-1], err_msg=name)


def test_a_contact_whose_offset_is_not_asked_for_has_no_equation_in_the_air() -> None:
    log, _ = swinging()
    for terms in (ExtraTerms(), ExtraTerms(offsets={"joint_torque": "log"}), ExtraTerms(scales=EVERY)):
        assert not of_air(log, terms)
    robot = world().robot
    joints = RowBuilder(robot, CONTACTS, named_sensors("joints", robot.n, 3, NOISE, len(robot.ft_names)), OFFSETS)
    assert not list(unloaded_offset_equations(joints, bound(log)))


# ------------------------------------------------------------------------------------------------ what they say


def test_a_mean_counts_as_exactly_as_its_readings_are_many_and_outliers_do_not_move_it() -> None:
    rng = np.random.default_rng(2)
    log, _ = swinging()
    wrench = value(log.contact_wrench_local).copy()
    wrench += np.repeat([2.0, 0.2], 3) * rng.normal(size=wrench.shape)
    off, builder = swinging()[1].wrench, builder_of()
    for spikes in (0.0, 1e4):
        read = wrench.copy()
        read[-20, 0] += spikes
        samples = bound(replace(log, contact_wrench_local=read))
        count = int(torch.isfinite(value(samples.unloaded)[:, 0, 0]).sum())
        for channel in unloaded_offset_equations(builder, samples):
            contact, axis = builder.extras[channel.offset].contact or (0, 0)
            sigma = NOISE.wrench_std[axis] / np.sqrt(count)
            assert abs(channel.mean - off[contact, axis]) < 4.0 * sigma
            assert 0.95 * sigma < channel.deviation < 2.5 * sigma
        slow = read + np.linspace(0.0, 40.0, len(read))[:, None, None]
    drifting = [x.deviation for x in unloaded_offset_equations(builder, bound(replace(log, contact_wrench_local=slow)))]
    assert min(drifting) > 3.0 * NOISE.wrench_std[3] / np.sqrt(count), "a drift is no noise of single readings"


def test_offsets_and_scales_are_exact_with_readings_in_the_air() -> None:
    log, off = swinging()
    scaled = ExtraTerms(EVERY, {"contact_force": "log"})
    gain = np.array([1.1, 0.95, 1.05] * 2)[:, None] * np.ones(6)
    gain = np.where(np.arange(6) < 3, gain[:3], 1.0)
    read = replace(log, contact_wrench_local=value(log.contact_wrench_local) / gain)
    robot = world().robot
    sensors = named_sensors("full", robot.n, len(CONTACTS), NOISE, len(robot.ft_names))
    for terms, given, expected in ((OFFSETS, log, np.ones((3, 6))), (scaled, read, gain)):
        found = fit(robot, CONTACTS, sensors, replace(terms, offsets=ALL.offsets), [bound(given)])
        of_contacts = {x.extra.label: x for x in found.extras if x.extra.contact is not None}
        assert len(of_contacts) == (15 if given is log else 15 + 9)  # of vectors along world axes, all three
        for label, x in of_contacts.items():
            contact, axis = x.extra.contact
            true = off.wrench[contact, axis] if x.extra.what == "offset" else expected[contact, axis] - 1.0
            assert x.value == pytest.approx(true, rel=1e-7, abs=1e-8), label


def test_parts_of_readings_in_the_air_are_beside_those_of_samples_which_stay_as_they_are() -> None:
    log, _ = swinging()
    builder = builder_of()
    parts = compress_parts([bound(log)], builder, threads=1)
    blind = compress_parts([replace(bound(log), unloaded=None)], builder, threads=1)
    on_ground = [part for part in parts if not part.unloaded]
    assert sum(part.samples for part in parts) == len(log)
    for part, expected in zip(on_ground, blind, strict=True):
        assert part.factor.rows == expected.factor.rows
        assert torch.equal(part.factor.triangle(), expected.factor.triangle())
    (air,) = (part for part in parts if part.unloaded)
    assert air.samples == 0
    assert air.factor.rows == sum(extra.contact is not None for extra in builder.extras)
    assert not air.factor.triangle()[:, : builder.columns.count].any(), "no body weighs anything there"


# ------------------------------------------------------------------------------------------- what they must not say


def test_readings_that_something_has_set_to_0_are_no_offset_of_0() -> None:
    (part,) = of_air(written(0.0))
    contacts = {number for number, extra in enumerate(builder_of().extras) if extra.contact is not None}
    assert part.masked == contacts
    assert not part.factor.rows


def test_missing_readings_say_nothing() -> None:
    assert not of_air(written(np.nan))


def test_a_clamp_at_0_is_recognized_and_a_coarse_sensor_about_0_is_not_taken_for_one() -> None:
    rng = np.random.default_rng(3)
    log, _ = swinging()
    wrench = value(log.contact_wrench_local).copy()
    noise = rng.normal(size=wrench.shape)
    for readings, masked in ((np.maximum(noise, 0.0), True), (np.round(noise), False), (noise, False)):
        free = ~value(log.contact_active)[..., None]
        (part,) = of_air(replace(log, contact_wrench_local=np.where(free, readings, wrench)))
        assert bool(part.masked) == masked
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            warn_of_masked([part], builder_of())
        assert [" read exactly 0 in the air" in str(x.message) for x in caught] == [True] * masked
