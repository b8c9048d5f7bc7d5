"""Errors of a run against the noise that its sensors leave: in the table, metrics.json and the figure of forces."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from demo import shortened_demo

from torchid.cli import main

UNPHYSICAL = pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning")


def floors(run: Path) -> dict[str, dict[str, float]]:
    found: dict[str, dict[str, float]] = json.loads((run / "metrics.json").read_text())["noise_floor"]
    return found


@UNPHYSICAL
def test_a_run_gives_the_noise_beside_its_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 400), tmp_path / "run"
    assert main(["identify", "--verbose", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    found, printed = floors(run), capsys.readouterr().out
    assert 0.06 < found["test"]["joint_torque"] < 0.08  # 0.1 N m and 0.5 N at 0.3 m, of which the filter leaves 0.38
    assert found["train"]["projected_residual"] == pytest.approx(0.38, abs=0.01)
    for value in (found["train"]["base_force"], found["test"]["base_moment"]):
        assert f"{value:.4g}" in printed
    assert printed.count("│   noise alone") == 4
    assert main(["evaluate", str(run), "--log", str(demo / "sway_test.npz")]) == 0
    evaluated = json.loads((run / "evaluation/sway_test/metrics.json").read_text())["sway_test"]
    assert evaluated["noise_floor"] == pytest.approx(found["test"], rel=1e-9)


@UNPHYSICAL
def test_noise_that_residuals_show_is_no_measure_of_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo, run = shortened_demo(tmp_path / "demo", 400), tmp_path / "run"
    text = (demo / "quadruped.yaml").read_text()
    stated = "noise: {joint_torque: 0.1, contact_force: 0.5, contact_moment: 0.05}"
    assert stated in text
    (demo / "quadruped.yaml").write_text(text.replace(stated, "noise: {}"))
    assert main(["identify", "--verbose", str(demo / "quadruped.yaml"), f"output={run}"]) == 0
    assert floors(run) == {"train": {}, "test": {}}
    assert main(["evaluate", str(run), "--log", str(demo / "sway_test.npz")]) == 0
    assert "│   noise alone" not in capsys.readouterr().out
