"""Where results may go: a run appears whole, in its own folder, or not at all, whatever the place and the disk."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hostile import judged
from hostile_commands import Commands
from refusals import files_in
from repository import ROOT
from run_folders import names_in

from torchid.cli import main
from torchid.commands.folder import RUN, claim_folder, require_replaceable
from torchid.errors import ConfigError, LogError
from torchid.logs import read_log, write_log

WHOLE = {"config.yaml", "parameters.json", "metrics.json", "identified.urdf", "forces.png", "errors.png"}
NOBODY = 65534


def identify(place: Path, output: object, *more: str) -> list[str]:
    return ["identify", str(place / "demo" / "quadruped.yaml"), f"output={output}", *more]


def is_whole(run: Path) -> bool:
    """Whether a folder has all that belongs to a run, and nothing else."""
    names = {path.name for path in run.iterdir()}
    json.loads((run / "parameters.json").read_text())
    json.loads((run / "metrics.json").read_text())
    require_replaceable(run, RUN)
    return names >= WHOLE


# --------------------------------------------------------------------------------------------------------------- places


def _file(folder: Path) -> None:
    (folder / "taken").write_text("mine")


def _link_to_a_folder(folder: Path) -> None:
    (folder / "target").mkdir()
    (folder / "taken").symlink_to(folder / "target")


def _link_to_a_file(folder: Path) -> None:
    (folder / "mine").write_text("mine")
    (folder / "taken").symlink_to(folder / "mine")


def _link_to_nothing(folder: Path) -> None:
    (folder / "taken").symlink_to(folder / "nothing")


def _link_to_itself(folder: Path) -> None:
    (folder / "taken").symlink_to(folder / "taken")


def _folder_with_things(folder: Path) -> None:
    (folder / "taken").mkdir()
    (folder / "taken" / "mine.txt").write_text("mine")


def _pipe(folder: Path) -> None:
    os.mkfifo(folder / "taken")


MADE = (_file, _link_to_a_folder, _link_to_a_file, _link_to_nothing, _link_to_itself, _folder_with_things, _pipe)
NAMES = (
    *("''", "' '", "'.'", "'..'", "'/'", "/", "/dev/null", "/dev/null/x", "/proc/self/x", "/dev/full"),
    *("'" + "x" * 300 + "'", "'" + "x/" * 3000 + "'", '"a\\nb"', '"a\\0b"', '"\\e[2J"'),
    *("~nobody_here/x", "null", "[a]", "{a: b}"),
)  # fmt: skip


@pytest.mark.parametrize("overwrite", ["false", "true"])
@pytest.mark.parametrize("made", MADE, ids=lambda made: made.__name__.strip("_"))
def test_what_stands_in_the_place_of_a_run_stays(place: Path, tmp_path: Path, made: object, overwrite: str) -> None:
    made(tmp_path)  # type: ignore[operator]
    for command in ("identify", "analyze"):
        if command == "analyze":
            (tmp_path / "taken").rename(tmp_path / "taken.analysis")
        arguments = [command, *identify(place, tmp_path / "taken", f"overwrite={overwrite}")[1:]]
        verdict = judged(made.__name__, lambda arguments=arguments: main(arguments), tmp_path)
        assert not verdict.faults
        assert verdict.outcome == "refused"


@pytest.mark.parametrize("name", NAMES, ids=lambda name: name[:12])
def test_what_is_no_name_for_a_folder_is_refused(place: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / "mine.txt").write_text("mine")  # here, where `.` is
    verdict = judged(name[:20], lambda: main(identify(place, name, "overwrite=true")), tmp_path)
    assert not verdict.faults
    assert verdict.outcome == "refused"


# ----------------------------------------------------------------------------------------------------------------- disk


@pytest.mark.parametrize("largest", [0, 20_000])
def test_a_full_disk_ends_a_run_in_one_line_with_nothing_left(place: Path, server: Commands, largest: int) -> None:
    """Largest files of 0 bytes to just below those of a run."""
    before = files_in(place / "demo")
    ended = server.run(identify(place, place / "full" / "run"), largest)
    assert ended.status == 1
    (line,) = [line for line in ended.said if "this run goes on without it" not in line]
    assert len(ended.said) <= 2
    assert re.match(rf"torchid: (writing {place}/full/run|identify \S+): OSError: .*File too large", line)
    assert not (place / "full").exists() or names_in(place / "full") == []
    assert files_in(place / "demo") == before


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("largest", [0, 4000])
def test_a_full_disk_leaves_no_part_of_a_log(place: Path, server: Commands, suffix: str, largest: int) -> None:
    target = place / "logs" / f"log{suffix}"
    target.parent.mkdir(exist_ok=True)
    ended = server.run(["convert", str(place / "demo" / "sway_train.npz"), str(target)], largest)
    assert ended.status in (1, 2)
    assert len(ended.said) == 1, ended.said
    assert "cannot be written" in ended.said[0]
    assert list(target.parent.iterdir()) == []


def test_a_place_that_may_not_be_written_is_refused(place: Path, server: Commands) -> None:
    closed = place / "closed"
    closed.mkdir(exist_ok=True)
    closed.chmod(0o555)
    uid = 0 if os.getuid() else NOBODY  # nothing is closed to root
    if uid and not os.access(ROOT, os.X_OK):
        pytest.skip("no other user may read the package")
    ended = server.run(identify(place, closed / "run"), uid=uid)
    assert (ended.status, len(ended.said)) == (2, 1), ended.said
    assert "cannot create a folder in " in ended.said[0]
    ended = server.run(["convert", str(place / "demo" / "sway_train.npz"), str(closed / "x.h5")], uid=uid)
    assert (ended.status, len(ended.said)) == (2, 1), ended.said
    assert list(closed.iterdir()) == []


def test_a_log_that_cannot_be_written_leaves_nothing(place: Path, tmp_path: Path) -> None:
    log = read_log(place / "demo" / "sway_test.npz")
    _link_to_nothing(tmp_path)
    (tmp_path / "folder.npz").mkdir()
    for name in ("folder.npz", "taken/x.npz", "a" * 260 + ".npz", "x/" * 10 + "x.h5"):
        with pytest.raises(LogError, match="cannot be written"):
            write_log(log, tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder.npz", "taken"]


# ------------------------------------------------------------------------------------------------- two at the same time


@pytest.mark.slow("four runs, two of them at once")
@pytest.mark.parametrize("overwrite", [False, True])
def test_of_two_runs_into_one_folder_one_stands_and_it_is_whole(place: Path, server: Commands, overwrite: bool) -> None:
    """Ridges tell them apart: settings and parameters are of the same run."""
    folder = place / f"two-{overwrite}"
    mass = {}
    for ridge in ("0.001", "10.0"):
        assert server.run(identify(place, folder / ridge, f"estimator.ridge={ridge}")).status == 0
        mass[float(ridge)] = json.loads((folder / ridge / "metrics.json").read_text())["total_mass"]
    more = ["overwrite=true"] if overwrite else []
    running = [server.start(identify(place, folder / "run", f"estimator.ridge={ridge}", *more)) for ridge in mass]
    ended = [server.end(child) for child in running]
    assert sorted(x.status for x in ended) == ([0, 0] if overwrite else [0, 2])
    for x in ended:
        assert len(x.said) == (x.status != 0)
    assert is_whole(folder / "run")
    ridge = yaml.safe_load((folder / "run" / "config.yaml").read_text())["estimator"]["ridge"]
    assert json.loads((folder / "run" / "metrics.json").read_text())["total_mass"] == mass[ridge]
    if not overwrite:
        assert ended[list(mass).index(ridge)].status == 0
    assert names_in(folder) == ["0.001", "10.0", "run"]


def test_a_folder_is_claimed_by_one_process_until_that_ends(tmp_path: Path) -> None:
    """Even if it is killed; what it leaves has a hidden name and hinders nobody."""

    def child(call: str) -> subprocess.Popen[str]:
        code = f"from pathlib import Path; from torchid.commands.folder import claim_folder\n{call}"
        return subprocess.Popen(
            [sys.executable, "-c", code, str(tmp_path / "x" / "run")], stdin=-1, stdout=-1, stderr=-1, text=True
        )

    hold = "with claim_folder(Path(__import__('sys').argv[1])): print('mine', flush=True); input()"
    with child(hold) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "mine\n"
        with pytest.raises(ConfigError, match="another run is writing there"), claim_folder(tmp_path / "x" / "run"):
            pass
        first.kill()
    assert [path.name for path in (tmp_path / "x").iterdir()] == [".run.lock"]
    with claim_folder(tmp_path / "x" / "run"):
        pass
    assert list((tmp_path / "x").iterdir()) == []


def test_the_folder_of_the_logs_and_that_of_the_call_are_not_replaced(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(place / "demo")
    for output in (".", "..", str(place / "demo"), "", "sway_train.npz"):
        verdict = judged(output, lambda output=output: main(identify(place, output, "overwrite=true")), place / "demo")
        assert not verdict.faults
        assert verdict.outcome == "refused"
