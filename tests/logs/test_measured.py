"""Contact flags, wrenches and torques through filtering and resampling."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motions import uniform, value

from torchid.errors import TorchidWarning
from torchid.logs import Log
from torchid.logs.preprocess import preprocess


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
        np.testing.assert_allclose(array[:, ~nan], expected[:, ~nan], rtol=0.0, atol=1e-14)


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
