"""Commands on robots with closed loops: from MJCF and from a URDF with `robot.loops`; wrong frames are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

pytest.importorskip("mujoco", reason="MuJoCo is not installed")

from closed_loops import LoopWorld, loop_world
from demo import NO_TERMS

import torchid
from torchid.cli import main
from torchid.config import load_config
from torchid.errors import TorchidError
from torchid.fitting.experiment import set_up
from torchid.reading.log_reader import LogReader
from torchid.regressor.loops import LoopClosures
from torchid.report import identified_urdf
from torchid.report.mjcf_files import mjcf_of_urdf
from torchid.robot import Loop, load_robot

LEG = "four-bar leg"


def experiment(folder: Path, w: LoopWorld, **robot: Any) -> Path:
    """An experiment file with two logs of motors alone, as robots log them."""
    motors = [k for k, name in enumerate(w.log.joint_names) if name not in w.robot.passive]
    for name, seed in (("train", 0), ("test", 3)):
        log = loop_world(LEG, 300, seed, True).log
        arrays = {
            key: getattr(log, f"joint_{key}")[:, motors] for key in ("position", "velocity", "acceleration", "torque")
        }
        named = {f"joint_{key}": array for key, array in arrays.items()}
        joints = tuple(log.joint_names[k] for k in motors)
        torchid.write_log(replace(log, joint_names=joints, **named), folder / f"{name}.npz")
    settings = {
        "robot": robot,
        "contacts": [{"frame": contact.frame, "type": contact.kind} for contact in w.contacts],
        "logs": {"train": ["train.npz"], "test": ["test.npz"]},
        "sensors": "full",
        "actuators": NO_TERMS,
        "estimator": {"name": "least_squares", "ridge": 1e-12},
        "output": str(folder / "run"),
    }
    (folder / "leg.yaml").write_text(yaml.safe_dump(settings))
    return folder / "leg.yaml"


def test_a_run_finds_the_motors_and_friction_of_joints_that_have_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    w = loop_world(LEG)
    assert main(["identify", str(experiment(tmp_path, w, mjcf=str(w.path)))]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"]
    by_joint = metrics["joint_torque_rms_by_joint"]
    assert {name for name, x in by_joint.items() if x is None} == set(w.robot.passive)
    assert metrics["nullspace_rms_relative"] < 1e-5
    bodies = json.loads((tmp_path / "run" / "parameters.json").read_text())["bodies"]
    found, true = np.array([body["identified"]["fc"] for body in bodies]), w.true[:, 10].copy()
    knee, coupler = (w.robot.body_names.index(name) for name in ("shank", "coupler"))
    for friction in (found, true):  # sides of a parallelogram turn together: only the sum can be told
        friction[[knee, coupler]] = friction[knee] + friction[coupler], 0.0
    np.testing.assert_allclose(found, true, atol=1e-8)
    assert load_robot(tmp_path / "run" / "identified.xml").loops == w.robot.loops
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "run"), "--log", str(tmp_path / "test.npz")]) == 0
    assert main(["replay", str(tmp_path / "run"), "--log", str(tmp_path / "test.npz")]) == 0
    assert "joints [rad]" in capsys.readouterr().out


def test_a_urdf_with_stated_loops_is_the_same_robot(tmp_path: Path) -> None:
    w = loop_world(LEG)
    (tmp_path / "leg.urdf").write_bytes(identified_urdf(w.robot, w.robot.nominal))
    frames, passive = list(w.robot.loops[0].frames), ["knee", "coup*"]
    file = experiment(tmp_path, w, urdf="leg.urdf", loops=[{"frames": frames, "max_gap": 0.001}], passive=passive)
    setup = set_up(load_config(file))
    assert setup.robot.loops == (Loop((frames[0], frames[1]), "point", 0.001),)
    assert setup.robot.passive == w.robot.passive
    assert setup.sensors.torque.all()
    (tmp_path / "again.xml").write_bytes(mjcf_of_urdf(setup.robot, setup.robot.nominal, {}))
    (loop,) = load_robot(tmp_path / "again.xml").loops
    assert loop.frames == (f"loop1 of {frames[0]}", f"loop1 of {frames[1]}")
    q = torch.from_numpy(w.log.joint_position)
    one, other = (LoopClosures(robot).jacobian(q) for robot in (setup.robot, w.robot))
    np.testing.assert_allclose(one, other, atol=1e-13)
    (samples,) = LogReader(setup).read(setup.config.logs.train, setup.sensors)
    np.testing.assert_allclose(samples.joint_position, q, atol=1e-9)


@pytest.mark.parametrize(
    ("loops", "message"),
    [
        ([{"frames": ["knee"]}], "two frames of the robot"),
        ([{"frames": ["shank", "pelvis"]}], "robot.loops[0].frames: unknown name 'pelvis'"),
        ([{"frames": ["shank", "toe"]}], "robot.loops[0].frames: shank and toe are on the same body"),
        ([{"frames": ["shank", "crank"], "type": "hinge"}], "robot.loops.0.type: found 'hinge'; accepted: 'point'"),
        ("knee", "a list of mappings: [{frames: [l_rod_end"),
    ],
)
def test_loops_that_are_none_are_refused_in_one_line(loops: Any, message: str, tmp_path: Path) -> None:
    w = loop_world(LEG)
    file = experiment(tmp_path, w, mjcf=str(w.path), loops=loops)
    with pytest.raises(TorchidError) as caught:
        set_up(load_config(file))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_check_says_how_open_loops_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    w = loop_world(LEG)
    main(["check", str(experiment(tmp_path, w, mjcf=str(w.path))), "--verbose"])
    out = " ".join(capsys.readouterr().out.split())
    assert "closed loop" in out
    for part in ("pin of coupler", "and pin of shank meet: ", "nothing; accepted: up to 5"):
        assert part in out


def test_joints_without_a_motor_are_named_or_matched(tmp_path: Path) -> None:
    w = loop_world(LEG)
    for passive, message in ((["knie"], "robot.passive: unknown name 'knie'"), (["z*"], "'z*' matches no joint")):
        with pytest.raises(TorchidError, match=message.replace("*", r"\*")):
            set_up(load_config(experiment(tmp_path, w, mjcf=str(w.path), passive=passive)))
