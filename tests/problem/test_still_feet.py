"""What a foot that stands still hides, and what a step shows (Mistry, Schaal, Yamane 2009, III-A)."""

from __future__ import annotations

import numpy as np
import pytest
from repository import CONFIGS

import torchid
from torchid import parameters
from torchid.estimators.least_squares import IDENTIFIED, UNOBSERVABLE
from torchid.identifiability.base_parameters import structural_samples
from torchid.problem import RowBuilder, compress, linear_problem
from torchid.sensing import Contact, named_sensors

SOLES = (Contact("l_sole", "flat"), Contact("r_sole", "flat"))
STANDING = ((True, True),)
STEPPING = ((True, True), (True, False), (False, True))


def foot_verdicts(sensors: str, states: tuple[tuple[bool, ...], ...]) -> np.ndarray:
    """Verdicts on the bodies of both soles, (2, 12)."""
    robot = torchid.load_robot(CONFIGS / "biped.urdf")
    builder = RowBuilder(robot, SOLES, named_sensors(sensors, robot.n, 2))
    logs = structural_samples(robot, SOLES, states)
    estimate = torchid.LeastSquares(1e-6).solve(linear_problem(compress(logs, builder), builder, robot))
    bodies = [robot.link(contact.frame)[0] for contact in SOLES]
    return np.asarray(estimate.verdict.reshape(-1, parameters.PER_BODY)[bodies])


@pytest.mark.parametrize("sensors", ["full", "contacts", "joints"])
def test_the_inertia_of_a_foot_cannot_be_seen_while_it_stands_and_can_once_it_steps(sensors: str) -> None:
    inertia = parameters.INERTIA
    assert (foot_verdicts(sensors, STANDING)[:, inertia] == UNOBSERVABLE).all()
    assert (foot_verdicts(sensors, STEPPING)[:, inertia] != UNOBSERVABLE).all()
    if sensors != "contacts":
        assert (foot_verdicts(sensors, STEPPING)[:, inertia] == IDENTIFIED).any(axis=1).all()


def test_joint_torques_alone_see_nothing_of_a_standing_foot() -> None:
    verdicts = foot_verdicts("joints", STANDING)
    assert (verdicts[:, parameters.INERTIAL] == UNOBSERVABLE).all()
