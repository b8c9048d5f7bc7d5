"""Scales that motors of one type share, from files to files, through the commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from currents import HIP_SCALE, HIPS, KNEES, NOISE, quadruped_files

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


def compressed(file: Path, folder: Path) -> list[str]:
    """Factors of the logs that train."""
    assert main(["compress", str(file), "--output", str(folder / "factors")]) == 0
    return sorted(map(str, (folder / "factors").rglob("*.factor")))


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


def test_factors_and_large_logs_have_it_as_well(file: Path, tmp_path: Path) -> None:
    found = {}
    assert main(["identify", str(file), f"output={tmp_path / 'blocks'}", "preprocessing.memory_gb=0.0001"]) == 0
    files = compressed(file, tmp_path)
    assert len(files) == 2
    more = (f"logs.train={json.dumps(files)}",)
    assert main(["identify", str(file), f"output={tmp_path / 'factored'}", *more]) == 0
    for name in ("blocks", "factored"):
        (scale,) = document(tmp_path / name, "parameters")["extras"]
        found[name] = scale["value"]
    assert found == pytest.approx(dict.fromkeys(found, HIP_SCALE - 1.0), rel=EXACT)


def test_factors_of_other_groups_are_refused(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = compressed(file, tmp_path)
    capsys.readouterr()
    groups = json.dumps({"joint_torque": [KNEES]})
    more = f"logs.train={json.dumps(files)}", f"sensors.scales={groups}", f"output={tmp_path / 'run'}"
    assert main(["identify", str(file), *more]) == 2
    found = "sensors.scales: without scale of *_knee, of all logs and with scale of *_hip,*_thigh, of all logs"
    assert found in capsys.readouterr().err


def test_a_sensor_set_is_analyzed_with_its_scales(file: Path, tmp_path: Path) -> None:
    analysis = json.dumps({"scenarios": {"stand": [["front_left_foot"]]}})
    assert main(["analyze", str(file), f"analysis={analysis}", f"output={tmp_path / 'run'}"]) == 0
    accuracy = json.loads((tmp_path / "run.analysis" / "analysis.json").read_text())["accuracy"]
    assert max(x for x in accuracy["proposed"]["measured"].values() if x is not None) < 1e-6, accuracy
