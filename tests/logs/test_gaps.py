"""Short gaps of a recording are bridged by a spline, all others stay what they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from raw_logs import log_refusal

from torchid.errors import LogError, TorchidWarning
from torchid.logs import Log, read_log
from torchid.logs.gaps import bridge_gaps

TIME = np.arange(200) / 100.0
ALL = np.ones(200, bool)


def gap(*samples: slice) -> np.ndarray:
    """1 for every sample (N,), NaN in some."""
    out = np.ones(200)
    for one in samples:
        out[one] = np.nan
    return out


def signal(hz: float, phase: float = 0.3) -> np.ndarray:
    return np.sin(2.0 * np.pi * hz * TIME + phase)


def bridged(longest_s: float, **fields: np.ndarray) -> dict[str, np.ndarray]:
    return bridge_gaps({"time": TIME, **fields}, longest_s)


def test_a_spline_fills_gaps_up_to_the_length_between_the_values_beside_them() -> None:
    exact = np.stack([signal(1.0), signal(2.0)], axis=1)
    broken = exact.copy()
    broken[50:54, 0] = np.nan  # 0.05 s from value to value
    broken[90:95, 1] = np.nan  # 0.06 s
    with pytest.warns(TorchidWarning, match=r"^joint_position: gaps of up to 0.05 s were bridged in 4 of 200 samples$"):
        found = bridged(0.05, joint_position=broken)["joint_position"]
    assert np.abs(found[:, 0] - exact[:, 0]).max() < 2e-5
    assert np.array_equal(found[:, 1], broken[:, 1], equal_nan=True)
    untouched = ~np.isnan(broken[:, 0])
    assert np.array_equal(found[untouched, 0], exact[untouched, 0])
    assert np.isnan(broken[50:54, 0]).all()  # what is given stays as it is


def test_a_cubic_signal_is_filled_exactly_and_no_spline_crosses_a_long_gap() -> None:
    cubic = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7])(TIME)
    values = cubic * gap(slice(30, 33), slice(60, 120), slice(122, 124))
    values[60:] += 1e3 * (TIME[60:] > 1.1)  # after the long gap another curve, by a step
    with pytest.warns(TorchidWarning, match="5 of 200"):
        found = bridged(0.04, base_position_world=np.stack([values] * 3, axis=1))["base_position_world"][:, 0]
    assert np.abs(found[:60] - cubic[:60]).max() < 1e-13
    assert np.isnan(found[60:120]).all()
    assert np.abs(found[120:] - cubic[120:] - 1e3).max() < 1e-9


def test_the_noise_of_a_bridged_sample_is_at_most_that_which_is_documented() -> None:
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((200, 2_000))
    noise[100:104] = np.nan
    with pytest.warns(TorchidWarning):
        filled = bridged(0.05, joint_torque=noise)["joint_torque"][100:104]
    assert 1.9 < np.sqrt(np.square(filled).mean(axis=1)).max() < 2.3


def test_gaps_at_the_ends_and_channels_without_any_value_stay() -> None:
    torque = np.stack([signal(1.0) * gap(slice(0, 2), slice(198, 200)), np.full(200, np.nan)], axis=1)
    assert np.array_equal(bridged(1.0, joint_torque=torque)["joint_torque"], torque, equal_nan=True)


def test_quaternions_are_bridged_as_a_whole_without_sign_flips_and_normalised() -> None:
    half = 0.4 * signal(1.0)
    exact = np.stack([np.cos(half), 0.6 * np.sin(half), 0 * half, 0.8 * np.sin(half)], axis=1)
    flipped = exact * np.where(TIME > 0.52, -1.0, 1.0)[:, None]
    flipped[51:54, 1] = np.nan  # one component is lost: all are
    with pytest.warns(TorchidWarning, match="3 of 200"):
        found = bridged(0.05, base_quat_wxyz=flipped)["base_quat_wxyz"]
    assert np.abs(np.abs((found * exact).sum(axis=1)) - 1.0).max() < 1e-9
    assert np.abs(np.linalg.norm(found, axis=1) - 1.0).max() < 1e-15


def test_a_force_is_bridged_only_while_its_contact_touches() -> None:
    active = np.stack([ALL, TIME < 0.515], axis=1)
    wrench = np.repeat(signal(1.0)[:, None, None], 2, axis=1) * np.ones(6)
    wrench[50:53] = np.nan
    wrench[..., 5] = np.nan  # never measured
    with pytest.warns(TorchidWarning, match="contact_wrench_local: gaps"):
        found = bridged(0.05, contact_wrench_local=wrench, contact_active=active)["contact_wrench_local"]
    assert np.isfinite(found[:, 0, :5]).all()
    assert np.isnan(found[50:53, 1]).all()
    assert np.isnan(found[..., 5]).all()


def test_flags_hold_over_a_gap() -> None:
    flags = np.where(TIME < 0.515, 1.0, 0.0) * gap(slice(50, 53), slice(80, 83))
    with pytest.warns(TorchidWarning, match="6 of 200"):
        found = bridged(0.05, contact_active=flags[:, None])["contact_active"][:, 0]
    assert found[50:53].tolist() == [1.0, 1.0, 1.0]
    assert found[80:83].tolist() == [0.0, 0.0, 0.0]


def test_nothing_is_filled_unless_it_is_told() -> None:
    fields = {"time": TIME, "joint_position": signal(1.0)[:, None] * gap(slice(50, 52))[:, None]}
    assert bridge_gaps(fields, None)["joint_position"] is fields["joint_position"]


def written(path: Path, position: np.ndarray) -> Path:
    np.savez(path, time=TIME, joint_names=["hip"], joint_position=position[:, None])
    return path


def test_a_refusal_names_the_key_and_the_longest_gap(tmp_path: Path) -> None:
    broken = signal(1.0) * gap(slice(20, 22), slice(50, 58))
    path = written(tmp_path / "a.npz", broken)
    message = log_refusal(path)
    assert (
        "joint_position: nan at sample 20, hip; accepted: finite numbers, or preprocessing.bridge_gaps_s to brid"
        in message
    )
    assert "(the longest is 0.09 s)" in message
    with pytest.warns(TorchidWarning, match="2 of 200"), pytest.raises(LogError, match="nan at sample 50, hip"):
        read_log(path, bridge_gaps_s=0.05)
    with pytest.warns(TorchidWarning, match="10 of 200"):
        log: Log = read_log(path, bridge_gaps_s=0.09)
    assert np.abs(log.joint_position[:, 0] - signal(1.0)).max() < 1e-3
    at_end = written(tmp_path / "b.npz", signal(1.0) * gap(slice(0, 3)))
    assert "no gap has values on both sides" in log_refusal(at_end)


@pytest.mark.parametrize("value", [np.inf, 1e300, -np.inf])
def test_what_is_no_number_beside_a_gap_is_refused_as_without_it(tmp_path: Path, value: float) -> None:
    position = signal(1.0) * gap(slice(50, 52))
    position[[49, 60]] = value
    with pytest.raises(LogError, match="joint_position: "):
        read_log(written(tmp_path / "a.npz", position), bridge_gaps_s=0.05)


def test_stamps_that_are_none_are_refused_before_any_gap_is_filled(tmp_path: Path) -> None:
    broken = (signal(1.0) * gap(slice(50, 52)))[:, None]
    for time, found in ((np.float64(3.0), r"time: shape \(\)"), (TIME[::-1], "time: .* accepted: strictly increasing")):
        np.savez(tmp_path / "a.npz", time=time, joint_names=["hip"], joint_position=broken)
        with pytest.raises(LogError, match=found):
            read_log(tmp_path / "a.npz", bridge_gaps_s=0.05)


def test_a_part_knows_nothing_of_what_is_beyond_its_ends(tmp_path: Path) -> None:
    path = written(tmp_path / "a.npz", signal(1.0) * gap(slice(99, 102)))
    with pytest.raises(LogError, match="nan at sample 99, hip"):
        read_log(f"{path}[:1]", bridge_gaps_s=0.05)
