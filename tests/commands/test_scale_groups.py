"""Scales that motors of one type share, from files to files, through the commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from currents import HIP_SCALE, HIPS, NOISE, quadruped_files

from torchid.cli import main

EXACT = 1e-7
GROUPED = {"set": "joints", "noise": NOISE, "scales": {"joint_torque": [HIPS]}}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hips and thighs have motors whose constant is off, knees others that are right."""
    scales = dict.fromkeys(HIPS, HIP_SCALE)
    exact = {"name": "least_squares", "ridge": 0.0}
    return quadruped_files(tmp_path_factory.mktemp("currents"), scales, sensors=GROUPED, estimator=exact)[0]


def document(run: Path, name: str) -> dict[str, Any]:
    return dict(json.loads((run / f"{name}.json").read_text()))


def test_the_scale_of_a_type_of_motors_is_found_and_a_new_log_predicted_with_it(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = file.parent / "run"
    assert main(["identify", "--verbose", str(file)]) == 0
    (scale,) = document(run, "parameters")["extras"]
    assert (scale["label"], scale["log"], scale["told_apart"]) == ("scale of *_hip,*_thigh", None, True)
    assert scale["value"] == pytest.approx(HIP_SCALE - 1.0, rel=EXACT)
    metrics = document(run, "metrics")
    assert metrics["test"]["nullspace_rms"] < 1e-7
    assert metrics["test_nominal"]["nullspace_rms"] > 0.1
    printed = capsys.readouterr().out
    assert "scale of *_hip,*_thigh" in printed
    assert max(map(len, printed.splitlines())) <= 100
    assert main(["evaluate", str(run), "--log", str(file.parent / "new.npz")]) == 0
    (written,) = (run / "evaluation").rglob("metrics.json")
    assert json.loads(written.read_text())["new"]["identified"]["nullspace_rms"] < 1e-7
