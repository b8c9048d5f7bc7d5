"""A log larger than memory is read, preprocessed and bound part by part, with the same result."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import DEMO
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
from motions import RATE, value
from scipy.interpolate import CubicSpline
from walking import MACHINES, truth
from walking import recorded as recorded_walk

from torchid.errors import InputError, LogError, TorchidWarning
from torchid.logs import Log, read_log, write_log
from torchid.logs.blocks import log_bytes
from torchid.logs.timeline import lay_out_timeline
from torchid.problem import Samples

SETTINGS = {
    "differentiated": {},
    "filtered": {"cutoff_hz": 8},
    "resampled": {"sample_rate_hz": 125},
    "every fifth sample": {"sample_rate_hz": 100, "cutoff_hz": 24},
    "as few samples as the filter allows": {"sample_rate_hz": "auto", "cutoff_hz": 18},
    "away from contact changes": {"contact_margin_s": 0.05, "cutoff_hz": 18},
}

SUFFIXES = (".npz", ".csv", ".parquet", ".h5")


@pytest.mark.parametrize(("name", "suffix"), [(name, SUFFIXES[k % 4]) for k, name in enumerate(SETTINGS)])
def test_parts_give_the_samples_of_the_whole_log(tmp_path: Path, name: str, suffix: str) -> None:
    file = experiment(tmp_path, recorded(), suffix)
    chosen = overrides(SETTINGS[name], "{set: full, offsets: {contact_force: log}}")
    whole, large = samples_of(file, *chosen, required=False), samples_of(file, *chosen, SMALL, required=False)
    assert is_on_disk(large)
    assert not is_on_disk(whole)
    assert whole.unloaded is not None
    assert_same(large, whole, 1e-9)


def test_jittered_stamps_are_evened_out_in_each_part(tmp_path: Path) -> None:
    """Their grid begins anew with each part: the same signals, at stamps between those of the whole."""
    file = experiment(tmp_path, recorded(jitter=0.3))
    chosen = overrides({"cutoff_hz": 8, "sample_rate_hz": 301.5})
    whole, large = samples_of(file, *chosen), samples_of(file, *chosen, SMALL)
    assert abs(len(large) - len(whole)) <= 3
    for name in ("joint_position", "joint_acceleration"):
        x, y = (value(getattr(samples, name)).numpy() for samples in (large, whole))
        inside = slice(5, -5)
        between = CubicSpline(whole.time.numpy(), y)(large.time.numpy())
        np.testing.assert_allclose(x[inside], between[inside], rtol=0.0, atol=1e-3 * np.abs(y).max(), err_msg=name)


def test_joints_at_rest_are_those_of_each_part(tmp_path: Path) -> None:
    """At rest is slower than a tenth of the root mean square, of a part or of all."""
    file = experiment(tmp_path, recorded())
    chosen = (*overrides({"cutoff_hz": 20}), "actuators.stiction=true")
    whole, large = (value(samples_of(file, *chosen, *more).resting) for more in ((), (SMALL,)))
    assert whole.any(0).all()
    assert float((whole != large).double().mean()) < 0.01


def test_normals_of_the_ground_and_forces_along_them_come_in_parts_too(tmp_path: Path) -> None:
    fields = recorded()
    normals = np.random.default_rng(0).normal(size=(SAMPLES, 4, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    fields["contact_normal_world"] = np.where(fields["contact_active"][..., None], normals, np.nan)
    fields["contact_force_normal"] = fields.pop("contact_wrench_local")[..., 2]
    names = fields["contact_names"]
    feet = ", ".join(f"{{frame: {foot}, type: point, radius: 0.02}}" for foot in names)
    read = ", ".join(f"{foot}: [fn]" for foot in names)
    file = experiment(tmp_path, fields)
    sensors = f"{{contact_wrenches: {{{read}}}, offsets: {{contact_force: log}}}}"
    settings = (*overrides({"cutoff_hz": 18}, sensors), "sensors.set=null", f"contacts=[{feet}]")
    whole, large = samples_of(file, *settings), samples_of(file, *settings, SMALL)
    assert whole.contact_normal is not None
    assert large.has_force_normal
    assert value(whole.wrench)[:, :, 2].abs().max() > 15.0
    assert_same(large, whole, 1e-9)


def test_the_parts_overlap_by_as_much_as_the_filter_remembers() -> None:
    for cutoff, rate in ((8.0, 500.0), (0.5, 100.0), (49.0, 100.0), (20.0, 1000.0)):
        time = np.arange(60_000) / rate
        low_pass = lay_out_timeline(time, cutoff, None, differentiates=False).low_pass
        assert low_pass is not None
        impulse = np.zeros(60_000)
        impulse[30_000] = 1.0
        response = np.abs(low_pass(impulse[:, None])[:, 0])
        assert response[30_000 + low_pass.settling :].max() < 1e-15 * response.max()
        assert response[30_000 + low_pass.settling // 2 :].max() > 1e-15 * response.max(), "no longer than needed"


@pytest.mark.parametrize("save", [np.savez_compressed, np.savez], ids=["compressed", "plain"])
def test_packed_and_transposed_arrays_are_unpacked_on_the_way(tmp_path: Path, save: Callable[..., None]) -> None:
    file, fields = experiment(tmp_path, recorded(6_000)), recorded(6_000)
    save(tmp_path / "log.npz", **fields | {"joint_torque": np.asfortranarray(fields["joint_torque"])})
    whole, large = samples_of(file, *overrides({})), samples_of(file, *overrides({}), SMALL)
    assert is_on_disk(large)
    assert_same(large, whole, 1e-10)


def test_what_is_given_and_need_not_be_derived_is_carried_as_it_is(tmp_path: Path) -> None:
    file, fields = experiment(tmp_path, recorded()), recorded()
    fields |= {"joint_velocity": fields["joint_position"], "joint_acceleration": fields["joint_position"]}
    del fields["base_position_world"], fields["base_quat_xyzw"], fields["contact_wrench_local"]
    np.savez(tmp_path / "log.npz", **fields)
    whole, large = (samples_of(file, "robot.fixed_base=true", *overrides({}), *x) for x in ((), (SMALL,)))
    assert len(whole) == SAMPLES
    assert_same(large, whole, 0.0)


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_channel_with_gaps_is_nan_in_the_parts_that_have_them(tmp_path: Path) -> None:
    fields = recorded()
    fields["joint_torque"][:, 0] = np.nan
    fields["joint_torque"][[17, 8_900], 2] = np.nan
    file = experiment(tmp_path, fields)
    with pytest.warns(TorchidWarning, match=r"samples 0 to \d+ of 9000, counted from 0\): joint_torque: NaN in part"):
        large = samples_of(file, *overrides({"cutoff_hz": 20}), SMALL, required=False)
    torque = value(large.torque)
    assert torque[:, 0].isnan().all()
    assert torque[[0, -1], 2].isnan().all()
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
    "a torque that was not measured": spoil("joint_torque", (8_900, 7), np.nan),
    "a step back in time": spoil("time", 6_000, 3.0),
    "a gap in time": spoil("time", slice(5_000, None), np.arange(4_000) / RATE + 99.0),  # type: ignore[arg-type]
    "a field that is too short": shorten("joint_torque"),
    "a field of no log": lambda fields: fields.update(joint_torqe=fields["joint_torque"]),
    "no positions": lambda fields: fields.pop("joint_position"),
    "a joint twice": spoil("joint_names", 1, "front_left_hip"),  # type: ignore[arg-type]
    "text for numbers": lambda fields: fields.update(joint_torque=np.full((SAMPLES, 12), "x")),
    "a contact of no robot": spoil("contact_names", 0, "nose"),  # type: ignore[arg-type]
}


@pytest.mark.parametrize("change", BAD.values(), ids=BAD.keys())
def test_a_bad_large_log_is_refused_for_the_field_of_a_small_one(
    tmp_path: Path, change: Callable[[Fields], None]
) -> None:
    file, fields = experiment(tmp_path, recorded(100)), recorded()
    change(fields)
    np.savez(tmp_path / "log.npz", **fields)
    refused = []
    for more in ((), (SMALL,)):
        with pytest.raises(InputError) as caught:
            samples_of(file, *overrides({}), *more)
        refused.append(caught.value)
        assert sorted(os.listdir(tmp_path)) == ["log.npz", "run.yaml"]
    assert refused[1].field == refused[0].field
    assert str(refused[1]).startswith(str(tmp_path / "log.npz"))


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


# ------------------------------------------------------------------------ what is worked out of other fields, in parts

MACHINE = MACHINES["quadruped"]
NO_BASE: dict[str, Any] = {"base_quat_xyzw": None, "base_position_world": None}
NO_FLAGS: dict[str, Any] = {"contact_names": (), "contact_active": None}
FORCE: dict[str, Any] = {"contact_threshold": {"above": 10.0, "below": 6.0, "shortest_s": 0.05}}


@cache
def walked() -> Log:
    """A walk of two parts and a bit, to and fro, with the pose of its base."""
    log = recorded_walk(MACHINE, truth(MACHINE, 0, seconds=8.4), seed=0, noise=0.1)
    count = len(log)
    there_and_back = np.concatenate([np.arange(count), np.arange(count)[::-1]] * 2 + [np.arange(count)])
    arrays: dict[str, Any] = {name: array[there_and_back] for name, array in log.arrays().items()}
    time = np.arange(len(there_and_back)) * (log.time[1] - log.time[0])
    return replace(log, **arrays | {"time": time, "contact_wrench_local": None})


def written(folder: Path, log: Log, normal: tuple[float, ...] = (0.0, 0.0, 1.0), **more: Any) -> Path:
    write_log(log, folder / "walk.h5")
    settings = {
        "robot": {"urdf": str(DEMO / "quadruped.urdf")},
        "contacts": [{"frame": name, "type": "point", "normal": normal} for name in MACHINE.feet],
        "logs": {"train": ["walk.h5"]},
        "preprocessing": {"cutoff_hz": 15} | more,
        "sensors": "joints",
        "output": str(folder / "run"),
    }
    (folder / "walk.yaml").write_text(json.dumps(settings))
    return folder / "walk.yaml"


def without_base() -> Log:
    """Feet are lifted for a while at three places, two of them close together."""
    active = value(walked().contact_active).copy()
    for start, stop in ((1_000, 1_030), (1_034, 1_060), (4_080, 4_110)):
        active[start:stop, :2] = False
    return replace(walked(), **NO_BASE, contact_active=active)


def with_gaps() -> Log:
    """Feet have sensors with offsets; short gaps in several fields, some across the ends of parts; no flags."""
    rng, log = np.random.default_rng(3), walked()
    loaded = 30.0 * value(without_base().contact_active)[..., None] * rng.uniform(0.5, 1.0, (len(log), 4, 6))
    wrench = loaded + rng.normal(size=(4, 6)) + 0.2 * rng.normal(size=loaded.shape)
    wrench[:, 1, 0], wrench[:, :, 3:] = np.nan, 0.0
    quat, torque = value(log.base_quat_xyzw).copy(), value(log.joint_torque).copy()
    for array in (quat, position := log.joint_position.copy(), torque, wrench[..., :3]):
        for start in (*rng.integers(10, len(log) - 40, 12), 4_198, 8_390):
            array[(slice(start, start + rng.integers(1, 8)), *map(rng.integers, array.shape[1:]))] = np.nan
    fields: dict[str, Any] = {"base_quat_xyzw": quat, "joint_position": position, "joint_torque": torque}
    return replace(log, contact_active=None, contact_wrench_local=wrench, **fields)


DERIVED: dict[str, tuple[Callable[[], Log], dict[str, Any]]] = {
    "base": (without_base, {"base_motion": "contacts", "max_slip": 0.05, "contact_margin_s": 0.01}),
    "gaps, flags by force": (with_gaps, {"bridge_gaps_s": 0.1, **FORCE}),
    "flags": (lambda: replace(walked(), **NO_FLAGS), {"detect_contacts": {"refit": False}}),
}


def alike(large: Samples, whole: Samples, tolerance: float) -> float:
    """The share of samples of either that are the same in the other; asserts that their motion is."""
    _, of_large, of_whole = np.intersect1d(
        large.time.numpy().round(6), whole.time.numpy().round(6), return_indices=True
    )
    for name in ("joint_acceleration", "torque"):
        x, y = value(getattr(large, name))[of_large], value(getattr(whole, name))[of_whole]
        assert float((x - y).abs().max()) <= tolerance * float(y.abs().max()), name
    x, y = value(large.base.specific_force)[of_large], value(whole.base.specific_force)[of_whole]
    assert float((x - y).abs().max()) <= tolerance * float(y.abs().max())
    same = (large.active[of_large] == whole.active[of_whole]).all(1)
    return int(same.sum()) / max(len(large), len(whole))


@pytest.mark.parametrize("name", DERIVED)
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_what_follows_from_other_fields_follows_part_by_part(tmp_path: Path, name: str) -> None:
    log, more = DERIVED[name]
    file = written(tmp_path, log(), **more)
    whole, large = samples_of(file, required=False), samples_of(file, SMALL, required=False)
    assert is_on_disk(large)
    assert 500 < len(whole) < len(walked())
    assert alike(large, whole, 1e-6) > (0.95 if name == "flags" else 0.99), "joints' friction is fitted to each part"


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_zeros_are_those_of_each_part(tmp_path: Path) -> None:
    file = written(tmp_path, with_gaps(), bridge_gaps_s=0.1, zero_in_air=True, **FORCE)
    whole, large = (value(samples_of(file, *more, required=False).wrench) for more in ((), (SMALL,)))
    assert float((whole - large).nan_to_num().abs().max()) < 0.2, "four standard deviations of a mean of 16 readings"


REFUSED: dict[str, tuple[Callable[[], Log], dict[str, Any], str]] = {
    "no foot stands": (
        lambda: replace(without_base(), contact_active=np.zeros_like(value(without_base().contact_active))),
        {"base_motion": "contacts"},
        "contact_active: no contact stands in any sample",
    ),
    "no force": (
        lambda: replace(walked(), **NO_FLAGS),
        {"contact_threshold": 5.0},
        "contact_wrench: missing; accepted",
    ),
    "tilted": (
        lambda: replace(walked(), **NO_BASE, **NO_FLAGS),
        {"detect_contacts": True, "base_motion": "contacts", "normal": (0.1, 0.0, 1.0)},
        "base_quat_xyzw: unknown: base_motion: contacts on a tilted floor needs the whole log in memory",
    ),
}


@pytest.mark.parametrize(("log", "more", "message"), REFUSED.values(), ids=REFUSED.keys())
def test_what_large_logs_lack_is_said_in_one_line(
    tmp_path: Path, log: Callable[[], Log], more: dict[str, Any], message: str
) -> None:
    with pytest.raises(LogError, match=message):
        samples_of(written(tmp_path, log(), **more), SMALL)
