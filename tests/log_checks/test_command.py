"""`torchid check` from the command line: answers, tables, exit statuses, files, refusals."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import DEMO, shortened_demo
from motions import value
from refusals import files_in, refusal
from repository import ROOT, SHARED

from torchid.cli import main
from torchid.commands.check import check_log
from torchid.log_checks.check import check
from torchid.logs import Log, read_log, write_log
from torchid.report.log_checks import log_check_figure

HUMAN, ARM = SHARED / "human_squats", SHARED / "kuka_lwr4"
ELSEWHERE = pytest.mark.skipif(not SHARED.is_dir(), reason=f"recorded logs are not in {SHARED}")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A short demo with a spike in a torque."""
    folder = shortened_demo(tmp_path / "demo", 400)
    log = read_log(folder / "sway_test.npz")
    torque = value(log.joint_torque).copy()
    torque[123, 3] += 200.0
    write_log(replace(log, joint_torque=torque), folder / "sway_test.npz")
    return folder


def test_the_logs_of_an_experiment_file_are_checked_one_by_one(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--verbose", str(folder / "quadruped.yaml")]) == 0
    printed = capsys.readouterr().out
    train, test = printed.split("sway_test.npz")
    assert "sway_train.npz: 400 samples, 3.99 s" in train
    assert "verdict       usable\n" in train
    assert "joint_torque (spike)" in test
    assert "verdict       usable without 1 of 400 samples\n" in test
    assert max(map(len, printed.splitlines())) <= 100


ONE_FOOT = "{set: null, contact_wrenches: {front_left_foot: [fx, fy, fz]}}"


@pytest.mark.parametrize(
    ("sensors", "settings", "said"),
    [
        ("joints", [], "joint_torque '{joint}' (does not fit)"),
        ("contacts", [], ""),
        ("contacts", ["preprocessing.cutoff_hz=60"], "preprocessing.cutoff_hz (does not fit)"),
        (ONE_FOOT, [], "sensors (does not fit)"),  # of which the base's six rows cannot be told
        (ONE_FOOT, ["sensors.on_base_lost=warn"], ""),
    ],
)
def test_a_log_that_identify_would_refuse_is_not_usable(
    folder: Path, capsys: pytest.CaptureFixture[str], sensors: str, settings: list[str], said: str
) -> None:
    log = read_log(folder / "sway_train.npz")
    torque = value(log.joint_torque).copy()
    torque[:, 3] = np.nan
    write_log(replace(log, joint_torque=torque), folder / "sway_train.npz")
    status = main(["check", str(folder / "quadruped.yaml"), f"sensors={sensors}", "estimator.robust=null", *settings])
    printed = capsys.readouterr().out
    assert status == (1 if said else 0)
    assert ("does not fit" in printed) == bool(said)
    assert said.format(joint=log.joint_names[3]) in printed


def test_frames_that_are_sent_again_are_one_row_of_the_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = read_log(folder / "sway_train.npz")
    again = np.arange(400)
    again[150:156] = 149
    write_log(replace(log.select(again), time=log.time), folder / "sway_train.npz")
    assert main(["check", "--verbose", str(folder / "sway_train.npz")]) == 0
    printed = capsys.readouterr().out
    assert printed.count("rejected") == 1
    assert "; also " in " ".join(printed.split())
    assert "usable without 6 of 400 samples" in printed


def test_a_log_alone_says_what_needs_a_robot(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, urdf = str(folder / "sway_test.npz"), str(folder / "quadruped.urdf")
    assert main(["check", log]) == 0
    assert "no robot" in capsys.readouterr().out
    assert main(["check", log, "--urdf", urdf, "--base-link", "trunk"]) == 0
    printed = capsys.readouterr().out
    assert "no robot" not in printed
    assert "usable without 1 of 400 samples" in printed


def test_feet_without_wrenches_whose_type_nobody_says_give_no_alarm(tmp_path: Path) -> None:
    """Four feet are taken for points: shanks turn above the ground, soles would not."""
    with np.load(DEMO / "sway_train.npz") as log:
        np.savez(tmp_path / "bare.npz", **{name: x for name, x in log.items() if name != "contact_wrench_local"})
    assert not check_log(tmp_path / "bare.npz", DEMO / "quadruped.urdf").findings


def test_a_log_that_is_not_usable_ends_with_status_one(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = read_log(folder / "sway_train.npz")
    write_log(replace(log, joint_position=np.degrees(log.joint_position)), folder / "sway_train.npz")
    assert main(["check", str(folder / "quadruped.yaml")]) == 1
    printed = capsys.readouterr().out
    assert printed.startswith("1 of 2 logs is usable")
    assert "rejected      joint_position (unit) in sway_train.npz: " in printed


@pytest.mark.parametrize("samples", [1, 4])
def test_a_log_too_short_to_differentiate_is_not_usable(
    folder: Path, capsys: pytest.CaptureFixture[str], samples: int
) -> None:
    log, path = read_log(folder / "sway_train.npz"), str(folder / "sway_train.npz")
    write_log(log.select(np.arange(samples)), path)
    assert main(["check", path, "--urdf", str(folder / "quadruped.urdf")]) == 1
    assert ": not usable: time: too short\n" in capsys.readouterr().out


def test_one_sample_of_an_arm_with_its_velocity_and_acceleration_needs_no_derivative(folder: Path) -> None:
    log = read_log(folder / "sway_train.npz").select(np.arange(1))
    q = log.joint_position
    assert check(Log("one.npz", log.time, log.joint_names, q, joint_velocity=q, joint_acceleration=q)).usable
    assert not check(Log("one.npz", log.time, log.joint_names, q, joint_velocity=q)).usable


def test_an_overview_gives_the_range_of_every_channel_and_names_only_what_there_is(folder: Path) -> None:
    clean, spiked = (check(read_log(folder / f"sway_{name}.npz")) for name in ("train", "test"))
    assert not log_check_figure([clean]).axes[0].get_legend()
    (axes,) = log_check_figure([spiked]).axes
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["rejected"]
    (beside,) = axes.child_axes
    names, ranges = ([label.get_text() for label in x.get_yticklabels()] for x in (axes, beside))
    told = dict(zip(names, ranges, strict=True))
    low, high = np.percentile(value(spiked.log.joint_torque)[:, 3], (0.5, 99.5))
    assert told["joint_torque front_right_hip"] == f"{low:.3g} to {high:.3g} N m"
    assert told["contact_wrench_local front_left_foot fz"].endswith(" N")
    assert told["contact_active front_left_foot"] == "0 to 1"


def test_the_documented_check_from_python_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "logs.md").read_text(), re.DOTALL)
    monkeypatch.chdir(ROOT)
    said: dict[str, Any] = {}
    exec(code, said)
    assert said["checked"].usable
    assert said["repaired"].joint_position.shape == said["log"].joint_position.shape


def test_findings_and_an_overview_are_written_whole(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    document, figure = tmp_path / "out" / "found.json", tmp_path / "out" / "found.png"
    assert main(["check", str(folder / "sway_test.npz"), "--json", str(document), "--figure", str(figure)]) == 0
    (log,) = json.loads(document.read_text())["logs"]
    assert (log["samples"], log["usable"], log["rejected_samples"]) == (400, True, 1)
    (spike,) = (finding for finding in log["findings"] if finding["severity"] == "rejected")
    assert (spike["name"], spike["field"], spike["channels"]) == ("spike", "joint_torque", ["front_right_hip"])
    assert spike["spans"] == [
        {"first": 123, "last": 123, "count": 1, "start_s": 1.23, "end_s": 1.23, "channel": "front_right_hip"}
    ]
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert set(files_in(tmp_path / "out")) == {"found.json", "found.png"}


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        (["{}/none.npz"], "file"),
        (["{}/none.yaml"], "file"),
        (["{}/quadruped.yaml", "--urdf", "{}/quadruped.urdf"], "--urdf"),
        (["{}/quadruped.yaml", "logs=null"], "logs"),
        (["{}/sway_test.npz", "estimator.ridge=1"], "overrides"),
        (["{}/sway_test.npz", "--fixed-base"], "--fixed-base"),
        (["{}/sway_test.npz", "--urdf", "{}/quadruped.urdf", "--base-link", "nowhere"], "base_link"),
        (["{}/sway_test.npz", "--json", "{}/found.txt"], "--json"),
        (["{}/sway_test.npz", "--figure", "{}/none/found.png"], "--figure"),
        (["{}/quadruped.urdf"], "file"),
    ],
)
def test_bad_input_is_answered_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], field: str
) -> None:
    line = refusal(["check", *(argument.format(folder) for argument in arguments)], folder, capsys)
    assert f": {field}" in line or f".{field}: " in line


def test_a_log_that_cannot_be_read_is_refused_as_any_command_does(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with np.load(folder / "sway_test.npz") as log:
        np.savez(folder / "back.npz", **(dict(log) | {"time": log["time"][::-1]}))
    assert "strictly increasing" in refusal(["check", str(folder / "back.npz")], folder, capsys)


def test_a_contact_of_the_log_that_the_robot_lacks_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = read_log(folder / "sway_test.npz")
    write_log(replace(log, contact_names=("nose", *log.contact_names[1:])), folder / "sway_test.npz")
    urdf = str(folder / "quadruped.urdf")
    assert "'nose'" in refusal(["check", str(folder / "sway_test.npz"), "--urdf", urdf], folder, capsys)


@ELSEWHERE
def test_a_recorded_arm_is_usable_and_its_stamps_are_seen_to_jitter(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf, document = str(ARM / "kuka_lwr4.urdf"), tmp_path / "found.json"
    for name in ("run1", "run2"):
        given = [str(ARM / f"{name}.npz"), "--urdf", urdf, "--fixed-base", "--json", str(document), "--overwrite"]
        assert main(["check", *given]) == 0
        assert ": usable; no mistake found\n" in capsys.readouterr().out
        (log,) = json.loads(document.read_text())["logs"]
        severities = {finding["name"]: finding["severity"] for finding in log["findings"]}
        assert severities == {"jitter": "note", "inertials": "note"}, "its last link has 0.3 kg and 0.5 m of gyration"


@ELSEWHERE
def test_a_recorded_person_is_usable_and_weighs_less_than_the_urdf(tmp_path: Path) -> None:
    found, document = {}, tmp_path / "found.json"
    for name in ("squats1", "squatsAsym1", "static1"):
        given = [
            str(HUMAN / f"{name}.npz"),
            "--urdf",
            str(HUMAN / "human.urdf"),
            "--json",
            str(document),
            "--overwrite",
        ]
        assert main(["check", *given]) == 0
        (found[name],) = json.loads(document.read_text())["logs"]
    weight = {name: next(x for x in log["findings"] if x["name"] == "weight") for name, log in found.items()}
    assert {x["severity"] for x in weight.values()} == {"note"}
    assert "60.03 kg at rest" in weight["static1"]["found"]
    assert "62.6 kg" in weight["static1"]["found"]
    assert [log["rejected_samples"] for log in found.values()] == [0, 2, 0]  # the last two poses jump by 0.26 rad
    names = {finding["name"] for log in found.values() for finding in log["findings"]}
    assert names <= {"weight", "constant", "saturated", "step"}


def test_the_shipped_demo_is_usable_without_reserve(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    for name in ("quadruped.urdf", "quadruped.yaml", "sway_train.npz", "sway_test.npz"):
        shutil.copy(DEMO / name, tmp_path)
    assert main(["check", str(tmp_path / "quadruped.yaml")]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("No mistake found in 2 logs.\n")
    assert "rejected" not in printed
    assert "suspicious" not in printed
