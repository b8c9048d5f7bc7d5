"""`preprocessing.cutoff_hz: auto` through the commands."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from repository import DEMO
from synthetic import UR5, load

from torchid.cli import main
from torchid.commands.chosen_settings import _cutoff_of_motion
from torchid.config import load_config
from torchid.errors import ConfigError
from torchid.fitting.experiment import set_up
from torchid.logs import Log, write_log

AUTO = ["preprocessing.cutoff_hz=auto", "sensors.noise={joint_position: 1e-4}", "estimator.ridge=0.01"]
AUTO += [f"logs.train=[{json.dumps(str(DEMO / 'sway_train.npz[:6]'))}]"]
FILE = str(DEMO / "quadruped.yaml")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("runs") / "run"
    assert main(["identify", FILE, *AUTO, f"output={output}"]) == 0
    return output


def test_a_run_keeps_the_cutoff_for_logs_that_come_later(run: Path) -> None:
    choice = json.loads((run / "metrics.json").read_text())["cutoff_selection"]
    assert choice["by_noise"]
    assert 3.0 < choice["cutoff_hz"] < 20.0
    assert load_config(run / "config.yaml").preprocessing.cutoff_hz == choice["cutoff_hz"]
    assert main(["evaluate", str(run), "--log", str(DEMO / "sway_test.npz")]) == 0


@pytest.mark.parametrize(("noise", "samples"), [(0.0, 4), (1e-3, 5)])
def test_poses_that_are_held_have_the_band_of_their_own_rate(tmp_path: Path, noise: float, samples: int) -> None:
    """As of a video in a file at 100 Hz, whose stairs are no noise, and have no harmonics of a motion."""
    robot, rng, time = load(UR5, fixed_base=True), np.random.default_rng(0), np.arange(3000) / 100.0
    phase = 2.0 * np.pi * np.array([0.2, 0.5, 0.9])[:, None] * time
    position = np.sin(phase + rng.uniform(0.0, 6.0, (robot.n, 3, 1))).sum(axis=1).T * rng.uniform(0.1, 0.4, robot.n)
    position += noise * rng.normal(size=position.shape)
    held, found = position[np.arange(len(time)) // samples * samples], []
    for poses in (position, held):
        write_log(Log("arm.npz", time, robot.joint_names, poses, joint_torque=poses), tmp_path / "arm.npz")
        of_arm = {"robot": {"urdf": str(UR5), "fixed_base": True}, "logs": [str(tmp_path / "arm.npz")], "output": None}
        setup = set_up(load_config(None, (), of_arm | {"sensors": "joints", "preprocessing": {"cutoff_hz": "auto"}}))
        found.append(_cutoff_of_motion(setup)[0].cutoff_hz or np.inf)
    at_most = min(found[0], 0.2 * 100.0 / samples)
    assert 0.7 * at_most < found[1] <= at_most


def test_other_words_are_refused() -> None:
    text = refused(lambda: load_config(FILE, ["preprocessing.cutoff_hz=automatic"]), FILE, ConfigError)
    assert text.endswith("preprocessing.cutoff_hz: found 'automatic'; accepted: auto, null, or a number greater than 0")
