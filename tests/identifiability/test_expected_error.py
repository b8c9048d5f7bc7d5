"""Errors that are expected of a fit are those that repeated fits make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from synthetic import SOLO12, load
from thinned import each_once

from torchid.estimators import LeastSquares
from torchid.identifiability.base_parameters import structural_samples
from torchid.identifiability.information import error_directions, expected_errors
from torchid.problem import Evaluation, LinearProblem, RowBuilder, Samples, compress, linear_problem
from torchid.problem.metrics import ROW_GROUPS
from torchid.robot import Robot
from torchid.sensing import Contact, SensorNoise, named_sensors

CONTACTS = tuple(Contact(f"{leg}_FOOT", "point") for leg in ("FL", "FR", "HL", "HR"))
STATES = ((True,) * 4, (True, False, False, True))
NOISE = SensorNoise(joint_torque=0.3, contact_force=2.0, contact_moment=0.2)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load(SOLO12)


@pytest.fixture(scope="module")
def logs(robot: Robot) -> list[Samples]:
    return structural_samples(robot, CONTACTS, STATES, 120)


def problem_of(robot: Robot, logs: list[Samples], sensors: str) -> LinearProblem:
    builder = RowBuilder(robot, CONTACTS, named_sensors(sensors, robot.n, len(CONTACTS), NOISE))
    return linear_problem(compress(logs, builder), builder, robot)


def rms(robot: Robot, logs: list[Samples], phi: np.ndarray) -> dict[str, float]:
    """Rms over parameter vectors, (M, 12 L), of the forces K phi by group of rows; of joints the mean of each one's."""
    silent = [
        replace(log, torque=torch.zeros_like(log.torque), wrench=torch.zeros_like(log.wrench))  # type: ignore[arg-type]
        for log in logs
    ]
    found = Evaluation(robot, CONTACTS).metrics(silent, phi)
    by_joint = np.array([[m.by_joint_rms[joint] for joint in robot.joint_names] for m in found], dtype=float)
    out = {group: float(np.sqrt(np.mean([m.rms[group] ** 2 for m in found]))) for group in ROW_GROUPS}  # type: ignore[operator]
    return out | {"joint_torque": float(np.sqrt(np.square(by_joint).mean(0)).mean())}


@pytest.mark.parametrize(("sensors", "ridge"), each_once(["joints", "contacts"], [0.0, 0.3]))
def test_repeated_fits_from_wrong_urdfs_and_noisy_sensors_are_as_far_off_as_expected(
    robot: Robot, logs: list[Samples], sensors: str, ridge: float
) -> None:
    problem, prior_error, draws = problem_of(robot, logs, sensors), 0.2, 120
    rng = np.random.default_rng(5)
    off = np.empty((draws, len(problem.nominal)))
    for draw in range(draws):
        true = problem.nominal + prior_error * problem.free * problem.scale * rng.normal(size=len(problem.nominal))
        noisy = problem.A @ true + rng.normal(size=len(problem.A))
        off[draw] = LeastSquares(ridge).solve(replace(problem, b=noisy, residual=float(problem.rows))).phi - true
    directions = error_directions(problem, ridge, 1.0, prior_error)
    expected = expected_errors(Evaluation(robot, CONTACTS).builder, logs, directions, NOISE).model
    for group, found in rms(robot, logs, off).items():
        assert expected[group] == pytest.approx(found, rel=0.15), group


def test_the_noise_of_the_sensors_that_predictions_are_compared_with_is_as_expected(
    robot: Robot, logs: list[Samples]
) -> None:
    generator = torch.Generator().manual_seed(3)
    evaluation, squares, draws = Evaluation(robot, CONTACTS), dict.fromkeys(ROW_GROUPS, 0.0), 30
    without_floors = replace(NOISE, base_force=0.0, base_moment=0.0)
    for _ in range(draws):
        noisy = []
        for log in logs:
            assert log.torque is not None
            assert log.wrench is not None
            torque = NOISE.joint_torque * torch.randn(log.torque.shape, generator=generator, dtype=torch.float64)
            wrench = torch.randn(log.wrench.shape, generator=generator, dtype=torch.float64)
            noisy.append(replace(log, torque=torque, wrench=wrench * torch.from_numpy(NOISE.wrench_std)))
        for group, value in evaluation.metrics(noisy, np.zeros((1, robot.nominal.size)))[0].rms.items():
            assert value is not None
            squares[group] += value**2 / draws
    expected = expected_errors(evaluation.builder, logs, np.zeros((1, robot.nominal.size)), without_floors)
    for group in ROW_GROUPS:
        assert expected.sensors[group] == pytest.approx(np.sqrt(squares[group]), rel=0.03), group
        assert expected.total[group] == expected.sensors[group]
    with_floors = expected_errors(evaluation.builder, logs, np.zeros((1, robot.nominal.size)), NOISE).sensors
    for group, floor in (("base_force", NOISE.contact_force), ("base_moment", NOISE.contact_moment)):
        assert with_floors[group] == pytest.approx(np.hypot(expected.sensors[group] or 0.0, floor))
    assert with_floors["joint_torque"] == expected.sensors["joint_torque"]
