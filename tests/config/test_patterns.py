"""Patterns in the names of logs: all files that match, in one order, and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from torchid.config import load_config
from torchid.config.experiment import LogsConfig
from torchid.errors import ConfigError

NAMES = ("walk_1.npz", "walk_2.npz", "walk_10.npz", "squat.npz", "notes.txt")


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in NAMES:
        (folder / name).touch()
    return folder


def load(logs: Path, *overrides: str, **named: Any) -> LogsConfig:
    """Logs of an experiment file beside their folder."""
    file = logs.parent / "experiment.yaml"
    settings = {"robot": {"urdf": "r.urdf"}, "logs": {"train": ["a.npz"]} | named, "sensors": "full", "output": "out"}
    file.write_text(yaml.safe_dump(settings))
    return load_config(file, overrides).logs


def names(paths: list[Path]) -> list[str]:
    return [path.name for path in paths]


def test_a_star_stands_for_any_characters_and_a_question_mark_for_one(logs: Path) -> None:
    assert names(load(logs, train=["logs/walk_*.npz"]).train) == ["walk_1.npz", "walk_10.npz", "walk_2.npz"]
    assert names(load(logs, train=["logs/walk_?.npz"]).train) == ["walk_1.npz", "walk_2.npz"]
    assert load(logs, train=["logs/*.npz"]).train == sorted(logs.glob("*.npz"))


def test_patterns_and_names_keep_their_order(logs: Path) -> None:
    found = load(logs, train=["logs/squat.npz", "logs/walk_?.npz", "b.npz"], test=["logs/walk_1?.npz"])
    assert names(found.train) == ["squat.npz", "walk_1.npz", "walk_2.npz", "b.npz"]
    assert names(found.test) == ["walk_10.npz"]


def test_a_pattern_without_a_match_is_refused_by_its_place(logs: Path) -> None:
    for named, place in (({"train": ["logs/run_*.npz"]}, "train"), ({"test": ["logs/run_*.npz"]}, "test")):
        with pytest.raises(ConfigError) as raised:
            load(logs, **named)
        line = str(raised.value)
        assert line.startswith(
            f"{logs.parent / 'experiment.yaml'}: logs.{place}: no file matches {logs / 'run_*.npz'}; "
        )
        assert "accepted: an existing log, or a matching pattern" in line
