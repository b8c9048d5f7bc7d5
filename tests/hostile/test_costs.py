"""Small files that stand for much are read or refused, soon and in bounded memory."""

from __future__ import annotations

from pathlib import Path

import pytest
from hostile import examined
from hostile_costs import CASES, SLOW, costs

from torchid.guards import MAX_GROWTH, MAX_SMALL, max_unpacked_bytes
from torchid.logs import Topics, read_log
from torchid.robot import body_extents, load_robot

FINE = ("urdf", "csv of 20000", "parquet of 20000", "parquet of 50 structures")  # which are read, or only warned of


def read(path: Path) -> None:
    """Whatever it is."""
    if path.suffix == ".urdf":
        body_extents(load_robot(path))
    else:
        read_log(path, Topics(joint_states="/joint_states") if path.suffix in (".mcap", ".bag") else None)


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_small_files_that_stand_for_much_cost_little(tmp_path: Path, slow: bool) -> None:
    tally = examined("costs", costs(tmp_path, slow), read, tmp_path)
    assert tally.faults == []
    assert len(tally.verdicts) == len(CASES | SLOW if slow else CASES)
    for verdict in tally.verdicts:
        assert (verdict.outcome == "accepted") == verdict.name.startswith(FINE), verdict


def test_a_file_may_come_to_more_the_larger_it_is() -> None:
    sizes = [0, 10**3, 10**6, 5 * 10**6, 10**7, 2 * 10**7, 10**9]
    most = [max_unpacked_bytes(size) for size in sizes]
    assert most == sorted(most)
    assert most[0] == MAX_SMALL
    assert most[4] == MAX_GROWTH * 10**7
