"""What commands import before they know what they need."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

RARE = ("tensorboard", "scipy.stats", "scipy.signal", "pyarrow", "h5py")
"""For event files, filters, and files of other types."""


@pytest.fixture(scope="module")
def found() -> subprocess.CompletedProcess[str]:
    """A process that prints which rare modules commands have imported, and of its garbage, and ends as a command."""
    code = (
        "import gc, runpy, sys; import torchid.cli, torchid.commands.identify, torchid.terminal.identification; "
        "assert 'torchid.sensor_planning' not in sys.modules; import torchid.api; "
        f"print([name for name in {RARE} if name in sys.modules]); from torchid.cli import main; "
        "main(['identify', 'no_such_file.yaml']); left = gc.get_freeze_count(); "
        "sys.argv[1:] = ['identify', 'no_such_file.yaml']; main(); "
        "print(gc.isenabled(), left == 0, gc.get_freeze_count() > 50_000 > len(gc.get_objects())); "
        "runpy.run_module('torchid', run_name='__main__')"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def test_commands_import_nothing_that_most_runs_do_without(
    found: subprocess.CompletedProcess[str],
) -> None:
    assert found.stdout.splitlines()[0] == "[]", found.stderr


def test_a_process_of_a_command_ends_with_all_of_its_output_and_its_status(
    found: subprocess.CompletedProcess[str], tmp_path: Path
) -> None:
    """It does not take libraries down one by one, which takes 0.3 s."""
    command = [sys.executable, "-m", "torchid", "demo", "--copy", str(tmp_path / "mine")]
    copied = subprocess.run(command, capture_output=True, text=True)
    assert (copied.returncode, copied.stderr) == (0, "")
    assert "in the folder above it: torchid identify mine/quadruped.yaml" in copied.stdout
    assert found.returncode == 2
    assert found.stderr.splitlines()[-1].startswith("torchid: no_such_file.yaml: ")
    assert found.stderr.endswith("\n")
