"""What every refusal is: one line that says where, what was found and what is accepted, and nothing written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from torchid.cli import main
from torchid.errors import ConfigError, InputError, UnknownNameError


def files_in(folder: Path) -> dict[str, bytes]:
    """All files with what is in them, and all folders."""
    paths = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in paths}


def refusal(arguments: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command ends that leaves a folder as it was."""
    before = files_in(folder)
    status = main(arguments)
    printed = capsys.readouterr()
    complaint = [line for line in printed.err.splitlines() if "Warning:" not in line]
    assert status == 2, printed.err
    assert len(complaint) == 1
    assert complaint[0].startswith("torchid: ")
    assert "accepted: " in complaint[0]
    assert printed.out == ""
    assert files_in(folder) == before
    return complaint[0]


def refused(call: Callable[[], object], start: str, kind: type[InputError] = InputError) -> str:
    """The one line of an error of a kind that a call ends with."""
    with pytest.raises(kind) as raised:
        call()
    message = str(raised.value)
    assert "\n" not in message
    assert message.startswith(start)
    assert "; accepted: " in message
    return message


def assert_unknown_key(load: Callable[[], object], file: Path, place: str, name: str, nearest: str) -> None:
    """A settings file is refused by the place of an unknown key and the nearest key that exists."""
    message = refused(load, f"{file}: {place}: unknown name '{name}'; accepted: ", UnknownNameError)
    assert nearest in message.split("accepted: ")[1].split(", ")


def assert_wrong_value(load: Callable[[], object], file: Path, place: str, found: str) -> None:
    """A settings file is refused by the place of a value, the value, and what is accepted."""
    assert found in refused(load, f"{file}: {place}: ", ConfigError)
