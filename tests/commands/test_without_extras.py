"""Commands where no package of an extra is installed: all work, but for those that are said to need one."""

from __future__ import annotations

import json
import subprocess
import sys

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
    shortened_demo(folder / "mine", 200)
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
