"""Commands that are started without standard output, as a service starts them."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-"], ids=["output", "output and error"])
def test_a_command_writes_its_files_without_standard_output(tmp_path: Path, closed: str) -> None:
    np.savez(tmp_path / "log.npz", time=np.arange(9.0), joint_names=["elbow"], joint_position=np.zeros((9, 1)))
    words = [sys.executable, "-m", "torchid", "convert", str(tmp_path / "log.npz"), str(tmp_path / "log.csv")]
    ran = subprocess.run(["sh", "-c", f"{shlex.join(words)} {closed}"], stderr=subprocess.PIPE, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert (tmp_path / "log.csv").stat().st_size
