"""Recordings of force plates through the commands: the fit is that of wrenches at the feet."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import NO_TERMS
from large import SMALL
from motions import value
from plates import LABORATORIES, walk, write_motion
from refusals import refusal
from repository import SHARED
from simulated import BIPED, feet_of

from torchid.cli import main
from torchid.logs import Log, read_log, write_log

MOTION = "motion.npz + plates.csv"


def experiment(folder: Path, log: str, columns: str | None = None, **preprocessing: Any) -> Path:
    """An experiment file that fits all sensors to one part of a log and tests on the other."""
    settings = {
        "robot": {"urdf": str(BIPED)},
        "contacts": [{"frame": "l_sole", "type": "flat"}, {"frame": "r_sole", "type": "flat"}],
        "logs": {"train": [f"{log}[0:1.2]"], "test": [f"{log}[1.2:]"]}
        | ({"columns": yaml.safe_load(columns)} if columns else {}),
        "sensors": "full",
        "actuators": NO_TERMS,
        "estimator": {"name": "least_squares", "ridge": 1e-3},
        "preprocessing": preprocessing,
        "output": str(folder / "run"),
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings, sort_keys=False))
    return folder / "experiment.yaml"


def identified(file: Path, *overrides: str) -> tuple[np.ndarray, dict[str, float]]:
    """Every identified parameter, and errors on the test log."""
    assert main(["identify", str(file), "overwrite=true", *overrides]) == 0
    run = file.parent / "run"
    bodies = json.loads((run / "parameters.json").read_text())["bodies"]
    test = json.loads((run / "metrics.json").read_text())["test"]
    errors = {name: x for name, x in test.items() if isinstance(x, float)}
    return np.array([x for body in bodies for x in body["identified"].values()]), errors


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, dict[str, float]]:
    """What wrenches at the soles give."""
    folder = tmp_path_factory.mktemp("soles")
    write_log(walk(2.0), folder / "walk.npz")
    return identified(experiment(folder, "walk.npz"))


def recorded(folder: Path, laboratory: str, log: Log) -> str:
    """Files of a motion and of plates, and the map of these."""
    write, text = LABORATORIES[laboratory]
    write_motion(folder / "motion.npz", log)
    write(folder / "plates.csv", log)
    return text


@pytest.mark.parametrize("laboratory", ["plates", "OpenSim"])
def test_a_fit_to_plates_is_that_to_wrenches_at_the_soles(
    laboratory: str, tmp_path: Path, expected: tuple[np.ndarray, dict[str, float]]
) -> None:
    text = recorded(tmp_path, laboratory, walk(2.0))
    parameters, errors = identified(experiment(tmp_path, MOTION, text))
    assert np.abs(parameters - expected[0]).max() < 1e-9 * np.abs(expected[0]).max()
    assert errors == pytest.approx(expected[1], rel=1e-9)


@pytest.mark.slow("four fits")
def test_a_converted_log_is_fitted_block_by_block_compressed_checked_and_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], expected: tuple[np.ndarray, dict[str, float]]
) -> None:
    text = recorded(tmp_path, "plates", walk(2.0))
    file, log = experiment(tmp_path, "walk.parquet", text), str(tmp_path / "walk.parquet")
    assert main(["convert", str(tmp_path / MOTION), log, "--columns", str(file)]) == 0
    parameters, _ = identified(file, SMALL)
    assert np.abs(parameters - expected[0]).max() < 1e-9 * np.abs(expected[0]).max()
    assert main(["compress", str(file), "--output", str(tmp_path / "factors")]) == 0
    factor = str(tmp_path / "factors" / "walk[0:1.2].factor")
    of_factor, _ = identified(file, f"logs.train=['{factor}']")
    assert np.abs(of_factor - parameters).max() < 1e-9 * np.abs(parameters).max()
    assert main(["evaluate", str(tmp_path / "run"), "--log", f"{log}[1.2:]"]) == 0
    capsys.readouterr()
    assert main(["check", log, "--urdf", str(BIPED)]) in (0, 1)
    assert "point" not in capsys.readouterr().out


def test_plates_without_a_pose_in_their_world_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = recorded(tmp_path, "OpenSim", walk(2.0))
    file = experiment(tmp_path, MOTION, text, base_motion="contacts")
    assert "contact_wrench_world: preprocessing.base_motion: contacts does not know the heading" in refusal(
        ["identify", str(file)], tmp_path, capsys
    )
    with np.load(tmp_path / "motion.npz") as arrays:
        rest = {name: x for name, x in arrays.items() if name != "base_position_world"}
    velocity = np.gradient(value(walk(2.0).base_position_world), walk(2.0).time, axis=0)
    np.savez(tmp_path / "motion.npz", base_linear_velocity_world=velocity, **rest)
    complaint = refusal(["identify", str(experiment(tmp_path, MOTION, text))], tmp_path, capsys)
    assert "contact_wrench_point_world: moments about the world's origin need base_position_world" in complaint


@pytest.mark.slow("a recording of a person")
@pytest.mark.skipif(not SHARED.is_dir(), reason="the recorded logs (../shared/data) are not here")
def test_a_plate_that_lies_elsewhere_is_noticed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A person on two plates, said to be 10 cm from where they are."""
    folder = SHARED / "human_squats"
    log = read_log(folder / "squats1.npz").select(slice(0, 600))
    wrench = value(log.contact_wrench_world)
    places = feet_of(log, folder / "human.urdf")[0] - [0.1, 0.0, 0.0]
    moments = wrench[..., 3:] + np.cross(places, wrench[..., :3])
    about_origin = np.concatenate([wrench[..., :3], moments], axis=2)
    write_log(replace(log, contact_wrench_world=about_origin, moments_about_world_origin=True), tmp_path / "walk.npz")
    main(["check", str(tmp_path / "walk.npz"), "--urdf", str(folder / "human.urdf")])
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "contact_wrench_world (point)" in printed
    assert "check the reference points of" in printed
