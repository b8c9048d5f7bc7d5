"""Logs as CSV and Parquet: one column per scalar, and every slip named by file and column."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from raw_logs import log_refusal, without_package

from torchid.errors import LogError, TorchidWarning
from torchid.guards import MAX_COLUMNS
from torchid.logs import Log, read_log, write_log
from torchid.logs.log import LARGEST
from torchid.logs.tables import table_blocks

Columns = dict[str, Sequence[Any]]
SUFFIXES = (".csv", ".parquet")
both = pytest.mark.parametrize("suffix", SUFFIXES)


def columns(**changes: Sequence[Any] | None) -> Columns:
    """A valid table of three samples; `__` in a name stands for a dot, None leaves a column out."""
    table: Columns = {
        "time": [0.0, 0.1, 0.25],
        "joint_position.knee": [1.0, 2.0, 3.0],
        "joint_position.hip.left": [4.0, 5.0, 6.0],
        "joint_torque.hip.left": [0.5, None, 0.75],
        "joint_torque.knee": [7.0, 8.0, 9.0],
        "contact_active.sole": [True, False, True],
        **{f"contact_wrench_local.sole.{x}": [i, 2 * i, None] for i, x in enumerate(("fz", "fy", "fx"), start=1)},
        **{f"contact_wrench_local.sole.{x}": [-1.0, -2.0, -3.0] for x in ("mx", "my", "mz")},
        "imu_frame": ["imu.link"] * 3,
        **{f"imu_specific_force.{x}": [9.0, 9.5, 9.8] for x in "zyx"},
        **{f"imu_angular_velocity.{x}": [1, 2, 3] for x in "xyz"},
    }
    table |= {name.replace("__", "."): value for name, value in changes.items() if value is not None}
    return {name: x for name, x in table.items() if changes.get(name.replace(".", "__"), x) is not None}


def save(path: Path, table: Columns) -> Path:
    """Write columns as they are, valid or not."""
    if path.suffix == ".parquet":
        pq.write_table(pa.table(dict(table)), path)
        return path
    cells = [["" if x is None else str(x) for x in values] for values in table.values()]
    lines = [",".join(table), *(",".join(row) for row in zip(*cells, strict=True))]
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


@both
def test_columns_in_any_order_make_up_the_fields(tmp_path: Path, suffix: str) -> None:
    log = read_log(save(tmp_path / f"x{suffix}", dict(reversed(columns().items()))))
    forward = read_log(save(tmp_path / f"y{suffix}", columns()))
    assert log.joint_names == ("hip.left", "knee")
    assert forward.joint_names == ("knee", "hip.left")
    for one in (log, forward):
        assert one.joint_torque is not None
        assert one.contact_wrench_local is not None
        hip = one.joint_names.index("hip.left")
        np.testing.assert_array_equal(one.joint_position[:, hip], [4.0, 5.0, 6.0])
        np.testing.assert_array_equal(one.joint_torque[:, hip], [0.5, np.nan, 0.75])
        np.testing.assert_array_equal(one.joint_torque[:, 1 - hip], [7.0, 8.0, 9.0])
        np.testing.assert_array_equal(one.contact_wrench_local[:, 0, :3], [[3, 2, 1], [6, 4, 2], [np.nan] * 3])
        np.testing.assert_array_equal(one.contact_active, [[True], [False], [True]])
        assert (one.contact_names, one.imu_frame) == (("sole",), "imu.link")


@pytest.mark.parametrize("flags", [[1, 0, 1], ["true", "FALSE", "True"], ["1.0", "0", " 1.000e+00"]])
def test_a_spreadsheet_may_write_flags_as_it_likes(tmp_path: Path, flags: list[Any]) -> None:
    log = read_log(save(tmp_path / "x.csv", columns(contact_active__sole=flags)))
    np.testing.assert_array_equal(log.contact_active, [[True], [False], [True]])


def test_a_spreadsheets_marks_spaces_and_quotes_change_nothing(tmp_path: Path) -> None:
    plain = save(tmp_path / "x.csv", columns())
    lines = plain.read_text().splitlines()
    quoted = [", ".join(f'"{cell}"' for cell in lines[0].split(",")).replace('", "', '","'), *lines[1:]]
    (tmp_path / "y.csv").write_bytes(b"\xef\xbb\xbf" + "\r\n".join([*quoted, "", ""]).encode())
    spaced = [lines[0].replace(",", " , "), *(line.replace(",", " , ") for line in lines[1:])]
    (tmp_path / "z.csv").write_text("\n".join(spaced))
    one = read_log(plain)
    for name in ("y.csv", "z.csv"):
        other = read_log(tmp_path / name)
        assert one.names == other.names
        for field, values in one.arrays().items():
            np.testing.assert_array_equal(values, other.arrays()[field])


BAD: list[tuple[dict[str, Any], str, str]] = [
    ({"time": None}, "time", "missing"),
    ({"joint_position__knee": None}, "joint_torque", "joint 'knee' missing in other fields"),
    ({"joint_positon__knee": [1.0] * 3}, "column 'joint_positon.knee'", "unknown name 'joint_positon'; accepted: joi"),
    ({"joint_names": ["a"] * 3}, "column 'joint_names'", "unknown name"),
    ({"joint_position": [1.0] * 3}, "column 'joint_position'", "accepted: joint_position.{joint}"),
    ({"time__x": [1.0] * 3}, "column 'time.x'", "accepted: time"),
    ({"joint_position__": [1.0] * 3}, "column 'joint_position.'", "accepted: joint_position.{joint}"),
    ({"contact_wrench_local__sole__f": [1.0] * 3}, "sole.f'", "accepted: contact_wrench_local.{contact}.{fx, fy, fz"),
    ({"contact_wrench_local__fx": [1.0] * 3}, "local.fx'", "accepted: contact_wrench_local.{contact}.{fx, fy, fz"),
    ({"imu_specific_force__w": [1.0] * 3}, "column 'imu_specific_force.w'", "accepted: imu_specific_force.{x, y, z}"),
    ({"base_quat_wxyz__w": [1.0] * 3}, "'base_quat_wxyz.x'", "no such column"),
    ({"contact_wrench_local__sole__mz": None}, "'contact_wrench_local.sole.mz'", "no such column"),
    ({"contact_active__sole": None}, "contact_wrench_local", "given without contact_active"),
    ({"imu_frame": None}, "imu_", "given without imu_frame"),
    ({"joint_position__knee [deg]": [1.0] * 3}, "joint_position.knee [deg];", "1 unknown"),
    ({"base_position_world__x(mm)": [1.0] * 3}, "x(mm)'", "this field has no such component"),
    ({"imu_frame": ["a", "a", "b"]}, "imu_frame", "'a' and 'b'; accepted: the same name in every row"),
    ({"imu_frame": ["a", None, "a"]}, "imu_frame", "'a' and an empty cell"),
    ({"time": [0.0, 0.1, 0.1]}, "time", "0.1 at sample 2, after 0.1 at sample 1"),
    ({"time": [0.0, None, 0.1]}, "time", "nan at sample 1"),
    ({"joint_position__knee": [1.0, None, 2.0]}, "joint_position", "nan at sample 1, knee"),
    ({"contact_active__sole": [1, None, 0]}, "contact_active", "nan at sample 1, sole"),
    ({"joint_torque__knee": [1.0, float("inf"), 2.0]}, "joint_torque", "inf at sample 1, knee"),
    ({f"joint_position.{'k' * 1000}": [1.0] * 3}, "header", "a name of 1015 characters"),
    ({"joint_position__kn\x1bee": [1.0] * 3}, "header", "a name of 20 characters: joint_position.kn\\x1bee"),
]


@both
@pytest.mark.parametrize(("changes", "place", "found"), BAD)
def test_every_unusable_column_is_named_in_one_line(
    tmp_path: Path, suffix: str, changes: dict[str, Any], place: str, found: str
) -> None:
    message = log_refusal(save(tmp_path / f"bad{suffix}", columns(**changes)))
    assert place in message
    assert found in message


def test_text_where_a_number_belongs_is_named_with_its_row(tmp_path: Path) -> None:
    path = save(tmp_path / "x.csv", columns(joint_torque__knee=[1.0, "n/a", 2.0]))
    assert "column 'joint_torque.knee': 'n/a' in row 3; accepted: numbers" in log_refusal(path)
    path = save(tmp_path / "y.csv", columns(contact_active__sole=[1, "perhaps", 0]))
    assert "column 'contact_active.sole': 'perhaps'; accepted: true and false" in log_refusal(path)
    path = save(tmp_path / "z.parquet", columns(joint_torque__knee=["1", "2", "3"]))
    assert "column 'joint_torque.knee': values of type string; accepted: real numbers" in log_refusal(path)
    path = save(tmp_path / "z.parquet", columns(time=np.array([1, 2, 3], dtype="M8[D]")))
    assert "column 'time': values of type date32[day]" in log_refusal(path)


@pytest.mark.parametrize("separator", [";", "\t"])
@pytest.mark.parametrize("mark", [".", ","])
def test_semicolons_tabs_and_decimal_commas_are_recognised(tmp_path: Path, separator: str, mark: str) -> None:
    header, *rows = save(tmp_path / "x.csv", columns()).read_text().replace(",", separator).split("\n")
    numbers = [re.sub(r"(?<=\d)\.(?=\d)", mark, row) for row in rows]
    (tmp_path / "y.csv").write_text("\n".join([header, *numbers]))
    plain, other = read_log(tmp_path / "x.csv"), read_log(tmp_path / "y.csv")
    assert other.names == plain.names
    for field, values in plain.arrays().items():
        np.testing.assert_array_equal(other.arrays()[field], values)


def test_two_decimal_marks_in_a_file_are_refused_by_row(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("time;joint_position.a\n0,0;1,5\n0,1;2.5\n")
    assert (
        "column 'joint_position.a': '2.5' in row 3; accepted: numbers, or empty cells for missing values"
        in log_refusal(tmp_path / "x.csv")
    )
    (tmp_path / "y.csv").write_text("time;joint_position.a\n0,0;1,5\n0,1;1.002,5\n")
    assert "column 'joint_position.a': '1.002,5' in row 3; accepted: numbers" in log_refusal(tmp_path / "y.csv")


def test_quoted_names_with_other_separators_in_them_stay_names(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text('time,"joint_position.a;b;c","joint_position.d"\n0,1,2\n')
    assert read_log(tmp_path / "x.csv").joint_names == ("a;b;c", "d")
    (tmp_path / "y.csv").write_text('"time";"joint_position.a,b,c";"joint_position.d"\n0;1;2\n')
    assert read_log(tmp_path / "y.csv").joint_names == ("a,b,c", "d")


def test_rows_of_other_lengths_and_repeated_columns_are_refused(tmp_path: Path) -> None:
    whole = save(tmp_path / "x.csv", columns()).read_text()
    for text, found in (
        (whole + "1,2\n", "2 cells; accepted: 19 cells, as in the line of names"),
        (whole.replace("imu_frame", "time"), "column 'time': given twice"),
        (whole.replace("time", "t\xefme", 1).encode("latin-1"), "'t\xefme'"),
        (whole.encode("utf-16"), "header: bytes that are not text"),
        (whole.split("\n")[0], "time: no samples"),
        (whole.split("\n")[0] + "\n\n\n", "time: no samples"),
        ("", "header: an empty line"),
    ):
        (tmp_path / "x.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
        assert found in log_refusal(tmp_path / "x.csv")
    pq.write_table(pa.Table.from_arrays([pa.array([1.0]), pa.array([2.0])], ["time", "time"]), tmp_path / "x.parquet")
    assert "column 'time': given twice" in log_refusal(tmp_path / "x.parquet")
    assert "time: no samples" in log_refusal(
        save(
            tmp_path / "y.parquet", {"time": pa.array([], pa.float64()), "joint_position.a": pa.array([], pa.float64())}
        )
    )


@both
def test_names_with_dots_commas_and_quotes_round_trip_and_others_are_refused(tmp_path: Path, suffix: str) -> None:
    def log_of(*names: str) -> Log:
        return Log("x", np.array([0.0]), names, np.array([range(len(names))], dtype=float))

    names = ("a.b", "c,d", 'e"f', "größe", "g h", "../i", "fx")
    write_log(log_of(*names), tmp_path / f"x{suffix}")
    assert read_log(tmp_path / f"x{suffix}").joint_names == names
    for name in ("a\nb", "a ", "a [deg]", "a\udcff", "a" * 1000):
        with pytest.raises(LogError, match="header|column"):
            write_log(log_of(name), tmp_path / f"y{suffix}")
        assert not (tmp_path / f"y{suffix}").exists()
    wrench = Log("x", np.zeros(1), (), np.zeros((1, 0)), ft_names=("a.fx",), ft_wrench=np.ones((1, 1, 6)))
    write_log(wrench, tmp_path / f"z{suffix}")
    assert read_log(tmp_path / f"z{suffix}").ft_names == ("a.fx",)


@both
def test_every_float_survives_a_round_trip_to_the_bit(tmp_path: Path, suffix: str) -> None:
    bits = np.random.default_rng(3).integers(-(2**63), 2**63, size=(5000, 1))
    values = bits.view(np.float64)
    values[~(np.abs(values) <= LARGEST)] = np.nan
    values[:4, 0] = -0.0, 5e-324, LARGEST, 0.1
    log = Log("x", np.arange(5000.0), ("a",), np.zeros((5000, 1)), joint_torque=values)
    write_log(log, tmp_path / f"x{suffix}")
    again = read_log(tmp_path / f"x{suffix}").joint_torque
    assert again is not None
    measured = ~np.isnan(values)
    np.testing.assert_array_equal(again[measured].view(np.int64), values[measured].view(np.int64))
    assert np.isnan(again[~measured]).all()


def test_sizes_without_bounds_are_refused_before_they_fill_the_memory(tmp_path: Path) -> None:
    many = {"time": [0.0], **{f"joint_position.j{i}": [0.0] for i in range(MAX_COLUMNS)}}
    for suffix in SUFFIXES:
        assert f"{MAX_COLUMNS + 1} columns" in log_refusal(save(tmp_path / f"x{suffix}", many))
    rows = 2_000_000  # of one value: a few bytes a column, 500 MB of zeros
    zeros = pa.chunked_array([pa.array(np.zeros(rows))])
    wide = {"time": zeros, **{f"joint_position.j{i}": zeros for i in range(30)}}
    pq.write_table(pa.table(wide), tmp_path / "bomb.parquet")
    assert (tmp_path / "bomb.parquet").stat().st_size < 300_000
    assert "in a file of this size" in log_refusal(tmp_path / "bomb.parquet")
    (tmp_path / "line.csv").write_bytes(b"time," * 2_000_000)
    assert "columns" in log_refusal(tmp_path / "line.csv")
    (tmp_path / "row.csv").write_bytes(b"time,joint_position.a\n0," + b"1" * 10_000_000)
    assert "cannot be read" in log_refusal(tmp_path / "row.csv")


def test_a_long_text_in_every_row_of_a_parquet_file_is_kept_once(tmp_path: Path) -> None:
    text = pa.DictionaryArray.from_arrays(
        pa.array(np.zeros(200_000, np.int32)), ["a" * 100_000]
    )  # 20 GB if spelled out
    table = {"time": np.arange(200_000.0), "imu_frame": text}
    table |= {f"imu_{x}.{axis}": np.zeros(200_000) for x in ("specific_force", "angular_velocity") for axis in "xyz"}
    assert "reading it exceeds the memory limit" in log_refusal(save(tmp_path / "x.parquet", table))


def test_without_pyarrow_the_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "x.csv", columns())
    without_package("pyarrow", monkeypatch, tmp_path)
    assert "pip install '.[tables]'" in log_refusal(path)
    with pytest.raises(LogError, match="pyarrow is not installed"):
        write_log(Log("x", np.zeros(1), (), np.zeros((1, 0))), tmp_path / "y.parquet")


@both
@pytest.mark.parametrize("rows", [2**16, 2], ids=["whole", "in blocks"])
def test_rows_that_repeat_the_one_before_count_once(tmp_path: Path, suffix: str, rows: int) -> None:
    again = [0, 0, 1, 1, 1, 2]
    once, twice = columns(), {name: [x[k] for k in again] for name, x in columns().items()}
    path = save(tmp_path / f"x{suffix}", twice)
    if suffix == ".parquet":
        pq.write_table(pq.read_table(path), path, row_group_size=rows)
    with pytest.warns(TorchidWarning, match="3 rows equal to the previous one, including the stamp: ignored"):
        log = read_log(path)
    expected = read_log(save(tmp_path / f"once{suffix}", once)).arrays()
    for name, values in log.arrays().items():
        np.testing.assert_array_equal(values, expected[name])
    with pytest.warns(TorchidWarning, match="3 rows "):
        blocks = [block["time"] for block in table_blocks(path)]
    assert np.concatenate(blocks).tolist() == once["time"]
    save(path, twice | {"joint_torque.knee": [7.0, 7.0, 8.0, 8.5, 8.0, 9.0]})
    with pytest.warns(TorchidWarning, match="1 row "), pytest.raises(LogError, match="strictly increasing"):
        read_log(path)


@both
def test_both_quaternion_orders_are_told_apart_by_their_columns(tmp_path: Path, suffix: str) -> None:
    quat = {"w": [0.5] * 3, "x": [0.1] * 3, "y": [0.7] * 3, "z": [0.5] * 3}
    for order in ("wxyz", "xyzw"):
        table = columns(**{f"base_quat_{order}__{axis}": quat[axis] for axis in "zwxy"})
        log = read_log(save(tmp_path / f"{order}{suffix}", table))
        assert log.base_quat_xyzw is not None
        np.testing.assert_allclose(log.base_quat_xyzw[1], [0.1, 0.7, 0.5, 0.5], rtol=0.0, atol=1e-15)
