"""The file of an experiment."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "experiments" / "experiment.yaml"
    path.parent.mkdir()
    return path
