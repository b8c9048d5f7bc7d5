"""Scales of motors of one type, and what a known mass fixes where the constants of all motors are off."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from arms import ARMS
from currents import HIP_SCALE, HIPS, KNEE_SCALE, KNEES, NOISE, quadruped_files
from refusals import refusal
from repository import SHARED
from run_folders import document
from synthetic import ROBOTS

from torchid.cli import main
from torchid.commands.identify import identify
from torchid.config import load_config
from torchid.errors import ConfoundedWarning
from torchid.estimators import LeastSquares
from torchid.fitting.prior_knowledge import KnownMass, with_known_masses
from torchid.identifiability.confounding import combination_standard_error, mass_weights
from torchid.parameters import PER_BODY
from torchid.problem import LinearProblem

SCALES = dict.fromkeys(HIPS, HIP_SCALE) | dict.fromkeys(KNEES, KNEE_SCALE)
SENSORS = {"set": "joints", "noise": NOISE, "scales": {"joint_torque": [HIPS, KNEES]}}
EXACT = {"name": "least_squares", "ridge": 0.0}
LABELS = ("scale of *_hip,*_thigh", "scale of *_knee")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, float]:
    """An experiment file of a robot of which each type of motor has an unknown constant, and its mass [kg]."""
    return quadruped_files(tmp_path_factory.mktemp("currents"), SCALES, 100, sensors=SENSORS, estimator=EXACT)


def scales_of(run: Path) -> dict[str, dict[str, Any]]:
    return {entry["label"]: entry for entry in document(run, "parameters")["extras"]}


@pytest.mark.parametrize(
    ("std", "more", "tolerance"),
    [
        (0.0, ("estimator.ridge=auto",), 1e-7),
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
        ("estimator={masses: {trunk: 3}, frozen: [trunk]}", "estimator.masses.trunk: a mass, but the body is frozen"),
        ("estimator={masses: {trunk: 3}, total_mass: 2}", "estimator.total_mass: 2 kg, but trunk alone weigh 3 kg"),
        (
            "estimator={name: consistent, masses: {trunk: 3}, bounds: {trunk: {m: [1, 4]}}}",
            "estimator.masses.trunk: a mass, but estimator.bounds.trunk.m is also set; accepted: one of the two",
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
            "train": [f"{SHARED / 'go2_standing' / 'log.npz'}[5:15]"],
            "columns": {"joint_torque": "torque_estimate", "contact_active": {"always": feet}},
        },
        "preprocessing": {"cutoff_hz": 4, "base_motion": "contacts"},
        "sensors": {"set": "joints", "scales": {"joint_torque": [["*_hip_joint", "*_thigh_joint"], "*_calf_joint"]}},
        "estimator": {"ridge": 0.001, "total_mass": {"value": 15.2, "std": 0.05}},
        "output": str(tmp_path / "run"),
    }
    (tmp_path / "go2.yaml").write_text(yaml.safe_dump(experiment))
    message = refusal(["identify", str(tmp_path / "go2.yaml")], tmp_path, capsys)
    assert "sensors.scales: the data do not determine scales of all measured forces: scale of *_hip_joint" in message
    assert "accepted: a sensor without a scale, or logs in which each contact lifts" in message


@pytest.mark.filterwarnings("ignore:identified.urdf")
def test_without_it_they_are_confounded_and_of_the_size_that_the_urdf_s_mass_makes_them(
    world: tuple[Path, float], tmp_path: Path
) -> None:
    file, mass = world
    with pytest.warns(ConfoundedWarning) as caught:
        identify(load_config(file, [f"output={tmp_path / 'run'}"]))
    (message,) = (str(x.message) for x in caught if issubclass(x.category, ConfoundedWarning))
    said = "scale of *_hip,*_thigh, *_knee: confounded with the total mass; do not trust either; state estimator."
    assert said in message
    (confounded,) = document(tmp_path / "run", "metrics")["confounded"]
    assert (confounded["extras"], confounded["confounded_with"]) == (list(LABELS), ["total mass"])
    assert said in confounded["message"]
    assert not any(entry["told_apart"] for entry in scales_of(tmp_path / "run").values())
    assert all(entry["standard_error"] is None for entry in scales_of(tmp_path / "run").values())
    assert document(tmp_path / "run", "metrics")["total_mass"] is None
    values = [1.0 + scales_of(tmp_path / "run")[label]["value"] for label in LABELS]
    urdf = document(tmp_path / "run", "metrics")["total_mass_nominal"]
    assert values == pytest.approx([HIP_SCALE * urdf / mass, KNEE_SCALE * urdf / mass], rel=1e-7)


@pytest.mark.filterwarnings("ignore:identified.urdf")
def test_scales_of_all_motors_of_a_bolted_robot_are_refused_without_a_word_of_contacts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "arms.urdf").write_text(ARMS)
    time = np.arange(2000) / 100.0
    position = np.stack([np.sin(2.0 * time) + 0.3 * np.sin(5.0 * time), np.cos(3.0 * time)], axis=1)
    torque = np.stack([9.81 * np.cos(position[:, 0]), position[:, 1]], axis=1)
    log = {"time": time, "joint_names": ["first", "second"], "joint_position": position, "joint_torque": torque}
    np.savez(tmp_path / "log.npz", **log)
    experiment = {
        "robot": {"urdf": "arms.urdf", "fixed_base": True},
        "logs": {"train": ["log.npz"]},
        "preprocessing": {"cutoff_hz": 10},
        "sensors": {"set": "joints", "scales": {"joint_torque": "all"}},
        "output": str(tmp_path / "run"),
    }
    (tmp_path / "arms.yaml").write_text(yaml.safe_dump(experiment))
    message = refusal(["identify", str(tmp_path / "arms.yaml")], tmp_path, capsys)
    assert "sensors.scales: the data do not determine scales of all measured forces" in message
    assert "accepted: a sensor without a scale, or known estimator.masses that load it" in message


def test_exact_masses_hold_whatever_the_data_say_and_uncertain_ones_are_weighed() -> None:
    """Against the optimum with a Lagrange multiplier, and against rows of their own."""
    rng, count = np.random.default_rng(0), 3 * PER_BODY
    A, b = rng.normal(size=(2 * count, count)), rng.normal(size=2 * count)
    nominal, scale = rng.uniform(0.5, 1.0, count), rng.uniform(0.5, 2.0, count)
    free = np.ones(count, dtype=bool)
    free[PER_BODY : 2 * PER_BODY] = False
    problem = LinearProblem(A, b, 0.0, 2 * count, nominal, scale, free)
    total, one = mass_weights(3), mass_weights(3) * (np.arange(count) == 0)
    exact = KnownMass("a", total, 7.0), KnownMass("b", one, 2.5)
    found = LeastSquares().solve(with_known_masses(problem, exact)).phi
    E = np.array([total, one])[:, free]
    known = np.array([7.0, 2.5]) - np.array([total, one])[:, ~free] @ nominal[~free]
    left = b - A[:, ~free] @ nominal[~free]
    H = np.block([[A[:, free].T @ A[:, free], E.T], [E, np.zeros((2, 2))]])
    expected = np.linalg.solve(H, np.append(A[:, free].T @ left, known))[: free.sum()]
    np.testing.assert_allclose(found[free], expected, rtol=1e-9)
    assert np.array_equal(found[~free], nominal[~free])
    uncertain = with_known_masses(problem, [KnownMass("a", total, 7.0, 0.2)], 1.5)
    rows = np.vstack([A, 1.5 / 0.2 * total])
    expected = np.linalg.lstsq(rows[:, free], np.append(left, 7.5 * (7.0 - total[~free] @ nominal[~free])))[0]
    np.testing.assert_allclose(LeastSquares().solve(uncertain).phi[free], expected, rtol=1e-9)


def test_a_known_mass_is_as_well_known_where_other_rows_are_mostly_noise_of_the_motion() -> None:
    rng, count = np.random.default_rng(0), 3 * PER_BODY
    A, b = rng.normal(size=(2 * count, count)), rng.normal(size=2 * count)
    problem = LinearProblem(A, b, 0.0, 2 * count, np.ones(count), np.ones(count), np.ones(count, dtype=bool))
    lacking, total = replace(problem, shrinkage=0.5 * A), mass_weights(3)
    known = [with_known_masses(x, [KnownMass("a", total, 7.0)]) for x in (problem, lacking)]
    errors = [combination_standard_error(x, LeastSquares().solve(x), total) for x in (problem, lacking, *known)]
    assert errors[1] > 2.0 * errors[0]
    assert errors[3] == pytest.approx(errors[2], rel=1e-9), "the row of the mass lacks nothing"


# ------------------------------------------------------------------------------------------- one type of motor alone


@pytest.fixture(scope="module")
def grouped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hips and thighs have motors whose constant is off, knees others that are right."""
    scales = dict.fromkeys(HIPS, HIP_SCALE)
    return quadruped_files(
        tmp_path_factory.mktemp("currents"),
        scales,
        100,
        sensors=SENSORS | {"scales": {"joint_torque": [HIPS]}},
        estimator=EXACT,
    )[0]


def test_the_scale_of_a_type_of_motors_is_found_and_a_new_log_predicted_with_it(
    grouped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = grouped.parent / "run"
    assert main(["identify", "--verbose", str(grouped)]) == 0
    (scale,) = document(run, "parameters")["extras"]
    assert (scale["label"], scale["log"], scale["told_apart"]) == ("scale of *_hip,*_thigh", None, True)
    assert scale["value"] == pytest.approx(HIP_SCALE - 1.0, rel=1e-7)
    metrics = document(run, "metrics")
    assert metrics["test"]["nullspace_rms"] < 1e-7
    assert metrics["test_nominal"]["nullspace_rms"] > 0.1
    printed = capsys.readouterr().out
    assert "scale of *_hip,*_thigh" in printed
    assert max(map(len, printed.splitlines())) <= 100
    assert main(["evaluate", str(run), "--log", str(grouped.parent / "new.npz")]) == 0
    (written,) = (run / "evaluation").rglob("metrics.json")
    assert json.loads(written.read_text())["new"]["identified"]["nullspace_rms"] < 1e-7
