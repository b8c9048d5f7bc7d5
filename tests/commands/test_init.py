"""`torchid init`: an experiment file from a robot and a log, with what was assumed, and nothing replaced."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from arms import ARMS
from dialects import save_csv, with_velocity
from refusals import refusal
from repository import DEMO, SHARED
from synthetic import ANYMAL, G1, PANDA, ROBOTS, SOLO12
from welded import machine

from torchid.cli import main
from torchid.commands.init import init
from torchid.config import load_config
from torchid.errors import InputError
from torchid.fitting.experiment import set_up
from torchid.logs import Log, read_log, write_log
from torchid.regressor import Regressor
from torchid.robot import load_robot

URDF = DEMO / "quadruped.urdf"
GO2 = ROBOTS / "go2_description/urdf/go2.urdf"


def recorded() -> Log:
    return with_velocity(read_log(DEMO / "sway_train.npz").select(slice(0, 300)))


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_a_robot_without_masses_and_its_weight_are_enough_to_identify_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "true.urdf").write_text(ARMS)
    (tmp_path / "bare.urdf").write_text(re.sub(r"<inertial>.*?</inertial>", "", ARMS, flags=re.DOTALL))
    robot, time = load_robot(tmp_path / "true.urdf", fixed_base=True), np.arange(3000) / 200.0
    rate = 2.0 * np.pi * np.array([0.7, 1.1])
    phase = rate * time[:, None] + np.array([0.0, 1.0])
    state = 0.8 * np.sin(phase), 0.8 * rate * np.cos(phase), -0.8 * rate**2 * np.sin(phase)
    K = Regressor(robot)(*map(torch.from_numpy, state)).numpy()
    torque = K @ robot.nominal.ravel() + np.random.default_rng(0).normal(0.0, 0.01, (3000, 2))
    names = dict(zip(("joint_position", "joint_velocity", "joint_acceleration"), state, strict=True))
    write_log(Log("swing.npz", time, robot.joint_names, **names, joint_torque=torque), tmp_path / "swing.npz")
    files = [str(tmp_path / name) for name in ("bare.urdf", "swing.npz", "new.yaml")]
    line = ["init", *files[:2], "--output", files[2]]
    assert "no link has mass; accepted: estimator.total_mass in the experiment file, torchid init --" in refusal(
        line, tmp_path, capsys
    )
    assert main([*line, "--total-mass", "7"]) == 0
    assert main(["identify", files[2], f"output={tmp_path / 'run'}", "preprocessing.cutoff_hz=5"]) == 0
    said = "no link has mass; 3 links share 7 kg equally, as balls of water"
    assert capsys.readouterr().err.count(said) == 2, "once in each command"
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())["test"]
    assert metrics["joint_torque_rms_relative"] < 0.02
    assert load_robot(tmp_path / "run" / "identified.urdf").nominal[:, 0].sum() == pytest.approx(7.0, rel=1e-6)


def test_a_log_in_the_format_needs_no_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["init", str(URDF), str(DEMO / "sway_train.npz"), "--output", str(tmp_path / "new.yaml")]) == 0
    settings = yaml.safe_load((tmp_path / "new.yaml").read_text())
    assert "columns" not in settings["logs"]
    assert settings["sensors"] == "full"
    assert "missing" not in capsys.readouterr().out
    assert main(["check", str(tmp_path / "new.yaml")]) == 0


def robot_log(folder: Path, urdf: Path, joint: str, feet: tuple[str, ...] = ()) -> tuple[Path, list[str]]:
    """A CSV of a robot whose joints are named by a pattern, in degrees and milliseconds."""
    robot, rng, time = load_robot(urdf), np.random.default_rng(0), np.arange(200) * 5.0
    columns: dict[str, Any] = {"timestamp_ms": time}
    for name in robot.joint_names:
        phase, rate = rng.uniform(0.0, 6.0), rng.uniform(1.0, 3.0)
        columns[joint.format(name.removesuffix("_joint")) + "_pos"] = 40.0 * np.sin(1e-3 * rate * time + phase)
        columns[joint.format(name.removesuffix("_joint")) + "_vel"] = 40.0 * rate * np.cos(1e-3 * rate * time + phase)
        columns[joint.format(name.removesuffix("_joint")) + "_effort"] = rng.standard_normal(200)
    columns |= {f"{foot}_contact": np.ones(200, int) for foot in feet}
    return save_csv(folder / "log.csv", columns), list(robot.joint_names)


LEGS = ("FL", "FR", "RL", "RR")
MACHINES = [
    (GO2, "{}", tuple(f"{leg}_foot" for leg in LEGS), "point"),
    (G1, "joint.{}", ("left_ankle_roll_link", "right_ankle_roll_link"), "flat"),
    (SOLO12, "m_{}", ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT"), "point"),
    (ANYMAL, "{}", ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT"), "point"),
]


@pytest.mark.parametrize(("urdf", "joint", "feet", "kind"), MACHINES, ids=[str(x[0].stem) for x in MACHINES])
@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_joints_feet_and_units_of_robots_are_found_by_name_and_number(
    tmp_path: Path, urdf: Path, joint: str, feet: tuple[str, ...], kind: str
) -> None:
    log, joints = robot_log(tmp_path, urdf, joint, feet)
    written = init(urdf, log, tmp_path / "new.yaml")
    config = load_config(tmp_path / "new.yaml")
    assert {(contact.frame, contact.type) for contact in config.contacts} == {(foot, kind) for foot in feet}
    again = read_log(log, columns=config.logs.columns)
    assert set(again.joint_names) == set(joints)
    assert set(again.contact_names) == set(feet)
    assert np.abs(again.joint_position).max() == pytest.approx(np.radians(40.0), rel=0.01)
    np.testing.assert_allclose(
        np.gradient(again.joint_position, again.time, axis=0)[5:-5], again.joint_velocity[5:-5], atol=1e-3
    )
    assert written.missing == ["motion of the base: no pose and no IMU; computed from the standing feet"]
    assert config.preprocessing.base_motion == "contacts"
    set_up(config)


def test_an_arm_without_feet_is_bolted(tmp_path: Path) -> None:
    log, joints = robot_log(tmp_path, PANDA, "{}")
    written = init(PANDA, log, tmp_path / "new.yaml")
    config = load_config(tmp_path / "new.yaml")
    assert config.robot.fixed_base
    assert not config.contacts
    assert not written.missing
    assert set(read_log(log, columns=config.logs.columns).joint_names) == set(joints)


def test_what_is_not_there_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = save_csv(tmp_path / "x.csv", {"a": [1.0, 2.0], "b": ["x", "y"]})
    assert main(["init", str(URDF), str(log), "--output", str(tmp_path / "new.yaml")]) == 0
    shown = capsys.readouterr().out
    for text in (
        "missing       time: fill in the step between samples",
        "missing       joint_position: fill in a column or pattern below",
        "missing       joint_torque: fill in torques [N m]",
        "missing       motion of the base: no pose and no IMU",
        "missing       contact_active (which foot touches when): detected from joint torques",
        "assumed       unused columns, listed in the file: a: 1 to 2, b: no numbers",
    ):
        assert text in shown
    assert "next: replace FILL_IN there" in " ".join(shown.split())
    message = refusal(["identify", str(tmp_path / "new.yaml")], tmp_path, capsys)
    assert "logs.columns.time.step: found 'FILL_IN'; accepted: a number" in message


def test_nothing_is_ever_replaced_and_nothing_half_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, target = DEMO / "sway_train.npz", tmp_path / "new.yaml"
    target.write_text("precious")
    (tmp_path / "link.yaml").symlink_to("nowhere.yaml")
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    (tmp_path / "x.mcap").write_bytes(b"")
    for urdf, source, output, found in (
        (URDF, log, "new.yaml", "--output: exists; accepted: a new file; torchid init overwrites no file"),
        (URDF, log, "link.yaml", "--output: exists"),
        (URDF, log, "nowhere/new.yaml", "--output: the folder "),
        (URDF, log, "new.txt", "--output: '"),
        (URDF, tmp_path / "absent.csv", "a.yaml", "absent.csv: file: no such file"),
        (URDF, f"{log} + {DEMO.name}/b.csv", "a.yaml", f"paths of further files are relative to {DEMO}"),
        (tmp_path / "absent.urdf", log, "a.yaml", "absent.urdf"),
        (URDF, tmp_path / "bad.npz", "a.yaml", "bad.npz: file: cannot be read"),
        (URDF, tmp_path / "x.mcap", "a.yaml", "x.mcap: file: cannot be read (EndOfFile)"),
    ):
        message = refusal(["init", str(urdf), str(source), "--output", str(tmp_path / output)], tmp_path, capsys)
        assert found in message
    assert target.read_text() == "precious"


WORDS = ("time", "q", "dq", "tau", "pos", "quat", "imu_acc", "gyro", "foot_force", "contact", "kp", "des_q", "base_pos",
         "front_left_hip", "front_left_foot", "{joint}", "[0]", "x", "w", "1", "12", "é", "joint_names",
         "*", "moment")  # fmt: skip
SHAPES = ((), (0,), (5,), (5, 12), (5, 3), (5, 4), (5, 20), (12,), (5, 4, 6), (5, 4, 3), (3, 2), (1, 12))


@pytest.mark.parametrize("seed", range(3))
def test_arrays_of_any_names_and_shapes_end_in_a_file_or_in_one_line(tmp_path: Path, seed: int) -> None:
    rng, written = np.random.default_rng(seed), 0
    makers = (
        lambda x: x,
        lambda x: x > 0,
        lambda x: np.asarray(x).astype(np.int64),
        lambda x: np.full_like(x, np.nan),
        lambda x: np.full(np.shape(x), "a"),
        lambda x: x + 1j,
    )
    for _ in range(25):
        arrays: dict[str, Any] = {}
        for _ in range(rng.integers(1, 9)):
            name = "_".join(rng.choice(WORDS, rng.integers(1, 4)))
            values = rng.standard_normal(SHAPES[rng.integers(len(SHAPES))]) * 10.0 ** rng.integers(-2, 12)
            arrays[name] = makers[rng.integers(len(makers))](values)
        np.savez(tmp_path / "x.npz", **(arrays | {"time": np.arange(5.0) * rng.choice([0.01, 10.0, 1e7, 0.0])}))
        (tmp_path / "new.yaml").unlink(missing_ok=True)
        try:
            init(URDF, tmp_path / "x.npz", tmp_path / "new.yaml")
        except InputError:
            continue
        written += 1
        yaml.safe_load((tmp_path / "new.yaml").read_text())
    assert written > 5


@pytest.mark.skipif(not SHARED.is_dir(), reason="recorded logs are not beside the repository")
def test_recorded_arrays_of_a_go2_need_no_edit_to_be_read(tmp_path: Path) -> None:
    for name, count in (("go2_in_air", 4779), ("go2_standing", 5000)):
        path = SHARED / name / "log.npz"
        init(GO2, path, tmp_path / f"{name}.yaml")
        config = load_config(tmp_path / f"{name}.yaml")
        log = read_log(path, columns=config.logs.columns)
        assert len(log) == count
        assert log.joint_torque is not None
        assert log.joint_velocity is not None
        hangs = name == "go2_in_air"
        assert config.robot.fixed_base is hangs
        feet = set() if hangs else {f"{leg}_foot" for leg in LEGS}
        assert {contact.frame for contact in config.contacts} == feet


@pytest.mark.parametrize(
    ("samples", "said", "test"),
    [
        (20, "missing", False),
        (60, "assumed", False),
        (1000, None, True),
    ],
)
def test_a_part_is_held_back_only_where_a_filter_leaves_something_of_it(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    samples: int,
    said: str | None,
    test: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_log(read_log(DEMO / "sway_train.npz").select(slice(0, samples)), tmp_path / "log.npz")
    assert (
        main(["init", str(DEMO / "quadruped.urdf"), str(tmp_path / "log.npz"), "--output", str(tmp_path / "n.yaml")])
        == 0
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert ("too short" in printed) is (said is not None)
    assert said is None or f"{said} {'motion' if said == 'missing' else 'logs.test: none'}" in printed
    written = yaml.safe_load((tmp_path / "n.yaml").read_text())
    assert ("test" in written["logs"]) is test
    assert written["estimator"]["ridge"] == "auto"
    assert main(["identify", str(tmp_path / "n.yaml")]) == (2 if said == "missing" else 0)


def test_sensors_in_limbs_that_a_log_names_are_used_and_fields_keep_the_files_names(tmp_path: Path) -> None:
    urdf, rng, count = machine(tmp_path), np.random.default_rng(0), 400
    names = load_robot(urdf).joint_names
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    np.savez(
        tmp_path / "log.npz", time=np.arange(count) / 100.0, joint_names=names, base_quat_wxyz=quat,
        joint_position=0.1 * rng.normal(size=(count, len(names))), ft_names=["ankle_ft", "no_such_joint"],
        joint_torque=rng.normal(size=(count, len(names))), ft_wrench=rng.normal(size=(count, 2, 6)),
    )  # fmt: skip
    said = init(urdf, tmp_path / "log.npz", tmp_path / "new.yaml")
    sensors = yaml.safe_load((tmp_path / "new.yaml").read_text())["sensors"]
    assert sensors == {"set": "joints", "ft_sensors": ["ankle_ft"]}
    assert "base_quat_wxyz" in str(said)
    assert "xyzw" not in str(said)
