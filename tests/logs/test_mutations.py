"""Hostile tables and bags: a log or one line, soon and in bounded memory, whatever the bytes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from bags import parsed, recorded
from hostile import examined
from hostile_bags import SUFFIXES, TOPICS, bag_cases, damaged, table_cases
from hostile_logs import mutations

from torchid.logs import Columns, Log, read_log

#: Bytes that reading a small file may take: its parser's blocks, and no bomb that went off.
MEMORY = 150 * 2**20


def read(path: Path) -> Log:
    return read_log(path, parsed(TOPICS))


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(("count", "seed"), [(200, 1), pytest.param(3000, 2, marks=pytest.mark.study)])
def test_damaged_files_give_a_log_or_one_line(tmp_path: Path, suffix: str, count: int, seed: int) -> None:
    tally = examined(f"damaged {suffix}", damaged(tmp_path, suffix, count, seed), read, tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.3, "or the files were hardly damaged"


@pytest.mark.parametrize(("count", "seed"), [(200, 1), pytest.param(3000, 2, marks=pytest.mark.study)])
@pytest.mark.parametrize("do_compression", [False, True])
def test_damaged_files_of_matlab_give_a_log_or_one_line(
    tmp_path: Path, do_compression: bool, count: int, seed: int
) -> None:
    path, arrays = tmp_path / "damaged.mat", recorded(12).arrays()
    names = {"joint_names": np.array(recorded(12).joint_names, dtype=object), "notes": {"text": "x", "k": np.eye(2)}}
    scipy.io.savemat(path, {name: x for name, x in arrays.items() if x.size} | names, do_compression=do_compression)
    cases = mutations(path, [path.read_bytes()], count, np.random.default_rng(seed))
    tally = examined("damaged .mat", cases, lambda path: read_log(path, columns=Columns(ignore=["notes/*"])), tmp_path)
    assert tally.faults == []
    assert tally.share("refused") > 0.3, "or the files were hardly damaged"


def test_hand_made_bags_are_refused_or_harmless(tmp_path: Path) -> None:
    topics = parsed({"joint_states": "/joint_states"})
    tally = examined("bags", bag_cases(tmp_path), lambda path: read_log(path, topics), tmp_path)
    assert tally.faults == []
    harmless = {
        "a name with separators",
        "a frame of 10 MB",
        "bag a definition that is a programme",
        "db3 time beyond time",
    }
    accepted = {x.name for x in tally.verdicts if x.outcome == "accepted"}
    assert accepted <= harmless
    assert max(x.growth for x in tally.verdicts) < MEMORY


def test_hand_made_tables_are_refused_or_harmless(tmp_path: Path) -> None:
    tally = examined("tables", table_cases(tmp_path), read, tmp_path)
    assert tally.faults == []
    accepted = {x.name for x in tally.verdicts if x.outcome == "accepted"}
    assert accepted == {"csv a name with separators", "parquet times"}
    assert max(x.growth for x in tally.verdicts) < MEMORY
