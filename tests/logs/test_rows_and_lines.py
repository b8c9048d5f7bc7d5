"""Tables with a row for each joint and stamp, and JSON lines: what is refused, and words that are flags."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from raw_logs import log_refusal

from torchid.errors import LogError, TorchidWarning
from torchid.logs import Columns, read_log

ROWS = "t,joint,q,mode\n0,a,1,x\n0,b,2,x\n0.1,a,3,x\n0.1,b,4,x\n"
COLUMNS = Columns(rows_of="joint", time="t", joint_position="q.{joint}")


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_rows_may_be_in_any_order_and_one_that_is_missing_was_not_measured(tmp_path: Path) -> None:
    by_joint = "t,joint,tau,q\n0,a,5,1\n0.1,a,6,3\n0,b,7,2\n0.1,b,,4\n0.2,b,8,6\n0.2,a,9,5\n"
    log = read_log(
        written(tmp_path / "x.csv", by_joint),
        columns=Columns(rows_of="joint", time="t", joint_position="q.{joint}", joint_torque="tau.{joint}"),
    )
    np.testing.assert_array_equal(log.joint_position, [[1, 2], [3, 4], [5, 6]])
    np.testing.assert_array_equal(log.joint_torque, [[5, 7], [6, np.nan], [9, 8]])
    with pytest.raises(LogError, match=r"joint_position: nan at sample 1, .*b"):
        read_log(written(tmp_path / "y.csv", ROWS.replace("0.1,b,4,x\n", "")), columns=COLUMNS)


def test_a_row_that_is_there_twice_counts_once_and_two_that_differ_are_refused(tmp_path: Path) -> None:
    with pytest.warns(TorchidWarning, match="1 row with the same joint and stamp as another: ignored"):
        log = read_log(written(tmp_path / "x.csv", ROWS + "0.1,b,4,x\n"), columns=COLUMNS)
    np.testing.assert_array_equal(log.joint_position, [[1, 2], [3, 4]])
    with pytest.raises(LogError, match=r"column 'joint': two rows of 'b' at 0\.1 differ in 'q'"):
        read_log(written(tmp_path / "y.csv", ROWS + "0.1,b,5,x\n"), columns=COLUMNS)


@pytest.mark.parametrize(
    ("text", "columns", "found"),
    [
        (
            ROWS,
            Columns(rows_of="motor", time="t"),
            "logs.columns.rows_of: no column 'motor'; accepted: one of t, joint",
        ),
        (ROWS, Columns(rows_of="joint"), "logs.columns.rows_of: no column of stamps; accepted"),
        (ROWS.replace(",b,2", ",,2"), COLUMNS, "logs.columns.rows_of: an empty cell; accepted: a name in each row"),
    ],
)
def test_rows_without_names_or_stamps_are_refused(tmp_path: Path, text: str, columns: Columns, found: str) -> None:
    with pytest.raises(LogError) as refused:
        read_log(written(tmp_path / "x.csv", text), columns=columns)
    assert found in str(refused.value)


def test_stamps_that_begin_anew_are_said_to_be_those_of_another_recording(tmp_path: Path) -> None:
    episodes = written(tmp_path / "x.csv", "time,joint_position.a\n0,1\n1,2\n0,3\n")
    assert "for several recordings (episodes) add [#0] or [#0:8] to the file name" in log_refusal(episodes)
    coarse = written(tmp_path / "y.csv", "time,joint_position.a\n0,1\n0,2\n1,3\n")
    assert "for a constant step set logs.columns.time: {step: ...}" in log_refusal(coarse)


TIMES, ANGLES = [0.0, 0.1, 0.2, 0.3], [[0.1, 1.0], [0.2, 2.0], [None, None], [0.4, 4.0]]
RECORDS: list[dict[str, Any]] = [
    {"t": t, "joints": {"q": q}, "effort": None if k == 1 else [1.0, k], "mode": "run"}
    for k, (t, q) in enumerate(zip(TIMES, ANGLES, strict=True))
]
RECORDS[2]["joints"] = {}
EFFORT = [[1, 0], None, [1, 2], [1, 3]]
DOCUMENTS = {
    "records": RECORDS,
    "records within": {"meta": {"robot": "x"}, "steps": RECORDS},
    "arrays": {"t": TIMES, "joints": {"q": ANGLES}, "effort": [x or [None, None] for x in EFFORT], "note": [[1], []]},
}


@pytest.mark.parametrize("kind", DOCUMENTS)
def test_documents_of_json_are_read_as_arrays(tmp_path: Path, kind: str) -> None:
    of = "steps/" if kind == "records within" else ""
    text = json.dumps(DOCUMENTS[kind], indent=1)
    columns = Columns(
        time=f"{of}t",  # type: ignore[arg-type]
        joint_order=["a", "b"],
        joint_position=f"{of}joints/q",  # type: ignore[arg-type]
        joint_torque=f"{of}effort",  # type: ignore[arg-type]
        ignore=["*mode", "note", "meta/*"],
    )
    log = read_log(written(tmp_path / "x.json", f"\ufeff{text}"), columns=columns, allow_gaps=True)
    np.testing.assert_array_equal(log.time, TIMES)
    np.testing.assert_array_equal(log.joint_position, np.array(ANGLES, dtype=float))
    np.testing.assert_array_equal(log.joint_torque, [[1, 0], [np.nan] * 2, [1, 2], [1, 3]])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('{"time": [0, 1', "cannot be read (JSONDecodeError"),
        ("[1, 2]", "found a list, not an object of arrays or a list of records"),
        (
            '{"time": [0, 1], "joint_position": [[1], [1, 2]], "joint_names": ["a"]}',
            "Python objects (pickled), references",
        ),
        ("[" * 100_000, "cannot be read (RecursionError"),
        (json.dumps([{str(k): 0} for k in range(1000)]), "1000 arrays; a log may have 200"),
    ],
    ids=["ends too soon", "numbers", "ragged", "nested", "keys"],
)
def test_documents_of_json_that_are_no_log_are_refused_in_one_line(tmp_path: Path, text: str, found: str) -> None:
    assert found in log_refusal(written(tmp_path / "x.json", text))
