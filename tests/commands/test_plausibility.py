"""Fits that no robot can have produced, or that predict worse than the URDF, and what the checks of the logs say."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demo import FAST_ESTIMATOR
from repository import DEMO
from synthetic import UR5, Oracle, load, make_log
from urdfs import inertial, joint, link, write

import torchid
from torchid.cli import main
from torchid.commands.plausibility import force_gain, implausibility
from torchid.estimators import LeastSquares
from torchid.identifiability.confounding import TotalMass
from torchid.problem import (
    LinearProblem,
    RowBuilder,
    bind_log,
    compress,
    linear_problem,
)
from torchid.sensing import named_sensors

RIDGE = f"estimator={json.dumps(FAST_ESTIMATOR)}"

# ---------------------------------------------------------------------------------------------- whole runs


def reversed_torques(log: dict[str, Any]) -> None:
    log["joint_torque"] = -log["joint_torque"]


def silent_torques(log: dict[str, Any]) -> None:
    log["joint_torque"] = np.zeros_like(log["joint_torque"])


def downward_world(log: dict[str, Any]) -> None:
    w, x, y, z = log["base_quat_wxyz"].T
    log["base_quat_wxyz"] = np.stack([-x, w, -z, y], axis=1)
    log["base_position_world"] = log["base_position_world"] * [1, -1, -1]


def exchanged_legs(log: dict[str, Any]) -> None:
    """Torques of front legs for those of rear ones, whose positions are right."""
    log["joint_torque"] = np.roll(log["joint_torque"], 6, axis=1)


def in_degrees(log: dict[str, Any]) -> None:
    log["joint_position"] = np.rad2deg(log["joint_position"])


def changed(folder: Path, change: Callable[[dict[str, Any]], None], samples: int = 600) -> list[str]:
    """Overrides for the demo with shortened and changed logs."""
    for name in ("train", "test"):
        with np.load(DEMO / f"sway_{name}.npz") as file:
            log = dict(file)
        log = {key: x if key.endswith("names") else x[:samples] for key, x in log.items()}
        change(log)
        np.savez(folder / f"{name}.npz", **log)
    return [f"logs.train=[{folder}/train.npz]", f"logs.test=[{folder}/test.npz]", f"output={folder}/run"]


@pytest.mark.slow("a search for each mistake")
@pytest.mark.parametrize(
    ("change", "options", "told"),
    [
        (
            silent_torques,
            ["sensors.set=joints", RIDGE],
            ("all measured forces are 0", "NaN: not measured"),
        ),
        (reversed_torques, ["sensors.set=joints", RIDGE], ("total mass is -21.", "opposite sign", "all reversed")),
        (
            exchanged_legs,
            ["sensors.set=full", "sensors.noise={}", RIDGE],
            (
                "the fit does not explain ",
                "% of the joint torques; torchid check finds in train.npz: joint_torque: front and",
            ),
        ),
        (downward_world, ["sensors.set=joints", RIDGE], ("total mass is -", "opposite sign")),
        (in_degrees, ["sensors.set=joints", RIDGE], ("torchid check finds in train.npz: joint_position", "degrees")),
    ],
    ids=lambda x: x.__name__ if callable(x) else "".join(x),
)
def test_what_no_robot_can_be_ends_the_run_in_one_line_that_says_what_it_points_to(
    tmp_path: Path,
    change: Callable[[dict[str, Any]], None],
    options: list[str],
    told: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = changed(tmp_path, change)
    assert main(["identify", str(DEMO / "quadruped.yaml"), *before, *options]) == 2
    printed = capsys.readouterr()
    assert len(printed.err.splitlines()) == 1
    assert printed.out == ""
    for text in told:
        assert text in printed.err
    assert not (tmp_path / "run").exists()


def scalars_of_the_feet(log: dict[str, Any]) -> None:
    """Sizes of the feet's forces, entered as if they were all along one oblique axis of the frames."""
    wrench = np.zeros_like(log["contact_wrench_local"])
    wrench[..., :3] = np.linalg.norm(log["contact_wrench_local"][..., :3], axis=-1, keepdims=True) / np.sqrt(3.0)
    log["contact_wrench_local"] = wrench


@pytest.mark.slow("a search for the mistake")
def test_a_fit_that_predicts_worse_than_the_urdf_says_so_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [
        *changed(tmp_path, scalars_of_the_feet),
        "sensors.set=contacts",
        "estimator={name: least_squares, ridge: 1.0e-5}",
    ]
    assert main(["identify", str(DEMO / "quadruped.yaml"), *options]) == 0
    printed = capsys.readouterr()
    headline, *_ = printed.out.splitlines()
    assert headline.startswith("WORSE THAN URDF (URDF -> identified) on ")
    assert "NumericalWarning" in printed.err
    assert "WORSE THAN URDF (URDF -> identified) on blocks left out of the fit: joint torque" in printed.err
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["verdict"] in printed.err
    worse = {(x["logs"], x["group"]): x for x in metrics["worse_than_nominal"]}
    found = worse["test logs", "joint_torque"]
    assert found["identified"] == metrics["test"]["joint_torque_rms"] > metrics["test_nominal"]["joint_torque_rms"]


# ------------------------------------------------------------------------------------------------- what no robot can be


def arm_problem(factor: float = 1.0) -> tuple[LinearProblem, torchid.Robot]:
    robot = load(UR5, fixed_base=True)
    log = make_log(Oracle.of(robot), [], [()], 200, np.random.default_rng(0))
    log = replace(log, joint_torque=factor * np.asarray(log.joint_torque))
    builder = RowBuilder(robot, [], named_sensors("joints", robot.n, 0))
    return linear_problem(compress([bind_log(log, robot, [])], builder), builder, robot), robot


@pytest.mark.parametrize(
    ("mass", "determined", "stops"),
    [
        (TotalMass(0.1, True, -65.9, 15.0), True, True),
        (TotalMass(0.1, True, 16.0, 15.0), True, False),
        (TotalMass(0.1, True, 151.0, 15.0), True, True),
        (TotalMass(20.0, True, -5.0, 15.0), False, False),
        (TotalMass(0.1, False, -5.0, 15.0), False, False),
        (TotalMass(float("inf"), True, -5.0, 15.0), False, False),
    ],
)
def test_a_total_mass_counts_where_the_data_determine_it(mass: TotalMass, determined: bool, stops: bool) -> None:
    problem, robot = arm_problem()
    assert mass.determined is determined
    assert (implausibility(problem, problem.nominal, mass, robot) is not None) is stops


@pytest.mark.parametrize(("factor", "stops"), [(1.0, False), (3.0, False), (-1.0, True), (1e3, True), (1e-3, True)])
def test_an_arm_s_torques_of_the_wrong_sign_or_unit_are_noticed_without_a_total_mass(
    factor: float, stops: bool
) -> None:
    problem, robot = arm_problem(factor)
    assert force_gain(problem) == pytest.approx(factor, rel=1e-6)
    estimate, unknown = LeastSquares().solve(problem), TotalMass(float("inf"), True, -3.0, 18.0)
    found = implausibility(problem, estimate.phi, unknown, robot)
    assert (found is not None) is stops
    assert ("opposite sign" in (found or "")) is (factor < 0.0)


def test_a_single_body_may_break_conditions_but_not_be_beyond_all_bounds() -> None:
    problem, robot = arm_problem()
    unknown, phi = TotalMass(float("inf"), True, 0.0, 18.0), problem.nominal.copy()
    phi[12] = -3.0  # seen in combination with others only: a condition that is broken, and no more
    assert implausibility(problem, phi, unknown, robot) is None
    phi[12] = 1e11
    assert "shoulder_link has m = 1e+11" in (implausibility(problem, phi, unknown, robot) or "")
    phi[12], phi[22] = 3.0, 3.9e161
    assert "fc = 3.9e+161" in (implausibility(problem, phi, unknown, robot) or "")


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["right", "reversed"])
def test_forces_of_bodies_that_cannot_exist_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sign: float
) -> None:
    limit = '<limit lower="-2" upper="2" effort="99" velocity="9"/>'
    slides = [
        joint(name, parent, child, "prismatic", f'<axis xyz="{axis}"/>{limit}')
        for name, parent, child, axis in (("x", "base", "bridge", "1 0 0"), ("y", "bridge", "head", "0 1 0"))
    ]
    urdf = write(tmp_path, link("base"), link("bridge"), link("head", inertial(mass="0.2")), *slides)
    time = np.arange(2000) / 100.0
    rate = 2.0 * np.pi * np.array([0.5, 0.7])
    position = np.sin(rate * time[:, None])
    force = np.array([1.3, sign * 0.25]) * -(rate**2) * position  # [N] of 1.05 and 0.25 kg
    force = force + 0.05 * np.random.default_rng(0).normal(size=force.shape)
    names = np.array(["x", "y"])
    np.savez(tmp_path / "log.npz", time=time, joint_names=names, joint_position=position, joint_torque=force)
    settings = {
        "robot": {"urdf": urdf.name, "fixed_base": True},
        "logs": {"train": ["log.npz[:80%]"], "test": ["log.npz[80%:]"]},
        "preprocessing": {"cutoff_hz": 5},
        "sensors": "joints",
        "estimator": {"name": "consistent", "ridge": 1e-4},
        "output": str(tmp_path / "run"),
    }
    (tmp_path / "stage.yaml").write_text(json.dumps(settings))
    assert main(["identify", str(tmp_path / "stage.yaml")]) == 0
    assert ("No physically consistent bodies explain these forces" in capsys.readouterr().out) == (sign < 0.0)
