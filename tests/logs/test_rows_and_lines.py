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
from torchid.logs.tables import sample_row_names

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
    with pytest.warns(TorchidWarning, match="1 row of a joint and stamp that have one already"):
        log = read_log(written(tmp_path / "x.csv", ROWS + "0.1,b,4,x\n"), columns=COLUMNS)
    np.testing.assert_array_equal(log.joint_position, [[1, 2], [3, 4]])
    with pytest.raises(LogError, match=r"column 'joint': two rows of 'b' at 0\.1, with two of 'q'"):
        read_log(written(tmp_path / "y.csv", ROWS + "0.1,b,5,x\n"), columns=COLUMNS)


@pytest.mark.parametrize(
    ("text", "columns", "found"),
    [
        (
            ROWS,
            Columns(rows_of="motor", time="t"),
            "logs.columns.rows_of: no column 'motor'; accepted: one of t, joint",
        ),
        (ROWS, Columns(rows_of="joint"), "logs.columns.rows_of: no column of stamps beside 'joint'"),
        (ROWS.replace(",b,2", ",,2"), COLUMNS, "logs.columns.rows_of: an empty cell; accepted: a name in each row"),
    ],
)
def test_rows_without_names_or_stamps_are_refused(tmp_path: Path, text: str, columns: Columns, found: str) -> None:
    with pytest.raises(LogError) as refused:
        read_log(written(tmp_path / "x.csv", text), columns=columns)
    assert found in str(refused.value)


LINE = '{"time": 0, "joint_position": {"a": 1}}\n'


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (LINE + '{"time": 0.1, "joint_', 'line 2: \'{"time": 0.1, "joint_\' (Unterminated string'),
        (LINE + "[1, 2]\n", "line 2: a list; accepted: a JSON object in each line"),
        (LINE + LINE.replace("1", '"x"'), "line 2: 'joint_position.a' is text, and a number before"),
        (LINE.replace('{"a": 1}', '{"a": 1}, "joint_position.a": 2'), "line 1: 'joint_position.a' twice"),
        (LINE.replace("1", "[" * 10_000 + "]" * 10_000), "line 1: "),
        (LINE.replace("1", "1" + "0" * 400), "line 1: int too large"),
        (LINE * 4096 + LINE.replace("}}", ', "b": 1}}'), "column 'joint_position.b': in none of the first lines"),
        ("", "time: missing"),
    ],
)
def test_lines_that_are_no_objects_of_numbers_are_refused_by_their_number(
    tmp_path: Path, text: str, found: str
) -> None:
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


def test_stamps_that_begin_anew_are_said_to_be_those_of_another_recording(tmp_path: Path) -> None:
    episodes = written(tmp_path / "x.csv", "time,joint_position.a\n0,1\n1,2\n0,3\n")
    assert "of recordings one after the other (episodes) the name with [#0] for the first" in log_refusal(episodes)
    coarse = written(tmp_path / "y.csv", "time,joint_position.a\n0,1\n0,2\n1,3\n")
    assert "where rows are steps of a clock that stamps round, logs.columns.time: {step: ...}" in log_refusal(coarse)


EACH = "".join(f"{0.1 * k:.1f},{joint},{k}\n" for k in range(20) for joint in "ab")
EPISODES = "".join(f"{0.1 * k:.1f},{number},{k}\n" for number in range(2) for k in range(20))
FRACTIONS = "".join(f"{second},{nano},{nano}\n" for second in range(3) for nano in range(0, 10**9, 10**8))


@pytest.mark.parametrize(("rows", "expected"), [(EACH, "name"), (EPISODES, None), (FRACTIONS, None)])
def test_rows_are_those_of_joints_where_successive_ones_share_a_stamp(
    tmp_path: Path, rows: str, expected: str | None
) -> None:
    found = sample_row_names(written(tmp_path / "x.csv", f"time,name,q\n{rows}"))
    assert (None if found is None else found.column) == expected


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
    "numbered rows": {  # as pandas writes them
        "t": {str(k): t for k, t in enumerate(TIMES)},
        "joints": {"q": ANGLES},
        "effort": [x or [None, None] for x in EFFORT],
    },
}


@pytest.mark.parametrize("kind", [*DOCUMENTS, "lines"])
def test_documents_of_json_are_read_as_arrays(tmp_path: Path, kind: str) -> None:
    of = "steps/" if kind == "records within" else ""
    text = "\n".join(map(json.dumps, RECORDS)) if kind == "lines" else json.dumps(DOCUMENTS[kind], indent=1)
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
        ("[1, 2]", "a list, no object of arrays and no list of records"),
        (
            '{"time": [0, 1], "joint_position": [[1], [1, 2]], "joint_names": ["a"]}',
            "Python objects (pickled), references",
        ),
        ("[" * 100_000, "cannot be read (RecursionError"),
        (json.dumps([{str(k): 0} for k in range(1000)]), "1000 arrays, more than the 200 that a log may have"),
    ],
    ids=["ends too soon", "numbers", "ragged", "nested", "keys"],
)
def test_documents_of_json_that_are_no_log_are_refused_in_one_line(tmp_path: Path, text: str, found: str) -> None:
    assert found in log_refusal(written(tmp_path / "x.json", text))
