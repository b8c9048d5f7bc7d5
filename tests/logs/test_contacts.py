"""Contact flags over the reach of a filter: any force that it smears onto a sample has its contact active there."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from motions import jittered, uniform, value

from torchid.logs import Log
from torchid.logs.log import BoolArray, FloatArray
from torchid.logs.preprocess import preprocess
from torchid.logs.timeline import JITTER, lay_out_timeline

CUTOFF = 10.0  # Hz: a reach of 0.1 s


def stepping(time: FloatArray, feet: int = 3) -> BoolArray:
    """Feet that land and leave at random, some for a single sample, the last one never on the floor."""
    rng = np.random.default_rng(4)
    flags = rng.random((len(time), feet)) < [0.02, 0.001, 0.0]
    flags[:, 0] |= np.sin(7.0 * time) > 0.5
    return flags


def any_within(reach: float, native: FloatArray, flags: BoolArray, at: FloatArray) -> BoolArray:
    """By brute force: whether a flag, which holds until the next sample, is true anywhere within `reach` of a stamp."""
    slack = JITTER * float(np.median(np.diff(native)))
    ends = np.append(native[1:], np.inf)
    rows = []
    for stamp in at:
        overlaps = (native <= stamp + reach + slack) & (ends > stamp - reach + slack)
        rows.append(flags[overlaps].any(axis=0))
    return np.array(rows)


@pytest.mark.parametrize("rate", [None, 123.0, 40.0, 2000.0], ids=["own stamps", "123 Hz", "40 Hz", "2 kHz"])
@pytest.mark.parametrize("time", [uniform(2.0), jittered(2.0)], ids=["uniform", "jittered"])
def test_a_filtered_contact_is_active_where_it_truly_is_within_the_filters_reach(
    time: FloatArray, rate: float | None
) -> None:
    timeline = lay_out_timeline(time, CUTOFF, rate, differentiates=True)
    assert timeline.reach == pytest.approx(1.0 / CUTOFF)
    flags = stepping(time)
    found = timeline.widen_flags(flags)
    np.testing.assert_array_equal(found, any_within(timeline.reach, timeline.native, flags, timeline.output_stamps))
    assert found.shape == (len(timeline.output_stamps), 3)
    assert not found[:, 2].any()
    assert not found[:, 1].all()


@pytest.mark.parametrize("rate", [123.0, 40.0, 2000.0])
@pytest.mark.parametrize("time", [uniform(2.0), jittered(2.0)], ids=["uniform", "jittered"])
def test_without_a_filter_a_resampled_flag_is_that_of_the_sample_before(time: FloatArray, rate: float) -> None:
    timeline = lay_out_timeline(time, None, rate, differentiates=True)
    assert timeline.reach == 0.0
    flags = stepping(time)
    np.testing.assert_array_equal(
        timeline.widen_flags(flags), any_within(0.0, timeline.native, flags, timeline.output_stamps)
    )
    before = np.searchsorted(timeline.native, timeline.output_stamps + 1e-9, side="right") - 1
    np.testing.assert_array_equal(timeline.widen_flags(flags), flags[before])


@pytest.mark.parametrize("time", [uniform(2.0), jittered(2.0)], ids=["uniform", "jittered"])
def test_without_a_filter_or_resampling_flags_are_the_logs_own(time: FloatArray) -> None:
    timeline = lay_out_timeline(time, None, None, differentiates=True)
    flags = stepping(time)
    np.testing.assert_array_equal(timeline.widen_flags(flags), flags[timeline.kept])


def test_a_shorter_reach_belongs_to_a_higher_cutoff() -> None:
    time = uniform(2.0)
    flags = np.zeros((len(time), 1), bool)
    flags[500] = True  # 1 s
    for cutoff in (5.0, 10.0, 50.0):
        timeline = lay_out_timeline(time, cutoff, None, differentiates=False)
        active = timeline.output_stamps[timeline.widen_flags(flags)[:, 0]]
        assert active.min() == pytest.approx(1.0 - 1.0 / cutoff, abs=0.0021)
        assert active.max() == pytest.approx(1.0 + 1.0 / cutoff, abs=0.0021)


@pytest.mark.parametrize("rate", [None, 200.0])
@pytest.mark.parametrize(("seconds", "share"), [(0.0, 0.02), (0.2, 0.0006)], ids=["step", "two periods of the cutoff"])
def test_where_a_filtered_contact_is_not_active_hardly_any_of_its_force_is_left(
    rate: float | None, seconds: float, share: float
) -> None:
    """An impact leaves 2 % of its force beyond the reach, one that grows over two periods of the cutoff 0.05 %."""
    time = uniform(4.0)
    grown = np.clip(np.minimum(time - 1.0, 3.0 - time) / max(seconds, 1e-9), 0.0, 1.0)
    grown = grown**3 * (10.0 - 15.0 * grown + 6.0 * grown**2)
    wrench = np.zeros((len(time), 1, 6))
    wrench[:, 0, 2] = 700.0 * grown
    log = Log(
        "x", time, ("a",), np.sin(time)[:, None],
        contact_names=("foot",), contact_active=wrench[..., 2] > 0.0, contact_wrench_local=wrench,
    )  # fmt: skip
    out = preprocess(log, CUTOFF, rate)
    active, force = value(out.contact_active)[:, 0], value(out.contact_wrench_local)[:, 0, 2]
    assert np.abs(force[~active]).max() < share * 700.0
    assert (~active).any()
    assert force[active].max() == pytest.approx(700.0, rel=0.2)
    begins, ends = out.time[active][[0, -1]]
    assert (begins, ends) == pytest.approx((0.9, 3.1), abs=0.008)


def test_a_log_of_reversed_views_is_one_that_torch_takes() -> None:
    t = uniform(0.05, 100.0)
    position = np.arange(10.0).reshape(5, 2)
    log = Log("x", t, ("b", "a"), position[:, ::-1])
    np.testing.assert_array_equal(torch.from_numpy(value(log.joint_position)), position[:, ::-1])
