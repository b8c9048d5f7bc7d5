"""Commands whose process is killed while they write: what is there before or after, whole."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import warnings
from pathlib import Path

from run_folders import a_run, everything, write

from torchid.commands.folder import (
    check_free,
)
from torchid.commands.manifest import MANIFEST
from torchid.staging import staging_folder

_KILLED = """
import os, signal, sys
from pathlib import Path
import torchid.commands.folder as folder
stop, output, calls = int(sys.argv[1]), Path(sys.argv[2]), 0
def counted(function):
    def call(*args, **kwargs):
        global calls
        calls += 1
        if calls == stop:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)
    return call
for name in ("mkdir", "open", "rename", "unlink", "rmdir", "replace", "remove"):
    setattr(os, name, counted(getattr(os, name)))
with folder.new_folder(output, True) as new:
    (new / "config.yaml").write_text("new")
    (new / "hparams").mkdir()
    (new / "hparams" / "events").write_text("new")
"""


def test_a_process_killed_at_any_step_loses_nothing_and_the_next_run_clears_what_it_left(tmp_path: Path) -> None:
    """At every change that it makes to the disk, the one between the old run and the new included."""
    stop, fates = 0, set()
    while True:
        stop += 1
        place = tmp_path / str(stop)
        output = a_run(place / "run")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of forks beside threads, which the child does not use
            pid = os.fork()  # an interpreter would take a second to start
        if not pid:
            try:
                sys.argv = ["", str(stop), str(output)]
                exec(_KILLED, {})
                os._exit(0)
            finally:
                os._exit(1)
        ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        check_free(output, True)  # which clears what was left
        text = (output / "config.yaml").read_text()
        assert {path.read_text() for path in output.rglob("*") if path.is_file() and path.name != MANIFEST} == {text}
        assert [path.name for path in place.iterdir()] == ["run"], stop
        fates.add(text)
        if not ended:
            break
        assert ended == -signal.SIGKILL
    assert stop > 10
    assert fates == {"old", "new"}


def test_what_a_living_process_makes_and_what_only_looks_like_it_stay(tmp_path: Path) -> None:
    output = tmp_path / "run"
    names = {".run-notes.torchid/new/a", ".run-01234567.torchid/mine", ".run-01234567/new", ".run-0123456x.torchid/new"}
    write(tmp_path, dict.fromkeys(names, "mine"))
    (tmp_path / ".run-76543210.torchid").symlink_to(tmp_path / ".run-01234567")
    before = everything(tmp_path)
    with staging_folder(output) as living:
        (living / "new").mkdir()
        a_run(output)
        assert (living / "new").exists()
    shutil.rmtree(output)
    assert everything(tmp_path) == before
