"""Run folders of strangers: hand-edited parameters and settings, checkpoints that are none."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch
from demo import shortened_demo
from hostile import examined, judged
from hostile_runs import checkpoints, parameter_files
from hostile_settings import DOCUMENTS

from torchid.cli import main
from torchid.commands.checkpoint import CHECKPOINT, load_checkpoint
from torchid.estimators.sgd import require_same_structure
from torchid.report.parameter_files import read_parameters
from torchid.robot import load_robot

SGD = "estimator={name: sgd, ridge: 0.001, training: {epochs: 2}}"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short demo, its finished run, and a training that was interrupted when it was done."""
    folder = tmp_path_factory.mktemp("place")
    demo = shortened_demo(folder / "demo", 120)
    assert main(["identify", str(demo / "quadruped.yaml"), f"output={folder / 'run'}"]) == 0
    with pytest.MonkeyPatch.context() as stopped:
        stopped.setattr("torchid.commands.results.write_json", lambda *_: signal.raise_signal(signal.SIGINT))
        assert main(["identify", str(demo / "quadruped.yaml"), f"output={folder / 'sgd'}", SGD]) == 1
    return folder


def evaluation(place: Path) -> list[str]:
    return ["evaluate", str(place / "run"), "--log", str(place / "demo" / "sway_test.npz")]


@pytest.mark.parametrize(("count", "share"), [(40, 2), pytest.param(400, 1, marks=pytest.mark.slow)])
def test_parameters_edited_by_hand_are_finite_or_refused(place: Path, count: int, share: int) -> None:
    robot = load_robot(place / "demo" / "quadruped.urdf")

    def read(path: Path) -> None:
        assert np.isfinite(read_parameters(path, robot)).all()

    cases = islice(parameter_files(place / "run" / "parameters.json", count, seed=8), 0, None, share)
    tally = examined("parameters.json", cases, read, place)
    assert tally.faults == []
    assert tally.share("refused") > 0.8


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("share", [20, pytest.param(5, marks=pytest.mark.slow)])
def test_a_run_with_parameters_edited_by_hand_is_evaluated_or_refused(place: Path, share: int) -> None:
    cases = islice(parameter_files(place / "run" / "parameters.json", 40, seed=9), 0, None, share)
    may_write = [place / "run" / "evaluation"]
    tally = examined("runs, edited by hand", cases, lambda _: main(evaluation(place)), place, may_write)
    assert tally.faults == []
    assert tally.share("refused") > 0.6


@pytest.mark.parametrize("share", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_a_run_with_hostile_settings_is_refused(place: Path, share: int) -> None:
    config = place / "run" / "config.yaml"
    whole = config.read_text()

    def cases() -> Iterator[tuple[str, Path]]:
        for name, content in islice(DOCUMENTS.items(), 0, None, share):
            config.write_bytes(content if isinstance(content, bytes) else content.encode())
            yield name, config
        config.write_text(whole)

    tally = examined("config.yaml of runs", cases(), lambda _: main(evaluation(place)), place)
    assert tally.faults == []
    assert tally.share("refused") == 1.0


@pytest.mark.parametrize("name", ["..npz", "...npz", "....npz"])
def test_an_evaluation_never_takes_the_place_of_its_run(place: Path, name: str) -> None:
    """The folder of `...npz` would be the run's `evaluation/..`."""
    shutil.copy(place / "demo" / "sway_test.npz", place / name)
    arguments = ["evaluate", str(place / "run"), "--log", str(place / name)]
    verdict = judged(name, lambda: main(arguments), place, [place / "run" / "evaluation"])
    (place / name).unlink()
    assert not verdict.faults
    assert (place / "run" / "parameters.json").is_file()
    assert verdict.outcome == ("accepted" if name == "....npz" else "refused")


@pytest.mark.parametrize(("count", "share"), [(20, 61), pytest.param(400, 1, marks=pytest.mark.slow)])
def test_checkpoints_are_tensors_and_plain_types_or_refused(place: Path, count: int, share: int) -> None:
    def load(path: Path) -> None:
        assert isinstance(load_checkpoint(path.parent), dict)

    tally = examined("checkpoints", checkpoints(place / "sgd.training" / CHECKPOINT, count, 10, share), load, place)
    assert tally.faults == []
    assert tally.share("refused") > 0.2


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
@pytest.mark.parametrize("share", [401, pytest.param(19, marks=pytest.mark.slow)])
def test_a_training_goes_on_from_its_own_state_alone(place: Path, tmp_path: Path, share: int) -> None:
    """A state with something else in one place is refused, or makes no difference."""
    kept = tmp_path / "kept"
    shutil.copytree(place / "sgd.training", kept)
    arguments = ["identify", str(place / "demo" / "quadruped.yaml"), f"output={place / 'sgd'}", SGD, "--resume"]

    def cases() -> Iterator[tuple[str, Path]]:
        for case in islice(checkpoints(place / "sgd.training" / CHECKPOINT, 0, 11, share), 29, None):
            yield case
            for left in ("sgd", "sgd.training"):
                shutil.rmtree(place / left, ignore_errors=True)
            shutil.copytree(kept, place / "sgd.training")

    may_write = [place / "sgd", place / "sgd.training", place / ".sgd"]
    tally = examined("resumed trainings", cases(), lambda _: main(arguments), place, may_write)
    assert tally.faults == []
    assert tally.share("refused") > 0.3


def test_states_are_alike_if_they_are_made_of_the_same() -> None:
    one = {"x": torch.zeros(3), "n": 2, "t": [1.0, 2.0], "empty": {}, "none": None}
    require_same_structure(
        {"x": torch.ones(3), "n": 5.0, "t": [3, 4.0], "empty": {0: {"s": 1}}, "none": None, "more": 1}, one
    )
    for key, value in (
        ("x", torch.zeros(4)),
        ("x", torch.zeros(3, dtype=torch.int64)),
        ("n", "2"),
        ("t", [1.0]),
        ("n", float("nan")),
        ("empty", {0: 1}),
    ):
        with pytest.raises(ValueError, match=rf"state\.{key}.* has the wrong"):
            require_same_structure(one | {key: value}, one)
