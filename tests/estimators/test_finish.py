"""A descent takes what the closed form takes, and ends at its optimum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from descents import arm_log, true_arm
from physical import PRIORS, random_case
from synthetic import UR5, load
from thinned import slow_but

from torchid.estimators import Conditions, Consistent, PenaltyWeights, Sgd, Trainer, violations
from torchid.estimators.least_squares import Minimizer
from torchid.estimators.training import excess, finish
from torchid.problem import ExtraTerms, MiniBatches, RowBuilder, assemble, compress_parts
from torchid.sensing import SensorNoise, named_sensors

RIDGE = 0.01


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("seed", slow_but([2, 4, 5], range(6)))
def test_it_ends_at_the_optimum_of_the_closed_form_under_the_same_conditions(seed: int, prior: str) -> None:
    case = random_case(np.random.default_rng(seed))
    settings = Sgd(RIDGE, prior=prior, conditions=case.conditions)
    found = finish(settings, case.problem, Minimizer(case.problem.nominal))
    assert excess(settings, case.problem, found) < 1e-6
    np.testing.assert_array_equal(found.phi, Consistent(RIDGE, prior, case.conditions).minimize(case.problem).phi)
    shape = (-1, 12)
    assert not violations(found.phi.reshape(shape), case.problem.scale.reshape(shape), case.conditions, 1e-8)


def test_of_a_descent_that_ends_early_it_is_known_by_how_much() -> None:
    case = random_case(np.random.default_rng(0), plain=True)
    settings = Sgd(RIDGE, conditions=case.conditions)
    best = Consistent(RIDGE, conditions=case.conditions).solve(case.problem)
    there = excess(settings, case.problem, Minimizer(best.phi))
    assert abs(there) < 1e-6
    nominal = Consistent(1e9, conditions=case.conditions).solve(case.problem).phi
    cost = case.problem.cost(nominal) / case.problem.rows
    away = RIDGE * float(np.square((nominal - case.problem.nominal) / case.problem.scale).sum())
    assert excess(settings, case.problem, Minimizer(nominal)) == pytest.approx(
        (cost + away) / best.objective - 1.0, rel=1e-6
    )


def test_with_penalties_the_bound_holds_and_vanishes_at_the_optimum() -> None:
    case = random_case(np.random.default_rng(1), plain=True)
    settings = Sgd(RIDGE, consistency="penalties", penalties=PenaltyWeights(eigenvalue=1.0), conditions=Conditions())
    before = Minimizer(case.problem.nominal)
    assert (
        excess(settings, case.problem, finish(settings, case.problem, before))
        < 1e-6
        < excess(settings, case.problem, before)
    )


def bolted_arm(terms: ExtraTerms) -> tuple[Trainer, MiniBatches, object]:
    """A UR5 whose torque sensors have offsets, in two logs, each with its own."""
    robot = load(UR5, fixed_base=True)
    builder = RowBuilder(robot, [], named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=0.1)), terms)
    phi, logs = true_arm(robot), []
    for seed in (1, 2):
        log = arm_log(robot, phi, seed, 120)
        shift = torch.linspace(-1.0, 2.0, robot.n, dtype=torch.float64) * seed
        logs.append(replace(log, torque=log.torque + shift + 0.3 * log.joint_acceleration, motion_noise=None))
    assembly = assemble(compress_parts(logs, builder), builder, robot)
    batches = MiniBatches(logs, builder, 50, assembly=assembly)
    return Trainer(Sgd(RIDGE, epochs=2), assembly.problem, batches, data=assembly.problem), batches, assembly.problem


@pytest.mark.parametrize("armature", [False, True])
@pytest.mark.parametrize("scope", ["log", "all"])
def test_offsets_and_armatures_cost_a_batch_what_they_cost_the_closed_form(scope: str, armature: bool) -> None:
    trainer, batches, problem = bolted_arm(ExtraTerms(offsets={"joint_torque": scope}, armature=armature))
    found = finish(trainer.settings, problem, Minimizer(problem.nominal))
    values = torch.from_numpy(np.append(found.phi, [] if found.psi is None else found.psi))
    cost = problem.cost(found.phi, found.psi)
    assert trainer.loss.mean_square(batches, values) == pytest.approx(
        cost / sum(b.rows for b in batches.chunks()), rel=1e-9
    )
    estimate = trainer.run()
    assert estimate.converged
    assert estimate.objective == pytest.approx(Consistent(RIDGE).solve(problem).objective, rel=1e-5)
    if armature:
        np.testing.assert_allclose(estimate.psi[-4:], 0.3, atol=0.02)  # nearer the base rotors and links are alike


def test_mini_batches_alone_meet_conditions_in_the_end() -> None:
    robot = load(UR5, fixed_base=True)
    builder = RowBuilder(robot, [], named_sensors("joints", robot.n, 0, SensorNoise(joint_torque=0.1)))
    logs = [replace(arm_log(robot, true_arm(robot), 1, 200), motion_noise=None)]
    problem = assemble(compress_parts(logs, builder), builder, robot).problem
    free = Consistent(RIDGE).solve(problem)
    upper = np.full(robot.nominal.shape, np.inf)
    upper[3, 11] = 0.7 * free.phi[47]
    settings = Sgd(RIDGE, epochs=60, finish=None, conditions=Conditions(upper=upper))
    estimate = Trainer(settings, problem, MiniBatches(logs, builder, 50)).run()
    assert 0.8 * upper[3, 11] < estimate.phi[47] < 1.01 * upper[3, 11] < 0.72 * free.phi[47]  # 0.89 was found
