"""Commands on a robot with a joint that the experiment welds: those on a URDF in which it is fixed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import NO_TERMS
from motions import value
from repository import DEMO

from torchid.cli import main
from torchid.logs import Log, read_log, write_log
from torchid.robot import load_robot

KNEE = "rear_right_knee"
HELD = -1.44  # near its mean
_TRAIN, _TEST = "sway_train.npz", "sway_test.npz"


def _held(log: Log) -> Log:
    """The log as if the knee had hardly moved, whose torque then says little of the robot."""
    column = log.joint_names.index(KNEE)
    position = log.joint_position.copy()
    position[:, column] = HELD + 0.01 * np.sin(log.time)
    return replace(log, joint_position=position, joint_velocity=None, joint_acceleration=None)


def _without(log: Log) -> Log:
    kept = [column for column, name in enumerate(log.joint_names) if name != KNEE]
    return replace(
        log,
        joint_names=tuple(log.joint_names[column] for column in kept),
        joint_position=log.joint_position[:, kept],
        joint_torque=value(log.joint_torque)[:, kept],
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the demo's robot and one whose knee is fixed, a log for each, and an experiment that welds it."""
    folder = tmp_path_factory.mktemp("welded")
    text = (DEMO / "quadruped.urdf").read_text()
    (folder / "moving.urdf").write_text(text)
    robot = load_robot(DEMO / "quadruped.urdf", weld={KNEE: HELD})
    _, pose = robot.links["rear_right_shank_link"]
    start = text.index(f'<joint name="{KNEE}"')
    joint = text[start : text.index("</joint>", start)]
    fixed = _fixed(joint)
    (folder / "fixed.urdf").write_text(text.replace(joint, fixed))
    again = load_robot(folder / "fixed.urdf")
    np.testing.assert_allclose(again.links["rear_right_shank_link"][1], pose, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(again.nominal, robot.nominal, rtol=0.0, atol=1e-12)
    for name in (_TRAIN, _TEST):
        log = _held(read_log(DEMO / name).select(slice(0, 250)))
        write_log(log, folder / name)
        write_log(_without(log), folder / f"fixed_{name}")
    settings = yaml.safe_load((DEMO / "quadruped.yaml").read_text())
    settings |= {"robot": {"urdf": "moving.urdf", "weld": {KNEE: HELD}}, "logs": {"train": [_TRAIN], "test": [_TEST]}}
    settings["estimator"]["ridge"] = 0.01
    settings["actuators"] = NO_TERMS
    settings["sensors"]["set"] = "full"  # without the knee's torque, forces of four feet hide the base
    (folder / "experiment.yaml").write_text(yaml.safe_dump(settings))
    without = {"robot": {"urdf": "fixed.urdf"}, "logs": {"train": [f"fixed_{_TRAIN}"], "test": [f"fixed_{_TEST}"]}}
    (folder / "fixed.yaml").write_text(yaml.safe_dump(settings | without))
    return folder


def _fixed(joint: str) -> str:
    from xml.etree import ElementTree

    element = ElementTree.fromstring(joint + "</joint>")
    origin, axis = element.find("origin"), element.find("axis")
    assert origin is not None
    assert axis is not None
    assert "rpy" not in origin.attrib, "turned by the axis alone"
    assert axis.get("xyz") == "0 1 0"
    element.set("type", "fixed")
    origin.set("rpy", f"0 {HELD} 0")
    for child in [x for x in element if x.tag not in ("origin", "parent", "child")]:
        element.remove(child)
    return ElementTree.tostring(element, encoding="unicode").removesuffix("</joint>").rstrip()


def run(folder: Path, output: str, *overrides: str, file: str = "experiment.yaml") -> dict[str, Any]:
    target = folder / output
    assert main(["identify", str(folder / file), f"output={target}", "overwrite=true", *overrides]) == 0
    document: dict[str, Any] = json.loads((target / "parameters.json").read_text())
    return document


def assert_alike(one: dict[str, Any], other: dict[str, Any], tolerance: float) -> None:
    """The same bodies with the same numbers."""
    for body, expected in zip(one["bodies"], other["bodies"], strict=True):
        assert body["name"] == expected["name"]
        assert body["identified"] == pytest.approx(expected["identified"], rel=tolerance, abs=1e-2 * tolerance)


def test_a_weld_is_a_fixed_joint_to_every_command(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs = f"logs={{train: [{files}/fixed_{_TRAIN}], test: [{files}/fixed_{_TEST}]}}"
    welded = run(files, "welded")
    fixed = run(files, "fixed", file="fixed.yaml")
    assert_alike(welded, fixed, 1e-7)
    assert_alike(run(files, "blocks", logs, "preprocessing.memory_gb=1e-4"), welded, 1e-6)
    assert f'<joint name="{KNEE}" type="revolute">' in (files / "welded" / "identified.urdf").read_text()
    experiment = str(files / "experiment.yaml")
    assert main(["evaluate", str(files / "welded"), "--log", str(files / f"fixed_{_TEST}")]) == 0
    assert main(["check", experiment]) == 0
    assert main(["compress", experiment, "--output", str(files / "factors")]) == 0
    (factor,) = (files / "factors").glob("*.factor")
    capsys.readouterr()
    assert (
        main(["identify", experiment, f"logs.train=[{factor}]", f"robot.weld.{KNEE}=-1.3", f"output={files / 'x'}"])
        == 2
    )
    assert "robot.weld" in capsys.readouterr().err
