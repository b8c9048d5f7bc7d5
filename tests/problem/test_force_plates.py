"""Wrenches about the world's origin on bolted robots; floating ones are in the oracle's test of rows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import on_plates
from scipy.spatial.transform import Rotation
from synthetic import Oracle, load, make_log
from welded import CONTACTS, STATES, machine

from torchid.logs import Log
from torchid.problem import Evaluation, bind_log
from torchid.problem.metrics import force_series
from torchid.robot import Robot


def measured(robot: Robot, log: Log) -> np.ndarray:
    """S^T tau + J_C^T lambda, (N, n)."""
    builder = Evaluation(robot, CONTACTS).builder
    phi = np.zeros((1, robot.nominal.size))
    return force_series(builder, bind_log(log, robot, CONTACTS), phi)[0]


@pytest.mark.parametrize("pose", ["its own world", "mounted askew somewhere"])
def test_a_bolted_robot_that_pushes_on_plates_feels_the_same_forces(pose: str, tmp_path: Path) -> None:
    robot = load(machine(tmp_path), None, True)
    oracle = Oracle.of(robot)
    contacts = [(contact.frame, len(contact.components)) for contact in CONTACTS]
    log = make_log(oracle, contacts, STATES, 60, np.random.default_rng(2))
    if pose != "its own world":
        log = replace(log, base_quat_xyzw=np.tile(Rotation.from_euler("xyz", [0.4, -0.9, 2.0]).as_quat(), (60, 1)))
    plates = on_plates(oracle, log)
    assert (plates.base_position_world is None) == (pose == "its own world")
    expected = measured(robot, log)
    assert np.abs(measured(robot, plates) - expected).max() < 1e-11 * np.abs(expected).max()
