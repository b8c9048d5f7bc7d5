"""Arrays of simulators, several fields side by side: a map takes some of their columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from raw_logs import log_refusal

from torchid.errors import InputError, LogError
from torchid.logs import Columns, read_log
from torchid.logs.blocks import open_log_blocks

RNG = np.random.default_rng(0)
TIME = 0.01 * np.arange(50)
QUAT = np.array([1.0, 0.1, -0.2, 0.05]) / np.linalg.norm([1.0, 0.1, -0.2, 0.05])
QPOS = np.hstack([RNG.normal(size=(50, 3)), np.tile(QUAT, (50, 1)), RNG.normal(size=(50, 2))])
MAP = {
    "joint_order": ["hip", "knee"],
    "joint_position": {"column": "qpos[7:]"},
    "base_position_world": {"column": "qpos[0:3]"},
    "base_quat_wxyz": {"column": "qpos[3:7]"},
    "joint_torque": {"column": "tau"},
}


def saved(path: Path) -> Path:
    arrays = {"time": TIME, "qpos": QPOS, "tau": QPOS[:, -2:]}
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, x in arrays.items():
                file[name] = x
    return path


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_parts_of_an_array_are_fields_whole_and_in_blocks(tmp_path: Path, suffix: str) -> None:
    path, columns = saved(tmp_path / f"x{suffix}"), Columns(**MAP)  # type: ignore[arg-type]
    log = read_log(path, columns=columns)
    np.testing.assert_array_equal(log.joint_position, QPOS[:, 7:])
    np.testing.assert_array_equal(log.base_position_world, QPOS[:, :3])
    np.testing.assert_allclose(log.base_quat_xyzw, QPOS[:, [4, 5, 6, 3]], atol=1e-15)
    with open_log_blocks(path, path.parent, columns) as blocks:
        some = blocks.read(slice(20, 30))
    np.testing.assert_array_equal(some.joint_position, QPOS[20:30, 7:])
    np.testing.assert_array_equal(some.base_position_world, QPOS[20:30, :3])


@pytest.mark.parametrize("shape", [(50, 6), (50, 1, 6)])
def test_a_wrench_of_one_contact_needs_no_axis_for_its_name(tmp_path: Path, shape: tuple[int, ...]) -> None:
    wrench = RNG.normal(size=shape)
    np.savez(tmp_path / "x.npz", time=TIME, qpos=QPOS, tau=QPOS[:, -2:], thrust=wrench)
    entries = {"contact_order": ["body"], "contact_wrench_local": {"column": "thrust"}}
    columns = Columns(**MAP, **entries, contact_active={"always": ["body"]})  # type: ignore[arg-type]
    found = read_log(tmp_path / "x.npz", columns=columns).contact_wrench_local
    np.testing.assert_array_equal(found, wrench.reshape(50, 1, 6))


@pytest.mark.parametrize("text", ["qpos[7:12]", "qpos[9:]", "qpos[4:4]", "time[0:2]"])
def test_columns_that_an_array_has_not_are_refused(tmp_path: Path, text: str) -> None:
    columns = Columns(**{**MAP, "joint_position": {"column": text}, "time": {"column": "time"}})  # type: ignore[arg-type]
    with pytest.raises(LogError, match="existing columns, counted from 0"):
        read_log(saved(tmp_path / "x.npz"), columns=columns)


@pytest.mark.parametrize("suffix", [".npz", ".h5", "chunks.h5"])
def test_transposed_arrays_and_fields_of_records_are_fields_whole_and_in_blocks(tmp_path: Path, suffix: str) -> None:
    records = np.zeros(50, [("time", "f8"), ("state", [("q", "f8", (2,)), ("mode", "i4")])])
    records["time"], records["state"]["q"] = TIME, QPOS[:, 7:]
    path = tmp_path / f"x{suffix}"
    if suffix == ".npz":
        np.savez(path, all=records, qpos=QPOS.T)
    else:
        packed: dict[str, Any] = {"chunks": (3, 16), "compression": "gzip"} if suffix == "chunks.h5" else {}
        with h5py.File(path, "w") as file:
            file["all"] = records
            file.create_dataset("qpos", data=QPOS.T, **packed)
    stated = MAP | {"time": {"column": "all['time']"}, "joint_position": {"column": "all['state']['q']"}}
    stated |= {"base_position_world": {"column": "qpos.T[0:3]"}, "base_quat_wxyz": {"column": "qpos.T[3:7]"}}
    columns = Columns(**(stated | {"joint_torque": {"column": "qpos.T[7:]"}}))  # type: ignore[arg-type]
    log = read_log(path, columns=columns)
    np.testing.assert_array_equal(log.joint_position, QPOS[:, 7:])
    np.testing.assert_array_equal(log.joint_torque, QPOS[:, 7:])
    np.testing.assert_array_equal(log.base_position_world, QPOS[:, :3])
    with open_log_blocks(path, tmp_path, columns) as blocks:
        some = blocks.read(slice(20, 30))
    np.testing.assert_array_equal(some.time, TIME[20:30])
    np.testing.assert_array_equal(some.joint_position, QPOS[20:30, 7:])
    np.testing.assert_array_equal(some.base_position_world, QPOS[20:30, :3])
    np.testing.assert_array_equal(some.base_quat_xyzw, log.base_quat_xyzw[20:30])


def test_an_array_without_an_entry_stays_unknown(tmp_path: Path) -> None:
    assert "qpos" in log_refusal(saved(tmp_path / "x.npz"))


def test_one_row_of_each_sample_in_an_array_counts_as_the_sample(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", time=TIME, data=QPOS[:, None, -2:])
    columns = Columns(joint_order=["hip", "knee"], joint_position={"column": "data"})  # type: ignore[arg-type]
    np.testing.assert_array_equal(read_log(tmp_path / "x.npz", columns=columns).joint_position, QPOS[:, -2:])


@pytest.mark.parametrize(("unit", "turn"), [("deg", 360.0), ("rad", 2.0 * np.pi), ("rev", 1.0)])
def test_angles_that_jump_by_a_turn_are_counted_from_where_a_turn_begins(
    tmp_path: Path, unit: str, turn: float
) -> None:
    angle = np.stack([0.1 * np.sin(TIME * 20.0), 0.05 + 0.2 * np.cos(TIME * 20.0)], axis=1)  # in turns
    np.savez(tmp_path / "x.npz", time=TIME, q=np.mod(angle, 1.0) * turn)
    entry = {"column": "q", "unit": unit, "turn_from": -0.5 * turn}
    columns = Columns(joint_order=["hip", "knee"], joint_position=entry)  # type: ignore[arg-type]
    log = read_log(tmp_path / "x.npz", columns=columns)
    np.testing.assert_allclose(log.joint_position, 2.0 * np.pi * angle, atol=1e-12)
    entry["turn_from"] = {"hip": -0.5 * turn}
    columns = Columns(joint_order=["hip", "knee"], joint_position=entry)  # type: ignore[arg-type]
    log = read_log(tmp_path / "x.npz", columns=columns)
    np.testing.assert_allclose(log.joint_position[:, 0], 2.0 * np.pi * angle[:, 0], atol=1e-12)
    np.testing.assert_allclose(log.joint_position[:, 1], 2.0 * np.pi * np.mod(angle[:, 1], 1.0), atol=1e-12)


@pytest.mark.parametrize("name", ["x.npz", "x.h5", "x.csv"])
def test_a_log_without_stamps_has_those_of_its_step(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "x.csv":
        path.write_text("q_0,q_1\n" + "".join(f"{a},{b}\n" for a, b in QPOS[:, -2:].tolist()))
        entry = "q_{index}"
    else:
        saved(path)
        entry = "qpos[7:]"
    stated = {"joint_order": ["hip", "knee"], "joint_position": {"column": entry}, "ignore": ["*"]}
    columns = Columns(time={"step": 5, "unit": "ms"}, **stated)  # type: ignore[arg-type]
    if name != "x.csv":
        columns = Columns(time={"step": 5, "unit": "ms"}, **(stated | {"ignore": ["time", "tau"]}))  # type: ignore[arg-type]
    log = read_log(path, columns=columns)
    np.testing.assert_array_equal(log.time, 0.005 * np.arange(50))
    with open_log_blocks(path, tmp_path, columns) as blocks:
        np.testing.assert_array_equal(blocks.time, log.time)
        np.testing.assert_array_equal(blocks.read(slice(20, 30)).time, log.time[20:30])


def test_a_step_has_no_column_beside_it_and_makes_up_no_positions(tmp_path: Path) -> None:
    for given, found in (
        (
            {"time": {"step": 0.01}, "joint_torque": {"column": "tau"}, "ignore": ["qpos", "time"]},
            "joint_position: missing",
        ),
        ({**MAP, "time": {"step": 0.01, "column": "time"}, "ignore": ["time"]}, "column and step together"),
        ({**MAP, "time": {"step": 0.01, "scale": 2}, "ignore": ["time"]}, "scale has no effect together with step"),
    ):
        columns = Columns(joint_order=["hip", "knee"], **{k: x for k, x in given.items() if k != "joint_order"})  # type: ignore[arg-type]
        with pytest.raises(InputError, match=found):
            read_log(saved(tmp_path / "x.npz"), columns=columns)


@pytest.mark.parametrize("name", ["x.npz", "x.csv"])
def test_stamps_in_two_columns_are_seconds_and_nanoseconds(tmp_path: Path, name: str) -> None:
    path, stamp = tmp_path / name, 1_999_000_000 + 5_000_000 * np.arange(50)
    arrays = {"stamp.sec": stamp // 10**9, "stamp.nsec": stamp % 10**9, "q_0": QPOS[:, -2], "q_1": QPOS[:, -1]}
    if name == "x.csv":
        rows = zip(*(x.tolist() for x in arrays.values()), strict=True)
        path.write_text(",".join(arrays) + "\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))
    else:
        np.savez(path, **arrays)
    stated: dict[str, Any] = {"joint_order": ["hip", "knee"], "joint_position": {"column": "q_{index}"}}
    time = {"column": "stamp.sec", "nanoseconds": "stamp.nsec"}
    columns = Columns(time=time, **stated)  # type: ignore[arg-type]
    log = read_log(path, columns=columns)
    np.testing.assert_allclose(log.time, 1e-9 * stamp, rtol=0.0, atol=1e-15)
    with open_log_blocks(path, tmp_path, columns) as blocks:
        np.testing.assert_array_equal(blocks.time, log.time)
    for entry, found in (
        ({"step": 5, "nanoseconds": "stamp.nsec"}, "time: nanoseconds has no effect together with step"),
        (time | {"nanoseconds": "stamp.nanosec"}, "time.nanoseconds: unknown name 'stamp.nanosec'|'stamp.nanosec'"),
        ({"nanoseconds": "stamp.nsec"}, "time: has no column"),
    ):
        with pytest.raises(InputError, match=found):
            read_log(path, columns=Columns(time=entry, **stated))  # type: ignore[arg-type]
