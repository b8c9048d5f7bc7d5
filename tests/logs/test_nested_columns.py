"""Columns of lists in Parquet files: each number of the lists is a column of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from torchid.errors import LogError
from torchid.guards import MAX_LIST
from torchid.logs import Columns, Log, read_log

NAMES = ("hip", "knee", "ankle")
POSITION = np.arange(12.0).reshape(4, 3) / 10.0
COLUMNS = Columns(
    time="t", joint_order=list(NAMES), joint_position="state.q[{index}]", joint_torque="tau[{index}]", ignore=["*"]
)


def fixed(values: np.ndarray) -> Any:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def saved(path: Path, q: Any, **more: Any) -> Path:
    state = pa.StructArray.from_arrays([q], names=["q"])
    columns = {"t": pa.array([0.0, 0.1, 0.2, 0.3]), "state": state, "tau": fixed(POSITION.astype(np.float32)), **more}
    pq.write_table(pa.table(columns), path, row_group_size=3)
    return path


def read(path: Path) -> Log:
    return read_log(path, columns=COLUMNS)


@pytest.mark.parametrize("kind", ["fixed size", "lists", "large lists"])
def test_lists_of_one_length_are_as_many_columns(tmp_path: Path, kind: str) -> None:
    of_lists = {"lists": pa.list_(pa.float64()), "large lists": pa.large_list(pa.float64())}
    q = fixed(POSITION) if kind == "fixed size" else pa.array(list(POSITION), of_lists[kind])
    log = read(saved(tmp_path / "log.parquet", q))
    np.testing.assert_array_equal(log.joint_position, POSITION)
    np.testing.assert_array_equal(log.joint_torque, POSITION.astype(np.float32))


def test_a_row_without_a_list_was_not_measured(tmp_path: Path) -> None:
    tau = pa.array([[1.0, 2.0, 3.0], None, [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]], pa.list_(pa.float64(), 3))
    log = read(saved(tmp_path / "log.parquet", fixed(POSITION), tau=tau))
    assert log.joint_torque is not None
    np.testing.assert_array_equal(log.joint_torque[[0, 2, 3]], [[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    assert np.isnan(log.joint_torque[1]).all()


def test_lists_of_several_lengths_are_refused_by_their_name(tmp_path: Path) -> None:
    uneven = pa.array([[1.0, 2.0], [1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]], pa.list_(pa.float64()))
    path = saved(tmp_path / "log.parquet", uneven)
    with pytest.raises(LogError, match="column 'state.q': lists of 3 and of 2 numbers; accepted: lists of one length"):
        read(path)


def test_lists_that_are_as_long_as_a_signal_are_not_columns(tmp_path: Path) -> None:
    path = saved(tmp_path / "log.parquet", fixed(POSITION), trace=fixed(np.zeros((4, MAX_LIST + 1))))
    assert read(path).joint_names == NAMES
