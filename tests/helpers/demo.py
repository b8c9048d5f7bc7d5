"""The demo that ships with torchid, shortened."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from repository import DEMO

FAST_ESTIMATOR = {"name": "least_squares", "ridge": 0.001}
"""Settings for short logs, of which no blocks can be left out, and for tests that no estimator matters to."""


def shortened_demo(folder: Path, samples: int) -> Path:
    """The folder, with a copy of the demo whose logs have so many samples, fitted by least squares."""
    shutil.copytree(DEMO, folder)
    file = folder / "quadruped.yaml"
    settings = [line for line in file.read_text().splitlines() if not line.startswith("estimator:")]
    file.write_text("\n".join([*settings, f"estimator: {FAST_ESTIMATOR}"]) + "\n")
    for name in ("sway_train", "sway_test"):
        with np.load(folder / f"{name}.npz") as log:
            short = {key: x if key in ("joint_names", "contact_names") else x[:samples] for key, x in log.items()}
        np.savez(folder / f"{name}.npz", **short)
    return folder
