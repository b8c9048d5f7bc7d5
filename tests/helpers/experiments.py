"""Experiment files as mappings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from torchid.config import ExperimentConfig, load_config

LEAST: dict[str, Any] = {
    "robot": {"urdf": "robot.urdf"}, "logs": {"train": ["a.npz"]}, "sensors": "full", "output": "out",
}  # fmt: skip


def load(file: Path, settings: Any, *overrides: str) -> ExperimentConfig:
    file.write_text(settings if isinstance(settings, str) else yaml.safe_dump(settings))
    return load_config(file, overrides)


def changed(**changes: Any) -> dict[str, Any]:
    return LEAST | changes
