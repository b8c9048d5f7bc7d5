"""Commands as processes of their own: what they import, without extras, and without standard output."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo

EXTRAS = ("mujoco", "h5py", "pyarrow", "rosbags", "mcap", "cvxpy", "pinocchio")
WORKING = (
    "identify mine/quadruped.yaml output=run",
    "evaluate run --log mine/sway_test.npz --output evaluated",
    "sample run --count 50 --output samples.npz",
    "check mine/quadruped.yaml",
    "report run",
    "analyze mine/quadruped.yaml",
    "compress mine/quadruped.yaml --output factors",
    "export run --format urdf --output exported",
    "export run --format isaaclab --output exported.py",
    "init mine/quadruped.urdf mine/sway_test.npz --output own.yaml",
)
REFUSED = {
    "replay run --log mine/sway_test.npz": "[sim]",
    "simulate mine/quadruped.yaml": "[sim]",
    "convert mine/sway_test.npz log.csv": "[tables]",
    "convert mine/sway_test.npz log.h5": "[hdf5]",
}


@pytest.fixture(scope="module")
def statuses(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Exit status and standard error of each command, one after the other in one process."""
    folder = tmp_path_factory.mktemp("bare")
    shortened_demo(folder / "mine", 100)
    code = (
        "import contextlib, io, json, sys\n"
        f"sys.modules.update(dict.fromkeys({EXTRAS}))\n"
        "from torchid.cli import main\n"
        "found = {}\n"
        "for command in json.loads(sys.argv[1]):\n"
        "    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:\n"
        "        found[command] = main(command.split()), said.getvalue()\n"
        "print(json.dumps(found))\n"
    )
    command = [sys.executable, "-W", "ignore", "-c", code, json.dumps([*WORKING, *REFUSED])]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=True)
    return {name: (status, said) for name, (status, said) in json.loads(done.stdout).items()}


@pytest.mark.parametrize("command", WORKING)
def test_a_command_works_without_extras(statuses: dict[str, tuple[int, str]], command: str) -> None:
    assert statuses[command][0] == 0, statuses[command][1]


@pytest.mark.parametrize(("command", "extra"), REFUSED.items())
def test_a_command_names_the_extra_that_it_needs(
    statuses: dict[str, tuple[int, str]], command: str, extra: str
) -> None:
    status, said = statuses[command]
    assert status == 2
    assert said.count("\n") == 1
    assert f"pip install '.{extra}'" in said


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
    found: subprocess.CompletedProcess[str],
) -> None:
    """It does not take libraries down one by one, which takes 0.3 s."""
    assert found.returncode == 2
    assert found.stderr.splitlines()[-1].startswith("torchid: no_such_file.yaml: ")
    assert found.stderr.endswith("\n")


@pytest.mark.slow("a process of its own")
def test_a_command_writes_its_files_without_standard_output(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", time=np.arange(9.0), joint_names=["elbow"], joint_position=np.zeros((9, 1)))
    words = [sys.executable, "-m", "torchid", "convert", str(tmp_path / "log.npz"), str(tmp_path / "log.csv")]
    ran = subprocess.run(["sh", "-c", f"{shlex.join(words)} >&-"], stderr=subprocess.PIPE, text=True)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert (tmp_path / "log.csv").stat().st_size
