"""`torchid replay`: the torques of a log on the robot in MuJoCo."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demo import shortened_demo
from refusals import refusal
from repository import DEMO
from synthetic import SOLO12

from torchid.cli import main
from torchid.commands.folder import REPLAY, read_manifest
from torchid.commands.replay import PARAMETER_SAMPLES, Replay, _feet, _model, replay
from torchid.config.experiment import ActuatorsConfig
from torchid.errors import ConfigError
from torchid.fitting.fit import Comparison
from torchid.problem.extras import ACTUATORS, ExtraTerms
from torchid.report.figures import drift_figure
from torchid.robot import load_robot
from torchid.sensing import Contact
from torchid.simulation.replay import Drift
from torchid.terminal.simulations import replay_lines

UNSEEN = str(DEMO / "sway_test.npz")
pytestmark = pytest.mark.filterwarnings("ignore:identified.urdf")


@pytest.fixture
def run(demo_run: Path) -> Path:
    return demo_run


@pytest.mark.slow("windows of a motion in MuJoCo with all samples of the parameters")
def test_the_identified_robot_stays_nearer_to_a_new_log_than_the_urdf(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "replay"
    assert main(["replay", str(run), "--log", f"{UNSEEN}[:3]", "--window", "0.2", "--output", str(output)]) == 0
    lines = capsys.readouterr().out.splitlines()
    document = json.loads((output / "replay.json").read_text())
    for name in ("joints [rad]", "base tilt [rad]"):
        nominal, identified = (np.array(document["quartiles"][name][who]) for who in ("nominal", "identified"))
        assert nominal.shape == (3, len(document["time_s"]))
        assert (np.diff(nominal, axis=0) >= 0.0).all()
        assert identified[1, -1] < 0.2 * nominal[1, -1]
        assert any(f"{identified[1, -1]:.4g}" in line for line in lines)
        least, largest = np.array(document["samples"]["least_and_largest_median"][name])
        assert (least <= largest).all()
        assert least[-1] < largest[-1] < 0.5 * nominal[1, -1]
        assert any(f"{least[-1]:.3g} to {largest[-1]:.3g}" in line for line in lines)
    assert document["samples"]["count"] == PARAMETER_SAMPLES
    assert lines[0].startswith("Drift after 0.2 s, driven by the torques of sway_test[:3], ")
    assert len(lines) <= 20
    assert max(map(len, lines)) <= 100
    kind = read_manifest(output)
    assert kind is not None
    assert kind.kind == REPLAY.name
    assert {file.name for file in output.iterdir()} == {"replay.json", "drift.png", "manifest.json"}
    assert main(["replay", str(run), "--log", UNSEEN, "--window", "1", "--verbose", "--samples", "0"]) == 0
    said = capsys.readouterr().out
    assert "rear_right_knee" in said
    assert "samples" not in said
    assert main(["replay", str(run), "--log", UNSEEN, "--samples", "-1"]) == 2
    assert "--samples: -1; accepted: 0 to 1000" in capsys.readouterr().err


def test_pd_targets_keep_both_nearer_to_the_log(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ends = []
    for name, gains in (("free", []), ("held", ["--kp", "20", "*_knee=40", "--kd", "0.5"])):
        output = tmp_path / name
        shown = ["--window", "0.2", "--samples", "0", "--output", str(output)]
        assert main(["replay", str(run), "--log", f"{UNSEEN}[:3]", *shown, *gains]) == 0
        document = json.loads((output / "replay.json").read_text())
        ends.append([document["quartiles"]["joints [rad]"][who][1][-1] for who in ("nominal", "identified")])
    assert "Drift after 0.2 s, driven by the PD targets of sway_test[:3], " in capsys.readouterr().out
    assert document["kp"]["rear_left_knee"] == 40.0
    assert document["kp"]["rear_left_hip"] == 20.0
    assert set(document["kd"].values()) == {0.5}
    assert ends[1][0] < 0.8 * ends[0][0]
    assert ends[1][1] < ends[1][0]
    for wrong, message in (
        ("stiff", "--kp: 'stiff'; accepted: numbers of at least 0"),
        ("nee=3", "--kp: unknown name 'nee'"),
        ("-1", "--kp: -1"),
    ):
        assert main(["replay", str(run), "--log", UNSEEN, f"--kp={wrong}"]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (["--window", "0"], "--window: 0"),
        (["--window", "nan"], "--window: nan"),
        (["--window", "1e9"], "no window of 1e+09 s without a gap"),
        (["--window", "1e-6"], "windows of 1e-06 s"),
    ],
)
def test_windows_that_no_log_has_are_refused(
    run: Path, more: list[str], found: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert found in refusal(["replay", str(run), "--log", UNSEEN, *more], tmp_path, capsys)


@pytest.mark.parametrize(
    ("units", "shares"),
    [
        (("rad", "m"), "joints [rad] 100 times smaller, joints [m] 10 times smaller"),
        (("rad", "rad"), "joints 22 times smaller"),
    ],
)
def test_drifts_of_hinges_and_slides_are_told_apart(units: tuple[str, ...], shares: str) -> None:
    time = np.array([0.0, 0.5])
    drifts = (Drift(time, np.array([[[0.0, 0.0], of_joints]]), None) for of_joints in ([1.0, 0.5], [0.01, 0.05]))
    found = Replay(
        source="log",
        window=0.5,
        windows=1,
        drift=Comparison(*drifts),
        joint_names=("j", "z"),
        units=units,
        of="URDF",
        gains=np.zeros((2, 2)),
    )
    assert f", compared with the URDF: {shares} (1 window)." in replay_lines(found, 200)[0]
    driven = replace(found, gains=np.ones((2, 2)))
    for one, by in ((found, "the torques of log"), (driven, "the PD targets of log")):
        figure = drift_figure(one.driven, time, one.quartiles(), {}, one.by_joint(), units, "URDF")
        assert figure.get_suptitle().startswith(f"Drift of a robot driven by {by}: median")


def test_what_a_replay_lacks_is_named(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load(UNSEEN) as arrays:
        log = dict(arrays)
    np.savez(tmp_path / "untorqued.npz", **{name: x for name, x in log.items() if name != "joint_torque"})
    no_torque = ["replay", str(run), "--log", str(tmp_path / "untorqued.npz")]
    assert "a log with all joint torques" in refusal(no_torque, tmp_path, capsys)
    assert "a folder written by torchid identify" in refusal(
        ["replay", str(tmp_path), "--log", UNSEEN], tmp_path, capsys
    )


def test_a_replay_replaces_nothing_but_a_replay(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = ["replay", str(run), "--log", UNSEEN, "--output", str(run)]
    assert "not empty; accepted: a new folder, or --overwrite" in refusal(again, run, capsys)
    assert "a run" in refusal([*again, "--overwrite"], run, capsys)


def test_a_run_with_welds_is_replayed_with_the_joint_held(tmp_path: Path) -> None:
    file = shortened_demo(tmp_path / "demo", 200) / "quadruped.yaml"
    for path in file.parent.glob("*.npz"):
        with np.load(path) as arrays:
            log = dict(arrays)
        kept = log["joint_names"] != "rear_right_knee"
        of_joints = {name: log[name][:, kept] for name in ("joint_position", "joint_torque")}
        np.savez(path, **(log | of_joints | {"joint_names": log["joint_names"][kept]}))
    weld = [
        "robot.weld={rear_right_knee: -1.65}",  # its mean angle in these samples
        "estimator={name: consistent, ridge: 0.001}",
        "sensors.on_base_lost=warn",
        f"output={tmp_path / 'run'}",
    ]
    assert main(["identify", str(file), *weld]) == 0
    found = replay(tmp_path / "run", file.parent / "sway_test.npz", window=0.1)
    assert "rear_right_knee" not in found.joint_names
    ends = found.at(0.1)
    assert ends["joints [rad]"].identified < 0.05
    assert ends["base tilt [rad]"].identified < 0.05


def test_a_flat_contact_without_spheres_is_refused_with_what_a_replay_can_stand_on() -> None:
    urdf = DEMO / "quadruped.urdf"
    found = r"trunk is a flat contact, but quadruped\.urdf has no collision spheres there; accepted: point contacts"
    with pytest.raises(ConfigError, match=f"contacts: {found}"):
        _feet([Contact("trunk", "flat")], urdf)


def test_every_term_of_actuators_has_its_fields_and_is_simulated() -> None:
    """A new row of `ACTUATORS` needs these; all else follows from the row."""
    robot = load_robot(SOLO12)
    plain = _model(robot.path, robot, {}, None)
    for name in ACTUATORS:
        assert name in ExtraTerms.__dataclass_fields__
        assert name in ActuatorsConfig.__dataclass_fields__
        fitted = _model(robot.path, robot, {name: {robot.joint_names[0]: 0.7}}, None, stribeck=0.1)
        changed = [
            x for x in ("armature", "offset", "stiffness", "stribeck") if getattr(fitted, x)[0] != getattr(plain, x)[0]
        ]
        assert len(changed) == 1, name
