"""Whatever stops a command is told in one line of plain text that says what was being done to which file."""

from __future__ import annotations

import errno
import io
import logging
import os
import sys
import threading
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from rich.table import Table
from rich.text import Text

from torchid.boundary import run_guarded
from torchid.cli import main
from torchid.errors import ConfoundedWarning, TorchidWarning, during, is_plain
from torchid.report.tables import print_tables, table_text, terminal_console

EVIL = "a\x1b[31m\u202eb\nc\r\x07\u200b$x_{$"


def stopped(error: BaseException, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """Exit status and the line on standard error of a command that an error stops while it reads a file."""

    def command() -> None:
        with during("reading", "outer.yaml"), during("reading", f"{EVIL}.npz"):
            raise error

    status = run_guarded("torchid", command)
    out, said = capsys.readouterr()
    assert out == ""
    assert said.count("\n") == 1
    assert is_plain(said.rstrip("\n"))
    return status, said.rstrip("\n")


@pytest.mark.parametrize(
    ("error", "status", "parts"),
    [
        (KeyError("x"), 1, ("KeyError: 'x'", "a bug in torchid", "the output of --debug")),
        (RuntimeError(EVIL), 1, ("RuntimeError", "a bug in torchid")),
        (RecursionError(), 1, ("RecursionError: no text", "a bug in torchid")),
        (AssertionError(), 1, ("AssertionError", "a bug in torchid")),
        (MemoryError(), 1, ("not enough memory", "accepted: smaller logs")),
        (OSError(errno.ENOSPC, "No space left on device"), 1, ("OSError: [Errno 28] No space left on device",)),
    ],
    ids=lambda value: type(value).__name__,
)
def test_any_error_becomes_a_line_that_says_what_was_being_done(
    capsys: pytest.CaptureFixture[str], error: Exception, status: int, parts: tuple[str, ...]
) -> None:
    found, line = stopped(error, capsys)
    assert found == status
    assert line.startswith("torchid: reading a\\x1b[31m\\u202eb c ")
    assert "outer.yaml" not in line
    for part in parts:
        assert part in line
    assert ("bug in torchid" in line) == any("bug" in part for part in parts)


def test_arguments_that_are_not_understood_are_repeated_in_plain_text(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["check", "x.npz", f"--{EVIL}"])
    assert all(map(is_plain, capsys.readouterr().err.split("\n")))


def test_whatever_is_printed_has_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> int:
        sys.stdout.write(f"{EVIL}\n")
        table = Table(title=EVIL.replace("[", "("))
        table.add_column(Text(EVIL))
        table.add_row(Text(EVIL))
        print_tables(table)
        terminal_console(stderr=True).print(Text(EVIL))
        warnings.warn(f"{EVIL}: a gap", TorchidWarning, stacklevel=1)
        return 0

    assert run_guarded("torchid", command) == 0
    for said in capsys.readouterr():
        assert said
        assert all(map(is_plain, said.split("\n")))
    table = Table()
    table.add_row(Text(EVIL))
    assert all(map(is_plain, table_text(table).split("\n")))


def test_a_thread_of_a_library_that_fails_does_not_speak_to_users(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only with --debug; whatever speaks otherwise is in its place again afterwards."""
    said: list[object] = []
    monkeypatch.setattr(threading, "excepthook", said.append)

    def command() -> None:
        thread = threading.Thread(target=lambda: Path("no/such/file").read_text())
        thread.start()
        thread.join()

    assert run_guarded("torchid", command) == 0
    assert not said
    run_guarded("torchid", command, debug=True)
    command()
    assert len(said) == 2


def test_libraries_do_not_speak_to_users(capsys: pytest.CaptureFixture[str]) -> None:
    """But for numbers that went wrong in them, once."""

    def command() -> None:
        logging.getLogger("trimesh").warning("%s", EVIL)
        warnings.simplefilter("always")
        warnings.warn("findfont: no glyph", UserWarning, stacklevel=1)
        for _ in range(2):
            np.array([1e308]) * np.array([1e308])

    assert run_guarded("torchid", command) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("torchid: NumericalWarning: a library could not handle a number (overflow")


def test_a_reader_who_has_enough_is_not_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in `torchid check log.npz | head -1`."""
    read, write = os.pipe()
    os.close(read)
    with open(write, "w", buffering=1) as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert run_guarded("torchid", lambda: sys.stdout.write("x" * 10_000) and 0) == 1
    assert capsys.readouterr().err == ""


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(10 * 2**30)


@pytest.mark.parametrize("make", [_pipe, _endless, _sparse], ids=lambda make: make.__name__)
@pytest.mark.parametrize("name", ["config.yaml", "parameters.json", "x.npz", "x.h5", "x.csv", "x.parquet", "x.mcap",
                                  "x.bag", "x.db3", "x.urdf"])  # fmt: skip
def test_what_has_no_end_is_not_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Callable[[Path], None], name: str
) -> None:
    demo = shortened_demo(tmp_path / "demo", 40)
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text(
        (demo / "quadruped.yaml").read_text().replace("quadruped.urdf", f"{demo}/quadruped.urdf")
    )
    path = (run if name in ("config.yaml", "parameters.json") else tmp_path) / name
    path.unlink(missing_ok=True)
    make(path)
    arguments = ["evaluate", str(run), "--log", str(demo / "sway_test.npz")]
    if path.parent == tmp_path:
        arguments = ["check", str(path)]
        if name == "x.urdf":
            arguments = ["check", str(demo / "sway_test.npz"), "--urdf", str(path)]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert name in said or "no config.yaml" in said


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def _warn_of_logs(
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    *,
    terminal: bool,
    fold: bool,
    category: type[TorchidWarning] = TorchidWarning,
    columns: int = 100,
) -> list[str]:
    """Lines on standard error of a command that warns."""

    def command() -> None:
        for text in told:
            warnings.warn(text, category, stacklevel=1)

    screen = _Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("COLUMNS", str(columns))
    assert run_guarded("torchid", command, fold_warnings=fold) == 0
    return screen.getvalue().splitlines()


def test_a_terminal_gets_the_first_of_alike_warnings_and_their_number_and_a_file_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    logs = [f"walk_{k}.npz: {10 * k} of 1300 samples excluded: 'joint_{k}' has spikes" for k in range(9)]
    told = [*logs, "walk_0.npz: time: a gap of 0.3 s", "identified.urdf: 2 bodies cannot exist", logs[0]]
    for terminal, fold in ((False, True), (True, False)):
        lines = _warn_of_logs(told, monkeypatch, terminal=terminal, fold=fold)
        assert lines == [f"torchid: TorchidWarning: {text}" for text in told]
    lines = _warn_of_logs(told, monkeypatch, terminal=True, fold=True)
    first = [f"torchid: TorchidWarning: {text}" for text in (told[0], told[-3], told[-2])]
    assert lines == [*first, "torchid: and 9 warnings like these; --verbose shows them"]
    assert _warn_of_logs(told[-3:-1], monkeypatch, terminal=True, fold=True) == first[1:]


def test_a_terminal_gets_no_warning_of_what_its_answer_says_is_confounded(monkeypatch: pytest.MonkeyPatch) -> None:
    told = ["walk.yaml: offset of l_hip: confounded with m of pelvis; do not trust either; add motion"]
    for terminal, fold in ((False, True), (True, False), (True, True)):
        lines = _warn_of_logs(told, monkeypatch, terminal=terminal, fold=fold, category=ConfoundedWarning)
        assert bool(lines) is not (terminal and fold)


def test_a_traceback_is_shown_to_who_asks(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_guarded("torchid", lambda: {}["x"], debug=True) == 1
    assert "Traceback" in capsys.readouterr().err
