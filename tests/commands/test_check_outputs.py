"""Files that `torchid check` writes: each complete or not at all, and an interrupt knows which are there."""

from __future__ import annotations

from pathlib import Path

import pytest
from demo import shortened_demo
from refusals import files_in

from torchid.cli import main
from torchid.commands import check


@pytest.fixture
def given(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A command that writes both files into the folder."""
    log = shortened_demo(tmp_path_factory.mktemp("logs") / "demo", 100) / "sway_test.npz"
    return ["check", str(log), "--json", str(tmp_path / "found.json"), "--figure", str(tmp_path / "found.png")]


def test_an_interrupt_between_the_files_says_which_one_was_written(
    given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(check, "log_check_figure", interrupted)
    assert main(given) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == f"torchid: interrupted; {tmp_path / 'found.json'} was written"
    assert set(files_in(tmp_path)) == {"found.json"}


def test_a_full_disk_leaves_the_earlier_file_as_it_was(
    given: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "found.json").write_text("earlier")
    monkeypatch.setattr(Path, "write_text", full)
    assert main([*given, "--overwrite"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"torchid: {tmp_path / 'found.json'}: file: cannot be written")
    assert "No space left on device" in line
    assert files_in(tmp_path) == {"found.json": b"earlier"}
