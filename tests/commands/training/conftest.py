"""A short training, whole and interrupted."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import NO_TERMS
from repository import DEMO
from tensorboard.summary.writer import event_file_writer
from trainings import (
    EPOCHS,
    EVERY,
    command,
    interrupt,
    stopped_in,
    training_of,
)

from torchid.cli import main


@pytest.fixture(scope="module", autouse=True)
def _event_files_in_order() -> Iterator[None]:
    """Event files of one second and one process sort by a number that is not padded, so that 10 comes before 9."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(1000))
        yield


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo shortened, with held-out samples, trained by mini-batches; a checkpoint after every epoch."""
    folder = tmp_path_factory.mktemp("training") / "experiment"
    folder.mkdir()
    shutil.copy(DEMO / "quadruped.urdf", folder)
    for name, log, part in (
        ("train", "sway_train", slice(0, 296)),
        ("held_out", "sway_train", slice(700, 800)),
        ("test", "sway_test", slice(0, 100)),
    ):
        with np.load(DEMO / f"{log}.npz") as file:
            fields = {key: x if key.endswith("names") else x[part] for key, x in file.items()}
        np.savez(folder / f"{name}.npz", **fields)
    settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
    settings["actuators"] = NO_TERMS
    settings["logs"] = {"train": ["train.npz"], "validation": ["held_out.npz"], "test": ["test.npz"]}
    training: dict[str, Any] = {"epochs": EPOCHS, "batch_size": 64, "evaluate_every": EVERY, "checkpoint_seconds": 0}
    training |= {"optimizer": {"name": "Adam", "lr": 0.05}, "schedule": {"name": "CosineAnnealingLR"}}
    settings["estimator"] = {"name": "sgd", "ridge": 0.001, "training": training}
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings))
    return folder


@pytest.fixture(scope="module")
def run(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the experiment, never interrupted."""
    output = tmp_path_factory.mktemp("runs") / "whole"
    assert main(["identify", str(experiment / "experiment.yaml"), f"output={output}"]) == 0
    return output


@pytest.fixture(scope="module")
def unfinished(experiment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What was left of a training that was interrupted in epoch 9."""
    output = tmp_path_factory.mktemp("interrupted") / "run"
    with pytest.MonkeyPatch.context() as monkeypatch:
        stopped_in(9, monkeypatch, interrupt())
        assert main(command(experiment, output)) == 1
    assert not output.exists()
    return training_of(output)


@pytest.fixture
def output(unfinished: Path, tmp_path: Path) -> Path:
    """A place for a run, with a copy of the unfinished training beside it."""
    output = tmp_path / "runs" / "run"
    shutil.copytree(unfinished, training_of(output))
    return output
