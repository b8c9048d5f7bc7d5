"""What commands import before they know what they need."""

from __future__ import annotations

import subprocess
import sys

RARE = ("tensorboard", "scipy.stats", "scipy.signal", "pyarrow", "h5py")
"""For event files, filters, and files of other types."""


def test_commands_import_nothing_that_most_runs_do_without() -> None:
    code = (
        "import sys; import torchid.cli, torchid.api, torchid.commands.identify, torchid.terminal.identification; "
        f"print([name for name in {RARE} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_a_command_imports_is_never_looked_through_for_garbage_again() -> None:
    code = (
        "import gc, sys; from torchid.cli import main; "
        "main(['identify', 'no_such_file.yaml']); left = gc.get_freeze_count(); "
        "sys.argv[1:] = ['identify', 'no_such_file.yaml']; main(); "
        "print(gc.isenabled(), left == 0, gc.get_freeze_count() > 50_000 > len(gc.get_objects()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True True True", "but by whoever calls it as a function and goes on"
