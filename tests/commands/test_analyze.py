"""`torchid analyze`: answers in a folder, and a slip answered in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from demo import FAST_ESTIMATOR, shortened_demo
from refusals import files_in, refusal
from synthetic import Oracle

from torchid.cli import main
from torchid.commands.analyze import analyze
from torchid.config import load_analysis
from torchid.errors import TorchidWarning

LEGS = ("front_left", "front_right", "rear_left", "rear_right")
FEET = tuple(f"{leg}_foot" for leg in LEGS)
TORQUES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "knee"))


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's robot and shortened logs."""
    return shortened_demo(tmp_path_factory.mktemp("analysis") / "experiment", 800)


def asked(folder: Path, **settings: Any) -> Path:
    """An experiment file that asks something of the demo's robot."""
    content: dict[str, Any] = {
        "robot": {"urdf": str(folder / "quadruped.urdf")},
        "contacts": [{"frame": foot, "type": "point"} for foot in FEET],
        "estimator": FAST_ESTIMATOR,
        "output": str(folder / "out"),
    }
    path = folder / "asked.yaml"
    path.write_text(yaml.safe_dump(content | settings))
    return path


@pytest.fixture(scope="module")
def with_logs(experiment: Path) -> tuple[Path, dict[str, Any]]:
    """The folder and the answers of a run with logs, a proposed set that lacks one knee, and two sets to compare."""
    file = asked(
        experiment,
        logs={"train": ["sway_train.npz"], "test": ["sway_test.npz"]},
        preprocessing={"cutoff_hz": 8},
        sensors={"joint_torques": [*TORQUES[:-1]], "noise": {"joint_torque": 0.1, "contact_force": 0.5}},
        analysis={"compare": {"full": "full", "feet": "contacts"}},
        output=str(experiment / "with_logs"),
    )
    assert main(["analyze", str(file)]) == 0
    folder = experiment / "with_logs.analysis"
    return folder, json.loads((folder / "analysis.json").read_text())


@pytest.fixture(scope="module")
def without_logs(experiment: Path) -> tuple[Path, dict[str, Any]]:
    """The answers of a run with neither logs nor sensors, in two scenarios."""
    scenarios = {"stand": [list(FEET)], "trot": [["front_left_foot", "rear_right_foot"], list(FEET[1:3]), []]}
    file = asked(
        experiment,
        analysis={"scenarios": scenarios, "keep": ["front_left_foot"], "exclude": ["rear_left_knee"]},
        output=str(experiment / "without_logs"),
    )
    assert main(["analyze", str(file)]) == 0
    folder = experiment / "without_logs.analysis"
    return folder, json.loads((folder / "analysis.json").read_text())


def test_the_folder_holds_answers_words_and_pictures(
    with_logs: tuple[Path, dict[str, Any]], without_logs: tuple[Path, dict[str, Any]]
) -> None:
    always = {"analysis.json", "base_parameters.txt", "config.yaml", "manifest.json"}
    assert set(files_in(with_logs[0])) == always | {"sensors-logs.png"}
    assert set(files_in(without_logs[0])) == always | {"sensors-stand.png", "sensors-trot.png"}
    words = (with_logs[0] / "base_parameters.txt").read_text()
    assert max(map(len, words.splitlines())) <= 100
    assert "m[trunk] + m[front_left_hip_link]" in words


def test_a_proposed_set_is_checked_and_its_cure_is_named(with_logs: tuple[Path, dict[str, Any]]) -> None:
    (scenario,) = with_logs[1]["scenarios"].values()
    lame = [check for check in scenario["proposed"] if check["lost"] is not None]
    assert {check["random_postures"]["rank"] for check in lame} == {5}
    assert all("rear_right_foot" in check["state"] for check in lame)
    for check in lame:
        (lacking,) = check["lost"]["lacking"]
        assert lacking == {"contacts": ["rear_right_foot"], "sensors": 1}
        assert set(check["lost"]["would_help"]) == {"rear_right_knee", "rear_right_foot"}
    assert any("rear_right_foot" not in check["state"] for check in scenario["proposed"])


def test_the_plan_is_the_smallest_and_says_what_each_sensor_is_for(with_logs: tuple[Path, dict[str, Any]]) -> None:
    (plan,) = with_logs[1]["scenarios"].values()
    assert plan["proven"]
    assert plan["cost"] == plan["lower_bound"] == 12
    assert {need["sensors"] for need in plan["needs"]} == {3}
    assert {check["random_postures"]["rank"] for check in plan["checks"]} == {6}
    for part in plan["parts"]:
        bits = [found["bits"] for found in part["cheapest"]]
        assert bits == sorted(bits, reverse=True)
        assert len(part["minimal_sets"]) == 2
    assert {without["base_rank"] for without in plan["without"]} == {5}


def test_scenarios_are_answered_one_by_one_and_sensors_are_kept_and_excluded(
    without_logs: tuple[Path, dict[str, Any]],
) -> None:
    stand, trot = without_logs[1]["scenarios"].values()
    assert without_logs[1]["accuracy"] is None
    assert (stand["contact_states"], trot["contact_states"][-1]) == ([list(FEET)], [])
    for plan in (stand, trot):
        assert plan["proposed"] is None
        assert {"front_left_foot", "rear_left_foot"} <= set(plan["sensors"])  # the latter for want of a knee
        assert "rear_left_knee" not in plan["sensors"]
    assert stand["stack"]["full"] == 94


def test_the_stack_of_all_samples_needs_far_fewer_sensors(experiment: Path) -> None:
    file = asked(
        experiment,
        analysis={"scenarios": {"step": [list(FEET), list(FEET[1:])]}, "criterion": "stack"},
        output=str(experiment / "stack"),
    )
    assert main(["analyze", str(file)]) == 0
    plan = json.loads((experiment / "stack.analysis" / "analysis.json").read_text())["scenarios"]["step"]
    assert plan["stack"]["rank"] == plan["stack"]["full"]
    assert plan["cost"] < 12
    assert max(without["stack_rank"] for without in plan["without"]) < plan["stack"]["full"]


REFUSED = {
    "a scenario with an unknown frame": ({"scenarios": {"stand": [["paw"]]}}, "analysis.scenarios.stand", "'paw'"),
    "no scenario": ({"scenarios": {}}, "analysis.scenarios", "an empty mapping"),
    "a scenario without states": ({"scenarios": {"stand": []}}, "analysis.scenarios.stand", "an empty list"),
    "a scenario that is no file name": ({"scenarios": {"a/b": [[]]}}, "analysis.scenarios.a/b:", "a name of at most"),
    "scenarios without names": ({"scenarios": [[[]]]}, "analysis.scenarios", "accepted: a mapping"),
    "a kept sensor that is no candidate": ({"keep": ["knee"]}, "analysis.keep", "'knee'"),
    "an excluded sensor that is no candidate": ({"exclude": ["front_left_foot.fx"]}, "analysis.exclude", "foot.fx'"),
    "a sensor kept and excluded": (
        {"keep": ["rear_left_knee"], "exclude": ["rear_left_knee"]}, "is also in exclude", "one of the two",
    ),
    "a candidate joint that does not exist": (
        {"candidates": {"joint_torques": ["knee"]}}, "analysis.candidates.joint_torques", "'knee'",
    ),
    "a cost of nothing": ({"costs": {"joint_torque": 0}}, "analysis.costs.joint_torque", "greater than 0"),
    "a cost of an unknown sensor": ({"costs": {"elbow": 2}}, "analysis.costs", "'elbow'"),
    "an unknown criterion": ({"criterion": "sample"}, "analysis.criterion", "'per_sample' or 'stack'"),
    "an unknown key": ({"scenario": {}}, "analysis", "scenarios"),
    "candidates that do not suffice": (
        {"candidates": {"contacts": "none"}, "exclude": ["rear_left_knee"]}, "candidates", "rear_left_foot",
    ),
    "sets to compare without logs": ({"compare": {"full": "full"}}, "analysis.compare", "logs.train"),
    "a set to compare that is empty": ({"compare": {"none": {}}}, "analysis.compare.none", "no sensor"),
    "a set to compare that reads nothing": (
        {"compare": {"none": {"contact_wrenches": {FEET[0]: []}}}}, "analysis.compare.none", "no sensor",
    ),
    "a set to compare without a name": ({"compare": {"": "full"}}, "analysis.compare", "accepted: a name"),
    "a set to compare with a sensor at no fixed joint": (
        {"compare": {"limb": {"ft_sensors": ["hip"]}}}, "analysis.compare", "needs logs to measure accuracy",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_slip_is_answered_in_one_line_and_nothing_is_written(
    case: str, experiment: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings, field, hint = REFUSED[case]
    file = asked(experiment, analysis=settings)
    message = refusal(["analyze", str(file)], experiment, capsys)
    assert str(file) in message
    assert field in message
    assert hint in message


def test_a_bolted_robot_cannot_lose_its_base(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = {"urdf": str(experiment / "quadruped.urdf"), "fixed_base": True}
    file = asked(experiment, robot=robot, analysis={"criterion": "per_sample"})
    assert "accepted: stack" in refusal(["analyze", str(file)], experiment, capsys)


def test_a_bolted_arm_without_contacts_is_asked_what_the_stack_of_its_log_needs(experiment: Path) -> None:
    time, hz = np.arange(200)[:, None] * 0.01, 1.0 + 0.3 * np.arange(len(TORQUES))
    position, velocity = np.sin(hz * time + np.arange(len(TORQUES))), hz * np.cos(hz * time + np.arange(len(TORQUES)))
    oracle = Oracle(experiment / "quadruped.urdf", TORQUES, fixed_base=True)
    torque = oracle.frictionless_forces(position, velocity, -(hz**2) * position)
    np.savez(
        experiment / "bolted.npz",
        time=time[:, 0],
        joint_names=np.array(TORQUES),
        joint_position=position,
        joint_torque=torque,
    )
    file = asked(
        experiment,
        robot={"urdf": str(experiment / "quadruped.urdf"), "fixed_base": True},
        contacts=[],
        logs={"train": ["bolted.npz"], "test": ["bolted.npz"]},
        sensors="joints",
        output=str(experiment / "bolted"),
    )
    with pytest.warns(TorchidWarning):  # fitted on what it is tested on
        analysis = analyze(load_analysis(file))
    (scenario,) = analysis.scenarios
    assert scenario.plan.problem.criterion == "stack"
    assert scenario.plan.stack_rank == scenario.plan.stack_full == scenario.base.rank - 2 * len(TORQUES)
    assert scenario.plan.cost < len(TORQUES)
    assert set(analysis.accuracies) == {"proposed", "sensor plan for logs"}
    assert {removal.base_rank for removal in scenario.plan.removals} == {None}


WELDS = tuple(f"{leg}_sole" for leg in LEGS)


@pytest.mark.filterwarnings("ignore::torchid.errors.MasslessBodyWarning")
@pytest.mark.usefixtures("figures")
def test_sensors_in_limbs_are_planned_named_and_drawn(experiment: Path) -> None:
    """A dear knee: a three-axis reading of the lower leg's weld takes its place, and the proposal is checked."""
    file = asked(
        experiment,
        sensors={"joint_torques": [*TORQUES[:-3]], "ft_sensors": [WELDS[-1]]},
        analysis={
            "candidates": {"contacts": "none", "ft_sensors": list(WELDS)},
            "costs": {"joint_torque": 3.0, "ft_sensor": 1.0},
            "exclude": [WELDS[0]],
        },
        output=str(experiment / "limbs"),
    )
    assert main(["analyze", str(file)]) == 0
    folder = experiment / "limbs.analysis"
    (answer,) = json.loads((folder / "analysis.json").read_text())["scenarios"].values()
    candidates = {c["name"]: c for c in answer["candidates"]}
    assert [candidates[weld]["channels"] for weld in WELDS] == [6] * 4
    assert set(answer["sensors"]) == {*TORQUES[:3], *WELDS[1:]}
    assert (answer["cost"], answer["proven"]) == (27.0, True)
    assert {check["random_postures"]["rank"] for check in answer["checks"] + answer["proposed"]} == {6}
    assert answer["exclude"] == [WELDS[0]]


def test_an_output_without_a_name_is_refused(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    message = refusal(["analyze", str(asked(experiment, output="/"))], experiment, capsys)
    assert "is not a file or folder name" in message


def test_a_robot_that_cannot_move_is_refused(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inertial = "<mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/>"
    stone = experiment / "stone.urdf"
    stone.write_text(f"<robot name='stone'><link name='stone'><inertial>{inertial}</inertial></link></robot>")
    file = asked(experiment, robot={"urdf": str(stone), "fixed_base": True}, contacts=[])
    assert "accepted: a robot that can move" in refusal(["analyze", str(file)], experiment, capsys)


def test_sensors_that_tell_nothing_leave_nothing_to_determine(experiment: Path) -> None:
    robot, output = {"urdf": str(experiment / "quadruped.urdf"), "fixed_base": True}, experiment / "blind"
    file = asked(experiment, robot=robot, sensors="contacts", analysis={"scenarios": {"air": [[]]}}, output=str(output))
    assert main(["analyze", str(file)]) == 0
    plan = json.loads((experiment / "blind.analysis" / "analysis.json").read_text())["scenarios"]["air"]
    assert (plan["base_parameters"]["rank"], plan["base_parameters"]["gap"]) == (0, None)
