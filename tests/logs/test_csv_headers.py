"""What stands above the rows of a CSV file: remarks, names and units, as programs of laboratories write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from raw_logs import log_refusal

from torchid.logs import Columns, read_log
from torchid.logs.column_map import check_columns
from torchid.logs.table_headers import read_header
from torchid.logs.tables import sample_table, table_blocks

ROWS = [(0.0, 1.5, 7.0), (0.1, 2.5, 8.0), (0.2, 3.5, -9.25)]
PLAIN = "\n".join(",".join(map(str, row)) for row in ROWS) + "\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def numbers(path: Path) -> np.ndarray:
    return np.array([np.asarray(x, dtype=float) for x in sample_table(path).values()]).T


@pytest.mark.parametrize(
    "head",
    [
        "time,q,tau\n",
        "# robot: go1\n# recorded 2024-03-03\ntime,q,tau\n",
        "# time,q,tau\n",
        "% made by a controller\n\n% time,q,tau\n",
        "Coordinates\nversion=1\nnRows=3\nendheader\ntime,q,tau\n",
        "Trial: 12, of 40\n\ntime,q,tau\n",
        "\ntime,q,tau\n",
    ],
)
def test_remarks_above_the_names_change_nothing(tmp_path: Path, head: str) -> None:
    path = written(tmp_path / "x.csv", head + PLAIN)
    assert read_header(path).texts == ["time", "q", "tau"]
    np.testing.assert_array_equal(numbers(path), ROWS)


@pytest.mark.parametrize("units", ["s,deg,N mm", "[s],[deg],[N mm]", "(s),(deg),(N mm)", "# s,deg,N mm"])
def test_a_line_of_units_belongs_to_the_names_above_it(tmp_path: Path, units: str) -> None:
    path = written(tmp_path / "x.csv", f"time,q,tau\n{units}\n{PLAIN}")
    assert read_header(path).texts == ["time [s]", "q [deg]", "tau [N mm]"]
    np.testing.assert_array_equal(numbers(path), ROWS)


def test_spaces_separate_cells_where_nothing_else_does(tmp_path: Path) -> None:
    path = written(tmp_path / "x.csv", "timestamp actual_q_0 actual_qd_0\n" + PLAIN.replace(",", " "))
    assert read_header(path).texts == ["timestamp", "actual_q_0", "actual_qd_0"]
    np.testing.assert_array_equal(numbers(path), ROWS)
    assert read_header(written(tmp_path / "y.csv", "t [s];q of hip\n0,5;1,5\n")).texts == ["t [s]", "q of hip"]


def test_an_index_without_a_name_and_a_separator_at_the_end_of_rows_are_columns(tmp_path: Path) -> None:
    path = written(tmp_path / "x.csv", ",time,q\n0,0.0,1.5\n1,0.1,2.5\n")
    assert read_header(path).texts == ["unnamed_0", "time", "q"]
    path = written(tmp_path / "y.csv", "time,q\n0.0,1.5,\n0.1,2.5,\n")
    assert read_header(path).texts == ["time", "q", "unnamed_2"]
    assert list(sample_table(path)) == ["time", "q", "unnamed_2"]


@pytest.mark.parametrize(("of_names", "of_rows"), [("", ","), (",", ","), (",", "")])
def test_a_separator_at_the_end_of_rows_needs_no_entry_of_a_map(tmp_path: Path, of_names: str, of_rows: str) -> None:
    path = written(tmp_path / "x.csv", f"time,joint_position.a{of_names}\n0.0,1.5{of_rows}\n0.1,2.5{of_rows}\n")
    np.testing.assert_array_equal(read_log(path).joint_position, [[1.5], [2.5]])
    path = written(tmp_path / "y.csv", f"stamp,q_a{of_names}\n0.0,1.5{of_rows}\n0.1,2.5{of_rows}\n")
    np.testing.assert_array_equal(read_log(path, columns=COLUMNS).joint_position, [[1.5], [2.5]])


def test_rows_without_names_need_a_map_and_a_bad_first_row_stays_a_row(tmp_path: Path) -> None:
    found = log_refusal(written(tmp_path / "x.csv", PLAIN))
    assert "columns: 3 of numbers without a line of names; accepted: names of the log format, or logs.columns" in found
    given = Columns(time="column_0", joint_position={"columns": {"a": "column_1"}}, ignore=["*"])  # type: ignore[arg-type]
    np.testing.assert_array_equal(read_log(tmp_path / "x.csv", columns=given).joint_position[:1], [[1.5]])
    found = log_refusal(written(tmp_path / "y.csv", "time,joint_position.a\nx,y\n0.0,1.5\n"))
    assert "column 'time': 'x' in row 2" in found


COLUMNS = Columns(time={"column": "stamp"}, joint_position={"column": "q_{joint}"})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("stamps", "first"),
    [
        (["2024-03-01 09:30:00.000000", "2024-03-01 09:30:00.002", "2024-03-01 09:30:00.004"], 1709285400.0),
        (["2024-03-01T09:30:00Z", "2024-03-01T09:30:00.002Z", "2024-03-01T09:30:00.004000Z"], 1709285400.0),
        (["09:30:00.000", "09:30:00.002", "09:30:00.004"], 34200.0),
    ],
)
def test_dates_and_times_of_day_are_stamps_in_seconds(tmp_path: Path, stamps: list[str], first: float) -> None:
    check_columns(COLUMNS)
    rows = "".join(f"{stamp},{number}.5\n" for number, stamp in enumerate(stamps))
    path = written(tmp_path / "x.csv", "stamp,q_a\n" + rows)
    log = read_log(path, columns=COLUMNS)
    np.testing.assert_allclose(log.time - first, [0.0, 0.002, 0.004], atol=5e-7)
    blocks = [block["time"] for block in table_blocks(path, COLUMNS)]
    np.testing.assert_array_equal(np.concatenate(blocks), log.time)
    sampled = sample_table(path)["stamp"]
    assert sampled is not None
    np.testing.assert_array_equal(sampled, log.time)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_dates_of_a_parquet_file_are_stamps_in_seconds(tmp_path: Path, unit: str) -> None:
    stamp = np.datetime64("2024-03-01T09:30:00", unit) + np.arange(3)
    pq.write_table(pa.table({"stamp": stamp, "q_a": [0.5, 1.5, 2.5]}), tmp_path / "x.parquet")
    step = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    sampled = sample_table(tmp_path / "x.parquet")["stamp"]
    assert sampled is not None
    np.testing.assert_allclose(sampled - 1709285400.0, step * np.arange(3), atol=5e-7)
    if unit != "ns":  # whose steps no float64 of seconds since 1970 resolves
        assert len(read_log(tmp_path / "x.parquet", columns=COLUMNS)) == 3
