"""Contact flags and a base's motion that are worked out of other fields, of logs larger than memory."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import DEMO
from large import SMALL, assert_same, is_on_disk, samples_of
from motions import value
from refusals import refusal
from thinned import slow_but
from walking import MACHINES, recorded, truth

from torchid.logs import Log, write_log

MACHINE = MACHINES["quadruped"]
NO_BASE: dict[str, Any] = {"base_quat_xyzw": None, "base_position_world": None}
NO_FLAGS: dict[str, Any] = {"contact_names": (), "contact_active": None}
BAG = {"link": "trunk", "mass": 6.0, "center_of_mass": [0.05, 0.0, 0.1]}


@cache
def walked() -> Log:
    """A walk of two blocks and a bit, to and fro, with the pose of its base."""
    log = recorded(MACHINE, truth(MACHINE, 0, seconds=8.4), seed=0, noise=0.1)
    count = len(log)
    there_and_back = np.concatenate([np.arange(count), np.arange(count)[::-1]] * 2 + [np.arange(count)])
    arrays: dict[str, Any] = {name: array[there_and_back] for name, array in log.arrays().items()}
    time = np.arange(len(there_and_back)) * (log.time[1] - log.time[0])
    return replace(log, **arrays | {"time": time, "contact_wrench_local": None})


def written(
    folder: Path,
    change: Callable[[Log], Log],
    radius: float = 0.0,
    normal: tuple[float, ...] = (0.0, 0.0, 1.0),
    payload: dict[str, Any] | None = None,
    **more: Any,
) -> Path:
    write_log(change(walked()), folder / "walk.h5")
    log = "walk.h5" if payload is None else {"file": "walk.h5", "payload": payload}
    settings = {
        "robot": {"urdf": str(DEMO / "quadruped.urdf")},
        "contacts": [{"frame": name, "type": "point", "radius": radius, "normal": normal} for name in MACHINE.feet],
        "logs": {"train": [log]},
        "preprocessing": {"cutoff_hz": 15} | more,
        "sensors": "joints",
        "output": str(folder / "run"),
    }
    (folder / "walk.yaml").write_text(json.dumps(settings))
    return folder / "walk.yaml"


def without_base(log: Log) -> Log:
    """Feet are lifted for a while at three places, two of them close together."""
    active = value(log.contact_active).copy()
    for start, stop in ((1_000, 1_030), (1_034, 1_060), (4_080, 4_110)):
        active[start:stop, :2] = False
    return replace(log, **NO_BASE, contact_active=active)


def bare(log: Log) -> Log:
    return replace(log, **NO_BASE, **NO_FLAGS)


def unflagged(log: Log) -> Log:
    torque = value(log.joint_torque).copy()
    torque[4_090:4_100, 3], torque[:2, 4] = np.nan, np.nan
    return replace(log, **NO_FLAGS, joint_torque=torque)


def read_in_the_air(log: Log) -> Log:
    """Feet have sensors with offsets, which read in the air too; one force was never read, nor was a foot's flag."""
    rng = np.random.default_rng(3)
    active = without_base(log).contact_active
    loaded = 30.0 * value(active)[..., None] * rng.uniform(0.5, 1.0, (len(log), 4, 6))
    wrench = loaded + rng.normal(size=(4, 6)) + 0.2 * rng.normal(size=loaded.shape)
    wrench[:, 1, 0], wrench[:, :, 3:] = np.nan, 0.0
    return replace(log, contact_active=active, contact_wrench_local=wrench)


def flagless(log: Log) -> Log:
    return replace(read_in_the_air(log), contact_active=None)


def by_scalars(log: Log) -> Log:
    """Scalar sensors at three feet, a flag alone at the fourth."""
    log = read_in_the_air(log)
    force = np.linalg.norm(np.nan_to_num(value(log.contact_wrench_local)[..., :3]), axis=2)
    force[:, 2] = np.nan
    return replace(log, contact_wrench_local=None, contact_force_normal=force)


def on_plates(log: Log) -> Log:
    """Moments about points that move over plates, unknown where nothing touches."""
    log = read_in_the_air(log)
    wrench = np.nan_to_num(value(log.contact_wrench_local))
    return replace(log, contact_wrench_local=None, contact_wrench_world=wrench, moments_about_world_origin=True)


def with_gaps(log: Log) -> Log:
    """Gaps of many lengths in every kind of field, some across the ends of blocks, some too long."""
    log, rng = read_in_the_air(log), np.random.default_rng(4)
    quat = value(log.base_quat_xyzw) * rng.choice([-1.0, 1.0], (len(log), 1))
    torque, wrench = value(log.joint_torque).copy(), value(log.contact_wrench_local).copy()
    for array in (quat, position := log.joint_position.copy(), torque, wrench[..., :3]):
        for start in (*rng.integers(10, len(log) - 40, 12), 4_094, 8_190):
            array[(slice(start, start + rng.integers(1, 8)), *map(rng.integers, array.shape[1:]))] = np.nan
    torque[3_000:3_050, 2] = np.nan  # stays
    return replace(log, base_quat_xyzw=quat, joint_position=position, joint_torque=torque, contact_wrench_local=wrench)


def gaps_alone(log: Log) -> Log:
    return replace(with_gaps(log), contact_active=None)


FORCE: dict[str, Any] = {"contact_threshold": {"above": 10.0, "below": 6.0, "shortest_s": 0.05}}
SETTINGS: dict[str, tuple[Callable[[Log], Log], float, dict[str, Any]]] = {
    "base": (without_base, 0.0, {"base_motion": "contacts"}),
    "base on balls": (without_base, 0.02, {"base_motion": "contacts", "contact_margin_s": 0.01}),
    "base, resampled": (without_base, 0.0, {"base_motion": "contacts", "sample_rate_hz": 170}),
    "base, unfiltered": (without_base, 0.0, {"base_motion": "contacts", "cutoff_hz": None}),
    "base, slip": (without_base, 0.0, {"base_motion": "contacts", "max_slip": 0.05}),
    "flags": (unflagged, 0.0, {"detect_contacts": True}),
    "flags by force": (flagless, 0.0, FORCE),
    "flags by scalars, slip": (by_scalars, 0.0, FORCE | {"max_slip": 0.05}),
    "flags by force, base": (flagless, 0.0, FORCE | {"base_motion": "contacts"}),
    "zeros": (read_in_the_air, 0.0, {"zero_in_air": True}),
    "zeros of scalars": (by_scalars, 0.0, {"zero_in_air": True}),
    "zeros of plates": (on_plates, 0.0, {"zero_in_air": True}),
    "zeros, then flags": (flagless, 0.0, {"zero_in_air": True, **FORCE}),
    "gaps": (with_gaps, 0.0, {"bridge_gaps_s": 0.1}),
    "gaps, flags": (with_gaps, 0.0, {"bridge_gaps_s": 0.1, "detect_contacts": True}),
    "gaps, zeros, flags by force": (
        lambda log: replace(with_gaps(log), contact_active=None),
        0.0,
        {"bridge_gaps_s": 0.1, "zero_in_air": True, **FORCE},
    ),
    "flags without the base": (bare, 0.0, {"detect_contacts": {"margin_s": 0.05}, "base_motion": "contacts"}),
}


#: Of which others hold all that they are made of.
PARTS = ("base", "flags", "base, unfiltered", "flags by force", "zeros", "zeros, then flags", "gaps", "gaps, flags")


@pytest.mark.parametrize("name", slow_but(SETTINGS.keys() - PARTS, SETTINGS))
def test_blocks_give_the_samples_and_warnings_of_the_whole_log(tmp_path: Path, name: str) -> None:
    change, radius, more = SETTINGS[name]
    file = written(tmp_path, change, radius, **more)

    def read(*overrides: str) -> tuple[Any, list[str]]:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            samples = samples_of(file, *overrides, required=False)
        return samples, sorted({str(x.message) for x in said if "noise" not in str(x.message)})

    whole, lines = read()
    large, of_blocks = read(SMALL)
    assert is_on_disk(large)
    assert not is_on_disk(whole)
    assert 500 < len(whole) < len(walked())
    assert_same(large, whole, 1e-9)
    assert of_blocks == lines


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_payload_counts_for_the_flags_of_a_large_log_too(tmp_path: Path) -> None:
    flags = {"detect_contacts": {"touch": 0.1, "lift": 0.1, "light": 1.0}}
    without = samples_of(written(tmp_path, unflagged, **flags), SMALL, required=False)
    file = written(tmp_path, unflagged, payload=BAG, **flags)
    whole, large = samples_of(file, required=False), samples_of(file, SMALL, required=False)
    assert_same(large, whole, 1e-9)
    np.testing.assert_array_equal(value(large.payload), value(whole.payload))
    assert len(without) != len(whole), "the weight that feet carry"


def lifted(log: Log) -> Log:
    return replace(log, **NO_BASE, contact_active=np.zeros_like(value(log.contact_active)))


def without_a_knee(log: Log) -> Log:
    torque = value(log.joint_torque).copy()
    torque[::3, log.joint_names.index("front_left_knee")] = np.nan
    return replace(log, **NO_FLAGS, joint_torque=torque)


def in_world(log: Log) -> Log:
    return replace(log, **NO_BASE, contact_wrench_world=np.zeros((len(log), 4, 6)))


def with_a_gap(log: Log) -> Log:
    position = log.joint_position.copy()
    position[8_300, 2] = np.nan
    return replace(log, **NO_BASE, joint_position=position)


def without_torques(log: Log) -> Log:
    return replace(log, **NO_FLAGS, joint_torque=None)


REFUSED: dict[str, tuple[Callable[[Log], Log], dict[str, Any], str]] = {
    "no foot stands": (lifted, {"base_motion": "contacts"}, "contact_active: no contact stands in any sample"),
    "world": (in_world, {"base_motion": "contacts"}, "contact_wrench_world: given, but preprocessing.base_motion"),
    "no flags": (bare, {"base_motion": "contacts"}, "contact_active: missing; accepted"),
    "a gap": (with_a_gap, {"base_motion": "contacts"}, "joint_position: nan at sample 8300"),
    "no force": (bare, {"contact_threshold": 5.0}, "contact_wrench: missing; accepted"),
    "no reading": (bare, {"zero_in_air": True}, "contact_wrench_local: missing; accepted"),
    "no foot in the air": (
        lambda log: replace(read_in_the_air(log), contact_active=np.ones_like(value(log.contact_active))),
        {"zero_in_air": True},
        "contact_wrench_local: 0 readings of front_left_foot in the air",
    ),
    "no torques": (without_torques, {"detect_contacts": True}, "joint_torque: missing"),
    "a knee": (without_a_knee, {"detect_contacts": True}, "joint_torque: measured at front_left_hip, front_left_thigh"),
    "tilted": (
        bare,
        {"detect_contacts": True, "base_motion": "contacts", "normal": (0.1, 0.0, 1.0)},
        "base_quat_xyzw: missing, with detect_contacts on a tilted floor in a log that is not in memory at once",
    ),
}


@pytest.mark.parametrize(("change", "more", "message"), REFUSED.values(), ids=REFUSED.keys())
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_what_large_logs_lack_is_said_in_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[Log], Log],
    more: dict[str, Any],
    message: str,
) -> None:
    file = written(tmp_path, change, **more)
    line = refusal(["identify", str(file), SMALL], tmp_path, capsys)
    assert message in line


@pytest.mark.parametrize("name", ["joint_torque", "joint_position", "contact_active"])
def test_fields_of_text_are_refused_whatever_follows_from_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    file = written(tmp_path, without_base, detect_contacts=True, base_motion="contacts")
    write_log(without_base(walked()), tmp_path / "walk.npz")
    with np.load(tmp_path / "walk.npz") as archive:
        fields = dict(archive)
    np.savez(tmp_path / "walk.npz", **(fields | {name: fields[name].astype("U5")}))
    log = f"logs.train=['{tmp_path / 'walk.npz'}']"
    settings = [] if name != "contact_active" else ["preprocessing.detect_contacts=false"]
    assert f"walk.npz: {name}: " in refusal(["identify", str(file), SMALL, log, *settings], tmp_path, capsys)
