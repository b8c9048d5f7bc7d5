"""What commands import before they know what they need."""

from __future__ import annotations

import subprocess
import sys

RARE = ("tensorboard", "scipy.stats", "scipy.signal", "pyarrow", "h5py")
"""For event files, filters, and files of other types."""


def test_commands_import_nothing_that_most_runs_do_without() -> None:
    code = (
        "import sys; import torchid.cli, torchid.api, torchid.commands.identify, torchid.terminal.answer; "
        f"print([name for name in {RARE} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
