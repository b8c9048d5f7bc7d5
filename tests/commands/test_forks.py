"""Copies of the process that draw and fit on its other cores: same results, same errors, none left behind."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
from demo import shortened_demo

from torchid import parallel
from torchid.cli import main
from torchid.parallel import Fork, forks_allowed, share_between_forks

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks are made on Linux alone")


def test_shares_are_in_order_and_worked_on_by_as_many_processes_as_asked_for() -> None:
    with forks_allowed():
        shared = share_between_forks(range(7), lambda item: (item**2, os.getpid()), 3)
    assert [value for value, _ in shared] == [0, 1, 4, 9, 16, 25, 36]
    assert len({process for _, process in shared}) == 3
    assert not multiprocessing.active_children()


def test_a_library_makes_no_forks_of_the_process_that_uses_it() -> None:
    assert {process for process in share_between_forks(range(4), lambda _: os.getpid(), 2)} == {os.getpid()}
    with Fork(os.getpid) as fork:
        assert fork.result() == os.getpid()


def test_an_error_is_that_of_this_process() -> None:
    def fails() -> None:
        raise FileNotFoundError(2, "no such thing", f"seen by {os.getpid()}")

    with forks_allowed(), Fork(fails) as fork, pytest.raises(FileNotFoundError) as caught:
        fork.result()
    assert caught.value.filename == f"seen by {os.getpid()}"


def test_a_warning_is_given_by_this_process() -> None:
    def warns() -> int:
        warnings.warn("mind the gap", UserWarning, stacklevel=1)
        return os.getpid()

    with forks_allowed(), Fork(warns) as fork, pytest.warns(UserWarning, match="mind the gap"):
        assert fork.result() == os.getpid()


def test_a_copy_that_is_killed_or_cannot_answer_is_replaced_by_this_process() -> None:
    original = os.getpid()
    with forks_allowed(), Fork(lambda: os.getpid() if os.getpid() == original else os._exit(9)) as killed:
        assert killed.result() == original
    with forks_allowed(), Fork(lambda: lambda: 7) as fork:  # what does not pickle
        assert fork.result()() == 7


def test_none_is_left_when_the_block_ends_before_its_copy() -> None:
    with forks_allowed(), Fork(lambda: time.sleep(60.0)):
        (process,) = multiprocessing.active_children()
    assert not process.is_alive()


def test_none_is_left_when_ctrl_c_comes_while_it_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would fill a folder that is being removed, of which something is then left."""

    def fork() -> int:
        child = forked()
        if child:
            signal.raise_signal(signal.SIGINT)
        return child

    forked = os.fork
    monkeypatch.setattr(os, "fork", fork)
    with forks_allowed(), pytest.raises(KeyboardInterrupt), Fork(lambda: time.sleep(600.0)):
        pass
    assert not multiprocessing.active_children()


def test_forks_make_no_forks() -> None:
    def inner() -> bool:
        return len(set(share_between_forks(range(2), lambda _: os.getpid(), 2))) == 1

    with forks_allowed(), Fork(inner) as fork:
        assert fork.result()


@pytest.mark.slow("a command in a process of its own, which draws all figures")
def test_a_command_in_its_own_process_writes_the_files_that_it_writes_without_forks(
    tmp_path: Path, figures: None, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, override = str(shortened_demo(tmp_path / "demo", 200) / "quadruped.yaml"), "estimator.ridge=auto"
    assert main(["identify", settings, override, f"output={tmp_path / 'alone'}", "--quiet"]) == 0
    command = [sys.executable, "-m", "torchid", "identify", settings, override, f"output={tmp_path / 'forks'}", "-q"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == capsys.readouterr().err
    alone, copied = (
        {path.name.partition(".out.")[0]: path.read_bytes() for path in (tmp_path / name).iterdir()}
        for name in ("alone", "forks")
    )
    assert alone.keys() == copied.keys()
    pictures = [name for name in alone if name.endswith(".png")]
    assert len(pictures) == 9
    assert all(alone[name] == copied[name] for name in pictures)
    ridges = [json.loads(files["metrics.json"])["ridge_selection"] for files in (alone, copied)]
    assert ridges[0] == ridges[1]


def test_a_figure_that_cannot_be_drawn_is_said_in_one_line(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("torchid.commands.run_folder.error_figure", fails)
    monkeypatch.setattr(parallel, "_allowed", True)
    settings, output = str(place / "demo" / "quadruped.yaml"), tmp_path / "run"
    assert main(["identify", settings, "estimator.ridge=0.1", f"output={output}", "--quiet"]) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert "drawing" in line
    assert "errors.png: OSError: [Errno 28] No space left on device" in line
    assert not output.exists()
    assert not multiprocessing.active_children()
