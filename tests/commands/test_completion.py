"""Scripts that complete the command line in a shell."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from torchid.cli import main


def script(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as leaving:
        main(["--print-completion", shell])
    assert leaving.value.code == 0
    return capsys.readouterr().out


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        (["eval"], ["evaluate"]),
        (["check", "--verb"], ["--verbose"]),
        (["check", "wa"], ["walk.npz"]),
        (["check", "walk.npz", "--urdf", "ro"], ["robot.urdf"]),
        (["compress", "run.yaml", "--output", ""], ["factors"]),
    ],
)
def test_bash_completes_commands_options_and_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], typed: list[str], completed: list[str]
) -> None:
    for name in ("walk.npz", "robot.urdf"):
        (tmp_path / name).touch()
    (tmp_path / "factors").mkdir()
    words = " ".join(f"'{word}'" for word in ("torchid", *typed))
    command = f"COMP_WORDS=({words}); COMP_CWORD={len(typed)}; _shtab_torchid; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    ran = subprocess.run(
        ["bash", "-c", f"{script('bash', capsys)}\n{command}"],
        cwd=tmp_path,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert [word.rstrip("/ ") for word in ran.stdout.splitlines()] == completed
