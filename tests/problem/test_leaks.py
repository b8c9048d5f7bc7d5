"""No sensor outside the set reaches the estimate, from the log on: contact flags fixed, everything else wild."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from motions import value
from simulated import BIPED, LIFTING, SOLES
from synthetic import Array, load

from torchid.estimators import Estimate, LeastSquares
from torchid.logs import Log, read_log
from torchid.logs.preprocess import preprocess
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.sensing import Contact, SensorSet, chosen_sensors, named_sensors

CONTACTS = [Contact(frame, "flat") for frame in SOLES]
ROBOT = load(BIPED)


@pytest.fixture(scope="module")
def log(biped_folder: Path) -> Log:
    """A noisy log of a robot that stands on both feet, on its left and on its right one."""
    log = read_log(biped_folder / "logs" / f"{LIFTING}.npz")
    assert {tuple(row) for row in value(log.contact_active)} == {(True, True), (True, False), (False, True)}
    return log


def estimate(log: Log, sensors: SensorSet) -> Estimate:
    samples = bind_log(preprocess(log, 10.0, 200.0), ROBOT, CONTACTS, required=sensors)
    builder = RowBuilder(ROBOT, CONTACTS, sensors)
    return LeastSquares(1e-4).solve(linear_problem(compress([samples], builder), builder, ROBOT))


def wild(values: Array) -> Array:
    return 1e3 * np.random.default_rng(3).normal(size=values.shape)


def assert_same(found: Estimate, expected: Estimate) -> None:
    np.testing.assert_array_equal(found.phi, expected.phi)
    np.testing.assert_array_equal(found.standard_error, expected.standard_error)


def test_joints_only_never_sees_a_wrench(log: Log) -> None:
    sensors = named_sensors("joints", ROBOT.n, 2)
    other = replace(log, contact_wrench_local=wild(value(log.contact_wrench_local)))
    assert_same(estimate(other, sensors), estimate(log, sensors))
    assert_same(estimate(replace(log, contact_wrench_local=None), sensors), estimate(log, sensors))


def test_contacts_only_never_sees_a_torque(log: Log) -> None:
    sensors = named_sensors("contacts", ROBOT.n, 2)
    assert_same(estimate(replace(log, joint_torque=wild(value(log.joint_torque))), sensors), estimate(log, sensors))
    assert_same(estimate(replace(log, joint_torque=None), sensors), estimate(log, sensors))


def test_a_set_chosen_by_name_sees_its_own_sensors_and_no_other(log: Log) -> None:
    right = [name for name in ROBOT.joint_names if name.startswith("r_")]
    sensors = chosen_sensors(ROBOT.joint_names, CONTACTS, right, {"l_sole": ["fx", "fy", "fz", "mx", "my", "mz"]})
    torque, wrench = value(log.joint_torque).copy(), value(log.contact_wrench_local).copy()
    unread = [i for i, name in enumerate(log.joint_names) if name not in right]
    torque[:, unread] = wild(torque[:, unread])
    wrench[:, 1] = wild(wrench[:, 1])
    expected = estimate(log, sensors)
    assert_same(estimate(replace(log, joint_torque=torque, contact_wrench_local=wrench), sensors), expected)
    torque[:, log.joint_names.index(right[0])] += 1.0
    assert (estimate(replace(log, joint_torque=torque, contact_wrench_local=wrench), sensors).phi != expected.phi).any()
