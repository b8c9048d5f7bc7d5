"""What the noise of readings leaves in measured forces: what noise that is added leaves in them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demo import DEMO
from synthetic import Oracle, load, make_log
from welded import CONTACTS, SENSORS, STATES, machine

from torchid.config import load_config
from torchid.fitting.experiment import set_up
from torchid.logs import read_log
from torchid.logs.preprocess import preprocess
from torchid.parameters import Array
from torchid.problem import Samples, bind_log
from torchid.problem.metrics import Evaluation, force_series, noise_series
from torchid.robot import Robot
from torchid.sensing import SensorNoise

NOISE = SensorNoise(joint_torque=0.3, contact_force=2.0, contact_moment=0.1, ft_force=1.5, ft_moment=0.05)


@pytest.fixture(params=[False, True], ids=["floating", "bolted"])
def recorded(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Robot, Oracle, Samples]:
    """A robot with contacts and sensors in limbs, its oracle, and samples of a log."""
    robot, rng = load(machine(tmp_path), None, request.param, SENSORS), np.random.default_rng(0)
    oracle = Oracle.of(robot)
    contacts = [(contact.frame, contact.components) for contact in CONTACTS]
    return robot, oracle, bind_log(make_log(oracle, contacts, STATES, 24, rng), robot, CONTACTS)


def rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def test_noise_enters_rows_through_sensors_and_contact_jacobians(recorded: tuple[Robot, Oracle, Samples]) -> None:
    robot, oracle, samples = recorded
    base, builder = robot.base_rows, Evaluation(robot, CONTACTS).builder
    q = samples.coordinates()[0].numpy()
    expected = np.zeros((24, robot.n_rows))
    expected[:, base:] += NOISE.dof_std(robot.n, robot.n_dofs) ** 2
    for number, contact in enumerate(CONTACTS):
        J = oracle.jacobian(q, contact.frame)[:, list(contact.components)]
        std = NOISE.wrench_std[list(contact.components)]
        touching = samples.active[:, number].numpy()
        expected[touching] += np.square(J * std[:, None]).sum(1)[touching]
    np.testing.assert_allclose(noise_series(builder, samples, NOISE), np.sqrt(expected), rtol=1e-10)
    filtered = replace(samples, oversampling=4.0)
    np.testing.assert_allclose(noise_series(builder, filtered, NOISE), np.sqrt(expected / 4.0), rtol=1e-10)


def test_metrics_have_the_rms_of_the_noise_by_group(recorded: tuple[Robot, Oracle, Samples]) -> None:
    robot, _, samples = recorded
    evaluation, base = Evaluation(robot, CONTACTS, noise=NOISE), robot.base_rows
    (found,) = evaluation.metrics([samples], robot.nominal.reshape(1, -1))
    series = noise_series(evaluation.builder, samples, NOISE)
    joints = [rms(x) for x in series[:, base : base + robot.n].T]
    assert found.noise["joint_torque"] == pytest.approx(np.mean(joints), rel=1e-12)
    for group, rows in (("base_force", slice(0, 3)), ("base_moment", slice(3, 6))):
        assert found.noise[group] == (pytest.approx(rms(series[:, rows]), rel=1e-12) if base else None)
    (without,) = Evaluation(robot, CONTACTS).metrics([samples], robot.nominal.reshape(1, -1))
    assert without.noise == {}
    assert without.as_dict() == found.as_dict()


def test_noise_that_is_added_to_a_log_leaves_as_much_after_the_filter() -> None:
    experiment = set_up(load_config(DEMO / "quadruped.yaml"))
    log, rng = read_log(DEMO / "sway_train.npz"), np.random.default_rng(1)
    noise = SensorNoise(joint_torque=0.2, contact_force=3.0, contact_moment=0.1)
    assert log.joint_torque is not None
    assert log.contact_wrench_local is not None
    noisy = replace(
        log,
        joint_torque=log.joint_torque + rng.normal(0.0, 0.2, log.joint_torque.shape),
        contact_wrench_local=log.contact_wrench_local + rng.normal(0.0, noise.wrench_std, (len(log), 4, 6)),
    )
    evaluation = experiment.evaluation()
    before, after = (bind_log(preprocess(one, 8.0), experiment.robot, experiment.contacts) for one in (log, noisy))
    zero = np.zeros((1, experiment.robot.nominal.size))
    difference = force_series(evaluation.builder, after, zero)[0] - force_series(evaluation.builder, before, zero)[0]
    expected = noise_series(evaluation.builder, before, noise)
    for rows in (slice(0, 3), slice(3, 6), slice(6, None)):
        assert rms(difference[:, rows]) == pytest.approx(rms(expected[:, rows]), rel=0.06)
