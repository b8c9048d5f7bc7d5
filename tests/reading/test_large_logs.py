"""A log larger than memory is read, preprocessed and bound block by block, with the same result."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from large import (
    SAMPLES,
    SMALL,
    Fields,
    assert_same,
    experiment,
    is_on_disk,
    overrides,
    recorded,
    samples_of,
)
from motions import RATE
from thinned import each_once

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import read_log, write_log
from torchid.logs.blocks import log_bytes, open_log_blocks
from torchid.logs.timeline import lay_out_timeline

SETTINGS = {
    "differentiated": ({}, 0.0),
    "filtered": ({"cutoff_hz": 8}, 1e-10),
    "resampled": ({"sample_rate_hz": 137}, 0.0),
    "filtered and resampled": ({"sample_rate_hz": 301.5, "cutoff_hz": 25}, 1e-10),
    "every fifth sample": ({"sample_rate_hz": 100, "cutoff_hz": 25}, 1e-10),
    "as few samples as the filter allows": ({"sample_rate_hz": "auto", "cutoff_hz": 18}, 1e-10),
    "away from contact changes": ({"contact_margin_s": 0.05, "cutoff_hz": 20}, 1e-10),
}

SUFFIXES = (".npz", ".csv", ".parquet", ".h5")


@pytest.mark.parametrize(("name", "jitter"), each_once([*SETTINGS], [0.0, 0.3]))
def test_blocks_give_the_samples_of_the_whole_log(tmp_path: Path, name: str, jitter: float) -> None:
    settings, tolerance = SETTINGS[name]
    file = experiment(tmp_path, recorded(jitter=jitter), ".h5")
    chosen = (*overrides(settings), "actuators.stiction=true")
    whole, large = samples_of(file, *chosen), samples_of(file, *chosen, SMALL)
    assert is_on_disk(large)
    assert not is_on_disk(whole)
    assert_same(large, whole, tolerance)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Logs in memory are read in blocks however short they are."""
    monkeypatch.setattr("torchid.reading.log_reader._WHOLE_GB", 0.0)
    monkeypatch.setattr("torchid.reading.log_steps.BLOCK_GB", 1e-4)


@pytest.mark.parametrize(("name", "threads"), each_once([*SETTINGS], [3, 1]))
def test_a_long_log_in_memory_is_worked_on_in_blocks_by_threads(
    tmp_path: Path, name: str, threads: int, request: pytest.FixtureRequest
) -> None:
    settings, tolerance = SETTINGS[name]
    file = experiment(tmp_path, recorded(jitter=0.3))
    chosen = (*overrides(settings), "actuators.stiction=true")
    whole, before = samples_of(file, *chosen), torch.get_num_threads()
    request.getfixturevalue("small_blocks")
    torch.set_num_threads(threads)
    try:
        blocks = samples_of(file, *chosen)
    finally:
        torch.set_num_threads(before)
    assert not is_on_disk(blocks)
    assert whole.resting is not None
    assert whole.resting.any(0).all()
    assert not whole.resting.all()
    assert_same(blocks, whole, tolerance)
    assert sorted(os.listdir(tmp_path)) == ["log.npz", "run.yaml"]


@pytest.mark.parametrize(("suffix", "cutoff"), each_once(SUFFIXES, ["null", "20"]))
def test_normals_of_the_ground_come_in_blocks_too(
    tmp_path: Path, suffix: str, cutoff: str, request: pytest.FixtureRequest
) -> None:
    fields = recorded(9_000)
    normals = np.random.default_rng(0).normal(size=(9_000, 4, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    fields["contact_normal_world"] = np.where(fields["contact_active"][..., None], normals, np.nan)
    feet = ", ".join(f"{{frame: {foot}, type: point, radius: 0.02}}" for foot in fields["contact_names"])
    file = experiment(tmp_path, fields, suffix)
    settings = ("sensors=joints", f"preprocessing.cutoff_hz={cutoff}", f"contacts=[{feet}]")
    whole = samples_of(file, *settings)
    assert whole.contact_normal is not None
    request.getfixturevalue("small_blocks")
    for more in ((), (SMALL,)):
        assert_same(samples_of(file, *settings, *more), whole, 1e-10)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_forces_along_the_normal_come_in_blocks_too(
    tmp_path: Path, suffix: str, request: pytest.FixtureRequest
) -> None:
    fields = recorded(9_000)
    fields["contact_force_normal"] = fields.pop("contact_wrench_local")[..., 2]
    file = experiment(tmp_path, fields, suffix)
    feet = ", ".join(f"{foot}: [fn]" for foot in fields["contact_names"])
    settings = (
        *overrides({"cutoff_hz": 20}, f"{{contact_wrenches: {{{feet}}}, offsets: {{contact_force: log}}}}"),
        "sensors.set=null",
    )
    whole = samples_of(file, *settings)
    assert whole.has_force_normal
    assert whole.wrench is not None
    assert whole.wrench[:, :, 2].abs().max() > 20.0
    assert whole.unloaded is not None
    assert whole.unloaded[:, 0, 2].isfinite().any()
    request.getfixturevalue("small_blocks")
    for more in ((), (SMALL,)):
        blocks = samples_of(file, *settings, *more)
        assert_same(blocks, whole, 1e-10)
        assert blocks.has_force_normal


@pytest.mark.parametrize(("suffix", "terms"), each_once(SUFFIXES, ["{contact_force: log}", "{}"]))
def test_readings_in_the_air_are_kept_where_offsets_are_fitted(
    tmp_path: Path, suffix: str, terms: str, request: pytest.FixtureRequest
) -> None:
    file = experiment(tmp_path, recorded(9_000), suffix)
    settings = (*overrides({"cutoff_hz": 20}), "sensors.set=full", f"sensors.offsets={terms}")
    whole = samples_of(file, *settings, required=False)
    request.getfixturevalue("small_blocks")
    for more in ((), (SMALL,)):
        blocks = samples_of(file, *settings, *more, required=False)
        assert is_on_disk(blocks) == bool(more)
        assert_same(blocks, whole, 1e-10)
        assert (blocks.unloaded is None) == (terms == "{}")


def test_a_damaged_byte_of_a_long_log_is_found(tmp_path: Path, small_blocks: None) -> None:
    file = experiment(tmp_path, recorded())
    data = bytearray((tmp_path / "log.npz").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "log.npz").write_bytes(data)
    with pytest.raises(LogError, match="Bad CRC-32"):
        samples_of(file, *overrides({}))


def test_the_neighbourhood_of_a_block_is_as_long_as_the_filter_remembers() -> None:
    for cutoff, rate in ((8.0, 500.0), (0.5, 100.0), (49.0, 100.0), (20.0, 1000.0)):
        time = np.arange(60_000) / rate
        low_pass = lay_out_timeline(time, cutoff, None, differentiates=False).low_pass
        assert low_pass is not None
        impulse = np.zeros(60_000)
        impulse[30_000] = 1.0
        response = np.abs(low_pass(impulse[:, None])[:, 0])
        assert response[30_000 + low_pass.settling :].max() < 1e-15 * response.max()
        assert response[30_000 + low_pass.settling // 2 :].max() > 1e-15 * response.max(), "no longer than needed"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_of_all_kinds_stream(tmp_path: Path, suffix: str) -> None:
    file = experiment(tmp_path, recorded(9_000), suffix)
    whole, large = (samples_of(file, *overrides({"cutoff_hz": 20}, "full"), *more, required=False)
                    for more in ((), (SMALL,)))  # fmt: skip
    assert is_on_disk(large)
    assert_same(large, whole, 1e-10)


@pytest.mark.parametrize("save", [np.savez_compressed, np.savez], ids=["compressed", "plain"])
def test_packed_and_transposed_arrays_are_unpacked_on_the_way(tmp_path: Path, save: Callable[..., None]) -> None:
    file, fields = experiment(tmp_path, recorded(6_000)), recorded(6_000)
    save(tmp_path / "log.npz", **fields | {"joint_torque": np.asfortranarray(fields["joint_torque"])})
    whole, large = samples_of(file, *overrides({})), samples_of(file, *overrides({}), SMALL)
    assert is_on_disk(large)
    assert_same(large, whole, 0.0)


def test_what_is_given_and_need_not_be_derived_is_carried_as_it_is(tmp_path: Path) -> None:
    """Also velocities in the base frame, and a bolted base."""
    file, fields = experiment(tmp_path, recorded(9_000)), recorded(9_000)
    whole = samples_of(file, *overrides({}))
    fields |= {"joint_velocity": fields["joint_position"], "joint_acceleration": fields["joint_position"]}
    del fields["base_position_world"], fields["base_quat_xyzw"], fields["contact_wrench_local"]
    np.savez(tmp_path / "log.npz", **fields)
    whole, large = (samples_of(file, "robot.fixed_base=true", *overrides({}), *x) for x in ((), (SMALL,)))
    assert len(whole) == 9_000
    assert_same(large, whole, 0.0)
    fields = recorded(9_000) | {"base_linear_acceleration_base": np.random.default_rng(0).normal(size=(9_000, 3))}
    np.savez(tmp_path / "log.npz", **fields)
    whole, large = (samples_of(file, *overrides({"cutoff_hz": 30}), *x) for x in ((), (SMALL,)))
    assert_same(large, whole, 1e-10)


def test_a_channel_with_gaps_anywhere_is_nan_everywhere_and_the_warning_is_that_of_the_whole_log(
    tmp_path: Path,
) -> None:
    fields = recorded()
    fields["joint_torque"][:, 0] = np.nan
    fields["joint_torque"][6_000:6_100, 1] = np.nan
    fields["joint_torque"][[17, 8_900], 2] = np.nan
    down = np.flatnonzero(fields["contact_active"][:, 3])
    fields["contact_wrench_local"][down[-5:], 3, 2] = np.nan
    fields["contact_wrench_local"][:, 1, 3:] = np.nan
    file = experiment(tmp_path, fields)
    found, said = [], []
    for more in ((), (SMALL,)):
        with pytest.warns(TorchidWarning, match="NaN throughout") as caught:
            found.append(samples_of(file, *overrides({"cutoff_hz": 20}), *more, required=False))
        said.append([str(warning.message) for warning in caught])
    assert said[0] == said[1]
    assert len(said[0]) == 2
    assert_same(found[1], found[0], 1e-10)
    torque = found[1].torque
    assert torque is not None
    assert torque[:, :3].isnan().all()
    assert not torque[:, 3:].isnan().any()


def spoil(name: str, index: Any, value: float) -> Callable[[Fields], None]:
    def change(fields: Fields) -> None:
        fields[name][index] = value

    return change


def shorten(name: str) -> Callable[[Fields], None]:
    def change(fields: Fields) -> None:
        fields[name] = fields[name][:-3]

    return change


BAD = {
    "a position that is no number": spoil("joint_position", (8_601, 4), np.nan),
    "an infinite torque": spoil("joint_torque", (5_000, 0), np.inf),
    "a torque beyond all that is measured": spoil("joint_torque", (8_345, 3), -1e160),
    "a torque that was not measured": spoil("joint_torque", (8_900, 7), np.nan),
    "a quaternion of another norm": spoil("base_quat_xyzw", 7_777, 0.4),
    "a step back in time": spoil("time", 6_000, 3.0),
    "a gap in time": spoil("time", slice(5_000, None), np.arange(4_000) / RATE + 99.0),  # type: ignore[arg-type]
    "a field that is too short": shorten("joint_torque"),
    "a field of no log": lambda fields: fields.update(joint_torqe=fields["joint_torque"]),
    "no positions": lambda fields: fields.pop("joint_position"),
    "a joint twice": spoil("joint_names", 1, "front_left_hip"),  # type: ignore[arg-type]
    "an unknown joint": spoil("joint_names", 1, "tail"),  # type: ignore[arg-type]
    "text for numbers": lambda fields: fields.update(joint_torque=np.full((SAMPLES, 12), "x")),
    "a contact of no robot": spoil("contact_names", 0, "nose"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("change", BAD.values(), ids=BAD.keys())
def test_a_bad_large_log_is_refused_in_the_words_for_a_small_one(
    tmp_path: Path, change: Callable[[Fields], None], request: pytest.FixtureRequest
) -> None:
    file, fields = experiment(tmp_path, recorded(100)), recorded()
    change(fields)
    np.savez(tmp_path / "log.npz", **fields)
    said = []
    for more in ((), (SMALL,)):
        with pytest.raises(InputError) as caught:
            samples_of(file, *overrides({}), *more)
        said.append(str(caught.value))
        assert sorted(os.listdir(tmp_path)) == ["log.npz", "run.yaml"]
    assert said[1].replace("near it", "in all") == said[0]
    request.getfixturevalue("small_blocks")
    with pytest.raises(InputError) as caught:
        samples_of(file, *overrides({}))
    assert str(caught.value).replace("near it", "in all") == said[0]


def test_the_size_of_a_log_is_known_before_it_is_read(tmp_path: Path) -> None:
    fields = recorded(2_000)
    numbers = sum(x[:1].size for x in fields.values() if len(x) == 2_000)
    experiment(tmp_path, fields, ".csv")
    write_log(read_log(tmp_path / "log.npz"), tmp_path / "log.parquet")
    assert log_bytes(tmp_path / "log.parquet", 0.0) == 8 * 2_000 * numbers
    assert log_bytes(tmp_path / "log.csv", 0.0) == pytest.approx(8 * 2_000 * numbers, rel=1e-3)
    most = log_bytes(tmp_path / "log.csv", 1e9)
    assert 8 * 2_000 * numbers <= most == 4 * (tmp_path / "log.csv").stat().st_size, "a small file is not counted"
    stored = log_bytes(tmp_path / "log.npz", 0.0)
    assert stored == pytest.approx(sum(x.nbytes for x in fields.values()), abs=4_000)
    with pytest.raises(LogError, match="no such file"):
        log_bytes(tmp_path / "other.npz", 0.0)


def test_signs_of_quaternions_go_on_across_blocks_that_overlap_touch_or_start_anew(tmp_path: Path) -> None:
    experiment(tmp_path, recorded(1_000))
    whole = read_log(tmp_path / "log.npz").base_quat_xyzw
    assert whole is not None
    with open_log_blocks(tmp_path / "log.npz", tmp_path) as blocks:
        for first, last in ((0, 2), (0, 400), (380, 700), (700, 701), (701, 1_000)):
            np.testing.assert_array_equal(blocks.read(slice(first, last)).base_quat_xyzw, whole[first:last])
