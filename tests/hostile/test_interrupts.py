"""Commands that are stopped at any moment: what they leave is a whole result, or nothing that looks like one."""

from __future__ import annotations

import random
import shutil
import signal
import sys
import time
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from hostile_commands import Commands
from refusals import files_in
from run_folders import names_in
from thinned import study_but

from torchid.staging import NEW, staging_folder

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL, signal.SIGHUP)
COMMANDS = ("identify", "train", "evaluate", "analyze", "convert", "compress")
TIMES = [1, pytest.param(25, marks=pytest.mark.study)]


@pytest.fixture(scope="module")
def run(place: Path, server: Commands) -> Path:
    """A finished run, to be evaluated."""
    assert server.run(["identify", *experiment(place, place / "run")]).status == 0
    return place / "run"


def experiment(place: Path, output: Path) -> list[str]:
    return [str(place / "demo" / "quadruped.yaml"), f"output={output}"]


def arguments(command: str, place: Path, run: Path, out: Path) -> tuple[list[str], Path]:
    """A command line, and the file or folder that it makes in `out`."""
    log = str(place / "demo" / "sway_test.npz")
    if command == "evaluate":
        shutil.copytree(run, out / "run", dirs_exist_ok=True)
        return ["evaluate", str(out / "run"), "--log", log], out / "run" / "evaluation" / "sway_test"
    if command == "convert":
        return ["convert", str(place / "demo" / "sway_train.npz"), str(out / "log.h5")], out / "log.h5"
    if command == "compress":
        line = ["compress", str(place / "demo" / "quadruped.yaml"), "--output", str(out / "factors")]
        return line, out / "factors"
    if command == "analyze":
        return ["analyze", *experiment(place, out / "run")], out / "run.analysis"
    sgd = ["estimator={name: sgd, training: {epochs: 30, checkpoint_seconds: 0}}"] if command == "train" else []
    return ["identify", *experiment(place, out / "run"), *sgd], out / "run"


def content(made: Path) -> set[str]:
    """Names in a result, event files by kind; a file is its own name."""
    names = files_in(made) if made.is_dir() else {made.name: b""}
    return {name.split(".out.tfevents")[0] for name in names}


def hidden(out: Path) -> list[str]:
    """Temporary files and folders, wherever they are."""
    found = (
        path for path in out.rglob(".*") if path.name != ".checkpoint.pt" and out / "run.training" not in path.parents
    )
    return sorted(str(path.relative_to(out)) for path in found)


@pytest.mark.slow("each command three times")
@pytest.mark.parametrize("times", TIMES)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_stopped_at_any_moment_leaves_all_or_nothing(
    place: Path, server: Commands, run: Path, tmp_path: Path, command: str, times: int
) -> None:
    """And what is left, of a process that was killed, hinders no other."""
    line, made = arguments(command, place, run, tmp_path / "whole")
    (tmp_path / "whole").mkdir(exist_ok=True)
    start = time.monotonic()
    assert server.run(line).status == 0
    seconds, whole = time.monotonic() - start, content(made)
    draw, out = random.Random(COMMANDS.index(command)), tmp_path / "out"
    for number in range(times):
        kind = SIGNALS[(number + COMMANDS.index(command)) % len(SIGNALS)]
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        line, made = arguments(command, place, run, out)
        ended = server.stopped(line, kind, draw.uniform(0.0, 1.1) * seconds)
        case = f"{command}, {kind.name} {number}: {ended}"
        assert not made.exists() or content(made) == whole, case
        assert ended.status in ((0, 1) if kind == signal.SIGINT else (0, 1, -kind)), case
        assert len(ended.said) == (ended.status == 1), case
        assert made.exists() == any(f"interrupted; {made} was written" in line for line in ended.said) or (
            ended.status != 1
        ), case
        if kind != signal.SIGKILL:
            assert hidden(out) == [], case
        if command == "train" and ended.status and (out / "run.training" / "checkpoint.pt").exists():
            line = [*line, "--resume"]
        elif made.exists() and command in ("identify", "train", "analyze", "compress"):
            line = [*line, "overwrite=true"]
        if command == "convert":
            line = [*line, "--overwrite"]
        if number < 6:
            assert server.run(line).status == 0, case
            assert content(made) == whole, case
            assert hidden(out) == [], f"{case}: left by the killed command"


@pytest.mark.slow("a run three times")
@pytest.mark.parametrize("number", study_but([signal.SIGTERM], [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]))
def test_a_run_that_is_replaced_is_there_at_any_moment(
    place: Path, server: Commands, run: Path, tmp_path: Path, number: signal.Signals
) -> None:
    """The old one or the new one, whenever the command is stopped."""
    out, draw = tmp_path / "run", random.Random(int(number))
    shutil.copytree(run, out)
    start = time.monotonic()
    line = ["identify", *experiment(place, out), "overwrite=true"]
    assert server.run(line).status == 0
    seconds = time.monotonic() - start
    for _ in range(2):
        server.stopped(line, number, draw.uniform(0.7, 1.0) * seconds)
        assert content(out) == content(run)
        assert names_in(tmp_path) == ["run"]


def test_ctrl_c_at_any_step_of_the_way_out_leaves_no_staging_folder(tmp_path: Path) -> None:
    """Also just before it is deferred; Python looks for signals in the functions that are called there."""

    def interrupt(frame: FrameType, _: str, __: object) -> Any:
        nonlocal steps
        if frame.f_code is staging_folder.__wrapped__.__code__:  # type: ignore[attr-defined]
            return interrupt
        if Path(frame.f_code.co_filename).name not in ("staging.py", "contextlib.py"):
            return None
        steps += 1
        if steps == chosen:
            signal.raise_signal(signal.SIGINT)
        return interrupt

    steps, chosen, interrupted = 0, 0, 0
    while steps >= chosen:
        steps, chosen = 0, chosen + 1
        sys.settrace(interrupt)
        try:
            with staging_folder(tmp_path / "out") as folder:
                (folder / NEW).write_text("half")
        except KeyboardInterrupt:
            interrupted += 1
        finally:
            sys.settrace(None)
        assert names_in(tmp_path) == [], chosen
    assert interrupted == chosen - 1 > 50
