"""The delay of commanded torques through the commands: found, stated in the run, and used by whatever comes after."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from delays import DELAY, arm, recorded
from motions import value

from torchid.cli import main
from torchid.config import load_config

KP = 20.0


def commanded(folder: Path, shape: tuple[int, float] = (6, 0.4), **settings: object) -> Path:
    """An experiment of logs that have no torques but gains and desired positions."""
    robot, _ = arm()
    for name, seconds in (("train", 5.0), ("new", 2.5)):
        log = recorded(seconds=seconds, shape=shape)
        q, torque = value(log.joint_position), value(log.joint_torque)
        fields = {"time": log.time, "joint_names": list(robot.joint_names), "dof_pos": q, "target": q + torque / KP}
        np.savez(folder / f"{name}.npz", **fields)
    law = {"kp": KP, "position": "target"}
    experiment = {
        "robot": {"urdf": str(robot.path), "fixed_base": True},
        "logs": {"train": ["train.npz"], "columns": {"joint_position": "dof_pos", "joint_torque": {"pd": law}}},
        "sensors": {"set": "joints", "noise": {"joint_torque": 0.01}},
        "preprocessing": {"cutoff_hz": 40},
        "estimator": {"ridge": 1e-7},
        "output": str(folder / "run"),
    }
    (folder / "experiment.yaml").write_text(yaml.safe_dump(experiment | settings))
    return folder / "experiment.yaml"


def test_a_run_finds_the_delay_of_a_pd_law_and_an_evaluation_predicts_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = commanded(tmp_path)
    assert main(["identify", str(file), "actuators.delay=auto", "--verbose"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    choice = metrics["delay_selection"]
    assert choice["best"] == pytest.approx(DELAY, abs=2e-5)
    assert choice["interval"][0] < DELAY < choice["interval"][1]
    assert "delay 3.7 ms (95 %: " in shown
    assert load_config(tmp_path / "run" / "config.yaml").actuators.delay == choice["value"]
    assert main(["evaluate", str(tmp_path / "run"), "--log", str(tmp_path / "new.npz")]) == 0
    (written,) = (tmp_path / "run" / "evaluation").rglob("metrics.json")
    with_delay = json.loads(written.read_text())["new"]["identified"]["joint_torque_rms"]

    assert main(["identify", str(file), "actuators.delay=null", f"output={tmp_path / 'without'}"]) == 0
    assert main(["evaluate", str(tmp_path / "without"), "--log", str(tmp_path / "new.npz")]) == 0
    (written,) = (tmp_path / "without" / "evaluation").rglob("metrics.json")
    assert with_delay < 0.1 * json.loads(written.read_text())["new"]["identified"]["joint_torque_rms"]
    assert json.loads((tmp_path / "without" / "metrics.json").read_text())["delay_selection"] is None


def test_a_run_on_a_motion_that_fits_any_delay_takes_none(tmp_path: Path) -> None:
    """A sine of one rate and little size: armature, spring and damping make up for it."""
    file = commanded(tmp_path, (1, 0.02), actuators={"armature": True, "stiffness": True, "delay": "auto"})
    assert main(["identify", str(file)]) == 0
    assert load_config(tmp_path / "run" / "config.yaml").actuators.delay == 0.0


@pytest.mark.filterwarnings("ignore:.*stated sensor noise")
def test_no_delay_is_looked_for_in_logs_without_a_filter(tmp_path: Path) -> None:
    """White noise between samples is smaller than at them, which would draw it to half a step."""
    file, found = commanded(tmp_path, preprocessing={}), []
    for more in ([], ["preprocessing.cutoff_hz=40", "overwrite=true"]):
        assert main(["identify", str(file), *more]) == 0
        found.append(load_config(tmp_path / "run" / "config.yaml").actuators.delay)
    assert found == [0.0, pytest.approx(DELAY, rel=0.1)]
