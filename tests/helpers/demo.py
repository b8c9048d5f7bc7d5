"""The demo that ships with torchid, shortened."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from repository import DEMO

from torchid.config.experiment import ActuatorsConfig

FAST_ESTIMATOR = {"name": "least_squares", "ridge": 0.001}
"""Settings for short logs, of which no blocks can be left out, and for tests that no estimator matters to."""

NO_TERMS = ActuatorsConfig.without_terms()
"""Settings of actuators for tests that no terms matter to: looking for them takes more than half of a short fit."""
WITHOUT_TERMS = f"actuators={NO_TERMS}".replace("None", "null")
"""The same as an override."""
WITHOUT_TERMS_LINE = WITHOUT_TERMS.replace("=", ": ", 1) + "\n"
"""The same as a line of an experiment file."""


def shortened_demo(folder: Path, samples: int) -> Path:
    """The folder, with a copy of the demo whose logs have so many samples, fitted by least squares without terms."""
    shutil.copytree(DEMO, folder)
    file = folder / "quadruped.yaml"
    settings = [line for line in file.read_text().splitlines() if not line.startswith("estimator:")]
    file.write_text("\n".join([*settings, f"estimator: {FAST_ESTIMATOR}", WITHOUT_TERMS_LINE]))
    for name in ("sway_train", "sway_test"):
        with np.load(folder / f"{name}.npz") as log:
            short = {key: x if key in ("joint_names", "contact_names") else x[:samples] for key, x in log.items()}
        np.savez(folder / f"{name}.npz", **short)
    return folder
