"""Whole runs through the command line, on the demo and on real logs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from demo import shortened_demo
from loadable import assert_loads
from repository import CONFIGS, DEMO, SHARED
from run_figures import OF_A_RUN
from synthetic import Oracle, random_states
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import torchid
from torchid.cli import main
from torchid.config import load_config
from torchid.estimators.least_squares import VERDICTS
from torchid.parameters import PARAMETERS
from torchid.report import identified_urdf

UNPHYSICAL = "ignore:identified.urdf:torchid.errors.TorchidWarning"


@pytest.fixture
def run(demo_run: Path) -> Path:
    return demo_run


def test_a_run_folder_holds_what_it_promises(run: Path) -> None:
    names = {path.name.split(".")[0] for path in run.iterdir()}
    assert names >= {"config", "parameters", "metrics", "identified", "events", *OF_A_RUN}
    assert [path for path in run.parent.iterdir() if path.name.startswith(".")] == [], "temporary folders left behind"


def test_simulators_take_the_robot_that_a_run_writes(run: Path) -> None:
    assert_loads(run / "identified.urdf", json.loads((run / "metrics.json").read_text())["total_mass"])


def test_resolved_config_reads_back_as_itself(run: Path) -> None:
    config = load_config(run / "config.yaml")
    assert config.robot.urdf == DEMO / "quadruped.urdf"
    assert config.sensors.set == "joints"
    assert yaml.safe_load((run / "config.yaml").read_text())["sensors"]["noise"]["joint_torque"] == 0.1


def test_parameters_json_names_every_body_and_parameter(run: Path) -> None:
    document = json.loads((run / "parameters.json").read_text())
    bodies, robot = document["bodies"], torchid.load_robot(DEMO / "quadruped.urdf")
    assert [body["name"] for body in bodies] == list(robot.body_names)
    for body, nominal in zip(bodies, robot.nominal, strict=True):
        for column in ("nominal", "identified", "standard_error", "identifiable", "data_share", "verdict"):
            assert tuple(body[column]) == PARAMETERS
        np.testing.assert_allclose([body["nominal"][name] for name in PARAMETERS], nominal)
        for name in PARAMETERS:
            assert body["identifiable"][name] == (body["standard_error"][name] is not None)
            assert (body["verdict"][name] in ("identified", "dominated by the prior")) == body["identifiable"][name]
            assert (body["verdict"][name] == "fixed") == (body["data_share"][name] is None)
    verdicts = [verdict for body in bodies for verdict in body["verdict"].values()]
    assert document["verdicts"] == {verdict: verdicts.count(verdict) for verdict in VERDICTS}
    assert bodies[0]["verdict"]["fc"] == "fixed", "the base has no joint"
    assert bodies[1]["identifiable"]["fv"]


def test_metrics_json_has_the_documented_fields(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    groups = ("joint_torque_rms", "joint_torque_rms_by_joint", "base_force_rms", "base_moment_rms", "nullspace_rms")
    groups += ("base_force_rms_by_axis", "base_moment_rms_by_axis")
    for name in ("train", "test"):
        every = (*groups, "projected_residual")
        known = {*every, *(f"{group}_relative" for group in every), "centre_of_pressure_rms"}
        assert set(metrics[name]) == known
        assert (
            0.0 < metrics[name]["centre_of_pressure_rms"] < 0.2 * metrics[f"{name}_nominal"]["centre_of_pressure_rms"]
        )
        assert metrics["base_force_rms_of_variation"][name] > metrics[name]["base_force_rms_relative"]
        assert len(metrics[name]["joint_torque_rms_by_joint"]) == 12
        joints = list(metrics[name]["joint_torque_rms_by_joint"].values())
        assert metrics[name]["joint_torque_rms"] == pytest.approx(np.mean(joints))
    assert metrics["rank"] == 118  # 10 + 7 * 12 inertial, 2 * 12 friction
    assert metrics["parameters"] == 156
    assert metrics["samples"] == 1250


def test_joint_torques_alone_predict_forces_no_sensor_of_the_fit_saw(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    for group in ("base_force_rms", "base_moment_rms", "joint_torque_rms", "nullspace_rms"):
        assert metrics["test"][group] < 0.4 * metrics["test_nominal"][group]
    assert metrics["total_mass"] == pytest.approx(21.347, abs=0.15)  # printed by scripts/make_demo.py


def test_tensorboard_shows_train_and_test_before_and_after(run: Path) -> None:
    events = EventAccumulator(str(run), size_guidance={"images": 0})
    events.Reload()
    for name in ("train", "test"):
        urdf, identified = events.Scalars(f"error_relative_{name}/base_force")
        assert (urdf.step, identified.step) == (0, 1)
        assert identified.value < urdf.value
    assert all(len(events.Scalars(tag)) > 1 for tag in events.Tags()["scalars"]), "no chart is a single dot"
    names = enumerate((*OF_A_RUN, "ridge"), 1)
    assert set(events.Tags()["images"]) == {f"figure_{k}_{name}" for k, name in names}
    assert min(events.Tags()["scalars"]).startswith("error_relative_"), "which TensorBoard shows first"
    text = events.Tensors("answer/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "Much better than the URDF on unseen motion" in text
    mass = json.loads((run / "metrics.json").read_text())["total_mass"]
    assert [event.value for event in events.Scalars("parameter/total_mass")] == pytest.approx([20.8, mass])


def test_evaluating_the_test_log_again_gives_the_same_figures(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(run), "--log", str(DEMO / "sway_test.npz"), "--output", str(tmp_path / "again")]) == 0
    assert "sway_test" in capsys.readouterr().out
    found = json.loads((tmp_path / "again" / "metrics.json").read_text())["sway_test"]
    expected = json.loads((run / "metrics.json").read_text())
    assert found["identified"] == expected["test"]
    assert found["nominal"]["base_force_rms"] == pytest.approx(expected["test_nominal"]["base_force_rms"])


@pytest.mark.parametrize("damage", [("NaN", "m"), ('"1.0"', "fv")], ids=["NaN", "text"])
def test_parameters_that_are_no_numbers_are_not_evaluated(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], damage: tuple[str, str]
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    document = json.loads((copy / "parameters.json").read_text())
    document["bodies"][3]["identified"][damage[1]] = json.loads(damage[0])
    (copy / "parameters.json").write_text(json.dumps(document))
    assert main(["evaluate", str(copy), "--log", str(DEMO / "sway_test.npz")]) == 2
    printed = capsys.readouterr().err
    assert f"identified.{damage[1]}" in printed
    assert document["bodies"][3]["name"] in printed


@pytest.mark.slow("a search for the mistake")
def test_torques_of_no_robot_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    demo_with(tmp_path / "demo", joint_torque=lambda torque: 50.0 * rng.normal(size=torque.shape))
    assert main(["identify", str(tmp_path / "demo" / "quadruped.yaml"), f"output={tmp_path / 'run'}"]) == 2
    assert "the fit does not explain " in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "run").exists()


def demo_with(folder: Path, **changes: Callable[[Any], Any]) -> None:
    """The demo, shortened, with fields of its training log changed."""
    shortened_demo(folder, 400)
    with np.load(folder / "sway_train.npz") as log:
        fields = dict(log)
    np.savez(folder / "sway_train.npz", **fields | {name: change(fields[name]) for name, change in changes.items()})


def test_identified_urdf_moves_as_its_parameters_say(tmp_path: Path) -> None:
    robot = torchid.load_robot(DEMO / "quadruped.urdf")
    rng = np.random.default_rng(0)
    phi = robot.nominal * rng.uniform(0.9, 1.1, (len(robot.bodies), 1))
    phi[1:, 10:] = rng.uniform(0.1, 0.5, (12, 2))
    path = tmp_path / "identified.urdf"
    path.write_bytes(identified_urdf(robot, phi))
    oracle = Oracle(path, robot.joint_names)
    q, v, a = random_states(rng, robot.n, 20)
    inertial = phi.copy()
    inertial[:, 10:] = 0.0
    predicted = torchid.Regressor(robot)(*map(torch.tensor, (q, v, a))) @ torch.tensor(inertial).flatten()
    expected = oracle.frictionless_forces(q, v, a)
    np.testing.assert_allclose(predicted.numpy(), expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.skipif(not SHARED.is_dir(), reason="the recorded human squats (../shared/data) are not here")
@pytest.mark.filterwarnings(UNPHYSICAL)
@pytest.mark.slow("recordings of a person, as configs/human_squats.yaml fits them")
def test_force_plates_alone_identify_a_person_who_then_squats_differently(tmp_path: Path) -> None:
    """The ridge was chosen by leaving blocks of the training log out (see configs/human_squats.yaml)."""
    config = CONFIGS / "human_squats.yaml"
    assert main(["identify", str(config), f"output={tmp_path / 'run'}"]) == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["test"]["base_force_rms_relative"] <= 0.02
    assert metrics["test_nominal"]["base_force_rms_relative"] == pytest.approx(0.048, abs=0.001)
    assert abs(metrics["total_mass"] - 60.03) <= 0.5
    assert_loads(tmp_path / "run" / "identified.urdf", metrics["total_mass"])
    assert metrics["test"]["joint_torque_rms"] is None
    assert metrics["test"]["nullspace_rms"] is None


def test_logs_of_one_name_are_not_evaluated_as_one(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = str(DEMO / "sway_test.npz")
    assert main(["evaluate", str(run), "--log", log, "--log", log]) == 2
    assert "several logs named 'sway_test'" in capsys.readouterr().err


def test_positions_in_degrees_stop_a_run_that_names_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo_with(tmp_path / "demo", joint_position=np.rad2deg)
    assert main(["identify", str(tmp_path / "demo" / "quadruped.yaml")]) == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "torchid check finds in sway_train.npz: joint_position: " in told
    assert "degrees?; accepted: convert joint_position" in told
