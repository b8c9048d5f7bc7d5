"""`torchid evaluate --output` writes an evaluation elsewhere, and refuses what `replay` and `export` refuse."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from demo import shortened_demo
from refusals import files_in

from torchid.cli import main
from torchid.commands.folder import EVALUATION, read_manifest


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, and the log that it is evaluated on."""
    folder = shortened_demo(tmp_path_factory.mktemp("evaluated") / "demo", 200)
    assert main(["identify", str(folder / "quadruped.yaml"), f"output={folder / 'run'}"]) == 0
    return folder


def evaluating(folder: Path, *more: str) -> list[str]:
    return ["evaluate", str(folder / "run"), "--log", str(folder / "sway_test.npz"), *more]


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_an_evaluation_elsewhere_is_the_same_and_leaves_the_run_as_it_was(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, output = files_in(folder / "run"), tmp_path / "evaluated"
    assert main(evaluating(folder, "--output", str(output))) == 0
    assert f"written to    {output}" in capsys.readouterr().out
    assert files_in(folder / "run") == before
    kind = read_manifest(output)
    assert kind is not None
    assert kind.kind == EVALUATION.name
    assert main(evaluating(folder)) == 0
    (usual,) = (path for path in (folder / "run" / "evaluation").iterdir() if path.is_dir())
    assert {file.name for file in usual.iterdir()} == {file.name for file in output.iterdir()}
    assert json.loads((usual / "metrics.json").read_text()) == json.loads((output / "metrics.json").read_text())
