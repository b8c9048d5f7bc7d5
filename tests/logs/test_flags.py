"""Contact flags by thresholds of forces: those that theory gives, from any file, and refusals."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import entries_of, parsed, topics_of, write_bag
from motions import value
from raw_logs import log_refusal
from refusals import refused

from torchid.errors import LogError
from torchid.logs import Log, read_log, write_log
from torchid.logs.flags import ContactThreshold, hysteresis, with_flags_by_force, without_short
from torchid.logs.log import FORCE_NORMAL, WRENCHES

SIZE, ABOVE, BELOW = 80.0, 30.0, 12.0
HZ = np.array([1.1, 0.7])
FEET = ("l_foot", "r_foot")


def walk(**fields: Any) -> tuple[Log, Any]:
    """Two feet with forces SIZE sin^2 in changing directions and no flags; the flags that these have by theory."""
    time = np.arange(1200) / 200.0
    phase = np.mod(2.0 * np.pi * HZ * time[:, None] + [0.0, 0.3], 2.0 * np.pi)
    on, off = (np.arccos(1.0 - 2.0 * limit / SIZE) for limit in (ABOVE, BELOW))
    active = (phase > on) & (phase < 2.0 * np.pi - off)
    direction = np.random.default_rng(0).normal(size=(len(time), 2, 6))
    wrench = direction / np.linalg.norm(direction[..., :3], axis=2, keepdims=True)
    wrench[..., :3] *= 0.5 * SIZE * (1.0 - np.cos(phase))[..., None]
    log = Log("x", time, ("hip",), np.zeros((len(time), 1)), contact_names=FEET, contact_wrench_local=wrench)
    return replace(log, **fields), active


def test_a_force_between_both_thresholds_keeps_its_flag() -> None:
    force = np.array([0.0, 0.04, 0.06, 0.04, 0.02, 0.04, 0.06, 0.01])
    assert hysteresis(force, 0.05, 0.03).tolist() == [False, False, True, True, False, False, True, False]
    assert hysteresis(np.full(3, 0.045), 0.05, 0.03).all()
    assert not hysteresis(np.full(3, 0.035), 0.05, 0.03).any()
    flags = np.array([1, 1, 1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1], dtype=bool)
    assert without_short(flags, 2).tolist() == [True] * 4 + [False] * 8 + [True] * 2
    assert without_short(flags, 1).tolist() == flags.tolist()


@pytest.mark.filterwarnings("ignore:.*no stamps in the messages:torchid.errors.TorchidWarning")
@pytest.mark.parametrize(
    ("suffix", "sensor"),
    [
        *product([".npz", ".h5", ".csv", ".parquet"], [*WRENCHES, FORCE_NORMAL]),
        *product([".mcap"], [WRENCHES[0], FORCE_NORMAL]),  # a bag has wrenches in frames of contacts alone
    ],
)
def test_flags_of_any_file_are_those_of_theory(tmp_path: Path, suffix: str, sensor: str) -> None:
    log, expected = walk()
    wrench = value(log.contact_wrench_local)
    given = np.linalg.norm(wrench[..., :3], axis=2) if sensor == "contact_force_normal" else wrench
    log = replace(log, **{"contact_wrench_local": None, sensor: given})
    path = tmp_path / f"walk{suffix}"
    if suffix != ".mcap":
        write_log(log, path)
        read = read_log(path, needs_flags=False)
    else:
        topics = {key: x for key, x in topics_of(log).items() if key != "contact_active"}
        read = read_log(write_bag(path, entries_of(log)), parsed(topics), needs_flags=False)
    found, certain = with_flags_by_force(read, ContactThreshold(ABOVE, BELOW))
    np.testing.assert_array_equal(found.contact_active, expected)
    assert certain.all()
    plain, _ = with_flags_by_force(read, ContactThreshold(ABOVE))
    assert (value(plain.contact_active) & ~expected).sum() == 0
    assert (expected & ~value(plain.contact_active)).sum() > 50  # between both thresholds, on their way down


def test_recorded_flags_are_replaced_and_those_of_a_contact_without_a_force_kept() -> None:
    log, expected = walk()
    wrench = value(log.contact_wrench_local).copy()
    wrench[:, 1] = np.nan
    recorded = np.random.default_rng(1).random(expected.shape) > 0.5
    found, _ = with_flags_by_force(
        replace(log, contact_wrench_local=wrench, contact_active=recorded), ContactThreshold(ABOVE, BELOW)
    )
    np.testing.assert_array_equal(value(found.contact_active)[:, 0], expected[:, 0])
    np.testing.assert_array_equal(value(found.contact_active)[:, 1], recorded[:, 1])
    bare = replace(log, contact_wrench_local=wrench)
    line = refused(
        lambda: with_flags_by_force(bare, ContactThreshold(ABOVE)), "x: contact_wrench_local: no force of r_"
    )
    assert "contact_active" in line


def test_each_contact_counts_by_its_own_sensor_a_scalar_one_first() -> None:
    log, expected = walk()
    wrench = value(log.contact_wrench_local).copy()
    scalar = np.linalg.norm(wrench[..., :3], axis=2)
    scalar[:, 0], wrench[:, 1] = np.nan, 1e3
    both = replace(log, contact_wrench_local=wrench, contact_force_normal=scalar)
    found, _ = with_flags_by_force(both, ContactThreshold(ABOVE, BELOW))
    np.testing.assert_array_equal(found.contact_active, expected)


def test_one_component_that_is_measured_is_the_force() -> None:
    log, expected = walk()
    wrench = np.full_like(value(log.contact_wrench_local), np.nan)
    wrench[..., 2] = np.linalg.norm(value(log.contact_wrench_local)[..., :3], axis=2)
    found, _ = with_flags_by_force(replace(log, contact_wrench_local=wrench), ContactThreshold(ABOVE, BELOW))
    np.testing.assert_array_equal(found.contact_active, expected)


def test_samples_of_stances_that_are_too_short_are_not_certain() -> None:
    force = np.full((300, 1), 50.0)
    force[100:200], force[150:154] = 0.0, 50.0
    fields: dict[str, Any] = {"time": np.arange(300) / 100.0, "joint_position": np.zeros((300, 1))}
    log = Log("x", **fields, joint_names=("hip",), contact_names=FEET[:1], contact_force_normal=force)
    found, certain = with_flags_by_force(log, ContactThreshold(ABOVE, BELOW, shortest_s=0.05))
    assert np.flatnonzero(~value(found.contact_active)[:, 0]).tolist() == list(range(100, 200))
    assert np.flatnonzero(~certain).tolist() == [150, 151, 152, 153]
    found, certain = with_flags_by_force(log, ContactThreshold(ABOVE, BELOW, shortest_s=0.04))
    assert value(found.contact_active)[150:154].all()
    assert certain.all()


def test_a_force_that_is_missing_for_a_while_is_refused() -> None:
    log, _ = walk()
    wrench = value(log.contact_wrench_local).copy()
    wrench[7:9, 1, 2] = np.nan
    broken = replace(log, contact_wrench_local=wrench)
    line = refused(
        lambda: with_flags_by_force(broken, ContactThreshold(ABOVE)),
        "x: contact_wrench_local: nan at sample 7, r_foot",
        LogError,
    )
    assert "preprocessing.bridge_gaps_s" in line
    bare = replace(log, contact_wrench_local=None)
    line = refused(lambda: with_flags_by_force(bare, ContactThreshold(ABOVE)), "x: contact_wrench: missing", LogError)
    assert "preprocessing.contact_threshold" in line


def test_normals_have_to_be_known_where_the_threshold_lets_a_contact_stand(tmp_path: Path) -> None:
    log, expected = walk()
    normals = np.where(expected[..., None], [0.0, 0.6, 0.8], np.nan)
    write_log(replace(log, contact_normal_world=normals), tmp_path / "a.npz")
    read = read_log(tmp_path / "a.npz", needs_flags=False)
    found, _ = with_flags_by_force(read, ContactThreshold(ABOVE, BELOW))
    np.testing.assert_allclose(value(found.contact_normal_world)[expected], [[0.0, 0.6, 0.8]] * expected.sum())
    start = f"{tmp_path / 'a.npz'}: contact_normal_world: norm nan"
    assert "while in contact" in refused(lambda: with_flags_by_force(read, ContactThreshold(5.0)), start, LogError)


def test_a_log_without_flags_is_otherwise_refused_with_the_key_that_makes_them(tmp_path: Path) -> None:
    write_log(walk()[0], tmp_path / "a.npz")
    line = log_refusal(tmp_path / "a.npz")
    assert "contact_wrench_local: given without contact_active" in line
    assert "preprocessing.contact_threshold" in line
