"""Run folders of strangers: hand-edited parameters and settings."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from hostile import examined, judged
from hostile_runs import parameter_files
from hostile_settings import DOCUMENTS

from torchid.cli import main
from torchid.report.parameter_files import read_parameters
from torchid.robot import load_robot


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short demo and its finished run."""
    folder = tmp_path_factory.mktemp("place")
    demo = shortened_demo(folder / "demo", 120)
    assert main(["identify", str(demo / "quadruped.yaml"), f"output={folder / 'run'}"]) == 0
    return folder


def evaluation(place: Path) -> list[str]:
    return ["evaluate", str(place / "run"), "--log", str(place / "demo" / "sway_test.npz")]


def test_parameters_edited_by_hand_are_finite_or_refused(place: Path) -> None:
    robot = load_robot(place / "demo" / "quadruped.urdf")

    def read(path: Path) -> None:
        assert np.isfinite(read_parameters(path, robot)).all()

    cases = parameter_files(place / "run" / "parameters.json", 40, seed=8)
    tally = examined("parameters.json", cases, read, place)
    assert tally.faults == []
    assert tally.share("refused") > 0.8


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_run_with_parameters_edited_by_hand_is_evaluated_or_refused(place: Path) -> None:
    cases = islice(parameter_files(place / "run" / "parameters.json", 40, seed=9), 0, None, 12)
    may_write = [place / "run" / "evaluation"]
    tally = examined("runs, edited by hand", cases, lambda _: main(evaluation(place)), place, may_write)
    assert tally.faults == []
    assert tally.share("refused") > 0.6


def test_a_run_with_hostile_settings_is_refused(place: Path) -> None:
    config = place / "run" / "config.yaml"
    whole = config.read_text()

    def cases() -> Iterator[tuple[str, Path]]:
        for name, content in islice(DOCUMENTS.items(), 0, None, 8):
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
