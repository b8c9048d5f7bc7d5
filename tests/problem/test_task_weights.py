"""Weights by control task: what a fit minimizes, and what does not depend on them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from demo import shortened_demo
from random_samples import NOISE, random_samples, sensor_set
from repository import ROOT
from synthetic import PANDA, Array, load

import torchid
from torchid.cli import main
from torchid.fitting.noise import mean_noise_square
from torchid.problem import RowBuilder, compress

ROBOT = torchid.load_robot(Path(torchid.__file__).parent / "demo" / "quadruped.urdf")
FEET = [torchid.Contact(f"{end}_{side}_foot", "point") for end in ("front", "rear") for side in ("left", "right")]
FORCE = [0, 1, 2]  # of the six components of a wrench, those that a point contact exerts
SAMPLES, STATE = random_samples(ROBOT, FEET, 40, 0)
WEIGHTS = np.random.default_rng(4).uniform(0.2, 5.0, ROBOT.n_rows)
SETS = ("full", "contacts", "joints", "mixed")


def least_over_unmeasured_forces(sensors: torchid.SensorSet, phi: Array) -> float:
    """Sum over the samples of the least square of S^-1/2 D (K phi - f - A_x^T x) over all x, by plain lstsq."""
    q, v, a = map(torch.from_numpy, STATE)
    K = torchid.Regressor(ROBOT)(q, v, a).numpy()
    J = torch.cat([torchid.FrameJacobian(ROBOT, foot.frame)(q)[:, FORCE] for foot in FEET], dim=1).numpy()
    wrench, torque = SAMPLES.wrench[..., FORCE].flatten(1).numpy(), SAMPLES.torque.numpy()
    std = np.concatenate([NOISE.base_std, np.full(ROBOT.n, NOISE.joint_torque)])
    total = 0.0
    for number, active in enumerate(np.repeat(SAMPLES.active.numpy(), 3, axis=1)):
        measured = sensors.wrench[:, FORCE].flatten() & active
        J_m, J_x = J[number, measured], J[number, active & ~measured]
        f = np.append(np.zeros(6), np.where(sensors.torque, torque[number], 0.0)) + J_m.T @ wrench[number, measured]
        A_x = np.vstack([J_x, np.eye(ROBOT.n_rows)[6:][~sensors.torque]])
        S = np.diag(std**2) + NOISE.contact_force**2 * J_m.T @ J_m
        white = np.linalg.solve(np.linalg.cholesky(S), np.diag(sensors.task_weights))
        error, directions = white @ (K[number] @ phi - f), white @ A_x.T
        total += float(np.square(error - directions @ np.linalg.lstsq(directions, error, rcond=1e-12)[0]).sum())
    return total


@pytest.mark.parametrize("name", SETS)
def test_rows_are_the_weighted_errors_that_no_unmeasured_force_can_make(name: str) -> None:
    sensors = replace(sensor_set(name, ROBOT, FEET), task_weights=WEIGHTS)
    builder = RowBuilder(ROBOT, FEET, sensors)
    triangle = compress([SAMPLES], builder).triangle().numpy()
    for seed in range(3):
        phi = np.random.default_rng(seed).normal(size=12 * len(ROBOT.bodies))
        at = np.append(builder.to_columns(phi[None])[0].numpy(), -1.0)
        squares = float(np.square(triangle @ at).sum())
        assert squares == pytest.approx(least_over_unmeasured_forces(sensors, phi), rel=1e-10)


@pytest.mark.parametrize("name", SETS)
def test_noise_leaves_rows_of_one_but_for_weights(name: str) -> None:
    sensors = sensor_set(name, ROBOT, FEET)
    assert mean_noise_square([SAMPLES], RowBuilder(ROBOT, FEET, sensors)) == pytest.approx(1.0, rel=1e-10)
    weighted = RowBuilder(ROBOT, FEET, replace(sensors, task_weights=3.0 * np.ones(ROBOT.n_rows)))
    assert mean_noise_square([SAMPLES], weighted) == pytest.approx(9.0, rel=1e-10)


@pytest.fixture
def demo(tmp_path: Path) -> Path:
    return shortened_demo(tmp_path / "demo", 600) / "quadruped.yaml"


def run(demo: Path, *overrides: str) -> bytes:
    output = demo.parent / "run"
    assert main(["identify", str(demo), *overrides, f"output={output}", "overwrite=true", "--quiet"]) == 0
    return (output / "parameters.json").read_bytes()


@pytest.mark.filterwarnings("ignore::torchid.errors.TorchidWarning")
def test_weights_of_one_are_no_weights_to_the_last_bit(demo: Path) -> None:
    plain = run(demo)
    assert run(demo, "estimator.task_weights={joint_torque: 1, base_force: [1, 1, 1]}") == plain
    assert run(demo, "estimator.task_weights={joint_torque: {'*': 1, '*_knee': 5}}") != plain


@pytest.mark.parametrize(
    ("override", "says"),
    [
        (
            "{joint_torque: {'*': 1, '*_elbow': 5}}",
            "task_weights.joint_torque: unknown name '*_elbow'; accepted: front_",
        ),
        ("{joint_torque: {'*_knee': 5}}", "task_weights.joint_torque: no weight for front_left_hip; accepted: one for"),
        ("{base_force: 0}", "task_weights.base_force: found 0; accepted: a number greater than 0, or three"),
        ("{base: 2}", "task_weights: unknown name 'base'; accepted: base_force, base_moment"),
    ],
)
def test_a_mistake_is_one_line(demo: Path, override: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(demo), f"estimator.task_weights={override}", f"output={demo.parent / 'run'}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert says in line


def test_a_fixed_base_has_no_axes_to_weigh(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm = ROOT / "configs" / "kuka_lwr4.yaml"
    assert main(["identify", str(arm), "estimator.task_weights={base_force: 2}", f"output={tmp_path / 'run'}"]) == 2
    assert (
        "estimator.task_weights: base_force or base_moment of a fixed base; accepted: joint_torque"
        in capsys.readouterr().err
    )


def test_weights_of_a_bolted_arm_weigh_its_joints() -> None:
    arm = load(PANDA, fixed_base=True)
    samples = random_samples(arm, [], 20, 1)[0]
    sensors, weights = torchid.named_sensors("joints", arm.n, 0, NOISE), np.arange(1.0, arm.n + 1.0)
    plain, _ = RowBuilder(arm, [], sensors).rows_by_sample(samples, ())
    weighted, _ = RowBuilder(arm, [], replace(sensors, task_weights=weights)).rows_by_sample(samples, ())
    torch.testing.assert_close(weighted, torch.from_numpy(weights)[:, None] * plain, rtol=1e-10, atol=1e-12)
