"""A known load in a log: its forces are the robot's, its parameters are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from payloads import load_on
from scipy.spatial.transform import Rotation
from synthetic import SOLO12, TALOS, Oracle, load, make_log
from true_robots import stepping, true_parameters

from torchid.errors import ConfigError, UnknownNameError
from torchid.estimators import LeastSquares
from torchid.parameters import INERTIA_AXES, INERTIAL
from torchid.problem import RowBuilder, bind_log, compress, linear_problem
from torchid.problem.metrics import force_series
from torchid.robot import Payload, Robot, payload_parameters, with_payload
from torchid.sensing import Contact, named_sensors

FEET = ("FL_FOOT", "FR_FOOT", "HL_FOOT", "HR_FOOT")
TURN = Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix()
INERTIA = TURN @ np.diag([0.02, 0.03, 0.04]) @ TURN.T
SKEW = tuple(float(INERTIA[axes]) for axes in INERTIA_AXES)


def turned_links(robot: Robot) -> list[str]:
    """Links that are lumped into a body and turned in it."""
    return [
        name
        for name, (body, T) in robot.links.items()
        if not np.allclose(T[:3, :3], np.eye(3)) and not robot.bodies[body].massless
    ]


def test_a_skew_payload_on_lumped_and_turned_links_is_pinocchio_s() -> None:
    robot = load(TALOS)
    links = turned_links(robot)
    assert len(links) > 3
    for number, link in enumerate(links):
        oracle, payload = Oracle.of(robot), Payload(link, 1.0 + number, (0.1, -0.2, 0.3), SKEW)
        before = oracle.inertial_parameters(robot)
        load_on(oracle, payload)
        added = payload_parameters(robot, [payload]).reshape(robot.nominal.shape)
        np.testing.assert_allclose(added[:, INERTIAL], oracle.inertial_parameters(robot) - before, atol=1e-10)
        assert not added[:, INERTIAL.stop :].any()


def test_a_loaded_robot_alone_gives_the_parameters_of_the_robot_without_its_loads() -> None:
    robot, rng = load(SOLO12), np.random.default_rng(3)
    payloads = [Payload("base_link", 0.8, (0.05, 0.02, 0.1), SKEW), Payload("FL_FOOT", 0.3, (0.02, -0.01, 0.03), SKEW)]
    oracle = Oracle.of(robot)
    oracle.perturb(rng, 0.2)
    true = true_parameters(oracle, robot).flatten()
    for payload in payloads:
        load_on(oracle, payload)
    contacts = tuple(Contact(foot, "point") for foot in FEET)
    log = make_log(oracle, [(foot, 3) for foot in FEET], [*stepping(4), [False] * 4], 400, rng)
    added = payload_parameters(robot, payloads)
    samples = replace(bind_log(log, robot, contacts), payload=added)
    for sensors in (named_sensors(name, robot.n, 4) for name in ("joints", "full")):
        builder = RowBuilder(robot, contacts, sensors)
        estimate = LeastSquares().solve(linear_problem(compress([samples], builder), builder, robot))
        columns = builder.columns.parameter_map
        rows, _ = builder.rows_by_sample(samples[:1], tuple(samples.active[0].tolist()))
        np.testing.assert_allclose(rows[0, :, :-1].numpy() @ columns @ true, rows[0, :, -1], atol=1e-9)
        loaded = with_payload(robot, added).nominal.flatten() - robot.nominal.flatten()
        np.testing.assert_allclose(loaded, added, atol=1e-15)
        full = RowBuilder(robot, contacts, named_sensors("full", robot.n, 4))
        measured, predicted = force_series(full, samples, np.array([estimate.phi, true]))
        assert np.abs(predicted - measured).max() < 1e-10 * np.abs(measured).max()
        _, without = force_series(full, replace(samples, payload=None), np.array([estimate.phi, true]))
        assert np.abs(without[0] - without[1]).max() < 1e-10 * np.abs(measured).max()
        assert np.abs(without[0] - measured).max() > 1e-2 * np.abs(measured).max()


def test_what_cannot_be_carried_is_refused() -> None:
    robot = load(SOLO12)
    with pytest.raises(UnknownNameError, match=r"payload\.link: unknown name 'FL_FOTO'; accepted: .*FL_FOOT"):
        payload_parameters(robot, [Payload("FL_FOTO", 1.0, (0.0, 0.0, 0.0))])
    with pytest.raises(ConfigError, match=r"payload\.inertia: \[1\.0, .* is not physically consistent; accepted: ixx"):
        payload_parameters(robot, [Payload("FL_FOOT", 1.0, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.1, 0.0, 0.1))])
