"""Runs whose samples several processes share, started by torchrun: the results of one process, and its manners."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch.distributed as dist  # noqa: TID251
import yaml
from demo import shortened_demo
from repository import DEMO
from run_folders import identified, names_in
from shared_work import (
    SMALL_CHUNK,
    TWO,
    children,
    differences,
    finish,
    finish_forked,
    lines_of_torchid,
    run_all,
    started,
    write_experiments,
)

import torchid
from torchid import distributed
from torchid.cli import main
from torchid.commands.folder import CHECKPOINT
from torchid.parallel import share_between_processes
from torchid.problem.linear import parameter_scale

DESCENT = ("estimator.name=sgd", "estimator.training.epochs=4", "estimator.ridge=0.1")
RUNS = {
    "biped, consistent": ("biped", ("estimator.name=consistent",)),
    "arm, robust": ("arm", ("estimator.robust=tukey",)),
    "quadruped, descent": ("quadruped", DESCENT),
    "short": ("short", ()),
}


@pytest.fixture(scope="module")
def experiments(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three robots; and the quadruped with a log of three samples, fewer than processes."""
    files = write_experiments(tmp_path_factory.mktemp("experiments"))
    short = files["quadruped"].parent.with_name("short")
    shutil.copytree(files["quadruped"].parent, short)
    with np.load(short / "log0.npz") as log:
        fields = {key: x if "names" in key else x[:3] for key, x in log.items()}
    np.savez(short / "log0.npz", **fields)
    return files | {"short": short / "experiment.yaml"}


@pytest.fixture(scope="module", autouse=True)
def _small_chunks() -> Iterator[None]:
    """Short logs have some of them, in this process and in its forks."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("torchid.problem.chunks._LEAST", SMALL_CHUNK)
        yield


@pytest.fixture(scope="module")
def runs(experiments: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """Folders with the runs of one and two processes."""
    folder, out = tmp_path_factory.mktemp("runs"), {}
    for processes in (1, 2):
        chosen = [(name, *RUNS[name]) for name in RUNS]
        out[processes] = folder / str(processes)
        run_all(processes, out[processes], [(name, experiments[robot], more) for name, robot, more in chosen])
    return out


def in_scale(run: Path, other: Path, urdf: Path, bolted: bool) -> float:
    """Largest difference of the parameters of two runs, in units of their scale."""
    robot = torchid.load_robot(urdf, fixed_base=bolted)
    return float(np.abs((identified(run) - identified(other)) / parameter_scale(robot.nominal)).max())


def robot_of(experiment: Path) -> tuple[Path, bool]:
    document = yaml.safe_load(experiment.read_text())["robot"]
    return Path(document["urdf"]), document["fixed_base"]


def assert_same(shared: Path, one: Path, experiment: Path, descends: bool) -> None:
    """Up to rounding, which a descent lets grow: Adam divides gradients that are nearly zero by their size."""
    assert in_scale(shared, one, *robot_of(experiment)) < (1e-9 if descends else 1e-12)
    before, now = (json.loads((run / "metrics.json").read_text()) for run in (one, shared))
    for group in ("train", "train_nominal", "cross_validation", "noise", "robust", "total_mass", "samples", "rows"):
        for where, difference in differences(before[group], now[group], group):
            assert difference < (1e-7 if descends else 1e-10), where


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_two_processes_find_what_one_finds(runs: dict[int, Path], experiments: dict[str, Path], name: str) -> None:
    assert_same(runs[2] / name, runs[1] / name, experiments[RUNS[name][0]], "descent" in name)


@pytest.mark.study
def test_the_same_number_of_processes_gives_the_same_bits(
    runs: dict[int, Path], experiments: dict[str, Path], tmp_path: Path
) -> None:
    names = ("arm, robust", "quadruped, descent")
    run_all(2, tmp_path / "again", [(name, experiments[RUNS[name][0]], RUNS[name][1]) for name in names])
    for name in names:
        assert (tmp_path / "again" / name / "parameters.json").read_bytes() == (
            runs[2] / name / "parameters.json"
        ).read_bytes()


@pytest.mark.parametrize(("sizes", "size"), [([1, 9, 1, 9], 2), ([3], 4), ([], 2), ([2048] * 9 + [3], 4)])
def test_every_piece_has_one_owner_and_shares_are_even(
    monkeypatch: pytest.MonkeyPatch, sizes: list[int], size: int
) -> None:
    shares = []
    for rank in range(size):
        monkeypatch.setattr(distributed, "_sharing", distributed._Group(None, rank, size))
        shares.append(distributed.own_share(sizes))
    numbers = range(len(sizes))
    assert [number for share in shares for number in numbers[share]] == list(numbers)
    assert all(abs(sum(sizes[share]) - sum(sizes) / size) <= max(sizes, default=0) for share in shares)


MISTAKEN = ("identify", str(DEMO / "quadruped.yaml"), "estimator.rigde=3")


def assert_told_once(printed: str, complained: str) -> None:
    assert not printed
    (line,) = lines_of_torchid(complained)
    assert line.endswith("estimator: unknown name 'rigde'; accepted: ridge")
    assert "torchid/commands" not in complained, "a traceback"


def test_a_mistake_that_all_see_is_told_once(tmp_path: Path) -> None:
    status, printed, complained = finish_forked(2, lambda: main([*MISTAKEN, f"output={tmp_path / 'run'}"]))
    assert status == 2
    assert_told_once(printed, complained)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def two_machines(tmp_path: Path) -> tuple[Path, Path]:
    """Folders in which two processes work, as machines without a common disk do."""
    return shortened_demo(tmp_path / "first", 100), shortened_demo(tmp_path / "second", 100)


def identified_on(machines: tuple[Path, Path]) -> tuple[int, str, str]:
    return finish_forked(2, lambda: main(["identify", "quadruped.yaml"]), machines)


def test_machines_need_no_common_disk(two_machines: tuple[Path, Path]) -> None:
    first, second = two_machines
    status, printed, complained = identified_on(two_machines)
    assert status == 0, complained
    assert printed.count("written to") == 1
    assert (first / "runs/quadruped/parameters.json").is_file()
    assert not (second / "runs").exists()


def test_a_mistake_that_one_process_meets_ends_all_at_once(two_machines: tuple[Path, Path]) -> None:
    first, second = two_machines
    (second / "sway_train.npz").unlink()
    status, _, complained = identified_on(two_machines)
    assert status != 0
    (line,) = lines_of_torchid(complained)
    assert "sway_train.npz" in line
    assert not (first / "runs").exists()


def test_machines_with_other_logs_are_told_apart(two_machines: tuple[Path, Path]) -> None:
    second = two_machines[1]
    with np.load(second / "sway_train.npz") as log:
        fields = {key: x if "names" in key else x[:-7] for key, x in log.items()}
    np.savez(second / "sway_train.npz", **fields)
    status, _, complained = identified_on(two_machines)
    assert status != 0
    (line,) = lines_of_torchid(complained)
    assert line == "torchid: logs: differs between processes; accepted: the same files and settings on every machine"


@pytest.mark.study
def test_an_evaluation_is_that_of_one_process(
    runs: dict[int, Path], experiments: dict[str, Path], tmp_path: Path
) -> None:
    log, documents = experiments["biped"].parent / "log1.npz", []
    for name, before in (("one", (sys.executable, "-m")), ("two", (*TWO, "-m", "--"))):
        shutil.copytree(runs[1] / "biped, consistent", tmp_path / name)
        status, _, complained = finish((*before, "torchid", "evaluate", str(tmp_path / name), "--log", str(log)))
        assert status == 0, complained
        documents.append(json.loads((tmp_path / name / "evaluation/log1/metrics.json").read_text()))
    for where, difference in differences(*documents):
        assert difference < 1e-10, where


def share_items(folder: Path) -> int:
    """What each of two processes does: shares items, one of which has something to say and one fails; writes what."""

    def work(item: int) -> list[int]:
        if item == 4:
            warnings.warn("four", UserWarning, stacklevel=1)
        return [60 // (item - 7), distributed.world_size(), os.getpid()]

    dist.init_process_group("gloo")
    number = dist.get_rank()
    with warnings.catch_warnings(record=True) as said, distributed.share_work():
        warnings.simplefilter("always")
        found = share_between_processes(range(1, 6), work, 1)
        distributed.all_gather(None, "the end")
    with pytest.raises(ZeroDivisionError), distributed.share_work():
        share_between_processes(range(6, 9), work, 1)
    document = {"found": found, "said": [str(one.message) for one in said], "process": os.getpid()}
    (folder / f"{number}.json").write_text(json.dumps(document))
    return 0


def test_processes_share_items_as_forks_would_and_the_first_alone_says_things(tmp_path: Path) -> None:
    status, _, complained = finish_forked(2, lambda: share_items(tmp_path))
    assert status == 0, complained
    first, second = (json.loads((tmp_path / f"{number}.json").read_text()) for number in range(2))
    one, other = first["process"], second["process"]
    assert first["found"] == second["found"]
    assert first["found"] == [[-10, 1, one], [-12, 1, other], [-15, 1, one], [-20, 1, one], [-30, 1, one]]
    assert (first["said"], second["said"]) == (["four"], [])


@pytest.mark.study
def test_torchrun_starts_again_where_a_training_was(runs: dict[int, Path], experiments: dict[str, Path]) -> None:
    """As `--resume`: the same bits as without the interruption."""
    folder: Path = runs[2].parent / "again"
    more = [*DESCENT, "estimator.training.checkpoint_seconds=0", f"output={folder / 'run'}"]
    command = [*TWO, "--max-restarts", "1", "-m", "torchid", "identify", str(experiments["quadruped"]), *more]
    with started(command) as process:
        until, workers = time.monotonic() + 60.0, []
        while time.monotonic() < until and not (folder / "run.training" / CHECKPOINT).is_file():
            time.sleep(0.01)
            workers = children(process)
        os.kill(workers[1], signal.SIGKILL)
        _, complained = process.communicate(timeout=60)
    assert process.returncode == 0, complained
    expected = json.loads((runs[2] / "quadruped, descent" / "parameters.json").read_text())
    assert json.loads((folder / "run/parameters.json").read_text()) == expected
    assert names_in(folder) == ["run"]
