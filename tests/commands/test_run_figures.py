"""The figures that commands leave behind."""

from __future__ import annotations

from pathlib import Path

import pytest
from demo import shortened_demo
from run_figures import OF_A_RUN
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchid.cli import main


@pytest.mark.slow("every figure of four commands")
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
    assert {path.stem for path in written} == {*OF_A_RUN, "drift", "sensors-logs"}
    assert len(written) == len(OF_A_RUN) + 6
    for path in written:
        assert path.read_bytes().startswith(b"%PDF-1.")
    assert not list(tmp_path.rglob("*.png"))
    pictures = EventAccumulator(str(run), size_guidance={"images": 0}).Reload()
    assert set(pictures.Tags()["images"]) == {f"figure_{number}_{name}" for number, name in enumerate(OF_A_RUN, 1)}
    (forces,) = pictures.Images("figure_1_forces")
    assert min(forces.height, forces.width) > 200
