"""Hostile tables and bags: a log or one line, soon and in bounded memory, whatever the bytes."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import hostile
import pytest
from bags import parsed
from hostile_bags import SUFFIXES, TOPICS, bag_cases, damaged, table_cases

from torchid.logs import Topics, read_log

#: Bytes that reading a small file may take: its parser's blocks, and no bomb that went off.
MEMORY = 150 * 2**20


def judged(
    kind: str,
    cases: Iterable[tuple[str, Path]],
    folder: Path,
    topics: Topics = parsed(TOPICS),  # noqa: B008
) -> hostile.Tally:
    """What became of every case, none of them wrong."""
    tally = hostile.Tally(kind)
    for name, path in cases:
        tally.verdicts.append(hostile.judged(name, lambda path=path: read_log(path, topics), folder))
    assert not tally.faults, "\n".join(tally.faults)
    return tally


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_files_give_a_log_or_one_line(tmp_path: Path, suffix: str) -> None:
    tally = judged(suffix, damaged(tmp_path, suffix, 200, 1), tmp_path)
    refused = sum(x.outcome == "refused" for x in tally.verdicts)
    assert refused > 60, "or the files were hardly damaged"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_damaged_in_thousands_of_ways_give_a_log_or_one_line(tmp_path: Path, suffix: str) -> None:
    judged(suffix, damaged(tmp_path, suffix, 3000, 2), tmp_path)


def test_hand_made_bags_are_refused_or_harmless(tmp_path: Path) -> None:
    tally = judged("bags", bag_cases(tmp_path), tmp_path, parsed({"joint_states": "/joint_states"}))
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
    tally = judged("tables", table_cases(tmp_path), tmp_path)
    accepted = {x.name for x in tally.verdicts if x.outcome == "accepted"}
    assert accepted == {"csv a name with separators"}
    assert max(x.growth for x in tally.verdicts) < MEMORY
