"""A mass that a scale has told fixes what torques alone leave open: by how much all their constants are off."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from currents import HIP_SCALE, HIPS, KNEE_SCALE, KNEES, NOISE, quadruped_files
from refusals import refusal
from repository import SHARED
from synthetic import ROBOTS

from torchid.cli import main

SCALES = dict.fromkeys(HIPS, HIP_SCALE) | dict.fromkeys(KNEES, KNEE_SCALE)
SENSORS = {"set": "joints", "noise": NOISE, "scales": {"joint_torque": [HIPS, KNEES]}}
EXACT = {"name": "least_squares", "ridge": 0.0}
LABELS = ("scale of *_hip,*_thigh", "scale of *_knee")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """An experiment file of a robot of which each type of motor has an unknown constant, and its mass [kg]."""
    return quadruped_files(tmp_path_factory.mktemp("currents"), SCALES, sensors=SENSORS, estimator=EXACT)


def document(run: Path, name: str) -> dict[str, Any]:
    return dict(json.loads((run / f"{name}.json").read_text()))


def scales_of(run: Path) -> dict[str, dict[str, Any]]:
    return {entry["label"]: entry for entry in document(run, "parameters")["extras"]}


@pytest.mark.parametrize(
    ("std", "more", "tolerance"),
    [
        (0.0, ("estimator.ridge=auto",), 1e-7),
        # 1.4e-3: the ridge holds all other parameters near the URDF
        pytest.param(0.0, ("estimator.ridge=1e-3",), 3e-3, marks=pytest.mark.slow),
        pytest.param(0.05, (), 1e-7, marks=pytest.mark.slow),
        (0.05, ("estimator.name=consistent", "estimator.ridge=1e-6"), 2e-4),
    ],
)
def test_a_known_total_mass_gives_the_scales_of_all_motors(
    world: tuple[Path, float], tmp_path: Path, std: float, more: tuple[str, ...], tolerance: float
) -> None:
    file, mass = world
    known = f"estimator.total_mass={{value: {mass!r}, std: {std}}}"
    assert main(["identify", str(file), known, f"output={tmp_path / 'run'}", *more]) == 0
    found = scales_of(tmp_path / "run")
    values = [found[label]["value"] for label in LABELS]
    assert values == pytest.approx([HIP_SCALE - 1.0, KNEE_SCALE - 1.0], abs=tolerance)
    assert all(found[label]["standard_error"] is not None for label in LABELS)
    assert all(found[label]["told_apart"] for label in LABELS)
    metrics = document(tmp_path / "run", "metrics")
    assert metrics["confounded"] == []
    assert metrics["total_mass"] == pytest.approx(mass, rel=1e-7 if not std else 1e-4)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("estimator.total_mass=heavy", "estimator.total_mass.value: found 'heavy'; accepted: a number"),
        ("estimator.total_mass=-1", "estimator.total_mass"),
        ("estimator.total_mass={value: 12, std: -1}", "estimator.total_mass.std"),
        ("estimator.masses={trnk: 3}", "estimator.masses: unknown name 'trnk'; accepted: trunk"),
        ("estimator={masses: {trunk: 3}, frozen: [trunk]}", "estimator.masses.trunk: a mass of a body that is frozen"),
        ("estimator={masses: {trunk: 3}, total_mass: 2}", "estimator.total_mass: 2 kg, of which trunk alone are 3 kg"),
        (
            "estimator={name: consistent, masses: {trunk: 3}, bounds: {trunk: {m: [1, 4]}}}",
            "estimator.masses.trunk: a mass, beside estimator.bounds.trunk.m; accepted: one of the two",
        ),
    ],
)
def test_a_mass_that_cannot_be_is_refused_in_one_line(
    world: tuple[Path, float], tmp_path: Path, capsys: pytest.CaptureFixture[str], more: str, message: str
) -> None:
    file, _ = world
    scales = () if "sgd" not in more else ("sensors={scales: {}}",)
    command = ["identify", str(file), more, f"output={tmp_path / 'run'}", *scales]
    assert message in refusal(command, file.parent, capsys)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the recorded logs (../shared/data) are not here")
def test_a_recorded_robot_that_stands_on_all_feet_is_refused_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No torques, and all mass at the feet, fit torques best that the model does not explain."""
    feet = [f"{end}{side}_foot" for end in "FR" for side in "LR"]
    experiment = {
        "robot": {"urdf": str(ROBOTS / "go2_description/urdf/go2.urdf")},
        "contacts": [{"frame": foot, "type": "point", "radius": 0.022} for foot in feet],
        "logs": {
            "train": [f"{SHARED / 'go2_standing' / 'log.npz'}[5:50]"],
            "columns": {"joint_torque": "torque_estimate", "contact_active": {"always": feet}},
        },
        "preprocessing": {"cutoff_hz": 4, "base_motion": "contacts"},
        "sensors": {"set": "joints", "scales": {"joint_torque": [["*_hip_joint", "*_thigh_joint"], "*_calf_joint"]}},
        "estimator": {"ridge": 0.001, "total_mass": {"value": 15.2, "std": 0.05}},
        "output": str(tmp_path / "run"),
    }
    (tmp_path / "go2.yaml").write_text(yaml.safe_dump(experiment))
    message = refusal(["identify", str(tmp_path / "go2.yaml")], tmp_path, capsys)
    assert "sensors.scales: of all measured forces, which no mass determines here: scale of *_hip_joint" in message
    assert "accepted: a sensor without a scale, or logs in which each contact lifts" in message
