"""Experiment files as mappings."""

from __future__ import annotations

from typing import Any

LEAST: dict[str, Any] = {
    "robot": {"urdf": "robot.urdf"}, "logs": {"train": ["a.npz"]}, "sensors": "full", "output": "out",
}  # fmt: skip
