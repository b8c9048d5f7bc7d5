"""What stands above the rows of text tables, OpenSim's header, lists in Parquet files, and lines of JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from raw_logs import log_refusal

from torchid.errors import LogError
from torchid.guards import MAX_LIST
from torchid.logs import Columns, read_log
from torchid.logs.table_files import read_header
from torchid.logs.tables import sample_table, table_blocks
from torchid.reader import LIMITS

ROWS = [(0.0, 1.5, 7.0), (0.1, 2.5, 8.0), (0.2, 3.5, -9.25)]
PLAIN = "\n".join(",".join(map(str, row)) for row in ROWS) + "\n"
COLUMNS = Columns(time={"column": "stamp"}, joint_position={"column": "q_{joint}"})  # type: ignore[arg-type]


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    "head",
    [
        "time,q,tau\n",
        "# robot: go1\n# recorded 2024-03-03\ntime,q,tau\n",
        "# time,q,tau\n",
        "Trial: 12, of 40\n\ntime,q,tau\n",
        "\ntime,q,tau\n# s, deg, N m\n",
    ],
)
def test_remarks_around_the_names_change_nothing(tmp_path: Path, head: str) -> None:
    path = written(tmp_path / "x.csv", head + PLAIN)
    assert read_header(path).names == ["time", "q", "tau"]
    np.testing.assert_array_equal(np.array(list(sample_table(path).values())).T, ROWS)


def test_lines_between_the_names_and_the_rows_are_refused(tmp_path: Path) -> None:
    for line in ("s,deg,N mm", "a,b,c", "x,y,z"):
        found = log_refusal(written(tmp_path / "x.csv", f"time,q,tau\n{line}\n{PLAIN}"))
        assert f"line 2: '{line}' between the names and the first row; accepted: rows of numbers directly" in found


def test_spaces_separate_cells_where_nothing_else_does(tmp_path: Path) -> None:
    path = written(tmp_path / "x.csv", "timestamp actual_q_0 actual_qd_0\n" + PLAIN.replace(",", " "))
    assert list(sample_table(path)) == ["timestamp", "actual_q_0", "actual_qd_0"]
    assert read_header(written(tmp_path / "y.csv", "t [s];q of hip\n0,5;1,5\n")).names == ["t [s]", "q of hip"]


@pytest.mark.parametrize(("of_names", "of_rows"), [("", ","), (",", ","), (",", "")])
def test_a_separator_at_the_end_of_rows_is_no_column(tmp_path: Path, of_names: str, of_rows: str) -> None:
    path = written(tmp_path / "x.csv", f"time,joint_position.a{of_names}\n0.0,1.5{of_rows}\n0.1,2.5{of_rows}\n")
    np.testing.assert_array_equal(read_log(path).joint_position, [[1.5], [2.5]])
    assert read_header(written(tmp_path / "y.csv", ",time\n0,0.5\n")).names == ["unnamed_0", "time"]


def test_rows_without_names_need_a_map(tmp_path: Path) -> None:
    found = log_refusal(written(tmp_path / "x.csv", PLAIN))
    assert (
        "columns: 3 columns of numbers without a line of names; accepted: names of the log format, or a map of the"
        in found
    )
    given = Columns(time="column_0", joint_position={"columns": {"a": "column_1"}}, ignore=["*"])  # type: ignore[arg-type]
    np.testing.assert_array_equal(read_log(tmp_path / "x.csv", columns=given).joint_position[:1], [[1.5]])


@pytest.mark.parametrize("end", ["", "Z"])
def test_dates_are_stamps_in_seconds(tmp_path: Path, end: str) -> None:
    stamps = [f"2024-03-01 09:30:00.{k:03}{end}" for k in (0, 2, 4)]
    rows = "".join(f"{stamp},{number}.5\n" for number, stamp in enumerate(stamps))
    path = written(tmp_path / "x.csv", "stamp,q_a\n" + rows)
    log = read_log(path, columns=COLUMNS)
    np.testing.assert_allclose(log.time - 1709285400.0, [0.0, 0.002, 0.004], atol=5e-7)
    blocks = [block["time"] for block in table_blocks(path, COLUMNS)]
    np.testing.assert_array_equal(np.concatenate(blocks), log.time)


@pytest.mark.parametrize("unit", ["s", "ms", "us"])
def test_dates_of_a_parquet_file_are_stamps_in_seconds(tmp_path: Path, unit: str) -> None:
    stamp = np.datetime64("2024-03-01T09:30:00", unit) + np.arange(3)
    pq.write_table(pa.table({"stamp": stamp, "q_a": [0.5, 1.5, 2.5]}), tmp_path / "x.parquet")
    time = read_log(tmp_path / "x.parquet", columns=COLUMNS).time
    np.testing.assert_allclose(time - 1709285400.0, {"s": 1.0, "ms": 1e-3, "us": 1e-6}[unit] * np.arange(3), atol=5e-7)


@pytest.mark.parametrize(("touches", "not_"), [("Stance", "swing"), ("yes", "no"), ("ON", "OFF"), ("true", "False")])
def test_words_for_contact_are_flags(tmp_path: Path, touches: str, not_: str) -> None:
    text = f"time;joint_position.a;contact_active.foot\n0;1;{touches}\n1;2;{not_}\n2;3;{touches}\n"
    log = read_log(written(tmp_path / "x.csv", text))
    np.testing.assert_array_equal(log.contact_active[:, 0], [True, False, True])
    other = written(tmp_path / "y.csv", text.replace(not_, "perhaps"))
    assert "column 'contact_active.foot': 'perhaps'; accepted: true and false, 1 and 0, yes" in log_refusal(other)


def test_names_of_old_spreadsheets_are_read(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_bytes("Zeit;Hüfte [°]\n0;1,5\n1;2,5\n".encode("latin-1"))
    columns = Columns(time="Zeit", joint_position={"columns": {"hip": "Hüfte [°]"}, "unit": "deg"})  # type: ignore[arg-type]
    np.testing.assert_allclose(read_log(tmp_path / "x.csv", columns=columns).joint_position, np.radians([[1.5], [2.5]]))


# ----------------------------------------------------------------------------------------------------- OpenSim's tables

ANGLES, SLIDE = [[30.0, -10.0], [20.0, 5.0]], [0.1, 0.2]
OPENSIM = "Coordinates\nnRows=2\ninDegrees={degrees}\n\nendheader\ntime\thip_r\tknee_r\tpelvis_tx\n"
JOINTS: dict[str, Any] = {"columns": {"hip": "hip_r", "knee": "knee_r", "rail": "pelvis_tx"}}


def opensim(path: Path, degrees: str = "yes") -> Path:
    rows = [[0.01 * k, *angles, slide] for k, (angles, slide) in enumerate(zip(ANGLES, SLIDE, strict=True))]
    return written(path, OPENSIM.format(degrees=degrees) + "".join("\t".join(map(str, row)) + "\n" for row in rows))


@pytest.mark.parametrize("suffix", [".mot", ".sto", ".MOT"])
def test_angles_of_opensim_have_the_unit_that_the_map_states(tmp_path: Path, suffix: str) -> None:
    path = opensim(tmp_path / f"x{suffix}")
    columns = Columns(joint_position=JOINTS | {"unit": {"*": "deg", "rail": "m"}})  # type: ignore[arg-type]
    log = read_log(path, columns=columns)
    np.testing.assert_allclose(log.joint_position, np.column_stack([np.radians(ANGLES), SLIDE]), rtol=1e-15)
    with pytest.raises(
        LogError, match="joint_position.unit: missing for hip, in a file with inDegrees=yes; accepted: d"
    ):
        read_log(path, columns=Columns(joint_position=JOINTS))  # type: ignore[arg-type]
    plain = read_log(opensim(path, "no"), columns=Columns(joint_position=JOINTS))  # type: ignore[arg-type]
    np.testing.assert_array_equal(plain.joint_position[:, :2], ANGLES)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a\nb\nc\n", "header: no line endheader"),
        ("version=1\nendheader\n", "header: an empty line"),
        ("endheader\ntime\thip_r\tknee_r\tpelvis_tx\n", "time"),
        ("endheader\ntime\thip_r\tknee_r\tpelvis_tx\n0\t1\tx\t3\n1\t1\t1\t1\n", "column 'knee_r': 'x' in row 3"),
        ("endheader\ntime\thip_r\tknee_r\tpelvis_tx\n0\t1\t2\n", "row 3: 3 cells; accepted: 4 cells"),
        ("endheader\n\x00\x01\t\x02\n0\t1\n", "header: "),
    ],
)
def test_damaged_tables_of_opensim_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(LogError) as refused:
        read_log(written(tmp_path / "x.mot", text), columns=Columns(joint_position=JOINTS))  # type: ignore[arg-type]
    assert message in str(refused.value)


# ---------------------------------------------------------------------------------------------------- lists of Parquet

POSITION = np.arange(12.0).reshape(4, 3) / 10.0
LISTS = Columns(
    time="t",
    joint_order=["hip", "knee", "ankle"],
    joint_position="state.q[{index}]",
    joint_torque="tau[{index}]",
    ignore=["*"],
)  # type: ignore[arg-type]


def fixed(values: np.ndarray) -> Any:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def lists(path: Path, q: Any, **more: Any) -> Path:
    state = pa.StructArray.from_arrays([q], names=["q"])
    columns = {"t": pa.array([0.0, 0.1, 0.2, 0.3]), "state": state, "tau": fixed(POSITION.astype(np.float32)), **more}
    pq.write_table(pa.table(columns), path, row_group_size=3)
    return path


@pytest.mark.parametrize("kind", ["fixed size", "lists", "large lists"])
def test_lists_of_one_length_are_as_many_columns(tmp_path: Path, kind: str) -> None:
    of_lists = {"lists": pa.list_(pa.float64()), "large lists": pa.large_list(pa.float64())}
    q = fixed(POSITION) if kind == "fixed size" else pa.array(list(POSITION), of_lists[kind])
    tau = pa.array([[1.0, 2.0, 3.0], None, [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]], pa.list_(pa.float64(), 3))
    long = fixed(np.zeros((4, MAX_LIST + 1)))
    log = read_log(lists(tmp_path / "log.parquet", q, tau=tau, trace=long), columns=LISTS)
    np.testing.assert_array_equal(log.joint_position, POSITION)
    np.testing.assert_array_equal(log.joint_torque, [[1, 2, 3], [np.nan] * 3, [4, 5, 6], [7, 8, 9]])


def test_lists_of_several_lengths_are_no_columns(tmp_path: Path) -> None:
    uneven = pa.array([[1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]], pa.list_(pa.float64()))
    with pytest.raises(LogError, match=r"'state.q\[0\]', no such column"):
        read_log(lists(tmp_path / "log.parquet", uneven), columns=LISTS)


# ------------------------------------------------------------------------------------------------------- lines of JSON

LINE = '{"time": 0, "joint_position": {"a": 1}}\n'


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (LINE + '{"time": 0.1, "joint_', "cannot be read"),
        (LINE + "[1, 2]\n", "Column() changed from object to array in row 1"),
        (LINE + LINE.replace("1", '"x"'), "changed from number to string in row 1"),
        (LINE.replace("1", "[" * 10_000 + "]" * 10_000), "file: "),
        ("", "cannot be read"),
    ],
)
def test_lines_that_are_no_objects_of_numbers_are_refused(
    tmp_path: Path, text: str, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(LIMITS, "0.2")  # of processor time, which the nested lists use up
    assert found in log_refusal(written(tmp_path / "x.jsonl", text))


def test_what_a_line_of_json_lacks_was_not_measured(tmp_path: Path) -> None:
    lines = [
        '{"time": 0, "joint_position": {"a": 1}, "joint_torque": {"a": NaN}, "contact_active": {"foot": "air"}}',
        '{"time": 1, "joint_position": {"a": 2}, "contact_active": {"foot": "contact"}}',
        '{"time": 2, "joint_position": {"a": 3}, "joint_torque": {"a": 5.5}, "contact_active": {"foot": "contact"}}',
    ]
    log = read_log(written(tmp_path / "x.jsonl", "\n\n".join(lines)))
    np.testing.assert_array_equal(log.joint_torque, [[np.nan], [np.nan], [5.5]])
    np.testing.assert_array_equal(log.contact_active, [[False], [True], [True]])
