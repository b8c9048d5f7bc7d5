"""Maps of columns that do not fit themselves or their file, and files without a map: one line each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from dialects import save_csv
from mapped import ORDER, POSITION, TIME, mapped
from refusals import refused

from torchid.errors import ConfigError, InputError, LogError, UnknownNameError
from torchid.logs import Columns, read_log
from torchid.logs.blocks import open_log_blocks
from torchid.logs.columns import require_names

QUAT = POSITION + "base_quat_wxyz: "

BAD: list[tuple[str, dict[str, Any], str]] = [
    (
        'joint_position: "p_{index}"',
        {},
        "logs.columns.joint_position: 'p_0', no such column (1 more are missing); accepted: q_0",
    ),
    (
        'joint_position: "{joint}_pos"',
        {},
        "joint_position: no column fits '{joint}_pos'; accepted: time, q_0, q_1",
    ),
    (POSITION, {"q_1": None}, "logs.columns.joint_position: 'q_1', no such column; accepted:"),
    (
        POSITION + "joint_velocity: q_0",
        {},
        "joint_velocity: column 'q_0' is already in logs.columns.joint_position",
    ),
    (
        "joint_position: {columns: {a: q_0, b: q_0}}\nignore: [q_1]",
        {},
        "column 'q_0' is already in logs.columns.joint_position",
    ),
    ('joint_position: {column: "q_{index}", order: [a, b, a]}', {}, "joint_position.order: 'a' twice; accepted: every"),
    ('joint_position: "q_{index}"', {}, "joint_position.order: missing; accepted: names of the joints in the order"),
    ('joint_position: {column: "q_{index}", order: [a]}', {}, "no entry for q_1; accepted: an entry"),
    (POSITION, {"w": TIME, "t2": TIME, "x[3]": TIME}, "no entry for w, t2, x[3]; accepted"),
    (POSITION + 'joint_torque: {column: "t{index}", order: [hip, foot]}', {"t0": TIME, "t1": TIME}, "joint 'foot' mis"),
    (POSITION + "joint_torque: q_0", {}, "column 'q_0' is already in logs.columns.joint_position"),
    ('joint_position: {column: "q_{index}", order: [a, b], unit: grad}', {}, "unit: 'grad', an unknown unit; accepted"),
    ('joint_position: {column: "q_{index}", order: [a, b], unit: rpm}', {}, "'rpm', a unit of angular velocity; acc"),
    (
        'joint_position: {column: "q_{index}", order: [a, b], scale: {c: -1}}',
        {},
        "scale: unknown name 'c'; accepted: a",
    ),
    (
        POSITION + "time: {column: time, unit: deg}",
        {},
        "logs.columns.time.unit: 'deg', a unit of angle; accepted: s, m",
    ),
    (POSITION + "time: {column: time, unit: {x: s}}", {}, "logs.columns.time.unit: unknown name 'x'"),
    (
        POSITION + 'base_quat_wxyz: {column: "k_{axis}", unit: deg}',
        {},
        "accepted: no unit: this number has none",
    ),
    (
        QUAT + "{rpy: {columns: {roll: q_0}}}",
        {},
        "rpy.columns: components roll; accepted: all of",
    ),
    (
        QUAT + "{rpy: {column: q_0, unit: rpm}}",
        {},
        "rpy.unit: 'rpm', a unit of angular velocity; acc",
    ),
    (
        QUAT + "{column: q_0, rpy: q_1}",
        {},
        "base_quat_wxyz: column and rpy together; accepted: one",
    ),
    (
        'joint_position: {column: "q_{axis}", order: [a]}',
        {},
        "{axis} in 'q_{axis}'; accepted: at most one of each: {joi",
    ),
    ('joint_position: "{index}_{joint}"', {}, "accepted: at most one of each: {joint}, {index}"),
    (
        "joint_position: {order: [a, b]}",
        {},
        "joint_position: has no column; accepted: one of column, co",
    ),
    (POSITION + "joint_torque: {column: q_0, pd: {kd: 1}}", {}, "joint_torque: column and pd together; accepted: one"),
    (
        POSITION + "joint_torque: {pd: {kp: 1}}",
        {},
        "joint_torque.pd: kp without position; accepted: kp and the desired position",
    ),
    (
        POSITION + "joint_torque: {pd: {kd: 1}}",
        {},
        "joint_torque.pd.kd: given without joint_velocity; accepted: a log with joint_v",
    ),
    (
        POSITION + "joint_torque: {pd: {kp: {hip: 3}, position: 'r_{index}'}}",
        {"r_0": TIME, "r_1": TIME},
        "no gain for knee",
    ),
    (
        POSITION + "joint_torque: {pd: {kp: {q: 3}, position: 'r_{index}'}}",
        {"r_0": TIME, "r_1": TIME},
        "unknown name 'q'",
    ),
    (POSITION + "joint_torque: {unit: N mm, pd: {kd: 1}}", {}, "joint_torque: unit has no effect together with pd"),
    (
        POSITION + "joint_torque: {current: {column: 'r_{index}', torque_constant: {hip: 1}, gear_ratio: 9}}",
        {"r_0": TIME, "r_1": TIME},
        "joint_torque.current.torque_constant: no torque constant for knee; accepted: one for every joint",
    ),
    (
        POSITION + "joint_torque: {current: {column: 'r_{index}', unit: N m, torque_constant: 1, gear_ratio: 9}}",
        {"r_0": TIME, "r_1": TIME},
        "joint_torque.current.unit: 'N m', a unit of torque; accepted: A, mA",
    ),
    (
        POSITION + "joint_torque: {current: {torque_constant: 1, gear_ratio: 9}}",
        {},
        "joint_torque.current: has no column; accepted: one of column, columns",
    ),
    (
        POSITION + "contact_active: {above: 3}",
        {},
        "contact_active.above: nothing to compare with it; accepted: a ",
    ),
    (
        POSITION + "contact_active: {above: 3, always: [a]}",
        {},
        "contact_active: above has no effect together with alw",
    ),
    (
        POSITION + 'contact_force_normal: "f_{contact}"',
        {"f_a": TIME},
        "contact_force_normal: given without contact_act",
    ),
    (POSITION + "imu_frame: imu", {}, "imu_frame: given without imu_specific_force"),
    (POSITION + "imu_specific_force: {columns: {x: q_0}}", {}, "columns: components x; accepted: all of x, y, z"),
    (
        POSITION,
        {"joint_position__hip": TIME, "joint_position__knee": TIME},
        "joint_position: given twice, also as 'joint_position.hip'",
    ),
    (POSITION + 'joint_name: "{joint}s_of_{joint}"', {}, "accepted: a pattern with one {joint}, such as {joint}_link"),
    (POSITION, {"q_0": [1, "x", 3]}, "column 'q_0': 'x' in row 3; accepted: numbers, or empty cells"),
    (POSITION, {"q_0": [1, "", 3]}, "joint_position: nan at sample 1, hip; accepted: finite numbers"),
    (POSITION, {"time": None}, "time: missing"),
]


@pytest.mark.parametrize(("text", "columns", "found"), BAD)
def test_a_map_that_does_not_fit_ends_in_one_line(
    tmp_path: Path, text: str, columns: dict[str, Any], found: str
) -> None:
    if "joint_order" not in text and '"p_' in text:
        text = ORDER + text
    message = refused(lambda: mapped(tmp_path, text, **columns), f"{tmp_path / 'x.csv'}: ", InputError)
    assert found in message
    assert len(message) < 600


BAD_ARRAYS: list[tuple[str, dict[str, Any], str]] = [
    (
        "joint_position: {column: q, order: [a, b, c]}",
        {},
        "'q': shape (N, 2); accepted: (N, 3), one per name of its",
    ),
    (
        "joint_position: {column: q, order: [a]}",
        {},
        "'q': shape (N, 2); accepted: (N, 1), one per name of its order",
    ),
    (
        "joint_position: q",
        {},
        "logs.columns.joint_position.order: missing; accepted: names of the joints in the order o",
    ),
    (ORDER + "joint_position: p", {}, "logs.columns.joint_position: 'p', no such column; accepted: "),
    (ORDER + "joint_position: q", {"q": np.array([["a", "b"]] * 3)}, "'q': values of type <U1; accepted: real numbers"),
    (ORDER + "joint_position: q", {"q": np.array(1.0)}, "'q': a single value"),
    (ORDER + "joint_position: q", {"q": np.ones((2, 3))}, "'q': shape (N, 3); accepted: (N, 2), one per name of"),
    (ORDER + "joint_position: q.T", {"q": np.ones((2, 3, 1))}, "'q.T': a 3-dimensional array; accepted: a 2-dim"),
    (ORDER + "joint_position: p.T", {}, "logs.columns.joint_position: 'p.T', no such column; accepted: "),
    (ORDER + "joint_position: \"q['a']\"", {}, "'q['a']': an array of shape (N, 2); accepted: an array of records"),
    (
        ORDER + "joint_position: \"q['a']\"",
        {"q": np.zeros(3, [("b", "f8", (2,)), ("c", "f8")])},
        "'q['a']': no such field; accepted: fields of 'q': b, c",
    ),
    (ORDER + "joint_position: q", {"q": np.array([{}, []], dtype=object)}, "q: Python objects (pickled), references"),
    (
        ORDER + "joint_position: q",
        {"q": np.ones((4, 2))},
        "joint_position: shape (4, 2); accepted: shape (N, n) = (3, 2)",
    ),
    (ORDER + 'joint_position: "q{index}"', {"q0": np.ones(3), "q1": np.ones(2), "q": np.ones(1)}, "no entry for q;"),
    (
        ORDER + 'joint_position: "q{index}"\nignore: [q]',
        {"q0": np.ones(3), "q1": np.ones(2)},
        "'q1': 2 samples; accepted",
    ),
    (
        ORDER + "joint_position: q",
        {"joint_names": np.array(["hip", "foot"])},
        "joint 'foot' missing here; accepted: the ",
    ),
    (
        ORDER + "joint_position: q\nft_wrench: w\nsensor_order: [s]",
        {"w": np.ones((3, 5))},
        "'w': shape (N, 5); accepted",
    ),
    (
        ORDER + "joint_position: q\njoint_velocity: v",
        {"v": np.ones((2, 2))},
        "joint_velocity: shape (2, 2); accepted: s",
    ),
]


@pytest.mark.parametrize(("text", "arrays", "found"), BAD_ARRAYS)
@pytest.mark.parametrize("in_blocks", [False, True])
def test_arrays_that_do_not_fit_a_map_end_in_one_line(
    tmp_path: Path, text: str, arrays: dict[str, Any], found: str, in_blocks: bool
) -> None:
    path, columns = tmp_path / "x.npz", Columns(**yaml.safe_load(text))
    np.savez(path, **({"time": np.array(TIME), "q": np.arange(6.0).reshape(3, 2)} | arrays))

    def read() -> None:
        if not in_blocks:
            read_log(path, columns=columns)
            return
        with open_log_blocks(path, path.parent, columns) as blocks:
            blocks.read(slice(0, len(blocks)))

    assert found in refused(read, f"{path}: ", InputError)


def test_without_a_map_unknown_columns_are_named_in_one_line(tmp_path: Path) -> None:
    path = save_csv(tmp_path / "x.csv", dict.fromkeys(("Timestamp", "leftKneePos", "tau[3]"), [1, 2]))
    message = refused(
        lambda: read_log(path), f"{path}: columns: 3 unknown: Timestamp, leftKneePos, tau[3]; acc", LogError
    )
    assert "accepted: names of the log format, or a map of the columns (logs.columns) in an experiment file" in message
    for name, found in (
        (
            "speed",
            "columns: 1 unknown: speed; accepted: names of the log format, or a map of the columns (logs.columns)",
        ),
        ("joint_torqe", "unknown name 'joint_torqe'; accepted: joint_torque"),
    ):
        path = save_csv(tmp_path / "x.csv", {"time": TIME, name: TIME})
        assert found in refused(lambda: read_log(path), f"{path}: ", LogError)  # noqa: B023
        np.savez(tmp_path / "x.npz", **{"time": TIME, name: TIME})
        assert found in refused(lambda: read_log(tmp_path / "x.npz"), f"{tmp_path}", LogError)


def test_groups_of_hdf5_that_contain_themselves_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        for name in ("a", "b", "c"):
            file.create_group(name)
            for inner in ("a", "b", "c"):
                file[f"{name}/{inner}"] = file["/"]
        file["soft"] = h5py.SoftLink("/a")
    message = refused(lambda: read_log(path, columns=Columns(time="a/time")), f"{path}: ", LogError)
    assert "20004 arrays and groups; a log may have 20000" in message
    with h5py.File(path, "w") as file:
        file["time"], file["joint_names"] = TIME, ["a"]
        file["joint_position"], file["empty"] = np.ones((3, 1)), h5py.SoftLink("/time")
        file.create_group("nothing")
    assert "columns: 2 unknown: empty, nothing" in refused(lambda: read_log(path), f"{path}: ", LogError)


def test_columns_inside_of_others_count(tmp_path: Path) -> None:
    inner = pa.StructArray.from_arrays([pa.array(TIME), pa.array([[1.0]] * 3)], ["q", "list"])
    pq.write_table(pa.table({"time": pa.array(TIME), "a": inner}), tmp_path / "x.parquet")
    columns = Columns(**yaml.safe_load('joint_position: "{joint}.q"\nignore: ["a.list[0]"]'))
    assert read_log(tmp_path / "x.parquet", columns=columns).joint_names == ("a",)
    assert "2 unknown: a.q, a.list[0]" in refused(lambda: read_log(tmp_path / "x.parquet"), "")


def test_a_map_of_another_robot_says_so_and_a_misspelt_name_the_nearest() -> None:
    columns = Columns(joint_order=["LF_HAA", "LF_HFE"])  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="the robot has no joint LF_HAA, LF_HFE. Is it the recorded robot"):
        require_names(columns, {"joint": ["FL_hip", "FL_thigh"]})
    with pytest.raises(UnknownNameError, match="unknown name 'FL_hpi'"):
        require_names(Columns(joint_order=["FL_hpi", "FL_thigh"]), {"joint": ["FL_hip", "FL_thigh"]})  # type: ignore[arg-type]


def test_a_map_of_another_type_is_refused_with_the_one_to_make(tmp_path: Path) -> None:
    columns: Any = {"time": "t"}
    with pytest.raises(TypeError, match=r"columns: found dict; accepted: torchid.Columns\("):
        read_log(tmp_path / "x.npz", columns=columns)
