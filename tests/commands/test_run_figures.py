"""The figures that commands leave behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from matplotlib.image import imread

from torchid.cli import main

_RUN = ("forces", "errors", "parameters", "identifiability", "contributions")


@pytest.mark.usefixtures("figures")
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_each_figure_of_a_run_and_of_an_evaluation_is_drawn(tmp_path: Path) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 300), tmp_path / "run"
    assert main(["identify", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    assert main(["evaluate", str(run), "--log", str(demo / "sway_test.npz")]) == 0
    (evaluation,) = (folder for folder in (run / "evaluation").iterdir() if folder.is_dir())
    for path in (*(run / f"{name}.png" for name in _RUN), evaluation / "forces.png", evaluation / "errors.png"):
        picture = imread(path)[..., :3]
        assert min(picture.shape[:2]) > 200
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 5, "lines, letters and their smooth edges"
