"""Commands of which a process is killed, while it writes or shares the work: what is there before or after, whole."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
from demo import shortened_demo
from run_folders import a_run, everything, names_in, write
from shared_work import SMALL_CHUNK, TWO, children, finish_forked, is_running, started

from torchid.cli import main
from torchid.commands.folder import MANIFEST, check_free
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
    names = {".run-notes.torchid/new/a", ".run-01234567.torchid/mine", ".run-01234567/new", ".run-0123-567.torchid/new"}
    write(tmp_path, dict.fromkeys(names, "mine"))
    (tmp_path / ".run-76543210.torchid").symlink_to(tmp_path / ".run-01234567")
    before = everything(tmp_path)
    with staging_folder(output) as living:
        (living / "new").mkdir()
        a_run(output)
        assert (living / "new").exists()
    shutil.rmtree(output)
    assert everything(tmp_path) == before


# ------------------------------------------------------------------------------------------ processes that share work


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[list[str], bytes, float]]:
    """A command without its output, the parameters that two processes find, and how long they work on them [s].

    Its logs have some chunks.
    """
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("torchid.problem.chunks._LEAST", SMALL_CHUNK)
        folder = shortened_demo(tmp_path_factory.mktemp("killed") / "demo", 200)
        command = ["identify", str(folder / "quadruped.yaml")]
        begin = time.monotonic()
        status, _, complained = finish_forked(2, lambda: main([*command, f"output={folder / 'run'}"]))
        assert status == 0, complained
        yield command, (folder / "run/parameters.json").read_bytes(), time.monotonic() - begin


def killed_after(seconds: float, command: list[str], output: Path, victim: int) -> int:
    """Exit status of a command of which one process was killed, so long after it had begun, all others having ended."""
    with started([*TWO, "-m", "torchid", *command, f"output={output}"]) as process:
        while process.poll() is None and len(children(process)) < 2:
            time.sleep(0.01)
        time.sleep(seconds)
        workers = children(process)
        if victim < len(workers):
            os.kill(workers[victim], signal.SIGKILL)
        process.communicate(timeout=60)
    assert not any(is_running(pid) for pid in workers)
    return process.returncode


def killed_fork_after(seconds: float, command: list[str], output: Path, victim: int) -> int:
    """As `killed_after`, of forks of this process, of which the other is then ended as torchrun does."""

    def kill(processes: Sequence[int]) -> None:
        time.sleep(seconds)
        os.kill(processes[victim], signal.SIGKILL)
        os.kill(processes[1 - victim], signal.SIGTERM)

    return finish_forked(2, lambda: main([*command, f"output={output}"]), meanwhile=kill)[0]


def assert_nothing_or_whole(output: Path, parameters: bytes, status: int) -> None:
    assert not output.exists() or (output / "parameters.json").read_bytes() == parameters
    assert output.exists() or status != 0


STARTING = 4.0
"""What processes of torchrun take to import what they need [s]."""


@pytest.mark.parametrize(
    ("seed", "kill", "start"),
    [
        pytest.param(0, killed_fork_after, 0.0, marks=pytest.mark.slow("two processes, and two again")),
        *(pytest.param(seed, killed_after, STARTING, marks=pytest.mark.study) for seed in range(20)),
    ],
)
def test_a_killed_process_ends_all_and_leaves_nothing_or_all(
    whole: tuple[list[str], bytes, float], tmp_path: Path, seed: int, kill: Callable[..., int], start: float
) -> None:
    command, parameters, seconds = whole
    drawn, output = random.Random(seed), tmp_path / "runs" / "run"
    status = kill(drawn.uniform(0.0, start + seconds), command, output, drawn.randrange(2))
    assert_nothing_or_whole(output, parameters, status)
    again = [*command, f"output={output}", "overwrite=true"]
    status, _, complained = finish_forked(2, lambda: main(again))
    assert status == 0, complained
    assert (output / "parameters.json").read_bytes() == parameters
    assert names_in(output.parent) == ["run"]
