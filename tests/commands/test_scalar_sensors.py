"""Whole runs with sensors of the force along the ground's normal, on the demo's quadruped."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from demo import DEMO, WITHOUT_TERMS_LINE
from motions import value
from refusals import refusal
from scipy.spatial.transform import Rotation

from torchid.cli import main
from torchid.logs import read_log, write_log
from torchid.robot import load_robot

FEET = tuple(f"{end}_{side}_foot" for end in ("front", "rear") for side in ("left", "right"))
pytestmark = [
    pytest.mark.filterwarnings("ignore:identified.urdf:torchid.errors.TorchidWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.NumericalWarning"),
    pytest.mark.filterwarnings("ignore::torchid.errors.ConfoundedWarning"),
]
SAMPLES = 300
EVERY_FOOT = ", ".join(f"{foot}: [fn]" for foot in FEET)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's experiment file with logs of insoles in place of wrenches."""
    folder = tmp_path_factory.mktemp("insoles")
    robot = load_robot(DEMO / "quadruped.urdf")
    for name in ("sway_train", "sway_test"):
        log = read_log(DEMO / f"{name}.npz").select(slice(0, SAMPLES))
        assert log.contact_wrench_local is not None
        order = [log.joint_names.index(joint) for joint in robot.joint_names]
        poses = robot.link_poses(torch.from_numpy(log.joint_position[:, order]))
        up = Rotation.from_quat(value(log.base_quat_xyzw)).inv().apply([0.0, 0.0, 1.0])
        force = np.stack(
            [
                np.einsum("ni,nij,nj->n", up, poses[foot][:, :3, :3].numpy(), log.contact_wrench_local[:, c, :3])
                for c, foot in enumerate(log.contact_names)
            ],
            axis=1,
        )
        write_log(replace(log, contact_wrench_local=None, contact_force_normal=force), folder / f"{name}.npz")
    text = (DEMO / "quadruped.yaml").read_text().replace("quadruped.urdf", str(DEMO / "quadruped.urdf"))
    assert "ridge: auto" in text
    text = text.replace("ridge: auto", "ridge: 0.01")
    joints = ", ".join(robot.joint_names)
    assert "  set: joints\n" in text
    chosen = f"  joint_torques: [{joints}]\n  contact_wrenches: {{{EVERY_FOOT}}}\n"
    (folder / "run.yaml").write_text(text.replace("  set: joints\n", chosen) + WITHOUT_TERMS_LINE)
    return folder / "run.yaml"


@pytest.mark.parametrize(
    ("command", "override", "message"),
    [
        ("identify", "sensors=full", "contact_wrench: missing; accepted: contact_wrench_local or contact_wrench_"
         "world, or sensors.contact_wrenches: {FRAME: [fn]} to use contact_force_normal"),
        ("identify", f"sensors.contact_wrenches={{{FEET[0]}: [fn, fz]}}",
         f"sensors.contact_wrenches.{FEET[0]}: 'fz', but this sensor measures only 'fn'"
         "; accepted: [fn], or wrench components without fn"),
        ("identify", "sensors.contact_wrenches={paw: [fn]}", "sensors.contact_wrenches: unknown name 'paw'"),
        ("analyze", "analysis.candidates.normal_forces=[paw]",
         "analysis.candidates.normal_forces: unknown name 'paw'; accepted: "),
        ("analyze", f"analysis.candidates={{contacts: axis, normal_forces: [{FEET[0]}]}}",
         f"analysis.candidates.normal_forces: {FEET[0]}, but candidates.contacts is axis; accepted: "
         "candidates.contacts: device or none"),
        ("analyze", "analysis.compare={left: {contact_wrenches: {front_left_foot: [fx]}}}",
         "analysis.compare.left.contact_wrenches.front_left_foot: 'fx', but this sensor measures only 'fn'"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_in_one_line(
    experiment: Path, command: str, override: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [command, str(experiment), override, f"output={experiment.parent / 'runs/none'}"]
    assert message in refusal(arguments, experiment.parent, capsys)


def analyzed(experiment: Path, name: str, *overrides: str) -> dict[str, Any]:
    """The document of an analysis with cheap scalar sensors among the candidates."""
    output = experiment.parent / "runs" / name
    offered = f"analysis.candidates.normal_forces=[{', '.join(FEET)}]"
    costs = "analysis.costs.normal_force=0.5"
    assert main(["analyze", str(experiment), offered, costs, *overrides, f"output={output}"]) == 0
    answers: dict[str, Any] = json.loads((output.with_name(f"{name}.analysis") / "analysis.json").read_text())
    return answers


@pytest.mark.slow("two analyses")
def test_analyze_plans_with_scalar_sensors_and_measures_the_plan(
    experiment: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each leg needs three readings, of which the cheap one at the foot is one."""
    answers = analyzed(experiment, "planned")
    (plan,) = answers["scenarios"].values()
    assert (plan["cost"], plan["proven"]) == (10.0, True)
    assert [name for name in plan["sensors"] if "foot" in name] == [f"{foot}.fn" for foot in FEET]
    assert {"name": f"{FEET[0]}.fn", "channels": 1, "cost": 0.5} in plan["candidates"]
    for part in plan["parts"]:
        assert len(part["minimal_sets"]) == 5
        assert len(part["cheapest"]) == 3
    assert {check["random_postures"]["rank"] for check in plan["checks"]} == {6}
    found = answers["accuracy"]
    assert set(found) == {"proposed", "sensor plan for logs"}
    assert (found["proposed"]["channels"], found["sensor plan for logs"]["channels"]) == (16, 12)
    assert found["proposed"]["rank"] == 118
    errors = [found[name]["measured"]["nullspace"] for name in ("proposed", "sensor plan for logs")]
    assert 0.0 < errors[0] < errors[1] < 0.5, "fewer sensors, larger errors"  # 0.04 and 0.25 were found
    assert "smallest set  12 sensors, cost 10, no cheaper set exists: " in capsys.readouterr().out
    joints = ", ".join(name for name in plan["sensors"] if "foot" not in name)
    again = analyzed(experiment, "as_planned", f"sensors.joint_torques=[{joints}]")
    (scenario,) = again["scenarios"].values()
    assert set(again["accuracy"]) == {"proposed"}, "it is the plan"
    assert scenario["proposed"] == scenario["checks"]
