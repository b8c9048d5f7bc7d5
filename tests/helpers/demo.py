"""The demo that ships with torchid, shortened."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from repository import DEMO


def shortened_demo(folder: Path, samples: int) -> Path:
    """The folder, with a copy of the demo whose logs have so many samples."""
    shutil.copytree(DEMO, folder)
    for name in ("sway_train", "sway_test"):
        with np.load(folder / f"{name}.npz") as log:
            short = {key: x if key in ("joint_names", "contact_names") else x[:samples] for key, x in log.items()}
        np.savez(folder / f"{name}.npz", **short)
    return folder
