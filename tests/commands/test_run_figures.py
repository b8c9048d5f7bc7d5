"""The figures that commands leave behind."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from matplotlib.image import imread
from run_figures import OF_A_RUN
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchid.cli import main


@pytest.mark.usefixtures("figures")
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_each_figure_of_a_run_and_of_an_evaluation_is_drawn(tmp_path: Path) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 120), tmp_path / "run"
    assert main(["identify", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    assert main(["evaluate", str(run), "--log", str(demo / "sway_test.npz")]) == 0
    (evaluation,) = (folder for folder in (run / "evaluation").iterdir() if folder.is_dir())
    of_log = (evaluation / f"{name}.png" for name in ("forces", "pressure", "errors"))
    for path in (*(run / f"{name}.png" for name in OF_A_RUN), *of_log):
        picture = np.rint(255.0 * imread(path)[..., :3])
        assert min(picture.shape[:2]) > 200
        assert len(np.unique(picture @ [65536.0, 256.0, 1.0])) > 5, "colours of lines, letters and their smooth edges"


_BEGINS = {"pdf": b"%PDF-1.", "svg": b"<?xml"}


@pytest.mark.usefixtures("figures")
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_figures_for_print_come_from_all_commands_and_tensorboard_keeps_its_pictures(tmp_path: Path) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 120), tmp_path / "run"
    log, experiment = demo / "sway_test.npz", str(demo / "quadruped.yaml")
    given = ["figures.format=pdf", "estimator.name=consistent"]
    assert main(["identify", experiment, f"output={run}", *given]) == 0
    assert main(["evaluate", str(run), "--log", str(log)]) == 0
    assert main(["replay", str(run), "--log", str(log), "--output", str(tmp_path / "replay")]) == 0
    assert main(["analyze", experiment, f"output={tmp_path / 'other'}", *given]) == 0
    written = list(tmp_path.rglob("*.pdf"))
    assert {path.stem for path in written} == {*OF_A_RUN, "drift", "sensors-logs", "accuracy"}
    assert len(written) == len(OF_A_RUN) + 6
    for path in written:
        assert path.read_bytes().startswith(_BEGINS["pdf"])
    assert not list(tmp_path.rglob("*.png"))
    pictures = EventAccumulator(str(run), size_guidance={"images": 0}).Reload()
    assert set(pictures.Tags()["images"]) == {f"figure_{number}_{name}" for number, name in enumerate(OF_A_RUN, 1)}
    (forces,) = pictures.Images("figure_1_forces")
    assert min(forces.height, forces.width) > 200
