"""A fit on messages of a LowState beside other topics is the fit on the same log in the format."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from bags import entries_of, topics_of, write_bag
from demo import NO_TERMS
from dialects import ORDER, with_velocity
from low_states import TOPIC, float32, low_states
from repository import DEMO

from torchid.cli import main
from torchid.logs import read_log, write_log


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_fit_is_that_on_the_same_log_in_the_format(tmp_path: Path) -> None:
    log = float32(with_velocity(read_log(DEMO / "sway_train.npz").select(slice(0, 300))))
    others = [entry for entry in entries_of(log) if entry[0] not in ("/joint_states", "/imu")]
    path = write_bag(tmp_path / "x.mcap", sorted([*low_states(log, ORDER), *others], key=lambda entry: entry[1]))
    topics = {key: x for key, x in topics_of(log).items() if key not in ("joint_states", "imu")}
    topics["low_state"] = {"topic": TOPIC, "joints": ORDER}
    without_imu = replace(log, imu_frame="", imu_specific_force=None, imu_angular_velocity=None)
    write_log(without_imu, tmp_path / "x.npz")
    settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
    settings["robot"]["urdf"] = str(DEMO / "quadruped.urdf")
    settings["actuators"] = NO_TERMS
    settings["estimator"] = {"name": "least_squares", "ridge": 0.01}
    found = {}
    for file in (path, tmp_path / "x.npz"):
        settings["logs"] = {"train": [str(file)], "topics": topics}
        run = tmp_path / f"run{file.suffix}"
        (tmp_path / "robot.yaml").write_text(yaml.safe_dump(settings))
        assert main(["identify", str(tmp_path / "robot.yaml"), f"output={run}"]) == 0
        assert yaml.safe_load((run / "config.yaml").read_text())["logs"]["topics"]["low_state"]["joints"] == ORDER
        found[file.suffix] = json.loads((run / "parameters.json").read_text())
    for one, other in zip(found[".mcap"]["bodies"], found[".npz"]["bodies"], strict=True):
        assert one["identified"] == pytest.approx(other["identified"], rel=1e-7, abs=1e-9)
        assert one["identified"] != one["nominal"]
