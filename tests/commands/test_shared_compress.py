"""`torchid compress` in processes that torchrun has started: the files and words of one process."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from fleets import walks
from shared_work import TORCHRUN, finish, finish_forked, lines_of_torchid

from torchid.cli import main


@pytest.mark.study
@pytest.mark.parametrize("processes", [2, 4])
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_processes_compress_a_log_each_to_the_files_of_one(tmp_path: Path, processes: int) -> None:
    """With noise that is estimated from all logs, offsets, readings in the air, and a process without a log."""
    offsets = {"set": "full", "offsets": "log"}
    file = walks(tmp_path / "walks", "biped", (2.0, 1.5, 3.0), sensors=offsets)
    printed_by_one: list[str] = []
    for name, before in (("one", (sys.executable, "-m")), ("shared", (*TORCHRUN, str(processes), "-m", "--"))):
        folder = tmp_path / name
        status, printed, complained = finish((*before, "torchid", "compress", str(file), "--output", str(folder)))
        assert status == 0, complained
        assert printed.count("written to") == 1
        assert {path.name: path.read_bytes() for path in folder.glob("*.factor")} == {
            path.name: path.read_bytes() for path in (tmp_path / "one").glob("*.factor")
        }
        assert len([*folder.glob("*.factor")]) == 3
        printed_by_one = printed_by_one or told(printed)
        assert told(printed) == printed_by_one


def told(printed: str) -> list[str]:
    """What a command prints, but for the folder."""
    return [line for line in printed.splitlines() if "written to" not in line]


def compressed_by(processes: int, file: Path, output: Path) -> tuple[int, str, str]:
    return finish_forked(processes, lambda: main(["compress", str(file), "--output", str(output)]))


def test_a_log_that_one_process_cannot_compress_ends_all_in_one_line(tmp_path: Path) -> None:
    file = walks(tmp_path / "walks", "biped", (1.0, 0.8), sensors={"set": "full"})
    (tmp_path / "walks" / "right.npz").write_bytes(b"no log")
    status, printed, complained = compressed_by(2, file, tmp_path / "factors")
    assert status != 0
    assert not printed
    (line,) = lines_of_torchid(complained)
    assert "right.npz" in line
    assert not (tmp_path / "factors").exists()


def test_warnings_of_other_processes_are_told_by_the_first(tmp_path: Path) -> None:
    file = walks(tmp_path / "walks", "biped", (1.0, 0.8), sensors={"set": "joints", "on_base_lost": "warn"})
    with np.load(tmp_path / "walks" / "right.npz") as log:
        fields = {key: log[key] for key in log}
    fields["contact_wrench_local"] = fields["contact_wrench_local"].copy()
    fields["contact_wrench_local"][40:44] = np.nan  # a gap
    np.savez(tmp_path / "walks" / "right.npz", **fields)
    warned = []
    for processes in (1, 2):
        status, _, complained = compressed_by(processes, file, tmp_path / str(processes))
        assert status == 0, complained
        warned.append([line for line in complained.splitlines() if "right.npz" in line and "torchid: " in line])
    assert warned[0]
    assert warned[1] == warned[0]
